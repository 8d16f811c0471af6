"""Joint states, commands and trajectory goals in messages of ROS and Foxglove.

``sensor_msgs/JointState``, ``foxglove.JointStates`` (docs.foxglove.dev/docs/sdk/schemas/joint-states),
``control_msgs/JointTrajectoryControllerState``, ``trajectory_msgs/JointTrajectory`` and ``std_msgs/Float64MultiArray``,
decoded to dicts or objects with fields.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.logs.joints import match_joints, meanings
from rejoint.logs.options import ImportOptions
from rejoint.logs.track import ColumnFrame, Track
from rejoint.system.errors import FileError
from rejoint.system.textfile import ANGLES

NANOSECONDS = 1_000_000_000
STATES = ("JointState", "JointStates")
"""Message types with joint positions and names"""
TRAJECTORY, ARRAY, CONTROLLER = "JointTrajectory", "Float64MultiArray", "JointTrajectoryControllerState"
REMEDY = "record it again, or save what is whole with `mcap recover` or `ros2 bag reindex`"
_STAMP_NAMES = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"), ("secs", "nsecs"))
_WRONG = (TypeError, ValueError, AttributeError, OverflowError)
"""Errors of a wrong message"""


class Sample(NamedTuple):
    """Joints in one message."""

    number: int
    header_ns: int
    log_ns: int
    names: tuple[str, ...]
    groups: Mapping[str, Sequence[float]]
    """``position``, ``command`` or ``torque`` to numbers per joint"""


class TrajectoryGoal(NamedTuple):
    """A trajectory message."""

    number: int
    header_ns: int
    log_ns: int
    names: tuple[str, ...]
    after: list[float]
    """[s] of each point"""
    points: list[dict[str, list[float]]]
    """``positions``, ``velocities`` and ``accelerations`` per point"""


def kind_of(schema: str) -> str:
    """Message type without its package: ``JointState``."""
    return schema.replace("/", ".").rpartition(".")[2]


def samples_of(messages: list[tuple[int, Any]], file: Path, topic: str, schema: str, group: str) -> list[Sample]:
    """Joint numbers as a ``group``; FileError."""
    samples = []
    for number, (log_ns, message) in enumerate(messages, start=1):
        try:
            stamp, names, found = _joints(message, kind_of(schema), group)
            groups = {key: [float(value) for value in values] for key, values in found.items()}
            samples.append(Sample(number, nanoseconds(stamp), log_ns, tuple(str(name) for name in names), groups))
        except _WRONG as error:
            raise FileError(
                file,
                f"topic {topic}, message {number}: no joint state ({error}), but {schema or 'of no named type'}",
                "name a topic with sensor_msgs/JointState",
            ) from error
    return samples


def _joints(message: Any, kind: str, group: str) -> tuple[Any, Any, dict[str, Any]]:  # noqa: ANN401
    if kind == ARRAY:
        return None, (), {group: field(message, "data")}
    stamp, joints = field(field(message, "header"), "stamp"), field(message, "joints")
    if kind == CONTROLLER:
        feedback, reference = (_point(message, *names) for names in (("feedback", "actual"), ("reference", "desired")))
        found = {"position": field(feedback, "positions"), "command": field(reference, "positions")}
        return stamp, field(message, "joint_names"), found | _effort(field(feedback, "effort"), found["position"])
    if joints is not None:
        held = {key: [field(joint, key) for joint in joints] for key in ("name", "position", "effort")}
        position = [np.nan if value is None else value for value in held["position"]]
        effort = [] if None in held["effort"] else held["effort"]
        return field(message, "timestamp"), held["name"], {group: position} | _effort(effort, position)
    position = field(message, "position")
    if position is None:
        raise ValueError("it has no positions")
    more = _effort(field(message, "effort"), position) if group == "position" else {}
    return stamp, field(message, "name") or (), {group: position} | more


def _point(message: Any, *names: str) -> Any:  # noqa: ANN401
    points = [field(message, name) for name in names]
    return next((point for point in points if point is not None and len(field(point, "positions"))), points[0])


def _effort(effort: Any, position: Any) -> dict[str, Any]:  # noqa: ANN401
    told = effort is not None and len(effort) == len(position) > 0 and np.any(np.asarray(effort, dtype=float))
    return {"torque": effort} if told else {}


def goals_of(messages: list[tuple[int, Any]], file: Path, topic: str) -> list[TrajectoryGoal]:
    """Trajectories; FileError."""
    goals = []
    for number, (log_ns, message) in enumerate(messages, start=1):
        try:
            names = tuple(str(name) for name in field(message, "joint_names"))
            points, after = [], []
            for point in field(message, "points"):
                found = {
                    key: [float(value) for value in values]
                    for key in ("positions", "velocities", "accelerations")
                    if (values := field(point, key)) is not None and len(values)
                }
                if any(len(values) != len(names) for values in found.values()) or "positions" not in found:
                    raise ValueError(f"{len(names)} names, but {', '.join(f'{len(v)} {k}' for k, v in found.items())}")
                points.append(found)
                after.append(nanoseconds(field(point, "time_from_start")) / NANOSECONDS)
            if not points or (np.diff(after) <= 0).any():
                raise ValueError("its points are not one after another in time" if points else "it has no points")
            stamp = nanoseconds(field(field(message, "header"), "stamp"))
            goals.append(TrajectoryGoal(number, stamp, log_ns, names, after, points))
        except _WRONG as error:
            raise FileError(
                file, f"topic {topic}, message {number}: no trajectory of joint positions ({error})", REMEDY
            ) from error
    return goals


def field(message: Any, name: str) -> Any:  # noqa: ANN401
    """Field of a dict, an object or protobuf, or None."""
    if message is None or isinstance(message, dict):
        return (message or {}).get(name)
    descriptor = getattr(message, "DESCRIPTOR", None)
    if descriptor is not None and name in descriptor.fields_by_name:
        found = descriptor.fields_by_name[name]
        if found.has_presence and not message.HasField(name):
            return None
    return getattr(message, name, None)


def nanoseconds(stamp: Any) -> int:  # noqa: ANN401
    """Time or duration [ns], or 0."""
    if stamp is None:
        return 0
    for seconds, rest in _STAMP_NAMES:
        if field(stamp, seconds) is not None and field(stamp, rest) is not None:
            return int(field(stamp, seconds)) * NANOSECONDS + int(field(stamp, rest))
    raise ValueError(f"stamp {stamp!r} has no seconds and nanoseconds")


def frame_of(
    samples: list[Sample],
    clock: tuple[str, int],
    where: tuple[Path, str],
    arm: Arm,
    options: ImportOptions,
    notes: list[str],
) -> ColumnFrame:
    """Columns of messages; other joints are dropped with a note.

    ``clock``: ``header`` or ``log``, and its origin [ns].
    """
    file, topic = where
    columns: dict[str, int] = {}
    rows: list[dict[int, float]] = []
    own = {names: any(meanings(names, arm, options)) for names in {sample.names for sample in samples}}
    foreign = [sample for sample in samples if sample.names and not own[sample.names]]
    if len(foreign) < len(samples):  # else an error shows their names
        notes += [f"topic {topic}: {len(foreign)} messages about other joints left out"] * bool(foreign)
        samples = [sample for sample in samples if not sample.names or own[sample.names]]
    for sample in samples:
        names = sample.names or options.names or ()
        row: dict[int, float] = {}
        for group, given in sample.groups.items():
            if len(names) != len(given):
                said = f"topic {topic}, message {sample.number}: {len(names)} names for {len(given)} {group}s"
                raise FileError(file, said, REMEDY if sample.names else "set --order if the messages hold no names")
            titles = [f"{group}.{name}" for name in names]
            row |= {columns.setdefault(title, len(columns)): one for title, one in zip(titles, given, strict=True)}
        rows.append(row)
    values: Array = np.full((len(rows), len(columns)), np.nan)
    for k, row in enumerate(rows):
        values[k, [*row]] = [*row.values()]
    stamps = [(sample.header_ns if clock[0] == "header" else sample.log_ns) - clock[1] for sample in samples]
    return ColumnFrame(
        path=file,
        titles=tuple(columns),
        values=lambda chosen: values[:, chosen],
        place=f"topic {topic}, message",
        number=np.array([sample.number for sample in samples], dtype=np.int64),
        angle_unit="rad",
        found=f"topic {topic}",
        # whole nanoseconds are subtracted before they become float64, which keeps them exact
        time=np.array([stamp / NANOSECONDS for stamp in stamps], dtype=float),
    )


_ORDERS = ("positions", "velocities", "accelerations")


def commands_of(
    goals: list[TrajectoryGoal],
    state: Track,
    clock: tuple[str, int],
    where: tuple[Path, str],
    arm: Arm,
    options: ImportOptions,
) -> Track:
    """Sample goals at the times of the states; ``clock`` as `frame_of`.

    As ``interpolate_between_points`` of joint_trajectory_controller: from the present state through the points, linear,
    cubic or quintic; the last point holds, a new goal replaces the old one. FileError for missing joints, or no goal
    before the last state.
    """
    from scipy.interpolate import BPoly

    file, topic = where
    goals = sorted(goals, key=lambda goal: _begin(goal, clock[0]))
    starts = np.array([(_begin(goal, clock[0]) - clock[1]) / NANOSECONDS for goal in goals])
    command = np.full(state.value.shape, np.nan)
    number = np.zeros(len(state), dtype=np.int64)
    active = np.searchsorted(starts, state.time, side="right") - 1
    told = active >= 0
    if not told.any():
        raise FileError(file, f"no state after the first goal on {topic}", "record longer")
    for index in np.unique(active[told]):
        goal, rows = goals[index], np.flatnonzero(active == index)
        knots, times = _knots(goal, arm, options, where), starts[index] + np.array(goal.after)
        if times[0] > starts[index]:  # a first point at the beginning leaves no way to it
            knots, times = [_now(state, starts[index]), *knots], np.concatenate([[starts[index]], times])
        asked = np.clip(state.time[rows], times[0], times[-1])
        command[rows] = knots[0][0]
        between = np.minimum(np.searchsorted(times, asked, side="right") - 1, len(times) - 2)
        for k in np.unique(between[between >= 0]):
            size = min(len(knots[k]), len(knots[k + 1]))  # the degree that both knots determine
            ends = [np.stack(knot[:size]) for knot in knots[k : k + 2]]
            own = between == k
            command[rows[own]] = BPoly.from_derivatives(times[k : k + 2], ends)(asked[own])
        number[rows] = goal.number
    return Track(
        path=file,
        what="command",
        time=state.time[told],
        value=command[told],
        columns=arm.joint_names,
        place=f"topic {topic}, message",
        number=number[told],
    )


def _begin(goal: TrajectoryGoal, stamp: str) -> int:
    return goal.header_ns if stamp == "header" and goal.header_ns else goal.log_ns


def _knots(goal: TrajectoryGoal, arm: Arm, options: ImportOptions, where: tuple[Path, str]) -> list[list[Array]]:
    """Positions, velocities, accelerations (n,) of each point, in radians."""
    file, topic = where
    match = match_joints(goal.names, arm, file, f"command topic {topic}, message {goal.number}", options)
    scale, offset = (np.array([getattr(one, key) for one in match.linear]) for key in ("scale", "offset"))
    if options.angle_unit == "normalised":
        raise FileError(file, "trajectories are in radians or degrees", "set another --angle-unit")
    factor = ANGLES[options.angle_unit or "rad"]
    return [
        [
            factor * (scale * np.array(point[key])[match.columns] + offset * (order == 0))
            for order, key in enumerate(_ORDERS)
            if {*_ORDERS[: order + 1]} <= {*point}
        ]
        for point in goal.points
    ]


def _now(state: Track, time: float) -> list[Array]:
    row = int(np.clip(np.searchsorted(state.time, time), 1, len(state) - 1))
    before = max(row - 3, 0)
    speed = (state.value[row] - state.value[before]) / max(state.time[row] - state.time[before], 1e-9)
    position = np.array([np.interp(time, state.time, one) for one in state.value.T])
    return [position, speed, np.zeros_like(position)]
