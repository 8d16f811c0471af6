"""Arms one can drive: emulated in process, or a myCobot through its vendor's client."""

from __future__ import annotations

from rejoint.arms import Arm, load_arm
from rejoint.control.robot import Robot
from rejoint.robots.address import EmulatedAddress, parse_address
from rejoint.system.errors import InputError
from rejoint.system.extras import require

DEFAULT_ARM = "mycobot280"
"""Arm behind an address that does not say: the vendor's client speaks to no other."""
SIMULATOR = "mujoco"
"""Module that emulated arms need."""
_EMULATED_PERIOD = (0.020, 0.030)
"""[s] Park et al. 2024 name 20 ms; the wire adds up to half of it (chosen)"""


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

    Without ``arm`` it is that of `default_arm`; most emulated profiles scale with the arm. ``count`` emulated
    arms of one profile form a batch. ``period`` [s] is the interval from which the length of every control
    cycle is drawn; by default the robot's own. A myCobot is powered on if it is off and put into fresh
    mode; nothing moves. Raises AddressError if nothing usable is there, MissingExtraError for an emulated arm
    without the simulator.
    """
    place = parse_address(address)
    arm = arm or load_arm(default_arm(address))
    if count < 1:
        raise InputError(f"a robot needs at least one arm, got count {count}")
    period = period or default_period(address)
    if isinstance(place, EmulatedAddress):
        return _open_emulated(address, place.profile, arm, seed, count, period, threads)
    if count != 1:
        raise InputError(f"{address} is one arm; only emulated robots come in batches, got count {count}")
    from rejoint.robots.link import VendorLink
    from rejoint.robots.mycobot import DriverSettings, MyCobotRobot

    settings = DriverSettings(period=period, seed=seed)
    link = VendorLink(place)
    robot = MyCobotRobot(link, arm, settings)
    link.open()
    return robot


def default_period(address: str) -> tuple[float, float]:
    """Interval [s] of the control periods of the robot at ``address`` where nothing else is asked for."""
    if isinstance(parse_address(address), EmulatedAddress):
        return _EMULATED_PERIOD
    from rejoint.robots.mycobot import DEFAULT_PERIOD

    return DEFAULT_PERIOD


def default_arm(address: str) -> str:
    """Name of the arm at ``address``: what its wear profile describes, as ``emulated:so101``, else a myCobot."""
    place = parse_address(address)
    if not isinstance(place, EmulatedAddress):
        return DEFAULT_ARM
    require(address, SIMULATOR)
    from rejoint.lab.plant.wear import wear_arm

    return wear_arm(place.profile) or DEFAULT_ARM


def _open_emulated(
    address: str, profile: str, arm: Arm, seed: int, count: int, period: tuple[float, float], threads: int
) -> Robot:
    require(address, SIMULATOR)
    from rejoint.lab.plant.wear import load_wear
    from rejoint.robots.emulated import EmulatedRobot

    wear = load_wear(profile, arm)
    return EmulatedRobot(arm, [wear] * count, address=address, seed=seed, period=period, threads=threads)


__all__ = ["DEFAULT_ARM", "SIMULATOR", "default_arm", "default_period", "open_robot"]
