"""Bags of ROS 1 and 2 and MCAP files (mcap.dev/spec): topics and clocks."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
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
from rejoint.logs.options import ImportOptions
from rejoint.logs.runlog import LOG_MOST
from rejoint.logs.track import Pending, RecordedMotion
from rejoint.system.errors import FileError, InputError
from rejoint.system.extras import require
from rejoint.system.files import MEGABYTE, begins_with, require_file

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

    return SeekingReader(
        stream,
        validate_crcs=True,
        record_size_limit=_RECORD_LIMIT,
        decoder_factories=[Ros2Factory(), ProtobufFactory(), JsonFactory()],
    )


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


MCAP = Store(
    name="mcap",
    magic={"": b"\x89MCAP0\r\n", ".mcap": b"\x89MCAP0\r\n"},
    topics=_mcap_topics,
    messages=_mcap_messages,
)
ROSBAG = Store(
    name="rosbag",
    magic={".db3": b"SQLite format 3\x00", ".bag": b"#ROSBAG V2.0"},
    topics=_bag_topics,
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

    def found(self, source: Path, options: ImportOptions) -> list[Path]:  # noqa: ARG002 - it declares nothing about this
        """Bags at a path, sorted by name."""
        return self.store.files(source)

    def motions(self, paths: Sequence[Path], arm: Arm, options: ImportOptions) -> list[Pending]:
        """One motion of each bag."""
        return [(file.stem, partial(_read, self.store, file, arm, options)) for file in paths]


def _read(store: Store, file: Path, arm: Arm, options: ImportOptions) -> RecordedMotion:
    require(f"{file}: reading {store.name}", "logs")
    with _reporting(store, file):
        held = store.topics(file)
    state, command, notes = _topics(held, options, file)
    topics = [topic for topic in (state, command) if topic]
    messages: dict[str, list[tuple[int, Any]]] = {topic: [] for topic in topics}
    with _reporting(store, file):
        for topic, time, content in store.messages(file, {*topics}):
            messages[topic].append((time, content))
            if len(messages[topic]) > MESSAGES_MOST:
                raise FileError(file, f"more than {MESSAGES_MOST} messages on {topic}", "cut it in parts")
    if silent := [topic for topic in topics if not messages[topic]]:
        raise FileError(file, f"no message on {silent[0]}", "record it again or name another topic")
    goals: list[TrajectoryGoal] = []
    samples: dict[str, list[Sample]] = {}
    for topic, group in zip(topics, ("position", "command"), strict=False):
        if kind_of(held[topic]) == TRAJECTORY and group == "command":
            goals = goals_of(messages[topic], file, topic)
        else:
            samples[topic] = samples_of(messages[topic], file, topic, held[topic], group)
    if options.names and all(sample.names for found in samples.values() for sample in found):
        raise FileError(file, "all messages name their joints", "use --map, not --order")
    stamp = options.stamp or _stamp(samples, goals, held, file, notes)
    first: list[Sample | TrajectoryGoal] = [*(found[0] for found in samples.values()), *goals[:1]]
    origin = min(one.header_ns if stamp == "header" else one.log_ns for one in first) // NANOSECONDS * NANOSECONDS
    origin = origin if origin > 10**17 else 0  # counted from 1970; smaller numbers a float64 resolves to 1e-8 s
    frames = [frame_of(found, (stamp, origin), (file, topic), arm, options, notes) for topic, found in samples.items()]
    extra = {"source": file.name, "format": store.name}
    extra |= {"clock_origin_s": f"{origin // NANOSECONDS}"} if origin else {}
    motion = read_motion(file.stem, frames, arm, options, notes=notes, robot=f"{store.name}:{file.stem}", extra=extra)
    if not goals:
        return motion
    asked = commands_of(goals, motion.state, (stamp, origin), (file, command or ""), arm, options)
    return replace(motion, command=asked)


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
    kinds = {name: kind_of(schema) for name, schema in held.items()}
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
    other = [name for name in able if kinds[name] in STATES or any(word in name for word in OTHER_INTERFACES)]
    ours = [name for name in able if name not in other]
    if options.command_topic is None and len(ours) == 1:
        return state, ours[0], [f"commands from {ours[0]} ({held[ours[0]]})"]
    if options.command_topic is not None or able:
        raise FileError(file, f"no topic {command}; found {found}", "name one with --command-topic")
    return state, None, [f"no topic with commands; found {found}"]


def _stamp(
    samples: dict[str, list[Sample]], goals: list[TrajectoryGoal], held: dict[str, str], file: Path, notes: list[str]
) -> str:
    """Whose stamps are the times: ``header`` or ``log``."""
    bare = [topic for topic, found in samples.items() if not any(sample.header_ns for sample in found)]
    # an empty stamp of a trajectory asks for a start at once
    if not bare and all(goal.header_ns for goal in goals):
        return "header"
    if len(bare) == 1 < len(samples) and kind_of(held[bare[0]]) != ARRAY:  # an array has none
        raise FileError(file, f"the messages on {bare[0]} have no stamps, the others do", "set stamp to log for both")
    notes.append(
        f"times are those of the recording, messages on {', '.join(bare) or 'the command topic'} have no stamps"
    )
    return "log"
