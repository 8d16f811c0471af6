"""Where an arm may be moved about to be diagnosed, and a rest posture that leaves room for it.

A posture is safe with its joints away from their limits, its frames above the floor, its TCP away from the arm's own
column and no joint loaded more than at the heaviest target: a worn arm that was brought into a posture that it cannot
lift itself out of would stay there.

A derived rest posture is tried before it is taken: the excitation (:mod:`rejoint.diagnosis.excitation`) stirs every
joint around it and holds postures around it. Where there is no room for that, the next candidate is tried, then those
of a search that keeps farther from the floor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array, Box
from rejoint.arms.kinematics import frames, gravity_torque, tcp_position
from rejoint.arms.size import heaviest_load, length_size, torque_size
from rejoint.arms.workspace import NoPostureError, rising_frames, workspaces

LIMIT_MARGIN = np.radians(10.0)
"""[rad] commands stay this far inside the joint limits (chosen: a worn arm overshoots a 0.2 rad step by half)."""

CLEARANCE = 0.05
"""[m] of joint frames and TCP above the floor (chosen: a worn myCobot sags up to 40 mm; goes with the reach)."""

COLUMN = 0.4
"""Share of the rest posture's reach that the TCP keeps from the vertical base axis (chosen; the arm must
not hit its own column)."""

LOAD_MARGIN = 0.02
"""[N m] that counts as no load at all (chosen: less than any joint of a myCobot has friction; goes with the load)."""

EXCURSION = 0.25
"""[rad] by which an excitation moves all joints about the rest posture at once (chosen)"""

HOLD_SPREAD, HOLD_OFFSET = 0.7, 0.15
"""[rad] how far held postures may lie from the rest posture, and from where each is approached (chosen)"""

POSTURES = 400
"""Postures around rest among which those to hold are chosen (chosen)"""

_LEAST = 0.25
"""Share of the excursions that has to be safe about a derived rest posture (chosen: those that were derived without a
trial, and could be excited, had 0.26 and more, measured with `python -m benchmarks.arms`)"""

_LEAST_HOLDS = 0.1
"""Share of the postures around rest that has to be safe (chosen: the same had 0.11 and more)"""

_CORNERS = 128
"""Most ends of excursions that are tried; drawn where an arm of more than seven joints has more (chosen)"""

_SEARCHES = ((0.0, 0.0), (0.05, 0.3), (0.1, 0.3))
"""By how much farther from the floor, in summed link lengths, and from the limits [rad] the searches keep, one after
the other (chosen: an excitation's clearance is 0.05 above a target's; `LIMIT_MARGIN` and half of `EXCURSION`)"""

_STEPS = 0.8 ** np.arange(8)
"""Shares that are tried (chosen, as the excitation makes smaller what is not safe)"""


def is_safe(arm: Arm, q: Array) -> NDArray[np.bool_]:
    """Tell for postures (..., n) [rad] whether a diagnosis may go there; returns (...)."""
    f = frames(arm, q)
    floor = arm.floor + CLEARANCE * length_size(arm)
    # Frames that never rise or sink, such as a shoulder on its column, may be anywhere.
    height = np.where(rising_frames(arm, floor), f.position[..., 2], np.inf).min(axis=-1)
    lowest = np.minimum(height, f.tcp_position[..., 2])
    reach = np.linalg.norm(f.tcp_position[..., :2], axis=-1)
    rest_reach = np.linalg.norm(tcp_position(arm, arm.rest)[:2])
    inside = ((q >= arm.lower + LIMIT_MARGIN) & (q <= arm.upper - LIMIT_MARGIN)).all(axis=-1)
    light = (np.abs(gravity_torque(arm, q)) <= _most_load(arm)).all(axis=-1)
    return np.asarray(inside & light & (lowest >= floor) & (reach >= COLUMN * rest_reach))


def line_is_safe(arm: Arm, start: Array, goal: Array) -> NDArray[np.bool_]:
    """Tell whether the straight joint motions (..., n) from ``start`` to ``goal`` stay safe; returns (...)."""
    share = np.linspace(0.0, 1.0, 12)[:, None]
    return np.asarray(is_safe(arm, start[..., None, :] + share * (goal - start)[..., None, :]).all(axis=-1))


def unsafe(arm: Arm, q: Array) -> str:
    """Say why a posture (n,) [rad] is not safe; empty where it is."""
    f = frames(arm, q)
    floor = arm.floor + CLEARANCE * length_size(arm)
    low = rising_frames(arm, floor) & (f.position[:, 2] < floor)
    near = (q < arm.lower + LIMIT_MARGIN) | (q > arm.upper - LIMIT_MARGIN)
    heavy = np.abs(gravity_torque(arm, q)) > _most_load(arm)
    names = np.array(arm.joint_names)
    causes = [
        (near.any(), f"{', '.join(names[near])} within {np.degrees(LIMIT_MARGIN):.0f} deg of a limit"),
        (low.any(), f"the frame of {', '.join(names[low])} less than {1e3 * floor:.0f} mm above the base"),
        (f.tcp_position[2] < floor, f"the TCP less than {1e3 * floor:.0f} mm above the base"),
        (heavy.any(), f"more load on {', '.join(names[heavy])} than at any target"),
        (
            np.linalg.norm(f.tcp_position[:2]) < COLUMN * np.linalg.norm(tcp_position(arm, arm.rest)[:2]),
            "the TCP too near to the base's vertical axis",
        ),
    ]
    return ", ".join(cause for holds, cause in causes if holds)


def room(arm: Arm, seed: int = 0) -> tuple[float, float]:
    """Shares, from 0 to 1, of the excursion about rest and of the spread of postures around it that are safe.

    The second is not looked for, and 0, where the first is too small.
    """
    corners = np.array(list(product((-1.0, 1.0), repeat=min(arm.joints, 7))))
    if arm.joints > 7:
        corners = np.random.default_rng(seed).choice((-1.0, 1.0), (_CORNERS, arm.joints))
    whole = is_safe(arm, arm.rest + EXCURSION * _STEPS[:, None, None] * corners).all(axis=-1)
    excursion = float(max(_STEPS[whole], default=0.0))
    if excursion < _LEAST:
        return excursion, 0.0
    held = (
        share
        for share in _STEPS
        if len(postures_to_hold(arm, np.random.default_rng(seed), spread=share * HOLD_SPREAD))
        >= _LEAST_HOLDS * POSTURES
    )
    return excursion, float(next(held, 0.0))


def postures_to_hold(
    arm: Arm, rng: np.random.Generator, *, spread: float = HOLD_SPREAD, offset: float = HOLD_OFFSET
) -> Array:
    """Draw postures around rest; those (k, n) [rad] are returned that can be come to from both sides, and from rest."""
    q = arm.rest + spread * rng.uniform(-1.0, 1.0, (POSTURES, arm.joints))
    for side in (-offset, offset):
        q = q[line_is_safe(arm, arm.rest, q + side) & line_is_safe(arm, q, q + side)]
    return q


def derive_workspace(arm: Arm, seed: int = 0) -> tuple[Array, Box]:
    """Find a rest posture (n,) [rad] and its region of targets, with room around it for an excitation.

    The best-scored posture is taken that has room, and whose region has at least half of the largest edges; where none
    has, the one with the most room. InputError if no posture has any.
    """
    best: tuple[float, Array, Box] | None = None
    why = ""
    for rest, box, wide in _tried(arm, seed):
        trial = replace(arm, rest=rest, targets=box)
        share, spread = room(trial, seed)
        if wide and share >= _LEAST and spread == 1.0:
            return rest, box
        why = why or unsafe(trial, rest) or "most postures around it are not safe"
        if min(share, spread) >= _LEAST:
            value = share * spread * float((box.upper - box.lower).prod())
            best = (value, rest, box) if best is None or value > best[0] else best
    if best is None:
        lack = f"has room for an excitation (of the best one: {why})" if why else "has a region of reachable targets"
        raise NoPostureError(
            f"arm {arm.name}: no posture with the TCP in front of the base (x > 0) {lack}; give rest_deg in the arm's "
            "TOML file"
        )
    return best[1], best[2]


def _tried(arm: Arm, seed: int) -> Iterator[tuple[Array, Box, bool]]:
    """Rest postures and their targets, from one search after the other; InputError if no search finds a posture."""
    found, refused = False, None
    for apart, margin in _SEARCHES:
        try:
            for candidate in workspaces(arm, seed, apart=apart, margin=margin):
                found = True
                yield candidate
        except NoPostureError as error:
            refused = refused or error
    if refused is not None and not found:
        raise refused


def _most_load(arm: Arm) -> Array:
    """Load (n,) [N m] that joints may bear."""
    return heaviest_load(arm) + LOAD_MARGIN * torque_size(arm)
