"""LeRobot's own bus as a judge of the emulated one: connect, calibrate, read, write, disconnect without complaint."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from commandline import JUDGE
from emulatedservers import serve_bus
from rejoint.arms import load_arm
from rejoint_lab.emulator import dynamixel, feetech
from rejoint_lab.plant.wear import load_wear

NAMES = (*load_arm("so101").joint_names, "gripper")

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(
        not (JUDGE / "lerobot").is_dir(), reason=f"LeRobot is not in {JUDGE}: `make judge` puts it there"
    ),
]


def judge(arm, models, homing, left):
    """LeRobot's bus finds servos and homing offsets, and leaves registers as it should, its calibration kept."""
    arm.advance(0.01)  # compiles the plant now: LeRobot waits for 0.8 s
    with serve_bus(arm, pty=True) as server:
        family, _, rest = server.address.partition("://")
        device = rest.partition("?")[0]
        command = [sys.executable, str(Path(__file__).with_name("lerobot_judge.py")), device, family]
        environment = os.environ | {"PYTHONPATH": str(JUDGE)}
        found = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert found.returncode == 0, found.stderr
    seen = json.loads(found.stdout.splitlines()[-1])
    assert seen["calibrated"]
    assert all(abs(count - 2047) <= 3 for count in seen["middle"].values())
    assert all(5.0 < angle < 14.0 for name, angle in seen["moved"].items() if name != "gripper")
    assert seen["models"] == models
    assert [seen["held"][name][0] for name in NAMES] == list(homing)
    for servo in arm.servos:
        assert {name: servo[name] for name in left} == left
        servo.cycle_power()
        assert (servo["Min_Position_Limit"], servo["Max_Position_Limit"]) == (1000, 3000)


def test_lerobot_connects_calibrates_moves_and_disconnects():
    arm = feetech.StsArm.build(load_arm("so101"), "so101")
    judge(arm, [777], feetech.HOMING, {"Torque_Enable": 0, "Lock": 0, "P_Coefficient": 16})


def test_lerobots_dynamixel_bus_does_the_same_on_a_koch():
    koch = load_arm("koch")
    arm = dynamixel.XArm(koch, load_wear("new", koch), gravity=np.zeros(3))  # limp for its calibration, it would fall
    left = {"Torque_Enable": 0, "Position_P_Gain": 1600, "Return_Delay_Time": 0}
    judge(arm, [1060, 1200], dynamixel.FITTINGS["koch"].homing, left)
