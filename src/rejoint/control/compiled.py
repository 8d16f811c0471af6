"""Compiled loops of the joint monitor.

Arrays are contiguous float64. Constants without a source are chosen.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from __future__ import annotations

import numpy as np
from numba import float64, from_dtype, int64, njit, types, void

from rejoint.arms.compiled import IN2, IN3, OUT3, compiled

HISTORY = 8
"""Stored commands (chosen: 160 ms at the shortest period)"""
SETTLE = 0.08
"""[s] from a command to a reading that shows it"""
AFTER = 1
"""Commands after one that has arrived"""
STILL = 2
"""Equal readings of a stationary joint"""
LEAST_GAIN, FULL = 3.0, 0.9
"""[1/rad] Growth of a load with its command that shows a stuck joint, and most of the torque"""
MOST, AND = 1.5, np.radians(0.2)
"""Allowed multiple of the largest push in the diagnosis, plus [rad]"""
LATE = 2
"""Readings in a row beyond it"""
PATIENCE = 0.05
"""[s] The excess, integrated twice, may reach the band times its square"""
LONGEST = 0.1
"""[s] longest counted cycle"""
TRACK = np.dtype(
    [
        ("position", "f8"), ("held", "f8"), ("since", "f8"), ("travel", "f8"), ("stuck", "f8"),
        ("home", "f8"), ("moved", "f8"),
        ("before", "f8"), ("reach", "f8"), ("width", "f8"), ("push", "f8"), ("pushed", "f8"), ("due", "f8"),
        ("still", "i8"), ("moves", "i8"), ("late", "i8"),
    ]
)  # fmt: skip
"""State of a joint. ``held`` [rad]: command at the last change of the reading, at ``since`` [s]. ``travel`` [rad]:
command travel since then; ``stuck``: its largest value before a change. ``moves``: changes; ``moved`` [rad] from
``home``. ``before``: load at the last change of the reading. Following errors beyond ``reach`` [rad] push no harder.
``width`` and ``push`` [rad]: largest push in the diagnosis, and now. ``late``: readings beyond it; ``pushed`` [rad s],
``due`` [rad s^2]: integrals of the excess."""

FINE, UNKNOWN, OVERDUE = range(3)
"""Verdicts: nothing to doubt; stationary, nothing tells why; overdue by push"""

_TRACKS = types.Array(from_dtype(TRACK), 2, "C")


@njit(cache=True)
def _follow(track, now, position, command, load):  # noqa: ANN001, ANN202
    if position == track.position:
        track.still += 1
        track.travel = command - track.held
        return
    track.stuck = max(track.stuck, abs(track.travel))
    track.moves += 1
    track.moved = max(track.moved, abs(position - track.home))
    track.position, track.held, track.since, track.travel, track.before = position, command, now, 0.0, load
    track.still = 0


@njit(cache=True)
def _push(low, high, balance, reach):  # noqa: ANN001, ANN202
    """Least push [rad] away from ``balance`` of leads from ``low`` to ``high``."""
    least = min(max(low, -reach), reach) - balance
    most = min(max(high, -reach), reach) - balance
    return max(least, 0.0) + min(most, 0.0)


@njit(cache=True)
def _overdue(track, elapsed):  # noqa: ANN001, ANN202
    beyond = abs(track.push) - MOST * track.width - min(AND, track.width)
    if track.still == 0 or not beyond > 0.0:
        track.late, track.pushed, track.due = 0, 0.0, 0.0
        return False
    elapsed = min(elapsed, LONGEST) if track.late > 0 else 0.0  # it may have begun at this very reading
    track.late += 1
    track.due += (track.pushed + 0.5 * beyond * elapsed) * elapsed
    track.pushed += beyond * elapsed
    return track.late >= LATE and track.due > track.width * PATIENCE * PATIENCE


@compiled(void(_TRACKS, float64[:, ::1], OUT3, IN2, IN3, int64[:, ::1]), boundscheck=True)
def watch(tracks, sent_at, sent, clock, reading, verdict):  # noqa: ANN001, ANN201
    """Take a reading and give a ``verdict`` (B, n).

    ``clock`` (2, B) [s]: now, and time of the command. ``reading`` (4, B, n): position and command [rad], load (NaN:
    none), following error against gravity [rad]. ``sent_at`` (B, HISTORY) [s] and ``sent`` (B, HISTORY, n) [rad],
    newest first, receive the command.
    """
    now, last, position, command, load, balance = clock[0], clock[1], reading[0], reading[1], reading[2], reading[3]
    arms, joints = position.shape
    for i in range(arms):
        if now[i] <= last[i]:
            continue
        for h in range(HISTORY - 1, 0, -1):
            sent_at[i, h] = sent_at[i, h - 1]
            sent[i, h] = sent[i, h - 1]
        sent_at[i, 0] = last[i]
        sent[i, 0] = command[i]
        reach = 0  # the newest command that has certainly arrived
        while reach < HISTORY - 1 and (reach < AFTER or sent_at[i, reach] > now[i] - SETTLE):
            reach += 1
        unsettled = sent_at[i, reach] > now[i] - SETTLE  # what was in force before the first command is not sure
        for j in range(joints):
            low = high = sent[i, reach, j]
            for h in range(reach):
                low, high = min(low, sent[i, h, j]), max(high, sent[i, h, j])
            low, high = low - position[i, j], high - position[i, j]
            track = tracks[i, j]
            _follow(track, now[i], position[i, j], sent[i, reach, j], load[i, j])
            stands = track.still >= STILL
            grown = (load[i, j] - track.before) * np.sign(track.travel)  # NaN: no load
            pushes = grown >= LEAST_GAIN * abs(track.travel) or load[i, j] * np.sign(track.travel) >= FULL
            verdict[i, j] = UNKNOWN if stands and not pushes else FINE
            if unsettled:
                continue
            track.push = _push(low, high, balance[i, j], track.reach)
            if _overdue(track, now[i] - last[i]):
                verdict[i, j] = OVERDUE
