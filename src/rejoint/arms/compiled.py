"""Compiled kinematics, inverse kinematics and distances.

A goal is 17 numbers: place (3) [m], rotation (9), tool axis (3), weight [m/rad], and what of the orientation counts: 0
nothing, 1 the axis, 2 all.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from typing import Any

import numpy as np
from numba import float64, int64, njit, types, void
from numba.core.compiler_lock import global_compiler_lock

from rejoint.arms.collision import CollisionShape
from rejoint.arms.kinematics import DAMPING, MOST_STEP, Chain

IN1, IN2, IN3, IN4 = (types.Array(float64, dimensions, "C", readonly=True) for dimensions in (1, 2, 3, 4))
ROWS1, ROWS2 = (types.Array(int64, dimensions, "C", readonly=True) for dimensions in (1, 2))
OUT1, OUT2, OUT3, OUT4 = float64[::1], float64[:, ::1], float64[:, :, ::1], float64[:, :, :, ::1]
CHAIN = types.NamedTuple((IN4, IN2, IN2, IN2, IN1, IN1, IN2), Chain)
SHAPE = types.NamedTuple((IN1, float64, ROWS2, ROWS1, float64, ROWS1, IN2), CollisionShape)
inner = njit(cache=True, nogil=True)
"""of a loop that others call"""

POINT = 1e-15
"""[m^2] squared length of a point (chosen)"""
HALVINGS = 20
"""of a link, to find its point nearest to a box (chosen)"""
_DECLARED: list[Any] = []


def compiled(signature, **options):  # noqa: ANN001, ANN003, ANN201
    """Return `numba.njit` for one ``signature``; it compiles at the first use, not at the import."""

    def declare(function):  # noqa: ANN001, ANN202
        made = njit(cache=True, nogil=True, **options)(function)
        build = made.compile

        def compile_now(*_):  # noqa: ANN002, ANN202
            with global_compiler_lock:  # of all threads, one compiles
                if not made.signatures:
                    build(signature)
                    made.disable_compile()
            return made  # Numba calls it with the arguments, and refuses wrong types

        made.compile = made._compile_for_args = compile_now
        _DECLARED.append(compile_now)
        return made

    return declare


def compile_all() -> None:
    """Compile what was declared in imported modules: a moving arm does not wait for that."""
    for build in _DECLARED:
        build()


@inner
def dot(row, vector):  # noqa: ANN001, ANN201
    """Scalar product with the beginning of a ``row``."""
    total = 0.0
    for i in range(len(vector)):
        total += row[i] * vector[i]
    return total


@inner
def fill(out, values):  # noqa: ANN001, ANN201
    """Copy ``values`` (n,) into ``out``; slices would compile for seconds, since they can fail."""
    for i in range(len(out)):
        out[i] = values[i]


@inner
def along(start, goal, share, out):  # noqa: ANN001, ANN201
    """Fill ``out`` (n,) with what is a ``share`` of the way from ``start`` to ``goal``."""
    for i in range(len(out)):
        out[i] = start[i] + share * (goal[i] - start[i])


@inner
def clip(q, limits):  # noqa: ANN001, ANN201
    """Bring ``q`` (n,) within ``limits`` (2, n)."""
    for i in range(len(q)):
        q[i] = np.minimum(np.maximum(q[i], limits[0, i]), limits[1, i])


@inner
def _cross(a, b):  # noqa: ANN001, ANN202
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@inner
def _times(matrix, vector):  # noqa: ANN001, ANN202
    """Product (r,) of the first columns of a matrix (r, c) and a ``vector``."""
    out = np.empty(len(matrix))
    for r in range(len(matrix)):
        out[r] = dot(matrix[r], vector)
    return out


@compiled(void(CHAIN, IN1, OUT3))
def put(chain, q, frames):  # noqa: ANN001, ANN201
    """Fill ``frames`` (n + 1, 4, 4) of joints and TCP at one posture (n,)."""
    joints, step = len(q), np.empty((4, 4))
    for i in range(joints + 1):
        if i < joints:
            terms, sine, cosine = chain.terms[i], np.sin(q[i]), np.cos(q[i])
            for r in range(4):
                for k in range(4):
                    step[r, k] = terms[0, r, k] + terms[1, r, k] * sine + terms[2, r, k] * cosine
        for r in range(4):
            if i == joints:
                fill(step[r], chain.tip[r])
            if i == 0:
                fill(frames[i, r], step[r])
        for r in range(4 if i > 0 else 0):
            for k in range(4):
                value = 0.0
                for j in range(4):
                    value += frames[i - 1, r, j] * step[j, k]
                frames[i, r, k] = value


@inner
def place(chain, q):  # noqa: ANN001, ANN201
    """Frames (n + 1, 4, 4) of joints and TCP at one posture (n,)."""
    frames = np.empty((len(q) + 1, 4, 4))
    put(chain, q, frames)
    return frames


@compiled(OUT4(CHAIN, IN2))
def place_all(chain, q):  # noqa: ANN001, ANN201
    """Frames (B, n + 1, 4, 4) of `place` at postures (B, n)."""
    frames = np.empty((len(q), q.shape[1] + 1, 4, 4))
    for b in range(len(q)):
        put(chain, q[b], frames[b])
    return frames


@compiled(OUT1(CHAIN, IN3, IN1))
def torques(chain, frames, gravity):  # noqa: ANN001, ANN201
    """Torques (n,) [N m] that hold ``frames`` (n + 1, 4, 4) against ``gravity`` (3,) [m/s^2]."""
    joints, mass = len(chain.axes), 0.0
    held, axis, lever, moment = np.empty(joints), np.empty(3), np.empty(3), np.zeros(3)
    for i in range(joints - 1, -1, -1):
        mass += chain.mass[i]
        for r in range(3):
            row = frames[i, r]  # axis, and moment of all that hangs on the joint
            axis[r] = dot(row, chain.axes[i])
            moment[r] += chain.mass[i] * (dot(row, chain.com[i]) + row[3])
            lever[r] = moment[r] - mass * row[3]
        held[i] = -dot(_cross(axis, lever), gravity)
    return held


@compiled(OUT2(CHAIN, IN2, IN1))
def torques_all(chain, q, gravity):  # noqa: ANN001, ANN201
    """`torques` (B, n) [N m] at postures (B, n)."""
    held, frames = np.empty(q.shape), np.empty((q.shape[1] + 1, 4, 4))
    for b in range(len(q)):
        put(chain, q[b], frames)
        fill(held[b], torques(chain, frames, gravity))
    return held


@inner
def largest(vector):  # noqa: ANN001, ANN201
    """Largest absolute element."""
    found = 0.0
    for i in range(len(vector)):
        found = max(found, abs(vector[i]))
    return found


@compiled(OUT1(IN1, IN2))
def missing_turn(goal, frame):  # noqa: ANN001, ANN201
    """Rotation vector (3,) [rad] from a ``frame`` (3, 4) to the orientation of a ``goal``."""
    wanted = goal[3:12].reshape(3, 3)
    if goal[16] == 2.0:
        relative = np.empty((3, 3))
        for r in range(3):
            fill(relative[r], _times(frame, wanted[r]))
        cosine = 0.5 * (relative[0, 0] + relative[1, 1] + relative[2, 2] - 1.0)
        vector = np.empty(3)
        for r in range(3):
            vector[r] = 0.5 * (relative[r - 1, r - 2] - relative[r - 2, r - 1])
        most = 0
        for r in range(1, 3):
            most = r if relative[r, r] > relative[most, most] else most
        half = relative[most].copy()
        half[most] += 1.0
    else:
        now, own = _times(frame, goal[12:15]), _times(wanted, goal[12:15])
        vector, cosine, across = np.array(_cross(now, own)), dot(now, own), np.zeros(3)
        across[0 if abs(now[0]) < 0.7 else 1] = 1.0
        half = np.array(_cross(now, across))
    sine = np.sqrt(dot(vector, vector))
    if sine <= 1e-9 and cosine < 0.0:
        vector, factor = half, np.pi / np.sqrt(dot(half, half))
    else:
        factor = np.arctan2(sine, cosine) / sine if sine > 1e-9 else 1.0
    for r in range(3):
        vector[r] *= factor
    return vector


@compiled(types.Tuple((OUT1, OUT2))(CHAIN, IN1, IN1))
def task(chain, goal, q):  # noqa: ANN001, ANN201
    """Error (k,) [m] from a ``goal`` at ``q`` (n,), and minus its derivatives (k, n); k is 3, or 6 with orientation."""
    joints, rows = len(q), 3 if goal[16] == 0.0 else 6
    frames, error, jacobian = place(chain, q), np.empty(rows), np.empty((rows, joints))
    for r in range(3):
        error[r] = goal[r] - frames[joints, r, 3]
    own = _times(goal[3:12].reshape(3, 3), goal[12:15])
    turn = missing_turn(goal, frames[joints, :3]) if rows == 6 else error
    for r in range(3, rows):
        error[r] = goal[15] * turn[r - 3]
    for i in range(joints):
        axis, lever = _times(frames[i, :3], chain.axes[i]), _from_to(frames[:, :, 3], i, joints)
        jacobian[0, i], jacobian[1, i], jacobian[2, i] = _cross(axis, lever)
        twist = dot(axis, own) if goal[16] == 1.0 else 0.0
        for r in range(3, rows):
            jacobian[r, i] = goal[15] * (axis[r - 3] - twist * own[r - 3])
    return error, jacobian


@compiled(void(CHAIN, IN2, IN2, OUT2, OUT3))
def fill_tasks(chain, goals, q, errors, jacobians):  # noqa: ANN001, ANN201
    """Fill `task` of ``goals`` (B, 17) at ``q`` (B, n): (B, k) and (B, k, n); zeros where no orientation counts."""
    for b in range(len(q)):
        error, jacobian = task(chain, goals[b], q[b])
        for r in range(len(error)):
            errors[b, r] = error[r]
            fill(jacobians[b, r], jacobian[r])


@compiled(OUT1(IN2, IN1, float64))
def damped(jacobian, error, damping):  # noqa: ANN001, ANN201
    """Step (n,) J' (J J' + damping^2 I)^-1 e, by Gauss's elimination; compiles faster than `numpy.linalg`."""
    rows, joints = jacobian.shape
    gram, work, step = np.empty((rows, rows)), error.copy(), np.zeros(joints)
    for r in range(rows):
        for k in range(rows):
            gram[r, k] = dot(jacobian[r], jacobian[k])
        gram[r, r] += damping * damping
    for r in range(rows):
        for k in range(r + 1, rows):
            factor = gram[k, r] / gram[r, r]
            for c in range(r + 1, rows):
                gram[k, c] -= factor * gram[r, c]
            work[k] -= factor * work[r]
    for r in range(rows - 1, -1, -1):
        work[r] /= gram[r, r]
        for k in range(r):
            work[k] -= gram[k, r] * work[r]
        for i in range(joints):
            step[i] += work[r] * jacobian[r, i]
    return step


@compiled(OUT1(IN2, IN1))
def in_null_space(jacobian, motion):  # noqa: ANN001, ANN201
    """Share (n,) of a ``motion`` (n,) that moves no goal."""
    left = damped(jacobian, _times(jacobian, motion), 1e-6 if len(jacobian) == 3 else 1e-4)
    for i in range(len(motion)):
        left[i] = motion[i] - left[i]
    return left


@compiled(float64(CHAIN, IN1, OUT1, IN2, float64, int64, float64))
def solve(chain, goal, q, limits, pull, rounds, tolerance):  # noqa: ANN001, ANN201
    """Move ``q`` (n,) within ``limits`` (2, n) to the ``goal``; returns the largest error [m].

    ``pull``: to rest per step, in the null space.
    """
    clip(q, limits)
    missed, home = np.inf, np.empty(len(q))
    for k in range(rounds + 1):
        error, jacobian = task(chain, goal, q)
        missed = largest(error)
        if not missed >= tolerance or k == rounds:
            break
        step = damped(jacobian, error, min(DAMPING, np.sqrt(dot(error, error)) + 1e-4))
        if pull > 0.0:
            for i in range(len(q)):
                home[i] = pull * (chain.rest[i] - q[i])
            home = in_null_space(jacobian, home)
            for i in range(len(q)):
                step[i] += home[i]
        scale = MOST_STEP / max(MOST_STEP, largest(step))
        for i in range(len(q)):
            q[i] += scale * step[i]
        clip(q, limits)
    return missed


@compiled(void(CHAIN, IN2, OUT2, float64, int64, float64, OUT1))
def solve_all(chain, goals, q, pull, rounds, tolerance, missed):  # noqa: ANN001, ANN201
    """`solve` for ``goals`` (B, 17), from ``q`` (B, n); fills ``missed`` (B,)."""
    for b in range(len(q)):
        missed[b] = solve(chain, goals[b], q[b], chain.limits, pull, rounds, tolerance)


@inner
def _from_to(ends, i, j):  # noqa: ANN001, ANN202
    return ends[j, 0] - ends[i, 0], ends[j, 1] - ends[i, 1], ends[j, 2] - ends[i, 2]


@compiled(float64(IN2, int64, int64))
def _axis_distance(ends, i, j):  # noqa: ANN001, ANN202
    """Distance between the axes of links i and j; ``ends`` (n + 2, 3)."""
    along, across, apart = _from_to(ends, i, i + 1), _from_to(ends, j, j + 1), _from_to(ends, j, i)
    a, e, b = dot(along, along), dot(across, across), dot(along, across)
    c, f = dot(along, apart), dot(across, apart)
    under = a * e - b * b
    s = min(max((b * f - c * e) / under, 0.0), 1.0) if under > POINT else 0.0
    t = min(max((b * s + f) / e, 0.0), 1.0) if e > POINT else 0.0
    s = min(max((b * t - c) / a, 0.0), 1.0) if a > POINT else 0.0
    square = 0.0
    for r in range(3):
        square += (apart[r] + s * along[r] - t * across[r]) ** 2
    return np.sqrt(square)


@compiled(float64(IN2, int64, IN1))
def _box_distance(ends, link, box):  # noqa: ANN001, ANN202
    """Distance [m] between the axis of ``link`` and a ``box`` (6,); ``ends`` (n + 2, 3). Halves the convex function."""
    low, high, square, along = 0.0, 1.0, 0.0, _from_to(ends, link, link + 1)
    for k in range(HALVINGS + 2):
        t = 0.0 if k == 0 else 1.0 if k == 1 else 0.5 * (low + high)
        slope = square = 0.0
        for r in range(3):
            place = ends[link, r] + t * along[r]
            gap = max(place - box[3 + r], 0.0) - max(box[r] - place, 0.0)
            slope, square = slope + along[r] * gap, square + gap * gap
        if slope < 0.0:
            low = t
        else:
            high = t
        if high == 0.0 or low == 1.0:
            break
    return np.sqrt(square)


@inner
def _count(shape):  # noqa: ANN001, ANN202
    """Distances of a posture."""
    return len(shape.floors) + len(shape.pairs) + len(shape.places) + len(shape.moving) * len(shape.boxes)


@compiled(OUT1(IN3, SHAPE))
def gaps(frames, shape):  # noqa: ANN001, ANN201
    """`collision.clearances_of` (n + P + G + L K,) [m] of one posture's ``frames`` (n + 1, 4, 4)."""
    ends, row, at = np.zeros((len(frames) + 1, 3)), np.empty(_count(shape)), len(shape.floors)
    for i in range(len(frames)):
        for r in range(3):
            ends[i + 1, r] = frames[i, r, 3]
    for i in range(at):
        row[i] = ends[i + 2, 2] - shape.floors[i]
    for pair in shape.pairs:
        row[at] = _axis_distance(ends, pair[0], pair[1]) - 2.0 * shape.radius
        at += 1
    for place in shape.places:
        row[at] = ends[place, 2] - shape.ground - shape.radius
        at += 1
    for k in range(len(shape.boxes)):
        for link in shape.moving:
            row[at] = _box_distance(ends, link, shape.boxes[k]) - shape.radius
            at += 1
    return row


@compiled(OUT2(CHAIN, SHAPE, IN2))
def clearances(chain, shape, q):  # noqa: ANN001, ANN201
    """`collision.clearances_of` (B, n + P + G + L K) [m] at ``q`` (B, n)."""
    out = np.empty((len(q), _count(shape)))
    for b in range(len(q)):
        fill(out[b], gaps(place(chain, q[b]), shape))
    return out
