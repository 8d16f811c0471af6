"""Progress: the one way in which everything that takes long says how far it is."""

from __future__ import annotations

import time
from collections.abc import Callable

Progress = Callable[[float, str], object]
"""Called now and then with the share that is done, 0 to 1, and a few words."""

INTERVAL = 0.1
"""[s] between two calls of what a user gives (chosen)"""


def no_progress(share: float, what: str) -> None:
    """Take progress that is not wanted."""


def part(progress: Progress, start: float, end: float, prefix: str = "") -> Progress:
    """Return the progress of a part of the work, which goes from the share ``start`` of the whole to ``end``."""
    return lambda share, what: progress(start + (end - start) * share, f"{prefix}{what}")


class RateLimit:
    """Hands on progress, but not more often than a person can read it."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._due, self._done = progress, -float("inf"), False

    def __call__(self, share: float, what: str) -> None:
        """Hand on, or not yet."""
        now = time.monotonic()
        if not self._done and (share >= 1.0 or now >= self._due):
            self._due, self._done = now + INTERVAL, share >= 1.0
            self._progress(share, what)
