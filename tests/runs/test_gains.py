"""Gains of the servos' own loops as a stage: searched for, compared, recommended, kept only when asked."""

import io
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import rejoint
from emulatedservers import serve_bus
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.policy import decode_contract, encode_contract
from rejoint.control.servogains import GainsFound, OverloadedError, Round
from rejoint.logs.runfolder import read_effort
from rejoint.robots import place_of
from rejoint.robots.feetech import KIND
from rejoint.runs.run import Run
from rejoint.runs.stages import fitting as stage
from rejoint.session import context
from rejoint.system.errors import ContractError, FileError, InputError
from rejoint.system.files import read_json, write_json
from rejoint.training.task import DEFAULT
from rejoint.training.train import policy_contract
from rejoint.twin.parameters import nominal_parameters
from rejoint_lab.emulator.feetech import StsArm
from servorobot import ARM, ServoRobot

FOUND = KIND.for_all({"p": 32, "i": 0, "d": 32, "dead": 1, "startup": 16}, 5) | {"limit": (0,) * 5}
PLAN = rejoint.TrialPlan(sets=1, repetitions=1, protocol=Protocol(dwell=3.0, hold=3.0))
SEEN = Round(error=np.zeros(5), unrest=np.zeros(5), tool=0.0)


def found_by(run, address="emulated:so101"):
    """Write what a search might have found into a run."""
    under = FOUND | {"p": (40, 48, 48, 40, 32)}
    alone = under | {"i": (0, 2, 2, 0, 0), "limit": (0, 50, 50, 0, 0)}
    result = GainsFound(
        arm=ARM.name,
        robot=address,
        found=FOUND,
        under=under,
        alone=alone,
        before=SEEN,
        with_under=SEEN,
        with_alone=SEEN,
        rounds=3,
    )
    write_json(run.folder.gains, result)
    return result


def test_what_a_search_finds_takes_part_in_the_comparison(tmp_path, monkeypatch):
    monkeypatch.setattr(stage, "TARGETS", 1)
    robot, run = ServoRobot(), Run.create(tmp_path, "emulated:so101", ARM)
    with pytest.raises(FileError, match=r"run `rejoint gains ROBOT"):
        rejoint.compare(
            robot, ["servo-gains"], [[0.3, 0.05, 0.2]], run=run, plan=rejoint.TrialPlan(sets=1, repetitions=1)
        )
    before = robot.servo_gains()
    rehearsed = rejoint.gains(robot, run, settings=rejoint.Settings(dry_run=True))
    assert rehearsed.rounds > 0
    assert not robot.history
    assert not run.folder.gains.exists()
    found = rejoint.gains(robot, run)
    spent = read_effort(run.folder)
    assert [stage.name for stage in spent.stages] == ["gains"]
    assert spent.total.moving > 0.0
    again = read_json(run.folder.gains, GainsFound)
    assert (again.found, again.under, again.alone) == (found.found, found.under, found.alone)
    np.testing.assert_array_equal(again.before.error, found.before.error)
    robot.history.clear()
    targets = np.array([[0.33, 0.05, 0.22], [0.31, -0.05, 0.20]])
    names = ["default", "servo-gains", "servo-gains+integrator"]
    compared = rejoint.compare(robot, names, targets, run=run, plan=PLAN)
    assert robot.servo_gains() == before
    assert all(gains in robot.history for gains in (found.alone, found.under))
    settled = {row.controller: row.settled.mean.value for row in compared.comparison.rows}
    assert settled["servo-gains"] < settled["default"]


def test_gains_that_a_servo_does_not_bear_are_left_out_and_the_others_are_compared(tmp_path):
    class Weak(ServoRobot):
        def tune(self, gains):
            if gains["p"][1] > 32:
                raise OverloadedError(
                    "shoulder_lift does not bear p=48: load 75 %, 31 deg C; the gains are as before", 1
                )
            super().tune(gains)

    robot, run = Weak(), Run.create(tmp_path, "emulated:so101", ARM)
    found_by(run)
    point = [[0.33, 0.05, 0.22]]
    found = rejoint.compare(robot, ["default", "servo-gains"], point, run=run, plan=PLAN).comparison
    assert [row.controller for row in found.rows] == ["default"]
    assert "servo-gains" in found.left_out[0]
    assert "load 75 %" in found.left_out[0]
    with pytest.raises(OverloadedError):
        rejoint.compare(robot, ["servo-gains"], point, run=run, plan=PLAN)


def test_an_arm_that_tells_no_gains_is_not_driven_under_any(tmp_path):
    arm = replace(ARM, servos=())
    run = Run.create(tmp_path, "emulated:worn", arm)
    found_by(run)
    assert not place_of("emulated:worn").tunable(arm)
    assert place_of("feetech:///dev/ttyACM0").tunable(arm)
    with pytest.raises(InputError, match="no servo gains"):
        rejoint.deploy(
            "emulated:worn", [[0.3, 0.05, 0.2]], run=run, settings=rejoint.Settings(controller="servo-gains")
        )


def test_the_memory_of_the_servos_is_written_after_a_yes_alone(tmp_path, monkeypatch, cli):
    arm = StsArm.build(ARM, "so101")
    with serve_bus(arm) as server:
        run = Run.create(tmp_path, server.address, ARM)
        found = found_by(run, server.address)
        for more, answer, code in (([], "n\n", 2), (["--yes"], "", 0)):
            monkeypatch.setattr("sys.stdin", io.StringIO(answer))
            told = cli("gains", server.address, run.path, "--keep", *more, code=code)
            assert "p 40/48/48/40/32" in told.err
            assert "LeRobot" in told.err
            if code:
                assert all(not servo.writes for servo in arm.servos)
    assert "Before: limit 0, p 32" in " ".join(told.out.split())
    for index, servo in enumerate(arm.servos[:5]):
        servo.cycle_power()
        assert (servo["P_Coefficient"], servo["I_Coefficient"]) == (found.alone["p"][index], found.alone["i"][index])
        assert servo["Lock"] == 1


def test_a_policy_is_trained_for_the_gains_of_the_diagnosis(tmp_path, monkeypatch):
    asked = []

    def learn(*_, options, **__):
        asked.append(options.servo_gains)
        raise KeyboardInterrupt

    run = Run.create(tmp_path, "emulated:so101", ARM)
    monkeypatch.setattr("rejoint.training.train.train", learn)
    monkeypatch.setattr(Run, "diagnosis", SimpleNamespace(servo_gains=FOUND))
    with pytest.raises(rejoint.InputError, match=r"no twin.toml; run `rejoint identify .* --generic"):
        rejoint.train(run=run)
    with pytest.raises(KeyboardInterrupt):
        rejoint.train(run=run, settings=rejoint.TrainSettings(generic=True))
    assert asked == [FOUND]
    contract = replace(policy_contract(ARM, None, DEFAULT, 0), servo_gains=FOUND)
    text = encode_contract(contract)
    assert decode_contract(text).servo_gains == FOUND
    earlier = json.loads(text)
    del earlier["servo_gains"]
    assert decode_contract(json.dumps(earlier)).servo_gains is None


def tuned_run(path, monkeypatch, policy=True):
    """A run whose search has found gains, with a twin, and a policy that was trained for them."""
    run = Run.create(path, "emulated:so101", ARM)
    found = found_by(run)
    stiff = replace(nominal_parameters(ARM), stiffness=np.full(5, 20.0))
    twin = SimpleNamespace(parameters=stiff, digest=lambda: "0" * 16)
    monkeypatch.setattr(Run, "twin", twin)
    monkeypatch.setattr(context, "replace", lambda one, **changes: SimpleNamespace(**(vars(one) | changes)))
    if policy:
        run.folder.policy.write_bytes(b"")
        contract = SimpleNamespace(servo_gains=found.under)
        monkeypatch.setattr(Run, "policy", SimpleNamespace(contract=contract))
    return run, found


def test_a_policy_is_trained_for_the_gains_that_a_search_found_on_a_twin_as_stiff_as_then(tmp_path, monkeypatch):
    asked = []

    def learn(arm, twin, *, options, **_):
        asked.append((twin.parameters.stiffness, options.servo_gains))
        raise KeyboardInterrupt

    run, found = tuned_run(tmp_path / "run", monkeypatch, policy=False)
    monkeypatch.setattr("rejoint.training.train.train", learn)
    with pytest.raises(KeyboardInterrupt):
        rejoint.train(run=run)
    np.testing.assert_allclose(asked[0][0], 20.0 * np.array([40, 48, 48, 40, 32]) / 32)
    assert asked[0][1] == found.under


def test_what_a_run_made_for_tuned_gains_is_driven_under_them_and_not_under_those_before(tmp_path, monkeypatch):
    run, found = tuned_run(tmp_path / "run", monkeypatch)

    def names(twin):
        return set(context.ControllerMaker(ARM, (0.02, 0.02), run, twin).contenders(real=True, posed=False))

    assert {"servo-gains+policy", "servo-gains+predictive"} <= names(run.twin)
    assert "servo-gains+predictive" not in names(None), "without a twin"
    assert not {"policy", "predictive", "shelf"} & names(run.twin), "on a real arm the own policy takes its place"
    assert context.ControllerMaker(ARM, run=run).choice()[0] == "servo-gains+policy"
    run.policy.contract.servo_gains = found.found  # trained before the search, as runs used to be
    assert "policy" in names(run.twin)
    assert context.ControllerMaker(ARM, run=run).choice()[0] == "policy"
    with pytest.raises(ContractError, match=r"no policy for the gains that its search found \(p 40/48/48/40/32"):
        context.ControllerMaker(ARM, (0.02, 0.02), run=run).factories(["servo-gains+policy"])
