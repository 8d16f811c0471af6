"""The trials of a comparison that are done, on file as soon as they are: an interrupted comparison goes on after them.

A line of JSON per `Driven`, each with its CRC-32; a line that a killed process left half written is not one. The first
line names the comparison: results of another one (other targets, another policy, another arm) are not taken over.
"""

from __future__ import annotations

import json
import os
import zlib
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.control.comparison.driven import Driven, Key
from rejoint.control.comparison.protocols import Crossings, Holds
from rejoint.control.comparison.result import Ended
from rejoint.system.errors import FileError
from rejoint.system.files import MEGABYTE, read_bounded, set_aside, unwritable

LEDGER_MOST = 256 * MEGABYTE
"""Largest ledger that is read (chosen: a trial of ten targets takes 1 kB)"""


class Ledger:
    """Finished trials of one comparison; `begin` finds those of an interrupted one."""

    def __init__(self, path: Path | None, done: dict[Key, Driven]) -> None:
        self.path, self.done = path, done

    @classmethod
    def begin(cls, path: Path, name: str) -> Ledger:
        """Open the ledger at ``path`` of the comparison called ``name``, or make it; one of another is set aside."""
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
        """Keep trials in memory alone."""
        return cls(None, {})

    def add(self, driven: Driven) -> None:
        """Keep a trial; FileError if it cannot be written."""
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
        """Remove the file: the comparison is written."""
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
    names = ("controller", "kind", "places", "first", "cycles", "reasons", "failed")
    plain = {name: getattr(driven, name) for name in names}
    return {
        **plain,
        "ended": [{field.name: getattr(one, field.name) for field in fields(one)} for one in driven.ended],
        "crossings": _columns(driven.crossings),
        "holds": _columns(driven.holds),
    }


def _columns(results: Crossings | Holds | None) -> dict[str, Any] | None:
    return None if results is None else {item.name: getattr(results, item.name).tolist() for item in fields(results)}


def _decode(entry: dict[str, Any]) -> Driven:
    found: dict[str, Any] = {
        kind: {name: np.array(values, dtype=float) for name, values in entry[kind].items()}
        for kind in ("crossings", "holds")
        if entry[kind] is not None
    }
    return Driven(
        controller=entry["controller"], kind=entry["kind"], cycles=entry["cycles"], reasons=entry["reasons"],
        failed=entry["failed"], first=entry.get("first", 0), places=tuple((int(s), int(r)) for s, r in entry["places"]),
        ended=tuple(Ended(**one) for one in entry["ended"]),
        crossings=Crossings(**found["crossings"]) if "crossings" in found else None,
        holds=Holds(**found["holds"]) if "holds" in found else None,
    )  # fmt: skip
