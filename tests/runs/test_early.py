"""Trials that are driven while a policy is still being trained: the comparison is the same to the bit."""

import os

import pytest

from rejoint.arms import mycobot280
from rejoint.control.comparison.result import Protocol
from rejoint.control.comparison.sharing import HelperLostError
from rejoint.runs.stages import comparing
from rejoint.runs.stages.compare import comparison_job
from rejoint.system.progress import no_progress

QUICK = Protocol(dwell=1.0, hold=0.8, window=0.4)


def job(*controllers, repetitions=1):
    return comparison_job(
        "emulated:worn", controllers, None, run=None, arm=mycobot280(), seed=0, sets=1, repetitions=repetitions,
        protocol=QUICK,
    )  # fmt: skip


@pytest.fixture
def ahead(monkeypatch):
    """What has begun with `default` before the others are known."""
    monkeypatch.setattr(comparing, "LEAST", 1)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    found = job("default").begin_ahead()
    yield found
    found.close()


@pytest.mark.parametrize("done", [True, False])
def test_what_is_driven_ahead_is_taken_over(ahead, done, monkeypatch):
    if done:
        ahead._worker.join()
        assert set(ahead._done) == {("default", "crossing"), ("default", "hold")}
    found = job("default", "integrator").drive(no_progress, ahead)
    assert not ahead._done  # all of it was asked for
    monkeypatch.setattr(comparing, "LEAST", 10**6)
    alone = job("default", "integrator").drive(no_progress)
    assert found.comparison == alone.comparison
    assert set(found.logs) == set(alone.logs)


def test_who_was_not_known_and_other_trials_are_not_driven_ahead(ahead):
    ahead._worker.join()
    places = ahead._places
    assert (ahead.rank(("policy", "hold")), ahead.rank(("default", "hold"))) == (0, 2)
    with pytest.raises(HelperLostError):
        ahead.drive(("policy", "hold"), places)
    with pytest.raises(HelperLostError):
        ahead.drive(("default", "hold"), (*places, (1, 0)))
    assert ahead.drive(("default", "hold"), places)[0].controller == "default"


def test_a_small_comparison_begins_nothing_ahead(monkeypatch):
    monkeypatch.setattr(comparing, "LEAST", 10**6)
    assert job("default").begin_ahead() is None
