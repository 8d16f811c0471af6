"""Robots by families."""

from __future__ import annotations

from pathlib import Path

from rejoint.arms import Arm, load_arm
from rejoint.control.robot import Robot
from rejoint.robots.bus import Bus, Clock, Reading, Vitals
from rejoint.robots.busrobot import BusRobot, bus_family
from rejoint.robots.family import DEFAULT_ARM, Family, Opening, Place
from rejoint.robots.registry import is_virtual, place_of, usable


def open_robot(
    address: str,
    *,
    arm: Arm | str | Path | None = None,
    seed: int = 0,
    count: int = 1,
    period: tuple[float, float] | None = None,
    threads: int = 1,
) -> Robot:
    """Connect to the unguarded joints of the robot at ``address``; see `rejoint.connect` for an arm.

    ``arm``: an arm, a name or a file. A myCobot is powered on and put into fresh mode; nothing moves.

    Examples
    --------
    >>> robot = rejoint.open_robot("emulated:worn")
    >>> state = robot.step(robot.read().position + 0.01)
    >>> robot.close()
    """
    arm = load_arm(arm) if isinstance(arm, str | Path) else arm
    return place_of(address).open(arm=arm, seed=seed, count=count, period=period, threads=threads)


__all__ = [
    "DEFAULT_ARM",
    "Bus",
    "BusRobot",
    "Clock",
    "Family",
    "Opening",
    "Place",
    "Reading",
    "Vitals",
    "bus_family",
    "is_virtual",
    "open_robot",
    "place_of",
    "usable",
]
