"""Finished trials on file: each line is JSON with its CRC-32; the first names the comparison."""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.control.comparison.result import Driven, Ended, Key
from rejoint.system.errors import FileError
from rejoint.system.files import MEGABYTE, read_bounded, set_aside, unwritable

LEDGER_MOST = 256 * MEGABYTE
"""[bytes] (chosen)"""


class Ledger:
    """Finished trials."""

    def __init__(self, path: Path | None, done: dict[Key, Driven]) -> None:
        self.path, self.done = path, done

    @classmethod
    def begin(cls, path: Path, name: str) -> Ledger:
        """Open or make the ledger of ``name``; another one's is set aside."""
        try:
            lines = list(_lines(path))
            if lines and lines[0] == name:
                with path.open("ab") as file:
                    file.write(b"\n")  # what comes next stands on a line of its own, whatever was cut before it
                return cls(path, {driven.key: driven for driven in map(_decode, lines[1:])})
            set_aside(path)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(_line(name))
        except OSError as error:
            raise unwritable(path, error) from error
        except (ValueError, KeyError, TypeError) as error:
            raise FileError(path, "damaged", "delete it: the comparison then begins at its first trial") from error
        return cls(path, {})

    @classmethod
    def nowhere(cls) -> Ledger:
        """Keep trials in memory."""
        return cls(None, {})

    def add(self, driven: Driven) -> None:
        """Store a trial; FileError."""
        self.done[driven.key] = driven
        if self.path is None:
            return
        try:
            with self.path.open("ab") as file:
                file.write(_line(_encode(driven)))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise unwritable(self.path, error) from error

    def close(self) -> None:
        """Remove the file."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def _line(value: object) -> bytes:
    text = json.dumps(value, separators=(",", ":"))  # writes NaN and Infinity, which trials hold
    return f"{zlib.crc32(text.encode()):08x} {text}\n".encode()


def _lines(path: Path) -> Iterator[Any]:
    if not path.exists():
        return
    for line in read_bounded(path, LEDGER_MOST, "delete it").splitlines():
        check, _, text = line.partition(b" ")
        if len(check) == 8 and check == f"{zlib.crc32(text):08x}".encode():
            yield json.loads(text)


def _encode(driven: Driven) -> dict[str, Any]:
    columns = {name: values.tolist() for name, values in driven.columns.items()}
    return asdict(replace(driven, columns={})) | {"columns": columns}


def _decode(entry: dict[str, Any]) -> Driven:
    columns = {name: np.array(values, dtype=float) for name, values in entry.pop("columns").items()}
    places = tuple((int(s), int(r)) for s, r in entry.pop("places"))
    ended = tuple(Ended(**one) for one in entry.pop("ended"))
    return Driven(**entry, places=places, ended=ended, columns=columns)
