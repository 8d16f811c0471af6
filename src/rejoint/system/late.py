"""Modules that are imported when they are first used."""

from __future__ import annotations

from importlib import import_module
from typing import Any


class Late:
    """A module that is slow to import, as compiled loops are: `--help` should not wait for it.

    `importlib.util.LazyLoader` does the same, but is not safe for threads in Python 3.11 (python/cpython issue 114763).
    """

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, attribute: str) -> Any:  # noqa: ANN401
        value = getattr(import_module(self._name), attribute)
        setattr(self, attribute, value)  # the next time it is found at once
        return value
