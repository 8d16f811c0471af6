"""Compiled loops of the joint monitor, and of the guard, for one arm and for batches.

Arrays are contiguous float64. Constants without a source are chosen.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
import numpy as np
from numba import float64, from_dtype, int64, njit, types, uint16, void

from rejoint.arms.compiled import CHAIN, IN1, IN2, IN3, OUT1, OUT3, SHAPE, along, compiled, fill, gaps, inner, place
from rejoint.control.guard import MAX_AGE, MAX_LEAD, MAX_PERIOD, RANGE_MARGIN, Reason, Rules

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
_MEASURES = "position held since travel stuck home moved before reach width push pushed due"
_COUNTS = "still moves late"
TRACK = np.dtype([(name, "f8") for name in _MEASURES.split()] + [(name, "i8") for name in _COUNTS.split()])
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
def push(low, high, balance, reach):  # noqa: ANN001, ANN201
    """Least push [rad] away from ``balance`` of leads from ``low`` to ``high``."""
    least = np.minimum(np.maximum(low, -reach), reach) - balance
    most = np.minimum(np.maximum(high, -reach), reach) - balance
    return np.maximum(least, 0.0) + np.minimum(most, 0.0)


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
            fill(sent[i, h], sent[i, h - 1])
        sent_at[i, 0] = last[i]
        fill(sent[i, 0], command[i])
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
            track.push = push(low, high, balance[i, j], track.reach)
            if _overdue(track, now[i] - last[i]):
                verdict[i, j] = OVERDUE


RULES = types.NamedTuple((*[IN1] * 5, int64), Rules)

TOLERANCE = 1e-9
"""[m] rounding of the kinematics: a joint that cannot move must not look sinking"""
FOLLOWS = np.radians(1.0)
"""[rad] off the last command within which an arm follows (chosen)"""
APPROACH, CLOSING, WATCHED, SHORTEST = 1e-6, 0.25, 0.03, 0.1
"""[m] by which a step may always bring measured bodies nearer; share of the rest to the least distance that it may
take; [m] to it from which steps are looked at; share of a step below which there is none (chosen)"""


@inner
def _between(value, low, high):  # noqa: ANN001, ANN202
    return min(max(value, low), high)


@inner
def _trips(chain, asked, age):  # noqa: ANN001, ANN202
    """Flag what must stop an arm; ``asked`` (4, n) as in `guard`."""
    found = 0 if age <= MAX_AGE else Reason.STALE.value  # NaN counts as stale
    for j in range(asked.shape[1]):
        for k in range(4):
            found |= 0 if np.isfinite(asked[k, j]) else Reason.NOT_FINITE.value
        position, lower, upper = asked[3, j], chain.limits[0, j], chain.limits[1, j]
        if np.isfinite(position) and not lower - RANGE_MARGIN <= position <= upper + RANGE_MARGIN:
            found |= Reason.OUT_OF_RANGE.value
    return found


@inner
def _hold(chain, rules, asked, out):  # noqa: ANN001, ANN202
    """Fill ``out`` (n,) with the last command, or what is known of it."""
    for j in range(len(out)):
        sent, position = asked[1, j], asked[3, j]
        known = _between(position, rules.lower[j], rules.upper[j]) if np.isfinite(position) else chain.rest[j]
        out[j] = sent if np.isfinite(sent) else known


@inner
def _limit(rules, asked, elapsed, out):  # noqa: ANN001, ANN202
    """Fill ``out`` (n,) with the command limited by lead, position, step and acceleration; returns their flags."""
    found = 0
    for j in range(len(out)):
        command, last, speed, position = asked[0, j], asked[1, j], asked[2, j], asked[3, j]
        near = _between(command, position - MAX_LEAD, position + MAX_LEAD)
        legal = _between(near, rules.lower[j], rules.upper[j])
        reach, way, gain = rules.max_speed[j] * elapsed, speed * elapsed, 0.0
        step = _between(legal, last - reach, last + reach)
        if elapsed > 0.0:  # an endless acceleration in no time is no number
            gain = rules.max_acceleration[j] * elapsed * elapsed
        out[j] = _between(step, last + min(way - gain, 0.0), last + max(way + gain, 0.0))
        found |= Reason.LEAD.value * (near != command) | Reason.POSITION.value * (legal != near)
        found |= Reason.STEP.value * (step != legal) | Reason.ACCELERATION.value * (out[j] != step)
    return found


@inner
def _keeps(clear, least):  # noqa: ANN001, ANN202
    """Whether no clearance (c,) is less than its ``least``."""
    kept = True
    for c in range(len(clear)):
        kept &= clear[c] >= least[c]
    return kept


@compiled(int64(CHAIN, SHAPE, RULES, IN1, IN1, OUT1))
def shorten(chain, shape, rules, last, clear, out):  # noqa: ANN001, ANN201
    """Shorten the step from ``last`` to ``out`` (n,), with ``clear`` (c,) there, until it is clear; returns flags.

    No clearance may become negative, or more so.
    """
    least = gaps(place(chain, last), shape)
    for c in range(len(least)):
        least[c] = least[c] - TOLERANCE if least[c] < 0.0 else 0.0
    if _keeps(clear, least):
        return 0
    tried, found, k = np.empty(len(out)), 0, 0
    while found == 0:
        k += 1
        along(last, out, k / rules.parts, tried)
        there = clear if k == rules.parts else gaps(place(chain, tried), shape)
        for c in range(len(least)):
            if there[c] < least[c]:
                found |= Reason.FLOOR.value if c < len(out) else Reason.COLLISION.value
    along(last, out, (k - 1) / rules.parts, out)
    return found


@inner
def _keep_away(chain, shape, rules, asked, out):  # noqa: ANN001, ANN202
    """Shorten steps to ``out`` (n,) that bring the measured arm too near to something, or too fast; returns flags.

    A step takes at most `CLOSING` of the distance that is left (a discrete control barrier: Agrawal and Sreenath 2017);
    each joint alone, since others may be stuck. ``asked`` (4, n).
    """
    last, position, found, off, wide = asked[1], asked[3], 0, 0.0, True
    for j in range(len(out)):
        off = max(off, abs(position[j] - last[j]))
    if off < FOLLOWS:  # the commanded posture tells
        return found
    here, moved = gaps(place(chain, position), shape), np.empty((2, len(out)))
    as_far, least, least_ahead = np.empty(len(here)), np.empty(len(here)), np.empty(len(here))
    for c in range(len(here)):
        near = rules.near[c]
        wide, as_far[c] = wide and here[c] > near + WATCHED, here[c] - APPROACH
        least[c], least_ahead[c] = min(as_far[c], here[c] - CLOSING * (here[c] - near)), min(here[c], near)
    if wide:
        return found
    for j in range(len(out)):
        fill(moved[0], position)
        fill(moved[1], position)
        share = 1.0
        while share > 0.0:
            step = share * (out[j] - last[j])
            moved[0, j], moved[1, j] = position[j] + step, last[j] + step
            there, ahead = gaps(place(chain, moved[0]), shape), gaps(place(chain, moved[1]), shape)
            if _keeps(there, as_far) or (_keeps(there, least) and _keeps(ahead, least_ahead)):
                break
            share = 0.5 * share if share > SHORTEST else 0.0
        if share < 1.0:
            out[j], found = last[j] + share * (out[j] - last[j]), Reason.COLLISION.value
    return found


@compiled(void(CHAIN, SHAPE, RULES, IN3, IN2, uint16[::1], OUT3))
def guard(chain, shape, rules, asked, times, reasons, out):  # noqa: ANN001, ANN201
    """Fill ``out`` (2, B, n) with commands and their speeds, and add to ``reasons`` (B,), which begin with trips.

    ``asked`` (B, 4, n): command, last command and its speed, position. ``times`` (2, B) [s]: ages and periods.
    """
    for b in range(len(asked)):
        command, last = out[0, b], asked[b, 1]
        out[1, b] = 0.0
        reasons[b] |= _trips(chain, asked[b], times[0, b])
        if reasons[b]:
            _hold(chain, rules, asked[b], command)
            continue
        elapsed = min(times[1, b], MAX_PERIOD) if times[1, b] > 0.0 else 0.0  # NaN counts as no time
        found = _limit(rules, asked[b], elapsed, command)
        found |= _keep_away(chain, shape, rules, asked[b], command)
        clear, touches = gaps(place(chain, command), shape), False
        for c in range(len(clear)):
            touches |= clear[c] < 0.0
        if touches:
            found |= shorten(chain, shape, rules, last, clear, command)
        for j in range(len(last)):
            if command[j] != asked[b, 0, j]:
                reasons[b] = found
            if elapsed > 0.0:
                speed = (command[j] - last[j]) / elapsed
                out[1, b, j] = _between(speed, -rules.max_speed[j], rules.max_speed[j])
