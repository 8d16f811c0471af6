"""Ways through joint space: to a posture, to a pose, along a straight line of the tool."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, solve_position, tcp_pose
from rejoint.arms.rotations import rotation_about

CARTESIAN_SPEED = 0.1
"""[m/s] highest tool speed on a straight line (vendor's communication protocol page)"""
TURN_SPEED = np.radians(40.0)
"""[rad/s] highest turning speed on a straight line (same page)"""

_TOLERANCE = 2e-4
"""[m, rad] accepted error of inverse kinematics; chosen: the wire resolves 1e-4."""
_STEP = 0.005
"""[m] between the waypoints of a straight line; chosen: the chord error stays below 0.1 mm."""
_TURN_STEP = np.radians(2.0)
_MAX_JUMP = np.radians(20.0)
"""Neighbouring waypoints further apart than this are another branch of solutions."""
_STARTS = 24
"""Random postures from which a pose is searched when the present one fails (chosen)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class TimedPath:
    """Waypoints and when they are passed at full speed."""

    points: Array
    """(k, n) [rad]"""
    time: Array
    """(k,) [s] not decreasing, from 0"""

    def at(self, time: float) -> Array:
        """Posture (n,) at ``time`` [s]."""
        return np.array([np.interp(time, self.time, column) for column in self.points.T])

    @property
    def duration(self) -> float:
        """[s] at full speed."""
        return float(self.time[-1])


def joint_path(start: Array, goal: Array, speed: float) -> TimedPath:
    """Straight way in joint space; the joint with the longest way moves at ``speed`` [rad/s]."""
    return TimedPath(points=np.stack([start, goal]), time=np.array([0.0, np.abs(goal - start).max() / speed]))


def solve_pose(arm: Arm, pose: Array, start: Array) -> Array | None:
    """Find a posture (n,) for a pose (4, 4), the nearest to ``start`` among several; None if there is none."""
    first = _solve(arm, pose, start[None], 100)
    if first is not None:
        return first
    rng = np.random.default_rng(0)
    return _solve(arm, pose, rng.uniform(arm.lower, arm.upper, (_STARTS, arm.joints)), 150, near=start)


def line_path(arm: Arm, start: Array, pose: Array, speed: float) -> tuple[TimedPath, bool]:
    """Straight line of the tool from posture ``start`` to ``pose``.

    Returns the way as far as it goes, and whether it reaches the pose.
    """
    here = tcp_pose(arm, start)
    turn = _rotation_vector(pose[:3, :3] @ here[:3, :3].T)
    length, angle = float(np.linalg.norm(pose[:3, 3] - here[:3, 3])), float(np.linalg.norm(turn))
    axis = turn / max(angle, 1e-12)  # without a turn it is zero, and so is the rotation about it
    count = max(1, int(np.ceil(max(length / _STEP, angle / _TURN_STEP))))
    slowest = max(length / CARTESIAN_SPEED, angle / TURN_SPEED) / count
    points, times = [start], [0.0]
    for i in range(1, count + 1):
        via = np.eye(4)
        via[:3, :3] = rotation_about(axis, angle * i / count) @ here[:3, :3]
        via[:3, 3] = here[:3, 3] + (pose[:3, 3] - here[:3, 3]) * i / count
        point = _solve(arm, via, points[-1][None], 40)
        if point is None or np.abs(point - points[-1]).max() > _MAX_JUMP:
            return TimedPath(points=np.array(points), time=np.array(times)), False
        times.append(times[-1] + max(slowest, np.abs(point - points[-1]).max() / speed))
        points.append(point)
    return TimedPath(points=np.array(points), time=np.array(times)), True


def _solve(arm: Arm, pose: Array, starts: Array, iterations: int, near: Array | None = None) -> Array | None:
    found = solve_position(arm, pose[:3, 3], starts, rotation=pose[:3, :3], tolerance=_TOLERANCE, iterations=iterations)
    if not found.converged.any():
        return None
    good: Array = found.q[found.converged]
    return good[np.argmin(np.abs(good - (starts[0] if near is None else near)).max(axis=1))]


def _rotation_vector(rotation: Array) -> Array:
    """Rotation vector (3,) [rad] of a rotation matrix; any axis at half a turn."""
    cosine = np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)
    angle = float(np.arccos(cosine))
    if angle < 1e-9:
        return np.zeros(3)
    if angle > np.pi - 1e-6:
        column = rotation + np.eye(3)
        axis = column[:, np.argmax(np.diag(column))]
        return np.pi * axis / np.linalg.norm(axis)
    skew = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    return angle * skew / (2.0 * np.sin(angle))
