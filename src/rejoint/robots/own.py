"""The families that come with this package; what opens their robots is imported when one is opened."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from rejoint.arms import CATALOGUE, Arm
from rejoint.arms.loaded import bare
from rejoint.control.robot import Robot
from rejoint.robots.address import SerialAddress, TcpAddress, serial_address, tcp_address
from rejoint.robots.bus import Bus
from rejoint.robots.busrobot import bus_family
from rejoint.robots.family import DEFAULT_ARM, Family, Opening, Place
from rejoint.robots.feetech.address import FORM, FeetechAddress, feetech_address
from rejoint.robots.feetech.gains import KNOBS, Gains, read_gains
from rejoint.system.errors import InputError

SIMULATOR = "mujoco"
"""Module that emulated arms need."""
_PORT = 9000
"""TCP port of the vendor's server on a myCobot"""
_BAUD = 1_000_000
"""[1/s] of the serial port on a myCobot's Raspberry Pi (vendor's manual); the M5 version needs 115200"""
_MYCOBOT_PERIOD = (0.050, 0.050)
"""[s] shortest cycle of control and feedback that the vendor of the myCobot names (its FAQ)"""
_FEETECH_ARM = "so101"
_FEETECH_PERIOD = (0.020, 0.020)
"""[s] 50 Hz (chosen: a cycle needs 3 ms of the bus, and controllers the rest on a slow computer)"""
_EMULATED_PERIOD = (0.020, 0.030)
"""[s] Park et al. 2024 name 20 ms; the wire adds up to half of it (chosen)"""


@dataclass(frozen=True, kw_only=True)
class EmulatedAddress:
    """An arm that is emulated in this process."""

    profile: str
    """of its wear"""
    payload: float = 0.0
    """[kg] that its hand really carries, whatever anybody was told"""
    gains: Gains = field(default_factory=dict)
    """of its servos, where they are not as sold"""

    @property
    def text(self) -> str:
        """The address of the same arm with an empty hand, whatever its gains."""
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
    """Read the mass [kg] in the hand from the options of an address; ValueError for what is none."""
    text = given.get("payload", "0")
    try:
        payload = float(text)
    except ValueError:
        payload = -1.0
    if not 0.0 <= payload < 100.0:
        raise ValueError(f"a payload is a mass in kg, such as payload=0.1, got {f'payload={text}'!r}")
    return payload


def _profile_arm(address: EmulatedAddress) -> str:
    """Name of the arm that a wear profile describes, as ``so101``; most scale with any arm."""
    from rejoint.robots.lab.plant.wear import wear_arm

    return wear_arm(address.profile) or DEFAULT_ARM


def _emulated(place: Place[EmulatedAddress], opening: Opening) -> Robot:
    from rejoint.robots.emulated import EmulatedRobot
    from rejoint.robots.lab.plant.wear import load_wear

    # What was told of the hand is a description: of it only where the tip is becomes true by being told.
    true = bare(opening.arm)
    bodies = None if true is opening.arm else [replace(true, tip=opening.arm.tip)] * opening.count
    return EmulatedRobot(
        opening.arm, [load_wear(place.detail.profile, true)] * opening.count, address=place.text, seed=opening.seed,
        period=opening.period, threads=opening.threads, payload=place.detail.payload, bodies=bodies,
        gains=place.detail.gains,
    )  # fmt: skip


def _has_gains(arm: Arm) -> bool:
    """Whether the gains of the servos of an emulated arm can be set."""
    from rejoint.robots.lab.plant.sts3215 import has_these_servos

    return has_these_servos(arm)


def unloaded(address: str) -> str:
    """Return the address of an emulated arm without what it carries: it is the same arm; others as they are."""
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
    """Raise InputError for an arm of the catalogue of which none is behind such addresses, whatever joints it has.

    The guard would judge every command by another arm's links. What a file describes may be a build of one's own.
    """
    if arm.name in CATALOGUE and arm.name != kind:
        raise InputError(
            f"at {schemes} addresses there are arms of the kind {kind}, and this is about a {arm.name}; check the "
            "address, and whose run it is"
        )


EMULATED = Family(
    scheme="emulated", form="emulated:PROFILE", parse=_profile,
    connect=_emulated, default_arm=_profile_arm, default_period=_EMULATED_PERIOD, virtual=True, tunable=_has_gains,
    needs=(SIMULATOR,),
)  # fmt: skip
MYCOBOT_TCP = bus_family(
    _mycobot, scheme="tcp", form="tcp://HOST:PORT", parse=lambda text: tcp_address(text, port=_PORT),
    default_period=_MYCOBOT_PERIOD,
)  # fmt: skip
MYCOBOT_SERIAL = bus_family(
    _mycobot, scheme="serial", form="serial:///dev/DEVICE", parse=lambda text: serial_address(text, baud=_BAUD),
    default_period=_MYCOBOT_PERIOD,
)  # fmt: skip
FEETECH = bus_family(
    _feetech, scheme="feetech", form=FORM, parse=feetech_address,
    default_arm=_FEETECH_ARM, default_period=_FEETECH_PERIOD, tunable=True,
    needs=("feetech",),
)  # fmt: skip

FAMILIES: tuple[Family[Any], ...] = (EMULATED, MYCOBOT_TCP, MYCOBOT_SERIAL, FEETECH)
"""To add one that comes with the package: a module with a `Family`, and its name here"""
