"""Wear profiles: what the servos and gears of one arm are like, read from files anyone can write."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, fields, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.size import reference_arm
from rejoint.robots.lab.plant.ageing import aged, warmed
from rejoint.robots.lab.plant.scaling import largest_load, scale_of
from rejoint.robots.lab.plant.servo import AMBIENT, STEP
from rejoint.system.errors import FileError, ProfileError
from rejoint.system.files import TOML_MOST, read_bounded

_PROFILES = files("rejoint.robots.lab.plant") / "profiles"
_SPREAD = 0.3
_LIFT_MARGIN = 1.03
"""What a drawn arm has of the torque that lifts it (chosen)."""
_MOVE_MARGIN = 1.1
"""What a joint of a scaled profile has of the torque that moves it against gravity (chosen)."""
_SCALING_ARM = "mycobot280"
"""The only arm whose profiles may scale."""


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
    offset: Array | float = 0.0
    """[rad] where the firmware brings a joint without load, minus the command"""
    ambient: float = AMBIENT
    """[deg C] of the room; a servo that never worked is as warm"""

    def __post_init__(self) -> None:
        n = np.shape(self.position_gain)
        if np.ndim(self.offset) == 0:
            object.__setattr__(self, "offset", np.full(n, self.offset))
        for name in (*PARAMETERS, "offset"):
            value = np.array(getattr(self, name), dtype=float)
            if value.ndim != 1 or value.shape != n:
                raise ProfileError(f"wear {self.name}: {name} has shape {value.shape}, expected {n}")
            least, strict = (-np.inf if name == "offset" else 0.0, name in _POSITIVE)
            if not np.isfinite(value).all() or (value < least).any() or (strict and (value <= least).any()):
                raise ProfileError(
                    f"wear {self.name}: {name} must be {'positive' if strict else 'at least 0'}, got {value.tolist()}"
                )
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
"""The names of the per-joint parameters that every profile gives."""
_POSITIVE = ("position_gain", "torque_limit", "link_stiffness", "reflected_inertia")
_FILE_NAMES = tuple("play_deg" if name == "play" else name for name in PARAMETERS)
_OPTIONAL_NAMES = ("offset_deg",)
_HEAD = ("arm", "scales", "play_in_loop")
_NUMBER = re.compile(r"-?\d+(\.\d+)?", re.ASCII)
_OPTIONS = {
    "seed": ("a whole number, draws another arm", 0.0, 2.0**63),
    "hours": ("of use", 0.0, 100_000.0),
    "ambient": ("deg C of the room", -10.0, 50.0),
}
"""What may stand behind the name of a profile: what it means, its least and its largest value"""
_TORQUES = ("position_gain", "torque_limit", "coulomb", "stiction", "link_stiffness", "ripple", "torque_noise")


def wear_names() -> tuple[str, ...]:
    """Names of the profiles that come with the package."""
    return tuple(
        sorted(entry.name.removesuffix(".toml") for entry in _PROFILES.iterdir() if entry.name.endswith(".toml"))
    )


def load_wear(name: str, arm: Arm) -> Wear:
    """Load a profile for ``arm``: a name of `wear_names` or the path of a TOML file, each with options or without.

    Options stand behind it, as in ``worn?seed=3&hours=500``.

    A profile that scales is brought to the size of the arm, see `rejoint.robots.lab.plant.scaling`; one that belongs to
    another arm is refused. ``seed=N`` draws every parameter of every joint from +-30 % around the profile; ``hours=H``
    lets the arm age by that much use, and ``ambient=C`` [deg C] stand in a warmer or colder room, both in the way of
    that seed, see `rejoint.robots.lab.plant.ageing`.
    Raises ProfileError, which names the alternatives or the fields, for anything that is not a usable profile.
    """
    base, options = _options(name)
    wear = _fitted(base, arm)
    seed = int(options.get("seed", 0))
    if "seed" in options:
        wear = draw_wear(wear, arm, seed)
    if "hours" in options:
        young, old = _fitted("healthy", arm), _fitted("worn", arm)
        least = _LIFT_MARGIN * lifting_torque(wear, arm)
        wear = aged(wear, arm, options["hours"], seed=seed, young=young, old=old, least_torque=least)
    return warmed(wear, options["ambient"], seed=seed) if "ambient" in options else wear


def _fitted(base: str, arm: Arm) -> Wear:
    """Return the profile ``base`` for ``arm``, without options."""
    text = _profile_text(base)
    owner, scales = _head(_tables(text, base), base)
    if owner is not None and owner != arm.name and not scales:
        raise ProfileError(
            f"wear {base} describes the arm {owner} alone, not {arm.name}; give --arm {owner} or a run of that "
            f"arm, or a profile that scales with the arm: {', '.join(n for n in wear_names() if wear_arm(n) is None)}"
        )
    if scales:
        return scale_wear(parse_wear(text, name=base, joints=reference_arm().joints), arm)
    return parse_wear(text, name=base, joints=arm.joints)


def _options(name: str) -> tuple[str, dict[str, float]]:
    """Part a profile's name from its options; ProfileError for one that is not known or not a number in its range."""
    base, query, rest = name.partition("?")
    options: dict[str, float] = {}
    for part in rest.split("&") if query else []:
        key, _, value = part.partition("=")
        meaning, lowest, highest = _OPTIONS.get(key, ("", 0.0, 0.0))
        if not meaning or key in options:
            known = ", ".join(f"{one}=N ({what})" for one, (what, _, _) in _OPTIONS.items())
            raise ProfileError(f"wear {name!r}: option {part!r} is not known or stands there twice; options: {known}")
        if not _NUMBER.fullmatch(value) or not lowest <= float(value) <= highest or (key == "seed" and "." in value):
            whole = "a whole number" if key == "seed" else "a number"
            raise ProfileError(
                f"wear {name!r}: expected {whole} from {lowest:g} to {highest:g} after '{key}=', got {value!r}"
            )
        options[key] = int(value) if key == "seed" else float(value)
    return base, options


def wear_arm(name: str) -> str | None:
    """Name of the one arm that a profile describes; None for a profile that fits or scales to others."""
    base, _ = _options(name)
    owner, scales = _head(_tables(_profile_text(base), base), base)
    return None if scales else owner


def parse_wear(text: str, *, name: str, joints: int) -> Wear:
    """Read a profile for ``joints`` joints from TOML text, as it stands."""
    data = _tables(text, name)
    _head(data, name)
    table = data["joints"]
    if not set(_FILE_NAMES) <= set(table) <= {*_FILE_NAMES, *_OPTIONAL_NAMES}:
        missing, unknown = set(_FILE_NAMES) - set(table), set(table) - {*_FILE_NAMES, *_OPTIONAL_NAMES}
        raise ProfileError(
            f"wear {name}: [joints] lacks {sorted(missing)} and has unknown {sorted(unknown)}; "
            f"fields: {', '.join(_FILE_NAMES)}; optional: {', '.join(_OPTIONAL_NAMES)}"
        )
    values: dict[str, Any] = {field: _per_joint(table[field], field, name, joints) for field in _FILE_NAMES}
    values["play"] = np.radians(values.pop("play_deg"))
    offset = np.radians(_per_joint(table.get("offset_deg", 0.0), "offset_deg", name, joints))
    return Wear(name=name, play_in_loop=data.get("play_in_loop", False), offset=offset, **values)


def scale_wear(wear: Wear, arm: Arm) -> Wear:
    """Bring the profile of a myCobot 280 to the size of ``arm``."""
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
    """Draw a neighbour of ``wear``: every parameter of every joint uniform within +-30 %.

    Offsets stay. Stiction stays above Coulomb friction, and no servo gets weaker than what lifts the arm from its
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
    return largest_load(arm) * (1 + wear.load_friction) + wear.stiction


def _profile_text(base: str) -> str:
    if base in wear_names():
        return (_PROFILES / f"{base}.toml").read_text(encoding="utf-8")
    if base.endswith(".toml"):
        return _read_file(base)
    raise ProfileError(
        f"no wear profile is called {base!r}; known profiles: {', '.join(wear_names())}, "
        "each also with ?seed=N or ?hours=H, or the path of a .toml file"
    )


def _tables(text: str, name: str) -> dict[str, Any]:
    """Contents of a profile whose outline is right."""
    try:
        data = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, ValueError, RecursionError) as error:
        raise ProfileError(f"wear {name}: not valid TOML ({error})") from error
    if not isinstance(data.get("joints"), dict) or set(data) - {"joints", *_HEAD}:
        raise ProfileError(f"wear {name}: expected a table [joints] and {', '.join(_HEAD)}, found {sorted(data)}")
    return data


def _head(data: dict[str, Any], name: str) -> tuple[str | None, bool]:
    """Name of the arm that a profile is for, and whether it scales to others."""
    for key in ("scales", "play_in_loop"):
        if not isinstance(data.get(key, False), bool):
            raise ProfileError(f"wear {name}: {key} must be true or false, got {data[key]!r}")
    owner, scales = data.get("arm"), data.get("scales", False)
    if owner is not None and not isinstance(owner, str):
        raise ProfileError(f"wear {name}: arm must be the name of an arm, got {owner!r}")
    if scales and owner != _SCALING_ARM:
        raise ProfileError(f"wear {name}: only profiles with arm = '{_SCALING_ARM}' can scale, got arm {owner!r}")
    return owner, scales


def _read_file(path: str) -> str:
    try:
        return read_bounded(Path(path), TOML_MOST, "take another file").decode()
    except (OSError, ValueError, FileError) as error:
        raise ProfileError(
            f"cannot read the wear profile {path!r} ({error}); known profiles: {', '.join(wear_names())}"
        ) from error


def _per_joint(value: object, field: str, name: str, joints: int) -> Array:
    values = value if isinstance(value, list) else [value] * joints
    if len(values) != joints or not all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
        raise ProfileError(f"wear {name}: {field} must be a number or a list of {joints} numbers, got {value!r}")
    return np.array(values, dtype=float)
