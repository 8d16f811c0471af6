"""Finished trials on file, and trials shared with a helper process.

Each line is JSON with its CRC-32; the first names the comparison. Two processes take trials from the two ends of one
list.
"""

from __future__ import annotations

import json
import os
import zlib
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Thread
from typing import Any, Protocol

import numpy as np

from rejoint.control.comparison.protocols import Driven, Key, Kind, Places
from rejoint.control.comparison.result import Ended
from rejoint.control.recording import Recording
from rejoint.system.errors import FileError
from rejoint.system.files import MEGABYTE, read_bounded, set_aside, unwritable
from rejoint.system.stopping import pause

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


Task = tuple[str, Kind]
Result = tuple[Driven, Recording]

_LOOK = 0.02


class HelperLostError(Exception):
    """A helper ended or failed."""


class Helper(Protocol):
    """A process that drives trials."""

    def settle(self) -> tuple[Task, ...]:
        """Its begun tasks; it begins no more."""

    def drive(self, task: Task, places: Places) -> Result:
        """Drive the trials of a task; HelperLostError."""

    def close(self) -> None:
        """End it."""


class Shared:
    """Tasks shared with a helper."""

    def __init__(self, tasks: Sequence[Task], helper: Helper | None, places: Places) -> None:
        begun = () if helper is None else helper.settle()
        self._left, self._helper, self._places = deque(sorted(tasks, key=begun.__contains__)), helper, places
        self._done: SimpleQueue[Result] = SimpleQueue()
        self._courier = Thread(target=self._carry, daemon=True)
        if helper is not None and len(tasks) > 1:
            self._courier.start()

    def here(self) -> Iterator[Task]:
        """Yield this process's tasks."""
        while True:
            while self._left:
                try:
                    yield self._left.popleft()
                except IndexError:  # the helper was quicker
                    break
            if not self._courier.is_alive() and not self._left:
                return
            pause(_LOOK)

    def arrived(self) -> Iterator[Result]:
        """Yield the helper's new results."""
        while True:
            try:
                yield self._done.get_nowait()
            except Empty:
                return

    def _carry(self) -> None:
        assert self._helper is not None  # noqa: S101 - for the type checker
        while True:
            try:
                task = self._left.pop()
            except IndexError:
                return
            try:
                self._done.put(self._helper.drive(task, self._places))
            except HelperLostError:
                self._left.append(task)
                return
