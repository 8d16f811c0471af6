"""LeRobot's own bus as a judge of the emulated one: connect, calibrate, read, write, disconnect without complaint."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from commandline import JUDGE
from rejoint.arms import load_arm
from rejoint.robots.wireserver import TerminalServer
from rejoint_lab.emulator import dynamixel, feetech
from rejoint_lab.emulator.servobus import BusSession
from rejoint_lab.plant.wear import load_wear

NAMES = (*load_arm("so101").joint_names, "gripper")

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(
        not (JUDGE / "lerobot").is_dir(), reason=f"LeRobot is not in {JUDGE}: `make judge` puts it there"
    ),
]


def judged(session):
    """What LeRobot's bus saw and did."""
    with TerminalServer(session) as server:
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
    return seen


def test_lerobot_connects_calibrates_moves_and_disconnects():
    arm = feetech.StsArm.build(load_arm("so101"), "so101")
    seen = judged(BusSession(arm))
    assert seen["models"] == [777]
    assert [seen["held"][name][0] for name in NAMES] == list(feetech.HOMING)
    for servo in arm.servos:  # as LeRobot leaves an arm: limp, its calibration kept
        assert (servo["Torque_Enable"], servo["Lock"], servo["P_Coefficient"]) == (0, 0, 16)
        servo.cycle_power()
        assert (servo["Min_Position_Limit"], servo["Max_Position_Limit"]) == (1000, 3000)


def test_lerobots_dynamixel_bus_does_the_same_on_a_koch():
    koch = load_arm("koch")
    arm = dynamixel.XArm(koch, load_wear("new", koch), gravity=np.zeros(3))  # limp for its calibration, it would fall
    seen = judged(BusSession(arm))
    assert seen["models"] == [1060, 1200]
    assert [seen["held"][name][0] for name in NAMES] == list(dynamixel.FITTINGS["koch"].homing)
    for servo in arm.servos:
        assert (servo["Torque_Enable"], servo["Position_P_Gain"], servo["Return_Delay_Time"]) == (0, 1600, 0)
        servo.cycle_power()
        assert (servo["Min_Position_Limit"], servo["Max_Position_Limit"]) == (1000, 3000)
