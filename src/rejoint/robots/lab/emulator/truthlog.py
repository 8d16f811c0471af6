"""The one thing that nobody can ask an emulated robot for: where its tool really is."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TextIO

from rejoint.robots.lab.emulator.armlike import ArmLike
from rejoint.system.errors import FileError


class TruthLog:
    """Writes where the tool really is beside the wall clock, for experiments: CSV, one row a tick.

    The clock is `time.monotonic`. But for sleeps of the computer it is the one that the driver stamps joint states
    with; on one machine the two can be laid side by side.
    """

    def __init__(self, path: Path, stream: TextIO, joints: int) -> None:
        self._path, self._stream = path, stream
        self._put(
            ["time", "x", "y", "z", *(f"{what}.joint{i + 1}" for what in ("encoder", "link") for i in range(joints))]
        )

    @classmethod
    def open(cls, path: Path, joints: int) -> TruthLog:
        """Begin a new file; FileError if that is not possible."""
        try:
            stream = path.open("w", encoding="utf-8", buffering=1)
        except OSError as error:
            raise FileError(path, f"cannot be written ({error.strerror})", "choose another path") from error
        return cls(path, stream, joints)

    def write(self, now: float, arm: ArmLike) -> None:
        """Add a row: [s], [m], [rad]. FileError if the disk is full."""
        self._put(f"{value:.6f}" for value in [now, *arm.true_tcp, *arm.angles, *arm.true_links])

    def _put(self, row: Iterable[str]) -> None:
        try:
            self._stream.write(",".join(row) + "\n")
        except OSError as error:
            raise FileError(
                self._path, f"cannot be written ({error.strerror})", "make room or log elsewhere"
            ) from error

    def close(self) -> None:
        """Finish the file."""
        self._stream.close()
