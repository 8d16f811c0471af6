"""Addresses of arms on a Feetech bus: a serial device, or a port of another machine that passes one on."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from rejoint.robots.address import serial_address, tcp_address
from rejoint.robots.feetech.gains import KNOBS, Gains, read_gains

FORM = "feetech:///dev/DEVICE or feetech://HOST:PORT"
_PORT = 9000
_BAUD = 1_000_000
"""[1/s] of a servo as sold"""
_OPTIONS = ("baud", "calibration", "zero", *KNOBS)


@dataclass(frozen=True, kw_only=True)
class FeetechAddress:
    """Where a bus is, and what is known of the arm on it."""

    text: str
    """as the user wrote it"""
    port: str
    """as pyserial names it: ``/dev/ttyACM0``, ``socket://HOST:PORT``"""
    baud: int = _BAUD
    """[1/s]"""
    calibration: Path | None = None
    """LeRobot's calibration of this arm; None for the limits that its servos hold"""
    zero: tuple[float, ...] = ()
    """[deg] angle of each joint, by the arm's description, in the middle of its range; none for zero"""
    gains: Gains = field(default_factory=dict)
    """of the servos' own loop, by `rejoint.robots.feetech.gains.KNOBS`; none: as they are"""

    def __str__(self) -> str:
        return self.text

    @property
    def spot(self) -> str:
        """The one place that it means, however it is written."""
        plain = self.text.partition("?")[0]
        if self.port.startswith("/"):
            return serial_address(plain, baud=self.baud).spot
        return tcp_address(plain, port=_PORT).spot


def feetech_address(text: str) -> FeetechAddress:
    """Read ``feetech:///dev/DEVICE`` or ``feetech://HOST:PORT``; ValueError for anything else.

    After a question mark: ``calibration=FILE.json`` (LeRobot's), ``zero=DEG,DEG,...`` (a number per joint), and for a
    device ``baud=N``; the servos' own gains are ``p``, ``i``, ``d`` and ``dead``.
    """
    plain, _, query = text.partition("?")
    options = parse_qs(query, strict_parsing=True, keep_blank_values=True) if query else {}
    unknown = set(options) - set(_OPTIONS)
    if unknown or any(len(values) > 1 or not values[0] for values in options.values()):
        raise ValueError(f"expected each of {', '.join(_OPTIONS)} once at most, got {query!r}")
    given = {name: values[0] for name, values in options.items()}
    parts = urlsplit(plain)
    if parts.netloc:
        if "baud" in given:
            raise ValueError("the baud rate is that of the other machine; leave it out")
        server = tcp_address(plain, port=_PORT)
        port = f"socket://{server.host}:{server.port}"
    elif parts.path.startswith("/") and parts.path != "/":
        port = parts.path
    else:
        raise ValueError(f"not of the form {FORM}")
    baud = given.get("baud", str(_BAUD))
    if not (baud.isascii() and baud.isdecimal() and int(baud) > 0):
        raise ValueError(f"the baud rate must be a positive whole number, got {baud!r}")
    return FeetechAddress(
        text=text, port=port, baud=int(baud), zero=_degrees(given.get("zero")),
        calibration=Path(given["calibration"]).expanduser() if "calibration" in given else None,
        gains=read_gains({name: given[name] for name in KNOBS if name in given}),
    )  # fmt: skip


def _degrees(text: str | None) -> tuple[float, ...]:
    if text is None:
        return ()
    try:
        found = tuple(float(word) for word in text.split(","))
    except ValueError:
        found = ()
    if not found or not all(-180.0 <= angle <= 180.0 for angle in found):
        raise ValueError(f"expected zero=DEG,DEG,... from -180 to 180, one per joint, got {text!r}")
    return found
