"""Finished trials of an unfinished comparison on file, so that it resumes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.control.comparison.result import Driven, Key
from rejoint.system.files import read_json, set_aside, write_json

Numbers = list[list[float | None]]


@dataclass(frozen=True)
class _File:
    """Content; columns stand beside their trials."""

    name: str
    trials: list[tuple[Driven, dict[str, Numbers]]]


class Ledger:
    """Finished trials of the comparison ``name``; without a path in memory. Those of another one are set aside."""

    def __init__(self, path: Path | None = None, name: str = "") -> None:
        self.path, self._name, self.done = path, name, dict[Key, Driven]()
        if path is None or not path.exists():
            return
        found = read_json(path, _File)
        if found.name != name:
            set_aside(path)
            return
        for driven, columns in found.trials:
            arrays = {key: np.array(values, dtype=float) for key, values in columns.items()}
            self.done[driven.key] = replace(driven, columns=arrays)

    def add(self, driven: Driven) -> None:
        """Store a trial; FileError."""
        self.done[driven.key] = driven
        if self.path is not None:
            trials = [(replace(one, columns={}), _plain(one)) for one in self.done.values()]
            write_json(self.path, _File(self._name, trials))

    def close(self) -> None:
        """Remove the file."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


def _plain(driven: Driven) -> dict[str, Any]:
    return {name: values.tolist() for name, values in driven.columns.items()}
