"""The families of this package, imported when opened."""

import re
from importlib.metadata import EntryPoint, entry_points
from traceback import walk_tb
from typing import Any

from rejoint.arms import CATALOGUE
from rejoint.robots.busrobot import bus_family
from rejoint.robots.dynamixel import DynamixelAddress
from rejoint.robots.family import Family, Place, wire_address
from rejoint.robots.feetech import FeetechAddress
from rejoint.system.errors import AddressError, MissingExtraError, first_line
from rejoint.system.extras import require

FAMILIES: tuple[Family[Any], ...] = (
    # TCP port of the vendor's server; the shortest cycle [s] that the vendor names (its FAQ) is the default
    # [1/s] of the serial port on its Raspberry Pi (vendor's manual); the M5 version needs 115200
    *(
        bus_family("rejoint.robots.mycobot.bus:MyCobotBus", scheme=scheme, form=form, parse=wire_address, only=True)
        for scheme, form in (("tcp", "tcp://HOST:PORT"), ("serial", "serial:///dev/DEVICE"))
    ),
    # 50 Hz (chosen)
    bus_family(
        "rejoint.robots.feetech.bus:FeetechBus",
        scheme="feetech",
        form="feetech:///dev/DEVICE or feetech://HOST:PORT",
        parse=FeetechAddress.read,
        default_arm="so101",
        default_period=(0.020, 0.020),
        only=True,
        tunable=True,
        needs=("feetech",),
    ),
    bus_family(
        "rejoint.robots.dynamixel.bus:DynamixelBus",
        scheme="dynamixel",
        form="dynamixel:///dev/DEVICE or dynamixel://HOST:PORT",
        parse=DynamixelAddress.read,
        default_arm="koch",
        default_period=(0.020, 0.020),
        tunable=True,
        needs=("dynamixel",),
    ),
)
"""Families of this package"""

GROUP = "rejoint.robots"
"""Entry points of `Family` objects"""

_MEANT = {
    r"(/dev/.+)": "perhaps feetech://{0} (SO-101), dynamixel://{0} (Koch) or serial://{0} (myCobot)",
    r"(?:https?://)?([\w.-]*\w\w[\w.-]*:\d+)/?": (
        "perhaps tcp://{0} (myCobot), feetech://{0} (SO-101) or dynamixel://{0} (Koch)"
    ),
    r"(?:https?://)?(\d+\.\d+\.\d+\.\d+)/?": "perhaps tcp://{0}:9000",
    r"COM\d+": "serial ports of Windows are not supported: serve the arm from Linux",
    r"[A-Za-z]:[\\/].*": "a folder of logs is given as --logs FOLDER",
    rf"(worn|healthy|{'|'.join(CATALOGUE)})": "perhaps emulated:{0}",
    r"(?![\w.+-]{2,}:).*": "no arm has that name; `rejoint ports` lists the ports, `rejoint arms` the names",
}
"""What is often written for an address, and what was perhaps meant"""

_KNOWN = {family.scheme: family for family in FAMILIES}  # and those of other packages: to look for one takes 50 ms


def place_of(text: str) -> Place[Any]:
    """Read a robot's address; AddressError with the forms."""
    scheme, colon, _ = (text := str(text)).partition(":")
    if colon and scheme not in _KNOWN and (points := tuple(entry_points(group=GROUP, name=scheme))):
        _KNOWN[scheme] = _load(points[0])
    family = _KNOWN.get(scheme) if colon else None
    if family is None:
        meant = ((words, re.fullmatch(form, text)) for form, words in _MEANT.items())
        hints = [words.format(*found.groups()) for words, found in meant if found][:1]
        if not hints or re.match(r"[\w+-]+:\d", text):  # that may be a family that is not there
            hints.append(f"expected {forms()}")
        raise AddressError(f"unknown robot address {text!r}; {'; '.join(hints)}")
    try:
        return Place(text=text, family=family, detail=family.parse(text))
    except ValueError as error:
        expected = "" if family.form in str(error) else f"; expected {family.form}"
        raise AddressError(f"robot address {text!r}: {error}{expected}") from error


def is_virtual(robot: object) -> bool:
    """Whether it is an address at which time passes in the steps of the robot alone, and many can be opened at once."""
    try:
        return isinstance(robot, str) and place_of(robot).virtual
    except AddressError:
        return False


def usable(text: str) -> bool:
    """Whether a robot at this address can be opened with what is installed."""
    try:
        require(text, *place_of(text).family.needs)
    except (AddressError, MissingExtraError):
        return False
    return True


def forms() -> str:
    """Forms of all families, and unusable packages with the reason."""
    found, refused = {family.scheme: family.form for family in FAMILIES}, []
    for point in entry_points(group=GROUP):
        if point.name not in found:
            try:
                found[point.name] = _load(point).form
            except AddressError as error:
                refused.append(f"; {error}")
    return ", ".join(found.values()) + "".join(refused)


def driver_of(error: BaseException) -> str | None:
    """Package of another's driver in an error's traceback, or None."""
    points = [point for point in entry_points(group=GROUP) if point.dist is None or point.dist.name != "rejoint"]
    drivers = {point.module.partition(".")[0]: point for point in points}
    for frame, _ in walk_tb(error.__traceback__):
        point = drivers.get(str(frame.f_globals.get("__name__")).partition(".")[0])
        if point is not None:
            return f"{_package(point)} (driver of {point.name}:)"
    return None


def _load(point: EntryPoint) -> Family[Any]:
    who = f"{_package(point)} (entry point {point.name} = {point.value})"
    try:
        family = point.load()
    except Exception as error:  # whatever another package does wrong is named as its own
        raise AddressError(
            f"{who} cannot be imported ({type(error).__name__}: {first_line(error)}); update or remove it"
        ) from error
    if not isinstance(family, Family) or family.scheme != point.name:
        found = f"the family of {family.scheme}:" if isinstance(family, Family) else f"a {type(family).__name__}"
        raise AddressError(f"{who} is refused: expected a Family of the scheme {point.name}, found {found}")
    return family


def _package(point: EntryPoint) -> str:
    return f"the package {point.dist.name} {point.dist.version}" if point.dist else "a package"
