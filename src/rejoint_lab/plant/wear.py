"""Wear profiles of an arm of any size after any hours of use.

A joint takes the numbers of the myCobot 280's joint at the same share of the chain. Torques scale with the ratio T of
the efforts, hypot(G, I g/L, 0.3 max G): gravity torque G, inertia I, reach L; damping with T t, inertia with T t^2, t =
sqrt(L / L0).

Wear is load times travel (Archard, J. Appl. Phys. 24, 1953), damage a gamma process (van Noortwijk, Reliab. Eng. Syst.
Saf. 94, 2009).
"""

from __future__ import annotations

from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from urllib.parse import parse_qsl

import msgspec
import numpy as np

from rejoint.arms import Arm, Array, Index, gravity_torque, link_inertia, mycobot280
from rejoint.arms.arm import frozen
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.workspace import heaviest_load, length_size, posture_grid, reach
from rejoint.system.errors import ProfileError, first_line
from rejoint.system.files import Number, Positive, Table, read_toml
from rejoint.system.records import entity
from rejoint_lab.plant import xseries
from rejoint_lab.plant.servo import AMBIENT, STEP

FLOOR = 0.3
"""Least effort over the largest load (chosen)"""

# Targets along each edge of the region over which the gravity torques are taken (chosen).
_GRID = 5


class Ratios(NamedTuple):
    """Ratios of an arm to the myCobot 280."""

    row: Index
    """(n,) joint of the myCobot 280 per joint"""
    torque: Array
    """(n,)"""
    time: float


@lru_cache(maxsize=16)
def scale_of(arm: Arm) -> Ratios:
    """Compare an arm with the myCobot 280."""
    reference = mycobot280()
    row = np.rint(np.linspace(0.0, reference.joints - 1, arm.joints)).astype(np.intp)
    return Ratios(
        row=row,
        torque=effort(arm) / effort(reference)[row],
        time=float(np.sqrt(length_size(arm))),
    )


@lru_cache(maxsize=16)
def effort(arm: Arm) -> Array:
    """Torque (n,) [N m] for the size of each joint."""
    load = heaviest_load(arm, _GRID)
    rate = np.linalg.norm(GRAVITY) / reach(arm)
    least = max(FLOOR * float(load.max()), np.finfo(float).tiny)
    return np.sqrt(load**2 + (link_inertia(arm, arm.rest) * rate) ** 2 + least**2)


LIFE = 2500.0
"""[h] to a damage of one at mean load and travel (chosen)"""

_BLOCK = 5.0  # [h] in which damage comes by a draw of its own (chosen: less than a month of use)
_SHAPE = 0.5  # of the gamma distribution of a block: damage of 2500 h then scatters by 6 % (chosen)
_PACE = 0.3  # standard deviation of the logarithm of a joint's own pace (chosen: as `draw_wear` spreads profiles)
_WEAKENING = 0.3  # logarithm by which a damage of one lowers the torque of a motor (chosen: brushes and magnets)
# [rad/K] by which the zero of an STS3215 moves, at most (shared facts on monitoring)
_OFFSET_PER_DEGREE = np.radians(0.02)
# [1/K] by which friction falls with warmth (Bittencourt and Axehill, J. Dyn. Syst. Meas. Control 134, 2012)
_GREASE_PER_DEGREE = 0.01

_DRIVE, _FRICTION, _GEAR = range(3)
# Parameters that grow by what lies between young and old, per damage, and of which mechanism
_ADDED = {
    "coulomb": _FRICTION,
    "stiction": _FRICTION,
    "load_friction": _FRICTION,
    "ripple": _FRICTION,
    "torque_noise": _FRICTION,
    "play": _GEAR,
}
# Parameters whose inverse grows so
_SOFTENED = {"position_gain": _DRIVE, "link_stiffness": _GEAR}


def aged(wear: Wear, arm: Arm, hours: float, *, seed: int) -> Wear:
    """``wear`` after ``hours``; every motor still lifts the arm."""
    young, old = _fitted("healthy", arm), _fitted("worn", arm)
    damage = damages(young, arm, hours, seed)
    changed = {
        name: getattr(wear, name) + damage[kind] * np.maximum(getattr(old, name) - getattr(young, name), 0.0)
        for name, kind in _ADDED.items()
    }
    for name, kind in _SOFTENED.items():
        softer = np.maximum(1.0 / getattr(old, name) - 1.0 / getattr(young, name), 0.0)
        changed[name] = 1.0 / (1.0 / getattr(wear, name) + damage[kind] * softer)
    changed["damping_gain"] = wear.damping_gain * changed["position_gain"] / wear.position_gain
    weaker = wear.torque_limit * np.exp(-_WEAKENING * damage[_DRIVE])
    least = _LIFT_MARGIN * lifting_torque(wear, arm)
    changed["torque_limit"] = np.maximum(weaker, np.minimum(wear.torque_limit, least))
    return replace(wear, name=f"{wear.name}, {hours:g} h", **changed)


def warmed(wear: Wear, ambient: float, *, seed: int) -> Wear:
    """``wear`` in a room of ``ambient`` [deg C]."""
    above = ambient - AMBIENT
    own = np.random.default_rng([seed, 2]).uniform(-1.0, 1.0, len(wear.position_gain))
    thinner = float(np.exp(-_GREASE_PER_DEGREE * above))
    return replace(
        wear,
        coulomb=wear.coulomb * thinner,
        stiction=wear.stiction * thinner,
        ambient=ambient,
        offset=wear.offset + own * _OFFSET_PER_DEGREE * above,
    )


def damages(young: Wear, arm: Arm, hours: float, seed: int) -> Array:
    """Damage (3, n) of drive, friction and gear after ``hours``."""
    blocks = int(hours // _BLOCK) + 1
    pace = np.exp(np.random.default_rng([seed, 1]).normal(-0.5 * _PACE**2, _PACE, (3, arm.joints)))
    # One generator for each mechanism and joint, so that more blocks change none of the earlier ones.
    draws = np.array(
        [
            [np.random.default_rng([seed, 1, kind, j]).gamma(_SHAPE, 1.0 / _SHAPE, blocks) for j in range(arm.joints)]
            for kind in range(3)
        ]
    )
    passed = draws[..., :-1].sum(axis=-1) + draws[..., -1] * (hours / _BLOCK - (blocks - 1))
    return pace * severity(young, arm) * passed * _BLOCK / LIFE


def severity(young: Wear, arm: Arm) -> Array:
    """Load times travel (n,) over its mean, at random targets."""
    posture = posture_grid(arm, 4).q
    travel = np.abs(posture[:, None] - posture[None]).mean(axis=(0, 1))
    load = (np.abs(gravity_torque(arm, posture)).mean(axis=0) + young.coulomb) / young.torque_limit
    return travel * load / (travel * load).mean()


NEW = "new"
"""Profile of new servos of known types"""
PLAY = np.radians(0.25)
"""[rad] of a new gear (ROBOTIS' data sheets)"""
_WEAKEST, _ROUGHER = 0.5, 1.5  # of a worn servo, by a new one's torque and friction (chosen)
_PROFILES = Path(__file__).parent / "profiles"
_SPREAD = 0.3
# What a drawn arm has of the torque that lifts it (chosen).
_LIFT_MARGIN = 1.03
# What a joint of a scaled profile has of the torque that moves it against gravity (chosen).
_MOVE_MARGIN = 1.1
# The only arm whose profiles may scale.
_SCALING_ARM = "mycobot280"


@entity
class Wear:
    """State of n servos; arrays are (n,)."""

    name: str
    position_gain: Array
    """[N m/rad] proportional gain of the firmware"""
    damping_gain: Array
    """[N m s/rad] derivative gain of the firmware"""
    torque_limit: Array
    """[N m] at standstill"""
    coulomb: Array
    """[N m] moving"""
    stiction: Array
    """[N m] stationary"""
    load_friction: Array
    """friction over transmitted torque"""
    play: Array
    """[rad] full width of the gear"""
    link_stiffness: Array
    """[N m/rad] behind the encoder"""
    reflected_inertia: Array
    """[kg m^2] motor and gear at the output"""
    ripple: Array
    """[N m] amplitude"""
    torque_noise: Array
    """[N m] standard deviation per millisecond"""
    play_in_loop: bool = False
    """the encoder is behind the gear and sees the play"""
    offset: Array | float = 0.0
    """[rad] unloaded joint minus command"""
    ambient: float = AMBIENT
    """[deg C]"""

    def __post_init__(self) -> None:
        for name in (*PARAMETERS, "offset"):
            object.__setattr__(self, name, frozen(np.broadcast_to(getattr(self, name), np.shape(self.position_gain))))
        if (self.stiction < self.coulomb).any():
            raise ProfileError(f"wear {self.name}: stiction must not be below coulomb friction")
        stiffest = self.position_gain * STEP**2 + self.damping_gain * STEP
        if (stiffest > 0.5 * self.reflected_inertia).any():
            raise ProfileError(
                f"wear {self.name}: position_gain or damping_gain is too high for reflected_inertia; "
                f"a servo loop of {STEP} s cannot be stable with it"
            )


PARAMETERS = tuple(
    field.name for field in fields(Wear) if field.name not in ("name", "play_in_loop", "offset", "ambient")
)
"""Per-joint parameters of every profile"""
_TORQUES = ("position_gain", "torque_limit", "coulomb", "stiction", "link_stiffness", "ripple", "torque_noise")


def wear_names() -> tuple[str, ...]:
    """Names of the package's profiles."""
    return tuple(sorted(path.stem for path in _PROFILES.glob("*.toml")))


def load_wear(name: str, arm: Arm) -> Wear:
    """Load a profile for ``arm``: a name or a TOML file; ProfileError, FileError.

    Options as ``worn?seed=3``: ``seed=N`` draws parameters within +-30 %, ``hours=H`` ages, ``ambient=C`` [deg C].
    """
    base, options = _options(name)
    wear = _fitted(base, arm)
    seed = options.seed or 0
    if options.seed is not None:
        wear = draw_wear(wear, arm, seed)
    if options.hours is not None:
        wear = aged(wear, arm, options.hours, seed=seed)
    return wear if options.ambient is None else warmed(wear, options.ambient, seed=seed)


def wear_arm(name: str) -> str | None:
    """Name of the one arm of a profile; None: for others too."""
    base = _options(name)[0]
    if base == NEW:
        return None
    found = _profile(base)
    return None if found.scales else found.arm


def new_wear(arm: Arm) -> Wear:
    """Wear of new X servos in links as stiff as a healthy arm's; else a healthy arm's."""
    healthy = scale_wear("healthy", arm)
    if not xseries.drives(arm.servos):
        return healthy
    rows = [(xseries.NEW[model], count) for model, count, _ in map(xseries.drive_of, arm.servos)]
    named = {"torque_limit": "stall", "coulomb": "coulomb", "reflected_inertia": "inertia"}
    values: dict[str, Any] = {name: np.array([row[own] * count for row, count in rows]) for name, own in named.items()}
    stall = values["torque_limit"]
    gain = np.array([row["Position_P_Gain"] / row["divisor"] for row, _ in rows]) * xseries.COUNTS / xseries.FULL
    return Wear(
        name=NEW,
        **values,
        position_gain=stall * gain / (2 * np.pi),
        damping_gain=np.zeros(arm.joints),
        stiction=1.2 * values["coulomb"],
        load_friction=np.array([row["load_friction"] for row, _ in rows]),
        play=np.full(arm.joints, PLAY),
        link_stiffness=healthy.link_stiffness,
        ripple=0.003 * stall,
        torque_noise=0.002 * stall,
        play_in_loop=True,
    )


def _fitted(base: str, arm: Arm) -> Wear:
    if base == NEW:
        return new_wear(arm)
    found = _profile(base)
    if found.scales:
        scaled = scale_wear(base, arm)
        if not xseries.drives(arm.servos):
            return scaled
        new = new_wear(arm)  # servos keep their inertia, and at least half their torque
        return replace(
            scaled,
            torque_limit=np.maximum(scaled.torque_limit, _WEAKEST * new.torque_limit),
            coulomb=np.maximum(scaled.coulomb, _ROUGHER * new.coulomb),
            stiction=np.maximum(scaled.stiction, _ROUGHER * new.stiction),
            reflected_inertia=new.reflected_inertia,
            position_gain=new.position_gain,
            damping_gain=new.damping_gain,
        )
    if found.arm not in (None, arm.name):
        raise ProfileError(
            f"wear {base} describes the arm {found.arm} alone, not {arm.name}; give --arm {found.arm} or a run of that "
            f"arm, or a profile that scales with the arm: {', '.join(n for n in wear_names() if wear_arm(n) is None)}"
        )
    return found.wear(base, arm.joints)


class _Options(msgspec.Struct, forbid_unknown_fields=True):
    seed: Annotated[int, msgspec.Meta(ge=0)] | None = None
    hours: Annotated[float, msgspec.Meta(ge=0.0, le=100_000.0)] | None = None
    ambient: Annotated[float, msgspec.Meta(ge=-10.0, le=50.0)] | None = None


def _options(name: str) -> tuple[str, _Options]:
    base, query, rest = name.partition("?")
    try:
        given = parse_qsl(rest, strict_parsing=True) if query else []
        return base, msgspec.convert(dict(given), _Options, strict=False)
    except ValueError as error:
        known = "seed=N (draws another arm), hours=N (of use), ambient=N (deg C of the room)"
        raise ProfileError(f"wear {name!r}: {first_line(error)}; options: {known}") from error


def scale_wear(base: str, arm: Arm) -> Wear:
    """Scale a myCobot 280's profile to ``arm``."""
    wear, scale = _profile(base).wear(base, mycobot280().joints), scale_of(arm)
    values = {name: getattr(wear, name)[scale.row] for name in (*PARAMETERS, "offset")}
    for name in _TORQUES:
        values[name] = values[name] * scale.torque
    values["damping_gain"] = values["damping_gain"] * (scale.torque * scale.time)
    values["reflected_inertia"] = values["reflected_inertia"] * (scale.torque * scale.time**2)
    moving = heaviest_load(arm, _GRID) * (1 + values["load_friction"]) + values["coulomb"]
    values["torque_limit"] = np.maximum(values["torque_limit"], _MOVE_MARGIN * moving)
    return Wear(name=wear.name, play_in_loop=wear.play_in_loop, **values)


def draw_wear(wear: Wear, arm: Arm, seed: int) -> Wear:
    """Draw a neighbour within +-30 % that lifts the arm."""
    rng = np.random.default_rng(seed)
    factor = {name: rng.uniform(1 - _SPREAD, 1 + _SPREAD, arm.joints) for name in PARAMETERS}
    drawn = {name: getattr(wear, name) * factor[name] for name in PARAMETERS}
    drawn["stiction"] = drawn["coulomb"] + (wear.stiction - wear.coulomb) * factor["stiction"]
    neighbour = replace(wear, name=f"{wear.name}?seed={seed}", **drawn)
    low = np.maximum((1 - _SPREAD) * wear.torque_limit, _LIFT_MARGIN * lifting_torque(neighbour, arm))
    high = np.maximum((1 + _SPREAD) * wear.torque_limit, 1.01 * low)
    share = (factor["torque_limit"] - (1 - _SPREAD)) / (2 * _SPREAD)
    return replace(neighbour, torque_limit=low + share * (high - low))


def lifting_torque(wear: Wear, arm: Arm) -> Array:
    """Torque (n,) [N m] that lifts the arm from standstill at all targets."""
    return heaviest_load(arm, _GRID) * (1 + wear.load_friction) + wear.stiction


_Size = Annotated[float, msgspec.Meta(ge=0.0, le=1e300)]
_Sizes = _Size | list[_Size]
_Positives = Positive | list[Positive]


class _Joints(Table):
    """One number for all joints, or one per joint."""

    position_gain: _Positives
    damping_gain: _Sizes
    torque_limit: _Positives
    coulomb: _Sizes
    stiction: _Sizes
    load_friction: _Sizes
    play_deg: _Sizes
    link_stiffness: _Positives
    reflected_inertia: _Positives
    ripple: _Sizes
    torque_noise: _Sizes
    offset_deg: Number | list[Number] = 0.0


class _WearFile(Table):
    joints: _Joints
    arm: str | None = None
    """the only arm"""
    scales: bool = False
    play_in_loop: bool = False

    def __post_init__(self) -> None:
        if self.scales and self.arm != _SCALING_ARM:
            raise ValueError(f"only profiles with arm = '{_SCALING_ARM}' can scale, got arm {self.arm!r}")

    def wear(self, name: str, joints: int) -> Wear:
        """Return the wear of ``joints`` joints; ProfileError."""
        values: dict[str, Any] = {}
        for field, value in msgspec.structs.asdict(self.joints).items():
            if np.size(value) not in (1, joints):
                raise ProfileError(f"wear {name}: {field} must be a number or a list of {joints} numbers, got {value}")
            numbers = np.broadcast_to(np.array(value), joints)
            values[field.removesuffix("_deg")] = np.radians(numbers) if field.endswith("_deg") else numbers
        return Wear(name=name, play_in_loop=self.play_in_loop, **values)


def _profile(base: str) -> _WearFile:
    known = f"known profiles: {', '.join(wear_names())} and {NEW}, each also with ?seed=N or ?hours=H, or a .toml file"
    if base not in wear_names() and not base.endswith(".toml"):
        raise ProfileError(f"no wear profile is called {base!r}; {known}")
    return read_toml(_PROFILES / f"{base}.toml" if base in wear_names() else Path(base), _WearFile, known)
