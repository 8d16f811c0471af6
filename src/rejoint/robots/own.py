"""The families that come with this package; what opens their robots is imported when one is opened."""

from __future__ import annotations

from typing import Any

from rejoint.arms import Arm
from rejoint.control.robot import Robot
from rejoint.robots.address import SerialAddress, TcpAddress, serial_address, tcp_address
from rejoint.robots.bus import Bus
from rejoint.robots.busrobot import bus_family
from rejoint.robots.family import DEFAULT_ARM, Family, Opening, Place
from rejoint.robots.feetech.address import FORM, FeetechAddress, feetech_address

SIMULATOR = "mujoco"
"""Module that emulated arms need."""
_PORT = 9000
"""TCP port of the vendor's server on a myCobot"""
_BAUD = 1_000_000
"""[1/s] of the serial port on a myCobot's Raspberry Pi (vendor's manual); the M5 version needs 115200"""
_MYCOBOT_PERIOD = (0.050, 0.050)
"""[s] shortest cycle of control and feedback that the vendor of the myCobot names (its FAQ)"""
_FEETECH_PERIOD = (0.020, 0.020)
"""[s] 50 Hz (chosen: a cycle needs 3 ms of the bus, and controllers the rest on a slow computer)"""
_EMULATED_PERIOD = (0.020, 0.030)
"""[s] Park et al. 2024 name 20 ms; the wire adds up to half of it (chosen)"""


def _profile(text: str) -> str:
    profile = text.partition(":")[2]
    if not profile or profile.startswith("//"):
        raise ValueError("not of the form emulated:PROFILE")
    return profile


def _profile_arm(profile: str) -> str:
    """Name of the arm that a wear profile describes, as ``so101``; most scale with any arm."""
    from rejoint.lab.plant.wear import wear_arm

    return wear_arm(profile) or DEFAULT_ARM


def _emulated(place: Place[str], opening: Opening) -> Robot:
    from rejoint.lab.plant.wear import load_wear
    from rejoint.robots.emulated import EmulatedRobot

    wears = [load_wear(place.detail, opening.arm)] * opening.count
    return EmulatedRobot(
        opening.arm, wears, address=place.text, seed=opening.seed, period=opening.period, threads=opening.threads
    )


def _mycobot(address: TcpAddress | SerialAddress, arm: Arm) -> Bus:
    from rejoint.robots.mycobot import MyCobotBus

    return MyCobotBus(address, arm)


def _feetech(address: FeetechAddress, arm: Arm) -> Bus:
    from rejoint.robots.feetech.bus import FeetechBus

    return FeetechBus(address, arm)


EMULATED = Family(
    scheme="emulated", form="emulated:PROFILE", parse=_profile,
    connect=_emulated, default_arm=_profile_arm, default_period=_EMULATED_PERIOD, virtual=True, needs=(SIMULATOR,),
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
    default_arm="so101", default_period=_FEETECH_PERIOD, tunable=True,
    needs=("feetech",),
)  # fmt: skip

FAMILIES: tuple[Family[Any], ...] = (EMULATED, MYCOBOT_TCP, MYCOBOT_SERIAL, FEETECH)
"""To add one that comes with the package: a module with a `Family`, and its name here"""
