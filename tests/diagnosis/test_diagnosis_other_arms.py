"""Diagnosis of arms that are not a myCobot: plans that fit, thresholds that go with the size, a reference on demand."""

import dataclasses

import numpy as np
import pytest

from modelfiles import packaged, ur5e
from rejoint.arms import gravity_torque, load_arm, mycobot280, so101
from rejoint.arms.inertia import loaded
from rejoint.arms.workspace import heaviest_load, is_safe, torque_size
from rejoint.diagnosis.diagnosis import judge
from rejoint.diagnosis.excitation import plan_excitation, record
from rejoint.diagnosis.healthy import healthy_reference
from rejoint.robots import open_robot
from rejoint.system.errors import InputError
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear

ARM = mycobot280()


def low_shoulder():
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
    reference = healthy_reference(arm)
    assert reference is not None
    robot = EmulatedRobot(arm, [load_wear(name, arm) for name in ("healthy", "worn")], seed=7)
    for logs, condition in zip(record(robot, seed=7), ("ok", "bad"), strict=True):
        diagnosis = judge(arm, logs, reference)
        assert diagnosis.condition == condition, diagnosis.verdict
    found = {(finding.joint, finding.kind) for finding in diagnosis.findings}
    assert ("shoulder_lift", "weak_gain") in found
    assert "elbow_flex" in {joint for joint, _ in found}


@pytest.mark.parametrize(
    ("knob", "load", "usual", "setting"),
    [("p=16", 0.0, 30.0, "P = 16"), ("payload=0.25", 0.25, 45.0, "0.25 kg and P = 32")],
)
def test_a_new_so101_is_healthy_under_whatever_gains_supply_and_load_it_has(knob, load, usual, setting):
    """LeRobot's P = 16, a supply that sags a little and a load bend it, and no joint is worn."""
    arm = loaded(so101(), load)
    robot = open_robot(f"emulated:so101-new?{knob}", arm=arm, seed=7)
    logs, gains = record(robot, seed=7)[0], dict(robot.servo_gains())
    assert judge(arm, logs, healthy_reference(so101())).condition in ("worn", "bad")
    diagnosis = judge(arm, logs, healthy_reference(arm, gains=gains, voltage=np.full(5, 12.0)))
    assert diagnosis.condition == "ok", diagnosis.verdict
    assert 0.7 * usual < diagnosis.healthy.error_mm.value < 1.3 * usual
    assert f"a healthy arm of this kind with {setting} and a supply of 12.0 V: " in diagnosis.verdict
