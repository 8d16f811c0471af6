"""Which rows of a log show the free arm, and which one that leans on something, stands at a stop or is not read.

Diagnosis and identification speak of the free arm. An arm that lies on its table looks like one with a
weak elbow, and its joints stay disturbed for seconds after. So such rows are found, left out of the fit,
and judged apart.

Method. Gravity pulls a free arm below its command. A tip that rests clearly above its command is held up;
if that happens at the bottom of the reach only, there is a table, and its height is where tips that are
held up part from tips that are not. A joint at an end of its travel that stands still far from its command
is at a stop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.logs.runlog import RunLog

Rows = NDArray[np.bool_]

HELD_UP = 0.005
"""[m] tip above its command by which it counts as held up; free tips at rest are at most 4 mm above theirs
(measured on a real low-cost arm)"""
SLOW = 0.05
"""[rad/s] speed of joints and commands below which a row tells whether the tip is held up (chosen)"""
LEAST_HELD = 2.0
"""[s] of being held up below which no table is claimed (chosen)"""
MARGIN = 0.010
"""[m] above the table where contact may begin: the finger under the tip is not on its axis (measured: a threshold
10 mm above the height found here is the one that separates the errors of a real low-cost arm)"""
RECOVERY = 3.0
"""[s] for which joints stay disturbed after a contact (measured on a real low-cost arm)"""

STOP_ERROR = np.radians(8.0)
"""[rad] between command and a joint that stands still, above which something blocks it (chosen: twice the largest
error at rest of a real low-cost arm)"""
USUAL = 3.0
"""Times the median error of a joint, command less position, that an error must have to speak of a stop or of dead
readings (chosen): a weak servo that sags, or one that sticks, is as far from its commands everywhere"""
STOP_BAND = np.radians(1.5)
"""[rad] from the end of the travel seen in the logs within which a blocked joint is at a stop (chosen)"""
LEAST_TRAVEL = np.radians(6.0)
"""[rad] of travel below which its ends are no stops: a joint that never moves is stuck, and that is a fault of the arm
(chosen: four times the band)"""
STOP_TIME = 0.2
"""[s] for which it stands there (chosen: a reversal is shorter)"""

STALE_TIME = 0.5
"""[s] without any change of any encoder, a command having moved off, after which readings count as dead (chosen)"""
STALE_MOTION = np.radians(6.0)
"""[rad] by which that command has moved: more than friction hides (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Exclusions:
    """Rows (T,) of one log that do not show the free arm; each kind with its recovery."""

    contact: Rows
    """the tip on the table, or just off it"""
    stop: Rows
    """a joint at a mechanical stop, or just off it"""
    stale: Rows
    """readings that do not change though they should"""

    @property
    def free(self) -> Rows:
        """(T,) rows that show the free arm."""
        return ~(self.contact | self.stop | self.stale)

    @property
    def readable(self) -> Rows:
        """(T,) rows that are worth predicting with a table: all but those at stops and dead ones."""
        return ~(self.stop | self.stale)


def find_exclusions(arm: Arm, logs: Sequence[RunLog], table: float | None = None) -> list[Exclusions]:
    """Judge every row of the logs, which share one table; ``table`` [m] is its height, if any (`table_height`)."""
    ends, usual = _travel(logs), _usual_error(logs)
    found = []
    for log in logs:
        contact = np.zeros(len(log), dtype=bool)
        if table is not None:
            contact = tcp_position(arm, log.position)[:, 2] < table + MARGIN
        stopped = _stopped(log, ends, usual) & ~contact  # a table stops joints too, at the end of what they show
        found.append(
            Exclusions(
                contact=_recovering(log.time, contact),
                stop=_recovering(log.time, stopped),
                stale=_recovering(log.time, _stale(log, usual) & ~stopped),
            )
        )
    return found


def table_height(arm: Arm, logs: Sequence[RunLog]) -> float | None:
    """Height [m] in the base frame of the tip on a table that the arm leans on in some logs; None if it never does."""
    heights, held, weights, usual = [], [], [], _usual_error(logs)
    for log in logs:
        tip, asked = (tcp_position(arm, q)[:, 2] for q in (log.position, log.command))
        counted = (joint_speed(log.time, log.position) < SLOW) & (joint_speed(log.time, log.command) < SLOW)
        counted &= ~_stale(log, usual)
        heights.append(tip[counted])
        held.append((tip - asked)[counted] > HELD_UP)
        weights.append(np.full(int(counted.sum()), float(np.median(np.diff(log.time)))))
    height, up, seconds = (np.concatenate(parts) for parts in (heights, held, weights))
    if not up.any():
        return None
    order = np.argsort(height)
    # Held-up tips count for, others against a table no lower than themselves.
    gain = np.cumsum(np.where(up, seconds, -seconds)[order])
    best = int(np.argmax(gain))
    return float(height[order][best]) if gain[best] > LEAST_HELD else None


def free_runs(free: Rows, time: Array, shortest: float) -> list[tuple[int, int]]:
    """Find runs of rows (first, last exclusive) that are free, without gaps in time, of at least ``shortest`` [s]."""
    if len(time) < 2:
        return []
    gap = np.diff(time) > 5 * np.median(np.diff(time))
    breaks = np.flatnonzero(gap | (free[1:] != free[:-1])) + 1
    edges = [0, *breaks.tolist(), len(time)]
    runs = [(a, b) for a, b in pairwise(edges) if free[a]]
    return [(a, b) for a, b in runs if time[b - 1] - time[a] >= shortest]


def _travel(logs: Sequence[RunLog]) -> tuple[Array, Array]:
    """Find the ends (n,) [rad] of the travel that the logs show."""
    lowest = np.min([log.position.min(axis=0) for log in logs], axis=0)
    return lowest, np.max([log.position.max(axis=0) for log in logs], axis=0)


def _usual_error(logs: Sequence[RunLog]) -> Array:
    """Median (n,) [rad] of how far each joint is from its command, where readings change; 0 where none ever does."""
    changing = [np.diff(log.position, axis=0, prepend=log.position[:1]).any(axis=1) for log in logs]
    errors = np.concatenate(
        [np.abs(log.command - log.position)[rows] for log, rows in zip(logs, changing, strict=True)]
    )
    return np.median(errors, axis=0) if len(errors) else np.zeros(logs[0].position.shape[1])


def _stopped(log: RunLog, ends: tuple[Array, Array], usual: Array) -> Rows:
    error = np.where(ends[1] - ends[0] > LEAST_TRAVEL, log.command - log.position, 0.0)
    least = np.maximum(STOP_ERROR, USUAL * usual)
    low = (log.position < ends[0] + STOP_BAND) & (error < -least)
    high = (log.position > ends[1] - STOP_BAND) & (error > least)
    return np.asarray(_lasting((low | high).any(axis=1), log.time, STOP_TIME))


def _stale(log: RunLog, usual: Array) -> Rows:
    """Rows in which every reading is that of the row before, for long, while a command moves on."""
    still = np.concatenate([[False], (log.position[1:] == log.position[:-1]).all(axis=1)])
    dead = np.zeros(len(log), dtype=bool)
    for first, last in free_runs(still, log.time, STALE_TIME):
        # A joint may well rest though its command moves; not for long once the command has left it.
        moved = np.abs(log.command[first:last] - log.command[first])
        left = (moved > np.maximum(STALE_MOTION, USUAL * usual)).any(axis=1)
        dead[first:last] = _lasting(left, log.time[first:last], STALE_TIME).any()
    return dead


def _lasting(rows: Rows, time: Array, seconds: float) -> Rows:
    kept = np.zeros(len(rows), dtype=bool)
    for first, last in free_runs(rows, time, seconds):
        kept[first:last] = True
    return kept


def _recovering(time: Array, rows: Rows) -> Rows:
    """Rows with those that follow within `RECOVERY`."""
    if not rows.any():
        return rows
    latest = np.maximum.accumulate(np.where(rows, time, -np.inf))
    return np.asarray(time - latest <= RECOVERY)


def joint_speed(time: Array, q: Array) -> Array:
    """(T,) [rad/s] speed of the fastest joint of positions or commands (T, n) [rad], over four rows to either side."""
    rows = np.arange(len(time))
    before, after = np.maximum(rows - 4, 0), np.minimum(rows + 4, len(time) - 1)
    return np.abs((q[after] - q[before]) / np.maximum(time[after] - time[before], 1e-9)[:, None]).max(axis=1)
