"""The second process of a comparison: it drives the same to the bit, and ends with whoever started it."""

import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

import rejoint
from rejoint.arms import mycobot280
from rejoint.control.comparison.compare import Settings
from rejoint.control.comparison.result import Key, Protocol
from rejoint.runs.stages import compare as comparing
from rejoint.runs.stages.compare import ComparisonJob, HelperProcess
from waiting import until

ARM = mycobot280()
QUICK = Protocol(dwell=1.0, hold=0.8, window=0.4)
JOB = ComparisonJob(
    robot="emulated:worn",
    arm=ARM,
    targets=ARM.targets.sample(np.random.default_rng(3), (1, 2)),
    settings=Settings(repetitions=2, seed=1, batched=True, protocol=QUICK),
)
PLACES = ((0, 0), (0, 1))


@pytest.fixture
def helper():
    found = HelperProcess(JOB)
    yield found
    found.close()


def test_it_drives_the_same_to_the_bit(helper):
    for key in (Key("integrator", "hold", PLACES), Key("shelf", "crossing", PLACES)):
        driven, recording = helper(key).result()
        own, seen = JOB.runner_of(key.controller).drive_batch(key)
        assert (driven.key, driven.cycles, driven.reasons) == (own.key, own.cycles, own.reasons)
        first = seen.of(slice(1))  # no other log is kept, and the rest is not sent
        assert first.position.shape[1] == 1 < seen.position.shape[1]
        for field in fields(seen):
            np.testing.assert_array_equal(getattr(recording, field.name), getattr(first, field.name))


@pytest.mark.parametrize("lost", ["a task fails", "it is gone", "it cannot be started"])
def test_what_it_does_not_drive_fails(lost, monkeypatch):
    if lost == "it cannot be started":
        monkeypatch.setattr(sys, "executable", "/no/such/python")
    helper = HelperProcess(JOB)
    if lost == "it is gone":
        helper._process.kill()
    future = helper(Key("nobody" if lost == "a task fails" else "default", "hold", PLACES))
    assert future.exception(60) is not None
    helper.close()


@pytest.fixture
def started(monkeypatch):
    """Make every comparison large enough for a helper, and keep the helpers that are started."""
    found = []

    class Kept(HelperProcess):
        def __init__(self, job):
            super().__init__(job)
            found.append(self)

    monkeypatch.setattr(comparing, "HelperProcess", Kept)
    monkeypatch.setattr(comparing, "LEAST", 1)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    return found


def compared(*controllers):
    return rejoint.compare("emulated:worn", controllers, plan=rejoint.TrialPlan(sets=1, repetitions=1, protocol=QUICK))


@pytest.mark.parametrize("lost", [False, True])
def test_a_comparison_with_a_helper_finds_what_it_finds_without(started, monkeypatch, lost):
    if lost:
        monkeypatch.setattr(sys, "executable", "/no/such/python")
    found = compared("default", "integrator")
    (helper,) = started
    assert lost or helper._process.poll() is not None  # it has ended with the comparison
    monkeypatch.setattr(comparing, "LEAST", 10**6)
    alone = compared("default", "integrator")
    assert len(started) == 1
    assert found.comparison == alone.comparison
    assert len(found.logs) == 4
    assert set(found.logs) == set(alone.logs)
    for label, log in found.logs.items():
        np.testing.assert_array_equal(log.position, alone.logs[label].position)


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_it_ends_with_the_process_that_started_it_however_that_ends():
    lines = (
        "import sys; sys.path[:0] = sys.argv[1:]",
        "from test_helper import JOB, PLACES, HelperProcess, Key",
        "helper = HelperProcess(JOB)",
        "helper(Key('default', 'hold', PLACES)).result()",
        "print(helper._process.pid, flush=True)",
        "sys.stdin.read()",
    )
    here = str(Path(__file__).parent)
    words = [sys.executable, "-c", "\n".join(lines), here, *sys.path]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        helper = int(process.stdout.readline())
        os.kill(helper, 0)  # it is there
        process.kill()
    until(lambda: not alive(helper))


def alive(pid):
    """Whether there is such a process, and no remains of one that nobody has asked about."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    state = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False).stdout
    return bool(state.strip()) and not state.startswith("Z")
