"""The bus's side of a conversation: answers take as long as their bytes do on the wire, slot by slot."""

from __future__ import annotations

from typing import Any

from rejoint.robots.lab.emulator.conversation import ByteStream, Conversation
from rejoint.robots.lab.emulator.faults import NONE, Faults
from rejoint.robots.lab.emulator.feetech.arm import ServoArm
from rejoint.robots.lab.emulator.feetech.bus import BYTE, Answer, ServoBus
from rejoint.robots.lab.emulator.feetech.packets import READ, SYNC_READ, Packet, PacketFinder, encode
from rejoint.robots.lab.emulator.wirefaults import SPLIT_PAUSE

ADAPTER = 0.001
"""[s] that a USB adapter takes for a request and its answer together (chosen: users see 1 to 2 ms for a single read)"""
GET_ANGLES = 0x20
"""As `rejoint.robots.lab.emulator.armfaults` names a question whose answer is read from the encoders."""


class BusSession(Conversation[Packet]):
    """The servos of ``arm`` for one client at a time; an answer costs the time on the wire and that of the adapter."""

    def __init__(
        self, arm: ServoArm, *, adapter: float = ADAPTER, seed: int = 0, faults: Faults = NONE, **options: Any  # noqa: ANN401
    ) -> None:  # fmt: skip
        super().__init__(arm, seed=seed, faults=faults, **options)
        self.bus = ServoBus(arm)
        self.bus.muted = self._muted
        self._adapter, self._spells = adapter, faults.mute
        self._free = 0.0
        """when the last packet has left the wire"""

    def _finder(self) -> PacketFinder:
        return PacketFinder()

    def _muted(self) -> set[int]:
        now = self._elapsed(self._clock())
        return {spell.joint for spell in self._spells if spell.after <= now < spell.after + spell.duration}

    def _answer(self, channel: ByteStream, request: Packet) -> None:
        self._free = max(self._came, self._free) + len(encode(request)) * BYTE
        answers = self.bus.execute(request)
        if not answers:
            return
        if request.code in (READ, SYNC_READ):
            self._arm.was_asked(GET_ANGLES)
        pieces = self._on_wire(request, answers)
        self._free += answers[-1].after
        self.wait(None, self._free + self._adapter + self._wire.delay)
        for place, piece in enumerate(pieces):
            if place:
                self.wait(None, self._clock() + SPLIT_PAUSE)
            if self._moves_on() and piece:
                channel.send(piece)

    def _on_wire(self, request: Packet, answers: list[Answer]) -> list[bytes]:
        """Return what arrives of the answers, with a pause between pieces; each of them has faults of its own."""
        pieces = [b""]
        for answer in answers:
            first, *rest = self._wire.pieces(encode(request), answer.data) or [b""]
            pieces[-1] += first
            pieces += rest
        return pieces
