"""What a path holds, in words, where it is no log: an error names what was found, not only what was expected."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from rejoint.logs.textfile import head, shown

_MAGIC = (
    (b"PAR1", "a Parquet table"), (b"PK\x03\x04", "a ZIP archive (a workbook of a spreadsheet is one: save it as CSV)"),
    (b"\x1f\x8b", "a file compressed with gzip: unpack it"),
    (b"\x28\xb5\x2f\xfd", "a file compressed with zstd: unpack it"),
    (b"BZh", "a file compressed with bzip2: unpack it"), (b"\xfd7zXZ", "a file compressed with xz: unpack it"),
    (b"\x89HDF", "an HDF5 file"), (b"#ROSBAG V2.0", "a bag of ROS 1: convert it with rosbags-convert"),
    (b"SQLite format 3", "an SQLite database"), (b"\x89MCAP0", "an MCAP file"), (b"MATLAB", "a MATLAB file"),
    (b"\x93NUMPY", "a NumPy array"), (b"\x89PNG", "a picture"), (b"\xff\xd8\xff", "a picture"), (b"%PDF", "a PDF"),
    (b"\x7fELF", "a program"), (b"\xd0\xcf\x11\xe0", "a workbook of an old spreadsheet: save it as CSV"),
)  # fmt: skip
"""First bytes of files that people take for logs. Source: the list of the program `file`."""

_SHOWN = 8
"""Files of a folder that are named (chosen)"""


def describe(path: Path) -> str:
    """Say what a file or folder is."""
    if path.is_dir():
        return _folder(path)
    if not path.is_file():
        return "neither a file nor a folder"
    with path.open("rb") as file:
        start = file.read(4096)
    if not start:
        return "an empty file"
    for magic, words in _MAGIC:
        if start.startswith(magic):
            return f"{words}{_columns(path)}" if magic == b"PAR1" else words
    sheet = head(path)
    if sheet is not None:
        return f"text in {sheet.found}: {sheet.shown}"
    if start.lstrip()[:1] in (b"{", b"["):
        return _json(path)
    if start.lstrip()[:1] == b"<":
        return "XML"
    return "binary data" if b"\x00" in start else "text without columns"


def _folder(path: Path) -> str:
    names = sorted(entry.name + "/" * entry.is_dir() for entry in path.iterdir())
    if not names:
        return "an empty folder"
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return f"a folder with {', '.join(names[:_SHOWN])}{more}"


def _columns(path: Path) -> str:
    try:
        return f" with the columns {shown(tuple(pq.read_schema(path).names))}"
    except (OSError, pa.ArrowException, ValueError):
        return ", damaged"


def _json(path: Path) -> str:
    try:
        value = json.loads(path.read_bytes()[: 1 << 20])
    except (ValueError, RecursionError):
        return "text that looks like JSON"
    return f"JSON with the entries {shown(tuple(map(str, value)))}" if isinstance(value, dict) else "JSON"
