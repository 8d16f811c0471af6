"""A history of a hundred arms and two years of monthly checks: how soon it is a table, a page and an answer in SQL."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.diagnosis.monitoring.measures import CheckMeasures, JointCheck
from rejoint.logs.history.index import CHECKS, find_rows
from rejoint.logs.history.rows import SUMMARY, HistoryRow, write_rows
from rejoint.logs.history.sql import ask
from rejoint.runs.history.checks import rows_of
from rejoint.runs.history.page import write_history
from rejoint.runs.history.table import arms_of

ARMS, VISITS, JOINTS = 100, 24, 6
QUERY = "select arm, max(error_mm) from history where joint = '' group by arm"


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _timed(f"writing {ARMS * VISITS} checks", lambda: _write(folder))
        _timed("a check that looks for its own", lambda: find_rows(folder, "arm-007"))
        _timed("SQL, every file for the first time", lambda: ask(folder, QUERY))
        _timed("SQL again", lambda: ask(folder, QUERY))
        arms = arms_of(_timed("all rows again", lambda: find_rows(folder))[0])
        _timed("page", lambda: write_history(folder / "history.html", arms))
        print(f"page of {(folder / 'history.html').stat().st_size / 1e3:.0f} kB")


def _timed(what: str, work: Callable[[], Any]) -> Any:
    begun, used = time.perf_counter(), time.process_time()
    result = work()
    print(f"{what}: {time.perf_counter() - begun:.2f} s, {time.process_time() - used:.2f} s of processor")
    return result


def _write(folder: Path) -> None:
    rng = np.random.default_rng(0)
    for arm in range(ARMS):
        for visit in range(VISITS):
            joints = tuple(
                JointCheck(joint=f"joint{j + 1}", hysteresis_mm=rng.uniform(1, 4), reversal_mm=0.5, deviation_mm=1.0,
                           sag_mm=None, lever_mm=200.0, temperature_c=25.0)
                for j in range(JOINTS)
            )  # fmt: skip
            measures = CheckMeasures(
                joints=joints, error_mm=rng.uniform(3, 6), repeatability_mm=0.2, approach_mm=1.0, true_error_mm=None,
                true_approach_mm=None, temperature_c=25.0,
            )  # fmt: skip
            head = HistoryRow(time=datetime(2027, 1, 1) + timedelta(days=30 * visit), kind="check",
                              arm=f"arm-{arm:03}", state="steady", line="Do: nothing.", tolerance_mm=7.0)  # fmt: skip
            write_rows(folder / CHECKS / head.arm / str(visit) / SUMMARY, rows_of(head, measures))
