"""Faults against reactions, row by row as in docs/faults.md: the driver and the loop on an emulated arm, over TCP.

The vendor's client is slow to give up: what takes its whole patience is tried once here.
"""

import signal
import time
from contextlib import closing
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from plainbus import PlainBus

from emulatedservers import deploy, serve_tcp
from rejoint.arms import mycobot280
from rejoint.control.controllers.classical import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.robots import open_robot
from rejoint.robots.bus import Vitals
from rejoint.robots.busrobot import BusRobot
from rejoint.robots.mycobot.bus import MyCobotBus  # noqa: F401 - the client without the deprecation that it raises
from rejoint.system.errors import ConnectionLostError, GuardTripError, RobotError
from rejoint_lab.emulator.faults import parse_faults
from rejoint_lab.emulator.firmware import Firmware
from targetdrive import drive_until_error

pytestmark = pytest.mark.realtime

ARM = mycobot280()
TARGETS = np.array([[[0.20, 0.05, 0.20], [0.18, -0.05, 0.22]]])
TIMING = {"state": 0.004, "acknowledgement": 0.003}
PERIOD = 0.04


@pytest.fixture(autouse=True)
def awake(monkeypatch):
    """The client without the 1.5 s that its constructor sleeps."""
    monkeypatch.setattr("pymycobot.mycobot280socket.time", SimpleNamespace(sleep=lambda _: None, time=time.time))


def drive(fault, *, dwell=2.0):
    """Drive to two targets with a fault; returns the recording and what ended it."""
    with (
        serve_tcp(Firmware.build(ARM, "worn"), timing=TIMING, faults=parse_faults(fault, 6)) as server,
        closing(open_robot(server.address, period=(PERIOD, PERIOD))) as robot,
    ):
        return drive_until_error(robot, TARGETS, dwell)


@pytest.mark.parametrize(
    "fault",
    ["drop=0.03", "garbage=0.1", "split=0.1", "double=0.1", "stale=0.05", "half=0.03", "echo=0.05", "stall=0.4/1.5"],
)
def test_a_lossy_link_is_got_over(fault):
    recording, error = drive(fault)
    assert error is None
    assert np.isfinite(recording.position).all()
    assert recording.time[-1, 0] - recording.time[0, 0] >= 4.0
    steps = np.abs(np.diff(recording.command[:, 0], axis=0)).max(axis=0)
    assert (steps <= 0.1 * ARM.max_speed + 1e-9).all()


@pytest.mark.parametrize("fault", ["stall=1.2/3", "gone=1/1"])
def test_after_a_long_stall_or_a_new_connection_the_arm_goes_on_slowly(fault):
    recording, error = drive(fault, dwell=3.0)
    assert error is None
    after = np.flatnonzero(recording.gaps())[0]
    first = np.abs(recording.command[after, 0] - recording.command[after - 1, 0]).max()
    assert np.degrees(first) < 1.0


def test_a_link_that_stays_away_ends_the_run_and_keeps_the_log(monkeypatch):
    monkeypatch.setattr("rejoint.robots.bus.TIMEOUT", 2.0)
    recording, error = drive("gone=0.5/60")
    assert isinstance(error, ConnectionLostError)
    assert len(recording.time) > 1
    assert "holds there" in error.__notes__[-1]


@pytest.mark.parametrize(
    ("fault", "reason", "says"),
    [
        ("overheat=3@0", "temperature", "joint3 is at"),
        ("current=2@0.8", "servo fault", "joint2 reports a servo fault"),
        ("voltage@0.8", "servo fault", "report a servo fault"),
    ],
)
def test_what_servos_suffer_from_holds_the_arm(fault, reason, says):
    _, error = drive(fault, dwell=3.0)
    assert isinstance(error, GuardTripError)
    assert reason in error.reason
    assert says in str(error)
    assert "was stopped" in error.__notes__[-1]


class TimedBus(PlainBus):
    """Its servos suffer from ``onset`` [s] on."""

    costs: ClassVar = {"read": 0.012, "ask": 0.012, "send": 0.008}

    def __init__(self, what, onset):
        super().__init__()
        self.what, self.onset, self.sent = what, onset, []

    def suffers(self, what):
        suffers = self.clock.now() >= self.onset and self.what == what
        self.tell("ask")
        return suffers

    def vitals(self):
        return (
            lambda: Vitals(temperature=np.full(6, 80.0 if self.suffers("temperature") else 30.0)),
            lambda: Vitals(fault=np.full(6, self.suffers("servo fault"))),
        )

    def send(self, goal):
        super().send(goal)
        self.sent.append(self.clock.now())


def trip_in_simulated_time(what, onset, period):
    """Drive until the guard trips; returns the commands sent after ``onset`` [s], and the time to the stop."""
    bus = TimedBus(what, onset)
    robot = BusRobot(bus, ARM, address="test:timed", period=(period, period))
    robot.open()
    with pytest.raises(GuardTripError, match=what):
        run(robot, IntegratorController(ARM), TARGETS, Schedule(dwell=10.0))
    return sum(at > onset for at in bus.sent), bus.clock.now() - onset


@pytest.mark.parametrize("what", ["temperature", "servo fault"])
def test_two_more_commands_at_most_are_sent_after_servos_began_to_suffer(what):
    found = [trip_in_simulated_time(what, onset, 0.050) for onset in 0.5 + np.arange(0.0, 0.2, 0.0037)]
    assert max(commands for commands, _ in found) == 2, "faults and temperatures are asked for in turn, one a period"
    assert max(late for _, late in found) < 3 * 0.050


@pytest.mark.parametrize("what", ["temperature", "servo fault"])
def test_a_period_without_time_for_it_has_servos_asked_within_two_seconds(what):
    found = [trip_in_simulated_time(what, onset, 0.025) for onset in 0.5 + np.arange(0.0, 2.1, 0.17)]
    assert 1.0 < max(late for _, late in found) < 2.0 + 3 * 0.025


def test_an_impossible_jump_is_no_reading():
    recording, error = drive("jump=2@0.8")
    assert np.abs(np.diff(recording.position[:, 0], axis=0)).max() < 0.6
    assert error is None or isinstance(error, RobotError)


def test_the_arm_holds_by_itself_when_whoever_drives_it_is_killed(tmp_path):
    """SIGKILL cannot be noticed: what the firmware was told last is what it holds."""
    firmware = Firmware.build(ARM, "worn")
    begin = firmware.planned_angles
    with serve_tcp(firmware) as server:
        process = deploy(server.address, firmware, tmp_path / "run", 0.1)
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=30)
        time.sleep(1.0)
        there, goal = firmware.angles, firmware.destination
        time.sleep(1.5)
        assert process.returncode == -signal.SIGKILL
        assert firmware.powered
        np.testing.assert_allclose(firmware.angles, there, atol=np.radians(1.0))
        np.testing.assert_array_equal(firmware.destination, goal)
        assert np.abs(firmware.destination - begin).max() > 0.1, "it was on its way"
