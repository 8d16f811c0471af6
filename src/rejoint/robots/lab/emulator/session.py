"""The myCobot's side of a conversation: an answer leaves in one piece, after the time that a real robot takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rejoint.arms.wire.commands import answer
from rejoint.arms.wire.frames import Decoder, Frame, encode
from rejoint.robots.lab.emulator.conversation import TICK, ByteStream, Conversation
from rejoint.robots.lab.emulator.firmware import Firmware
from rejoint.robots.lab.emulator.wirefaults import SPLIT_PAUSE


@dataclass(frozen=True, kw_only=True)
class Timing:
    """How long answers take; measured on a myCobot 280: 12-15 ms for get_angles, 7-8 ms for an acknowledgement."""

    state: float = 0.012
    """[s] from the request to the answer that reports a state"""
    acknowledgement: float = 0.008
    """[s] from an order to its acknowledgement"""
    jitter: float = 0.1
    """relative standard deviation of both (chosen)"""
    tick: float = TICK
    """[s] at most between two advances of the plant"""
    pace: float = 1.0
    """simulated seconds per second of the wall clock; anything but 1 is for experiments without a controller"""


class Session(Conversation[Frame]):
    """One arm with this ``firmware``, whose answers take as long as ``timing`` says."""

    def __init__(self, firmware: Firmware, *, timing: Timing, seed: int = 0, **options: Any) -> None:  # noqa: ANN401
        super().__init__(firmware, tick=timing.tick, pace=timing.pace, seed=seed, **options)
        self._firmware, self._timing = firmware, timing
        self._rng = np.random.default_rng(seed)

    def _finder(self) -> Decoder:
        return Decoder()

    def _answer(self, channel: ByteStream, request: Frame) -> None:
        """Answer with the state at the moment of the request: it is as old as its way back takes."""
        reply = answer(self._firmware, request)
        if reply is None:
            return
        self._arm.was_asked(request.command)
        mean = self._timing.state if reply.is_state else self._timing.acknowledgement
        delay = mean * max(0.0, 1.0 + self._timing.jitter * self._rng.standard_normal())
        self.wait(None, self._clock() + delay + self._wire.delay)
        for place, piece in enumerate(self._wire.pieces(encode(request), encode(reply.frame))):
            if place:
                self.wait(None, self._clock() + SPLIT_PAUSE)
            if self._moves_on():
                channel.send(piece)
