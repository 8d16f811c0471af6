"""Compiled searches for a posture, by cost and descent in the null space, and for a way (RRT-Connect).

Goals are those of `rejoint.arms.compiled`. A *load* (2, n) [N m] is the torque that counts as one, and the largest.
RRT-Connect: Kuffner and LaValle 2000.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from typing import NamedTuple

import numpy as np
from numba import boolean, float64, int64, types, void

from rejoint.arms.arm import Array
from rejoint.arms.collision import CollisionShape
from rejoint.arms.compiled import (
    CHAIN,
    IN1,
    IN2,
    OUT1,
    OUT2,
    SHAPE,
    along,
    compiled,
    fill,
    gaps,
    in_null_space,
    inner,
    largest,
    place,
    solve,
    task,
    torques,
)
from rejoint.arms.kinematics import GRAVITY, REST_GAIN, TOLERANCE, Chain

AMPLE, CRAMPED = 5.0 / 3.0, 10.0
"""Least distances from which there is enough room, and cost of a sufficient clearance less (chosen by `python -m
benchmarks postures`)"""
FAR = 1000.0
"""Cost of an impossible posture"""
LOAD, MOST_LOAD, NEAR_LIMIT = 0.85, 1.5, 0.2
"""Share of torque that costs, share from which only the largest counts, and costly distance [rad] from a limit"""
TRAVEL = 0.6
"""Cost of half a turn"""
LOCAL_ROUNDS, ROUNDS, DESCENTS = 200, 25, 10
NEAR_REACH = 0.2
"""[rad] between neighbours for a lower cost"""
COMFORT_LOAD, COMFORT_LIMIT = 0.8, float(np.radians(3.0))


class Body(NamedTuple):  # Numba's files on disk name this class: give this module a new name if the class gets one
    """An arm in compiled loops."""

    chain: Chain
    shape: CollisionShape
    """with `collision.guarded_floors`"""
    inner: Array
    """(2, n) [rad] limits less margin"""
    least: Array
    """(c,) [m] least distances; minus infinity: constant"""
    spacious: float
    """[m] sufficient clearance"""
    levers: Array
    """(n + c, n) [m] bounds of the changes of clearances per radian"""
    step: float
    """[m] by which a clearance may change between checks"""


BODY = types.NamedTuple((CHAIN, SHAPE, IN2, IN1, float64, IN2, float64), Body)


@compiled(types.UniTuple(float64, 4)(BODY, IN1, IN2))
def _judge(body, q, load):  # noqa: ANN001, ANN202
    """Cost of a posture without travel, largest torque share, lack of `AMPLE` distances, distance from a limit.

    A cost of `FAR` and more: impossible.
    """
    poses, limits, joints = place(body.chain, q), body.chain.limits, len(q)
    torque, clear = torques(body.chain, poses, GRAVITY), gaps(poses, body.shape)
    cost = wrong = share = over = lack = 0.0
    away = np.inf
    for i in range(joints):
        lifted = abs(torque[i])
        share, over = max(share, lifted / load[0, i]), max(over, lifted / load[1, i])
        near = min(q[i] - limits[0, i], limits[1, i] - q[i])
        cost += 0.5 * min(lifted / load[0, i] / LOAD, MOST_LOAD) ** 4
        cost += 0.5 * max(1.0 - near / NEAR_LIMIT, 0.0) ** 2
        away = min(away, near)
        if clear[i] < -2.0 * TOLERANCE:
            wrong -= clear[i] / body.spacious
    cost += 10.0 * max(share - LOAD, 0.0)
    if over > 1.0:
        wrong += 0.1 + over - 1.0
    for k in range(len(body.least)):
        gap, least = clear[joints + k], body.least[k]
        if least > -np.inf:
            lack = max(lack, AMPLE * least - gap)
            cost += CRAMPED * max(AMPLE * least - gap, 0.0) / body.spacious
            cost += 0.5 * max(1.0 - gap / body.spacious, 0.0) ** 2
            if gap < least:
                wrong += 0.1 + (least - gap) / body.spacious
    return cost + (FAR * (1.0 + wrong) if wrong > 0.0 else 0.0), share, lack, away


@compiled(float64(BODY, IN1, IN1, IN2))
def _cost(body, q, start, load):  # noqa: ANN001, ANN202
    """Cost of a posture (n,) with its travel, nearly that of the joint that turns most."""
    travel = 0.0
    for i in range(len(q)):
        travel += ((q[i] - start[i]) / np.pi) ** 4
    return _judge(body, q, load)[0] + TRAVEL * np.sqrt(np.sqrt(travel))


@compiled(float64(BODY, IN1, OUT1, IN1, IN2, float64, int64))
def _descend(body, goal, q, start, load, reach, rounds):  # noqa: ANN001, ANN202
    """Lower the cost of ``q`` (n,) in the null space, and return it.

    No joint moves more than ``reach`` [rad].
    """
    joints, limits = len(q), np.empty((2, len(q)))
    for i in range(joints):
        limits[0, i], limits[1, i] = max(body.inner[0, i], q[i] - reach), min(body.inner[1, i], q[i] + reach)
    cost, slope, trial = _cost(body, q, start, load), np.zeros(joints), np.empty(joints)
    length, fresh = 0.15, True
    for _ in range(rounds):
        if fresh:
            for i in range(joints):
                kept = q[i]
                q[i] += 1e-4
                slope[i] = (cost - _cost(body, q, start, load)) / 1e-4
                q[i] = kept
            slope = in_null_space(task(body.chain, goal, q)[1], slope)
            if largest(slope) < 1e-3:
                return cost
        steepest, fresh = largest(slope), False
        for i in range(joints):
            trial[i] = q[i] + length * slope[i] / steepest
        if solve(body.chain, goal, trial, limits, 0.0, 8, TOLERANCE) < TOLERANCE:
            there = _cost(body, trial, start, load)
            if there < cost - 1e-4:
                fill(q, trial)
                cost, fresh = there, True
        length *= 1.5 if fresh else 0.4
        if length < 0.005:
            break
    return cost


@compiled(void(BODY, IN2, IN2, OUT1))
def judge_all(body, postures, load, costs):  # noqa: ANN001, ANN201
    """Fill ``costs`` (N,) of ``postures`` (N, n) without travel."""
    for k in range(len(postures)):
        costs[k] = _judge(body, postures[k], load)[0]


@compiled(types.Tuple((float64, OUT1))(BODY, IN1, IN1, IN2, boolean))
def stay(body, goal, start, load, near):  # noqa: ANN001, ANN201
    """Cost, or infinity, and the goal's posture (n,) on the branch of ``start`` (n,).

    A comfortable posture of `solve_position` is kept. ``near``: lower the cost from the nearest posture.
    """
    q, rounds = start.copy(), LOCAL_ROUNDS if goal[16] == 0.0 else LOCAL_ROUNDS // 2
    missed = solve(body.chain, goal, q, body.chain.limits, REST_GAIN, rounds, TOLERANCE)
    if missed < TOLERANCE:
        cost, share, lack, away = _judge(body, q, load)
        light = np.isinf(load[1, 0]) or share < COMFORT_LOAD
        light = light and not (near and largest(q - start) > NEAR_REACH)
        if cost < FAR and light and lack <= 0.0 and away >= COMFORT_LIMIT:
            return 0.0, q
    if near or missed >= TOLERANCE:
        fill(q, start)
    if solve(body.chain, goal, q, body.inner, 0.0, ROUNDS, TOLERANCE) >= TOLERANCE:
        return np.inf, q
    return _descend(body, goal, q, start, load, NEAR_REACH if near else np.inf, DESCENTS), q


@compiled(types.Tuple((float64, OUT1))(BODY, OUT2, IN1, IN1, IN2, int64, int64))
def search(body, found, goal, start, load, bests, descents):  # noqa: ANN001, ANN201
    """Cost, or infinity, and best posture (n,) of a goal.

    All postures ``found`` (S, n) are moved to the goal; the ``bests`` different ones are improved.
    """
    cost = np.full(len(found), np.inf)
    for s in range(len(found)):
        if solve(body.chain, goal, found[s], body.inner, 0.0, ROUNDS, TOLERANCE) < TOLERANCE:
            cost[s] = _cost(body, found[s], start, load)
    best, q = np.inf, start.copy()
    for _ in range(bests):
        s = int(np.argmin(cost))
        if cost[s] == np.inf:
            break
        chosen = found[s].copy()
        for other in range(len(found)):
            if largest(found[other] - chosen) < 0.3:
                cost[other] = np.inf
        value = _descend(body, goal, chosen, start, load, np.inf, descents)
        if value < best:
            best, q = value, chosen
    return best, q


ROUNDING = 1e-7
"""[m] tolerance of distances"""
LONGEST, SHORTEST = 1.5, 0.02
"""[rad] branch lengths, by the joint that turns most (chosen)"""


@compiled(types.Tuple((float64, int64))(BODY, IN1, IN1, IN1, boolean))
def passable(body, start, goal, least, leaving):  # noqa: ANN001, ANN201
    """Share, 0 to 1, of the straight line ``start`` to ``goal`` (n,) that keeps ``least`` (n + c,) [m]; what ends it.

    ``leaving``: too small distances at the start may grow.
    """
    rates, here = np.zeros(len(least)), np.empty(len(start))
    for k in range(len(least)):
        for i in range(len(start)):
            rates[k] += body.levers[k, i] * abs(goal[i] - start[i])
    before, share, safe = np.full(len(least), -np.inf), 0.0, 0.0
    while True:
        along(start, goal, share, here)
        clear, ahead = gaps(place(body.chain, here), body.shape), 1.0
        for k in range(len(least)):
            leaves = leaving and before[k] < least[k] and clear[k] >= before[k]
            if clear[k] < least[k] - ROUNDING and not leaves:
                return safe, k
            ahead = min(ahead, max(clear[k] - least[k], body.step) / max(rates[k], 1e-12))
        before, safe = clear, share
        if share >= 1.0:
            return 1.0, 0
        share = min(1.0, share + ahead)


@inner
def _branch(nodes, parents, node):  # noqa: ANN001, ANN202
    """Rows (k, n) from ``node`` to the root of its tree."""
    chain = [node]
    while parents[chain[-1]] >= 0:
        chain.append(parents[chain[-1]])
    return nodes[np.array(chain)]


@compiled(OUT2(BODY, IN1, IN1, IN2, IN1))
def connect(body, start, goal, drawn, least):  # noqa: ANN001, ANN201
    """Corners (k, n) of a way from ``start`` to ``goal`` (n,); k is 0 if none is found.

    ``drawn`` (D, n): random postures; the rest as in `passable`.
    """
    joints, most = len(start), 2 * len(drawn) + 2
    nodes, parents, counts = np.empty((2, most, joints)), np.empty((2, most), np.int64), np.ones(2, np.int64)
    parents[0, 0], parents[1, 0], end = -1, -1, np.empty(joints)
    fill(nodes[0, 0], start)
    fill(nodes[1, 0], goal)
    for k in range(len(drawn)):
        tree, aim = k % 2, drawn[k].copy()
        for side in (tree, 1 - tree):
            near, least_apart = 0, np.inf
            for node in range(counts[side]):
                apart = 0.0
                for i in range(joints):
                    apart += (nodes[side, node, i] - aim[i]) ** 2
                if apart < least_apart:
                    near, least_apart = node, apart
            origin = nodes[side, near]
            size = largest(aim - origin)
            if size < 1e-9:
                continue
            reach = 1.0 if side != tree else min(1.0, LONGEST / size)
            along(origin, aim, reach, end)
            share = passable(body, origin, end, least, False)[0]
            joined = side != tree and share == 1.0
            if share * reach * size < SHORTEST and not joined:
                if side == tree:
                    break
                continue
            count = counts[side]
            along(origin, end, share, nodes[side, count])
            if share == 1.0 and reach == 1.0:
                fill(nodes[side, count], aim)
            parents[side, count] = near
            counts[side] += 1
            if joined:
                first = _branch(nodes[0], parents[0], counts[0] - 1)
                last = _branch(nodes[1], parents[1], counts[1] - 1)
                return np.concatenate((first[::-1], last[1:]))
            aim = nodes[side, count].copy()
    return np.empty((0, joints))
