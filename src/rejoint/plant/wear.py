"""Wear profiles: what the servos and gears of one arm are like, read from files anyone can write."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, solve_position
from rejoint.errors import ProfileError
from rejoint.plant.servo import STEP

_PROFILES = files("rejoint.plant") / "profiles"
_SPREAD = 0.3
_SOFTEST_LINK = 10.0
"""[N m/rad] below it the viscous torque of the gear would be unstable in steps of 1 ms."""
_LIFT_MARGIN = 1.03
"""What a drawn arm has of the torque that lifts it (chosen)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Wear:
    """State of the n servos of an arm; every array is (n,). `dataclasses.replace` makes variants."""

    name: str
    position_gain: Array
    """[N m/rad] proportional gain of the firmware"""
    damping_gain: Array
    """[N m s/rad] derivative gain of the firmware"""
    torque_limit: Array
    """[N m] motor torque at standstill"""
    coulomb: Array
    """[N m] friction while moving"""
    stiction: Array
    """[N m] friction before moving"""
    load_friction: Array
    """[1] further friction as a fraction of the transmitted torque"""
    play: Array
    """[rad] full width of the free motion of the gear"""
    link_stiffness: Array
    """[N m/rad] of gear and link behind the encoder"""
    reflected_inertia: Array
    """[kg m^2] of motor and gear, seen from the output"""
    ripple: Array
    """[N m] amplitude of the gear ripple"""
    torque_noise: Array
    """[N m] standard deviation from one millisecond to the next"""
    play_in_loop: bool = False
    """whether the encoder sits behind the gear and sees the play (never the flex)"""

    def __post_init__(self) -> None:
        n = np.shape(self.position_gain)
        for name in PARAMETERS:
            value = np.array(getattr(self, name), dtype=float)
            if value.ndim != 1 or value.shape != n:
                raise ProfileError(f"wear {self.name}: {name} has shape {value.shape}, expected {n}")
            least, strict = (0.0, name in _POSITIVE)
            if not np.isfinite(value).all() or (value < least).any() or (strict and (value <= least).any()):
                raise ProfileError(
                    f"wear {self.name}: {name} must be {'positive' if strict else 'at least 0'}, got {value.tolist()}"
                )
            value.setflags(write=False)
            object.__setattr__(self, name, value)
        if (self.stiction < self.coulomb).any():
            raise ProfileError(f"wear {self.name}: stiction must not be below coulomb friction")
        if (self.link_stiffness < _SOFTEST_LINK).any():
            raise ProfileError(f"wear {self.name}: link_stiffness must be at least {_SOFTEST_LINK} N m/rad")
        stiffest = self.position_gain * STEP**2 + self.damping_gain * STEP
        if (stiffest > 0.5 * self.reflected_inertia).any():
            raise ProfileError(
                f"wear {self.name}: position_gain or damping_gain is too high for reflected_inertia; "
                f"a servo loop of {STEP} s cannot be stable with it"
            )


PARAMETERS = tuple(field.name for field in fields(Wear) if field.name not in ("name", "play_in_loop"))
"""The names of the per-joint parameters."""
_POSITIVE = ("position_gain", "torque_limit", "link_stiffness", "reflected_inertia")
_FILE_NAMES = tuple("play_deg" if name == "play" else name for name in PARAMETERS)


def wear_names() -> tuple[str, ...]:
    """Names of the profiles that come with the package."""
    return tuple(
        sorted(entry.name.removesuffix(".toml") for entry in _PROFILES.iterdir() if entry.name.endswith(".toml"))
    )


def load_wear(name: str, arm: Arm) -> Wear:
    """Load a profile for ``arm``: a name of `wear_names`, one with ``?seed=N``, or the path of a TOML file.

    ``?seed=N`` draws every parameter of every joint from +-30 % around the profile. Raises ProfileError,
    which names the alternatives or the fields, for anything that is not a usable profile.
    """
    base, query, seed = name.partition("?seed=")
    if query and not (seed.isascii() and seed.isdecimal()):
        raise ProfileError(f"wear {name!r}: expected a whole number after '?seed=', got {seed!r}")
    if base in wear_names():
        text = (_PROFILES / f"{base}.toml").read_text(encoding="utf-8")
    elif base.endswith(".toml"):
        text = _read_file(base)
    else:
        raise ProfileError(
            f"no wear profile is called {base!r}; known profiles: {', '.join(wear_names())}, "
            "each also with ?seed=N, or the path of a .toml file"
        )
    wear = parse_wear(text, name=base, joints=arm.joints)
    return draw_wear(wear, arm, int(seed)) if query else wear


def parse_wear(text: str, *, name: str, joints: int) -> Wear:
    """Read a profile for ``joints`` joints from TOML text."""
    try:
        data = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        raise ProfileError(f"wear {name}: not valid TOML ({error})") from error
    table = data.get("joints")
    if not isinstance(table, dict) or set(data) - {"joints", "play_in_loop"}:
        raise ProfileError(f"wear {name}: expected a table [joints] and play_in_loop, found {sorted(data)}")
    if set(table) != set(_FILE_NAMES):
        missing, unknown = set(_FILE_NAMES) - set(table), set(table) - set(_FILE_NAMES)
        raise ProfileError(
            f"wear {name}: [joints] lacks {sorted(missing)} and has unknown {sorted(unknown)}; "
            f"fields: {', '.join(_FILE_NAMES)}"
        )
    in_loop = data.get("play_in_loop", False)
    if not isinstance(in_loop, bool):
        raise ProfileError(f"wear {name}: play_in_loop must be true or false, got {in_loop!r}")
    values = {field: _per_joint(table[field], field, name, joints) for field in _FILE_NAMES}
    values["play"] = np.radians(values.pop("play_deg"))
    return Wear(name=name, play_in_loop=in_loop, **values)


def draw_wear(wear: Wear, arm: Arm, seed: int) -> Wear:
    """Draw a neighbour of ``wear``: every parameter of every joint uniform within +-30 %.

    Stiction stays above Coulomb friction, and no servo gets weaker than what lifts the arm from its
    heaviest posture in the target region (`lifting_torque`): an arm that cannot lift itself is broken,
    not worn.
    """
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
    """Motor torque (n,) [N m] that lifts the arm from standstill in any posture of its target region."""
    return heaviest_load(arm) * (1 + wear.load_friction) + wear.stiction


@lru_cache(maxsize=8)
def heaviest_load(arm: Arm) -> Array:
    """Largest gravity torque (n,) [N m] of each joint over the postures of a grid of targets."""
    axes = [np.linspace(low, high, 5) for low, high in zip(arm.targets.lower, arm.targets.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    postures = solve_position(arm, grid, arm.rest).q
    return np.abs(gravity_torque(arm, postures)).max(axis=0)


def _read_file(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except (OSError, ValueError) as error:
        raise ProfileError(
            f"cannot read the wear profile {path!r} ({error}); known profiles: {', '.join(wear_names())}"
        ) from error


def _per_joint(value: object, field: str, name: str, joints: int) -> Array:
    values = value if isinstance(value, list) else [value] * joints
    if len(values) != joints or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        raise ProfileError(f"wear {name}: {field} must be a number or a list of {joints} numbers, got {value!r}")
    return np.array(values, dtype=float)
