"""Diagnosis of arms that are not a myCobot: plans that fit, thresholds that go with the size, a reference on demand."""

import dataclasses

import numpy as np
import pytest

from modelfiles import packaged, ur5e
from rejoint.arms import Arm, gravity_torque, load_arm, mycobot280, so101
from rejoint.arms.room import is_safe
from rejoint.arms.size import heaviest_load, torque_size
from rejoint.diagnosis.diagnosis import judge
from rejoint.diagnosis.excitation import SHORT, plan_excitation
from rejoint.diagnosis.healthy import healthy_reference, load_healthy
from rejoint.diagnosis.record import record
from rejoint.robots import open_robot
from rejoint.system.errors import InputError

ARM = mycobot280()


def low_shoulder() -> Arm:
    """A UR5, whose shoulder sits 89 mm above the base, less than what other joints keep from the floor."""
    file = packaged("ManipulaPy", "ManipulaPy_data/universal_robots/ur5/ur5.urdf")
    return load_arm(file, base="base_link", tip="tool0")


@pytest.mark.parametrize("make", [so101, ur5e, low_shoulder])
@pytest.mark.parametrize("seed", range(3))
def test_a_plan_for_another_arm_is_safe_and_slow_enough(make, seed):
    arm = make()
    excitation = plan_excitation(arm, seed=seed)
    time = np.arange(0.0, excitation.duration, 0.02)
    q = excitation.command(time)
    assert is_safe(arm, q).all()
    assert (np.abs(np.diff(q, axis=0)) / 0.02 <= arm.max_speed + 1e-9).all()
    assert (np.abs(gravity_torque(arm, q)) <= heaviest_load(arm) + 0.021 * torque_size(arm)).all()


def test_a_slow_arm_is_excited_slowly_and_a_cramped_one_gently():
    slow = dataclasses.replace(ARM, max_speed=np.full(6, 0.6))
    excitation = plan_excitation(slow, seed=0)
    speed = np.abs(np.diff(excitation.position, axis=0)) / np.diff(excitation.time)[:, None]
    assert speed.max() <= 0.6
    plan = plan_excitation(ARM, seed=0)
    cramped = dataclasses.replace(ARM, upper=np.where(np.arange(6) == 5, ARM.rest + np.radians(24.0), ARM.upper))
    gentle = plan_excitation(cramped, seed=0)
    multisine = next(s for s in gentle.segments if s.kind == "multisine")
    wide, narrow = (
        np.abs(e.command(np.arange(multisine.start, multisine.stop, 0.02)) - ARM.rest).max() for e in (plan, gentle)
    )
    assert 0.3 * wide < narrow < 0.999 * wide
    with pytest.raises(InputError, match="safe"):
        plan_excitation(dataclasses.replace(ARM, upper=ARM.rest + np.radians(10.5)), seed=0)


def test_a_worn_arm_of_another_build_is_found_out_and_a_healthy_one_is_not():
    arm = so101()
    reference = load_healthy(arm)
    assert reference is not None
    assert healthy_reference(arm) == reference
    for address, condition in (("emulated:healthy", "ok"), ("emulated:worn", "bad")):
        logs = record(open_robot(address, arm=arm, seed=7), seed=7)[0]
        diagnosis = judge(arm, logs, reference)
        assert diagnosis.condition == condition, diagnosis.verdict
    found = {(finding.joint, finding.kind) for finding in diagnosis.findings}
    assert {("shoulder_lift", "weak_gain"), ("elbow_flex", "hysteresis")} <= found


def test_a_reference_for_an_unknown_arm_is_measured_on_demand(monkeypatch):
    arm = dataclasses.replace(ARM, name="mine")
    assert load_healthy(arm) is None
    monkeypatch.setattr("rejoint.diagnosis.healthy.record", _short_record)
    monkeypatch.setattr("rejoint.diagnosis.healthy.ARMS_ON_DEMAND", 4)
    found = healthy_reference(arm)
    assert found is not None
    assert (found.arm, found.source) == ("mine", "4 emulated arms with wear profile 'healthy'")
    assert 1.5 < found.error_mm.value < 5.0
    monkeypatch.setattr("rejoint.diagnosis.healthy.SIMULATOR", "a_module_that_nobody_has")
    assert healthy_reference(arm) is None


def _short_record(robot, *, seed):
    return record(robot, seed=seed, plan=SHORT)
