"""What a controller of trajectories told its joints between the points of its goals.

As ``joint_trajectory_controller`` of ros2_controls does (``interpolate_between_points`` in ``trajectory.cpp``): from
where the joints are when a goal comes to its first point, then from point to point, linear where only positions are
given, cubic with velocities, quintic with accelerations too; after the last point it holds. A new goal replaces the
one before it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.logs.joints import match_joints, radians
from rejoint.logs.messages import NANOSECONDS, TrajectoryGoal
from rejoint.logs.options import ImportOptions
from rejoint.logs.track import Track
from rejoint.system.errors import FileError

_ORDERS = ("positions", "velocities", "accelerations")


def commands_of(
    goals: list[TrajectoryGoal],
    state: Track,
    stamp: str,
    origin: int,
    where: tuple[Path, str],
    arm: Arm,
    options: ImportOptions,
) -> Track:
    """Sample goals at the times of the states, which are counted from ``origin`` [ns].

    Raises FileError where no goal comes before the last state, or one lacks a joint.
    """
    file, topic = where
    starts = np.array([(_begin(goal, stamp) - origin) / NANOSECONDS for goal in goals])
    order = np.argsort(starts, kind="stable")
    starts, goals = starts[order], [goals[i] for i in order]
    command = np.full(state.value.shape, np.nan)
    number = np.zeros(len(state), dtype=np.int64)
    active = np.searchsorted(starts, state.time, side="right") - 1
    for index in np.unique(active[active >= 0]):
        goal, rows = goals[index], active == index
        match = match_joints(goal.names, arm, options, file, f"command topic {topic}, message {goal.number}")
        knots = [_knot(point, match.columns, arm, options, file) for point in goal.points]
        times = starts[index] + np.array(goal.after)
        if times[0] > starts[index]:  # a first point at the beginning leaves no way to it
            knots, times = [_now(state, starts[index]), *knots], np.concatenate([[starts[index]], times])
        command[rows] = _between(state.time[rows], times, knots)
        number[rows] = goal.number
    told = active >= 0
    if not told.any():
        raise FileError(file, f"no state after the first goal on {topic}", "record longer")
    return Track(
        path=file, what="command", time=state.time[told], value=command[told], columns=arm.joint_names,
        place=f"topic {topic}, message", number=number[told],
    )  # fmt: skip


def _begin(goal: TrajectoryGoal, stamp: str) -> int:
    return goal.header_ns if stamp == "header" and goal.header_ns else goal.log_ns


def _knot(
    point: dict[str, list[float]], columns: list[int], arm: Arm, options: ImportOptions, file: Path
) -> list[Array]:
    """Positions, velocities and accelerations (n,) of a point, as far as given, in the arm's order and radians."""
    found = []
    for key in _ORDERS:
        if key not in point:
            break
        values = np.array([point[key][column] for column in columns])
        found.append(radians(values, options.angle_unit or "rad", arm, options, file))
    return found


def _now(state: Track, time: float) -> list[Array]:
    """Where the joints are when a goal comes, and how fast."""
    row = int(np.clip(np.searchsorted(state.time, time), 1, len(state) - 1))
    before = max(row - 3, 0)
    speed = (state.value[row] - state.value[before]) / max(state.time[row] - state.time[before], 1e-9)
    position = np.array([np.interp(time, state.time, one) for one in state.value.T])
    return [position, speed, np.zeros_like(position)]


def _between(time: Array, times: Array, knots: list[list[Array]]) -> Array:
    """Commands (T, n) at ``time`` (T,) of a way through knots at ``times`` (K,), held at its ends."""
    result = np.empty((len(time), len(knots[0][0])))
    segment = np.searchsorted(times, time, side="right") - 1
    for index in np.unique(segment):
        rows = segment == index
        if index < 0 or index >= len(times) - 1:
            result[rows] = knots[max(index, 0)][0]
            continue
        start, end = knots[index], knots[index + 1]
        span = times[index + 1] - times[index]
        result[rows] = _spline(time[rows] - times[index], span, start, end)
    return result


def _spline(t: Array, span: float, start: list[Array], end: list[Array]) -> Array:
    """Polynomial of the degree that both knots determine, at ``t`` (T,) [s] after the first."""
    order = min(len(start), len(end))
    s, gap = (t / span)[:, None], end[0] - start[0]
    if order == 1:
        return start[0] + gap * s
    v0, v1 = start[1] * span, end[1] * span
    if order == 2:
        return start[0] + v0 * s + (3 * gap - 2 * v0 - v1) * s**2 + (v0 + v1 - 2 * gap) * s**3
    a0, a1 = start[2] * span**2, end[2] * span**2
    third = 10 * gap - 6 * v0 - 4 * v1 - 1.5 * a0 + 0.5 * a1
    fourth = -15 * gap + 8 * v0 + 7 * v1 + 1.5 * a0 - a1
    fifth = 6 * gap - 3 * (v0 + v1) - 0.5 * (a0 - a1)
    return start[0] + v0 * s + 0.5 * a0 * s**2 + third * s**3 + fourth * s**4 + fifth * s**5
