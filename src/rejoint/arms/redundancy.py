"""Compiled search for a posture: damped least squares, cost, and descent.

A goal is 17 numbers: place (3) [m], rotation (9), tool axis (3), weight [m/rad], and what of the orientation counts: 0
nothing, 1 the axis, 2 all.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64, njit, types, void
from numpy.typing import NDArray

from rejoint.arms.arm import Array
from rejoint.arms.compiled import (
    IN1,
    IN2,
    IN3,
    OUT2,
    OUT3,
    OUT4,
    ROWS1,
    ROWS2,
    fill_clearances,
    fill_columns,
    fill_poses,
)

AMPLE, CRAMPED = 5.0 / 3.0, 10.0
"""Least distances from which there is enough room, and cost of a sufficient clearance less (chosen by `python -m
benchmarks postures`: in postures with the least distances, worn arms came nearer than 5 mm)"""
FAR = 1000.0
"""Cost of an impossible posture"""
DAMPING, MOST_STEP, REST_GAIN = 0.05, float(np.radians(10.0)), 0.05
TOLERANCE, DRIFT = 1e-5, 1e-6
LOAD, MOST_LOAD, NEAR_LIMIT = 0.85, 1.5, 0.2
"""Share of torque that costs, share from which only the largest counts, and costly distance [rad] from a limit"""
TRAVEL = 0.6
"""Cost of half a turn"""
LOCAL_ROUNDS, ROUNDS, DESCENTS = 200, 25, 10
NEAR_REACH = 0.2
"""[rad] between neighbours for a lower cost"""
COMFORT_LOAD, COMFORT_LIMIT = 0.8, float(np.radians(3.0))


class ArmTables(NamedTuple):  # Numba's files on disk name this class: give this module a new name if the class gets one
    """An arm in compiled loops; see `Arm` and `CollisionShape`."""

    terms: Array
    tip: Array
    axes: Array
    lower: Array
    upper: Array
    inner: Array
    """(2, n) [rad] limits less margin"""
    rest: Array
    mass: Array
    com: Array
    floors: Array
    pairs: NDArray[np.int64]
    places: NDArray[np.int64]
    moving: NDArray[np.int64]
    boxes: Array
    least: Array
    """(c,) [m] least distances; minus infinity: constant"""
    sizes: Array
    """[m] link radius, ground height, sufficient clearance"""


class Pool(NamedTuple):
    """Postures without contacts."""

    posture: Array
    """(N, n) [rad]"""
    place: Array
    """(N, 12) TCP position [m], then rotation"""
    torque: Array
    """(N, n) [N m] against gravity"""
    bare: Array
    """(N,) cost without torque and travel"""


BODY = types.NamedTuple(
    (IN3, IN2, IN2, IN1, IN1, IN2, IN1, IN1, IN2, IN1, ROWS2, ROWS1, ROWS1, IN2, IN1, IN1), ArmTables
)
_POOL = types.NamedTuple((IN2, IN2, IN2, IN1), Pool)
OUT1 = float64[::1]
_OPTIONS = {"cache": True, "nogil": True}


@njit(**_OPTIONS)
def copy(into, values):  # noqa: ANN001, ANN201
    """Copy ``values`` (n,); compiles faster than a slice."""
    for i in range(len(values)):
        into[i] = values[i]


@njit(void(BODY, IN1, OUT4), **_OPTIONS)
def place(body, q, poses):  # noqa: ANN001, ANN201
    """Fill ``poses`` (n + 1, 3, 4, 1) of one posture."""
    fill_poses(body.terms, body.tip, np.sin(q).reshape(-1, 1), np.cos(q).reshape(-1, 1), 0, poses)


@njit(void(BODY, OUT4, OUT2), **_OPTIONS)
def measure(body, poses, clear):  # noqa: ANN001, ANN201
    """Fill ``clear`` (1, n + c) [m] with `clearances` of one posture."""
    fill_clearances(
        poses, body.floors, body.pairs, body.places, body.sizes[0], body.sizes[1], body.moving, body.boxes, clear
    )


@njit(**_OPTIONS)
def _room(body):  # noqa: ANN001, ANN202
    """Room for poses, columns, error, jacobian, torque, clearances and facts of one posture."""
    joints, count = len(body.lower), len(body.floors) + len(body.least)
    poses, columns = np.empty((joints + 1, 3, 4, 1)), np.empty((3, joints, 1))
    error, jacobian, torque = np.empty(6), np.empty((6, joints)), np.empty(joints)
    return poses, columns, error, jacobian, torque, np.empty((1, count)), np.empty(3)


@njit(void(BODY, OUT4, OUT1), **_OPTIONS)
def _weigh(body, poses, torque):  # noqa: ANN001, ANN202
    """Fill ``torque`` (n,) [N m] as `kinematics.gravity_torque`."""
    joints = len(torque)
    mass = x = y = 0.0
    for back in range(joints):
        i = joints - 1 - back
        pose, com = poses[i, :, :, 0], body.com[i]
        mass += body.mass[i]
        x += body.mass[i] * (pose[0, 0] * com[0] + pose[0, 1] * com[1] + pose[0, 2] * com[2] + pose[0, 3])
        y += body.mass[i] * (pose[1, 0] * com[0] + pose[1, 1] * com[1] + pose[1, 2] * com[2] + pose[1, 3])
        ax = pose[0, 0] * body.axes[i, 0] + pose[0, 1] * body.axes[i, 1] + pose[0, 2] * body.axes[i, 2]
        ay = pose[1, 0] * body.axes[i, 0] + pose[1, 1] * body.axes[i, 1] + pose[1, 2] * body.axes[i, 2]
        torque[i] = 9.81 * (ax * (y - mass * pose[1, 3]) - ay * (x - mass * pose[0, 3]))


@njit(float64(BODY, OUT4, IN1, IN1, IN1, OUT1, OUT2, OUT1), **_OPTIONS)
def _judge(body, poses, q, scale, most, torque, clear, facts):  # noqa: ANN001, ANN202
    """Cost of a posture without travel; `FAR` and more: impossible.

    ``scale`` (n,) [N m]: torque that counts as one; ``most`` (n,): largest. Fills ``facts`` (3,): largest torque share,
    what distances lack to `AMPLE` ones, distance from a limit.
    """
    joints = len(q)
    _weigh(body, poses, torque)
    measure(body, poses, clear)
    cost, wrong, over = 0.0, 0.0, 0.0
    facts[0], facts[1], facts[2] = 0.0, 0.0, np.inf
    for i in range(joints):
        share = abs(torque[i]) / scale[i]
        cost += 0.5 * min(share / LOAD, MOST_LOAD) ** 4
        facts[0] = max(facts[0], share)
        over = max(over, abs(torque[i]) / most[i])
        away = min(q[i] - body.lower[i], body.upper[i] - q[i])
        facts[2] = min(facts[2], away)
        if away < NEAR_LIMIT:
            cost += 0.5 * (1.0 - away / NEAR_LIMIT) ** 2
        if clear[0, i] < -2.0 * TOLERANCE:
            wrong -= clear[0, i] / body.sizes[2]
    if facts[0] > LOAD:
        cost += 10.0 * (facts[0] - LOAD)
    if over > 1.0:
        wrong += 0.1 + over - 1.0
    for k in range(joints, clear.shape[1]):
        gap = clear[0, k]
        if body.least[k - joints] == -np.inf:
            continue
        short = AMPLE * body.least[k - joints] - gap
        facts[1] = max(facts[1], short)
        cost += CRAMPED * max(short, 0.0) / body.sizes[2]
        if gap < body.sizes[2]:
            cost += 0.5 * (1.0 - gap / body.sizes[2]) ** 2
        if gap < body.least[k - joints]:
            wrong += 0.1 + (body.least[k - joints] - gap) / body.sizes[2]
    return cost + (FAR * (1.0 + wrong) if wrong > 0.0 else 0.0)


@njit(**_OPTIONS)
def farthest(q, other):  # noqa: ANN001, ANN201
    """Largest difference of two postures (n,)."""
    largest = 0.0
    for i in range(len(q)):
        largest = max(largest, abs(q[i] - other[i]))
    return largest


@njit(float64(IN1, IN1), **_OPTIONS)
def _travel(q, start):  # noqa: ANN001, ANN202
    """Cost of travel, nearly that of the joint that turns most."""
    total = 0.0
    for i in range(len(q)):
        total += ((q[i] - start[i]) / np.pi) ** 4
    return TRAVEL * np.sqrt(np.sqrt(total))


@njit(**_OPTIONS)
def _lengthen(vector, cosine):  # noqa: ANN001, ANN202
    """Turn an axis (3,) times the sine into that times the angle; whether it is half a turn about any axis."""
    sine = np.sqrt(vector[0] ** 2 + vector[1] ** 2 + vector[2] ** 2)
    if sine > 1e-9:
        for r in range(3):
            vector[r] *= np.arctan2(sine, cosine) / sine
    return sine <= 1e-9 and cosine < 0.0


@njit(**_OPTIONS)
def _turn(current, wanted, vector):  # noqa: ANN001, ANN202
    """Fill the rotation ``vector`` (3,) from ``current`` to ``wanted`` (3, 3)."""
    relative = np.zeros((3, 3))
    for r in range(3):
        for k in range(3):
            for j in range(3):
                relative[r, k] += wanted[r, j] * current[k, j]
    cosine = 0.5 * (relative[0, 0] + relative[1, 1] + relative[2, 2] - 1.0)
    for r in range(3):
        after, last = (r + 1) % 3, (r + 2) % 3
        vector[r] = 0.5 * (relative[last, after] - relative[after, last])
    if _lengthen(vector, cosine):
        largest = 0
        for r in range(3):
            if relative[r, r] > relative[largest, largest]:
                largest = r
        size = 0.0
        for r in range(3):
            vector[r] = relative[r, largest] + (1.0 if r == largest else 0.0)
            size += vector[r] ** 2
        for r in range(3):
            vector[r] *= np.pi / max(np.sqrt(size), 1e-12)


@njit(**_OPTIONS)
def _swing(turn, wanted, tool, vector):  # noqa: ANN001, ANN202
    """Fill the smallest rotation ``vector`` (3,) of the axis ``tool`` (3,), in its frame, into ``wanted``."""
    now = np.empty(3)
    for r in range(3):
        now[r] = turn[r, 0] * tool[0] + turn[r, 1] * tool[1] + turn[r, 2] * tool[2]
    cosine = now[0] * wanted[0] + now[1] * wanted[1] + now[2] * wanted[2]
    for r in range(3):
        after, last = (r + 1) % 3, (r + 2) % 3
        vector[r] = now[after] * wanted[last] - now[last] * wanted[after]
    if _lengthen(vector, cosine):
        other = 0 if abs(now[0]) < 0.7 else 1
        after, last = (other + 1) % 3, (other + 2) % 3
        size = np.sqrt(now[after] ** 2 + now[last] ** 2)
        vector[other], vector[after], vector[last] = 0.0, np.pi * now[last] / size, -np.pi * now[after] / size


@njit(int64(BODY, IN1, OUT4, OUT3, OUT1, OUT2), **_OPTIONS)
def _miss(body, goal, poses, columns, error, jacobian):  # noqa: ANN001, ANN202
    """Fill ``error`` (6,) [m] from a ``goal`` (17,), and its derivatives (6, n); returns 3 or 6 rows."""
    joints = columns.shape[1]
    fill_columns(body.axes, poses, columns)
    for r in range(3):
        error[r] = goal[r] - poses[joints, r, 3, 0]
        for i in range(joints):
            jacobian[r, i] = columns[r, i, 0]
    if goal[16] == 0.0:
        return 3
    turn, wanted, weight = poses[joints, :, :3, 0], goal[3:12].reshape(3, 3), goal[15]
    vector, own = np.zeros(3), np.zeros(3)
    for r in range(3):
        own[r] = wanted[r, 0] * goal[12] + wanted[r, 1] * goal[13] + wanted[r, 2] * goal[14]
    if goal[16] == 2.0:
        _turn(turn, wanted, vector)
    else:
        _swing(turn, own, goal[12:15], vector)
    for i in range(joints):
        for r in range(3):
            axis = poses[i, r]
            jacobian[3 + r, i] = weight * (
                axis[0, 0] * body.axes[i, 0] + axis[1, 0] * body.axes[i, 1] + axis[2, 0] * body.axes[i, 2]
            )
        if goal[16] == 1.0:
            along = own[0] * jacobian[3, i] + own[1] * jacobian[4, i] + own[2] * jacobian[5, i]
            for r in range(3):
                jacobian[3 + r, i] -= along * own[r]
    for r in range(3):
        error[3 + r] = weight * vector[r]
    return 6


@njit(void(OUT2, IN2, int64, float64), **_OPTIONS)
def _factor(gram, jacobian, rows, damping):  # noqa: ANN001, ANN202
    """Fill ``gram`` with the Cholesky factor of J J' + damping^2 I."""
    for r in range(rows):
        for k in range(r + 1):
            value = damping * damping if r == k else 0.0
            for i in range(jacobian.shape[1]):
                value += jacobian[r, i] * jacobian[k, i]
            for j in range(k):
                value -= gram[r, j] * gram[k, j]
            gram[r, k] = np.sqrt(max(value, 1e-24)) if r == k else value / gram[k, k]


@njit(void(OUT2, IN2, int64, IN1, OUT1, OUT1), **_OPTIONS)
def _least(gram, jacobian, rows, error, work, step):  # noqa: ANN001, ANN202
    """Fill ``step`` (n,) with J' (J J' + damping^2 I)^-1 e; ``gram`` is the factor."""
    for r in range(rows):
        value = error[r]
        for j in range(r):
            value -= gram[r, j] * work[j]
        work[r] = value / gram[r, r]
    for back in range(rows):
        r = rows - 1 - back
        value = work[r]
        for j in range(r + 1, rows):
            value -= gram[j, r] * work[j]
        work[r] = value / gram[r, r]
    for i in range(len(step)):
        value = 0.0
        for r in range(rows):
            value += jacobian[r, i] * work[r]
        step[i] = value


@njit(float64(BODY, IN1, OUT1, IN1, IN1, float64, int64, OUT4, OUT3, OUT1, OUT2), **_OPTIONS)
def _solve(body, goal, q, lower, upper, pull, rounds, poses, columns, error, jacobian):  # noqa: ANN001, ANN202
    """Move ``q`` (n,) to the ``goal``, as `solve_position`; returns the error [m].

    Fills ``poses`` of the result.
    """
    joints = len(q)
    gram, work, drift = np.empty((6, 6)), np.empty(6), np.empty(6)
    step, back = np.empty(joints), np.empty(joints)
    for i in range(joints):
        q[i] = min(max(q[i], lower[i]), upper[i])
    missed = np.inf
    for k in range(rounds + 1):
        place(body, q, poses)
        rows = _miss(body, goal, poses, columns, error, jacobian)
        missed = square = 0.0
        for r in range(rows):
            missed = max(missed, abs(error[r]))
            square += error[r] * error[r]
        if missed < TOLERANCE or k == rounds:
            break
        _factor(gram, jacobian, rows, min(DAMPING, np.sqrt(square) + 1e-4))
        _least(gram, jacobian, rows, error, work, step)
        if pull > 0.0:
            for r in range(rows):
                drift[r] = 0.0
                for i in range(joints):
                    drift[r] += jacobian[r, i] * pull * (body.rest[i] - q[i])
            _factor(gram, jacobian, rows, DRIFT if rows == 3 else 1e-4)
            _least(gram, jacobian, rows, drift, work, back)
            for i in range(joints):
                step[i] += pull * (body.rest[i] - q[i]) - back[i]
        largest = MOST_STEP
        for i in range(joints):
            largest = max(largest, abs(step[i]))
        for i in range(joints):
            q[i] = min(max(q[i] + step[i] * (MOST_STEP / largest), lower[i]), upper[i])
    return missed


@njit(int64(OUT2, int64, float64), **_OPTIONS)
def _keep_new(basis, count, least):  # noqa: ANN001, ANN202
    """Orthogonalise ``basis[count]``; returns the new count."""
    joints = basis.shape[1]
    for _ in range(2):
        for c in range(count):
            dot = 0.0
            for i in range(joints):
                dot += basis[count, i] * basis[c, i]
            for i in range(joints):
                basis[count, i] -= dot * basis[c, i]
    size = 0.0
    for i in range(joints):
        size += basis[count, i] ** 2
    if size <= least:
        return count
    for i in range(joints):
        basis[count, i] /= np.sqrt(size)
    return count + 1


@njit(int64(IN2, int64, OUT2), **_OPTIONS)
def _null_space(jacobian, rows, basis):  # noqa: ANN001, ANN202
    """Fill ``basis`` (n + 1, n) with orthonormal vectors; returns how many first ones move the goal."""
    joints = jacobian.shape[1]
    largest, count = 0.0, 0
    for r in range(rows):
        size = 0.0
        for i in range(joints):
            size += jacobian[r, i] ** 2
        largest = max(largest, size)
    for r in range(rows):
        copy(basis[count], jacobian[r])
        count = _keep_new(basis, count, 1e-6 * largest)
    matter = count
    for i in range(joints):
        for j in range(joints):
            basis[count, j] = 1.0 if i == j else 0.0
        count = _keep_new(basis, count, 1e-3)
    return matter


@njit(float64(BODY, IN1, OUT1, IN1, IN1, IN1, float64, int64), **_OPTIONS)
def _descend(body, goal, q, start, scale, most, reach, rounds):  # noqa: ANN001, ANN202
    """Lower the cost of ``q`` (n,) in the null space, and return it.

    No joint moves more than ``reach`` [rad].
    """
    joints = len(q)
    poses, columns, error, jacobian, torque, clear, tried = _room(body)
    basis, trial, slope = np.empty((joints + 1, joints)), np.empty(joints), np.empty(joints)
    lower, upper = np.empty(joints), np.empty(joints)
    for i in range(joints):
        lower[i], upper[i] = max(body.inner[0, i], q[i] - reach), min(body.inner[1, i], q[i] + reach)
    place(body, q, poses)
    cost = _judge(body, poses, q, scale, most, torque, clear, tried) + _travel(q, start)
    length, size, nowhere = 0.15, 1.0, np.zeros(joints)
    fresh = True
    for _ in range(rounds):
        if fresh:
            place(body, q, poses)
            rows = _miss(body, goal, poses, columns, error, jacobian)
            matter = _null_space(jacobian, rows, basis)
            if matter >= joints:
                return cost
            for i in range(joints):
                slope[i] = 0.0
            for c in range(matter, joints):
                for i in range(joints):
                    trial[i] = q[i] + 1e-4 * basis[c, i]
                place(body, trial, poses)
                there = _judge(body, poses, trial, scale, most, torque, clear, tried) + _travel(trial, start)
                for i in range(joints):
                    slope[i] -= (there - cost) / 1e-4 * basis[c, i]
            size = farthest(slope, nowhere)
            if size < 1e-3:
                return cost
        for i in range(joints):
            trial[i] = q[i] + length * slope[i] / size
        missed = _solve(body, goal, trial, lower, upper, 0.0, 8, poses, columns, error, jacobian)
        fresh = False
        if missed < TOLERANCE:
            there = _judge(body, poses, trial, scale, most, torque, clear, tried) + _travel(trial, start)
            if there < cost - 1e-4:
                copy(q, trial)
                cost, fresh = there, True
        length = 1.5 * length if fresh else 0.4 * length
        if length < 0.005:
            break
    return cost


@njit(void(_POOL, IN1, IN1, IN1, float64, int64[::1], OUT1), **_OPTIONS)
def _nearest(pool, goal, start, scale, size, chosen, worth):  # noqa: ANN001, ANN202
    """Fill ``chosen`` (S,) with pool postures, the best first, then -1.

    Best: near the goal, by ``size`` [m], and of low cost.
    """
    room = len(chosen)
    for s in range(room):
        chosen[s], worth[s] = -1, np.inf
    own = goal[3:12].reshape(3, 3)
    for k in range(len(pool.posture)):
        value = 0.0
        for r in range(3):
            value += (pool.place[k, r] - goal[r]) ** 2
        value = np.sqrt(value)
        if goal[16] > 0.0 and value < size * worth[room - 1]:
            turn = pool.place[k, 3:12].reshape(3, 3)
            cosine = 0.0
            for r in range(3):
                if goal[16] == 2.0:
                    for j in range(3):
                        cosine += 0.5 * own[r, j] * turn[r, j]
                else:
                    one = own[r, 0] * goal[12] + own[r, 1] * goal[13] + own[r, 2] * goal[14]
                    cosine += one * (turn[r, 0] * goal[12] + turn[r, 1] * goal[13] + turn[r, 2] * goal[14])
            if goal[16] == 2.0:
                cosine -= 0.5
            value += 2.0 * size * np.arccos(min(max(cosine, -1.0), 1.0))
        value /= size
        if value >= worth[room - 1]:
            continue
        value += 0.3 * (pool.bare[k] + _travel(pool.posture[k], start))
        for i in range(len(scale)):
            value += 0.15 * min((abs(pool.torque[k, i]) / scale[i] / LOAD) ** 4, 20.0)
        if value >= worth[room - 1]:
            continue
        at = room - 1
        while at > 0 and worth[at - 1] > value:
            worth[at], chosen[at] = worth[at - 1], chosen[at - 1]
            at -= 1
        worth[at], chosen[at] = value, k


@njit(void(BODY, IN2, OUT2, OUT2, OUT1), **_OPTIONS)
def survey(body, postures, places, torques, bare):  # noqa: ANN001, ANN201
    """Fill ``places`` (N, 12), ``torques`` (N, n), and ``bare`` (N,): cost without load."""
    joints = postures.shape[1]
    poses, _, _, _, torque, clear, known = _room(body)
    scale = np.full(joints, np.inf)
    for k in range(len(postures)):
        place(body, postures[k], poses)
        bare[k] = _judge(body, poses, postures[k], scale, scale, torque, clear, known)
        copy(torques[k], torque)
        for r in range(3):
            places[k, r] = poses[joints, r, 3, 0]
            for j in range(3):
                places[k, 3 + 3 * r + j] = poses[joints, r, j, 0]


@njit(float64(BODY, IN1, IN1, IN1, IN1, boolean, OUT1), **_OPTIONS)
def stay(body, goal, start, scale, most, near, q):  # noqa: ANN001, ANN201
    """Fill ``q`` (n,) with the goal's posture on the branch of ``start`` (n,); returns its cost, or infinity.

    A comfortable posture of `solve_position` is kept. ``near``: lower the cost from the nearest posture.
    """
    poses, columns, error, jacobian, torque, clear, facts = _room(body)
    copy(q, start)
    rounds = LOCAL_ROUNDS if goal[16] == 0.0 else LOCAL_ROUNDS // 2
    missed = _solve(body, goal, q, body.lower, body.upper, REST_GAIN, rounds, poses, columns, error, jacobian)
    if missed < TOLERANCE:
        cost = _judge(body, poses, q, scale, most, torque, clear, facts)
        light = np.isinf(most[0]) or facts[0] < COMFORT_LOAD
        light = light and not (near and farthest(q, start) > NEAR_REACH)
        if cost < FAR and light and facts[1] <= 0.0 and facts[2] >= COMFORT_LIMIT:
            return 0.0
    reach = np.inf
    if near or missed >= TOLERANCE:
        copy(q, start)
    if near:
        reach = NEAR_REACH
    missed = _solve(body, goal, q, body.inner[0], body.inner[1], 0.0, ROUNDS, poses, columns, error, jacobian)
    if missed >= TOLERANCE:
        return np.inf
    return _descend(body, goal, q, start, scale, most, reach, DESCENTS)


@njit(float64(BODY, _POOL, IN1, IN1, IN1, IN1, float64, int64, int64, int64, OUT1, OUT1), **_OPTIONS)
def search(body, pool, goal, start, scale, most, size, starts, bests, descents, q, nearest):  # noqa: ANN001, ANN201
    """Fill ``q`` (n,) with the goal's best posture; returns its cost, or infinity.

    ``starts`` pool postures are moved to the goal; the ``bests`` different ones are improved. ``nearest`` (n + 1,):
    the posture with the least error, and that error [m].
    """
    joints = len(q)
    poses, columns, error, jacobian, torque, clear, known = _room(body)
    chosen, worth = np.empty(starts, np.int64), np.empty(starts)
    _nearest(pool, goal, start, scale, size, chosen, worth)
    found, cost = np.empty((starts, joints)), np.full(starts, np.inf)
    nearest[joints] = np.inf
    for s in range(starts):
        if chosen[s] < 0:
            break
        copy(found[s], pool.posture[chosen[s]])
        missed = _solve(
            body, goal, found[s], body.inner[0], body.inner[1], 0.0, ROUNDS, poses, columns, error, jacobian
        )
        if missed < nearest[joints]:
            copy(nearest, found[s])
            nearest[joints] = missed
        if missed < TOLERANCE:
            cost[s] = _judge(body, poses, found[s], scale, most, torque, clear, known) + _travel(found[s], start)
    best = np.inf
    for _ in range(bests):
        s = 0
        for other in range(starts):
            if cost[other] < cost[s]:
                s = other
        if cost[s] == np.inf:
            break
        for other in range(starts):
            if other != s and cost[other] < np.inf and farthest(found[other], found[s]) < 0.3:
                cost[other] = np.inf
        cost[s] = np.inf
        value = _descend(body, goal, found[s], start, scale, most, np.inf, descents)
        if value < best:
            best = value
            copy(q, found[s])
    return best
