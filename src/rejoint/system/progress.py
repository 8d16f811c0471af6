"""Progress: the one way in which everything that takes long says how far it is."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

P = ParamSpec("P")
T = TypeVar("T")

Progress = Callable[[float, str], object]
"""Called now and then with the share that is done, 0 to 1, and what is being done, in a few words."""

INTERVAL = 0.1
"""[s] between two calls of what a user gives (chosen: nobody reads faster, and a control cycle has better to do)"""


def no_progress(share: float, what: str) -> None:
    """Take progress that nobody asked for."""


def part(progress: Progress, start: float, end: float, prefix: str = "") -> Progress:
    """Return the progress of a part of the work, which goes from the share ``start`` of the whole to ``end``."""
    return lambda share, what: progress(start + (end - start) * share, f"{prefix}{what}")


def paced(stage: Callable[P, T]) -> Callable[P, T]:
    """Let a function call its ``on_progress`` at the start, every `INTERVAL` at most, and with 1 when it is done."""

    @wraps(stage)
    def with_pace(*args: P.args, **given: P.kwargs) -> T:
        progress = cast("Progress | None", given.get("on_progress"))
        if progress is None:
            return stage(*args, **given)
        pace = _RateLimit(progress)
        changed: dict[str, Any] = {**given, "on_progress": pace}
        found = stage(*args, **changed)
        pace(1.0, "done")
        return found

    return with_pace


class _RateLimit:
    """Hands on progress, but not more often than a person can read it."""

    def __init__(self, progress: Progress) -> None:
        self._progress, self._due, self._done = progress, -float("inf"), False

    def __call__(self, share: float, what: str) -> None:
        now = time.monotonic()
        if not self._done and (share >= 1.0 or now >= self._due):
            self._due, self._done = now + INTERVAL, share >= 1.0
            self._progress(share, what)
