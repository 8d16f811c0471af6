"""Names and small words of the page."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress

from rejoint.robots import place_of
from rejoint.system.errors import AddressError

CONTROLLERS = {
    "default": "target sent once, as the arm does by itself",
    "pid-sum": "joint PID of Park et al., integral as a plain sum",
    "pid-literal": "joint PID of Park et al., integral as printed",
    "integrator": "moves the command until the measured error is gone",
    "feedforward": "raises the command against gravity, then integrates",
    "servo-gains": "target sent once, under better gains of the servos themselves",
    "servo-gains+integrator": "integrator, under better gains of the servos",
    "servo-gains+feedforward": "feedforward, under better gains of the servos",
    "policy": "learned in simulation of this arm",
}
"""What each controller does"""


def joint_label(name: str) -> str:
    """Return a short label: ``joint3`` becomes ``J3``, ``elbow_joint`` becomes ``elbow``, other names stay."""
    match = re.fullmatch(r"joint_?(\d+)", name)
    return f"J{match[1]}" if match else name.removesuffix("_joint") or name


def listed(words: Sequence[str], last: str) -> str:
    """Join words with commas and ``last`` (and, or) before the last one."""
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} {last} {words[-1]}"


def plural(count: int, noun: str) -> str:
    """Return the count with its noun in the right number."""
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def short(name: str, width: int = 24) -> str:
    """Cut a name to ``width`` characters, so that a figure's labels leave room for the figure."""
    return name if len(name) <= width else f"{name[: width - 1]}…"


def sentence(text: str) -> str:
    """Begin with a capital letter and end with a full stop."""
    return f"{text[:1].upper()}{text[1:].removesuffix('.')}."


def once(robot: str) -> str:
    """Return the options with which `rejoint compare` is done in minutes on a real arm: its defaults take hours there.

    Empty for an arm in virtual time, which costs nothing. What is no address, such as ROBOT, stands for a real arm.
    """
    with suppress(AddressError):
        if place_of(robot).virtual:
            return ""
    return " --sets 1 --repetitions 1"
