"""Bags of ROS 2 in sqlite3 files (.db3), as distributions before Iron record them, through the package ``rosbags``."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rejoint.arms import Arm
from rejoint.logs import bags
from rejoint.logs.bags import Inventory, Message, Store, Topic
from rejoint.logs.mcapfile import DECLARATIONS
from rejoint.logs.messages import NANOSECONDS
from rejoint.logs.options import ImportOptions
from rejoint.logs.runlog import LOG_MOST
from rejoint.logs.track import RecordedMotion
from rejoint.system.errors import FileError
from rejoint.system.files import begins_with, require_file

ENDING = ".db3"
MAGIC = b"SQLite format 3\x00"
"""First bytes of the file. Source: sqlite.org/fileformat2.html."""
_ZSTD = b"\x28\xb5\x2f\xfd"
_REMEDY = "record it again, or mend it with `ros2 bag convert`"


def fits(source: Path, options: ImportOptions) -> bool:  # noqa: ARG001 - it declares nothing about this
    """Tell whether a file is such a bag, or a folder holds some."""
    return bool(_files(source))


def motions(source: Path, arm: Arm, options: ImportOptions) -> tuple[int, Iterator[RecordedMotion]]:
    """Count the bags at a path and read them one by one, sorted by name."""
    options.refuse_others(source, "rosbag", *DECLARATIONS)
    files = [source] if source.is_file() else _files(source)
    if not files:
        raise FileError(source, f"no bag of ROS 2 ({ENDING}) here", "check the path or the format")
    return bags.motions(STORE, files, arm, options)


def _files(source: Path) -> list[Path]:
    found = sorted(source.glob(f"*{ENDING}")) if source.is_dir() else [source]
    return [file for file in found if file.suffix == ENDING and begins_with(file, MAGIC)]


def _opened(file: Path) -> Any:  # noqa: ANN401 - the library is optional
    from rosbags.rosbag2 import Reader

    require_file(file, LOG_MOST, "cut it into several bags")
    unwritten = file.with_name(f"{file.name}-wal")
    if unwritten.is_file() and unwritten.stat().st_size:
        raise FileError(file, f"was not closed: part of it is still in {unwritten.name}", "run `ros2 bag reindex`")
    return Reader(file)


def _inventory(file: Path) -> Inventory:
    with _opened(file) as bag:
        seconds = bag.duration / NANOSECONDS
        topics = {
            name: Topic(schema=info.msgtype or "", count=info.msgcount, seconds=seconds)
            for name, info in bag.topics.items()
        }
    return Inventory(topics=topics, header={})


def _messages(file: Path, topics: set[str]) -> dict[str, list[Message]]:
    """Decode the messages of some topics, in the order of their times."""
    from rosbags.typesys import Stores, get_typestore

    kinds = get_typestore(Stores.LATEST)  # messages about joints are the same in all distributions
    found: dict[str, list[Message]] = {}
    with _opened(file) as bag:
        chosen = [connection for connection in bag.connections if connection.topic in topics]
        for connection, time, data in bag.messages(connections=chosen):
            message = kinds.deserialize_cdr(_unpacked(data, file), connection.msgtype)
            found.setdefault(connection.topic, []).append((time, message))
    return found


def _unpacked(data: bytes, file: Path) -> bytes:
    """Return a message of a bag that compresses each by itself, or as it is."""
    if not data.startswith(_ZSTD):
        return data
    import zstandard

    size = zstandard.frame_content_size(data)
    if not 0 <= size <= 1 << 24:
        raise FileError(file, f"a message that unpacks to {size} bytes", _REMEDY)
    return zstandard.ZstdDecompressor().decompress(data)


STORE = Store(name="rosbag", inventory=_inventory, messages=_messages)
