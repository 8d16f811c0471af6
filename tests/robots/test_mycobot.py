"""The driver against a server that misbehaves on purpose, and against the emulated worn arm."""

import logging
import os
import pty
import socket
import struct
import threading
import time
from contextlib import suppress
from types import SimpleNamespace

import numpy as np
import pytest
from plainbus import SimulatedClock

from emulatedservers import serve_pty, serve_tcp
from rejoint.arms import mycobot280, tcp_position
from rejoint.control.controllers.classical import IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.robots import bus as link_module
from rejoint.robots import open_robot
from rejoint.robots.family import Wire
from rejoint.robots.mycobot.bus import MyCobotBus
from rejoint.system.errors import (
    AddressError,
    ConnectionLostError,
    ImpossibleReplyError,
    NoReplyError,
    RobotError,
    StaleReplyError,
)
from rejoint_lab.emulator.firmware import Firmware

pytestmark = pytest.mark.realtime

ARM = mycobot280()
READ, SEND, TEMPERATURES, STATUS, STOP = 0x20, 0x22, 0xE5, 0xE4, 0x29
POWER_ON, IS_POWER_ON, SET_FRESH, IS_FRESH, ERROR = 0x10, 0x12, 0x16, 0x17, 0x07


def frame(command, payload):
    return bytes([0xFE, 0xFE, len(payload) + 2, command]) + payload + b"\xfa"


def healthy(_command, _nth):
    """No fault."""


class FakeArm:
    """A robot of a few lines with bytes of its own; ``fault(command, nth)`` returns what goes wrong.

    A fault is None (nothing), bytes to send instead, a number of seconds to be late, "twice", or "close".
    """

    def __init__(self, fault=healthy):
        self.fault = fault
        self.degrees = [20.0, 0.0, -85.0, -5.0, 0.0, 0.0]
        self.powered, self.fresh, self.clients = True, False, 0
        self.seen = []
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self.listener.getsockname()[1]}"
        self.open = True
        self.connection = None
        self.thread = threading.Thread(target=self.serve, daemon=True)
        self.thread.start()

    def payload(self, command, data):
        if command == SEND:
            self.degrees = [value / 100 for value in struct.unpack(">6h", data[:12])]
        self.powered |= command == POWER_ON
        self.fresh |= command == SET_FRESH
        angles = struct.pack(">6h", *(round(100 * value) for value in self.degrees))
        state = {READ: angles, IS_POWER_ON: bytes([self.powered]), IS_FRESH: bytes([self.fresh]), ERROR: b"\x01"}
        return {**state, TEMPERATURES: bytes([33] * 6), STATUS: bytes([0, 0, 4, 0, 0, 0])}.get(command, b"\x01")

    def serve(self):
        while self.open:
            with suppress(OSError):
                self.connection, _ = self.listener.accept()
                with self.connection:
                    self.converse(self.connection)

    def converse(self, connection):
        self.clients += 1
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        while data := connection.recv(1024):
            command = data[3]
            self.seen.append(command)
            answer = frame(command, self.payload(command, data[4:-1]))
            fault = self.fault(command, self.seen.count(command))
            if fault == "close":
                return
            if isinstance(fault, float):
                time.sleep(fault)
            connection.sendall(fault if isinstance(fault, bytes) else answer)
            if fault == "twice":
                connection.sendall(answer)

    def close(self):
        self.open = False
        for place in (self.connection, self.listener):
            with suppress(OSError, AttributeError):
                place.shutdown(socket.SHUT_RDWR)
        self.listener.close()
        self.thread.join()


@pytest.fixture
def awake(monkeypatch):
    """The client without the 1.5 s that its constructor sleeps; nothing else of it is touched."""
    stand_in = SimpleNamespace(sleep=lambda _: None, time=time.time)
    monkeypatch.setattr("pymycobot.mycobot280socket.time", stand_in)
    monkeypatch.setattr("pymycobot.mycobot280.time", stand_in)
    monkeypatch.setattr(link_module, "REOPEN_PAUSE", 0.01)
    monkeypatch.setattr(link_module, "TIMEOUT", 1.5)


@pytest.fixture
def start(awake):
    """Opens a robot on a fake arm with a fault; returns both."""
    opened = []

    def begin(fault=healthy, **state):
        fake = FakeArm(fault)
        vars(fake).update(state)
        opened.append(fake)
        robot = open_robot(fake.address, period=(0.02, 0.02))
        opened.append(robot)
        return robot, fake

    yield begin
    for thing in reversed(opened):
        thing.close()


def only(command, nth, fault):
    """The fault at the nth request with this command id, or at every one from the first of a range."""
    times = {nth} if isinstance(nth, int) else nth
    return lambda seen, count: fault if seen == command and count in times else None


GARBAGE = b"\x00\x01\x02\x03\x04\x05"
OTHER = frame(SEND, b"\x01")
ALWAYS = range(1, 10_000)


def test_a_good_arm(start):
    before = logging.getLogger().handlers[:]
    robot, fake = start()
    assert logging.getLogger().handlers == before, "the client's side effects are undone"
    assert fake.fresh
    assert not {SEND, POWER_ON} & set(fake.seen), "opening it moves nothing"
    state = robot.read()
    np.testing.assert_allclose(state.position, np.radians([fake.degrees]))
    np.testing.assert_array_equal(state.temperature, [[33.0] * 6])
    np.testing.assert_array_equal(state.fault, [[False, False, True, False, False, False]])
    assert state.age[0] == 0.0
    assert abs(state.time[0] - time.monotonic()) < 1.0
    assert np.isnan(robot.true_tcp()).all()
    assert (robot.count, robot.address, robot.arm.name) == (1, fake.address, "mycobot280")
    command = np.radians([[24.0, -1.239, -83.0, -4.0, 2.0, 3.0]])
    after = robot.step(command)
    np.testing.assert_allclose(np.degrees(after.position), [[24.0, -1.24, -83.0, -4.0, 2.0, 3.0]])
    assert after.time[0] > state.time[0]
    robot.stop()
    assert fake.seen[-1] == STOP
    assert 0x11 not in fake.seen  # never powered off


def test_an_arm_without_power_is_switched_on(start):
    _, fake = start(powered=False)
    assert fake.powered


@pytest.mark.parametrize(
    "fault",
    [
        b"",
        b"\xfe\xfe\x0e\x20\x07\xd0\x00",
        GARBAGE,
        "close",
        0.35,
        OTHER,
        frame(READ, b"\x01"),
    ],
    ids=["silence", "cut", "garbage", "close", "late", "other command", "too short"],
)
def test_one_bad_answer_is_recovered_from(start, fault):
    resent = fault in (b"", GARBAGE, OTHER)  # by the client itself: three times
    robot, fake = start(only(READ, range(2, 5 if resent else 3), fault))
    robot.read()
    fake.degrees[0] = 20.5
    for _ in range(3):
        state = robot.read()
        assert np.degrees(state.position[0, 0]) == pytest.approx(20.5)


def test_answers_that_nobody_asked_for_are_not_taken_for_later_ones(start):
    robot, fake = start(only(READ, range(2, 200), "twice"))
    for i in range(8):
        fake.degrees[0] = 20.0 + 0.1 * i
        time.sleep(0.005)
        assert np.degrees(robot.read().position[0, 0]) == pytest.approx(fake.degrees[0])


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (b"", NoReplyError),
        (GARBAGE, NoReplyError),
        (b"\xfe\xfe\x0e\x20\x07\xd0\x00", ImpossibleReplyError),
        (frame(READ, b"\x01"), ImpossibleReplyError),
        (0.35, StaleReplyError),
        ("close", ConnectionLostError),
        (frame(READ, struct.pack(">6h", *[18008] * 6)), ImpossibleReplyError),
        (frame(READ, struct.pack(">6h", 0, 15000, 0, 0, 0, 0)), ImpossibleReplyError),
        (frame(READ, struct.pack(">6h", 8000, 0, -8500, -500, 0, 0)), ImpossibleReplyError),
    ],
    ids=["silence", "garbage", "cut", "too short", "late", "close", "unreadable", "out of range", "jump"],
)
def test_what_stays_bad_becomes_an_error_with_a_name(start, fault, error):
    robot, _ = start(only(READ, range(3, 10_000), fault))
    robot.read()
    robot.read()
    with pytest.raises(error) as caught:
        robot.read()
    assert isinstance(caught.value, RobotError)
    assert "\n" not in str(caught.value)


def test_a_server_that_is_gone_for_good_is_named(start):
    robot, fake = start()
    robot.read()
    fake.close()
    fake.close = lambda: None
    with pytest.raises(ConnectionLostError):
        robot.read()


def test_an_arm_that_lost_its_power_is_not_switched_on_again(start):
    robot, fake = start(only(READ, 2, "close"))
    robot.read()
    fake.powered = False
    with pytest.raises(ConnectionLostError):
        robot.read()
    assert not fake.powered


def test_a_refused_command_is_an_error(start):
    robot, _ = start(only(SEND, ALWAYS, frame(SEND, b"\x00")))
    with pytest.raises(RobotError):
        robot.step(np.radians([[20.0, 0, -85, -5, 0, 0]]))


def test_firmware_without_temperatures_can_be_driven(start):
    robot, fake = start(only(TEMPERATURES, ALWAYS, b""))
    state = robot.read()
    assert state.temperature is None
    np.testing.assert_array_equal(state.fault[0], np.arange(6) == 2)  # what the firmware does answer still counts
    robot.step(state.position)
    assert fake.seen.count(TEMPERATURES) == 2 * 3  # as often as patience allows, each three times by the client


def test_something_else_behind_the_port_is_named(awake):
    fake = FakeArm(lambda *_: b"")
    try:
        with pytest.raises(AddressError):
            open_robot(fake.address)
    finally:
        fake.close()


@pytest.mark.parametrize("transport", ["tcp", "pty"])
def test_the_worn_arm_is_driven_to_a_target(transport, awake):
    """The integrator reaches what the default misses by centimetres; no answer is lost."""
    firmware = Firmware.build(ARM, "worn")
    serve = serve_tcp if transport == "tcp" else serve_pty
    with serve(firmware, timing={"state": 0.003, "acknowledgement": 0.002}) as server:
        robot = open_robot(server.address, period=(0.02, 0.03), seed=1)
        recording = run(robot, IntegratorController(ARM), np.array([[[0.2, -0.03, 0.2]]]), Schedule(dwell=3.0))
        robot.stop()
        held = robot.read()
        robot.close()
    log = recording.log(0, "driven")
    assert np.all(np.diff(log.time) > 0)
    assert held.age[0] == 0.0
    assert np.linalg.norm(tcp_position(ARM, log.position[-1]) - log.target[-1]) < 0.006
    np.testing.assert_allclose(held.position[0], log.position[-1], atol=np.radians(2))


class DeafFirst(MyCobotBus):
    """The first new connection is let in and never answered, as by a server that is not ready yet; the next one is.

    All in virtual time, at the cost of the client's own sleep.
    """

    def __init__(self):
        super().__init__(Wire(text="tcp://nowhere:9000", host="nowhere", port=9000), ARM)
        self.clock, self.opened = SimulatedClock(), 0

    def open(self):
        self.clock.wait(1.5)
        self.opened += 1

    def ask(self, method, *_arguments):
        if self.opened != 2:
            return 1
        self.clock.wait(0.9)
        raise NoReplyError(method)

    def _drain(self, quiet):
        self.clock.wait(quiet)
        return False


def test_a_new_connection_that_nobody_serves_is_given_up_for_another_one():
    bus = DeafFirst()
    link = link_module.Link(bus, "tcp://nowhere:9000")
    link.open()
    answers = iter([OSError("gone")])

    def question():
        for error in answers:
            raise error
        return bus.opened

    assert link.ask(question) == 3


def test_a_clock_that_is_set_back_does_not_keep_a_silent_line_waiting(awake, monkeypatch):
    """The client waited until the wall clock had made up for it, an hour here, and no signal ended that."""
    line, far = pty.openpty()
    bus = MyCobotBus(Wire(text="serial:", device=os.ttyname(far), baud=115200), ARM)
    bus.open()
    wall, began = time.time, time.monotonic()
    monkeypatch.setattr(time, "time", lambda: wall() - (3600.0 if time.monotonic() > began + 0.2 else 0.0))
    ended = []

    def ask():
        with pytest.raises(NoReplyError):
            bus.read()
        ended.append(True)

    asking = threading.Thread(target=ask, daemon=True)
    asking.start()
    asking.join(20.0)
    assert ended
    bus.close()
    os.close(line)
    os.close(far)


def test_two_programs_do_not_drive_one_arm_on_a_serial_line(awake):
    with serve_pty(Firmware.build(ARM, "healthy")) as server:
        robot = open_robot(server.address, period=(0.05, 0.05))
        with pytest.raises(AddressError):
            open_robot(server.address, period=(0.05, 0.05))
        assert np.isfinite(robot.step(robot.read().position).position).all()
        robot.close()
        open_robot(server.address, period=(0.05, 0.05)).close()
