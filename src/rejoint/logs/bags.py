"""Bags of ROS 1 and 2 and MCAP files (mcap.dev/spec): topics and clocks."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import IO, Any

from rejoint.arms import Arm
from rejoint.logs.columns import read_motion
from rejoint.logs.messages import (
    ARRAY,
    CONTROLLER,
    NANOSECONDS,
    REMEDY,
    STATES,
    TRAJECTORY,
    Sample,
    TrajectoryGoal,
    commands_of,
    frame_of,
    goals_of,
    kind_of,
    samples_of,
)
from rejoint.logs.options import OPTIONS, ImportOptions
from rejoint.logs.runlog import LOG_MOST
from rejoint.logs.track import Pending, RecordedMotion
from rejoint.system.errors import FileError, InputError
from rejoint.system.extras import require
from rejoint.system.files import MEGABYTE, begins_with, require_file

_RECORD_LIMIT = 1 << 28
"""[bytes] (chosen: larger than recorded chunks)"""
_CHUNK_MOST = 1000 * MEGABYTE
"""[bytes] (chosen: a thousand times recorded chunks)"""

Message = tuple[int, Any]
"""[ns] of recording, decoded message"""


@dataclass(frozen=True, kw_only=True)
class Topic:
    """One topic."""

    schema: str
    count: int
    seconds: float
    """[s]"""

    def __str__(self) -> str:
        rate = f", {(self.count - 1) / self.seconds:.3g} Hz" if self.seconds > 0 and self.count > 1 else ""
        return f"({self.schema or 'no type'}, {self.count} message{'s' * (self.count != 1)}{rate})"


@dataclass(frozen=True, kw_only=True)
class Store:
    """A kind of file with messages."""

    name: str
    magic: dict[str, bytes]
    """first bytes by ending; empty: any"""
    inventory: Callable[[Path], dict[str, Topic]]
    messages: Callable[[Path, set[str]], dict[str, list[Message]]]
    """decodes messages of some topics"""

    def files(self, source: Path) -> list[Path]:
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


def _mcap_inventory(file: Path) -> dict[str, Topic]:
    with file.open("rb") as stream:
        reader = _mcap_reader(stream)
        summary = reader.get_summary()
        if summary is not None:
            largest = max((chunk.uncompressed_size for chunk in summary.chunk_indexes), default=0)
            if largest > _CHUNK_MOST:
                raise FileError(file, f"a chunk of {largest} bytes, expected at most {_CHUNK_MOST}", REMEDY)
        return _mcap_topics(reader) if summary is None or summary.statistics is None else _counted(summary)


def _counted(summary: Any) -> dict[str, Topic]:  # noqa: ANN401 - the library is optional
    schemas = {number: schema.name for number, schema in summary.schemas.items()}
    found = summary.statistics
    seconds = max(found.message_end_time - found.message_start_time, 0) / NANOSECONDS
    counts: dict[str, int] = {}
    for channel in summary.channels.values():
        counts[channel.topic] = counts.get(channel.topic, 0) + found.channel_message_counts.get(channel.id, 0)
    return {
        channel.topic: Topic(schema=schemas.get(channel.schema_id, ""), count=counts[channel.topic], seconds=seconds)
        for channel in summary.channels.values()
    }


def _mcap_topics(reader: Any) -> dict[str, Topic]:  # noqa: ANN401
    names: dict[str, str] = {}
    times: dict[str, list[int]] = {}
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        names[channel.topic] = schema.name if schema else ""
        times.setdefault(channel.topic, []).append(message.log_time)
    return {
        topic: Topic(schema=names[topic], count=len(found), seconds=(max(found) - min(found)) / NANOSECONDS)
        for topic, found in times.items()
    }


def _mcap_reader(stream: IO[bytes]) -> Any:  # noqa: ANN401
    from mcap.decoder import DecoderFactory
    from mcap.reader import SeekingReader
    from mcap_protobuf.decoder import DecoderFactory as ProtobufFactory
    from mcap_ros2.decoder import DecoderFactory as Ros2Factory

    class JsonFactory(DecoderFactory):
        def decoder_for(self, message_encoding: str, schema: object) -> Callable[[bytes], Any] | None:  # noqa: ARG002
            return json.loads if message_encoding == "json" else None

    return SeekingReader(
        stream,
        validate_crcs=True,
        record_size_limit=_RECORD_LIMIT,
        decoder_factories=[Ros2Factory(), ProtobufFactory(), JsonFactory()],
    )


def _mcap_messages(file: Path, topics: set[str]) -> dict[str, list[Message]]:
    found: dict[str, list[Message]] = {}
    with file.open("rb") as stream:
        reader = _mcap_reader(stream)
        decoded = reader.iter_decoded_messages(topics=sorted(topics), log_time_order=False)
        for _, channel, message, content in decoded:
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


def _bag(file: Path) -> Any:  # noqa: ANN401
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    require_file(file, LOG_MOST, "cut it into several bags")
    unwritten = file.with_name(f"{file.name}-wal")
    if unwritten.is_file() and unwritten.stat().st_size:
        raise FileError(file, f"was not closed: part of it is still in {unwritten.name}", "run `ros2 bag reindex`")
    # bags that hold no definitions: messages about joints are the same in all distributions
    return AnyReader([file], default_typestore=get_typestore(Stores.LATEST))


def _bag_inventory(file: Path) -> dict[str, Topic]:
    with _bag(file) as bag:
        seconds = bag.duration / NANOSECONDS
        return {
            name: Topic(schema=info.msgtype or "", count=info.msgcount, seconds=seconds)
            for name, info in bag.topics.items()
        }


def _bag_messages(file: Path, topics: set[str]) -> dict[str, list[Message]]:
    found: dict[str, list[Message]] = {}
    with _bag(file) as bag:
        chosen = [connection for connection in bag.connections if connection.topic in topics]
        for connection, time, data in bag.messages(connections=chosen) if chosen else ():
            found.setdefault(connection.topic, []).append((time, bag.deserialize(data, connection.msgtype)))
    return found


MCAP = Store(
    name="mcap",
    magic={"": b"\x89MCAP0\r\n", ".mcap": b"\x89MCAP0\r\n"},
    inventory=_mcap_inventory,
    messages=_mcap_messages,
)
ROSBAG = Store(
    name="rosbag",
    magic={".db3": b"SQLite format 3\x00", ".bag": b"#ROSBAG V2.0"},
    inventory=_bag_inventory,
    messages=_bag_messages,
)


STATE_TOPIC, COMMAND_TOPIC = "/joint_states", "/joint_commands"
"""As of ROS 2's joint_state_broadcaster; and, chosen, its counterpart"""
MESSAGES_MOST = 5_000_000
"""(chosen: 1.4 hours at 1 kHz)"""
OTHER_INTERFACES = ("velocity", "effort", "gripper", "hand")
"""Topics without joint positions (chosen)"""


@dataclass(frozen=True, kw_only=True)
class BagReader:
    """Reads bags of one kind."""

    store: Store

    def fits(self, source: Path, options: ImportOptions) -> bool:  # noqa: ARG002 - it declares nothing about this
        """Whether a path holds such bags."""
        return bool(self.store.files(source))

    def motions(self, source: Path, arm: Arm, options: ImportOptions) -> list[Pending]:
        """Motions at a path, sorted by name."""
        files = self.store.files(source) or ([source] if source.is_file() else [])
        if not files:
            raise FileError(source, f"no file of format {self.store.name} here", "check the path or the format")
        return [(file.stem, partial(_read, self.store, file, arm, options)) for file in files]


def _read(store: Store, file: Path, arm: Arm, options: ImportOptions) -> RecordedMotion:
    with _reporting(store, file):
        held = store.inventory(file)
    state_topic, command_topic, notes = _topics(held, options, file)
    topics = {topic for topic in (state_topic, command_topic) if topic}
    for topic in topics:
        count = held[topic].count
        if count > MESSAGES_MOST:
            raise FileError(file, f"{count} messages on {topic}, expected at most {MESSAGES_MOST}", "cut it in parts")
    with _reporting(store, file):
        messages = store.messages(file, topics)
    for topic in topics:
        if topic not in messages:
            raise FileError(file, f"no message on {topic}", "record it again or name another topic")
    kinds = {topic: kind_of(held[topic].schema) for topic in topics}
    goals: list[TrajectoryGoal] = []
    samples: dict[str, list[Sample]] = {}
    wanted = ((state_topic, "position"), (command_topic or "", "command"))
    for topic, group in wanted:
        if topic and kinds[topic] == TRAJECTORY and group == "command":
            goals = goals_of(messages[topic], file, topic)
        elif topic and topic not in samples:
            samples[topic] = samples_of(messages[topic], file, topic, held[topic].schema, group)
    if options.names and all(sample.names for found in samples.values() for sample in found):
        raise FileError(file, "all messages name their joints", "use --map, not --order")
    stamp, remarks = _stamp(samples, goals, (state_topic, command_topic), kinds, options, file)
    notes += remarks
    first: list[Sample | TrajectoryGoal] = [*(found[0] for found in samples.values()), *goals[:1]]
    origin = min(one.header_ns if stamp == "header" else one.log_ns for one in first) // NANOSECONDS * NANOSECONDS
    origin = origin if origin > 10**17 else 0  # counted from 1970; smaller numbers a float64 resolves to 1e-8 s
    frames = []
    for topic, found in samples.items():
        frame, remarks = frame_of(found, (stamp, origin), (file, topic), arm, options)
        frames.append(frame)
        notes += remarks
    extra = {"source": file.name, "format": store.name}
    extra |= {"clock_origin_s": f"{origin // NANOSECONDS}"} if origin else {}
    motion = read_motion(file.stem, frames, arm, options, notes=notes, robot=f"{store.name}:{file.stem}", extra=extra)
    if goals:
        command = commands_of(goals, motion.state, (stamp, origin), (file, command_topic or ""), arm, options)
        motion = replace(motion, command=command)
    return motion


@contextmanager
def _reporting(store: Store, file: Path) -> Iterator[None]:
    """Turn a decoder's errors into FileError."""
    require(f"{file}: reading {store.name}", "logs")
    try:
        yield
    except FileError:
        raise
    except ImportError as error:  # of what those bring themselves, such as decompressors
        raise InputError(
            f"{file}: {store.name} needs {error.name}; install it with: pip install 'rejoint[logs]'"
        ) from error
    except FileNotFoundError as error:
        raise FileError(file, "no such file", "check the path") from error
    # Decoders, decompressors and message compilers stand behind this; none lists what it raises.
    except Exception as error:
        reason = (str(error).splitlines() or [""])[0][:200]
        raise FileError(file, f"damaged or not readable ({type(error).__name__}: {reason})", REMEDY) from error


def _topics(held: dict[str, Topic], options: ImportOptions, file: Path) -> tuple[str, str | None, list[str]]:
    """Choose topics of states and commands."""
    notes: list[str] = []
    found = ", ".join([f"{name} {topic}" for name, topic in sorted(held.items())][:12]) or "none"
    found += f" and {len(held) - 12} more" if len(held) > 12 else ""
    controllers = [name for name, topic in held.items() if kind_of(topic.schema) == CONTROLLER]
    state, command = options.state_topic or STATE_TOPIC, options.command_topic or COMMAND_TOPIC
    if state in controllers:
        return state, None, []
    if options.state_topic is None and options.command_topic is None and command not in held and len(controllers) == 1:
        return controllers[0], None, [f"states and commands from {controllers[0]} {held[controllers[0]]}"]
    if state not in held:
        raise FileError(file, f"no topic {state}; found {found}", f"name one with {OPTIONS['state_topic']}")
    if command == state:
        raise FileError(file, f"states and commands cannot both come from {state}", "name two topics")
    if command in held:
        return state, command, notes
    able = [
        name for name, topic in held.items() if kind_of(topic.schema) in (*STATES, TRAJECTORY, ARRAY) and name != state
    ]
    ours = [
        name
        for name in able
        if kind_of(held[name].schema) not in STATES and not any(word in name for word in OTHER_INTERFACES)
    ]
    if options.command_topic is None and len(ours) == 1:
        return state, ours[0], [f"commands from {ours[0]} {held[ours[0]]}"]
    if options.command_topic is not None or able:
        raise FileError(file, f"no topic {command}; found {found}", f"name one with {OPTIONS['command_topic']}")
    return state, None, [f"no topic with commands; found {found}"]


def _stamp(
    samples: dict[str, list[Sample]],
    goals: list[TrajectoryGoal],
    topics: tuple[str, str | None],
    kinds: dict[str, str],
    options: ImportOptions,
    file: Path,
) -> tuple[str, list[str]]:
    state, command = topics
    if options.stamp is not None:
        return options.stamp, []
    stamped = {topic: any(sample.header_ns for sample in found) for topic, found in samples.items()}
    told = "times are those of the recording"
    # an array has no stamp, and an empty one of a trajectory asks for a start at once
    if command and (kinds[command] == ARRAY or (goals and not all(goal.header_ns for goal in goals))):
        return "log", [f"{told}, the commands on {command} have no stamps"]
    if goals or len(set(stamped.values())) == 1:
        return ("header", []) if stamped[state] else ("log", [f"{told}, the messages have no stamps"])
    bare = command if stamped[state] else state
    raise FileError(file, f"the messages on {bare} have no stamps, the others do", "set stamp to log for both")
