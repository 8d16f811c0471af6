"""The families of this package, imported when opened."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib.metadata import EntryPoint, entry_points
from traceback import walk_tb
from typing import Any

from rejoint.arms import CATALOGUE, Arm
from rejoint.arms.inertia import bare
from rejoint.control.robot import Robot
from rejoint.robots.bus import Bus
from rejoint.robots.busrobot import bus_family
from rejoint.robots.family import (
    DEFAULT_ARM,
    Family,
    Opening,
    Place,
    SerialAddress,
    TcpAddress,
    serial_address,
    tcp_address,
)
from rejoint.robots.feetech.gains import FORM, KNOBS, FeetechAddress, Gains, feetech_address, read_gains
from rejoint.system.errors import AddressError, InputError, first_line

SIMULATOR = "mujoco"
"""Module of emulated arms"""
# TCP port of the vendor's server on a myCobot
_PORT = 9000
# [1/s] of the serial port on a myCobot's Raspberry Pi (vendor's manual); the M5 version needs 115200
_BAUD = 1_000_000
# [s] shortest cycle of control and feedback that the vendor of the myCobot names (its FAQ)
_MYCOBOT_PERIOD = (0.050, 0.050)
_FEETECH_ARM = "so101"
# [s] 50 Hz (chosen)
_FEETECH_PERIOD = (0.020, 0.020)
# [s] Park et al. 2024 name 20 ms; the wire adds up to half of it (chosen)
_EMULATED_PERIOD = (0.020, 0.030)


@dataclass(frozen=True, kw_only=True)
class EmulatedAddress:
    """An arm emulated in this process."""

    profile: str
    """of wear"""
    payload: float = 0.0
    """[kg] true, unknown to the software"""
    gains: Gains = field(default_factory=dict)
    """of servos; empty: as sold"""

    @property
    def text(self) -> str:
        """Address without payload and gains."""
        return f"emulated:{self.profile}"


def _profile(text: str) -> EmulatedAddress:
    detail = text.partition(":")[2]
    if not detail or detail.startswith("//"):
        raise ValueError("not of the form emulated:PROFILE")
    base, _, query = detail.partition("?")
    parts = query.split("&") if query else []
    keys = [part.partition("=")[0] for part in parts]
    rest = "&".join(part for part, key in zip(parts, keys, strict=True) if key not in ("payload", *KNOBS))
    given = {key: part.partition("=")[2] for part, key in zip(parts, keys, strict=True)}
    gains = read_gains({key: text for key, text in given.items() if key in KNOBS})
    return EmulatedAddress(profile=f"{base}?{rest}" if rest else base, payload=_payload(given), gains=gains)


def _payload(given: Mapping[str, str]) -> float:
    """Payload [kg] of address options; ValueError."""
    text = given.get("payload", "0")
    try:
        payload = float(text)
    except ValueError:
        payload = -1.0
    if not 0.0 <= payload < 100.0:
        raise ValueError(f"a payload is a mass in kg, such as payload=0.1, got {f'payload={text}'!r}")
    return payload


def _profile_arm(address: EmulatedAddress) -> str:
    from rejoint.robots.lab.plant.wear import wear_arm

    return wear_arm(address.profile) or DEFAULT_ARM


def _emulated(place: Place[EmulatedAddress], opening: Opening) -> Robot:
    from rejoint.robots.emulated import EmulatedRobot
    from rejoint.robots.lab.plant.wear import load_wear

    # What was told of the hand is a description: of it only where the tip is becomes true by being told.
    true = bare(opening.arm)
    bodies = None if true is opening.arm else [replace(true, tip=opening.arm.tip)] * opening.count
    return EmulatedRobot(
        opening.arm,
        [load_wear(place.detail.profile, true)] * opening.count,
        address=place.text,
        seed=opening.seed,
        period=opening.period,
        threads=opening.threads,
        payload=place.detail.payload,
        bodies=bodies,
        gains=place.detail.gains,
    )


def _has_gains(arm: Arm) -> bool:
    from rejoint.robots.lab.plant.servo import has_these_servos

    return has_these_servos(arm)


def unloaded(address: str) -> str:
    """Address of an emulated arm without its payload; others unchanged."""
    return _profile(address).text if address.startswith("emulated:") else address


def _mycobot(address: TcpAddress | SerialAddress, arm: Arm) -> Bus:
    from rejoint.robots.mycobot import MyCobotBus

    _require_kind(arm, DEFAULT_ARM, "tcp: and serial:")
    return MyCobotBus(address, arm)


def _feetech(address: FeetechAddress, arm: Arm) -> Bus:
    from rejoint.robots.feetech.bus import FeetechBus

    _require_kind(arm, _FEETECH_ARM, "feetech:")
    return FeetechBus(address, arm)


def _require_kind(arm: Arm, kind: str, schemes: str) -> None:
    """Raise InputError for an arm that such addresses never have: the guard would use its links."""
    if arm.name in CATALOGUE and arm.name != kind:
        raise InputError(
            f"at {schemes} addresses there are arms of the kind {kind}, and this is about a {arm.name}; check the "
            "address, and whose run it is"
        )


EMULATED = Family(
    scheme="emulated",
    form="emulated:PROFILE",
    parse=_profile,
    connect=_emulated,
    default_arm=_profile_arm,
    default_period=_EMULATED_PERIOD,
    virtual=True,
    tunable=_has_gains,
    needs=(SIMULATOR,),
)
MYCOBOT_TCP = bus_family(
    _mycobot,
    scheme="tcp",
    form="tcp://HOST:PORT",
    parse=lambda text: tcp_address(text, port=_PORT),
    default_period=_MYCOBOT_PERIOD,
)
MYCOBOT_SERIAL = bus_family(
    _mycobot,
    scheme="serial",
    form="serial:///dev/DEVICE",
    parse=lambda text: serial_address(text, baud=_BAUD),
    default_period=_MYCOBOT_PERIOD,
)
FEETECH = bus_family(
    _feetech,
    scheme="feetech",
    form=FORM,
    parse=feetech_address,
    default_arm=_FEETECH_ARM,
    default_period=_FEETECH_PERIOD,
    tunable=True,
    needs=("feetech",),
)

FAMILIES: tuple[Family[Any], ...] = (EMULATED, MYCOBOT_TCP, MYCOBOT_SERIAL, FEETECH)
"""Families of this package"""


GROUP = "rejoint.robots"
"""Entry points of `Family` objects"""

_OWN: dict[str, Family[Any]] = {family.scheme: family for family in FAMILIES}


def place_of(text: str) -> Place[Any]:
    """Read a robot's address; AddressError with the forms."""
    scheme, colon, _ = text.partition(":")
    family = _family(scheme) if colon else None
    if family is None:
        raise AddressError(f"unknown robot address {text!r}; expected {forms()}")
    try:
        return Place(text=text, family=family, detail=family.parse(text))
    except ValueError as error:
        expected = "" if family.form in str(error) else f"; expected {family.form}"
        raise AddressError(f"robot address {text!r}: {error}{expected}") from error


def forms() -> str:
    """Forms of all families, and unusable packages with the reason."""
    found, refused = list(_OWN.values()), []
    for point in entry_points(group=GROUP):
        if point.name in _OWN:
            continue
        try:
            found.append(_load(point))
        except AddressError as error:
            refused.append(f"; {error}")
    return ", ".join(family.form for family in found) + "".join(refused)


def driver_of(error: BaseException) -> str | None:
    """Package of another's driver in an error's traceback, or None."""
    drivers = {point.module.partition(".")[0]: point for point in entry_points(group=GROUP)}
    for frame, _ in walk_tb(error.__traceback__):
        point = drivers.get(str(frame.f_globals.get("__name__")).partition(".")[0])
        if point is not None:
            return f"{_package(point)} (driver of {point.name}:)"
    return None


def _family(scheme: str) -> Family[Any] | None:
    if scheme in _OWN:
        return _OWN[scheme]
    points = tuple(entry_points(group=GROUP, name=scheme))
    return _load(points[0]) if points else None


def _load(point: EntryPoint) -> Family[Any]:
    who = f"{_package(point)} (entry point {point.name} = {point.value})"
    try:
        family = point.load()
    except Exception as error:  # whatever another package does wrong is named as its own
        why = f"{type(error).__name__}: {first_line(error)}"
        raise AddressError(f"{who} cannot be imported ({why}); update or remove it") from error
    if not isinstance(family, Family) or family.scheme != point.name:
        found = f"the family of {family.scheme}:" if isinstance(family, Family) else f"a {type(family).__name__}"
        raise AddressError(f"{who} is refused: expected a Family of the scheme {point.name}, found {found}")
    return family


def _package(point: EntryPoint) -> str:
    return f"the package {point.dist.name} {point.dist.version}" if point.dist else "a package"
