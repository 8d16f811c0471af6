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
from rejoint.diagnosis.healthy import as_set, healthy_reference, load_healthy
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


def test_a_new_so101_is_healthy_under_whatever_gains_and_supply_it_has():
    """LeRobot's P = 16 and a supply that sags a little make it soft, and no joint worn."""
    arm, gains = so101(), {"p": (16,) * 5}
    robot = open_robot("emulated:so101-new?p=16", arm=arm, seed=7)
    assert dict(robot.servo_gains())["p"] == gains["p"]
    logs = record(robot, seed=7)[0]
    as_sold = load_healthy(arm)
    assert judge(arm, logs, as_sold).condition == "bad"
    diagnosis = judge(arm, logs, as_set(arm, as_sold, gains, np.full(5, 12.0)))
    assert diagnosis.condition == "ok", diagnosis.verdict
    assert 20.0 < diagnosis.healthy.error_mm.value < 40.0
    assert "a healthy arm of this kind with P = 16 and a supply of 12.0 V: " in diagnosis.verdict


def test_what_a_healthy_so101_measures_goes_with_p_and_supply():
    arm = so101()
    as_sold = load_healthy(arm)
    same = as_set(arm, as_sold, {"p": (32,) * 5}, np.full(5, 12.0))
    assert same.joints == as_sold.joints
    assert same.error_mm == as_sold.error_mm
    soft = as_set(arm, as_sold, {"p": (24, 32, 32, 32, 32)}, np.full(5, 6.0))
    for joint, factor in ((0, 24 / 32 / 2), (1, 0.5)):
        stiffness, before = (entry.joints[joint].stiffness_nm_per_rad for entry in (soft, as_sold))
        assert stiffness.value == pytest.approx(factor * before.value)
        assert stiffness.low == pytest.approx(factor * before.low)
    assert 2.0 < soft.error_mm.value / as_sold.error_mm.value < 2.3
    assert soft.setting == " with P = 32 (shoulder_pan 24) and a supply of 6.0 V"  # an owner sees what makes it soft
    errors = [as_set(arm, as_sold, {"p": (p,) * 5}, None).error_mm.value for p in (12, 16, 24, 32, 48, 64)]
    assert sorted(errors, reverse=True) == errors
    assert as_set(arm, as_sold, None, None) is as_sold
    assert as_set(ARM, load_healthy(ARM), {"p": (16,) * 6}, None) == load_healthy(ARM)


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
