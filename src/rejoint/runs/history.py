"""The history: rows of checks and runs, table, page, Prometheus metrics."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import msgspec

from rejoint.control.comparison.recommend import recommend
from rejoint.diagnosis.monitoring.judge import Outlook, PastCheck
from rejoint.diagnosis.monitoring.measures import CheckMeasures
from rejoint.logs.history import SUMMARY, HistoryRow, name_of, read_rows, setup_of, utc_now, write_rows
from rejoint.logs.runfolder import RUNS
from rejoint.pages.html import write_page
from rejoint.runs.run import Run
from rejoint.system.errors import FileError
from rejoint.system.shell import command


def owners(rows: Sequence[HistoryRow]) -> Callable[[HistoryRow], str]:
    """Return the arm of each row; of a repair without a name, the only one checked at its address until then."""
    checked = sorted({(row.time, name_of(row.robot, row.model), row.arm) for row in rows if row.kind == "check"})

    def owner(row: HistoryRow) -> str:
        there = [] if row.kind == "check" else [one for one in checked if one[1] == row.arm]
        names = {arm for time, _, arm in there if time <= row.time} or {arm for *_, arm in there[:1]}
        return names.pop() if len(names) == 1 else row.arm

    return owner


MOVED, SET_UP = "moved", "set up"
"""Reasons of a new baseline: a move, or another description"""


class Past(NamedTuple):
    """History of an arm since its baseline began."""

    visits: tuple[PastCheck, ...] = ()
    """the oldest first"""
    setup: str = ""
    """fingerprint of its description, or empty"""
    left_mm: float | None = None
    """tool error with the controller of its last repair, if any"""


def counted(history: Path, arm: str) -> tuple[object, ...]:
    """Options of a repair that counts in a ``history``."""
    return () if history == Path(RUNS) else ("--run", history / f"{arm}-{utc_now():%Y%m%dT%H%M}")


def rows_of(head: HistoryRow, measures: CheckMeasures, found: Outlook, line: str) -> list[HistoryRow]:
    """Rows of a check, with its outlook; ``head`` holds the common fields."""
    tool = asdict(measures)
    joints = tool.pop("joints")
    arm = replace(
        head,
        state=found.state,
        line=line,
        tolerance_mm=found.tolerance_mm,
        controlled_mm=found.controlled_mm,
        **tool,
    )
    if due := found.due:
        arm = replace(arm, due_early=due.early, due=due.middle, due_late=due.late)
    states = {one.joint: one.state for one in reversed(found.changes)}  # the worst of each joint
    return [arm, *(replace(head, state=states.get(joint["joint"], ""), **joint) for joint in joints)]


def past_of(rows: Sequence[HistoryRow], arm: str) -> Past:
    """Return an arm's history since its baseline began."""
    past, owner = Past(), owners(rows)
    mine = sorted((row for row in rows if owner(row) == arm), key=lambda row: (row.time, row.kind))
    for (_, kind), group in groupby(mine, key=lambda row: (row.time, row.kind)):
        members = {row.joint: row for row in group}  # of a folder that was copied each stands there twice
        head = members.pop("", None)
        if kind == "repair" and head:
            past = Past(setup=head.setup, left_mm=head.left_mm)
        elif kind == "check" and head and members:
            with suppress(msgspec.ValidationError):  # a measure is missing
                found = vars(head) | {"joints": list(map(vars, members.values()))}
                check = PastCheck(time=head.time, measures=msgspec.convert(found, CheckMeasures), used_h=head.used_h)
                left = None if head.norm == SET_UP else past.left_mm
                past = Past(visits=(check,) if head.norm else (*past.visits, check), setup=head.setup, left_mm=left)
    return past


def summarise(run: Run) -> None:
    """Write ``summary.parquet`` into a run folder that is no quick try; FileError if that fails.

    A finished repair keeps its time.
    """
    diagnosis, comparison = run.diagnosis, run.comparison
    if run.folder.quick.exists() or not (diagnosis or comparison):
        return
    path, kind = run.path / SUMMARY, REPAIR if run.folder.finished.exists() and not run.info.from_logs else "run"
    before = summary_of(path)
    arm = HistoryRow(
        time=before.time if before and before.kind == kind == REPAIR else utc_now(),
        kind=kind,
        arm=run.info.name or name_of(run.robot, run.arm.name),
        robot=run.robot,
        model=run.arm.name,
        setup=setup_of(run.arm),
    )
    if diagnosis:
        arm = replace(arm, state=diagnosis.condition, line=diagnosis.verdict)
        if loop := diagnosis.open_loop:
            known = loop.true_error_mm
            arm = replace(arm, true_error_mm=known.value if known else None, error_mm=loop.error_mm.value)
    if comparison:
        best = comparison.row(recommend(comparison).controller)
        settled, true = (1e3 * one.mean.value if one else None for one in (best.settled, best.settled_true))
        arm = replace(arm, controller=best.controller, settled_mm=settled, settled_true_mm=true)
    if kind == REPAIR:
        from rejoint.pages.report.page import check_again

        drive = command("goto", run.info.name or run.robot, "X", "Y", "Z", "--run", run.path)
        use = f"Do: {drive} uses it; check it later: {check_again(run.folder, run.info)}"
        arm = replace(arm, line=f"Before its repair: {arm.line} {use}")
    write_rows(path, [arm])


def summary_of(path: Path) -> HistoryRow | None:
    """Row of the arm in a summary; None where it cannot be read."""
    with suppress(FileError):
        return next((row for row in read_rows(path) if not row.joint), None)
    return None


_STATES = ("alarm", "drifting", "learning", "steady")
"""The worst first"""


def prometheus_text(name: str, seen: Outlook, measures: CheckMeasures) -> str:
    """Check as Prometheus text."""
    ends, epoch = {} if seen.due is None else asdict(seen.due), datetime(1970, 1, 1)
    samples = [
        *(("state", seen.state == state, {"state": state}) for state in _STATES),
        ("error_mm", seen.error_mm, {"by": "encoders"}),
        ("controlled_error_mm", seen.controlled_mm, {}),
        ("tolerance_mm", seen.tolerance_mm, {}),
        ("repeatability_mm", measures.repeatability_mm, {}),
        *(("due_seconds", end and (end - epoch).total_seconds(), {"end": name}) for name, end in ends.items()),
        *(("hysteresis_mm", row.hysteresis_mm, {"joint": row.joint}) for row in measures.joints),
        *(("cusum", one.cusum, {"joint": one.joint, "quantity": one.quantity}) for one in seen.changes),
    ]
    lines = [f"# TYPE rejoint_{metric} gauge\n" for metric in dict.fromkeys(metric for metric, *_ in samples)]
    for metric, value, labels in samples:
        if value is not None:
            pairs = ({"arm": name} | labels).items()
            words = ",".join(f"{key}={msgspec.json.encode(text).decode()}" for key, text in pairs)
            lines.append(f"rejoint_{metric}{{{words}}} {value:.10g}\n")
    return "".join(lines)


HEADERS = ("arm", "state", "error [mm]", "tolerance [mm]", "reached", "last check", "what to do")
REPAIR, REPAIRED, OVER = "repair", "repaired", "tolerance reached"
"""Kind of a repair's row, and states"""
_ORDER = (OVER, "alarm", "bad", "drifting", "worn", REPAIRED, "steady", "ok", "learning", "unknown", "")


class ArmHistory(NamedTuple):
    """All rows of one arm."""

    name: str
    rows: tuple[HistoryRow, ...]
    """of the whole arm, the oldest first"""

    @property
    def newest(self) -> HistoryRow:
        """The last check or repair, else the last run."""
        return next((row for row in reversed(self.rows) if row.kind in ("check", "repair")), self.rows[-1])

    @property
    def checks(self) -> list[HistoryRow]:
        """Checks with an error, without those of runs."""
        return [row for row in self.rows if row.kind == "check" and row.counts_mm is not None]

    @property
    def state(self) -> str:
        """State in a word or two."""
        return state_of(self.newest)


def state_of(row: HistoryRow) -> str:
    """State of an arm by its newest row."""
    return OVER if row.over else REPAIRED if row.kind == REPAIR else row.state


DRIFTS, ALARM = 6, 7
"""Exit codes of a check: watch the arm, repair it"""


def code_of(check: HistoryRow | Outlook) -> int:
    """Exit code of a check."""
    return ALARM if check.over or check.state == "alarm" else DRIFTS if check.state == "drifting" else 0


def arms_of(rows: Sequence[HistoryRow]) -> list[ArmHistory]:
    """Group rows, the oldest first, by arm; urgent arms first."""
    owner = owners(rows)
    whole = sorted((row for row in rows if not row.joint), key=lambda row: (owner(row), row.time))
    return sorted(
        (ArmHistory(name=name, rows=tuple(mine)) for name, mine in groupby(whole, owner)),
        key=lambda arm: (
            (*_ORDER, arm.state).index(arm.state),
            arm.newest.due_early or datetime.max,
            -(arm.newest.counts_mm or 0.0),
        ),
    )


def cells(arm: ArmHistory) -> list[str]:
    """One row of the table `HEADERS`."""
    row = arm.newest
    by = " by encoders" * (row.true_error_mm is None or row.counts_mm == row.error_mm)
    early, late = row.due_early, row.due_late
    due = f"{early:%Y-%m-%d} to {late:%Y-%m-%d}" if early and late else f"after {early:%Y-%m-%d}" if early else ""
    return [
        arm.name,
        arm.state,
        "" if row.counts_mm is None else f"{row.counts_mm:.1f}{by}",
        "" if row.tolerance_mm is None else f"{row.tolerance_mm:.1f}",
        "now" if row.over else due,
        f"{row.time:%Y-%m-%d}",
        what_to_do(row),
    ]


def what_to_do(row: HistoryRow) -> str:
    """Last advice to the user."""
    return row.line.partition("Do: ")[2]


def write_history(path: Path, arms: Sequence[ArmHistory]) -> None:
    """Write the page; FileError if it cannot be written."""
    urgent = [arm for arm in arms if arm.state in (OVER, "alarm", "drifting", "bad")]
    write_page(path, "history.html", arms=arms, urgent=urgent, headers=HEADERS, cells=cells)
