"""LeRobot's own bus as a judge of the emulated one: connect, calibrate, read, write, disconnect without complaint."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from rejoint.arms import load_arm
from rejoint.robots.wireserver import TerminalServer
from rejoint_lab.emulator.feetech import HOMING, NAMES, BusSession, build_arm

JUDGE = Path(os.environ.get("REJOINT_JUDGE", Path(__file__).parents[2] / ".judge"))

pytestmark = [
    pytest.mark.realtime,
    pytest.mark.skipif(
        not (JUDGE / "lerobot").is_dir(), reason=f"LeRobot is not in {JUDGE}: `make judge` puts it there"
    ),
]


def test_lerobot_connects_calibrates_moves_and_disconnects():
    arm = build_arm(load_arm("so101"), "so101")
    with TerminalServer(BusSession(arm)) as server:
        device = server.address.removeprefix("feetech://").partition("?")[0]
        command = [sys.executable, str(Path(__file__).with_name("lerobot_judge.py")), device]
        environment = os.environ | {"PYTHONPATH": str(JUDGE)}
        found = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert found.returncode == 0, found.stderr
    seen = json.loads(found.stdout.splitlines()[-1])
    assert seen["models"] == [777]
    assert [seen["held"][name][0] for name in NAMES] == list(HOMING)
    assert seen["calibrated"]
    assert all(abs(count - 2047) <= 3 for count in seen["middle"].values())
    assert all(5.0 < angle < 13.0 for name, angle in seen["moved"].items() if name != "gripper")
    for servo in arm.servos:  # as LeRobot leaves an arm: limp, its calibration kept
        assert (servo["Torque_Enable"], servo["Lock"], servo["P_Coefficient"]) == (0, 0, 16)
        servo.cycle_power()
        assert (servo["Min_Position_Limit"], servo["Max_Position_Limit"]) == (1000, 3000)
