"""The robot family `emulated:`, which the product finds by its entry point as it finds those of other packages."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from rejoint.arms import Arm
from rejoint.arms.inertia import bare
from rejoint.control.robot import Robot
from rejoint.robots import DEFAULT_ARM, Family, Opening, Place
from rejoint.robots.feetech.gains import KNOBS, Gains, read_gains

SIMULATOR = "mujoco"
"""Module of emulated arms"""
# [s] Park et al. 2024 name 20 ms; the wire adds up to half of it (chosen)
_PERIOD = (0.020, 0.030)


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
    def unloaded(self) -> str:
        """Address without payload and gains."""
        return f"emulated:{self.profile}"


def _profile(text: str) -> EmulatedAddress:
    base, _, query = text.partition(":")[2].partition("?")
    if not base or base.startswith("//"):
        raise ValueError("not of the form emulated:PROFILE")
    parts = [part.partition("=")[::2] for part in query.split("&")] if query else []
    given = {key: value for key, value in parts if key in ("payload", *KNOBS)}
    rest = "&".join(f"{key}={value}" for key, value in parts if key not in given)
    try:
        payload = float(given.pop("payload", "0"))
    except ValueError:
        payload = -1.0
    if not 0.0 <= payload < 100.0:
        raise ValueError(f"a payload is a mass in kg, such as payload=0.1, got {query!r}")
    return EmulatedAddress(profile=f"{base}?{rest}" if rest else base, payload=payload, gains=read_gains(given))


def _profile_arm(address: EmulatedAddress) -> str:
    from rejoint_lab.plant.wear import wear_arm

    return wear_arm(address.profile) or DEFAULT_ARM


def _emulated(place: Place[EmulatedAddress], opening: Opening) -> Robot:
    from rejoint_lab.emulated import EmulatedRobot
    from rejoint_lab.plant.wear import load_wear

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


def has_gains(arm: Arm) -> bool:
    """Whether all servos of an ``arm`` have gains that can be set."""
    return set(arm.servos) == {"STS3215"}


EMULATED = Family(
    scheme="emulated",
    form="emulated:PROFILE",
    parse=_profile,
    connect=_emulated,
    default_arm=_profile_arm,
    default_period=_PERIOD,
    virtual=True,
    tunable=has_gains,
    needs=(SIMULATOR,),
)
