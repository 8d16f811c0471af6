"""Faults of the link: what becomes of an answer on its way, and when the link stands still or is gone."""

from __future__ import annotations

import math

import numpy as np

from rejoint.robots.lab.emulator.faults import Faults

SPLIT_PAUSE = 0.05
"""[s] between the two pieces of an answer: two segments of their own, well below the 0.3 s a client waits (chosen)"""
MOST_GARBAGE = 12
"""random bytes at most, as many as half a frame (chosen)"""

_CHANCES = ("drop", "garbage", "stale", "split", "half", "double", "echo")


class LinkGoneError(Exception):
    """The connection is no longer there."""


class DeathError(Exception):
    """The emulator has to end without a word."""


class WireFaults:
    """What the faults do to a link; without faults nothing. Times are [s] after the first byte of a client."""

    def __init__(self, faults: Faults, seed: int = 0) -> None:
        self._faults = faults
        self._streams = {name: np.random.default_rng([seed, place]) for place, name in enumerate(_CHANCES)}
        self._earlier: dict[int, tuple[bytes, bytes]] = {}
        """id -> the last request of this id and what was answered"""

    @property
    def delay(self) -> float:
        """[s] that every answer takes longer."""
        return self._faults.slow

    def check(self, elapsed: float) -> None:
        """DeathError if the emulator has ended, LinkGoneError while there is no link."""
        if self._faults.die is not None and elapsed >= self._faults.die:
            raise DeathError
        if any(gone.after <= elapsed < gone.after + gone.duration for gone in self._faults.gone):
            raise LinkGoneError

    def still_until(self, elapsed: float) -> float:
        """When the link moves on; ``elapsed`` itself unless it stands still."""
        if self._faults.silent is not None and elapsed >= self._faults.silent:
            return math.inf
        stall = self._faults.stall
        if stall is None or elapsed < stall.every:
            return elapsed
        begin = stall.every * math.floor(elapsed / stall.every)
        return max(elapsed, begin + stall.duration)

    def pieces(self, request: bytes, answer: bytes) -> list[bytes]:
        """Return what goes out instead of ``answer``, with a `SPLIT_PAUSE` between pieces; nothing if it is lost."""
        hit = {name: self._draw(name) for name in _CHANCES}
        answer = self._perhaps_old(request, answer, old=hit["stale"])
        if hit["drop"]:
            return []
        if hit["half"]:
            answer = answer[: self._cut("half", answer)]
        if hit["garbage"]:
            answer = self._with_garbage(answer)
        if hit["echo"]:
            answer = request + answer
        if hit["double"]:
            answer = answer * 2
        if not hit["split"]:
            return [answer]
        cut = self._cut("split", answer)
        return [piece for piece in (answer[:cut], answer[cut:]) if piece]

    def _draw(self, name: str) -> bool:
        share: float = getattr(self._faults, name)
        return share > 0.0 and bool(self._streams[name].random() < share)

    def _perhaps_old(self, request: bytes, answer: bytes, *, old: bool) -> bytes:
        if not self._faults.stale:
            return answer
        command = request[3]
        asked, answered = self._earlier.get(command, (b"", b""))
        if old and asked == request:
            return answered
        self._earlier[command] = request, answer
        return answer

    def _with_garbage(self, answer: bytes) -> bytes:
        stream = self._streams["garbage"]
        noise = stream.bytes(int(stream.integers(1, MOST_GARBAGE, endpoint=True)))
        place = 0 if stream.random() < 0.5 else self._cut("garbage", answer)
        return answer[:place] + noise + answer[place:]

    def _cut(self, name: str, answer: bytes) -> int:
        """Return a place inside ``answer``."""
        return int(self._streams[name].integers(1, max(len(answer), 2)))
