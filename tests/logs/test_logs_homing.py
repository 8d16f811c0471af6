"""Corrected zeros in LeRobot's calibration: its degrees then say where the links are."""

import json

import numpy as np
import pytest

from rejoint.arms import load_arm
from rejoint.logs.joints import corrected_homing, write_homing
from rejoint.system.errors import InputError

ARM = load_arm("so101")
NAMES = (*ARM.joint_names, "gripper")


@pytest.fixture
def source(tmp_path):
    path = tmp_path / "arm.json"
    rng = np.random.default_rng(3)
    motors = {
        name: {
            "id": i + 1,
            "drive_mode": 0,
            "homing_offset": int(rng.integers(-1500, 1500)),
            "range_min": int(rng.integers(700, 900)),
            "range_max": int(rng.integers(3200, 3400)),
        }
        for i, name in enumerate(NAMES)
    }
    path.write_text(json.dumps(motors))
    return path


def degrees(motor, raw):
    """As LeRobot has them for Feetech servos: present = raw - homing_offset, from the middle of the range."""
    return (raw - motor["homing_offset"] - 0.5 * (motor["range_min"] + motor["range_max"])) * 360.0 / 4096


def test_degrees_change_by_the_offset_and_the_gripper_s_do_not(source):
    before, offset = json.loads(source.read_bytes()), np.radians([1.0, -2.0, 0.5, 3.0, -0.4])
    motors, changes = corrected_homing(source, ARM, offset)
    count = 360.0 / 4096
    for joint, angle in zip(ARM.joint_names, np.degrees(offset), strict=True):
        assert degrees(motors[joint], 2000) - degrees(before[joint], 2000) == pytest.approx(angle, abs=0.5 * count)
        assert changes[joint] == motors[joint]["homing_offset"] - before[joint]["homing_offset"]
    assert motors["gripper"] == before["gripper"]
    kept = [{key: motors[name][key] for key in ("id", "drive_mode", "range_min", "range_max")} for name in NAMES]
    assert kept == [
        {key: before[name][key] for key in ("id", "drive_mode", "range_min", "range_max")} for name in NAMES
    ]


def test_what_is_written_is_corrected_back_to_what_was_read(source, tmp_path):
    offset = np.radians([1.0, -2.0, 0.5, 3.0, -0.4])
    motors, _ = corrected_homing(source, ARM, offset)
    write_homing(tmp_path / "new.json", motors)
    assert corrected_homing(tmp_path / "new.json", ARM, -offset)[0] == json.loads(source.read_bytes())


def test_an_offset_that_a_servo_cannot_hold_is_refused(source):
    with pytest.raises(InputError, match=r"homing offset of -?\d+ counts, expected at most 2047"):
        corrected_homing(source, ARM, np.full(5, np.radians(359.0)))
