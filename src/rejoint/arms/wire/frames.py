"""Frames of the myCobot wire protocol, as pure functions on bytes.

A frame is ``FE FE LEN ID payload FA`` with LEN = payload bytes + 2. There is no checksum, and
nothing is escaped: a header or a footer may occur inside a payload, so a frame is only known to be
one when its LEN fits and its last byte is the footer.

Source: the vendor's communication protocol page (elephantrobotics/mycobot_docs, 18-communication)
and the reader of pymycobot 4.0.7, which refuses LEN above 30.
"""

from __future__ import annotations

from dataclasses import dataclass

HEADER = b"\xfe\xfe"
FOOTER = 0xFA
MAX_PAYLOAD = 28
"""[bytes] longest payload that the client's reader accepts"""

_OVERHEAD = 2
"""LEN counts the command id and the footer besides the payload."""


@dataclass(frozen=True)
class Frame:
    """One command or one reply; both carry the same id."""

    command: int
    payload: bytes = b""

    def __post_init__(self) -> None:
        if not 0 <= self.command <= 0xFF or len(self.payload) > MAX_PAYLOAD:
            raise ValueError(
                f"a frame holds an id of one byte and at most {MAX_PAYLOAD} payload bytes, "
                f"got id {self.command} and {len(self.payload)} bytes"
            )


def encode(frame: Frame) -> bytes:
    """Return the bytes of a frame."""
    return HEADER + bytes((len(frame.payload) + _OVERHEAD, frame.command)) + frame.payload + bytes((FOOTER,))


def split(buffer: bytes) -> tuple[list[Frame], bytes]:
    """Find every whole frame in ``buffer``; return them and the bytes that may begin another one.

    Garbage before, between and after frames is skipped. What is returned as the rest is shorter
    than one frame.
    """
    frames: list[Frame] = []
    start = 0
    while True:
        start = buffer.find(HEADER, start)
        if start < 0:
            return frames, buffer[-1:] if buffer.endswith(HEADER[:1]) else b""
        if len(buffer) < start + 3:
            return frames, buffer[start:]
        length = buffer[start + 2]
        end = start + 3 + length
        if not _OVERHEAD <= length <= MAX_PAYLOAD + _OVERHEAD:
            start += 1
        elif len(buffer) < end:
            return frames, buffer[start:]
        elif buffer[end - 1] != FOOTER:
            start += 1
        else:
            frames.append(Frame(buffer[start + 3], buffer[start + 4 : end - 1]))
            start = end


class Decoder:
    """Finds frames in a stream that arrives in pieces."""

    def __init__(self) -> None:
        self._rest = b""

    @property
    def pending(self) -> bool:
        """Whether bytes are kept that may begin a frame."""
        return bool(self._rest)

    def feed(self, data: bytes) -> list[Frame]:
        """Take the next bytes; return the frames that they complete."""
        frames, self._rest = split(self._rest + data)
        return frames

    def expire(self) -> list[Frame]:
        """Give up waiting for the rest of a half frame; return the frames that it had swallowed.

        A header whose LEN promises more than will ever come must not eat the commands behind it.
        """
        frames: list[Frame] = []
        while self._rest:
            found, self._rest = split(self._rest[1:])
            frames += found
        return frames
