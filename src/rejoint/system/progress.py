"""Progress: the one way in which everything that takes long says how far it is."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[float, str], object]
"""Called now and then with the share that is done, 0 to 1, and what is being done, in a few words."""


def no_progress(share: float, what: str) -> None:
    """Take progress that nobody asked for."""


def part(progress: Progress, start: float, end: float, prefix: str = "") -> Progress:
    """Return the progress of a part of the work, which goes from the share ``start`` of the whole to ``end``."""
    return lambda share, what: progress(start + (end - start) * share, f"{prefix}{what}")
