"""`rejoint doctor` names what was planted, in one line with what to do."""

import errno
import fcntl
import os
import pty
import shutil
import termios
import time
from contextlib import ExitStack
from types import SimpleNamespace
from unittest.mock import MagicMock

import cv2
import pytest
import serial

from emulatedservers import serve_bus, serve_tcp
from rejoint.arms import load_arm, mycobot280
from rejoint.robots.mycobot import wire
from rejoint.runs.run import Run
from rejoint.system import extras
from rejoint_lab.emulator.faults import parse_faults
from rejoint_lab.emulator.feetech import StsArm
from rejoint_lab.emulator.firmware import Firmware
from test_newcomer import COBOT, serial_line

SO101 = load_arm("so101")


class Bench:
    """Where something is planted."""

    def __init__(self, patch, folder, stack):
        self.patch, self.folder, self._stack = patch, folder, stack

    def so101(self, fault="", **registers):
        arm = StsArm.build(SO101, "so101")
        for name, value in registers.items():
            arm.servos[2][name] = value
        return self._stack.enter_context(serve_bus(arm, fault)).address

    def mycobot(self, fault=""):
        computer = Firmware.build(mycobot280(), "worn")
        return self._stack.enter_context(serve_tcp(computer, faults=parse_faults(fault, 6))).address

    def line(self, answer, begins, rate):
        return self._stack.enter_context(serial_line(answer, begins, rate))

    def run(self, robot):
        return Run.create(self.folder / "run", robot, mycobot280()).path


def no_permission(bench):
    def refuse(*_, **__):
        raise serial.SerialException(errno.EACCES, "could not open port")

    bench.patch.setattr(serial, "Serial", refuse)
    return [f"serial://{bench.folder}"]


def another_program(bench):
    ours, theirs = pty.openpty()
    for descriptor in (ours, theirs):
        bench._stack.callback(os.close, descriptor)
    fcntl.flock(theirs, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return [f"serial://{os.ttyname(theirs)}"]


def damaged(bench):
    path = bench.run("emulated:worn")
    (path / "twin.toml").write_text("format = ")
    return ["emulated:worn", path]


def old_firmware(bench):
    bench.patch.setitem(wire.ROWS, (0x02, 0), wire.ROWS[0x02, 0]._replace(answer="2d"))
    return [bench.mycobot()]


def patched(what, name, value):
    def plant(bench):
        bench.patch.setattr(what, name, value)
        return []

    return plant


dark = patched(cv2, "VideoCapture", MagicMock(**{"return_value.read.return_value": (False, None)}))


PLANTED = {
    "port missing": (lambda _: ["feetech:///dev/ttyACM77"], "robot", "there is no port", "ports of this computer"),
    "no address": (lambda _: ["foo://x"], "robot", "unknown robot address", "tcp://"),
    "no permission": (no_permission, "robot", "no permission", "usermod -aG"),
    "wrong baud rate": (
        lambda bench: ["serial://" + bench.line(COBOT, b"\xfe\xfe", termios.B115200)],
        "robot",
        "a myCobot 280 answers",
        "?baud=115200",
    ),
    "wrong protocol": (
        lambda bench: [bench.so101().replace("feetech", "tcp")],
        "robot",
        "Feetech servos",
        "give feetech://",
    ),
    "other program on the port": (another_program, "robot", "another program drives the arm", "end it"),
    "servo missing": (lambda bench: [bench.so101("mute=3@0/1000")], "robot", "elbow_flex (servo 3)", "cable"),
    "two servos with one ID": (lambda bench: [bench.so101("same=3@0")], "robot", "servo 3", "ID"),
    "low voltage": (lambda bench: [bench.so101("voltage@0")], "servos", "voltage", "power supply"),
    "hot servo": (lambda bench: [bench.so101("overheat=2@0")], "servos", "shoulder_lift 85", "cool"),
    "hot servo of a myCobot": (lambda bench: [bench.mycobot("overheat=2@0")], "servos", "joint2 85", "cool"),
    "extra missing": (
        lambda bench: bench.patch.setitem(extras.EXTRAS, "train", ("no_such_module",)) or [],
        "extras",
        "train",
        "pip install",
    ),
    "full disk": (
        patched(shutil, "disk_usage", lambda _: SimpleNamespace(free=2e7)),
        "disk",
        "0.0 GB free",
        "free 980 MB",
    ),
    "clock behind": (patched(time, "time", lambda: 1e9), "clock", "files here are newer", "set-ntp"),
    "slow link": (lambda bench: [bench.mycobot("slow=0.1")], "link", "a question takes", "--period"),
    "firmware unknown": (old_firmware, "servos", "firmware: 4.5, expected 7.3", "update"),
    "arm not calibrated": (
        lambda bench: [bench.so101(Min_Position_Limit=0, Max_Position_Limit=4095)],
        "robot",
        "never calibrated",
        "lerobot-calibrate",
    ),
    "tool not calibrated": (
        lambda bench: ["emulated:worn", bench.run("emulated:worn")],
        "run",
        "no calibration",
        "rejoint calibrate",
    ),
    "camera dark": (lambda bench: [*dark(bench), "--camera", 0], "camera", "gives no pictures", "check its cable"),
    "camera missing": (lambda _: ["--camera", 7], "camera", "no camera answers as number 7", "plug it in"),
    "run of another arm": (
        lambda bench: ["emulated:healthy", bench.run("tcp://10.0.0.1:9000")],
        "run",
        "is a run of tcp://10.0.0.1:9000 (mycobot280)",
        "give another RUN",
    ),
    "damaged run": (damaged, "run", "twin.toml", "identify"),
    "no compiler": (
        lambda bench: bench.patch.setenv("NUMBA_DISABLE_JIT", "1") or [],
        "compiler",
        "NUMBA_DISABLE_JIT is set",
        "unset it",
    ),
}


@pytest.mark.realtime
@pytest.mark.parametrize("planted", PLANTED)
def test_the_cause_is_named_with_its_remedy(planted, tmp_path, monkeypatch, cli):
    plant, check, found, fix = PLANTED[planted]
    monkeypatch.chdir(tmp_path)
    with ExitStack() as stack:
        told = cli("doctor", *plant(Bench(monkeypatch, tmp_path, stack)), "--json", code=2)
    named = [one for one in told.last["findings"] if one["check"] == check and one["fix"]]
    assert any(found in one["found"] and fix in one["fix"] for one in named), told.out
    assert all(one["found"].count("\n") == 0 for one in named)
    assert {one["check"] for one in told.last["findings"] if one["fix"]} <= {check, "extras", "link"}


@pytest.mark.realtime
@pytest.mark.parametrize("arm", ["so101", "mycobot"])
def test_a_sound_arm_has_nothing_to_put_right(arm, tmp_path, monkeypatch, cli):
    with ExitStack() as stack:
        told = cli("doctor", getattr(Bench(monkeypatch, tmp_path, stack), arm)())
    assert "Nothing to put right" in told.out
    assert told.out.splitlines()[0].startswith("rejoint ")
