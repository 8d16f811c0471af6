"""Compiled loops of the planner.

The tree search is RRT-Connect (Kuffner and LaValle 2000).
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from __future__ import annotations

import numpy as np
from numba import boolean, float64, int64, njit, types

from rejoint.arms.compiled import IN1, IN2, OPTIONS, OUT2, largest, place
from rejoint.arms.redundancy import BODY, measure

ROUNDING = 1e-7
"""[m] tolerance of distances"""
LONGEST, SHORTEST = 1.5, 0.02
"""[rad] branch lengths, by the joint that turns most (chosen)"""


@njit(types.Tuple((float64, int64))(BODY, IN1, IN1, IN2, IN1, float64, boolean), **OPTIONS)
def passable(body, start, goal, levers, least, step, leaving):  # noqa: ANN001, ANN201
    """Share, 0 to 1, of the straight line ``start`` to ``goal`` (n,) that keeps ``least`` (n + c,) [m]; what ends it.

    ``levers`` (n + c, n) [m] bound the changes per radian. Between checks a distance changes by ``step`` [m] or its
    reserve at most. ``leaving``: too small distances at the start may grow.
    """
    rates = (levers * np.abs(goal - start)).sum(axis=1)
    before, share, safe = np.full(len(least), -np.inf), 0.0, 0.0
    while True:
        clear, ahead = measure(body, place(body.chain, start + share * (goal - start))), 1.0
        for k in range(len(least)):
            leaves = leaving and before[k] < least[k] and clear[k] >= before[k]
            if clear[k] < least[k] - ROUNDING and not leaves:
                return safe, k
            ahead = min(ahead, max(clear[k] - least[k], step) / max(rates[k], 1e-12))
        before, safe = clear, share
        if share >= 1.0:
            return 1.0, 0
        share = min(1.0, share + ahead)


@njit(int64(OUT2, int64, IN1), **OPTIONS)
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


@njit(**OPTIONS)
def _branch(nodes, parents, node):  # noqa: ANN001, ANN202
    """Rows (k, n) from ``node`` to the root of its tree."""
    chain = [node]
    while parents[chain[-1]] >= 0:
        chain.append(parents[chain[-1]])
    return nodes[np.array(chain)]


@njit(OUT2(BODY, IN1, IN1, IN2, IN2, IN1, float64), **OPTIONS)
def connect(body, start, goal, drawn, levers, least, step):  # noqa: ANN001, ANN201
    """Corners (k, n) of a way from ``start`` to ``goal`` (n,); k is 0 if none is found.

    ``drawn`` (D, n): random postures; the rest as in `passable`.
    """
    joints, most = len(start), 2 * len(drawn) + 2
    nodes, parents, counts = np.empty((2, most, joints)), np.empty((2, most), np.int64), np.ones(2, np.int64)
    nodes[0, 0], nodes[1, 0], parents[0, 0], parents[1, 0] = start, goal, -1, -1
    for k in range(len(drawn)):
        tree, aim = k % 2, drawn[k].copy()
        for side in (tree, 1 - tree):
            near = _closest(nodes[side], counts[side], aim)
            origin = nodes[side, near]
            size = largest(aim - origin)
            if size < 1e-9:
                continue
            reach = 1.0 if side != tree else min(1.0, LONGEST / size)
            end = origin + reach * (aim - origin)
            share = passable(body, origin, end, levers, least, step, False)[0]
            joined = side != tree and share == 1.0
            if share * reach * size < SHORTEST and not joined:
                if side == tree:
                    break
                continue
            count = counts[side]
            nodes[side, count] = aim if share == 1.0 and reach == 1.0 else origin + share * (end - origin)
            parents[side, count] = near
            counts[side] += 1
            if joined:
                first = _branch(nodes[0], parents[0], counts[0] - 1)
                last = _branch(nodes[1], parents[1], counts[1] - 1)
                return np.concatenate((first[::-1], last[1:]))
            aim = nodes[side, count].copy()
    return np.empty((0, joints))
