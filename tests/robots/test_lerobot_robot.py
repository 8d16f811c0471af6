"""`lerobot_robot_rejoint` before LeRobot's own base classes, on an emulated SO-101; and the lines that it speaks."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from commandline import JUDGE
from emulatedservers import serve_bus
from rejoint.arms import load_arm
from rejoint.control.guard import MAX_PERIOD, GuardLimits
from rejoint.runs.run import Run
from rejoint.session.session import connect
from rejoint.system.errors import InputError
from rejoint_lab.emulator.feetech import StsArm

ARM = load_arm("so101")
MOTORS = (*ARM.joint_names, "gripper")

pytestmark = pytest.mark.realtime


def serving(tmp_path, pty=False):
    server = serve_bus(StsArm.build(ARM, "so101"), pty=pty)
    server.run_path = Run.create(tmp_path / "run", server.address, ARM).path
    return server


def never_dropped(arm):
    for servo in arm.servos:
        assert servo["Torque_Enable"] == 1
        assert all(address != 40 or data != b"\0" for address, data in servo.writes)
        assert all(address != 55 or data == b"\1" for address, data in servo.writes)
    return True


def test_an_arm_follows_joint_goals_and_holds_where_it_is_before_and_after(tmp_path):
    with serving(tmp_path) as server:
        with connect(server.address, run=server.run_path) as arm:
            start = arm.state.joints_rad
            goal = arm.send_joints(ARM.rest + np.radians([40.0, 6.0, -6.0, 8.0, 10.0]))
            time.sleep(3.0)
            end = arm.state.joints_rad
            limited = arm.send_joints([*end[:4], 5.0])
            assert limited[4] == ARM.upper[4]
            with pytest.raises(InputError, match="give radians"):
                arm.send_joints([5.0, -10.0, 8.0, 3.0, 0.0])
            arm.send_joints(end)
        assert np.degrees(start - ARM.rest) == pytest.approx(np.zeros(5), abs=6.0)
        assert np.degrees(end - goal) == pytest.approx(np.zeros(5), abs=1.2)
        goals = [int.from_bytes(data, "little") for address, data in server.arm.servos[0].writes if address == 42]
        limits = GuardLimits.of(ARM)
        longest = limits.max_speed[0] * MAX_PERIOD / ARM.encoder_step  # never a leap: every command is guarded
        assert np.abs(np.diff(goals)).max() <= longest + 1 < np.ptp(goals)
        assert never_dropped(server.arm)
    assert list((server.run_path / "logs").glob("joints-*.parquet"))


def test_lines_of_another_program_are_answered_or_refused(tmp_path):
    with serving(tmp_path) as server:
        address = f"{server.address}?zero=0,0,0,5,0"
        command = [sys.executable, "-m", "rejoint", "serve", address, str(server.run_path), "--stdio"]
        lines = [{}, {"goal": [1.0]}, {"speed": 3}, {"gripper": 40.0}, {}, None]
        program = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        hears = [json.loads(program.stdout.readline())]
        for line in lines:
            if line is None:
                server.arm.execute = lambda _: []
                time.sleep(1.3)
            program.stdin.write(f"{json.dumps(line or {})}\n")
            program.stdin.flush()
            hears.append(json.loads(program.stdout.readline()))
        del server.arm.execute
        program.stdin.close()
        assert program.wait(20) == 0
    program.stdout.close()
    assert hears[0] == {
        "joints": list(ARM.joint_names),
        "middle": pytest.approx(np.radians([0, 0, 0, 5, 0])),
        "gripper": True,
    }
    assert "5 joint positions" in hears[2]["refused"]
    assert "speed" in hears[3]["refused"]
    assert "answered" in hears[6]["refused"]
    assert hears[5]["position"] == pytest.approx((ARM.rest + np.radians([0, 0, 0, 5, 0])).tolist(), abs=np.radians(6.0))


@pytest.mark.skipif(not (JUDGE / "lerobot").is_dir(), reason=f"LeRobot is not in {JUDGE}: `make judge` puts it there")
def test_lerobot_finds_makes_drives_and_leaves_the_robot(tmp_path):
    program = tmp_path / "rejoint"
    path = os.pathsep.join(filter(None, (os.environ.get("PYTHONPATH"), str(Path(__file__).parents[2] / "src"))))
    program.write_text(f'#!/bin/sh\nPYTHONPATH="{path}" exec "{sys.executable}" -m rejoint "$@"\n')
    program.chmod(0o755)
    folder = tmp_path / "home"
    folder.mkdir()
    with serving(tmp_path, pty=True) as server:
        device = server.address.removeprefix("feetech://").partition("?")[0]
        command = [sys.executable, str(Path(__file__).with_name("lerobot_robot_judge.py")), device]
        found = subprocess.run(
            [*command, str(server.run_path), str(program), str(folder)],
            env=os.environ | {"PYTHONPATH": str(JUDGE)},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert found.returncode == 0, found.stderr
        assert never_dropped(server.arm)
    seen = json.loads(found.stdout.splitlines()[-1])
    keys = sorted(f"{name}.pos" for name in MOTORS)
    assert (seen["type"], seen["robot"], seen["abstract"], seen["calibrated"]) == ("rejoint_so101", True, [], True)
    assert seen["features"] == [keys, keys]
    assert seen["connected"] == [False, True, False]
    assert seen["rate"] > 25.0
    assert seen["sent"] == pytest.approx(seen["goal"], abs=1e-6)
    for name in keys:
        assert seen["end"][name] == pytest.approx(seen["goal"][name], abs=3.0 if name == "gripper.pos" else 1.2), name
    assert seen["clipped"] == pytest.approx(np.degrees(ARM.upper[3]) * 4096 / 4095)
    assert abs(seen["moved"]) < 10.0  # what was sent before is not sent again after connecting anew
    assert "rejoint refused the goal" in seen["refused"]
