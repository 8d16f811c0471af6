"""Journals: a run log on disk while it is recorded.

A hidden file beside the run log: a line of JSON, then rows of float64 (time, position, command, target, true TCP), each
with its CRC-32. A thread writes it. After ``kill -9`` `recover` restores all but the last `INTERVAL`. Where writing
fails, the run goes on.
"""

import json
import os
import threading
import zlib
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.logs.runlog import LOG_MOST, RunLog
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import read_bounded, unused, writing

INTERVAL = 0.25
"""[s] between writes (chosen)"""

CUT_SHORT = "cut-short"
"""Suffix of a recovered log"""

_ENDING = ".journal"
_MAGIC = "rejoint journal 1"


class Journal:
    """Writes rows of one arm, until `finish` or `discard`."""

    def __init__(self, path: Path, arm: Arm, robot: str, label: str) -> None:
        """Open the journal of the run log at ``path``, of the ``robot`` at this address; FileError."""
        about = {"arm": arm.name, "joints": arm.joint_names, "robot": robot, "label": label}
        self.path, self.file = path, path.with_name(f".{path.stem}{_ENDING}")
        self.problem: OSError | None = None
        """first write error"""
        self._rows, self._over = deque[bytes](), threading.Event()
        with writing(self.file):
            self.file.parent.mkdir(parents=True, exist_ok=True)
            self._handle = os.open(self.file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
            try:
                _write(self._handle, f"{_MAGIC} {json.dumps(about)}\n".encode())
            except OSError:
                os.close(self._handle)
                self.file.unlink(missing_ok=True)
                raise
        self._thread = threading.Thread(target=self._write_on, name="journal", daemon=True)
        self._thread.start()

    def see(self, cycle: Any) -> None:  # noqa: ANN401 - of `rejoint.control.recording.Cycle`, a room above
        """Add a control cycle."""
        self.append(cycle.time[0], cycle.position[0], cycle.command[0], cycle.target[0], cycle.true_tcp[0])

    def append(self, time: float, position: Array, command: Array, target: Array, true_tcp: Array) -> None:
        """Add a row: [s], (n,) [rad], (n,) [rad], (3,) [m], (3,) [m]."""
        if self.problem is None:
            data = np.concatenate(((time,), position, command, target, true_tcp)).astype("<f8", copy=False).tobytes()
            self._rows.append(data + zlib.crc32(data).to_bytes(4, "little"))

    def finish(self, log: RunLog) -> None:
        """Write the run log and remove the journal; FileError."""
        self.close()
        try:
            log.save(self.path)
        except FileError as error:
            kept = f"What was written before is in {self.file}; the next command in this folder makes a log of it."
            error.add_note(kept)
            raise
        self.file.unlink(missing_ok=True)

    def rescue(self, log: RunLog | None = None) -> str:
        """Write the log of a failed run, by default what is in its journal; returns a message."""
        path: Path | None = self.path
        try:
            if log is None:
                self.close()
                path = _convert(self.file, self.path)
            else:
                self.finish(log)
        except FileError as error:
            kept = f"What was recorded until then is in {self.file}; the next command in this folder makes a log of it."
            return f"{kept} {error}"
        return "Nothing was recorded." if path is None else f"What was recorded until then: {path}"

    def discard(self) -> None:
        """Remove the journal."""
        self.close()
        self.file.unlink(missing_ok=True)

    def close(self) -> None:
        """Flush; the journal stays."""
        if not self._over.is_set():
            self._over.set()
            self._thread.join()
            os.close(self._handle)

    def _write_on(self) -> None:
        over = False
        while not over and self.problem is None:
            over = self._over.wait(INTERVAL)
            try:
                _write(self._handle, b"".join(self._rows.popleft() for _ in range(len(self._rows))))
            except OSError as error:
                self.problem = error
                self._rows.clear()


def recover(folder: Path) -> tuple[Path, ...]:
    """Make run logs of killed processes' journals.

    Journals in use look the same: call it alone. FileError.
    """
    found = []
    for file in sorted(folder.glob(f".*{_ENDING}")):
        path = folder / f"{file.name[1 : -len(_ENDING)]}.parquet"
        if path.exists():  # only the removal was missing
            file.unlink()
        elif made := _convert(file, path):
            found.append(made)
    return tuple(found)


def _convert(file: Path, path: Path) -> Path | None:
    """Make a log of a journal and remove it; None without rows.

    An unreadable journal becomes a visible file.
    """
    log = read_journal(file)
    if log is None and any(file.read_bytes()):
        file.replace(file.with_name(f"{path.stem}-damaged{_ENDING}"))
    made = None
    if log:
        made = unused(path.with_stem(f"{path.stem}-{CUT_SHORT}"))
        log.save(made)
    file.unlink(missing_ok=True)
    return made


def read_journal(file: Path) -> RunLog | None:
    """Whole rows of a journal; None without a header."""
    head, _, rest = read_bounded(file, "delete it", LOG_MOST).partition(b"\n")
    try:
        magic, _, text = head.decode().partition(" {")
        about: dict[str, Any] = json.loads("{" + text)
        if magic != _MAGIC:
            return None
        n = len(about["joints"])
        time, *groups = np.split(_whole_rows(rest, 1 + 2 * n + 6), [1, 1 + n, 1 + 2 * n, 4 + 2 * n], axis=1)
        return RunLog(
            arm=about["arm"],
            joint_names=tuple(about["joints"]),
            robot=about["robot"],
            label=f"{about['label']}/{CUT_SHORT}",
            time=time[:, 0],
            **dict[str, Any](zip(("position", "command", "target", "true_tcp"), groups, strict=True)),
        )
    except (ValueError, KeyError, TypeError, RecursionError, InputError):
        return None


def _whole_rows(data: bytes, size: int) -> Array:
    """Rows (T, size) with correct checksum and clock."""
    row = np.dtype([("numbers", "<f8", size), ("check", "<u4")])
    rows = np.frombuffer(data, row, len(data) // row.itemsize)
    table = rows["numbers"][np.array([zlib.crc32(one["numbers"]) == one["check"] for one in rows], dtype=bool)]
    table = table[np.isfinite(table[:, :-6]).all(axis=-1)]
    return table[table[:, 0] > np.maximum.accumulate(np.append(-np.inf, table[:, 0]))[:-1]]


def _write(handle: int, data: bytes) -> None:
    while data:
        data = data[os.write(handle, data) :]
