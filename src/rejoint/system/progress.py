"""Progress of long work."""

import time
from collections.abc import Callable

Progress = Callable[[float, str], object]
"""Receives the done share, 0 to 1, and a label"""

INTERVAL = 0.1
"""[s] between a user's calls (chosen)"""


def no_progress(share: float, what: str) -> None:
    """Ignore progress."""


def part(progress: Progress, start: float, end: float, prefix: str = "") -> Progress:
    """Progress of a part, from the share ``start`` to ``end``."""
    return lambda share, what: progress(start + (end - start) * share, f"{prefix}{what}")


class RateLimit:
    """Passes progress on at a limited rate."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._due, self._done = progress, 0.0, False

    def __call__(self, share: float, what: str) -> None:
        """Pass on, or not yet."""
        now = time.monotonic()
        if not self._done and (share >= 1.0 or now >= self._due):
            self._due, self._done = now + INTERVAL, share >= 1.0
            self._progress(share, what)
