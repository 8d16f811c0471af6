"""Where links end, and the distance of two segments, worked out in another way than the product does."""

import numpy as np

from rejoint.arms import Arm, frames


def link_ends(arm: Arm, q: np.ndarray) -> np.ndarray:
    """The base, the origins of all joint frames, and the TCP: (B, n + 2, 3) [m]."""
    f = frames(arm, q)
    return np.concatenate([np.zeros((len(q), 1, 3)), f.position, f.tcp_position[:, None]], axis=1)


def segments_apart(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distance of segments a-b and c-d (..., 3): the least of four ends from a segment, or zero gap of their planes."""
    ends = [_point_apart(a, c, d), _point_apart(b, c, d), _point_apart(c, a, b), _point_apart(d, a, b)]
    normal = np.cross(b - a, d - c)
    area = _dot(normal, normal)
    solid = area > 1e-14
    safe = np.where(solid, area, 1.0)
    s = _dot(np.cross(c - a, d - c), normal) / safe
    t = _dot(np.cross(c - a, b - a), normal) / safe
    inside = solid & (s >= 0.0) & (s <= 1.0) & (t >= 0.0) & (t <= 1.0)
    across = np.abs(_dot(c - a, normal)) / np.sqrt(safe)
    return np.minimum(np.min(ends, axis=0), np.where(inside, across, np.inf))


def _point_apart(point: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    way = end - start
    length = _dot(way, way)
    share = np.clip(_dot(point - start, way) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    gap = point - start - share[..., None] * way
    return np.sqrt(_dot(gap, gap))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)
