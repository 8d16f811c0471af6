"""Names and small words of the page."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from datetime import datetime

from rejoint.pages.report.numerals import number
from rejoint.robots import place_of
from rejoint.system.errors import AddressError

MONTHS = (
    "January", "February", "March", "April", "May", "June", "July", "August", "September", "October", "November",
    "December",
)  # fmt: skip

CONTROLLERS = {
    "default": "target sent once, as the arm does by itself",
    "pid-sum": "joint PID of Park et al., integral as a plain sum",
    "pid-literal": "joint PID of Park et al., integral as printed",
    "integrator": "moves the command until the measured error is gone",
    "feedforward": "raises the command against gravity, then integrates",
    "push": "feedforward, with a push against friction and a little dither",
    "servo-gains": "target sent once, under better gains of the servos themselves",
    "servo-gains+integrator": "integrator, under better gains of the servos",
    "servo-gains+feedforward": "feedforward, under better gains of the servos",
    "servo-gains+push": "push, under better gains of the servos",
    "servo-gains+policy": "policy, trained for better gains of the servos and driven under them",
    "servo-gains+predictive": "predictive, under better gains of the servos",
    "shelf": "learned in simulation for any worn arm of this build, comes with rejoint",
    "policy": "learned in simulation of this arm",
    "predictive": "plans on the twin of this arm, leaves the last millimetre to another",
}
"""What each controller does"""


SOURCES = {
    "touch": "touch, typed in by hand",
    "camera": "a camera that sees a board",
    "tracker": "a tracker",
    "emulated": "the emulator's own knowledge of its tool, and the noise of a ruler",
}
"""What measured where the tool is"""


def measured_with(source: str) -> str:
    """Say what measured; sources of other programs stay as they are."""
    return SOURCES.get(source, source)


def day_and_time(text: str) -> str:
    """Say a date in ISO 8601 as ``21 November 2026, 11:57``; what is none stays as it is."""
    try:
        when = datetime.fromisoformat(text)
    except ValueError:
        return text
    return f"{when.day} {MONTHS[when.month - 1]} {when.year}, {when:%H:%M}"


def listed(words: Sequence[str], last: str) -> str:
    """Join words with commas and ``last`` (and, or) before the last one."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"


def plural(count: int, noun: str) -> str:
    """Return the count with its noun in the right number."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def cycles(count: float) -> str:
    """``1.05 million control cycles``, or ``768 control cycles`` where they are few."""
    few = count < 1e5
    return f"{count:.0f} control cycles" if few else f"{number(count / 1e6, 3)} million control cycles"


def short(name: str, width: int = 24) -> str:
    """Cut a name to ``width`` characters, so that a figure's labels leave room for the figure."""
    return name if len(name) <= width else f"{name[: width - 1]}…"


def sentence(text: str) -> str:
    """Begin with a capital letter and end with a full stop."""
    return f"{text[:1].upper()}{text[1:].removesuffix('.')}."


def is_virtual(robot: str) -> bool:
    """Tell an arm in virtual time from a real one, as which counts what is no address, such as ROBOT."""
    with suppress(AddressError):
        return place_of(robot).virtual
    return False
