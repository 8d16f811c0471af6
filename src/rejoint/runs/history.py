"""The history: rows of checks and runs, table, page, Prometheus metrics."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rejoint.control.comparison.recommend import recommend
from rejoint.diagnosis.monitoring.judge import Outlook, PastCheck, cause_of
from rejoint.diagnosis.monitoring.measures import CheckMeasures, JointCheck
from rejoint.logs.history.rows import SUMMARY, HistoryRow, name_of, read_rows, setup_of, utc_now, write_rows
from rejoint.pages.html import write_page
from rejoint.runs.run import Run, is_finished
from rejoint.system.errors import FileError
from rejoint.system.files import write_whole
from rejoint.system.shell import command

if TYPE_CHECKING:
    from rejoint.control.comparison.result import Comparison
    from rejoint.diagnosis.diagnosis import Diagnosis


def owners(rows: Sequence[HistoryRow]) -> Callable[[HistoryRow], str]:
    """Return a function from a row to its arm's name."""
    checks: dict[str, list[HistoryRow]] = {}
    for row in sorted((row for row in rows if row.kind == "check" and not row.joint), key=lambda row: row.time):
        checks.setdefault(name_of(row.robot, row.model), []).append(row)

    def owner(row: HistoryRow) -> str:
        there = [] if row.kind == "check" else checks.get(name_of(row.robot, row.model), [])
        before = [one for one in there if one.time <= row.time]
        return (before[-1:] or there[:1] or [row])[0].arm

    return owner


MOVED, SET_UP = "moved", "set up"
"""Reasons of a new baseline: a move, or another description"""

# Bound of all that a check measures, in millimetres and degrees (chosen: a kilometre)
_MOST = 1e6
_TOOL = ("error_mm", "repeatability_mm", "approach_mm", "true_error_mm", "true_approach_mm", "temperature_c")


@dataclass(frozen=True, kw_only=True)
class Past:
    """History of an arm since its baseline began."""

    visits: tuple[PastCheck, ...]
    """the oldest first"""
    setup: str
    """fingerprint of its description, or empty"""
    left_mm: float | None
    """tool error with the controller of its last repair, if any"""


def rows_of(head: HistoryRow, measures: CheckMeasures) -> list[HistoryRow]:
    """Rows of a check; ``head`` holds the common fields."""
    tool = replace(head, **{name: getattr(measures, name) for name in _TOOL})
    return [tool, *(replace(head, **asdict(joint)) for joint in measures.joints)]


def with_outlook(rows: Sequence[HistoryRow], found: Outlook, line: str) -> list[HistoryRow]:
    """Add the outlook to the rows of a check."""
    due = found.due
    joints = {name: _worst(found, name) for name in {row.joint for row in rows}}
    arm = replace(
        rows[0],
        state=found.state,
        cause=cause_of(found),
        line=line,
        tolerance_mm=found.tolerance_mm,
        controlled_mm=found.controlled_mm,
        due_early=None if due is None else due.early,
        due=None if due is None else due.middle,
        due_late=None if due is None else due.late,
    )
    return [arm, *(replace(row, state=joints[row.joint]) for row in rows[1:])]


def past_of(rows: Sequence[HistoryRow], arm: str, key: str) -> Past:
    """Return an arm's history since its baseline began.

    A repair counts for its `owners`, or by ``key``.
    """
    visits: list[PastCheck] = []
    setup, left = "", None
    owner = owners(rows)
    mine = [row for row in rows if row.arm == arm or (row.kind == "repair" and owner(row) in (arm, key))]
    mine.sort(key=lambda row: (row.time, row.kind))
    for (_, kind), group in groupby(mine, key=lambda row: (row.time, row.kind)):
        members = {row.joint: row for row in group}  # of a folder that was copied each stands there twice
        head = members.pop("", None)
        if kind == "repair":
            visits, left = [], None if head is None else head.left_mm
            setup = setup if head is None else head.setup
        elif kind == "check":
            measures = None if head is None else _measures(head, tuple(members.values()))
            if head is None or measures is None:
                continue
            visits, setup = [] if head.norm else visits, head.setup
            left = None if head.norm == SET_UP else left
            visits.append(PastCheck(time=head.time, measures=measures, used_h=head.used_h))
    return Past(visits=tuple(visits), setup=setup, left_mm=left)


def _worst(found: Outlook, joint: str) -> str:
    states = [one.state for one in found.changes if one.joint == joint]
    return next((state for state in ("alarm", "drifting", "learning", "steady") if state in states), "")


def _measures(head: HistoryRow, joints: Sequence[HistoryRow]) -> CheckMeasures | None:
    if not all(map(_believable, (head, *joints))):
        return None
    needed = (head.error_mm, head.repeatability_mm, head.approach_mm)
    if None in needed or not joints:
        return None
    found = []
    for row in joints:
        values = {name: getattr(row, name) for name in JointCheck.__annotations__}
        if any(values[name] is None for name in ("hysteresis_mm", "reversal_mm", "deviation_mm", "lever_mm")):
            return None
        found.append(JointCheck(**values))
    return CheckMeasures(joints=tuple(found), **{name: getattr(head, name) for name in _TOOL})


def _believable(row: HistoryRow) -> bool:
    values = (getattr(row, name) for name in (*_TOOL, *JointCheck.__annotations__) if name != "joint")
    return all(value is None or abs(value) <= _MOST for value in values)


def summarise(run: Run) -> None:
    """Write ``summary.parquet`` into a run folder; FileError if that fails.

    A finished repair keeps its time.
    """
    diagnosis, comparison = run.diagnosis, run.comparison
    if diagnosis is None and comparison is None:
        return
    kind = "repair" if is_finished(run.folder) else "run"
    head = HistoryRow(
        time=_repaired_at(run.path / SUMMARY, kind) or utc_now(),
        kind=kind,
        arm=name_of(run.robot, run.arm.name),
        robot=run.robot,
        model=run.arm.name,
        setup=setup_of(run.arm),
    )
    arm = head
    joints: list[HistoryRow] = []
    if diagnosis is not None:
        arm, joints = _diagnosed(head, diagnosis)
    if comparison is not None:
        arm = _compared(arm, comparison)
    write_rows(run.path / SUMMARY, [arm, *joints])


def _repaired_at(path: Path, kind: str) -> datetime | None:
    if kind != "repair":
        return None
    with suppress(FileError, FileNotFoundError):
        return next((row.time for row in read_rows(path) if row.kind == kind), None)
    return None


def _diagnosed(head: HistoryRow, found: Diagnosis) -> tuple[HistoryRow, list[HistoryRow]]:
    loop = found.open_loop
    true = None if loop is None or loop.true_error_mm is None else loop.true_error_mm.value
    arm = replace(
        head,
        state=found.condition,
        line=found.verdict,
        true_error_mm=true,
        error_mm=None if loop is None else loop.error_mm.value,
    )
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
        arm,
        controller=chosen,
        success=row.reached,
        settled_mm=None if row.settled is None else 1e3 * row.settled.mean.value,
        settled_true_mm=None if row.settled_true is None else 1e3 * row.settled_true.mean.value,
    )


_STATES = ("learning", "steady", "drifting", "alarm")


def write_prometheus(path: Path, name: str, seen: Outlook, measures: CheckMeasures) -> None:
    """Write the check of the arm ``name``, atomically; FileError if that fails."""
    text = prometheus_text(name, seen, measures)
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def prometheus_text(name: str, seen: Outlook, measures: CheckMeasures) -> str:
    """Check as Prometheus text."""
    arm = f'arm="{_escaped(name)}"'
    lines: list[str] = []

    def metric(name: str, what: str, values: list[tuple[str, float]]) -> None:
        if values:
            lines.extend((f"# HELP rejoint_{name} {what}", f"# TYPE rejoint_{name} gauge"))
            lines.extend(f"rejoint_{name}{{{labels}}} {value:.10g}" for labels, value in values)

    metric(
        "state",
        "1 for the state that the arm is in",
        [(f'{arm},state="{state}"', float(seen.state == state)) for state in _STATES],
    )
    known = "tool" if seen.error_known else "encoders"
    metric("error_mm", "tool error at the five poses of a check", [(f'{arm},by="{known}"', seen.error_mm)])
    metric(
        "controlled_error_mm",
        "tool error with the controller of the last repair, at most",
        [] if seen.controlled_mm is None else [(arm, seen.controlled_mm)],
    )
    metric(
        "tolerance_mm",
        "tool error that the owner can bear",
        [] if seen.tolerance_mm is None else [(arm, seen.tolerance_mm)],
    )
    metric("repeatability_mm", "largest RP of a pose by the encoders", [(arm, measures.repeatability_mm)])
    if seen.due is not None:
        ends = (("early", seen.due.early), ("middle", seen.due.middle), ("late", seen.due.late))
        metric(
            "due_seconds",
            "when the tolerance will be reached",
            [(f'{arm},end="{end}"', _seconds(time)) for end, time in ends if time is not None],
        )
    metric(
        "hysteresis_mm",
        "following error one way minus the other",
        [(f'{arm},joint="{_escaped(row.joint)}"', row.hysteresis_mm) for row in measures.joints],
    )
    metric(
        "cusum",
        "standard deviations that have come together since the change began",
        [(f'{arm},joint="{_escaped(one.joint)}",quantity="{one.quantity}"', one.cusum) for one in seen.changes],
    )
    return "\n".join([*lines, ""])


def _seconds(time: datetime) -> float:
    return (time - datetime(1970, 1, 1)).total_seconds()


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


HEADERS = ("arm", "state", "error [mm]", "tolerance [mm]", "reached", "last check", "what to do")
REPAIR, REPAIRED = "repair", "repaired"
"""Kind of a repair's row, and the state until the next check"""
_ORDER = ("alarm", "bad", "drifting", "worn", REPAIRED, "steady", "ok", "learning", "unknown", "")


@dataclass(frozen=True, kw_only=True)
class ArmHistory:
    """All rows of one arm."""

    name: str
    rows: tuple[HistoryRow, ...]
    """of the whole arm, the oldest first"""
    joints: tuple[HistoryRow, ...]

    @property
    def newest(self) -> HistoryRow:
        """The last check or repair, else the last run."""
        told = [row for row in self.rows if row.kind in ("check", "repair")]
        return (told or list(self.rows))[-1]

    @property
    def checks(self) -> list[HistoryRow]:
        """Checks with an error, without those of runs."""
        return [row for row in self.rows if row.kind == "check" and row.counts_mm is not None]

    @property
    def error(self) -> float | None:
        """[mm] newest tool error that counts."""
        return self.newest.counts_mm

    @property
    def over(self) -> bool:
        """Whether the tolerance is reached."""
        return self.newest.over

    @property
    def state(self) -> str:
        """State in a word or two."""
        return "tolerance reached" if self.over else REPAIRED if self.newest.kind == REPAIR else self.newest.state


def arms_of(rows: Sequence[HistoryRow]) -> list[ArmHistory]:
    """Group rows, the oldest first, by arm; urgent arms first."""
    found = []
    owner = owners(rows)
    whose = [(owner(row), row) for row in rows]
    for name in sorted({name for name, _ in whose}):
        mine = sorted((row for other, row in whose if other == name), key=lambda row: row.time)
        whole = tuple(row for row in mine if not row.joint)
        if whole:
            found.append(ArmHistory(name=name, rows=whole, joints=tuple(row for row in mine if row.joint)))
    return sorted(found, key=_urgency)


def cells(arm: ArmHistory) -> list[str]:
    """One row of the table `HEADERS`."""
    row = arm.newest
    by = "" if row.true_error_mm is not None or arm.error is None else " by encoders"
    return [
        arm.name,
        arm.state,
        "" if arm.error is None else f"{arm.error:.1f}{by}",
        "" if row.tolerance_mm is None else f"{row.tolerance_mm:.1f}",
        "now" if arm.over else _span(row.due_early, row.due_late),
        f"{row.time:%Y-%m-%d}",
        what_to_do(row),
    ]


def what_to_do(row: HistoryRow) -> str:
    """Last advice to the user."""
    if row.kind == REPAIR:
        return f"{command('check', row.robot)} --repeat 5"
    return row.line.rpartition("Do: ")[2] if "Do: " in row.line else ""


def _span(early: datetime | None, late: datetime | None) -> str:
    if early is None:
        return ""
    return f"after {early:%Y-%m-%d}" if late is None else f"{early:%Y-%m-%d} to {late:%Y-%m-%d}"


def _urgency(arm: ArmHistory) -> tuple[bool, int, datetime, float]:
    row = arm.newest
    state = _ORDER.index(arm.state) if arm.state in _ORDER else len(_ORDER)
    return (not arm.over, state, row.due_early or datetime.max, -(arm.error or 0.0))


def write_history(path: Path, arms: Sequence[ArmHistory]) -> None:
    """Write the page; FileError if it cannot be written."""
    checks = sum(row.kind == "check" for arm in arms for row in arm.rows)
    runs = sum(len(arm.rows) for arm in arms) - checks
    urgent = [arm for arm in arms if arm.over or arm.state in ("alarm", "drifting", "bad")]
    first = f"{len(urgent)} of {len(arms)} arms need somebody." if urgent else f"Nothing to do on {len(arms)} arms."
    write_page(
        path,
        "history.html",
        title="Arms over time",
        subtitle=f"{len(arms)} arms, {checks} checks, {runs} runs",
        verdict=(first, *(f"{arm.name}: {arm.newest.line}" for arm in urgent[:5])),
        parts=(("arms", "Arms"), ("trends", "Trends"), ("joints", "Joints")),
        footer="Made from the files summary.parquet below one folder, which are not changed.",
        arms=arms,
        headers=HEADERS,
        cells=cells,
        trends=[arm for arm in arms if len(arm.checks) > 1],
        joints=[pair for arm in urgent for pair in _joints(arm)],
    )


def _joints(arm: ArmHistory) -> Iterator[tuple[str, HistoryRow, HistoryRow]]:
    begun = max((row.time for row in arm.rows if row.kind == "repair" or row.norm), default=datetime.min)
    mine = [row.time for row in arm.rows if row.kind == "check" and row.time >= begun]
    if len(mine) > 1:
        first, last = ({row.joint: row for row in arm.joints if row.time == time} for time in (mine[0], mine[-1]))
        yield from ((arm.name, first[joint], row) for joint, row in last.items() if joint in first)
