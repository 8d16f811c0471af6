"""Completion of an arm that a file describes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms.arm import Arm, Array, Box, Mask
from rejoint.arms.inertia import plausible
from rejoint.arms.kinematics import tcp_position
from rejoint.arms.workspace import NoPostureError, derive_targets, derive_workspace, length_size, on_a_surface, reach
from rejoint.system.errors import InputError
from rejoint.system.results import Readable

DEFAULT_SPEED = np.radians(90.0)
"""[rad/s] of a joint without one (chosen)"""

DEFAULT_COUNTS = 4096
"""Encoder steps a turn of hobby servos; doubled until a step moves no tool farther than a myCobot's (chosen)"""

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


@dataclass(frozen=True, kw_only=True, repr=False)
class Loaded(Readable):
    """An arm and its assumptions."""

    arm: Arm
    notes: tuple[str, ...] = ()
    """a sentence per missing or wrong value"""


UNKNOWN = Box(lower=np.full(3, np.nan), upper=np.full(3, np.nan))
"""Targets of an unfinished arm"""


def finish(draft: Loaded) -> Loaded:
    """Complete an arm in which NaN is unknown, as are masses of zero; NoPostureError without rest or targets."""
    given, notes = draft.arm, list(draft.notes)
    if np.isnan(given.rest).any() and not np.isnan(given.targets.lower).any():
        raise InputError(f"arm {given.name}: targets are given without a rest posture; give rest_deg too, or neither")
    lower, upper = _limits(given, notes)
    rest = np.where(np.isnan(given.rest), (lower + upper) / 2, given.rest)
    arm = plausible(replace(given, lower=lower, upper=upper, rest=rest), notes)
    arm = replace(arm, max_speed=_speeds(given, notes))
    if reach(arm) > LONGEST:
        raise InputError(
            f"arm {arm.name}: its links add up to {reach(arm):.0f} m, at most {LONGEST:.0f} m were expected; "
            "are they in millimetres? give lengths in metres"
        )
    if np.isnan(arm.encoder_step):
        counts = DEFAULT_COUNTS * 2 ** max(0, int(np.ceil(np.log2(length_size(arm)))))
        arm = replace(arm, encoder_step=2 * np.pi / counts)
        notes.append(f"encoders: no resolution given; {counts} steps a turn assumed")
    if np.isnan(arm.floor):
        arm = replace(arm, floor=round(FLOOR_RATIO * reach(arm), 3))
        notes.append(f"floor: none given; {1e3 * arm.floor:.0f} mm above the base's origin assumed")
    if np.isnan(arm.targets.lower).any():
        try:
            arm = _with_workspace(arm, bool(np.isnan(given.rest).any()), notes)
        except NoPostureError as error:
            error.arm, error.notes = arm, tuple(notes)
            raise
    return Loaded(arm=arm, notes=tuple(notes))


def _with_workspace(arm: Arm, derives: bool, notes: list[str]) -> Arm:
    """Derive targets, and the rest posture too where it ``derives`` one."""
    if on_a_surface(arm):
        tcp = tcp_position(arm, arm.rest)
        notes.append(
            f"targets: the {arm.joints} joint{'s move' if arm.joints > 1 else ' moves'} the TCP on a line or a surface "
            "only, so there is no region to drive it to; its logs can be used as those of any arm"
        )
        return replace(arm, targets=Box(lower=tcp - POINT, upper=tcp + POINT))
    if derives:
        rest, targets = derive_workspace(arm)
        arm = replace(arm, rest=rest, targets=targets)
        notes.append(f"rest posture: none given; {_listed(np.degrees(arm.rest))} deg derived by sampling")
    else:
        arm = replace(arm, targets=derive_targets(arm))
    low, high = _listed(1e3 * arm.targets.lower), _listed(1e3 * arm.targets.upper)
    notes.append(f"targets: none given; the box from {low} to {high} mm derived by sampling")
    return arm


def _limits(draft: Arm, notes: list[str]) -> tuple[Array, Array]:
    wide = np.maximum(np.abs(draft.lower), np.abs(draft.upper)) > MOST_TURN
    known = np.isfinite(draft.lower) & np.isfinite(draft.upper) & (draft.lower < draft.upper)
    given = _believed(draft, "limits", known, wide, f"{MOST_TURN / (2 * np.pi):.0f} turns", "+-180 deg", notes)
    return np.where(given, draft.lower, -np.pi), np.where(given, draft.upper, np.pi)


def _speeds(draft: Arm, notes: list[str]) -> Array:
    known, wide = np.isfinite(draft.max_speed) & (draft.max_speed > 0), draft.max_speed > FASTEST
    assumed, most = f"{np.degrees(DEFAULT_SPEED):.0f} deg/s", f"{FASTEST / (2 * np.pi):.0f} turns a second"
    return np.where(_believed(draft, "speed", known, wide, most, assumed, notes), draft.max_speed, DEFAULT_SPEED)


def _believed(draft: Arm, what: str, known: Mask, wide: Mask, most: str, assumed: str, notes: list[str]) -> Mask:
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
