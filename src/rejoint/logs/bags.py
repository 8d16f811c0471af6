"""Bags of ROS 1 and 2 and MCAP files (mcap.dev/spec): topics, clocks, joint states and commands.

Messages are ``sensor_msgs/JointState``, ``foxglove.JointStates`` (docs.foxglove.dev/docs/sdk/schemas/joint-states),
``control_msgs/JointTrajectoryControllerState`` and ``std_msgs/Float64MultiArray``. A trajectory's goals do not tell
what was commanded: the controller's state does.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rejoint.logs.columns import RawMotion
from rejoint.logs.joints import ImportOptions
from rejoint.logs.readers import Reader
from rejoint.logs.runlog import LOG_MOST
from rejoint.system.errors import FileError, first_line
from rejoint.system.extras import require
from rejoint.system.files import begins_with, reading, require_file
from rejoint.system.textfile import shown

NANOSECONDS = 1_000_000_000
REMEDY = "record it again, or save what is whole with `mcap recover` or `ros2 bag reindex`"
_RECORD_LIMIT = 1 << 28
"""[bytes] (chosen: larger than recorded chunks)"""


Opened = tuple[dict[str, str], Callable[[set[str]], Iterator[tuple[str, int, Any]]]]
"""Topics and their types; and decoded messages of some topics, with topic and time of recording [ns]"""
Opener = Callable[[Path], AbstractContextManager[Opened]]


def _bags(magic: dict[str, bytes], source: Path) -> list[Path]:
    """Files with the ``magic`` first bytes of their ending, sorted by name; the empty ending is any, of one file."""
    files = sorted(source.iterdir()) if source.is_dir() else [source]
    magics = [(file, magic.get(file.suffix) or (file is source and magic.get(""))) for file in files]
    return [file for file, found in magics if found and begins_with(file, found)]


@contextmanager
def _open_mcap(file: Path) -> Iterator[Opened]:
    from mcap.decoder import DecoderFactory
    from mcap.reader import SeekingReader
    from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
    from mcap_ros2.decoder import DecoderFactory as Ros2Factory

    class JsonFactory(DecoderFactory):
        def decoder_for(self, message_encoding: str, schema: object) -> Callable[[bytes], Any] | None:  # noqa: ARG002
            return json.loads if message_encoding == "json" else None

    factories = [Ros2Factory(), ProtobufFactory(), JsonFactory()]
    with file.open("rb") as stream:
        reader = SeekingReader(stream, validate_crcs=True, record_size_limit=_RECORD_LIMIT, decoder_factories=factories)
        summary = reader.get_summary()
        if summary is None:
            channels = ((schema, channel) for schema, channel, _ in reader.iter_messages(log_time_order=False))
        else:
            channels = ((summary.schemas.get(one.schema_id), one) for one in summary.channels.values())

        def messages(topics: set[str]) -> Iterator[tuple[str, int, Any]]:
            for _, channel, message, content in reader.iter_decoded_messages(topics=[*topics], log_time_order=False):
                yield channel.topic, message.log_time, content

        yield {channel.topic: schema.name if schema else "" for schema, channel in channels}, messages


@contextmanager
def _open_rosbag(file: Path) -> Iterator[Opened]:
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    require_file(file, LOG_MOST, "cut it into several bags")
    unwritten = file.with_name(f"{file.name}-wal")
    if unwritten.is_file() and unwritten.stat().st_size:
        raise FileError(file, f"was not closed: part of it is still in {unwritten.name}", "run `ros2 bag reindex`")
    # bags that hold no definitions: messages about joints are the same in all distributions
    with AnyReader([file], default_typestore=get_typestore(Stores.LATEST)) as bag:

        def messages(topics: set[str]) -> Iterator[tuple[str, int, Any]]:
            chosen = [connection for connection in bag.connections if connection.topic in topics]
            for connection, time, data in bag.messages(connections=chosen):
                yield connection.topic, time, bag.deserialize(data, connection.msgtype)

        yield {name: info.msgtype or "" for name, info in bag.topics.items()}, messages


_MCAP_MAGIC = b"\x89MCAP0\r\n"
STATES = ("JointState", "JointStates")
"""Message types with joint positions and names"""
ARRAY, CONTROLLER = "Float64MultiArray", "JointTrajectoryControllerState"
STATE_TOPIC, COMMAND_TOPIC = "/joint_states", "/joint_commands"
"""As of ROS 2's joint_state_broadcaster; and, chosen, its counterpart"""
OTHER_INTERFACES = ("velocity", "effort", "gripper", "hand")
"""Topics without joint positions (chosen)"""


class Message(NamedTuple):
    """Joints in one message of states or commands."""

    stamp: int
    """[ns] of the message, or 0"""
    logged: int
    """[ns] of the recording"""
    columns: Mapping[str, float]
    """``position.elbow`` and the like"""


def _read(opened: Opener, file: Path, options: ImportOptions) -> list[RawMotion]:
    require(f"{file}: reading bags", "logs")
    notes: list[str] = []
    found: dict[str, list[Message]] = {}
    try:
        with opened(file) as (held, read):
            groups = _topics(held, options, file, notes)
            for topic, time, content in read({*groups}):
                messages = found.setdefault(topic, [])
                said = f"topic {topic}, message {len(messages) + 1}: no joint positions in {held[topic] or 'no type'}"
                with reading(file, said, "name a topic with sensor_msgs/JointState, or record it again"):
                    messages.append(_message(content, groups[topic], time, options))
    except FileError:
        raise
    # Decoders, decompressors and message compilers stand behind this; none lists what it raises.
    except Exception as error:
        said = f"damaged or not readable ({type(error).__name__}: {first_line(error)[:200]})"
        raise FileError(file, said, REMEDY) from error
    if silent := [topic for topic in groups if topic not in found]:
        raise FileError(file, f"no message on {silent[0]}", "record it again or name another topic")
    bare = [topic for topic, messages in found.items() if not any(one.stamp for one in messages)]
    stamped = options.stamp == "header" or (options.stamp is None and not bare)
    if options.stamp is None and bare:
        notes.append(f"times are those of the recording, messages on {bare[0]} have no stamps")
    clocks = {
        topic: np.array([one.stamp if stamped else one.logged for one in messages]) for topic, messages in found.items()
    }
    origin = min(int(clock.min()) for clock in clocks.values()) // NANOSECONDS * NANOSECONDS
    origin = origin if origin > 10**17 else 0  # counted from 1970; smaller numbers a float64 resolves to 1e-8 s
    motions: list[RawMotion] = []
    extra = {"clock_origin_s": f"{origin // NANOSECONDS}"} if origin else {}
    for topic in groups:  # states come first
        messages = found[topic]
        # whole nanoseconds are subtracted before they become float64, which keeps them exact
        times = (clocks[topic] - origin) / NANOSECONDS
        titles = dict.fromkeys(title for one in messages for title in one.columns)
        columns = {title: np.array([one.columns.get(title, np.nan) for one in messages]) for title in titles}
        about = {"place": f"topic {topic}, message", "angle_unit": "rad", "found": f"topic {topic}"}
        motions.append(RawMotion.of(file.stem, file, columns, time=times, notes=notes, extra=extra, **about))
    state, *sent = motions
    return [state.with_commands(sent[0]) if sent else state]


def _topics(held: dict[str, str], options: ImportOptions, file: Path, notes: list[str]) -> dict[str, str]:
    kinds = {name: schema.replace("/", ".").rpartition(".")[2] for name, schema in held.items()}
    found = shown([f"{name} ({held[name] or 'no type'})" for name in sorted(held)])
    controllers = [name for name, kind in kinds.items() if kind == CONTROLLER]
    state, command = options.state_topic, options.command_topic
    if not (state or command) and COMMAND_TOPIC not in held and len(controllers) == 1:
        (state,) = controllers
        notes.append(f"states and commands from {state} ({held[state]})")
    state = state or STATE_TOPIC
    if state not in held:
        raise FileError(file, f"no topic {state}; found {found}", "name one with --state-topic")
    if state in controllers:
        return {state: "position"}
    able = [name for name, kind in kinds.items() if kind in (*STATES, ARRAY) and name != state]
    ours = [n for n in able if kinds[n] not in STATES and not any(word in n for word in OTHER_INTERFACES)]
    if command is None and COMMAND_TOPIC not in held and len(ours) == 1:
        (command,) = ours
        notes.append(f"commands from {command} ({held[command]})")
    if command is None and not able:
        notes.append(f"no topic with commands; found {found}")
        return {state: "position"}
    command = command or COMMAND_TOPIC
    if command not in held or command == state:
        said = f"no topic {command} beside that of the states; found {found}"
        raise FileError(file, said, "name one with --command-topic")
    return {state: "position", command: "command"}


_FIELDS = {
    "stamp": ("header.stamp", "timestamp"),
    "names": ("joint_names", "name", "joints.name"),
    "values": ("position", "data", "feedback.positions", "actual.positions", "joints.position"),
    "effort": ("effort", "feedback.effort", "actual.effort", "joints.effort"),
    "sent": ("reference.positions", "desired.positions"),
}
"""What all types of messages call the same"""


def _message(content: Any, group: str, logged: int, options: ImportOptions) -> Message:  # noqa: ANN401
    """Joints of a decoded message; TypeError or ValueError for one of another kind."""
    held = {key: _some(content, paths) for key, paths in _FIELDS.items()}
    names, stamp = [*map(str, held["names"] or options.names)], _nanoseconds(held["stamp"])
    given, effort = {group: held["values"]}, () if held["effort"] is None else held["effort"]
    if len(names) != len(given[group]):
        raise ValueError(f"{len(names)} names for {len(given[group])} {group}s; set --order if it holds no names")
    if group == "position" and held["sent"] is not None:
        given["command"] = held["sent"]
    if group == "position" and len(effort) == len(names) and any(effort):
        given["torque"] = effort
    numbers = {key: [np.nan if value is None else float(value) for value in values] for key, values in given.items()}
    return Message(
        stamp, logged, {f"{key}.{name}": v for key, one in numbers.items() for name, v in zip(names, one, strict=True)}
    )


def _some(content: Any, paths: Sequence[str]) -> Any:  # noqa: ANN401
    fields = (_field(content, path.split(".")) for path in paths)
    return next((field for field in fields if field is not None and np.size(field)), None)


def _field(message: Any, path: Sequence[str]) -> Any:  # noqa: ANN401
    """Field of a field of a dict, an object, protobuf, or each of a list; or None."""
    if not path or message is None:
        return message
    if not isinstance(message, dict | str) and hasattr(message, "__getitem__"):
        return [_field(one, path) for one in message]
    if isinstance(message, dict):
        return _field(message.get(path[0]), path[1:])
    declared = getattr(getattr(message, "DESCRIPTOR", None), "fields_by_name", {}).get(path[0])
    absent = declared is not None and declared.has_presence and not message.HasField(path[0])
    return None if absent else _field(getattr(message, path[0], None), path[1:])


def _nanoseconds(stamp: Any) -> int:  # noqa: ANN401
    """Time or duration [ns], or 0."""
    if stamp is None:
        return 0
    seconds, rest = (
        _some(stamp, names) for names in (("sec", "seconds", "secs"), ("nanosec", "nsec", "nanos", "nsecs"))
    )
    if seconds is not None and rest is not None:
        return int(seconds) * NANOSECONDS + int(rest)
    raise ValueError(f"stamp {stamp!r} has no seconds and nanoseconds")


MCAP = Reader(partial(_bags, {"": _MCAP_MAGIC, ".mcap": _MCAP_MAGIC}), partial(_read, _open_mcap))
ROSBAG = Reader(partial(_bags, {".db3": b"SQLite format 3\x00", ".bag": b"#ROSBAG V2.0"}), partial(_read, _open_rosbag))
