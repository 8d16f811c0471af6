"""The robot family `emulated:`, which the product finds by its entry point as it finds those of other packages."""

from dataclasses import field, replace

from rejoint.arms import CATALOGUE, load_arm
from rejoint.arms.inertia import bare
from rejoint.control.robot import Robot
from rejoint.robots import DEFAULT_ARM, Family, Opening, Place
from rejoint.robots.dynamixel import KIND as X_SERIES
from rejoint.robots.feetech import KIND as STS
from rejoint.robots.knobs import Gains
from rejoint.system.records import value_type
from rejoint_lab.plant.servo import Channel
from rejoint_lab.plant.wear import load_wear, wear_arm, wear_names
from rejoint_lab.plant.xseries import drives

SIMULATOR = "mujoco"
"""Module of emulated arms"""
# [s] Park et al. 2024 name 20 ms; the wire adds up to half of it (chosen)
_PERIOD = (0.020, 0.030)


@value_type
class EmulatedAddress:
    """An arm emulated in this process."""

    profile: str
    """of wear"""
    arm: str | None = None
    """of the catalogue; None: the profile's"""
    payload: float = 0.0
    """[kg] true, unknown to the software"""
    gains: Gains = field(default_factory=dict)
    """of servos; empty: as sold"""

    @property
    def unloaded(self) -> str:
        """Address without payload and gains."""
        own = "" if self.arm is None else f"{self.arm}?"
        return f"emulated:{own}{self.profile.replace('?', '&') if own else self.profile}"


def _profile(text: str) -> EmulatedAddress:
    base, _, query = text.partition(":")[2].partition("?")
    if not base or base.startswith("//"):
        raise ValueError("not of the form emulated:PROFILE")
    parts = [part.partition("=") for part in query.split("&")] if query else []
    words, arm = [key for key, equals, _ in parts if not equals], None
    if words or (base in CATALOGUE and base not in wear_names()):
        arm, base = base, words[0] if words else "new"
        if arm not in CATALOGUE or len(words) > 1:
            raise ValueError(f"not of the form emulated:ARM?PROFILE with one of the arms {', '.join(CATALOGUE)}")
    kind = X_SERIES if arm and drives(load_arm(arm).servos) else STS
    given = {key: value for key, _, value in parts if key in ("payload", *kind.knobs)}
    rest = "&".join(key + equals + value for key, equals, value in parts if equals and key not in given)
    try:
        payload = float(given.pop("payload", "0"))
    except ValueError:
        payload = -1.0
    if not 0.0 <= payload < 100.0:
        raise ValueError(f"a payload is a mass in kg, such as payload=0.1, got {query!r}")
    profile = f"{base}?{rest}" if rest else base
    return EmulatedAddress(profile=profile, arm=arm, payload=payload, gains=kind.read_gains(given))


def _emulated(place: Place[EmulatedAddress], opening: Opening) -> Robot:
    from rejoint_lab.emulated import EmulatedRobot

    # What was told of the hand is a description: of it only where the tip is becomes true by being told.
    true = bare(opening.arm)
    bodies = None if true is opening.arm else [replace(true, tip=opening.arm.tip)] * opening.count
    return EmulatedRobot(
        opening.arm,
        [load_wear(place.detail.profile, true)] * opening.count,
        address=place.text,
        seed=opening.seed,
        channel=Channel(period=opening.period),
        payload=place.detail.payload,
        bodies=bodies,
        gains=place.detail.gains,
    )


EMULATED = Family(
    scheme="emulated",
    form="emulated:PROFILE or emulated:ARM?PROFILE",
    parse=_profile,
    connect=_emulated,
    default_arm=lambda address: address.arm or wear_arm(address.profile) or DEFAULT_ARM,
    default_period=_PERIOD,
    virtual=True,
    tunable=lambda arm: set(arm.servos) == {"STS3215"} or drives(arm.servos),
    needs=(SIMULATOR,),
)
