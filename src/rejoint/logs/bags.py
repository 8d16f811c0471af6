"""Bags of ROS 1 and 2 and MCAP files (mcap.dev/spec): topics, clocks, joint states, commands and trajectories.

Messages are ``sensor_msgs/JointState``, ``foxglove.JointStates`` (docs.foxglove.dev/docs/sdk/schemas/joint-states),
``control_msgs/JointTrajectoryControllerState``, ``trajectory_msgs/JointTrajectory`` and ``std_msgs/Float64MultiArray``,
decoded to dicts or objects with fields.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.logs.columns import ColumnFrame, Pending, RecordedMotion, Track, read_motion
from rejoint.logs.joints import ImportOptions, match_joints, meanings
from rejoint.logs.readers import Reader
from rejoint.logs.runlog import LOG_MOST
from rejoint.system.errors import FileError, InputError
from rejoint.system.extras import require
from rejoint.system.files import MEGABYTE, begins_with, reading, require_file
from rejoint.system.textfile import ANGLES

NANOSECONDS = 1_000_000_000
REMEDY = "record it again, or save what is whole with `mcap recover` or `ros2 bag reindex`"
_RECORD_LIMIT = 1 << 28
"""[bytes] (chosen: larger than recorded chunks)"""
_CHUNK_MOST = 1000 * MEGABYTE
"""[bytes] (chosen: a thousand times recorded chunks)"""


@dataclass(frozen=True, kw_only=True)
class Store:
    """A kind of file with messages."""

    name: str
    magic: dict[str, bytes]
    """first bytes by ending; empty: any"""
    topics: Callable[[Path], dict[str, str]]
    """topics and their types"""
    messages: Callable[[Path, set[str]], Iterator[tuple[str, int, Any]]]
    """decoded messages of some topics, with topic and time of recording [ns]"""

    def files(self, source: Path, _: ImportOptions) -> list[Path]:
        """Files of this kind, sorted by name."""
        found = sorted(source.iterdir()) if source.is_dir() else [source]
        return [
            file
            for file in found
            if any(
                begins_with(file, magic) and (file.suffix == ending or (not ending and file is source))
                for ending, magic in self.magic.items()
            )
        ]

    def motions(self, paths: Sequence[Path], arm: Arm, options: ImportOptions) -> list[Pending]:
        """One motion of each bag."""
        return [(file.stem, partial(_read, self, file, arm, options)) for file in paths]


def _mcap_topics(file: Path) -> dict[str, str]:
    with file.open("rb") as stream:
        reader = _mcap_reader(stream)
        summary = reader.get_summary()
        if summary is None or summary.statistics is None:
            return {
                channel.topic: schema.name if schema else ""
                for schema, channel, _ in reader.iter_messages(log_time_order=False)
            }
        largest = max((chunk.uncompressed_size for chunk in summary.chunk_indexes), default=0)
        if largest > _CHUNK_MOST:
            raise FileError(file, f"a chunk of {largest} bytes, expected at most {_CHUNK_MOST}", REMEDY)
        schemas = {number: schema.name for number, schema in summary.schemas.items()}
        return {channel.topic: schemas.get(channel.schema_id, "") for channel in summary.channels.values()}


def _mcap_reader(stream: IO[bytes]) -> Any:  # noqa: ANN401
    from mcap.decoder import DecoderFactory
    from mcap.reader import SeekingReader
    from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
    from mcap_ros2.decoder import DecoderFactory as Ros2Factory

    class JsonFactory(DecoderFactory):
        def decoder_for(self, message_encoding: str, schema: object) -> Callable[[bytes], Any] | None:  # noqa: ARG002
            return json.loads if message_encoding == "json" else None

    factories = [Ros2Factory(), ProtobufFactory(), JsonFactory()]
    return SeekingReader(stream, validate_crcs=True, record_size_limit=_RECORD_LIMIT, decoder_factories=factories)


def _mcap_messages(file: Path, topics: set[str]) -> Iterator[tuple[str, int, Any]]:
    with file.open("rb") as stream:
        decoded = _mcap_reader(stream).iter_decoded_messages(topics=sorted(topics), log_time_order=False)
        for _, channel, message, content in decoded:
            yield channel.topic, message.log_time, content


def _bag(file: Path) -> Any:  # noqa: ANN401
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    require_file(file, LOG_MOST, "cut it into several bags")
    unwritten = file.with_name(f"{file.name}-wal")
    if unwritten.is_file() and unwritten.stat().st_size:
        raise FileError(file, f"was not closed: part of it is still in {unwritten.name}", "run `ros2 bag reindex`")
    # bags that hold no definitions: messages about joints are the same in all distributions
    return AnyReader([file], default_typestore=get_typestore(Stores.LATEST))


def _bag_topics(file: Path) -> dict[str, str]:
    with _bag(file) as bag:
        return {name: info.msgtype or "" for name, info in bag.topics.items()}


def _bag_messages(file: Path, topics: set[str]) -> Iterator[tuple[str, int, Any]]:
    with _bag(file) as bag:
        chosen = [connection for connection in bag.connections if connection.topic in topics]
        for connection, time, data in bag.messages(connections=chosen) if chosen else ():
            yield connection.topic, time, bag.deserialize(data, connection.msgtype)


_MCAP = Store(
    name="mcap",
    magic={"": b"\x89MCAP0\r\n", ".mcap": b"\x89MCAP0\r\n"},
    topics=_mcap_topics,
    messages=_mcap_messages,
)
_ROSBAG = Store(
    name="rosbag",
    magic={".db3": b"SQLite format 3\x00", ".bag": b"#ROSBAG V2.0"},
    topics=_bag_topics,
    messages=_bag_messages,
)
MCAP, ROSBAG = (Reader(store.files, store.motions) for store in (_MCAP, _ROSBAG))

STATES = ("JointState", "JointStates")
"""Message types with joint positions and names"""
TRAJECTORY, ARRAY, CONTROLLER = "JointTrajectory", "Float64MultiArray", "JointTrajectoryControllerState"
STATE_TOPIC, COMMAND_TOPIC = "/joint_states", "/joint_commands"
"""As of ROS 2's joint_state_broadcaster; and, chosen, its counterpart"""
MESSAGES_MOST = 5_000_000
"""(chosen: 1.4 hours at 1 kHz)"""
OTHER_INTERFACES = ("velocity", "effort", "gripper", "hand")
"""Topics without joint positions (chosen)"""


class Sample(NamedTuple):
    """Joints in one message: of states or commands, or a trajectory goal."""

    number: int
    header_ns: int
    log_ns: int
    names: tuple[str, ...]
    groups: Mapping[str, Sequence[float]]
    """``position``, ``command`` or ``torque`` to numbers per joint"""
    after: Array = np.zeros(0)
    """(K,) [s] of the points of a goal"""
    orders: Sequence[Array] = ()
    """(K, n) positions, velocities and accelerations of the points, as far as all have them"""

    def begin(self, stamp: str) -> int:
        """[ns] by the clock ``header`` or ``log``; an empty stamp of a goal asks for a start at once."""
        return self.header_ns if stamp == "header" and (self.header_ns or not len(self.after)) else self.log_ns


def _read(store: Store, file: Path, arm: Arm, options: ImportOptions) -> RecordedMotion:
    require(f"{file}: reading {store.name}", "logs")
    with _reporting(store, file):
        held = store.topics(file)
    state, command, notes = _topics(held, options, file)
    groups = {topic: group for topic, group in ((state, "position"), (command, "command")) if topic}
    samples: dict[str, list[Sample]] = {topic: [] for topic in groups}
    with _reporting(store, file):
        for topic, time, content in store.messages(file, {*groups}):
            number, kind = len(samples[topic]) + 1, held[topic].replace("/", ".").rpartition(".")[2]
            said = f"topic {topic}, message {number}: no joint positions, but {held[topic] or 'of no named type'}"
            with reading(file, said, "name a topic with sensor_msgs/JointState, or record it again"):
                samples[topic].append(Sample(number, *_joints(content, kind, groups[topic], time)))
            if number > MESSAGES_MOST:
                raise FileError(file, f"more than {MESSAGES_MOST} messages on {topic}", "cut it in parts")
    if silent := [topic for topic, found in samples.items() if not found]:
        raise FileError(file, f"no message on {silent[0]}", "record it again or name another topic")
    stamp = options.stamp or _stamp(samples, held, file, notes)
    origin = min(found[0].begin(stamp) for found in samples.values()) // NANOSECONDS * NANOSECONDS
    origin = origin if origin > 10**17 else 0  # counted from 1970; smaller numbers a float64 resolves to 1e-8 s
    goals = samples.pop(command) if command and len(samples[command][0].after) else []
    frames = [_frame(found, (stamp, origin), (file, topic), arm, options, notes) for topic, found in samples.items()]
    extra = {"clock_origin_s": f"{origin // NANOSECONDS}"} if origin else {}
    motion = read_motion(file.stem, frames, arm, options, source=file, kind=store.name, notes=notes, extra=extra)
    if goals:
        asked = _planned(goals, motion.state, (stamp, origin), (file, command or ""), arm, options)
        motion = replace(motion, command=asked)
    return motion


@contextmanager
def _reporting(store: Store, file: Path) -> Iterator[None]:
    """Turn a decoder's errors into FileError."""
    try:
        yield
    except FileError:
        raise
    except ImportError as error:  # of what those bring themselves, such as decompressors
        said = f"{file}: {store.name} needs {error.name}; install it with: pip install 'rejoint[logs]'"
        raise InputError(said) from error
    except FileNotFoundError as error:
        raise FileError(file, "no such file", "check the path") from error
    # Decoders, decompressors and message compilers stand behind this; none lists what it raises.
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0][:200]
        raise FileError(file, f"damaged or not readable ({type(error).__name__}: {reason})", REMEDY) from error


def _topics(held: dict[str, str], options: ImportOptions, file: Path) -> tuple[str, str | None, list[str]]:
    """Choose topics of states and commands, with notes."""
    shown = [f"{name} ({kind or 'no type'})" for name, kind in sorted(held.items())]
    found = (", ".join(shown[:12]) or "none") + f" and {len(shown) - 12} more" * (len(shown) > 12)
    kinds = {name: schema.replace("/", ".").rpartition(".")[2] for name, schema in held.items()}
    controllers = [name for name, kind in kinds.items() if kind == CONTROLLER]
    state, command = options.state_topic or STATE_TOPIC, options.command_topic or COMMAND_TOPIC
    if state in controllers:
        return state, None, []
    if options.state_topic is None and options.command_topic is None and command not in held and len(controllers) == 1:
        return controllers[0], None, [f"states and commands from {controllers[0]} ({held[controllers[0]]})"]
    if state not in held:
        raise FileError(file, f"no topic {state}; found {found}", "name one with --state-topic")
    if command == state:
        raise FileError(file, f"states and commands cannot both come from {state}", "name two topics")
    if command in held:
        return state, command, []
    able = [name for name, kind in kinds.items() if kind in (*STATES, TRAJECTORY, ARRAY) and name != state]
    ours = [name for name in able if kinds[name] not in STATES and not any(word in name for word in OTHER_INTERFACES)]
    if options.command_topic is None and len(ours) == 1:
        return state, ours[0], [f"commands from {ours[0]} ({held[ours[0]]})"]
    if options.command_topic is not None or able:
        raise FileError(file, f"no topic {command}; found {found}", "name one with --command-topic")
    return state, None, [f"no topic with commands; found {found}"]


def _stamp(samples: dict[str, list[Sample]], held: dict[str, str], file: Path, notes: list[str]) -> str:
    """Whose stamps are the times: ``header`` or ``log``."""
    bare = [topic for topic, found in samples.items() if not any(sample.header_ns for sample in found)]
    goals = [topic for topic, found in samples.items() if len(found[0].after)]
    # an empty stamp of a trajectory asks for a start at once
    if not bare and all(goal.header_ns for topic in goals for goal in samples[topic]):
        return "header"
    if len(bare) == 1 < len(samples) and not goals and not held[bare[0]].endswith(ARRAY):  # an array has none
        raise FileError(file, f"the messages on {bare[0]} have no stamps, the others do", "set stamp to log for both")
    notes.append(f"times are those of the recording, messages on {', '.join(bare or goals)} have no stamps")
    return "log"


def _joints(
    message: Any,  # noqa: ANN401
    kind: str,
    group: str,
    time: int,
) -> tuple[int, int, tuple[str, ...], dict[str, list[float]], Array, list[Array]]:
    """Return fields of a `Sample` but its number."""
    stamp, names, joints = (
        _field(_field(message, "header"), "stamp"),
        _field(message, "name"),
        _field(message, "joints"),
    )
    effort, orders, after = None, list[Array](), np.zeros(0)
    if kind == ARRAY:
        found = {group: _field(message, "data")}
    elif kind == TRAJECTORY and group == "command":
        names, found = _field(message, "joint_names"), {}
        after, orders = _points(_field(message, "points"), len(names))
    elif kind == CONTROLLER:
        feedback, reference = (_first(message, *both) for both in (("feedback", "actual"), ("reference", "desired")))
        names, effort = _field(message, "joint_names"), _field(feedback, "effort")
        found = {"position": _field(feedback, "positions"), "command": _field(reference, "positions")}
    elif joints is not None:
        stamp, names = _field(message, "timestamp"), [_field(joint, "name") for joint in joints]
        position, effort = ([_field(joint, key) for joint in joints] for key in ("position", "effort"))
        found = {group: [np.nan if value is None else value for value in position]}
        effort = None if None in effort else effort
    else:
        found, effort = {group: _field(message, "position")}, _field(message, "effort")
        if found[group] is None:
            raise ValueError("it has no positions")
    if "position" in found and effort is not None and len(effort) == len(found["position"]) > 0 and np.any(effort):
        found["torque"] = effort
    numbers = {key: [float(value) for value in values] for key, values in found.items()}
    return _nanoseconds(stamp), time, tuple(str(name) for name in names or ()), numbers, after, orders


def _first(message: Any, *names: str) -> Any:  # noqa: ANN401
    points = [_field(message, name) for name in names]
    return next((point for point in points if point is not None and len(_field(point, "positions"))), points[0])


def _points(points: Sequence[Any], joints: int) -> tuple[Array, list[Array]]:
    """Return times (K,) [s] and orders of a goal's points; ValueError."""
    after = np.array([_nanoseconds(_field(point, "time_from_start")) / NANOSECONDS for point in points])
    if not len(after) or (np.diff(after) <= 0).any():
        raise ValueError("its points are not one after another in time")
    orders: list[Array] = []
    for key in ("positions", "velocities", "accelerations"):
        values = [_field(point, key) for point in points]
        if any(one is None or not len(one) for one in values):
            break
        orders.append(np.array(values, dtype=float).reshape(len(points), joints))
    if not orders:
        raise ValueError("points without positions")
    return after, orders


def _field(message: Any, name: str) -> Any:  # noqa: ANN401
    """Field of a dict, an object or protobuf, or None."""
    if message is None or isinstance(message, dict):
        return (message or {}).get(name)
    descriptor = getattr(message, "DESCRIPTOR", None)
    if descriptor is not None and name in descriptor.fields_by_name:
        found = descriptor.fields_by_name[name]
        if found.has_presence and not message.HasField(name):
            return None
    return getattr(message, name, None)


def _nanoseconds(stamp: Any) -> int:  # noqa: ANN401
    """Time or duration [ns], or 0."""
    if stamp is None:
        return 0
    for names in (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"), ("secs", "nsecs")):
        seconds, rest = (_field(stamp, name) for name in names)
        if seconds is not None and rest is not None:
            return int(seconds) * NANOSECONDS + int(rest)
    raise ValueError(f"stamp {stamp!r} has no seconds and nanoseconds")


def _frame(
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
            for name, value in zip(names, given, strict=True):
                row[columns.setdefault(f"{group}.{name}", len(columns))] = value
        rows.append(row)
    values: Array = np.full((len(rows), len(columns)), np.nan)
    for k, row in enumerate(rows):
        values[k, [*row]] = [*row.values()]
    return ColumnFrame(
        path=file,
        titles=tuple(columns),
        values=lambda chosen: values[:, chosen],
        place=f"topic {topic}, message",
        number=np.array([sample.number for sample in samples], dtype=np.int64),
        angle_unit="rad",
        found=f"topic {topic}",
        # whole nanoseconds are subtracted before they become float64, which keeps them exact
        time=np.array([(sample.begin(clock[0]) - clock[1]) / NANOSECONDS for sample in samples], dtype=float),
    )


def _planned(
    goals: list[Sample],
    state: Track,
    clock: tuple[str, int],
    where: tuple[Path, str],
    arm: Arm,
    options: ImportOptions,
) -> Track:
    """Sample goals at the times of the states; ``clock`` as `_frame`.

    As ``interpolate_between_points`` of joint_trajectory_controller: from the present state through the points, linear,
    cubic or quintic; the last point holds, a new goal replaces the old one. FileError for missing joints, or no goal
    before the last state.
    """
    from scipy.interpolate import BPoly

    file, topic = where
    goals = sorted(goals, key=lambda goal: goal.begin(clock[0]))
    starts = np.array([(goal.begin(clock[0]) - clock[1]) / NANOSECONDS for goal in goals])
    command, number = np.full(state.value.shape, np.nan), np.zeros(len(state), dtype=np.int64)
    active = np.searchsorted(starts, state.time, side="right") - 1
    known = active >= 0
    if not known.any():
        raise FileError(file, f"no state after the first goal on {topic}", "record longer")
    for index in np.unique(active[known]):
        goal, rows = goals[index], np.flatnonzero(active == index)
        knots, times = _knots(goal, arm, options, where), starts[index] + goal.after
        if times[0] > starts[index]:  # a first point at the beginning leaves no way to it
            present = _present(state, starts[index])[:, : knots.shape[1]]
            knots, times = np.concatenate([present, knots]), np.concatenate([[starts[index]], times])
        asked = np.clip(state.time[rows], times[0], times[-1])
        command[rows] = BPoly.from_derivatives(times, knots)(asked) if len(times) > 1 else knots[0, 0]
        number[rows] = goal.number
    return Track(
        path=file,
        what="command",
        time=state.time[known],
        value=command[known],
        columns=arm.joint_names,
        place=f"topic {topic}, message",
        number=number[known],
    )


def _knots(goal: Sample, arm: Arm, options: ImportOptions, where: tuple[Path, str]) -> Array:
    """Positions, velocities, accelerations (K, orders, n) of the points, in radians."""
    file, topic = where
    match = match_joints(goal.names, arm, file, f"command topic {topic}, message {goal.number}", options)
    scale, offset = (np.array([getattr(one, key) for one in match.linear]) for key in ("scale", "offset"))
    if options.angle_unit == "normalised":
        raise FileError(file, "trajectories are in radians or degrees", "set another --angle-unit")
    knots = scale * np.stack(goal.orders, axis=1)[..., match.columns]
    knots[:, 0] += offset
    return knots * ANGLES[options.angle_unit or "rad"]


def _present(state: Track, time: float) -> Array:
    """Position, velocity and acceleration (1, 3, n) of the arm at a ``time``."""
    row = int(np.clip(np.searchsorted(state.time, time), 1, len(state) - 1))
    before = max(row - 3, 0)
    speed = (state.value[row] - state.value[before]) / max(state.time[row] - state.time[before], 1e-9)
    position = np.array([np.interp(time, state.time, one) for one in state.value.T])
    return np.stack([position, speed, np.zeros_like(position)])[None]
