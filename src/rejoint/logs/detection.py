"""Names the kind of a file in errors."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from rejoint.system.textfile import head, shown

_PACKED = (b"PK\x03\x04", b"\x1f\x8b", b"\x28\xb5\x2f\xfd", b"BZh", b"\xfd7zXZ")
"""First bytes of ZIP (also spreadsheets), gzip, zstd, bzip2 and xz; source: the program `file`"""
_SHOWN = 8
"""Named files of a folder (chosen)"""


def describe(path: Path) -> str:
    """Kind of a file or folder, in words."""
    if path.is_dir():
        return _folder(path)
    if not path.is_file():
        return "neither a file nor a folder"
    with path.open("rb") as file:
        start = file.read(4096)
    if not start:
        return "an empty file"
    if start.startswith(b"PAR1"):
        return f"a Parquet table{_columns(path)}"
    if start.startswith(_PACKED):
        return "a packed file or a spreadsheet: unpack it, or save it as CSV"
    sheet = head(path)
    if sheet is not None:
        return f"text in {sheet.found}: {sheet.shown}"
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
