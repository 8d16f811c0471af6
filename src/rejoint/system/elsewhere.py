"""Work that other processes may do, on this machine or elsewhere: what those who spread it need to know of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

T = TypeVar("T")
R = TypeVar("R")


class Elsewhere(Protocol):
    """Processes that wait for work."""

    @property
    def cpus(self) -> int:
        """Pieces of work that are done at the same time."""

    def each(
        self, work: Callable[[T], R], items: Sequence[T], done: Callable[[int], object] = ..., *,
        cpus_each: float = ...,
    ) -> list[R]:  # fmt: skip
        """Do work on each item, in any order, and return what came out in theirs; ``done`` is told how many are."""
