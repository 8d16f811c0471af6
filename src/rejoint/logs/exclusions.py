"""Rows of a log with the free arm; others are in contact, at a stop, or unread.

A tip at rest above its command is held up: by a table if only at the bottom of the reach. A joint stationary at an end
of its travel, far from its command, is at a stop.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import compress, pairwise

import numpy as np

from rejoint.arms import Arm, Array, Mask, tcp_position
from rejoint.arms.workspace import length_size
from rejoint.logs.columns import ZEROS
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.records import entity

HELD_UP = 0.005
"""[m] of a held tip above its command (a free low-cost arm: at most 4 mm)"""
SLOW = 0.05
"""[rad/s] of a usable row (chosen)"""
LEAST_HELD = 2.0
"""[s] of held rows for a table (chosen)"""
APART = 0.03
"""[m] least extent of places where a table holds a myCobot 280's tip (chosen)"""
MARGIN = 0.010
"""[m] of contact above the table (measured on a real low-cost arm)"""
RECOVERY = 3.0
"""[s] after a contact (measured on a real low-cost arm)"""

STOP_ERROR = np.radians(8.0)
"""[rad] error of a blocked joint (chosen: twice a real arm's largest)"""
USUAL = 3.0
"""Times the median error at a stop (chosen): sagging joints are always off"""
STOP_BAND = np.radians(1.5)
"""[rad] from the end of the travel (chosen)"""
LEAST_TRAVEL = np.radians(6.0)
"""[rad] of travel with stops (chosen)"""
STOP_TIME = 0.2
"""[s] at a stop (chosen: a reversal is shorter)"""

PAUSE = 0.1
"""[s] least pause that ends a run (chosen)"""
STALE_TIME = 0.5
"""[s] of constant readings under a moving command (chosen)"""
STALE_MOTION = np.radians(6.0)
"""[rad] of that command (chosen: more than friction hides)"""

UNPOWERED = "unpowered"
"""Key in ``extra`` for joints without torque"""
ASKED = np.radians(3.0)
"""[rad] least travel of a command (chosen)"""
ANSWERED = 0.1
"""Travel share without torque (chosen)"""
UNRELATED = 0.3
"""Correlation, likewise (chosen)"""
ANSWERING = 0.9
"""Least correlation in a log of a joint that is powered in some of them (chosen)"""
LAGS = (0.0, 0.05, 0.1, 0.15, 0.2, 0.3)
"""[s] of searched answers (chosen)"""
RESTING = 1e-3
"""[rad] rms at rest: below a 12-bit encoder's step (chosen)"""


@entity
class Exclusions:
    """Rows (T,) of a log without the free arm, with recovery."""

    log: RunLog
    contact: Mask
    """tip on the table"""
    stop: Mask
    """joint at a stop"""
    stale: Mask
    """readings that should change"""

    @property
    def free(self) -> Mask:
        """(T,) rows of the free arm."""
        return self.readable & ~self.contact

    @property
    def readable(self) -> Mask:
        """(T,) rows for a twin with a table."""
        return ~(self.stop | self.stale)


def find_exclusions(arm: Arm, logs: Sequence[RunLog], table: float | None = None) -> list[Exclusions]:
    """Judge every row of logs; ``table`` [m] as `table_height`."""
    reached, usual = np.concatenate([log.position for log in logs]), _usual_error(logs)
    ends = reached.min(axis=0), reached.max(axis=0)
    found = []
    for log in logs:
        contact = tcp_position(arm, log.position)[:, 2] < MARGIN + (-np.inf if table is None else table)
        stopped = _stopped(log, ends, usual) & ~contact  # a table stops joints too, at the end of what they show
        found.append(
            Exclusions(
                log=log,
                contact=_recovering(log.time, contact),
                stop=_recovering(log.time, stopped),
                stale=_recovering(log.time, _stale(log, usual) & ~stopped),
            )
        )
    return found


def table_height(arm: Arm, logs: Sequence[RunLog]) -> float | None:
    """Height [m] of the tip on a table; None without, or without known zeros."""
    places, held, weights, usual = [], [], [], _usual_error(logs)
    for log in logs:
        tip, asked = (tcp_position(arm, q) for q in (log.position, log.command))
        counted = (joint_speed(log.time, log.position) < SLOW) & (joint_speed(log.time, log.command) < SLOW)
        counted &= ~_stale(log, usual) & (ZEROS not in log.extra)
        places.append(tip[counted])
        held.append((tip - asked)[counted, 2] > HELD_UP)
        weights.append(np.full(counted.sum(), log.period))
    place, up, seconds = (np.concatenate(parts) for parts in (places, held, weights))
    if not up.any():
        return None
    height = place[:, 2]
    order = np.argsort(height)
    # Held-up tips count for, others against a table no lower than themselves.
    gain = np.cumsum(np.where(up, seconds, -seconds)[order])
    best = np.argmax(gain)
    found = height[order][best]  # a table is flat: most of what it holds lies there
    near = up & (np.abs(height - found) < 2 * MARGIN)
    flat = gain[best] > LEAST_HELD and seconds[near].sum() > 0.5 * seconds[up & (height <= found)].sum()
    return float(found) if flat and np.ptp(place[near], axis=0).max() > APART * length_size(arm) else None


def correlations(time: Array, position: Array, command: Array) -> tuple[Array, Array]:
    """Lowest and highest correlation (n, n) over `LAGS` of positions (T, n), in rows, with commands; 0: at rest."""
    period, rows, n = np.median(np.diff(time)), *position.shape
    found = []
    for lag in sorted({round(lag / period) for lag in LAGS}):
        # over little of the log any two smooth motions look alike
        if rows - lag >= max(20, 0.8 * rows):
            moved = np.concatenate([position[lag:], command[: rows - lag]], axis=1)
            moved = moved - moved.mean(axis=0)
            scale = np.linalg.norm(moved, axis=0)
            scale[scale < RESTING * np.sqrt(len(moved))] = np.inf
            found.append((moved.T @ moved / np.outer(scale, scale))[:n, n:])
    if not found:
        return np.zeros((n, n)), np.ones((n, n))
    return np.min(found, axis=0), np.max(found, axis=0)


def unpowered_joints(log: RunLog) -> tuple[str, ...]:
    """Joints that never answer, or are declared without torque."""
    silent = np.isin(log.joint_names, log.extra.get(UNPOWERED, "").split(",")) | _silent([log])
    return tuple(compress(log.joint_names, silent))


def _silent(logs: Sequence[RunLog], alike: float = UNRELATED) -> Mask:
    """Joints (n,) that move less than a tenth of the commands' travel, or not ``alike``, in all logs together."""
    on = [log.rows(np.flatnonzero(~_off(log))) for log in logs]
    told = [log for log in on if log.commanded and log.duration > LAGS[-1]]
    if not told:
        return np.zeros(len(logs[0].joint_names), dtype=bool)
    groups = ([log.position for log in told], [log.command for log in told])
    position, command = (np.concatenate([one - one.mean(axis=0) for one in group]) for group in groups)
    lowest, highest = correlations(told[0].period * np.arange(len(position), dtype=float), position, command)
    answer = np.maximum(-np.diag(lowest), np.diag(highest))
    moved, asked = np.ptp(position, axis=0), np.ptp(command, axis=0)
    return (asked >= ASKED) & ((moved < ANSWERED * asked) | (answer < alike))


def powered(arm: Arm, logs: Sequence[RunLog]) -> list[RunLog]:
    """Cut logs at rows without torque, declare joints that never answer, and end commands where the arm ends.

    InputError for another arm, or where nothing is left.
    """
    found = []
    for log in logs:
        log.require(arm)
    for log in _within_ends(arm, logs):
        edges = np.flatnonzero(np.diff(_off(log), prepend=True, append=True)).reshape(-1, 2).tolist()
        pieces = [log.rows(slice(a, b)) for a, b in edges if b - a > 2]
        for number, piece in enumerate(pieces, start=1):
            label = f"{log.label} ({number})" if len(pieces) > 1 else log.label
            found.append(replace(piece, label=label))
    if not found:
        raise InputError(f"{logs[0].label}: no row in which all joints have torque")
    silent = _silent(found)
    for log in found if silent.any() else ():  # in one log, few goals agree by chance
        silent &= (np.ptp(log.command, axis=0) < ASKED) | _silent([log], ANSWERING)
    if not silent.any():
        return found
    names = list(compress(logs[0].joint_names, silent))
    known = [",".join([*names, log.extra.get(UNPOWERED, "")]) for log in found]
    return [replace(log, extra=log.extra | {UNPOWERED: one}) for log, one in zip(found, known, strict=True)]


def _within_ends(arm: Arm, logs: Sequence[RunLog]) -> list[RunLog]:
    """Hold commands within limits and what was reached, as firmware or a stop does; not where zeros are unknown."""
    reached = np.concatenate([log.position for log in logs])
    low = np.where(arm.endless, -np.inf, np.minimum(arm.lower, reached.min(axis=0)))
    high = np.where(arm.endless, np.inf, np.maximum(arm.upper, reached.max(axis=0)))
    return [log if ZEROS in log.extra else replace(log, command=log.command.clip(low, high)) for log in logs]


def _off(log: RunLog) -> Mask:
    """Rows (T,) without torque of a joint that has it in others, or declared."""
    gain = np.ones_like(log.position) if log.gain is None else log.gain
    return np.asarray(((gain == 0.0) & gain.any(axis=0)).any(axis=1))


def recorded_gain(logs: Sequence[RunLog]) -> Array | None:
    """Largest P gain (n,) that logs record, in the servo's unit; None without any."""
    known = [log.gain.max(axis=0) for log in logs if log.gain is not None and (log.gain.max(axis=0) > 0.0).all()]
    return np.max(known, axis=0) if known else None


def answered(log: RunLog) -> RunLog:
    """Give joints that never answer, or had no torque, their position as command, and declare them."""
    names = unpowered_joints(log)
    command = np.where(np.isin(log.joint_names, names), log.position, log.command)
    return replace(log, command=command, extra=log.extra | {UNPOWERED: ",".join(names)}) if names else log


def free_runs(free: Mask, time: Array, shortest: float) -> list[tuple[int, int]]:
    """Gapless free runs (first, last exclusive) of ``shortest`` [s] or more."""
    if len(time) < 2:
        return []
    gap = np.diff(time) > max(5 * np.median(np.diff(time)), PAUSE)
    breaks = np.flatnonzero(gap | (free[1:] != free[:-1])) + 1
    runs = pairwise([0, *breaks.tolist(), len(time)])
    return [(a, b) for a, b in runs if free[a] and time[b - 1] - time[a] >= shortest]


def _usual_error(logs: Sequence[RunLog]) -> Array:
    """Median error (n,) [rad] where readings change, else 0."""
    rows = [np.flatnonzero(np.diff(log.position, axis=0).any(axis=1)) + 1 for log in logs]
    errors = np.concatenate([np.abs(log.command - log.position)[one] for log, one in zip(logs, rows, strict=True)])
    return np.median(errors, axis=0) if len(errors) else np.zeros(errors.shape[1])


def _stopped(log: RunLog, ends: tuple[Array, Array], usual: Array) -> Mask:
    error = np.where(ends[1] - ends[0] > LEAST_TRAVEL, log.command - log.position, 0.0)
    least = np.maximum(STOP_ERROR, USUAL * usual)
    low = (log.position < ends[0] + STOP_BAND) & (error < -least)
    high = (log.position > ends[1] - STOP_BAND) & (error > least)
    stopped = np.zeros(len(log), dtype=bool)
    for first, last in free_runs((low | high).any(axis=1), log.time, STOP_TIME):
        stopped[first:last] = True
    return stopped


def _stale(log: RunLog, usual: Array) -> Mask:
    still = (np.diff(log.position, axis=0, prepend=np.nan) == 0.0).all(axis=1)
    dead = np.zeros(len(log), dtype=bool)
    for first, last in free_runs(still, log.time, STALE_TIME):
        # A joint may well rest though its command moves; not for long once the command has left it.
        moved = np.abs(log.command[first:last] - log.command[first])
        left = (moved > np.maximum(STALE_MOTION, USUAL * usual)).any(axis=1)
        dead[first:last] = bool(free_runs(left, log.time[first:last], STALE_TIME))
    return dead


def _recovering(time: Array, rows: Mask) -> Mask:
    return time - np.maximum.accumulate(np.where(rows, time, -np.inf)) <= RECOVERY


SPAN = 0.16
"""[s] of a speed at least; chosen: one step of an encoder in it is no motion"""


def joint_speed(time: Array, q: Array) -> Array:
    """(T,) [rad/s] of the fastest joint of ``q`` (T, n) [rad], over nine rows, and at least `SPAN`."""
    return np.abs(velocity(time, q, 4, SPAN)).max(axis=1)


def velocity(time: Array, q: Array, reach: int, span: float = 0.0) -> Array:
    """(T, n) [rad/s] by central differences over ``reach`` rows to either side, and at least ``span`` [s]."""
    rows = np.arange(len(time))
    before = np.minimum(rows - reach, np.searchsorted(time, time - span / 2)).clip(0)
    after = np.maximum(rows + reach, np.searchsorted(time, time + span / 2)).clip(max=len(time) - 1)
    return (q[after] - q[before]) / np.maximum(time[after] - time[before], 1e-9)[:, None]
