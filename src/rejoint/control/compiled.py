"""The loops of one control step, compiled: on six numbers, each call of NumPy costs more than what it computes.

They give to the bit what NumPy gives element by element. All arrays are contiguous, of float64 unless said otherwise.
Signatures are given, so that everything is compiled, or read from disk, when this module is imported: no control cycle
may wait for it. Arrays too short for the others end in an IndexError.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from __future__ import annotations

import numpy as np
from numba import bool_, float64, int64, njit, types, void

IN1, IN2 = (types.Array(float64, dimensions, "C", readonly=True) for dimensions in (1, 2))
ROWS = types.Array(int64, 1, "C", readonly=True)
OUT1, OUT2, OUT3 = float64[::1], float64[:, ::1], float64[:, :, ::1]

OPTIONS = {"cache": True, "nogil": True, "boundscheck": True}


@njit(void(ROWS, IN1, IN2, OUT1, OUT2, OUT3, OUT1, float64, float64), **OPTIONS)
def differentiate(rows, time, position, last_time, last_position, velocity, period, longest, smoothing):  # noqa: ANN001, ANN201
    """Take over the measurements of the arms ``rows`` (m,): ``time`` (m,) [s] and ``position`` (m, n) [rad].

    ``last_time`` (B,), ``last_position`` (B, n), ``velocity`` (B, h, n) with the newest first and the running mean
    ``period`` (B,) are brought up to date. A repeated answer (no time has passed) says nothing new: velocities stand.
    """
    joints, kept = position.shape[1], velocity.shape[1]
    for k in range(len(rows)):
        i = rows[k]
        elapsed = time[k] - last_time[i]
        if elapsed > 0.0:
            for h in range(kept - 1, 0, -1):
                for j in range(joints):
                    velocity[i, h, j] = velocity[i, h - 1, j]
            for j in range(joints):
                velocity[i, 0, j] = (position[k, j] - last_position[i, j]) / elapsed
            period[i] += smoothing * (min(elapsed, longest) - period[i])
        last_time[i] = time[k]
        for j in range(joints):
            last_position[i, j] = position[k, j]


@njit(void(OUT3, *[IN2, IN2, IN1, IN2, IN1, IN1], *[float64] * 6), **OPTIONS)
def weigh(out, step, error, distance, action, moves, spared, floor, slope, most, step_limit, fade, near):  # noqa: ANN001, ANN201
    """Fill ``out`` (2, B, n) with the part of the damped least-squares ``step`` (B, n) to integrate, and the action's.

    The step is that of `clip_norm` to ``step_limit``, fades with the TCP ``error`` (B, 3) as by `fade`, and within
    ``near`` of the target, at a ``distance`` (B,), leaves joints alone by their share ``spared`` (n,). The ``action``
    (B, n), in [-1, 1], counts as much as `CommandLaw.authority` says (``floor``, ``slope``, ``most``), on joints that
    move the tool (``moves`` (n,), 1 or 0).
    """
    arms, joints = step.shape
    for i in range(arms):
        largest, square = 0.0, 0.0
        for j in range(joints):
            largest = np.maximum(largest, abs(step[i, j]))
        for axis in range(3):
            square += error[i, axis] * error[i, axis]
        size = np.sqrt(square)
        faded, whole = size / (size + fade), np.minimum(1.0, step_limit / np.maximum(largest, 1e-12))
        authority = np.minimum(floor + slope * largest, most)
        ratio = distance[i] / near
        close = 1.0 / (1.0 + ratio * ratio)
        for j in range(joints):
            out[0, i, j] = faded * (step[i, j] * whole) * (1.0 - close * spared[j])
            out[1, i, j] = authority * moves[j] * np.minimum(np.maximum(action[i, j], -1.0), 1.0)


@njit(void(OUT2, OUT2, OUT2, IN2, IN1, IN2, IN2, float64, float64, float64, float64), **OPTIONS)
def integrate(correction, speed, last, position, elapsed, step, extra, rate, limit, moving, smoothing):  # noqa: ANN001, ANN201
    """Add ``rate * elapsed * step`` to ``correction`` where joints are not on their way, and ``extra`` everywhere.

    All (B, n) but ``elapsed`` (B,); ``correction`` is kept within +-``limit``, and the estimate of the ``speed`` and
    the ``last`` position are brought up to date.
    """
    arms, joints = correction.shape
    for i in range(arms):
        for j in range(joints):
            newest = (position[i, j] - last[i, j]) / elapsed[i] if elapsed[i] > 0.0 else speed[i, j]
            now = smoothing * newest + (1.0 - smoothing) * speed[i, j]
            push = rate * elapsed[i] * step[i, j]
            if abs(now) > moving and now * push > 0.0:
                push = 0.0
            speed[i, j], last[i, j] = now, position[i, j]
            correction[i, j] = np.minimum(np.maximum(correction[i, j] + push + extra[i, j], -limit), limit)


@njit(void(OUT3, *[IN2] * 3, *[IN1] * 5, float64), **OPTIONS)
def limit(stages, measured, last, speed, elapsed, fastest, acceleration, lower, upper, lead):  # noqa: ANN001, ANN201
    """Fill ``stages`` (5, B, n), whose first is what is wanted, with what each limit leaves of it.

    These are lead, position, step and acceleration. ``last`` (B, n) was sent with the ``speed`` (B, n), ``elapsed``
    (1 or B,) [s] ago; ``fastest``, ``acceleration``, ``lower`` and ``upper`` are (n,), and ``lead`` is the largest
    distance from ``measured`` (B, n). The last command itself is within step and acceleration, whatever its speed.
    """
    _, arms, joints = stages.shape
    for i in range(arms):
        time = elapsed[i % len(elapsed)]
        for j in range(joints):
            near = min(max(stages[0, i, j], measured[i, j] - lead), measured[i, j] + lead)
            legal = min(max(near, lower[j]), upper[j])
            reach = fastest[j] * time
            step = min(max(legal, last[i, j] - reach), last[i, j] + reach)
            gain = acceleration[j] * time * time if time > 0.0 else 0.0
            way = speed[i, j] * time
            stages[1, i, j], stages[2, i, j], stages[3, i, j] = near, legal, step
            stages[4, i, j] = min(max(step, last[i, j] + min(way - gain, 0.0)), last[i, j] + max(way + gain, 0.0))


@njit(void(OUT2, bool_[:, ::1], IN2, IN2, OUT3, float64), **OPTIONS)
def shorten(command, why, start, way, clear, tolerance):  # noqa: ANN001, ANN201
    """Take ``command`` (B, n) back to where, from ``start`` (B, n) along ``way`` (B, n), it is still clear enough.

    ``clear`` (B, S, n + c) are clearances at S equal shares of the way, from none to all of it. None may become
    negative, or more so by the ``tolerance``. A command that ends well stays; else ``why`` (2, B) tells whether one of
    the first n or one of the others would have been the first not to be.
    """
    arms, shares, kinds = clear.shape
    joints = start.shape[1]
    least = np.empty(kinds)
    for i in range(arms):
        worse = False
        for c in range(kinds):
            least[c] = clear[i, 0, c] - tolerance if clear[i, 0, c] < 0.0 else 0.0
            worse = worse or clear[i, shares - 1, c] < least[c]
        if not worse:
            continue
        k = 0
        while not (why[0, i] or why[1, i]):
            k += 1
            for c in range(kinds):
                if clear[i, k, c] < least[c]:
                    why[int(c >= joints), i] = True
        for j in range(joints):
            command[i, j] = start[i, j] + (k - 1) / (shares - 1) * way[i, j]


@njit(void(OUT2, *[IN2] * 2, *[IN1] * 2), **OPTIONS)
def take_speed(speed, command, last, elapsed, fastest):  # noqa: ANN001, ANN201
    """Fill ``speed`` (B, n) with that of the ``command`` (B, n), ``elapsed`` (1 or B,) after the ``last`` (B, n).

    It is 0 where no time has passed; rounding takes none beyond the ``fastest`` (n,).
    """
    arms, joints = speed.shape
    for i in range(arms):
        time = elapsed[i % len(elapsed)]
        for j in range(joints):
            speed[i, j] = 0.0
            if time > 0.0:
                speed[i, j] = min(max((command[i, j] - last[i, j]) / time, -fastest[j]), fastest[j])


@njit(bool_(*[IN2] * 4, IN1, IN1, IN1, float64), **OPTIONS)
def credible(command, sent, speed, position, lowest, highest, age, oldest):  # noqa: ANN001, ANN201
    """Tell whether all numbers (B, n) are finite, positions believed and states (B,) young, in the whole batch."""
    arms, joints = command.shape
    for i in range(arms):
        if not age[i] <= oldest:  # NaN counts as old
            return False
        for j in range(joints):
            seen = lowest[j] <= position[i, j] <= highest[j]
            if not (seen and np.isfinite(command[i, j] + sent[i, j] + speed[i, j])):
                return False
    return True
