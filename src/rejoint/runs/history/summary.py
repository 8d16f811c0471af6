"""The summary rows of a run, from the files that its stages left."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rejoint.control.comparison.recommend import recommend
from rejoint.logs.history.identity import name_of, setup_of
from rejoint.logs.history.rows import SUMMARY, HistoryRow, read_rows, utc_now, write_rows
from rejoint.runs.run import Run, is_finished
from rejoint.system.errors import FileError

if TYPE_CHECKING:
    from rejoint.control.comparison.result import Comparison
    from rejoint.diagnosis.diagnosis import Diagnosis


def summarise(run: Run) -> None:
    """Write ``summary.parquet`` into a run folder: what its diagnosis and its comparison found; FileError if it cannot.

    A later stage writes it anew. A finished repair keeps the time at which it was finished: a later comparison in its
    folder begins no new norm. Nothing is written before either of them has been run.
    """
    diagnosis, comparison = run.diagnosis, run.comparison
    if diagnosis is None and comparison is None:
        return
    kind = "repair" if is_finished(run.folder) else "run"
    head = HistoryRow(
        time=_repaired_at(run.path / SUMMARY, kind) or utc_now(), kind=kind, arm=name_of(run.robot, run.arm.name),
        robot=run.robot, model=run.arm.name, setup=setup_of(run.arm),
    )  # fmt: skip
    arm = head
    joints: list[HistoryRow] = []
    if diagnosis is not None:
        arm, joints = _diagnosed(head, diagnosis)
    if comparison is not None:
        arm = _compared(arm, comparison)
    write_rows(run.path / SUMMARY, [arm, *joints])


def _repaired_at(path: Path, kind: str) -> datetime | None:
    """Return the time of the rows of a finished repair that are there already."""
    if kind != "repair":
        return None
    with suppress(FileError, FileNotFoundError):
        return next((row.time for row in read_rows(path) if row.kind == kind), None)
    return None


def _diagnosed(head: HistoryRow, found: Diagnosis) -> tuple[HistoryRow, list[HistoryRow]]:
    loop = found.open_loop
    true = None if loop is None or loop.true_error_mm is None else loop.true_error_mm.value
    arm = replace(
        head, state=found.condition, line=found.verdict, true_error_mm=true,
        error_mm=None if loop is None else loop.error_mm.value,
    )  # fmt: skip
    joints = []
    for row in found.measurement.joints:
        values: dict[str, Any] = {
            name: None if (one := getattr(row, name)) is None else one.value
            for name in ("stiffness_nm_per_rad", "coulomb_nm", "lag_s", "offset_rad")
        }
        joints.append(replace(head, joint=row.joint, **values))
    return arm, joints


def _compared(arm: HistoryRow, found: Comparison) -> HistoryRow:
    chosen = recommend(found).controller
    row = found.row(chosen)
    return replace(
        arm, controller=chosen, success=row.crossing.success.value,
        settled_mm=None if row.hold.settled is None else 1e3 * row.hold.settled.mean.value,
        settled_true_mm=None if row.hold.settled_true is None else 1e3 * row.hold.settled_true.mean.value,
    )  # fmt: skip
