"""The live view without a browser: nothing is lost, torn or changed, and what is drawn and said is so."""

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rejoint.arms import mycobot280
from rejoint.control.controllers.classical import DefaultController, IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import Cycle
from rejoint.pages.live.animation import Ring
from rejoint.pages.live.view import LiveView
from rejoint.robots import open_robot
from rejoint.robots import wrapper as wallclock
from standin import state_of

ARM = mycobot280()
N = ARM.joints


def write(ring, number, *, time=None, reasons=0, position=None, wanted=None, command=None, **given):
    """Write a record every number of which is ``number``, unless given."""
    each, point = np.full((1, N), float(number)), np.full((1, 3), float(number))
    position, wanted, command = (each if one is None else one[None] for one in (position, wanted, command))
    cycle = Cycle(
        time=np.array([number if time is None else time], dtype=float),
        position=position,
        command=command,
        target=given.get("target", point),
        aim=point,
        target_index=np.array([number]),
        since_target=np.zeros(1),
        true_tcp=given.get("true_tcp", point),
        active=np.array([True]),
        reasons=np.array([reasons], dtype=np.uint16),
        load=each,
        turned=np.full(1, np.nan),
    )
    state = state_of(position, cycle.time, temperature=given.get("temperature"), load=each)
    ring.write(0, cycle, state, wanted)


def column(records, name):
    return np.array([getattr(one, name) for one in records])


@given(slots=st.integers(1, 9), writes=st.lists(st.integers(0, 12), max_size=12))
def test_a_reader_gets_the_newest_records_once_and_in_order(slots, writes):
    ring, read, written, seen = Ring(slots), 0, 0, []
    for burst in writes:
        for number in range(written, written + burst):
            write(ring, number)
        written += burst
        records, read = ring.since(read)
        assert len(records) == min(burst, slots)  # what did not fit is lost, the oldest first
        numbers = [one.target_index for one in records]
        assert numbers == list(range(written - len(records), written))
        seen += numbers
    assert seen == sorted(set(seen))


def test_records_that_are_read_while_others_are_written_are_whole():
    ring, last = Ring(7), 30_000

    def writer():
        for number in range(last):
            write(ring, number)

    thread, read, seen = threading.Thread(target=writer), 0, []
    thread.start()
    alive = True
    while alive:  # once more after its end
        alive = thread.is_alive()
        records, read = ring.since(read)
        for one in records:
            assert (one.position == one.target_index).all()
            assert (one.true_tcp == one.target_index).all()
        seen += [one.target_index for one in records]
    thread.join()
    assert seen == sorted(set(seen))
    assert seen[-1] == last - 1


def test_looking_on_changes_nothing_and_sees_what_is_recorded():
    targets = ARM.targets.sample(np.random.default_rng(0), (1, 2))

    def drive(robot):
        return run(robot, DefaultController(ARM), targets, Schedule(dwell=0.4))

    view = LiveView()
    robot = view.watch(open_robot("emulated:worn", seed=4), paced=False)
    alone, watched = drive(open_robot("emulated:worn", seed=4)), drive(robot)
    records, count = view._subject.ring.since(0)
    assert count == len(alone.time) == len(records)
    for name in ("time", "position", "command", "target", "aim", "true_tcp", "load", "reasons"):
        expected = getattr(alone, name)
        assert np.array_equal(getattr(watched, name), expected, equal_nan=True)
        assert np.array_equal(column(records, name), expected[:, 0], equal_nan=True)
    assert np.isfinite(column(records, "temperature")).all()
    limited, wanted, command = (column(records, name) for name in ("reasons", "wanted", "command"))
    limited = limited > 0
    assert limited.any()
    assert np.array_equal(wanted[~limited][:-1], command[~limited][:-1])  # the last is not sent
    assert (wanted[limited] != command[limited]).any(axis=1).all()


class Passing:
    arm, address, count = None, "passing", 2
    """A robot of virtual time, a second a step, that takes no time of the wall."""

    def step(self, command, active=None):  # noqa: ARG002 - as robots are
        self.now = getattr(self, "now", 100.0) + 1.0
        return state_of(command, np.array([self.now, 0.0]))


def test_virtual_time_is_slowed_down_to_the_pace_which_may_change(monkeypatch):
    wall = [0.0]
    monkeypatch.setattr(wallclock.time, "monotonic", lambda: wall[0])
    monkeypatch.setattr(wallclock, "pause", lambda duration: wall.__setitem__(0, wall[0] + max(duration, 0.0)))
    pace = [1.0]
    robot = wallclock.WallClock(Passing(), lambda: pace[0])
    robot.step(np.zeros((2, N)))
    for _ in range(4):
        robot.step(np.zeros((2, N)))
    assert wall[0] == pytest.approx(4.0)
    pace[0] = 10.0
    for _ in range(5):
        robot.step(np.zeros((2, N)))
    assert wall[0] == pytest.approx(4.5)
    pace[0] = np.inf
    robot.step(np.zeros((2, N)))
    assert wall[0] == pytest.approx(4.5)


def test_a_view_that_fails_or_was_never_opened_does_not_end_what_is_driven(monkeypatch):
    view = LiveView()
    view._page = SimpleNamespace(watched=True, show=lambda *_, **__: 1 / 0)
    robot = view.watch(open_robot("emulated:worn", seed=4), paced=False)
    view._thread.start()
    done = run(
        robot, IntegratorController(ARM), ARM.targets.sample(np.random.default_rng(0), (1, 1)), Schedule(dwell=0.3)
    )
    view._thread.join()
    assert len(done.time) > 10
    assert view.failure == "ZeroDivisionError: division by zero"
