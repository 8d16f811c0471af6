"""Wear profiles of an arm of any size after any hours of use.

A joint takes the numbers of the myCobot 280's joint at the same share of the chain. Torques scale with the ratio T of
the efforts, hypot(G, I g/L, 0.3 max G): gravity torque G, inertia I, reach L; damping with T t, inertia with T t^2, t =
sqrt(L / L0).

Wear is load times travel (Archard, J. Appl. Phys. 24, 1953), damage a gamma process (van Noortwijk, Reliab. Eng. Syst.
Saf. 94, 2009).
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, NamedTuple
from urllib.parse import parse_qsl

import msgspec
import numpy as np
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, gravity_torque, link_inertia
from rejoint.arms.inverse import solve_position
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.workspace import heaviest_load, length_size, reach, reference_arm
from rejoint.system.errors import FileError, ProfileError, first_line
from rejoint.system.files import TOML_MOST, read_bounded
from rejoint_lab.plant.servo import AMBIENT, STEP

FLOOR = 0.3
"""Least effort over the largest load (chosen)"""

# Targets along each edge of the region over which the gravity torques are taken (chosen).
_GRID = 5


class Ratios(NamedTuple):
    """Ratios of an arm to the myCobot 280."""

    row: NDArray[np.intp]
    """(n,) joint of the myCobot 280 per joint"""
    torque: Array
    """(n,)"""
    time: float


@lru_cache(maxsize=16)
def scale_of(arm: Arm) -> Ratios:
    """Compare an arm with the myCobot 280."""
    reference = reference_arm()
    row = np.rint(np.linspace(0.0, reference.joints - 1, arm.joints)).astype(np.intp)
    return Ratios(
        row=row,
        torque=effort(arm) / effort(reference)[row],
        time=float(np.sqrt(length_size(arm))),
    )


@lru_cache(maxsize=16)
def effort(arm: Arm) -> Array:
    """Torque (n,) [N m] for the size of each joint."""
    load = largest_load(arm)
    rate = np.linalg.norm(GRAVITY) / reach(arm)
    least = max(FLOOR * float(load.max()), np.finfo(float).tiny)
    return np.sqrt(load**2 + (link_inertia(arm, arm.rest) * rate) ** 2 + least**2)


def largest_load(arm: Arm) -> Array:
    """Largest gravity torque (n,) [N m] over the targets."""
    return heaviest_load(arm, _GRID)


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


def aged(wear: Wear, arm: Arm, hours: float, *, seed: int, young: Wear, old: Wear, least_torque: Array) -> Wear:
    """``wear`` after ``hours``; no motor gets below ``least_torque`` (n,) [N m]."""
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
    changed["torque_limit"] = np.maximum(weaker, np.minimum(wear.torque_limit, least_torque))
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
    return np.asarray(pace * severity(young, arm) * passed * _BLOCK / LIFE)


def severity(young: Wear, arm: Arm) -> Array:
    """Load times travel (n,) over its mean, at random targets."""
    axes = [np.linspace(low, high, 4) for low, high in zip(arm.targets.lower, arm.targets.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    posture = solve_position(arm, grid, arm.rest).q
    travel = np.abs(posture[:, None] - posture[None]).mean(axis=(0, 1))
    load = (np.abs(gravity_torque(arm, posture)).mean(axis=0) + young.coulomb) / young.torque_limit
    rubbed: Array = travel * load / (travel * load).mean()
    return rubbed


_PROFILES = files("rejoint_lab.plant") / "profiles"
_SPREAD = 0.3
# What a drawn arm has of the torque that lifts it (chosen).
_LIFT_MARGIN = 1.03
# What a joint of a scaled profile has of the torque that moves it against gravity (chosen).
_MOVE_MARGIN = 1.1
# The only arm whose profiles may scale.
_SCALING_ARM = "mycobot280"


@dataclass(frozen=True, kw_only=True, eq=False)
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
        n = np.shape(self.position_gain)
        for name in (*PARAMETERS, "offset"):
            value = np.array(getattr(self, name), dtype=float)
            if name == "offset" and value.ndim == 0:
                value = np.full(n, value)
            if value.ndim != 1 or value.shape != n:
                raise ProfileError(f"wear {self.name}: {name} has shape {value.shape}, expected {n}")
            least = np.nextafter(0.0, 1.0) if name in _POSITIVE else -np.inf if name == "offset" else 0.0
            if not (np.isfinite(value) & (value >= least)).all():
                wanted = "positive" if name in _POSITIVE else "at least 0"
                raise ProfileError(f"wear {self.name}: {name} must be {wanted}, got {value.tolist()}")
            value.setflags(write=False)
            object.__setattr__(self, name, value)
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
_POSITIVE = ("position_gain", "torque_limit", "link_stiffness", "reflected_inertia")
_FILE_NAMES = tuple("play_deg" if name == "play" else name for name in PARAMETERS)
_TORQUES = ("position_gain", "torque_limit", "coulomb", "stiction", "link_stiffness", "ripple", "torque_noise")


def wear_names() -> tuple[str, ...]:
    """Names of the package's profiles."""
    return tuple(
        sorted(entry.name.removesuffix(".toml") for entry in _PROFILES.iterdir() if entry.name.endswith(".toml"))
    )


def load_wear(name: str, arm: Arm) -> Wear:
    """Load a profile for ``arm``: a name or a TOML file; ProfileError.

    Options as ``worn?seed=3``: ``seed=N`` draws parameters within +-30 %, ``hours=H`` ages, ``ambient=C`` [deg C].
    """
    base, options = _options(name)
    wear = _fitted(base, arm)
    seed = options.seed or 0
    if options.seed is not UNSET:
        wear = draw_wear(wear, arm, seed)
    if options.hours is not UNSET:
        young, old = _fitted("healthy", arm), _fitted("worn", arm)
        least = _LIFT_MARGIN * lifting_torque(wear, arm)
        wear = aged(wear, arm, options.hours, seed=seed, young=young, old=old, least_torque=least)
    return wear if options.ambient is UNSET else warmed(wear, options.ambient, seed=seed)


def _fitted(base: str, arm: Arm) -> Wear:
    found = _profile(_text(base), base)
    if found.arm is not None and found.arm != arm.name and not found.scales:
        raise ProfileError(
            f"wear {base} describes the arm {found.arm} alone, not {arm.name}; give --arm {found.arm} or a run of that "
            f"arm, or a profile that scales with the arm: {', '.join(n for n in wear_names() if wear_arm(n) is None)}"
        )
    if found.scales:
        return scale_wear(_wear(found, base, reference_arm().joints), arm)
    return _wear(found, base, arm.joints)


class _Options(msgspec.Struct, forbid_unknown_fields=True):
    """What may stand behind the name of a profile."""

    seed: Annotated[int, msgspec.Meta(ge=0)] | UnsetType = UNSET
    hours: Annotated[float, msgspec.Meta(ge=0.0, le=100_000.0)] | UnsetType = UNSET
    ambient: Annotated[float, msgspec.Meta(ge=-10.0, le=50.0)] | UnsetType = UNSET


def _options(name: str) -> tuple[str, _Options]:
    base, query, rest = name.partition("?")
    try:
        given = parse_qsl(rest, keep_blank_values=True, strict_parsing=True) if query else []
        if len(dict(given)) < len(given):
            raise ValueError("an option stands there twice")
        return base, msgspec.convert(dict(given), _Options, strict=False)
    except ValueError as error:
        known = "seed=N (draws another arm), hours=N (of use), ambient=N (deg C of the room)"
        raise ProfileError(f"wear {name!r}: {first_line(error)}; options: {known}") from error


def wear_arm(name: str) -> str | None:
    """Name of the one arm of a profile; None: for others too."""
    base, _ = _options(name)
    found = _profile(_text(base), base)
    return None if found.scales else found.arm


def parse_wear(text: str, *, name: str, joints: int) -> Wear:
    """Read a profile for ``joints`` joints from TOML text."""
    return _wear(_profile(text, name), name, joints)


def scale_wear(wear: Wear, arm: Arm) -> Wear:
    """Scale a myCobot 280's profile to ``arm``."""
    scale = scale_of(arm)
    values: dict[str, Any] = {name: getattr(wear, name)[scale.row] for name in (*PARAMETERS, "offset")}
    for name in _TORQUES:
        values[name] = values[name] * scale.torque
    values["damping_gain"] = values["damping_gain"] * (scale.torque * scale.time)
    values["reflected_inertia"] = values["reflected_inertia"] * (scale.torque * scale.time**2)
    moving = largest_load(arm) * (1 + values["load_friction"]) + values["coulomb"]
    values["torque_limit"] = np.maximum(values["torque_limit"], _MOVE_MARGIN * moving)
    return Wear(name=wear.name, play_in_loop=wear.play_in_loop, **values)


def draw_wear(wear: Wear, arm: Arm, seed: int) -> Wear:
    """Draw a neighbour within +-30 % that lifts the arm."""
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    factor = {name: rng.uniform(1 - _SPREAD, 1 + _SPREAD, arm.joints) for name in PARAMETERS}
    drawn: dict[str, Any] = {name: getattr(wear, name) * factor[name] for name in PARAMETERS}
    over = (wear.stiction - wear.coulomb) * factor["stiction"]
    drawn["stiction"] = drawn["coulomb"] + over
    neighbour = replace(wear, name=f"{wear.name}?seed={seed}", **drawn)
    low = np.maximum((1 - _SPREAD) * wear.torque_limit, _LIFT_MARGIN * lifting_torque(neighbour, arm))
    high = np.maximum((1 + _SPREAD) * wear.torque_limit, 1.01 * low)
    share = (factor["torque_limit"] - (1 - _SPREAD)) / (2 * _SPREAD)
    return replace(neighbour, torque_limit=low + share * (high - low))


def lifting_torque(wear: Wear, arm: Arm) -> Array:
    """Torque (n,) [N m] that lifts the arm from standstill at all targets."""
    return largest_load(arm) * (1 + wear.load_friction) + wear.stiction


def _text(base: str) -> str:
    known = f"known profiles: {', '.join(wear_names())}, each also with ?seed=N or ?hours=H, or a .toml file"
    if base in wear_names():
        return (_PROFILES / f"{base}.toml").read_text(encoding="utf-8")
    if not base.endswith(".toml"):
        raise ProfileError(f"no wear profile is called {base!r}; {known}")
    try:
        return read_bounded(Path(base), TOML_MOST, "take another file").decode()
    except (OSError, ValueError, FileError) as error:
        raise ProfileError(f"cannot read the wear profile {base!r} ({error}); {known}") from error


class _WearFile(msgspec.Struct, forbid_unknown_fields=True):
    joints: dict[str, Any]
    arm: str | None = None
    """the only arm"""
    scales: bool = False
    play_in_loop: bool = False


def _profile(text: str, name: str) -> _WearFile:
    try:
        found = msgspec.toml.decode(text, type=_WearFile)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        expected = "expected a table [joints] and, if wished, arm, scales and play_in_loop"
        raise ProfileError(f"wear {name}: {first_line(error)}; {expected}") from error
    if found.scales and found.arm != _SCALING_ARM:
        raise ProfileError(f"wear {name}: only profiles with arm = '{_SCALING_ARM}' can scale, got arm {found.arm!r}")
    return found


def _wear(found: _WearFile, name: str, joints: int) -> Wear:
    if differing := set(_FILE_NAMES) ^ set(found.joints) - {"offset_deg"}:
        raise ProfileError(
            f"wear {name}: [joints] lacks, or does not know, {', '.join(sorted(differing))}; fields: "
            f"{', '.join(_FILE_NAMES)}; optional: offset_deg"
        )
    values: dict[str, Any] = {}
    for field, value in found.joints.items():
        try:
            numbers = np.broadcast_to(msgspec.convert(value, float | list[float]), joints)
        except ValueError as error:
            message = f"wear {name}: {field} must be a number or a list of {joints} numbers, got {value!r}"
            raise ProfileError(message) from error
        values[field.removesuffix("_deg")] = np.radians(numbers) if field.endswith("_deg") else numbers
    return Wear(name=name, play_in_loop=found.play_in_loop, **values)
