"""The loop of `rejoint.control.following`, compiled: every joint of every arm, once per cycle."""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from __future__ import annotations

import numpy as np
from numba import bool_, float64, from_dtype, int64, njit, types, void

HISTORY = 8
"""Commands that are remembered (chosen: 160 ms of the shortest regular period)."""
SETTLE = 0.08
"""[s] after which a command has reached the servo and a reading shows it: latency, a period of 25 ms, age of a reading
and the time in which a worn joint sets off (chosen). Periods above 40 ms take longer, see `AFTER`."""
AFTER = 1
"""Commands that must have been sent after one that has certainly arrived, so that it takes two periods at least: 80 ms
at 25 ms, 100 at 50, and as long as a wire stalls. The clock of a command is that of the reading before it, and one that
is acknowledged late is there only when the next reading is due; once another has followed, joint and servo have had a
period. Two would make blind servos known a period later, and prevented no more false trips by pushes (chosen)."""
STILL = 2
"""Cycles with the same reading after which a joint is taken to stand (chosen: the load is a median of three)."""
STRIKES = 2
"""Cycles in a row in which the load has to disagree by more than `MARGIN` (chosen)."""
PUSHED, UNPUSHED_STRIKES = np.radians(0.3), 4
"""[rad] travel of the command below which it takes more cycles (chosen: a joint that rings about its place, or that
another one shakes, shows one reading by chance for two or three)"""
MARGIN = 0.03
"""Share of the largest torque by which a load may be off for one cycle (chosen: less is quicker, and was not wrong down
to 0.025)"""
SUDDEN, LIGHT = 0.08, np.radians(2.0)
"""Share by which it may not even be for one cycle, in a joint that sticks by less than that [rad]. One that sticks more
is off by far when it breaks loose, one cycle before its reading changes (chosen: light joints with nothing broken
reached 0.05)"""
COUNTS = 1.1
"""Encoder steps by which the servo's own reading may differ from the one told (chosen: dead zone and flicker)."""
STEADY, STEADY_COUNTS = 12, 0.3
"""Cycles for which no flicker stays unseen, and encoder steps by which a reading may then be off (chosen: in 128 runs
with nothing broken loads were off for 8 cycles, and never for 12)"""
STEADY_MARGIN, STEADY_NOISE = 0.002, 2.0
"""Share of the largest torque by which a load may be off for so long, and times its noise that come on top (chosen)"""
NOISE = 0.015
"""Standard deviation of a load that is learned from, share of the largest torque (chosen)."""
SURE = 1.5
"""Standard deviations of the expected load that are allowed for (chosen)."""
KNOWN = 0.5
"""relative error of a gain from which nothing is concluded (chosen)"""
FULL = 0.9
"""Share of the largest torque from which a servo gives all it has (chosen)."""
FULL_CYCLES = 8
"""Cycles of that which show that a joint is stuck: one that turns has no full torque for long (chosen)"""
MOST, AND = 1.5, np.radians(0.2)
"""Times the push at which a joint stood in its own diagnosis, and [rad] on top (or as much again, if that is less), up
to which it may stand (chosen: of 1536 runs at 50 ms with nothing broken three were overdue at 1.4, one at 1.5)"""
LATE = 2
"""Readings in a row that must be the same beyond that (chosen, as `STILL`)"""
PATIENCE = 0.05
"""[s] The excess, summed over time twice, may reach the band times the square of this: 0.07 s at an excess as large as
the band (chosen: in those runs none did; one did with 0.04)"""
LONGEST = 0.1
"""[s] that count for one cycle at most: in a gap nobody knows what was in force (chosen: two slow periods)"""
LEARN_SPREAD = np.radians(0.5)
"""[rad] commands in `SETTLE` may differ by this where a load is learned from (chosen)."""
LEARN_STILL = 4
"""Cycles of stillness after which a load is learned from (chosen)."""
LEARN_LAST = 200
"""Cycles of stillness after which it is not any more: it would say the same again (chosen)."""
TRACK = np.dtype(
    [
        ("position", "f8"), ("held", "f8"), ("since", "f8"), ("travel", "f8"), ("stuck", "f8"),
        ("home", "f8"), ("moved", "f8"),
        ("gain", "f8"), ("least", "f8"), ("offset", "f8"), ("p00", "f8"), ("p01", "f8"), ("p11", "f8"),
        ("load", "f8"), ("load1", "f8"), ("load2", "f8"), ("expected", "f8"),
        ("noise", "f8"), ("reach", "f8"), ("width", "f8"), ("push", "f8"), ("pushed", "f8"), ("due", "f8"),
        ("still", "i8"), ("strikes", "i8"), ("steady", "i8"), ("moves", "i8"), ("full", "i8"), ("late", "i8"),
        ("given", "?"),
    ]
)  # fmt: skip
"""What is remembered of a joint. ``held`` [rad] is the command in force when its reading last changed (at ``since``
[s]), ``travel`` [rad] how far the command has gone from there, ``stuck`` [rad] how far it went before the reading
changed, at most, ``moves`` how often it did, and ``moved`` [rad] how far from ``home``, its first. Standing, it should
tell the load ``gain`` * (command - position) + ``offset``, known with the covariance ``p``, and ``noise`` [share of the
largest torque] about it; a gain below ``least`` is
not learned, or a joint that turns slowly would teach its own. Only a gain that was ``given`` beforehand tells of joints
that turn: one learned from nothing says too little. Leads beyond ``reach`` [rad] push no harder; ``width`` [rad] is the
push at which the joint stood in its diagnosis (infinite: not known), ``push`` the present one. For ``late`` readings it
has been beyond what is allowed, the excess summed over time once is ``pushed`` [rad s] and twice ``due`` [rad s^2]."""

FINE, STANDING, UNKNOWN, TURNING, OVERDUE = range(5)
"""Verdicts: the reading changes; it stands, and by its load the joint does; it stands, and no load tells; it stands,
and by its load the joint does not; it stands, and by its push the joint cannot."""

_TRACKS = types.Array(from_dtype(TRACK), 2, "C")
_IN1, _IN2 = (types.Array(float64, dimensions, "C", readonly=True) for dimensions in (1, 2))
_OPTIONS = {"cache": True, "nogil": True, "boundscheck": True}


@njit(cache=True)
def _follow(track, now, position, command):  # noqa: ANN001, ANN202
    if position == track.position:
        track.still += 1
        track.travel = command - track.held
        return
    track.stuck = max(track.stuck, abs(track.travel))
    track.moves += 1
    track.moved = max(track.moved, abs(position - track.home))
    track.position, track.held, track.since, track.travel = position, command, now, 0.0
    track.still = track.strikes = track.steady = track.full = 0


@njit(cache=True)
def _learn(track, lead, spread):  # noqa: ANN001, ANN202
    """Recursive least squares of load = gain * lead + offset, where the lead lies anywhere within ``spread`` [rad]."""
    a, b = track.p00 * lead + track.p01, track.p01 * lead + track.p11
    wrong = track.load - track.gain * lead - track.offset
    unsure = track.gain * spread
    share = NOISE * NOISE + unsure * unsure / 12.0 + lead * a + b
    track.gain = max(track.gain + a * wrong / share, track.least)
    track.offset += b * wrong / share
    track.p00 -= a * a / share
    track.p01 -= a * b / share
    track.p11 -= b * b / share


@njit(cache=True)
def _judge(track, told, low, high, step):  # noqa: ANN001, ANN202
    """Compare the load ``told`` of a joint that stands with what its servo must give at leads from ``low`` to ``high``.

    What is shown and learned from is the median of three loads instead.
    """
    lead = 0.5 * (low + high)
    unsure = SURE * np.sqrt(track.p00 * lead * lead + 2.0 * track.p01 * lead + track.p11)
    least = min(max(track.gain * low + track.offset, -1.0), 1.0)
    most = min(max(track.gain * high + track.offset, -1.0), 1.0)
    if low < COUNTS * step:  # the dead zone of the servo
        least = min(least, 0.0)
    if high > -COUNTS * step:
        most = max(most, 0.0)
    track.expected = 0.5 * (least + most)
    known = SURE * np.sqrt(track.p00) < KNOWN * track.gain
    agrees = max(least - track.load, track.load - most) <= MARGIN + COUNTS * step * track.gain + unsure
    telling = high - low < LEARN_SPREAD and abs(lead) > COUNTS * step and abs(track.load) < FULL
    if (agrees or not known) and telling and LEARN_STILL <= track.still <= LEARN_LAST:
        _learn(track, lead, high - low)
    if track.given:
        if _turns(track, max(least - told, told - most) - unsure, step):
            return TURNING
    else:
        track.strikes = 0 if agrees else track.strikes + 1
    if abs(track.load) >= FULL and track.load * lead > 0.0:
        track.full += 1
        return STANDING
    explained = known and (track.given or track.strikes < STRIKES)  # one that breaks loose disagrees for a cycle
    return STANDING if explained or track.full >= FULL_CYCLES else UNKNOWN


@njit(cache=True)
def _turns(track, off, step):  # noqa: ANN001, ANN202
    """Whether a load that is ``off`` by what standing does not explain, now and before, says that the joint turns."""
    reading = step * track.gain
    track.strikes = track.strikes + 1 if off > MARGIN + COUNTS * reading else 0
    steady = off > STEADY_MARGIN + STEADY_NOISE * track.noise + STEADY_COUNTS * reading
    track.steady = track.steady + 1 if steady else 0
    if abs(track.travel) > PUSHED:
        sudden = off > SUDDEN + COUNTS * reading and track.stuck < LIGHT
        return sudden or track.strikes >= STRIKES or track.steady >= STEADY
    return track.strikes >= UNPUSHED_STRIKES or track.steady >= STEADY


@njit(cache=True)
def _push(low, high, balance, reach):  # noqa: ANN001, ANN202
    """By how much [rad] leads anywhere from ``low`` to ``high`` certainly push a joint from its ``balance``."""
    least = min(max(low, -reach), reach) - balance
    most = min(max(high, -reach), reach) - balance
    return max(least, 0.0) + min(most, 0.0)


@njit(cache=True)
def _overdue(track, elapsed):  # noqa: ANN001, ANN202
    """Whether a joint that stands must long have moved under its push, now and for some time.

    A push beyond what it stands accelerates a joint, so that the excess, summed twice, is how far it would have gone.
    """
    beyond = abs(track.push) - MOST * track.width - min(AND, track.width)
    if track.still == 0 or not beyond > 0.0:
        track.late, track.pushed, track.due = 0, 0.0, 0.0
        return False
    elapsed = min(elapsed, LONGEST) if track.late > 0 else 0.0  # it may have begun at this very reading
    track.late += 1
    track.due += (track.pushed + 0.5 * beyond * elapsed) * elapsed
    track.pushed += beyond * elapsed
    return track.late >= LATE and track.due > track.width * PATIENCE * PATIENCE


@njit(void(_IN2, _IN2, _IN2, _IN1, float64[:, ::1]), **_OPTIONS)
def fill_pushes(low, high, balance, reach, out):  # noqa: ANN001, ANN201
    """Fill ``out`` (T, n) [rad] with the pushes at leads from ``low`` to ``high`` (T, n) [rad]; ``reach`` is (n,)."""
    for k in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[k, j] = _push(low[k, j], high[k, j], balance[k, j], reach[j])


@njit(void(from_dtype(TRACK)[::1], _IN1, _IN2, _IN2, bool_[::1]), **_OPTIONS)
def fill_overdue(tracks, time, position, push, out):  # noqa: ANN001, ANN201
    """Tell in ``out`` (n,) which joints are overdue somewhere in a log of ``time`` (T,) and ``position`` (T, n)."""
    for j in range(len(tracks)):
        track = tracks[j]
        for k in range(1, len(time)):
            track.still = track.still + 1 if position[k, j] == position[k - 1, j] else 0
            track.push = push[k, j]
            if _overdue(track, time[k] - time[k - 1]):
                out[j] = True


@njit(cache=True)
def _by_load(track, load, loaded, unsettled, low, high, step):  # noqa: ANN001, ANN202
    """Judge a joint by its encoder, and by the ``load`` that its servo told, if ``loaded``."""
    stands = track.still >= STILL
    if not loaded:
        return UNKNOWN if stands else FINE
    if unsettled or np.isnan(load):
        return UNKNOWN if stands and not track.given else STANDING if stands else FINE
    median = max(min(load, track.load1), min(max(load, track.load1), track.load2))
    track.load2, track.load1, track.load = track.load1, load, median
    return _judge(track, load, low, high, step) if stands else FINE


@njit(void(_TRACKS, float64[:, ::1], float64[:, :, ::1], _IN1, _IN1, _IN2, _IN2, _IN2, bool_, _IN2, float64,
           int64[:, ::1]), **_OPTIONS)  # fmt: skip
def watch(tracks, sent_at, sent, now, last, position, command, load, loaded, balance, step, verdict):  # noqa: ANN001, ANN201
    """Take over a reading and give a ``verdict`` (B, n) on every joint.

    ``sent_at`` (B, HISTORY) [s] and ``sent`` (B, HISTORY, n) [rad], newest first, take over ``command`` (B, n), which
    was sent at the clock ``last`` (B,); ``now`` (B,) is that of the reading ``position`` (B, n), ``load`` (B, n) what
    its servos told if ``loaded`` (NaN where they did not), ``balance`` (B, n) [rad] the leads that hold the arm against
    gravity, and ``step`` [rad] that of the encoders. A repeated answer says nothing new. Where a line was given, the
    load alone decides.
    """
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
            _follow(track, now[i], position[i, j], sent[i, reach, j])
            verdict[i, j] = _by_load(track, load[i, j], loaded, unsettled, low, high, step)
            if unsettled or (loaded and track.given and not np.isnan(load[i, j])):
                continue
            track.push = _push(low, high, balance[i, j], track.reach)
            if _overdue(track, now[i] - last[i]):
                verdict[i, j] = OVERDUE
