"""Logs of any motion, cut into the named spans that measurements need: free motion, steps, rest.

The logs are put one after the other on one clock, so that everything that reads an excitation reads
them too. No span holds a row that does not show the free arm (`rejoint.logs.exclusions`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.diagnosis.segments import ExcitationLog, Segment
from rejoint.logs.exclusions import Exclusions, Rows, free_runs
from rejoint.logs.runlog import RunLog

FREE, STEP, HOLD, STILL = "free", "step", "hold", "still"
"""Kinds of spans; the last three are those of an excitation"""

_APART = 60.0
"""[s] between one log and the next on the common clock"""

SHORTEST = 1.0
"""[s] of free motion that are worth a span (chosen: three windows of the measurement)"""

LONGEST = 300.0
"""[s] of a span of free motion (chosen: the window averages number the parts of a span up to a thousand of 2 s)"""

QUIET = 1.0
"""[s] for which no command moves before a span counts as rest (chosen: several lags of a hobby servo)"""

STEP_TIME, STEP_SIZE = 0.15, 0.05
"""[s] within which a command moves by so much [rad] or more in a step (chosen: faster than a servo follows)"""

STEP_LENGTH = 3.0
"""[s] of a step that are looked at, at most (chosen: a worn arm has come to rest)"""

_SAME = 1e-6
"""[rad] by which a command that stands still may change from row to row: the rounding of a file (chosen)"""


def join_logs(arm: Arm, logs: Sequence[RunLog], excluded: Sequence[Exclusions]) -> ExcitationLog:
    """Put logs on one clock and name their spans; the name of a span begins with the number of its log.

    InputError if a log is of another arm.
    """
    segments: list[Segment] = []
    times, begin = [], 0.0
    for number, (log, rows) in enumerate(zip(logs, excluded, strict=True)):
        log.require(arm.name, arm.joint_names)
        time = log.time - log.time[0] + begin
        segments += _spans(number, log, rows.free, time)
        times.append(time)
        begin = float(time[-1]) + _APART
    everything = RunLog(
        arm=arm.name, joint_names=arm.joint_names, robot="logs", label=f"{len(logs)} logs", time=np.concatenate(times),
        position=_stacked(logs, "position"), command=_stacked(logs, "command"), target=_stacked(logs, "target"),
        true_tcp=_stacked(logs, "true_tcp"),
    )  # fmt: skip
    return ExcitationLog.with_segments(arm, everything, tuple(segments))


def log_of(segment: Segment) -> int:
    """Return the number of the log that a span is of."""
    return int(segment.name.partition("/")[0])


def _stacked(logs: Sequence[RunLog], name: str) -> Array:
    return np.concatenate([getattr(log, name) for log in logs])


def _spans(number: int, log: RunLog, free: Rows, time: Array) -> Iterator[Segment]:
    def segment(kind: str, first: int, last: int, joints: tuple[int, ...]) -> Segment:
        name = f"{number}/{kind}/{joints[0] if kind == STEP else 'all'}/{first}"
        return Segment(name=name, kind=kind, start=float(time[first]), stop=float(time[last - 1]), joints=joints)

    everyone = tuple(range(log.position.shape[1]))
    still = np.concatenate([np.ones((1, len(everyone)), dtype=bool), np.abs(np.diff(log.command, axis=0)) < _SAME])
    for first, last in free_runs(free, time, SHORTEST):
        count = int(np.ceil((time[last - 1] - time[first]) / LONGEST))
        edges = np.linspace(first, last, count + 1).astype(int).tolist()
        for a, b in pairwise(edges):
            yield segment(FREE, a, b, everyone)
    for first, last in free_runs(free & still.all(axis=1), time, QUIET):
        yield segment(HOLD, first, last, everyone)
        yield segment(STILL, first, last, everyone)
    for joint in everyone:
        for first, last in _steps(log, free, still[:, joint], joint):
            yield segment(STEP, first, last, (joint,))


def _steps(log: RunLog, free: Rows, still: Rows, joint: int) -> Iterator[tuple[int, int]]:
    """Rows (first, last exclusive) of a joint's steps: from the last row before one to where the next motion begins."""
    for arrived, last in free_runs(still, log.time, QUIET):
        first = int(np.searchsorted(log.time, log.time[arrived] - STEP_TIME))
        moved = np.abs(np.diff(log.command[first : arrived + 1, joint]))
        if moved.sum() < STEP_SIZE or abs(log.command[arrived, joint] - log.command[first, joint]) < STEP_SIZE:
            continue
        first += int(np.argmax(moved > _SAME))
        last = min(last, int(np.searchsorted(log.time, log.time[first] + STEP_LENGTH)))
        if free[first:last].all():
            yield first, last
