"""What every family with a bus gets from the shared parts, in simulated time, on a bus of a few lines."""

import os
import signal
import struct
import time

import numpy as np
import pytest
from plainbus import PlainBus

from rejoint.arms import mycobot280
from rejoint.control.robot import Robot
from rejoint.robots import BusRobot, Clock, Reading, Vitals
from rejoint.robots.bus import ATTEMPTS, TIMEOUT
from rejoint.system import stopping
from rejoint.system.errors import (
    AddressError,
    ConnectionLostError,
    ImpossibleReplyError,
    NoReplyError,
    PowerLostError,
    RobotError,
)

ARM = mycobot280()
REST = ARM.rest[None]


def opened(*faults, **extra):
    """A robot whose bus was opened, which moves nothing, and which meets ``faults`` from now on."""
    bus = PlainBus(**extra)
    robot = BusRobot(bus, ARM, address="plain:1", period=(0.02, 0.03), seed=2)
    robot.open()
    assert bus.done == ["close", "open", "prepare"]
    bus.done, bus.faults = [], list(faults)
    return robot, bus


def test_it_is_a_robot_and_opening_it_moves_nothing():
    robot, _ = opened(load=np.full(6, 0.5), voltage=np.full(6, 7.4), temperature=np.full(6, 30.0))
    assert isinstance(robot, Robot)
    state = robot.read()
    assert state.fault is None
    for value, number in ((state.load, 0.5), (state.voltage, 7.4), (state.temperature, 30.0)):
        np.testing.assert_array_equal(value, np.full((1, 6), number))
    assert np.isnan(robot.true_tcp()).all()


def test_every_answer_comes_one_period_after_the_last_one():
    robot, _ = opened()
    times = [robot.read().time[0]] + [robot.step(REST).time[0] for _ in range(50)]
    periods, drawn = np.diff(times), np.random.default_rng(2).uniform(0.02, 0.03, 50)
    np.testing.assert_allclose(periods, drawn, atol=1e-9)


@pytest.mark.parametrize("fault", [TimeoutError("late"), ValueError("cut"), struct.error("cut"), IndexError("cut")])
def test_a_lost_or_garbled_answer_is_asked_for_again_once_both_sides_are_in_step(fault):
    robot, bus = opened(fault)
    np.testing.assert_array_equal(robot.read().position[0], ARM.rest)
    assert bus.done == ["read", "resynchronise", "read"]


@pytest.mark.parametrize("fault", [TimeoutError("silent again"), ValueError("cut"), ConnectionLostError("silent")])
def test_a_wire_that_fails_again_while_it_is_brought_into_step_is_connected_anew(fault):
    robot, bus = opened(TimeoutError("late"), fault)
    np.testing.assert_array_equal(robot.read().position[0], ARM.rest)
    assert bus.done == ["read", "resynchronise", "close", "open", "prepare", "read"]


def test_a_broken_connection_is_made_anew():
    robot, bus = opened(OSError("gone"), OSError("still gone"))
    robot.step(REST)
    assert bus.done[:7] == ["read", "close", "open", "close", "open", "prepare", "read"]


@pytest.mark.parametrize(
    ("fault", "error"),
    [(TimeoutError, NoReplyError), (ValueError, ImpossibleReplyError), (OSError, ConnectionLostError)],
)
def test_what_stays_bad_is_an_error_with_a_name_after_bounded_patience(fault, error):
    robot, bus = opened(*[fault("bad"), *([] if fault is OSError else [None])] * 1000)
    began = bus.clock.now()
    with pytest.raises(error, match="plain:1"):
        robot.read()
    assert bus.done.count("read") <= ATTEMPTS
    assert bus.clock.now() - began <= TIMEOUT


def test_an_arm_that_lost_its_power_is_not_waited_for():
    robot, _ = opened(OSError("gone"), None, PowerLostError("no power"))
    with pytest.raises(PowerLostError):
        robot.read()


@pytest.mark.parametrize(
    ("waited", "moved", "told"),
    [(60.0, 0.0, False), (60.0, 0.3, True), (60.0, -0.05, False), (60.0, -0.2, True), (0.1, 0.05, False)],
)
def test_an_arm_that_stands_elsewhere_after_a_pause_is_told_until_its_next_command(waited, moved, told):
    robot, bus = opened()
    goal = REST + 0.1
    robot.step(REST)
    robot.step(goal)
    assert not robot.read().elsewhere
    bus.clock.wait(waited)
    bus.position = goal[0] + moved
    assert robot.read().elsewhere == told
    assert robot.read().elsewhere == told
    robot.step(bus.position[None])
    assert not robot.read().elsewhere


@pytest.mark.parametrize(("gone", "sent"), [(0.2, True), (2.0, False)])
def test_a_command_that_was_kept_up_by_a_new_connection_is_not_sent_to_an_arm_that_was_moved(gone, sent):
    robot, bus = opened()
    robot.step(REST)

    def open_anew():
        bus.tell("open")
        bus.clock.wait(gone)
        bus.position = ARM.rest + 0.2

    bus.open, bus.faults = open_anew, [OSError("gone")]
    state = robot.step(REST)
    assert bus.done.count("send") == 1 + 1 + sent
    assert state.elsewhere != sent
    assert np.allclose(state.position, ARM.rest) == sent


def test_an_arm_that_refuses_is_not_asked_again():
    robot, bus = opened(None, RobotError("refused"))
    robot.read()
    with pytest.raises(RobotError):
        robot.step(REST)
    assert bus.done == ["read", "send"]


@pytest.mark.parametrize(
    ("position", "says"),
    [
        (np.where(np.arange(6) == 2, np.nan, ARM.rest), "the servos of joint3 cannot be read"),
        (np.full(6, 7.0), "joint1 reads 401.1 deg, outside the arm's range of -168 to 168 deg"),
        (np.zeros(5), "expected 6 "),
    ],
)
def test_positions_that_no_such_arm_has_are_asked_for_again_and_then_named(position, says):
    robot, bus = opened(Reading(position=position))
    robot.read()
    bus.faults = [Reading(position=position), None] * ATTEMPTS
    with pytest.raises(ImpossibleReplyError, match=says):
        robot.read()


@pytest.mark.parametrize("name", ["load", "temperature", "voltage", "fault"])
def test_an_answer_of_another_number_of_servos_is_named(name):
    robot, _ = opened(*[Reading(position=ARM.rest, **{name: np.zeros(5)})] * ATTEMPTS * 2)
    with pytest.raises(ImpossibleReplyError):
        robot.read()


def test_a_wrong_byte_is_no_alarm_and_an_alarm_that_stays_is_one():
    robot, bus = opened(Reading(position=ARM.rest, fault=["", "overload", *[""] * 4]), fault=np.zeros(6, bool))
    assert not robot.read().fault.any()
    bus.extra = {"fault": np.arange(6) == 1}
    np.testing.assert_array_equal(robot.read().fault, [np.arange(6) == 1])


def test_questions_about_health_take_turns_where_the_period_leaves_time():
    class AskedBus(PlainBus):
        def vitals(self):
            return self.warmth, self.faulty

        def warmth(self):
            self.tell("warmth")
            return Vitals(temperature=np.full(6, 41.0))

        def faulty(self):
            self.tell("faulty")
            return Vitals(fault=np.zeros(6, bool))

    bus = AskedBus()
    robot = BusRobot(bus, ARM, address="plain:1", period=(0.03, 0.03))
    robot.open()
    state = robot.read()
    assert (state.temperature == 41.0).all()
    assert not state.fault.any()
    bus.done = []
    times = [robot.step(REST).time[0] for _ in range(4)]
    assert bus.done == ["send", "warmth", "read", "send", "faulty", "read"] * 2
    np.testing.assert_allclose(np.diff(times), 0.03)
    hurried = BusRobot(bus, ARM, address="plain:1", period=(0.009, 0.009))
    hurried.open()
    hurried.read()
    bus.done = []
    for _ in range(4):
        hurried.step(REST)
    assert set(bus.done) == {"send", "read"}


def test_where_nothing_answers_or_something_else_does_the_error_is_one_line():
    bus = PlainBus(faults=[FileNotFoundError("no such port\nat all")])
    with pytest.raises(AddressError, match="nothing answers at plain:1") as caught:
        BusRobot(bus, ARM, address="plain:1").open()
    assert "\n" not in str(caught.value)
    bus = PlainBus(faults=[None, TimeoutError()])
    with pytest.raises(AddressError, match="something listens at plain:1, but no Plain answers"):
        BusRobot(bus, ARM, address="plain:1").open()
    assert bus.done[-1] == "close"


def test_a_wish_to_end_is_heard_between_two_attempts_and_the_arm_is_still_stopped():
    robot, bus = opened(*[TimeoutError(), None] * ATTEMPTS)
    with stopping.noted():
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(stopping.Interrupted):
            robot.read()
    assert bus.done == ["read"]
    bus.done, bus.faults = [], [TimeoutError()]
    robot.stop()
    assert bus.done == ["stop", "resynchronise", "stop"]


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="this system has no clock that tells its sleep")
def test_the_clock_goes_on_while_the_computer_sleeps(monkeypatch):
    before = Clock().now()
    monkeypatch.setattr(time, "clock_gettime", lambda which: before + 60.0 * (which == time.CLOCK_BOOTTIME))
    assert Clock().now() == before + 60.0
