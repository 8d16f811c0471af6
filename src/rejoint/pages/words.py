"""Numbers for readers: rounded, with units, never `nan`."""

import math
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import NamedTuple

from rejoint.system.statistics import Estimate, Spread

MM = 1e3
UNKNOWN = "not known"
NEVER = "never"
MOST_PLACES = 5
"""Most decimals (chosen: smaller is rounding noise)"""


def number(value: float | None, digits: int = 3, unit: str = "") -> str:
    """Value with ``digits`` significant digits and unit, or `UNKNOWN`."""
    if value is None or not math.isfinite(value):
        return UNKNOWN
    suffix = unit and f"\N{NO-BREAK SPACE}{unit}"
    return f"{value:z.{_places(value, digits)}f}{suffix}"


def interval(low: float | None, high: float | None, digits: int = 3, factor: float = 1.0) -> str:
    """``low to high`` times ``factor``; empty if an end is missing or both are equal."""
    if low is None or high is None or low == high or not (math.isfinite(low) and math.isfinite(high)):
        return ""
    low, high = low * factor, high * factor
    places = _places(max(abs(low), abs(high)), digits)
    return f"{low:z.{places}f} to {high:z.{places}f}"


def ends(one: Estimate, digits: int, factor: float = 1.0) -> str:
    """Interval of an estimate times ``factor``."""
    return interval(one.low, one.high, digits, factor)


def grouped(found: Mapping[str, Sequence[str]]) -> str:
    """Names and their joints: ``damping (joint4), delay (arm)``."""
    return ", ".join(f"{name} ({', '.join(joints)})" for name, joints in found.items())


def _places(value: float, digits: int) -> int:
    if abs(value) < 10.0**-MOST_PLACES:
        return digits - 1
    rounded = float(f"{value:.{digits - 1}e}")
    return min(max(0, digits - 1 - math.floor(math.log10(abs(rounded)))), MOST_PLACES)


class Cell(NamedTuple):
    """A cell of a table."""

    text: str
    note: str = ""
    """small print, perhaps several lines"""

    def __str__(self) -> str:
        """In one line, the small print in brackets."""
        return f"{self.text} ({', '.join(self.note.splitlines())})" if self.note else self.text


def measured(value: Spread | Estimate | None, factor: float = MM, digits: int = 2) -> Cell:
    """Value with its interval in small print."""
    one = value.mean if isinstance(value, Spread) else value
    if one is None:
        return Cell(UNKNOWN)
    return Cell(number(one.value * factor, digits), ends(one, digits, factor))


def parameter_name(element: str) -> str:
    """Name of a twin parameter: ``dry friction of joint1`` for ``coulomb.joint1``."""
    name, _, joint = element.partition(".")
    called = "dry friction" if name == "coulomb" else name.replace("_", " ")
    return f"{called} of {joint}" if joint else called


def day_and_time(text: str) -> str:
    """ISO 8601 date as ``21 November 2026, 11:57``; other text unchanged."""
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        return text
    return f"{when.day} {when:%B %Y, %H:%M}"


def listed(words: Sequence[str]) -> str:
    """Join words with commas, the last one with "and"."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


def plural(count: int, noun: str) -> str:
    """Count with its noun."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def cycles(count: float) -> str:
    """``1.05 million control cycles``."""
    return f"{count:.0f} control cycles" if count < 1e5 else f"{number(count / 1e6, 3)} million control cycles"


def short(name: str) -> str:
    """Cut a name to 24 characters."""
    return name if len(name) <= 24 else f"{name[:23]}…"


def sentence(text: str) -> str:
    """Capitalise, and end with a full stop."""
    return f"{text[:1].upper()}{text[1:].removesuffix('.')}."
