"""The pushes at which the joints of an arm stand, read from logs of its own motion.

A servo turns its joint by the lead: command minus reading. Part of it, the balance, holds the arm against gravity; what
is left is the push. Dry friction holds a joint up to some push, and that makes a band about the balance: inside it a
joint may stand, outside it has to move. Where the balance lies is fitted to the slow motion of the joint, in both
directions, since friction then takes as much one way as it does the other; how wide the band is, is the largest push
at which the joint ever stood for `HELD`. A weak servo gives no more beyond some lead, and its joint may stand
at any: the reach is put where the band is narrowest for what the servo can push.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, gravity_torque
from rejoint.control.following import Bands
from rejoint.control.law import plain
from rejoint.control.lines import PER_MEDIAN, commands_in_force
from rejoint.logs.runlog import RunLog
from rejoint.system.late import Late

watching = Late("rejoint.control.watching")

HELD = 0.05
"""[s] for which a push must have lasted, at least from one reading to the next (chosen: longer than one that crosses
the band on its way, shorter than a joint stands before it breaks loose in a sweep)"""
FEWEST = 100
"""rows in motion from which a balance is fitted (chosen: two and a half seconds at 25 ms)"""
SLOWEST, FASTEST = 0.04, 0.4
"""[rad/s] between which a joint counts as in slow motion (chosen: above what a flickering reading shows, and at most
what a lead of some degrees is not needed for)"""
AVERAGED = 5
"""rows over which a speed is averaged (chosen: an encoder step in 25 ms is 0.06 rad/s)"""
LEAST_GRAVITY = 0.04
"""of the range of the joint with the most, what the gravity torque of a joint must range to be fitted (chosen)"""
HUBER, _ROUNDS = 2.0, 20
"""Residuals, in robust standard deviations, from which a row counts for less (chosen), and rounds of reweighting"""
REACHES = np.radians(np.geomspace(0.3, 20.0, 30))
"""[rad] reaches that are tried, up to the guard's longest lead (chosen)"""
WIDER, _OFTEN = 1.25, 12
"""times as wide is a band made in whose own logs a joint would be overdue (chosen), and how often at most"""


def standing_bands(arm: Arm, logs: Sequence[RunLog]) -> Bands:
    """Read what ``logs`` of an arm tell of the pushes at which its joints stand.

    The band of a joint that hardly moved in them is not known. None of these logs has an overdue joint by it.
    """
    slope, offset, known = _balances(arm, logs)
    found = Bands(slope=slope, offset=offset, reach=np.full(arm.joints, np.inf), width=np.full(arm.joints, np.inf))
    if not known.any():
        return found
    leads = [_leads(log, found.balance(arm, log.position)) for log in logs]
    reach, width = _narrowest(arm, logs, leads)
    width = np.where(known, width, np.inf)
    for _ in range(_OFTEN):
        late = np.zeros(arm.joints, dtype=bool)
        for log, lead in zip(logs, leads, strict=True):
            late |= _overdue(log, _push(lead, reach), width)
        if not late.any():
            break
        width = np.where(late, WIDER * width, width)
    return Bands(slope=slope, offset=offset, reach=reach, width=np.where(late, np.inf, width))


Leads = tuple[Array, Array, Array]
"""Lowest and highest lead (T, n) [rad] of those that may be in force at each row, and the balance"""


def _leads(log: RunLog, balance: Array) -> Leads:
    low, high = commands_in_force(log)
    return low - log.position, high - log.position, balance


def _push(leads: Leads, reach: Array) -> Array:
    low, high, balance = (plain(array) for array in leads)
    push = np.empty_like(low)
    watching.fill_pushes(low, high, balance, reach, push)
    return push


def _balances(arm: Arm, logs: Sequence[RunLog]) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Slope (n,) [rad/(N m)] and offset (n,) [rad] of the balance, and for which joints (n,) they are known."""
    slope, offset, known = np.zeros(arm.joints), np.zeros(arm.joints), np.zeros(arm.joints, dtype=bool)
    if not logs:
        return slope, offset, known
    parts = [_in_motion(arm, log) for log in logs]
    lead, gravity, speed, moving = (np.concatenate([part[k] for part in parts]) for k in range(4))
    loaded = np.ptp(gravity, axis=0) > LEAST_GRAVITY * np.ptp(gravity, axis=0).max()
    for j in range(arm.joints):
        use = moving[:, j].astype(bool)
        known[j] = np.count_nonzero(use) >= FEWEST
        if known[j]:
            columns = [loaded[j] * gravity[use, j], np.ones(use.sum()), np.sign(speed[use, j]), speed[use, j]]
            slope[j], offset[j] = _fit(np.stack(columns, axis=-1), lead[use, j])[:2]
    return np.where(loaded, slope, 0.0), offset, known


def _in_motion(arm: Arm, log: RunLog) -> tuple[Array, Array, Array, Array]:
    """Mean lead, gravity torque, speed (T, n), and where the joints are in slow motion (1 or 0)."""
    low, high = commands_in_force(log)
    if len(log) < AVERAGED:
        nothing = np.empty((0, arm.joints))
        return nothing, nothing, nothing, nothing
    speed = np.gradient(log.position, log.time, axis=0)
    mean = np.ones(AVERAGED) / AVERAGED
    speed = np.stack([np.convolve(speed[:, j], mean, "same") for j in range(arm.joints)], axis=-1)
    slow = (np.abs(speed) > SLOWEST) & (np.abs(speed) < FASTEST)
    return 0.5 * (low + high) - log.position, gravity_torque(arm, log.position), speed, slow.astype(float)


def _fit(columns: Array, value: Array) -> Array:
    """Coefficients of ``columns`` (N, k) for ``value`` (N,), robustly."""
    weight = np.ones_like(value)
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)
        found = np.linalg.lstsq(columns * root[:, None], value * root)[0]
        off = np.abs(value - columns @ found)
        noise = max(PER_MEDIAN * float(np.median(off)), 1e-6)
        weight = np.minimum(1.0, HUBER * noise / np.maximum(off, 1e-12))
    return np.asarray(found)


def _narrowest(arm: Arm, logs: Sequence[RunLog], leads: Sequence[Leads]) -> tuple[Array, Array]:
    """Reach and width (n,) [rad] of the bands that are narrowest for what the servos can push."""
    best, reach, width = np.zeros(arm.joints), np.full(arm.joints, np.inf), np.full(arm.joints, np.inf)
    for tried in REACHES:
        both = [_held(log, _push(lead, np.full(arm.joints, tried))) for log, lead in zip(logs, leads, strict=True)]
        found = np.maximum(np.max(both, axis=0), arm.encoder_step)
        better = tried / found >= best
        best = np.where(better, tried / found, best)
        reach, width = np.where(better, tried, reach), np.where(better, found, width)
    return reach, width


def _held(log: RunLog, push: Array) -> Array:
    """Largest push (n,) [rad] at which joints stood for `HELD`."""
    readings = 1 + max(1, round(HELD / float(np.median(np.diff(log.time))))) if len(log) > 1 else 1
    if len(log) <= readings:
        return np.zeros(push.shape[1])
    stands = np.vstack([np.zeros((1, push.shape[1]), dtype=bool), np.diff(log.position, axis=0) == 0.0])
    windows = np.lib.stride_tricks.sliding_window_view(np.where(stands, push, 0.0), readings, axis=0)
    return np.asarray(np.maximum(windows.min(axis=-1), -windows.max(axis=-1)).max(axis=0))


def _overdue(log: RunLog, push: Array, width: Array) -> NDArray[np.bool_]:
    """Joints (n,) that would be overdue somewhere in a log."""
    tracks, found = np.zeros(len(width), watching.TRACK), np.zeros(len(width), dtype=bool)
    tracks["width"] = width
    watching.fill_overdue(tracks, plain(log.time), plain(log.position), plain(push), found)
    return found
