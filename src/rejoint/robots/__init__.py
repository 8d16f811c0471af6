"""Robots by families."""

from rejoint.arms import CATALOGUE, ArmLike, load_arm
from rejoint.control.robot import Robot
from rejoint.robots.bus import Bus, Clock, Reading, Vitals
from rejoint.robots.busrobot import BusRobot, bus_family
from rejoint.robots.family import DEFAULT_ARM, Family, Opening, Place
from rejoint.robots.registry import is_virtual, place_of, usable
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.numbers import as_period, as_seed, as_whole


def open_robot(
    address: str,
    *,
    arm: ArmLike | None = None,
    seed: int = 0,
    count: int = 1,
    period: tuple[float, float] | None = None,
) -> Robot:
    """Connect to the unguarded joints of the robot at ``address``; see `rejoint.connect` for an arm.

    ``arm``: an arm, a name or a file; ``period`` [s]. A myCobot is powered on and put into fresh mode; nothing moves.
    AddressError, InputError, MissingExtraError.

    Examples
    --------
    >>> robot = rejoint.open_robot("emulated:worn")
    >>> state = robot.step(robot.read().position + 0.01)
    >>> robot.close()
    """
    place = place_of(address)
    arm = load_arm(place.default_arm if arm is None else arm)
    if (
        (place.family.only or getattr(place.detail, "arm", None))
        and arm.name in CATALOGUE
        and arm.name != place.default_arm
    ):
        raise InputError(
            f"{address} is an arm of the kind {place.default_arm}, and this is about a {arm.name}; check the address, "
            "and whose run it is"
        )
    if as_whole("count", count, 1) != 1 and not place.virtual:
        raise InputError(f"{address} is one arm; only emulated robots come in batches, got count {count}")
    require(address, *place.family.needs)
    cycle = as_period(period) or place.default_period
    return place.family.connect(place, Opening(arm=arm, seed=as_seed(seed), count=count, period=cycle))


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
