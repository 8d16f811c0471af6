"""Arms one can drive, by families: emulated, a myCobot through its vendor's client, and what other packages bring."""

from __future__ import annotations

from rejoint.arms import Arm
from rejoint.control.robot import Robot
from rejoint.robots.bus import Bus, Clock, Reading, Vitals
from rejoint.robots.busrobot import BusRobot, bus_family
from rejoint.robots.family import DEFAULT_ARM, Family, Opening, Place
from rejoint.robots.own import SIMULATOR
from rejoint.robots.registry import place_of


def open_robot(
    address: str,
    *,
    arm: Arm | None = None,
    seed: int = 0,
    count: int = 1,
    period: tuple[float, float] | None = None,
    threads: int = 1,
) -> Robot:
    """Connect to the robot at ``address``: ``emulated:PROFILE``, ``tcp://HOST:PORT``, ``serial:///dev/DEVICE``.

    Shorthand for `place_of` and `Place.open`, which see. A myCobot is powered on if it is off and put into fresh mode;
    nothing moves.
    """
    return place_of(address).open(arm=arm, seed=seed, count=count, period=period, threads=threads)


__all__ = [
    "DEFAULT_ARM", "SIMULATOR", "Bus", "BusRobot", "Clock", "Family", "Opening", "Place", "Reading", "Vitals",
    "bus_family", "open_robot", "place_of",
]  # fmt: skip
