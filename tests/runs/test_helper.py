"""The second thread of a comparison: it drives the same to the bit."""

import os

import numpy as np

import rejoint
from rejoint.control.comparison.result import Protocol

QUICK = Protocol(dwell=1.0, hold=0.8, window=0.4)


def compared(*controllers):
    return rejoint.compare("emulated:worn", controllers, plan=rejoint.TrialPlan(sets=1, repetitions=1, protocol=QUICK))


def test_a_comparison_with_a_helper_finds_what_it_finds_without(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    found = compared("default", "integrator")
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    alone = compared("default", "integrator")
    assert found.comparison == alone.comparison
    assert len(found.logs) == 4
    assert set(found.logs) == set(alone.logs)
    for label, log in found.logs.items():
        np.testing.assert_array_equal(log.position, alone.logs[label].position)
