"""MCAP files with joint states: ROS 2 (CDR), protobuf and JSON.

Read are ``sensor_msgs/JointState`` (parallel lists ``name`` and ``position``, in radians by its definition) and
``foxglove.JointStates`` (a list of joints), each in any of the three encodings
(docs.foxglove.dev/docs/sdk/schemas/joint-states). One topic holds the states, another one the commands.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.joints import Match, match_joints, means_a_joint, radians
from rejoint.logs.options import OPTIONS, ImportOptions
from rejoint.logs.track import Points, RecordedMotion, Track
from rejoint.system.errors import FileError, InputError
from rejoint.system.extras import require

MAGIC = b"\x89MCAP0\r\n"
"""First bytes of every MCAP file. Source: mcap.dev/spec."""
STATE_TOPIC, COMMAND_TOPIC = "/joint_states", "/joint_commands"
"""Where ROS 2's joint_state_broadcaster publishes; and, chosen, its counterpart."""
POINT_TOPICS = {"target": "/target", "true_tcp": "/true_tcp"}
METADATA = "rejoint"
"""Name of the metadata record in which an exported log keeps what messages cannot hold."""
NANOSECONDS = 1_000_000_000

_RECORD_LIMIT = 1 << 28
"""[bytes] chosen: larger than any chunk a recorder writes, smaller than a Raspberry Pi's memory."""
_REMEDY = "record it again, or save what is whole with `mcap recover`"
_STAMP_NAMES = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"), ("secs", "nsecs"))


class _Sample(NamedTuple):
    number: int
    header_ns: int
    log_ns: int
    names: tuple[str, ...]
    position: list[float]


def fits(source: Path, options: ImportOptions) -> bool:  # noqa: ARG001 - it declares nothing about this
    """Tell whether a file is MCAP, or a folder holds such files."""
    return bool(_files(source))


def motions(source: Path, arm: Arm, options: ImportOptions) -> tuple[int, Iterator[RecordedMotion]]:
    """Count the MCAP files at a path and read them one by one, sorted by name."""
    options.refuse_others(
        source, "mcap", "angle_unit", "joint_map", "joint_order", "state_topic", "command_topic", "stamp", "calibration"
    )
    files = [source] if source.is_file() else _files(source)
    if not files:
        raise FileError(source, "no MCAP file here", "check the path or the format")
    return len(files), (_read(file, arm, options) for file in files)


def _files(source: Path) -> list[Path]:
    if source.is_dir():
        return sorted(file for file in source.glob("*.mcap") if file.is_file() and _has_magic(file))
    return [source] if source.is_file() and _has_magic(source) else []


def _has_magic(file: Path) -> bool:
    try:
        with file.open("rb") as stream:
            return stream.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def _read(file: Path, arm: Arm, options: ImportOptions) -> RecordedMotion:
    with _reporting(file):
        topics, header = _survey(file)
    state_topic = _topic(options.state_topic, STATE_TOPIC, topics, file, OPTIONS["state_topic"])
    command_topic = _topic(options.command_topic, COMMAND_TOPIC, topics, file, OPTIONS["command_topic"])
    if state_topic == command_topic:
        raise FileError(file, f"states and commands cannot both come from {state_topic}", "name two topics")
    points = POINT_TOPICS if header else {}
    with _reporting(file):
        messages = _messages(file, {state_topic, command_topic, *points.values()})
    samples = {topic: _samples(messages.get(topic, []), file, topic) for topic in (state_topic, command_topic)}
    stamp = _stamp(samples, options, file)
    notes: list[str] = [] if stamp == "header" else ["times are those of the recording, the messages have no stamps"]
    if header and header.get("arm") != arm.name:
        notes.append(f"the log says that it is of arm {header.get('arm')}, it is taken as one of {arm.name}")
    tracks = []
    for what, (topic, found) in zip(("state", "command"), samples.items(), strict=True):
        time, track, remarks = _track(found, stamp, (file, topic, what), arm, options)
        tracks.append((time, track))
        notes += remarks
    origin = min(time[0] for time, _ in tracks) // NANOSECONDS * NANOSECONDS
    origin = origin if origin > 10**17 else 0  # counted from 1970; smaller numbers a float64 resolves to 1e-8 s
    state, command = (_on_clock(track, time, origin) for time, track in tracks)
    name, robot = header.get("label", file.stem), header.get("robot", f"mcap:{file.stem}")
    extra = {"source": file.name, "format": "mcap"} | ({"clock_origin_s": f"{origin // NANOSECONDS}"} if origin else {})
    return RecordedMotion(
        name=name, state=state, command=command, angle_unit=options.angle_unit or "rad", robot=robot,
        points={group: _points(messages.get(topic, []), origin, file) for group, topic in points.items()},
        extra=_kept_extra(header, file) if header else extra, notes=tuple(notes),
    )  # fmt: skip


def _survey(file: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Return the topics with the names of their schemas, and the metadata of an exported log."""
    with file.open("rb") as stream:
        reader = _reader(stream)
        summary = reader.get_summary()
        if summary is not None:
            schemas = {number: schema.name for number, schema in summary.schemas.items()}
            topics = {channel.topic: schemas.get(channel.schema_id, "") for channel in summary.channels.values()}
        else:
            topics = {
                channel.topic: schema.name if schema else ""
                for schema, channel, _ in reader.iter_messages(log_time_order=False)
            }
        kept = [record.metadata for record in reader.iter_metadata() if record.name == METADATA]
    return topics, kept[0] if kept else {}


def _reader(stream: IO[bytes]) -> Any:  # noqa: ANN401 - the library is optional
    from mcap.decoder import DecoderFactory
    from mcap.reader import SeekingReader
    from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
    from mcap_ros2.decoder import DecoderFactory as Ros2Factory

    class JsonFactory(DecoderFactory):
        def decoder_for(self, message_encoding: str, schema: object) -> Callable[[bytes], Any] | None:  # noqa: ARG002
            return json.loads if message_encoding == "json" else None

    return SeekingReader(
        stream, validate_crcs=True, record_size_limit=_RECORD_LIMIT,
        decoder_factories=[Ros2Factory(), ProtobufFactory(), JsonFactory()],
    )  # fmt: skip


def _messages(file: Path, topics: set[str]) -> dict[str, list[tuple[int, Any]]]:
    """Decode the messages of some topics, in the order of the file, each with its time of recording [ns]."""
    found: dict[str, list[tuple[int, Any]]] = {}
    with file.open("rb") as stream:
        reader = _reader(stream)
        decoded = reader.iter_decoded_messages(topics=sorted(topics), log_time_order=False)
        for _, channel, message, content in decoded:
            found.setdefault(channel.topic, []).append((message.log_time, content))
        summary = reader.get_summary()
    if summary is not None and summary.statistics is not None:
        counts = summary.statistics.channel_message_counts
        for channel in summary.channels.values():
            promised = sum(counts.get(c.id, 0) for c in summary.channels.values() if c.topic == channel.topic)
            if channel.topic in topics and promised != len(found.get(channel.topic, [])):
                held = len(found.get(channel.topic, []))
                raise FileError(file, f"{held} messages on {channel.topic}, its statistics promise {promised}", _REMEDY)
    return found


@contextmanager
def _reporting(file: Path) -> Iterator[None]:
    """Turn whatever the decoders raise on damaged bytes into a FileError."""
    require(f"{file}: reading MCAP", "logs")
    try:
        yield
    except FileError:
        raise
    except ImportError as error:  # of what those bring themselves, such as decompressors
        raise InputError(f"{file}: MCAP needs {error.name}; install it with: pip install 'rejoint[logs]'") from error
    except FileNotFoundError as error:
        raise FileError(file, "no such file", "check the path") from error
    # Three decoders, two decompressors and a message compiler stand behind this; none lists what it raises.
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0][:200]
        raise FileError(file, f"damaged or not readable ({type(error).__name__}: {reason})", _REMEDY) from error


def _topic(asked: str | None, default: str, topics: dict[str, str], file: Path, option: str) -> str:
    topic = asked or default
    if topic in topics:
        return topic
    joints = [f"{name} ({schema})" for name, schema in sorted(topics.items()) if "JointState" in schema]
    raise FileError(
        file, f"no topic {topic}; topics with joint states: {', '.join(joints) or 'none'}", f"name one with {option}"
    )


def _samples(messages: list[tuple[int, Any]], file: Path, topic: str) -> list[_Sample]:
    samples = []
    for number, (log_ns, message) in enumerate(messages, start=1):
        try:
            joints = _field(message, "joints")
            if joints is None:
                names, position = _field(message, "name") or (), _field(message, "position")
                stamp = _field(_field(message, "header"), "stamp")
            else:
                names = [_field(joint, "name") for joint in joints]
                position = [np.nan if (value := _field(joint, "position")) is None else value for joint in joints]
                stamp = _field(message, "timestamp")
            if position is None:
                raise ValueError("it has no positions")
            values = [float(value) for value in position]
            samples.append(_Sample(number, _nanoseconds(stamp), log_ns, tuple(str(name) for name in names), values))
        except (TypeError, ValueError, AttributeError, OverflowError) as error:
            raise FileError(
                file, f"topic {topic}, message {number}: no joint state ({error})",
                "name a topic with sensor_msgs/JointState",
            ) from error  # fmt: skip
    return samples


def _field(message: Any, name: str) -> Any:  # noqa: ANN401 - what three decoders return
    """Get a field of a message that is a dict (JSON), an object (CDR) or protobuf; None where it is not set."""
    if message is None or isinstance(message, dict):
        return (message or {}).get(name)
    descriptor = getattr(message, "DESCRIPTOR", None)
    if descriptor is not None and name in descriptor.fields_by_name:
        field = descriptor.fields_by_name[name]
        if field.has_presence and not message.HasField(name):
            return None
    return getattr(message, name, None)


def _nanoseconds(stamp: Any) -> int:  # noqa: ANN401
    if stamp is None:
        return 0
    for seconds, rest in _STAMP_NAMES:
        if _field(stamp, seconds) is not None and _field(stamp, rest) is not None:
            return int(_field(stamp, seconds)) * NANOSECONDS + int(_field(stamp, rest))
    raise ValueError(f"stamp {stamp!r} has no seconds and nanoseconds")


def _stamp(samples: dict[str, list[_Sample]], options: ImportOptions, file: Path) -> str:
    """Choose between the stamps in the messages and the times of recording; both topics take the same."""
    if options.stamp is not None:
        return options.stamp
    for topic, found in samples.items():
        if not found:
            raise FileError(file, f"no message on {topic}", "record it again or name another topic")
    unstamped = {topic: not any(sample.header_ns for sample in found) for topic, found in samples.items()}
    if len(set(unstamped.values())) > 1:
        bare = next(topic for topic, missing in unstamped.items() if missing)
        raise FileError(file, f"the messages on {bare} have no stamps, the others do", "set stamp to log for both")
    return "log" if all(unstamped.values()) else "header"


def _track(
    samples: list[_Sample], stamp: str, where: tuple[Path, str, str], arm: Arm, options: ImportOptions,
) -> tuple[list[int], Track, list[str]]:  # fmt: skip
    """Put each message's positions into the arm's order; returns stamps [ns], a track without times, and notes."""
    file, topic, what = where
    matches: dict[tuple[str, ...], Match | None] = {}
    times, values, numbers, columns, foreign = [], [], [], arm.joint_names, 0
    for sample in samples:
        place = f"{what} topic {topic}, message {sample.number}"
        if sample.names and options.joint_order:
            raise FileError(file, f"{place}: names its joints", "use --joints, not --order")
        names = sample.names or options.joint_order or ()
        if len(names) != len(sample.position):
            raise FileError(
                file, f"{place}: {len(names)} names for {len(sample.position)} positions",
                "set --order if the messages hold no names" if not sample.names else _REMEDY,
            )  # fmt: skip
        if names not in matches:
            ours = any(means_a_joint(name, arm, options) for name in names)
            matches[names] = match_joints(names, arm, options, file, place) if ours or not matches else None
        match = matches[names]
        if match is None:
            foreign += 1
            continue
        columns = match.names
        times.append(sample.header_ns if stamp == "header" else sample.log_ns)
        values.append([sample.position[column] for column in match.columns])
        numbers.append(sample.number)
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


def _on_clock(track: Track, stamps: list[int], origin: int) -> Track:
    """Fill in the times: whole nanoseconds are subtracted before they become float64, which keeps them exact."""
    time = np.array([(stamp - origin) / NANOSECONDS for stamp in stamps])
    return replace(track, time=time)


def _points(messages: list[tuple[int, Any]], origin: int, file: Path) -> Points:
    """Read geometry_msgs/PointStamped messages."""
    times, values = [], []
    for number, (_, message) in enumerate(messages, start=1):
        try:
            times.append((_nanoseconds(_field(_field(message, "header"), "stamp")) - origin) / NANOSECONDS)
            values.append([float(_field(_field(message, "point"), axis)) for axis in ("x", "y", "z")])
        except (TypeError, ValueError, AttributeError) as error:
            raise FileError(file, f"message {number} of a point topic is no PointStamped ({error})", _REMEDY) from error
    return Points(time=np.array(times, dtype=float), value=np.array(values, dtype=float).reshape(-1, 3))


def _kept_extra(header: dict[str, str], file: Path) -> dict[str, str]:
    try:
        extra = json.loads(header.get("extra", "{}"))
        return {str(key): str(value) for key, value in extra.items()}
    except (ValueError, AttributeError, RecursionError) as error:
        raise FileError(file, f"metadata {METADATA} is damaged ({error})", _REMEDY) from error
