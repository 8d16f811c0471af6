"""An arm as a file describes it, and its completion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array, Box
from rejoint.arms.inertia import SpatialInertia, link_ends, plausible_links
from rejoint.arms.kinematics import tcp_position
from rejoint.arms.workspace import NoPostureError, derive_targets, derive_workspace, length_size, on_a_surface, reach
from rejoint.system.errors import InputError

Mask = NDArray[np.bool_]

DEFAULT_SPEED = np.radians(90.0)
"""[rad/s] of a joint without one (chosen)"""

DEFAULT_COUNTS = 4096
"""Encoder steps a turn, as hobby servos have; doubled until a step moves no tool farther than a myCobot's (chosen)"""

MOST_TURN = 4 * 2 * np.pi
"""[rad] larger limits are ignored (chosen)"""

FASTEST = 10 * 2 * np.pi
"""[rad/s] larger speeds are ignored (chosen)"""

LONGEST = 30.0
"""[m] larger reaches are refused (chosen)"""

POINT = 1e-3
"""[m] region around the resting TCP (chosen)"""

FLOOR_RATIO = 0.04
"""over the reach (chosen)"""


@dataclass(frozen=True, kw_only=True)
class Loaded:
    """An arm and its assumptions."""

    arm: Arm
    notes: tuple[str, ...] = ()
    """a sentence per missing or wrong value"""


class UnfinishedArmError(NoPostureError):
    """No rest posture or targets could be derived."""

    def __init__(self, error: NoPostureError, arm: Arm, notes: Sequence[str]) -> None:
        super().__init__(str(error))
        self.arm = arm
        """with placeholders for them"""
        self.notes = tuple(notes)


@dataclass(frozen=True, kw_only=True, eq=False)
class Draft:
    """Fields of an `Arm`; NaN or None: unknown."""

    name: str
    joint_names: tuple[str, ...]
    offset: Array
    axis: Array
    tip: Array
    lower: Array
    upper: Array
    max_speed: Array
    links: tuple[SpatialInertia, ...]
    """per joint, in its frame; zero mass: unknown"""
    rest: Array | None = None
    targets: Box | None = None
    floor: float | None = None
    encoder_step: float | None = None
    servo_acceleration: float = np.inf
    servos: tuple[str, ...] = ()
    keep_out: tuple[Box, ...] = ()
    notes: tuple[str, ...] = ()


def finish(draft: Draft) -> Loaded:
    """Complete a draft; UnfinishedArmError without rest posture or targets."""
    notes = list(draft.notes)
    lower, upper = _limits(draft, notes)
    links, repairs = plausible_links(draft.joint_names, draft.links, link_ends(draft.offset, draft.tip))
    notes += repairs
    floor = draft.floor
    arm = Arm(
        name=draft.name,
        joint_names=draft.joint_names,
        offset=draft.offset,
        axis=draft.axis,
        tip=draft.tip,
        lower=lower,
        upper=upper,
        max_speed=_speeds(draft, notes),
        mass=np.array([link.mass for link in links]),
        com=np.array([link.com for link in links]),
        inertia=np.array([link.inertia for link in links]),
        rest=(lower + upper) / 2 if draft.rest is None else draft.rest,
        targets=draft.targets or Box(lower=-np.ones(3), upper=np.ones(3)),
        floor=0.0 if floor is None else floor,
        encoder_step=draft.encoder_step or 2 * np.pi / DEFAULT_COUNTS,
        servo_acceleration=draft.servo_acceleration,
        servos=draft.servos,
        keep_out=draft.keep_out,
    )
    if reach(arm) > LONGEST:
        raise InputError(
            f"arm {arm.name}: its links add up to {reach(arm):.0f} m, at most {LONGEST:.0f} m were expected; "
            "are they in millimetres? give lengths in metres"
        )
    if draft.encoder_step is None:
        finer = 2 ** max(0, int(np.ceil(np.log2(length_size(arm)))))
        arm = replace(arm, encoder_step=arm.encoder_step / finer)
        notes.append(f"encoders: no resolution given; {DEFAULT_COUNTS * finer} steps a turn assumed")
    if floor is None:
        arm = replace(arm, floor=round(FLOOR_RATIO * reach(arm), 3))
        notes.append(f"floor: none given; {1e3 * arm.floor:.0f} mm above the base's origin assumed")
    try:
        arm = _with_workspace(arm, draft, notes)
    except NoPostureError as error:
        raise UnfinishedArmError(error, arm, notes) from error
    return Loaded(arm=arm, notes=tuple(notes))


def _with_workspace(arm: Arm, draft: Draft, notes: list[str]) -> Arm:
    if draft.rest is not None and draft.targets is not None:
        return arm
    if on_a_surface(arm):
        tcp = tcp_position(arm, arm.rest)
        notes.append(
            f"targets: the {arm.joints} joint{'s move' if arm.joints > 1 else ' moves'} the TCP on a line or a surface "
            "only, so there is no region to drive it to; its logs can be used as those of any arm"
        )
        return replace(arm, targets=Box(lower=tcp - POINT, upper=tcp + POINT))
    if draft.rest is not None:
        arm = replace(arm, targets=derive_targets(arm))
    elif draft.targets is None:
        rest, targets = derive_workspace(arm)
        arm = replace(arm, rest=rest, targets=targets)
    else:
        raise InputError(f"arm {arm.name}: targets are given without a rest posture; give rest_deg as well, or neither")
    if draft.rest is None:
        notes.append(f"rest posture: none given; {_listed(np.degrees(arm.rest))} deg derived by sampling")
    low, high = _listed(1e3 * arm.targets.lower), _listed(1e3 * arm.targets.upper)
    notes.append(f"targets: none given; the box from {low} to {high} mm derived by sampling")
    return arm


def _limits(draft: Draft, notes: list[str]) -> tuple[Array, Array]:
    wide = np.maximum(np.abs(draft.lower), np.abs(draft.upper)) > MOST_TURN
    known = np.isfinite(draft.lower) & np.isfinite(draft.upper) & (draft.lower < draft.upper)
    given = _believed(draft, "limits", known, wide, f"{MOST_TURN / (2 * np.pi):.0f} turns", "+-180 deg", notes)
    return np.where(given, draft.lower, -np.pi), np.where(given, draft.upper, np.pi)


def _speeds(draft: Draft, notes: list[str]) -> Array:
    known, wide = np.isfinite(draft.max_speed) & (draft.max_speed > 0), draft.max_speed > FASTEST
    assumed, most = f"{np.degrees(DEFAULT_SPEED):.0f} deg/s", f"{FASTEST / (2 * np.pi):.0f} turns a second"
    return np.where(_believed(draft, "speed", known, wide, most, assumed, notes), draft.max_speed, DEFAULT_SPEED)


def _believed(draft: Draft, what: str, known: Mask, wide: Mask, most: str, assumed: str, notes: list[str]) -> Mask:
    """Joints (n,) whose values are ``known`` and not ``wide``; a note names the others."""
    wide = known & wide
    if wide.any():
        notes.append(
            f"{what}: those of {_chosen(draft.joint_names, wide)} are beyond {most}, and not believed; are they in "
            "degrees, where radians were expected?"
        )
    given: Mask = known & ~wide
    if not given.all():
        notes.append(f"{what}: none usable for {_chosen(draft.joint_names, ~given)}; {assumed} assumed")
    return given


def _chosen(names: Sequence[str], mask: Mask) -> str:
    return ", ".join(name for name, chosen in zip(names, mask, strict=True) if chosen)


def _listed(values: Array) -> str:
    return "(" + ", ".join(f"{value:.0f}" for value in values) + ")"
