"""Compiled forward kinematics and distances."""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from __future__ import annotations

import numpy as np
from numba import float64, int64, njit, types, void

IN1, IN2, IN3, IN4 = (types.Array(float64, dimensions, "C", readonly=True) for dimensions in (1, 2, 3, 4))
ROWS1, ROWS2 = (types.Array(int64, dimensions, "C", readonly=True) for dimensions in (1, 2))
OUT2, OUT3, OUT4 = float64[:, ::1], float64[:, :, ::1], float64[:, :, :, ::1]

POINT = 1e-15
"""[m^2] squared length of a point (chosen)"""


@njit(OUT3(IN3, IN2, IN2), cache=True, nogil=True, fastmath={"contract"})
def _steps(terms, sine, cosine):  # noqa: ANN001, ANN202
    """Joint frames (n, 16, B), each in its parent."""
    joints, postures = sine.shape
    steps = np.empty((joints, 16, postures))
    for i in range(joints):
        for e in range(16):
            for b in range(postures):
                steps[i, e, b] = terms[i, e, 2] * cosine[i, b] + (terms[i, e, 1] * sine[i, b] + terms[i, e, 0])
    return steps


@njit(void(IN3, IN2, IN2, IN2, int64, OUT4), cache=True, nogil=True)
def fill_poses(terms, tip, sine, cosine, first, poses):  # noqa: ANN001, ANN201
    """Fill ``poses`` (n + 1, r, 4, B): r rows from ``first`` of the frames of joints and TCP.

    ``terms`` (n, 16, 3), ``tip`` (4, 4), ``sine`` and ``cosine`` (n, B).
    """
    steps = _steps(terms, sine, cosine)
    joints, rows, postures = len(steps), poses.shape[1], poses.shape[3]
    for r in range(rows):
        for k in range(4):
            for b in range(postures):
                poses[0, r, k, b] = steps[0, 4 * (first + r) + k, b]
    for i in range(1, joints):
        for r in range(rows):
            for k in range(4):
                for b in range(postures):
                    value = poses[i - 1, r, 0, b] * steps[i, k, b]
                    for j in range(1, 4):
                        value += poses[i - 1, r, j, b] * steps[i, 4 * j + k, b]
                    poses[i, r, k, b] = value
    for r in range(rows):
        for k in range(4):
            for b in range(postures):
                value = poses[joints - 1, r, 0, b] * tip[0, k]
                for j in range(1, 4):
                    value += poses[joints - 1, r, j, b] * tip[j, k]
                poses[joints, r, k, b] = value


@njit(void(IN2, IN4, OUT3), cache=True, nogil=True)
def fill_columns(axes, poses, columns):  # noqa: ANN001, ANN201
    """Fill ``columns`` (3, n, B) with TCP motions per radian; ``axes`` (n, 3)."""
    _, joints, postures = columns.shape
    axis, lever = np.empty(3), np.empty(3)
    for i in range(joints):
        for b in range(postures):
            for r in range(3):
                pose = poses[i, r]
                axis[r] = axes[i, 0] * pose[0, b] + axes[i, 1] * pose[1, b] + axes[i, 2] * pose[2, b]
                lever[r] = poses[joints, r, 3, b] - pose[3, b]
            for r in range(3):
                after, last = (r + 1) % 3, (r + 2) % 3
                columns[r, i, b] = axis[after] * lever[last] - axis[last] * lever[after]


@njit(float64(IN2, int64, int64), cache=True, nogil=True)
def _axis_distance(ends, i, j):  # noqa: ANN001, ANN202
    """Distance between the axes of links i and j; ``ends`` (n + 2, 3)."""
    a = e = b = c = f = 0.0
    for r in range(3):
        along, across = ends[i + 1, r] - ends[i, r], ends[j + 1, r] - ends[j, r]
        apart = ends[i, r] - ends[j, r]
        a, e, b = a + along * along, e + across * across, b + along * across
        c, f = c + along * apart, f + across * apart
    under = a * e - b * b
    s = min(max((b * f - c * e) / under, 0.0), 1.0) if under > POINT else 0.0
    t = min(max((b * s + f) / e, 0.0), 1.0) if e > POINT else 0.0
    s = min(max((b * t - c) / a, 0.0), 1.0) if a > POINT else 0.0
    square = 0.0
    for r in range(3):
        along, across = ends[i + 1, r] - ends[i, r], ends[j + 1, r] - ends[j, r]
        gap = ends[i, r] - ends[j, r] + s * along - t * across
        square += gap * gap
    return np.sqrt(square)


@njit(float64(IN2, int64, IN1, float64), cache=True, nogil=True)
def _box_slope(ends, link, box, t):  # noqa: ANN001, ANN202
    """Half the derivative, by ``t``, of the squared distance between box (6,) and link."""
    slope = 0.0
    for r in range(3):
        along = ends[link + 1, r] - ends[link, r]
        place = ends[link, r] + t * along
        slope += along * (max(place - box[3 + r], 0.0) - max(box[r] - place, 0.0))
    return slope


@njit(float64(IN2, int64, IN1), cache=True, nogil=True)
def box_distance(ends, link, box):  # noqa: ANN001, ANN201
    """Distance [m] between the axis of ``link`` and a ``box`` (6,); ``ends`` (n + 2, 3)."""
    low, high = 0.0, 1.0
    for side in range(6):
        r = side % 3
        along = ends[link + 1, r] - ends[link, r]
        if abs(along) < POINT:
            continue
        t = (box[side] - ends[link, r]) / along
        if low < t < high:
            if _box_slope(ends, link, box, t) < 0.0:
                low = t
            else:
                high = t
    first, last = _box_slope(ends, link, box, low), _box_slope(ends, link, box, high)
    t = low if first >= 0.0 else high if last <= 0.0 else low + (high - low) * first / (first - last)
    square = 0.0
    for r in range(3):
        place = ends[link, r] + t * (ends[link + 1, r] - ends[link, r])
        gap = max(place - box[3 + r], 0.0) + max(box[r] - place, 0.0)
        square += gap * gap
    return np.sqrt(square)


@njit(void(IN4, IN1, ROWS2, ROWS1, float64, float64, ROWS1, IN2, OUT2), cache=True, nogil=True)
def fill_clearances(poses, floors, pairs, grounded, radius, ground, links, boxes, out):  # noqa: ANN001, ANN201
    """Fill ``out`` (B, n + P + G + L K) [m] as `collision.clearances`.

    ``poses`` (n + 1, 3, 4, B), ``floors`` (n,), ``pairs`` (P, 2), ``grounded`` (G,), ``links`` (L,), ``boxes`` (K, 6).
    """
    joints, first = poses.shape[0], len(floors) + len(pairs)
    boxed = first + len(grounded)
    ends = np.zeros((joints + 1, 3))
    for b in range(len(out)):
        for i in range(joints):
            for r in range(3):
                ends[i + 1, r] = poses[i, r, 3, b]
        for k in range(len(floors)):
            out[b, k] = ends[k + 2, 2] - floors[k]
        for k in range(len(pairs)):
            out[b, len(floors) + k] = _axis_distance(ends, pairs[k, 0], pairs[k, 1]) - 2.0 * radius
        for k in range(len(grounded)):
            out[b, first + k] = ends[grounded[k], 2] - ground - radius
        for k in range(len(boxes)):
            for j in range(len(links)):
                out[b, boxed + k * len(links) + j] = box_distance(ends, links[j], boxes[k]) - radius
