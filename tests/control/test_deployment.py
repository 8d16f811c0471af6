"""What a deployment says of each target: reached, missed and why, never tried."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import rejoint
from rejoint.arms import mycobot280
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.moving.drive import Deployment, judge_targets
from rejoint.control.recording import recording_of
from rejoint.robots import open_robot
from rejoint.runs.run import Run
from rejoint.session.context import guard_limits
from rejoint.system.errors import ContractError, GuardTripError, InputError
from rejoint.training.task import DEFAULT
from rejoint.training.train import policy_contract
from targetdrive import deploy, grow_hot

ARM = mycobot280()
NEAR = np.array([[0.17, 0.0, 0.2], [0.18, 0.03, 0.21]])
FAR = np.array([[0.6, 0.0, 0.2]])
"""[m] twice the arm's reach"""


def job(targets, **changes):
    return replace(Deployment(controller="integrator", targets=targets, dwell=4.0), **changes)


def drive(targets, **changes):
    return deploy(open_robot("emulated:worn"), make_controller("integrator", ARM), job(targets, **changes))


def test_a_target_counts_where_the_encoders_say_so_at_the_end():
    recording, done = drive(NEAR)
    assert [visit.reached for visit in done.visits] == [True, True]
    assert done.missed == ()
    assert done.gaps == ()
    assert done.period == pytest.approx(0.025, abs=0.003)
    assert all(0.0 < visit.error < 0.003 for visit in done.visits)
    assert all(visit.true_error.value > 0.003 for visit in done.visits), "the emulator knows that the tool is elsewhere"
    assert done.visits[0].remark == ""
    strict = judge_targets(ARM, recording, job(NEAR, within=1e-5))
    assert strict.missed == (1, 2)


def test_a_target_out_of_reach_is_missed_and_says_how_far():
    _, done = drive(np.vstack([NEAR[:1], FAR]))
    assert done.missed == (2,)
    assert "mm off after 4 s" in done.visits[1].remark
    assert done.visits[1].error > 0.2


def test_what_was_done_before_a_trip_is_told(monkeypatch):
    grow_hot(monkeypatch, at=300)
    plan = job(np.vstack([NEAR, NEAR]))
    with pytest.raises(GuardTripError) as caught:
        deploy(open_robot("emulated:worn"), make_controller("integrator", ARM), plan)
    done = judge_targets(ARM, recording_of(caught.value), plan, ended=True)
    assert [visit.remark for visit in done.visits] == ["", "ended early", "not tried", "not tried"]
    assert done.visits[0].reached
    assert done.missed == (2, 3, 4)


def test_a_policy_is_refused_by_the_period_that_was_measured():
    robot, policy = open_robot("emulated:worn"), DefaultController(ARM)
    policy.contract = replace(policy_contract(ARM, None, DEFAULT, 0), min_period=0.040, max_period=0.060)
    settings = rejoint.Settings(controller=policy, dwell=1.0)
    with pytest.raises(ContractError):
        rejoint.deploy(robot, NEAR, settings=settings)
    assert robot.read().time == pytest.approx(1.0, abs=0.1), "it was brought to rest, and no farther"
    policy.contract = replace(policy.contract, min_period=0.020, max_period=0.030)
    assert rejoint.deploy("emulated:worn", NEAR[:1], settings=settings).visits[0].error is not None


def diagnosed():
    """As much of a diagnosis as a guard needs: gains, and softness [rad/(N m)] and offsets [rad] of the joints."""
    balance = np.array([0.0, 0.1, 0.1, 0.1, 0.0, 0.0]), np.zeros(6)
    return SimpleNamespace(servo_gains=None, measurement=SimpleNamespace(balance=lambda _: balance))


def save_logs(run):
    recording, _ = drive(NEAR)
    for name in ("excitation", "targets"):
        recording.log(0, name).save(run.folder.log(name))


def test_a_stage_that_drives_knows_at_which_pushes_the_joints_of_this_arm_stand(tmp_path, monkeypatch):
    run = Run.create(tmp_path, "emulated:worn", ARM)
    assert guard_limits(run, ARM, "emulated:worn").bands is None, "no diagnosis, nothing known"
    save_logs(run)
    monkeypatch.setattr(Run, "diagnosis", diagnosed())
    bands = guard_limits(run, ARM, "emulated:worn").bands
    assert bands.width.shape == (6,)
    assert (bands.width >= ARM.encoder_step).all()


@pytest.mark.parametrize(
    ("own", "driven", "used"),
    [
        ("emulated:worn", "emulated:worn?seed=1", False),
        ("emulated:worn", "tcp://127.0.0.1:9000", False),
        ("tcp://127.0.0.1:9000", "emulated:worn", False),
        ("tcp://127.0.0.1:9000", "tcp://192.168.1.5:9000", True),
    ],
)
def test_what_a_run_knows_of_its_joints_is_used_for_its_own_arm_only(tmp_path, monkeypatch, own, driven, used):
    """A real arm has many addresses."""
    monkeypatch.setattr(Run, "diagnosis", diagnosed())
    run = Run.create(tmp_path, own, ARM)
    save_logs(run)
    limits = guard_limits(run, ARM, driven)
    assert (limits.bands is not None) == used


def test_targets_out_of_reach_are_refused_before_anything_moves():
    robot = open_robot("emulated:worn")
    with pytest.raises(InputError, match=r"number 2: \(900, 0, 200\) mm out of reach by \d+.* mm; the nearest"):
        rejoint.deploy(robot, [[0.17, 0.0, 0.2], [0.9, 0.0, 0.2]], settings=rejoint.Settings(controller="integrator"))
    assert robot.read().time == 0.0
