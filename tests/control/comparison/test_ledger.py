"""An interrupted comparison goes on after the trials that are done, and finds what it would have found."""

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest

from rejoint.arms import mycobot280
from rejoint.control.comparison.compare import Ledger, Settings, TrialRunner
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.catalogue import BASELINES
from rejoint.control.guard import Reason
from rejoint.control.loop import run as drive
from rejoint.robots import open_robot
from rejoint.system.errors import FileError, NoReplyError

ARM = mycobot280()
TARGETS = ARM.targets.sample(np.random.default_rng(3), (2, 2))
QUICK = Protocol(dwell=1.5, hold=1.2, window=0.4)
NAMES = ("default", "integrator")
FACTORIES = {name: BASELINES[name] for name in NAMES}
BATCHED = Settings(repetitions=2, seed=1, batched=True, protocol=QUICK)
ALONE = replace(BATCHED, batched=False)


def connect(count, seed):
    return open_robot("emulated:worn", count=count, seed=seed)


def stop_after(number):
    """Raise after as many trials."""
    seen = []

    def count(*_):
        seen.append(1)
        if len(seen) > number:
            raise NoReplyError("gone")

    return count


def test_a_comparison_that_was_interrupted_finds_what_it_would_have_found(tmp_path):
    whole = TrialRunner(connect, FACTORIES, TARGETS, BATCHED).compare()
    path = tmp_path / "trials"
    with pytest.raises(NoReplyError):
        TrialRunner(connect, FACTORIES, TARGETS, BATCHED, ledger=Ledger(path, "one"), on_trial=stop_after(2)).compare()
    ledger = Ledger(path, "one")
    assert len(ledger.done) == 2  # of four batches of four trials, the third was cut
    driven = []
    again = TrialRunner(connect, FACTORIES, TARGETS, BATCHED, ledger=ledger, on_trial=lambda *one: driven.append(one))
    assert again.compare() == whole
    assert [one.key[:2] for one, _ in driven] == [("integrator", "crossing"), ("integrator", "hold")]


def test_damaged_trials_are_not_gone_on_from_and_those_of_another_comparison_are_set_aside(tmp_path):
    path = tmp_path / "trials"
    TrialRunner(connect, FACTORIES, TARGETS, BATCHED, ledger=Ledger(path, "one")).compare()
    whole = path.read_bytes()
    data = bytearray(whole)
    data[data.index(b"0.") + 3] ^= 1
    path.write_bytes(data)
    with pytest.raises(FileError, match="delete"):
        Ledger(path, "one")
    path.write_bytes(whole)
    assert Ledger(path, "other").done == {}
    assert [file.read_bytes() for file in tmp_path.iterdir()] == [whole]


def test_a_trial_with_a_long_gap_is_driven_again(monkeypatch):
    """At most twice; then it counts, and the guard's column says so."""
    paused, trials = [], []

    def pausing(robot, controller, targets, schedule, **options):
        recording = drive(robot, controller, targets, schedule, **options)
        if len(paused) == 4:
            return recording
        paused.append(1)
        time, reasons = recording.time.copy(), recording.reasons.copy()
        time[5:] += 2.5
        reasons[5] |= np.uint16(Reason.GAP.value)
        return replace(recording, time=time, reasons=reasons)

    monkeypatch.setattr(import_module("rejoint.control.comparison.compare"), "run", pausing)
    one = replace(ALONE, repetitions=1)
    alone = {"integrator": BASELINES["integrator"]}
    keep = {"on_trial": lambda driven, _: trials.append(driven.key.kind)}
    result = TrialRunner(connect, alone, TARGETS[:1], one, **keep).compare()
    assert trials == ["crossing"] * 3 + ["hold"] * 2
    assert result.rows[0].guard["gap"] > 0.0
