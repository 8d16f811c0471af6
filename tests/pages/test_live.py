"""The live view without a browser: nothing is lost, torn or changed, and what is drawn and said is so."""

from types import SimpleNamespace

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control import robot as wallclock
from rejoint.control.controllers.classical import DefaultController, IntegratorController
from rejoint.control.loop import Schedule, run
from rejoint.pages.live.view import LiveView, SeenCycle
from rejoint.robots import open_robot
from standin import state_of

ARM = mycobot280()
N = ARM.joints


def column(records, name):
    return np.array([getattr(one, name) for one in records])


def test_looking_on_changes_nothing_and_sees_what_is_recorded():
    targets = ARM.targets.sample(np.random.default_rng(0), (1, 2))

    def drive(robot):
        return run(robot, DefaultController(ARM), targets, Schedule(dwell=0.4))

    view = LiveView()
    robot = view.watch(open_robot("emulated:worn", seed=4), paced=False)
    alone, watched = drive(open_robot("emulated:worn", seed=4)), drive(robot)
    records = [SeenCycle.of(*one) for one in view.shown.cycles]
    assert len(alone.time) == len(records)
    for name in ("time", "position", "command", "target", "aim", "true_tcp", "load", "reasons"):
        expected = getattr(alone, name)
        assert np.array_equal(getattr(watched, name), expected, equal_nan=True)
        assert np.array_equal(column([one.cycle for one in records], name), expected[:, 0], equal_nan=True)
    assert np.isfinite(column(records, "temperature")).all()
    limited, command = (column([one.cycle for one in records], name) for name in ("reasons", "command"))
    wanted = column(records, "wanted")
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
    for pace[0], steps, end in ((1.0, 5, 4.0), (10.0, 5, 4.5), (np.inf, 1, 4.5)):
        for _ in range(steps):
            robot.step(np.zeros((2, N)))
        assert wall[0] == pytest.approx(end)


def test_a_view_that_fails_or_was_never_opened_does_not_end_what_is_driven():
    view = LiveView()
    view._page = SimpleNamespace(watched=True, draw=lambda *_: 1 / 0)
    robot = view.watch(open_robot("emulated:worn", seed=4), paced=False)
    view._thread.start()
    done = run(
        robot, IntegratorController(ARM), ARM.targets.sample(np.random.default_rng(0), (1, 1)), Schedule(dwell=0.3)
    )
    view._over.set()
    view._thread.join()
    assert len(done.time) > 10
    assert view.failure == "ZeroDivisionError: division by zero"
