"""What messages say about joints: states, and commands in the forms that controllers take them.

Read are ``sensor_msgs/JointState`` (parallel lists ``name`` and ``position``, in radians by its definition),
``foxglove.JointStates`` (a list of joints; docs.foxglove.dev/docs/sdk/schemas/joint-states),
``trajectory_msgs/JointTrajectory`` and ``std_msgs/Float64MultiArray`` (which controllers of ros2_control take), as any
decoder returns them: dicts, or objects with fields.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.joints import Match, match_joints, means_a_joint, radians
from rejoint.logs.options import ImportOptions
from rejoint.logs.track import Points, Track
from rejoint.system.errors import FileError

NANOSECONDS = 1_000_000_000
STATES = ("JointState", "JointStates")
"""Kinds of messages that hold joint positions with their names"""
TRAJECTORY, ARRAY = "JointTrajectory", "Float64MultiArray"
REMEDY = "record it again, or save what is whole with `mcap recover` or `ros2 bag reindex`"
_STAMP_NAMES = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"), ("secs", "nsecs"))


class Sample(NamedTuple):
    """The joints in one message."""

    number: int
    header_ns: int
    log_ns: int
    names: tuple[str, ...]
    position: list[float]


class TrajectoryGoal(NamedTuple):
    """One message of a trajectory."""

    number: int
    header_ns: int
    log_ns: int
    names: tuple[str, ...]
    after: list[float]
    """[s] from its beginning to each point"""
    points: list[dict[str, list[float]]]
    """``positions``, ``velocities`` and ``accelerations`` of each, as far as given"""


def kind_of(schema: str) -> str:
    """Name of a message type without its package: ``JointState`` for ``sensor_msgs/msg/JointState``."""
    return schema.replace("/", ".").rpartition(".")[2]


def samples_of(messages: list[tuple[int, Any]], file: Path, topic: str, schema: str) -> list[Sample]:
    """Read joint positions; FileError names the message that holds none."""
    samples = []
    for number, (log_ns, message) in enumerate(messages, start=1):
        try:
            stamp, names, position = _joints(message, kind_of(schema))
            if position is None:
                raise ValueError("it has no positions")
            values = [float(value) for value in position]
            samples.append(Sample(number, nanoseconds(stamp), log_ns, tuple(str(name) for name in names), values))
        except (TypeError, ValueError, AttributeError, OverflowError) as error:
            raise FileError(
                file, f"topic {topic}, message {number}: no joint state ({error}), but {schema or 'of no named type'}",
                "name a topic with sensor_msgs/JointState",
            ) from error  # fmt: skip
    return samples


def _joints(message: Any, kind: str) -> tuple[Any, Any, Any]:  # noqa: ANN401 - what decoders return
    """Return stamp, names and positions of a message."""
    if kind == ARRAY:
        return None, (), field(message, "data")
    joints = field(message, "joints")
    if joints is None:
        return field(field(message, "header"), "stamp"), field(message, "name") or (), field(message, "position")
    position = [np.nan if (value := field(joint, "position")) is None else value for joint in joints]
    return field(message, "timestamp"), [field(joint, "name") for joint in joints], position


def goals_of(messages: list[tuple[int, Any]], file: Path, topic: str) -> list[TrajectoryGoal]:
    """Read trajectories; FileError names the message that is none."""
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
        except (TypeError, ValueError, AttributeError, OverflowError) as error:
            raise FileError(
                file, f"topic {topic}, message {number}: no trajectory of joint positions ({error})", REMEDY
            ) from error
    return goals


def field(message: Any, name: str) -> Any:  # noqa: ANN401
    """Get a field of a message that is a dict (JSON), an object (CDR) or protobuf; None where it is not set."""
    if message is None or isinstance(message, dict):
        return (message or {}).get(name)
    descriptor = getattr(message, "DESCRIPTOR", None)
    if descriptor is not None and name in descriptor.fields_by_name:
        found = descriptor.fields_by_name[name]
        if found.has_presence and not message.HasField(name):
            return None
    return getattr(message, name, None)


def nanoseconds(stamp: Any) -> int:  # noqa: ANN401
    """Read a time or duration [ns]; 0 where there is none."""
    if stamp is None:
        return 0
    for seconds, rest in _STAMP_NAMES:
        if field(stamp, seconds) is not None and field(stamp, rest) is not None:
            return int(field(stamp, seconds)) * NANOSECONDS + int(field(stamp, rest))
    raise ValueError(f"stamp {stamp!r} has no seconds and nanoseconds")


def track_of(
    samples: list[Sample], stamp: str, where: tuple[Path, str, str], arm: Arm, options: ImportOptions,
) -> tuple[list[int], Track, list[str]]:  # fmt: skip
    """Put each message's positions into the arm's order; returns stamps [ns], a track without times, and notes."""
    file, topic, what = where
    matches: dict[tuple[str, ...], Match | None] = {}
    times, values, numbers, columns, foreign = [], [], [], arm.joint_names, 0
    for sample in samples:
        place = f"{what} topic {topic}, message {sample.number}"
        names = sample.names or options.joint_order or ()
        if len(names) != len(sample.position):
            raise FileError(
                file, f"{place}: {len(names)} names for {len(sample.position)} positions",
                "set --order if the messages hold no names" if not sample.names else REMEDY,
            )  # fmt: skip
        if names not in matches:
            ours = any(means_a_joint(name, arm, options) for name in names)
            matches[names] = match_joints(names, arm, options, file, place) if ours else None
        match = matches[names]
        if match is None:
            foreign += 1
            continue
        columns = match.names
        times.append(sample.header_ns if stamp == "header" else sample.log_ns)
        values.append([sample.position[column] for column in match.columns])
        numbers.append(sample.number)
    if not times and samples:  # no message is about a joint of the arm: the first one is what an error shows
        match_joints(samples[0].names, arm, options, file, f"{what} topic {topic}, message {samples[0].number}")
    if not times:
        raise FileError(file, f"no joint state on {topic}", "record it again or name another topic")
    dropped = sorted({name for match in matches.values() if match for name in match.dropped})
    notes = [f"{what}: names that are no joints dropped: {', '.join(dropped)}"] * bool(dropped)
    notes += [f"{what}: {foreign} messages about other joints left out"] * bool(foreign)
    angles = radians(np.array(values, dtype=float), options.angle_unit or "rad", arm, options, file)
    track = Track(
        path=file, what=what, time=np.empty(len(times)), value=angles, columns=columns,
        place=f"topic {topic}, message", number=np.array(numbers, dtype=np.int64),
    )  # fmt: skip
    return times, track, notes


def points_of(messages: list[tuple[int, Any]], origin: int, file: Path) -> Points:
    """Read geometry_msgs/PointStamped messages."""
    times, values = [], []
    for number, (_, message) in enumerate(messages, start=1):
        try:
            times.append((nanoseconds(field(field(message, "header"), "stamp")) - origin) / NANOSECONDS)
            values.append([float(field(field(message, "point"), axis)) for axis in ("x", "y", "z")])
        except (TypeError, ValueError, AttributeError) as error:
            raise FileError(file, f"message {number} of a point topic is no PointStamped ({error})", REMEDY) from error
    return Points(time=np.array(times, dtype=float), value=np.array(values, dtype=float).reshape(-1, 3))
