"""Trials shared with a helper: everything is driven once, and by this process where the helper is lost."""

import threading

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.catalogue import make_controller
from rejoint.control.comparison.compare import Settings, TrialRunner, compare
from rejoint.control.comparison.counting import Targets
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.result import Protocol
from rejoint.control.comparison.sharing import HelperLostError, Shared
from rejoint.robots import open_robot
from rejoint.system.progress import no_progress

ARM = mycobot280()
TARGETS = ARM.targets.sample(np.random.default_rng(3), (1, 2))
BATCHED = Settings(repetitions=2, seed=1, batched=True, protocol=Protocol(dwell=1.0, hold=0.8, window=0.4))
FACTORIES = {name: (lambda arm, name=name: make_controller(name, arm)) for name in ("default", "integrator")}


def connect(count, seed):
    return open_robot("emulated:worn", count=count, seed=seed)


class Beside:
    """A helper that is no other process, and is lost after as many tasks."""

    def __init__(self, lasts=99):
        self.lasts, self.asked, self.begun = lasts, [], threading.Event()
        shape = (*TARGETS.shape[:1], 2, TARGETS.shape[1])
        self.runner = TrialRunner(
            open_robot=connect, controllers=FACTORIES, targets=TARGETS, settings=BATCHED, shape=shape, tallies={},
            ledger=Ledger.nowhere(), limits=None, stance=None, correction=None, model=None,
            progress=Targets(no_progress, 1), on_trial=None, measured=(), source="",
        )  # fmt: skip

    def rank(self, _task):
        return 0

    def drive(self, task, places):
        self.asked.append(task)
        self.begun.set()
        if len(self.asked) > self.lasts:
            raise HelperLostError
        return self.runner.drive_batch(self.runner.open_batch(places), *task, places)

    def close(self):
        pass


def compared(helper=None):
    trials, shares = [], []
    found = compare(
        connect, FACTORIES, TARGETS, BATCHED, helper=helper, on_trial=trials.append,
        on_progress=lambda share, _: shares.append(share),
    )  # fmt: skip
    return found, sorted(trial.label for trial in trials), shares


@pytest.mark.parametrize("lasts", [99, 1, 0])
def test_what_comes_out_is_the_same_with_a_helper_and_without(lasts):
    alone, labels, _ = compared()
    helper = Beside(lasts)
    found, seen, shares = compared(helper)
    assert helper.asked[0] == ("integrator", "hold")  # the last one
    assert len(helper.asked) <= lasts + 1
    assert found == alone
    assert seen == labels
    assert shares[-1] == 1.0


class Slow:
    """A helper that does a task only when it is told to."""

    def __init__(self, fails=False, near=None):
        self.near = near or {}
        self.go, self.asked, self.fails = threading.Event(), threading.Event(), fails

    def rank(self, task):
        return self.near.get(task[0], 0)

    def drive(self, task, _places):
        self.asked.set()
        assert self.go.wait(10)
        if self.fails:
            raise HelperLostError
        return task, "done beside"


@pytest.mark.parametrize("fails", [False, True])
def test_the_last_task_is_waited_for_and_done_here_where_the_helper_is_lost(fails):
    helper = Slow(fails)
    shared = Shared([("a", "hold"), ("b", "hold"), ("c", "hold")], helper, ())
    assert helper.asked.wait(10)
    tasks = shared.here()
    assert [next(tasks), next(tasks)] == [("a", "hold"), ("b", "hold")]
    threading.Timer(0.1, helper.go.set).start()
    rest, beside = list(tasks), list(shared.arrived())
    assert (rest, beside) == (([("c", "hold")], []) if fails else ([], [(("c", "hold"), "done beside")]))


def test_one_task_is_not_worth_a_helper():
    helper = Slow()
    assert list(Shared([("a", "hold")], helper, ()).here()) == [("a", "hold")]
    assert not helper.asked.is_set()


def test_a_helper_takes_what_is_nearest_to_it_first():
    helper = Slow(near={"a": 2, "b": 1})
    shared = Shared([("a", "hold"), ("b", "hold"), ("c", "hold")], helper, ())
    assert helper.asked.wait(10)
    tasks = shared.here()
    assert [next(tasks), next(tasks)] == [("c", "hold"), ("b", "hold")]
    helper.go.set()
    assert (list(tasks), list(shared.arrived())) == ([], [(("a", "hold"), "done beside")])
