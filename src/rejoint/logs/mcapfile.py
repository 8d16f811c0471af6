"""MCAP files: messages of ROS 2 (CDR), protobuf and JSON (mcap.dev/spec)."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from rejoint.arms import Arm
from rejoint.logs import bags
from rejoint.logs.bags import METADATA, Inventory, Message, Store, Topic
from rejoint.logs.messages import NANOSECONDS, REMEDY
from rejoint.logs.options import ImportOptions
from rejoint.logs.track import RecordedMotion
from rejoint.system.errors import FileError
from rejoint.system.files import MEGABYTE, begins_with

MAGIC = b"\x89MCAP0\r\n"
"""First bytes of every MCAP file. Source: mcap.dev/spec."""
DECLARATIONS = ("angle_unit", "joint_map", "joint_order", "state_topic", "command_topic", "stamp", "calibration")
"""What a user may declare about messages"""

_RECORD_LIMIT = 1 << 28
"""[bytes] chosen: larger than any chunk a recorder writes, smaller than a Raspberry Pi's memory."""
_CHUNK_MOST = 1000 * MEGABYTE
"""Largest chunk that is unpacked (chosen: a thousand times what recorders write)"""


def fits(source: Path, options: ImportOptions) -> bool:  # noqa: ARG001 - it declares nothing about this
    """Tell whether a file is MCAP, or a folder holds such files."""
    return bool(_files(source))


def motions(source: Path, arm: Arm, options: ImportOptions) -> tuple[int, Iterator[RecordedMotion]]:
    """Count the MCAP files at a path and read them one by one, sorted by name."""
    options.refuse_others(source, "mcap", *DECLARATIONS)
    files = [source] if source.is_file() else _files(source)
    if not files:
        raise FileError(source, "no MCAP file here", "check the path or the format")
    return bags.motions(STORE, files, arm, options)


def _files(source: Path) -> list[Path]:
    if source.is_dir():
        return sorted(file for file in source.glob("*.mcap") if begins_with(file, MAGIC))
    return [source] if begins_with(source, MAGIC) else []


def _inventory(file: Path) -> Inventory:
    """Return the topics, and the metadata of an exported log."""
    with file.open("rb") as stream:
        reader = _reader(stream)
        summary = reader.get_summary()
        if summary is not None:
            largest = max((chunk.uncompressed_size for chunk in summary.chunk_indexes), default=0)
            if largest > _CHUNK_MOST:
                raise FileError(file, f"a chunk of {largest} bytes, expected at most {_CHUNK_MOST}", REMEDY)
        topics = _topics(reader) if summary is None or summary.statistics is None else _counted(summary)
        kept = [record.metadata for record in reader.iter_metadata() if record.name == METADATA]
    return Inventory(topics=topics, header=kept[0] if kept else {})


def _counted(summary: Any) -> dict[str, Topic]:  # noqa: ANN401 - the library is optional
    schemas = {number: schema.name for number, schema in summary.schemas.items()}
    found = summary.statistics
    seconds = max(found.message_end_time - found.message_start_time, 0) / NANOSECONDS
    counts: dict[str, int] = {}
    for channel in summary.channels.values():
        counts[channel.topic] = counts.get(channel.topic, 0) + found.channel_message_counts.get(channel.id, 0)
    return {
        channel.topic: Topic(
            schema=schemas.get(channel.schema_id, ""), count=counts[channel.topic], seconds=seconds
        )
        for channel in summary.channels.values()
    }  # fmt: skip


def _topics(reader: Any) -> dict[str, Topic]:  # noqa: ANN401
    """Count the messages of each topic of a file that does not."""
    names: dict[str, str] = {}
    times: dict[str, list[int]] = {}
    for schema, channel, message in reader.iter_messages(log_time_order=False):
        names[channel.topic] = schema.name if schema else ""
        times.setdefault(channel.topic, []).append(message.log_time)
    return {
        topic: Topic(schema=names[topic], count=len(found), seconds=(max(found) - min(found)) / NANOSECONDS)
        for topic, found in times.items()
    }


def _reader(stream: IO[bytes]) -> Any:  # noqa: ANN401
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


def _messages(file: Path, topics: set[str]) -> dict[str, list[Message]]:
    """Decode the messages of some topics, in the order of the file, each with its time of recording [ns]."""
    found: dict[str, list[Message]] = {}
    with file.open("rb") as stream:
        reader = _reader(stream)
        decoded = reader.iter_decoded_messages(topics=sorted(topics), log_time_order=False)
        for _, channel, message, content in decoded:
            found.setdefault(channel.topic, []).append((message.log_time, content))
        summary = reader.get_summary()
    if summary is not None and summary.statistics is not None:
        for topic, promised in _counted(summary).items():
            held = len(found.get(topic, []))
            if topic in topics and promised.count != held:
                raise FileError(file, f"{held} messages on {topic}, its statistics promise {promised.count}", REMEDY)
    return found


STORE = Store(name="mcap", inventory=_inventory, messages=_messages)
