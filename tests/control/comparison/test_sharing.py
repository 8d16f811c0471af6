"""Trials shared with a helper: everything is driven once, and by this process where the helper is lost."""

import threading

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.catalogue import make_controller
from rejoint.control.comparison.compare import Settings, TrialRunner
from rejoint.control.comparison.ledger import HelperLostError, Shared
from rejoint.control.comparison.result import Protocol
from rejoint.robots import open_robot

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
        self.runner = TrialRunner(connect, FACTORIES, TARGETS, BATCHED)

    def settle(self):
        return ()

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
    found = TrialRunner(
        connect,
        FACTORIES,
        TARGETS,
        BATCHED,
        helper=helper,
        on_trial=trials.append,
        on_progress=lambda share, _: shares.append(share),
    ).compare()
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

    def __init__(self, fails=False, begun=()):
        self.go, self.asked, self.fails, self.begun = threading.Event(), threading.Event(), fails, begun

    def settle(self):
        return self.begun

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


def test_what_a_helper_has_begun_is_left_to_it():
    helper = Slow(begun=(("a", "hold"),))
    shared = Shared([("a", "hold"), ("b", "hold"), ("c", "hold")], helper, ())
    assert helper.asked.wait(10)
    tasks = shared.here()
    assert [next(tasks), next(tasks)] == [("b", "hold"), ("c", "hold")]
    helper.go.set()
    assert not list(tasks)
    assert list(shared.arrived()) == [(("a", "hold"), "done beside")]
