"""Compiled loops of the planner.

The tree search is RRT-Connect (Kuffner and LaValle 2000).
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, njit, void

from rejoint.arms.compiled import IN1, IN2, IN3, OUT2
from rejoint.arms.redundancy import BODY, OUT1, copy, farthest, measure, place

ROUNDING = 1e-7
"""[m] tolerance of distances"""
LONGEST, SHORTEST = 1.5, 0.02
"""[rad] branch lengths, by the joint that turns most (chosen)"""
_OPTIONS = {"cache": True, "nogil": True}


@njit(float64(BODY, IN1, IN1, IN2, IN1, float64, boolean, OUT1), **_OPTIONS)
def passable(body, start, goal, levers, least, step, leaving, worst):  # noqa: ANN001, ANN201
    """Share, 0 to 1, of the straight line from ``start`` to ``goal`` (n,) that keeps ``least`` (n + c,) [m].

    ``levers`` (n + c, n) [m] bound the changes per radian. Between checks a distance changes by ``step`` [m] or its
    reserve at most. ``leaving``: too small distances at the start may grow. Fills ``worst`` (2,): the violated
    distance, and its share.
    """
    joints = len(start)
    clear, before, poses = np.empty((1, len(least))), np.empty(len(least)), np.empty((joints + 1, 3, 4, 1))
    q, rates = np.empty(joints), np.zeros(len(least))
    for k in range(len(least)):
        for i in range(joints):
            rates[k] += levers[k, i] * abs(goal[i] - start[i])
    share, safe = 0.0, 0.0
    first = True
    while True:
        for i in range(joints):
            q[i] = start[i] + share * (goal[i] - start[i])
        place(body, q, poses)
        measure(body, poses, clear)
        ahead = 1.0
        for k in range(len(least)):
            value = clear[0, k]
            leaves = leaving and (first or (before[k] < least[k] and value >= before[k]))
            if value < least[k] - ROUNDING and not leaves:
                worst[0], worst[1] = k, share
                return safe
            ahead = min(ahead, max(value - least[k], step) / max(rates[k], 1e-12))
            before[k] = value
        safe, first = share, False
        if share >= 1.0:
            return 1.0
        share = min(1.0, share + ahead)


@njit(int64(OUT2, int64, IN1), **_OPTIONS)
def _closest(nodes, count, q):  # noqa: ANN001, ANN202
    """Nearest to ``q`` (n,) of the first ``count`` rows."""
    best, least = 0, np.inf
    for k in range(count):
        square = 0.0
        for i in range(len(q)):
            square += (nodes[k, i] - q[i]) ** 2
        if square < least:
            best, least = k, square
    return best


@njit(**_OPTIONS)
def _trace(nodes, parents, counts, way):  # noqa: ANN001, ANN202
    chain = np.empty(len(way), np.int64)
    count = 0
    for tree in range(2):
        found, node = 0, counts[tree] - 1
        while node >= 0 and found < len(chain):
            chain[found] = node
            found += 1
            node = parents[tree, node]
        for k in range(tree, found):
            if count == len(way):
                return 0
            copy(way[count], nodes[tree, chain[found - 1 - k if tree == 0 else k]])
            count += 1
    return count


@njit(int64(BODY, IN1, IN1, IN2, IN2, IN1, float64, OUT2), **_OPTIONS)
def connect(body, start, goal, drawn, levers, least, step, way):  # noqa: ANN001, ANN201
    """Fill ``way`` (M, n) with corners from ``start`` to ``goal`` (n,); returns their number, 0: none.

    ``drawn`` (D, n): random postures; the rest as in `passable`.
    """
    joints, most = len(start), 2 * len(drawn) + 2
    nodes, parents, counts = np.empty((2, most, joints)), np.empty((2, most), np.int64), np.ones(2, np.int64)
    copy(nodes[0, 0], start)
    copy(nodes[1, 0], goal)
    parents[0, 0] = parents[1, 0] = -1
    worst, aim, end = np.empty(2), np.empty(joints), np.empty(joints)
    for k in range(len(drawn)):
        tree = k % 2
        copy(aim, drawn[k])
        for side in (tree, 1 - tree):
            near = _closest(nodes[side], counts[side], aim)
            size = farthest(aim, nodes[side, near])
            if size < 1e-9:
                continue
            reach = 1.0 if side != tree else min(1.0, LONGEST / size)
            for i in range(joints):
                end[i] = nodes[side, near, i] + reach * (aim[i] - nodes[side, near, i])
            share = passable(body, nodes[side, near], end, levers, least, step, False, worst)
            if share * reach * size < SHORTEST and not (side != tree and share == 1.0):
                if side == tree:
                    break
                continue
            count = counts[side]
            for i in range(joints):
                there = nodes[side, near, i] + share * (end[i] - nodes[side, near, i])
                nodes[side, count, i] = aim[i] if share == 1.0 and reach == 1.0 else there
            parents[side, count] = near
            counts[side] += 1
            if side != tree and share == 1.0:
                return _trace(nodes, parents, counts, way)
            copy(aim, nodes[side, count])
    return 0


@njit(void(IN1, IN2, IN1, IN3, IN1, int64, OUT2), **_OPTIONS)
def follow(start, moves, begins, profiles, time, derivative, out):  # noqa: ANN001, ANN201
    """Fill ``out`` (T, n) with positions, or a derivative, at ``time`` (T,) of a `JointTrajectory`."""
    for t in range(len(time)):
        for i in range(len(start)):
            out[t, i] = start[i] if derivative == 0 else 0.0
        for m in range(len(moves)):
            knots, past = profiles[m, 0], time[t] - begins[m]
            if past < 0.0 or (derivative > 0 and past > knots[7]):
                continue
            k = 0
            while k < 6 and past >= knots[k + 1]:
                k += 1
            past = min(past, knots[7]) - knots[k]
            share, speed, gain, jerk = profiles[m, 1, k], profiles[m, 2, k], profiles[m, 3, k], profiles[m, 4, k]
            if derivative == 0:
                value = min(share + past * (speed + past * (gain / 2.0 + past * jerk / 6.0)), 1.0)
            elif derivative == 1:
                value = speed + past * (gain + past * jerk / 2.0)
            else:
                value = gain + past * jerk if derivative == 2 else jerk
            for i in range(len(start)):
                out[t, i] += value * moves[m, i]
