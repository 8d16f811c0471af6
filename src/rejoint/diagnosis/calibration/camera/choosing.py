"""Which postures to take pictures in: those that tell most, among those in which the board is seen."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, collides, frames, heights, tcp_pose, tcp_position
from rejoint.arms.camera.board import BoardView
from rejoint.arms.camera.rig import Rig
from rejoint.diagnosis.calibration.camera.adjustment import Adjustment, looseness
from rejoint.diagnosis.calibration.camera.bundle import USUAL
from rejoint.diagnosis.calibration.parameters import DisplacementLayout, belief, displacement_of
from rejoint.system.errors import InputError

CANDIDATES = 240
"""Postures that are chosen among (chosen)"""
SPREAD = np.radians(40.0)
"""[rad] how far joints leave the rest posture, at most (chosen: beyond it boards on a tool turn away)"""
SCOUTING = {"board": np.radians(20.0), "camera": np.radians(12.0)}
"""[rad] the same while nobody knows where the camera is, by what the tool carries (chosen: the board stays in sight; a
camera that turns itself loses it sooner)"""
_DRAWS = 4000  # at a time
_TRIES = 25  # of so many draws
_ROOM = np.radians(5.0)  # from the joint limits
_AROUND = 0.04  # [m] around the region of targets in which the tool stays (chosen)
_LOOK = 1.0  # [m] and [rad] of camera and board around where they are believed to be


def choose_postures(arm: Arm, rig: Rig, count: int, seed: int = 0, before: float = 0.0) -> Array:
    """Choose ``count`` postures (count, n) [rad] in which ``rig``, as it is believed to stand, shows the board.

    D-optimal, one after the other: each is the one that narrows all unknowns most. Those are left out that cannot be
    come to from ``before`` [rad] away, with all joints upwards or downwards. InputError where the board is seen in too
    few postures.
    """
    candidates = seen_postures(arm, rig, max(CANDIDATES, 2 * count), seed, before=before)
    if len(candidates) < count:
        raise InputError(
            f"the camera sees the board in {len(candidates)} of {_TRIES * _DRAWS} postures around the rest posture, "
            f"expected at least {count}; turn the camera to the tool, or the board to the camera"
        )
    layout = DisplacementLayout(joints=arm.joints)
    believed = belief(arm, layout, USUAL)
    displacement = displacement_of(layout, believed.mean)
    root = np.linalg.inv(np.linalg.cholesky(looseness(arm, displacement, candidates)))
    nothing = BoardView(name="", number=np.zeros(0, np.int64), pixel=np.zeros((0, 2)))
    state = Adjustment(
        arm=arm, layout=layout, belief=believed, rig=rig, lens=rig.lens, views=[nothing] * len(candidates),
        sights=rig.sight(displacement.tool_pose(arm, candidates)), position=candidates,
        approach=np.full_like(candidates, np.nan), whitener=root,
    )  # fmt: skip
    slope = state.shared_ties(state.start(believed.mean))[..., -layout.body - 12 :]
    spread = np.diag(np.concatenate([np.full(12, _LOOK**2), 1.0 / np.diag(believed.precision)]))
    return candidates[_greedy(slope, spread, count)]


def scouting_postures(arm: Arm, carried: str, count: int, before: float) -> Array:
    """Choose ``count`` postures (count, n) [rad] about the rest posture, the first, for a camera that stands anywhere.

    ``carried`` is what the tool carries.

    One after the other, each is the one that differs most from those before it.
    """
    drawn = seen_postures(arm, None, CANDIDATES, 0, spread=SCOUTING[carried], before=before)
    if len(drawn) < count:
        raise InputError(
            f"arm {arm.name}: {len(drawn)} postures about the rest posture are free of floor, limits and collisions, "
            f"expected at least {count}; give the arm another rest posture"
        )
    chosen = [arm.rest]
    while len(chosen) < count:
        apart = np.linalg.norm(drawn[:, None] - np.array(chosen), axis=-1).min(axis=1)
        chosen.append(drawn[int(np.argmax(apart))])
    return np.array(chosen)


def seen_postures(
    arm: Arm, rig: Rig | None, count: int, seed: int, *, spread: float = SPREAD, before: float = 0.0
) -> Array:
    """Draw up to ``count`` postures (C, n) [rad] around the rest posture in which the board is seen and nothing met.

    Without a ``rig`` nobody knows where it is seen. ``before``: as in `choose_postures`.
    """
    rng, room = np.random.default_rng(seed), _ROOM + before
    low, high = np.maximum(arm.lower + room, arm.rest - spread), np.minimum(arm.upper - room, arm.rest + spread)
    found, enough = [np.zeros((0, arm.joints))], 0
    for _ in range(_TRIES):
        drawn = rng.uniform(low, high, (_DRAWS, arm.joints))
        tool = tcp_position(arm, drawn)
        near = ((tool > arm.targets.lower - _AROUND) & (tool < arm.targets.upper + _AROUND)).all(axis=-1)
        drawn = drawn[near & (heights(arm, drawn)[:, 1:].min(axis=-1) > arm.floor)]
        drawn = drawn if rig is None else drawn[rig.shows(tcp_pose(arm, drawn))]
        for away in (0.0, before, -before) if before else (0.0,):
            drawn = drawn[(heights(arm, drawn - away)[:, 1:].min(axis=-1) > arm.floor)]
            drawn = drawn[~collides(arm, frames(arm, drawn - away))]
        found.append(drawn)
        enough += len(drawn)
        if enough >= count:
            break
    return np.concatenate(found)[:count]


def _greedy(slope: Array, spread: Array, count: int) -> list[int]:
    """Rows that narrow ``spread`` (p, p) most, one after the other, by their derivatives (C, 6, p)."""
    chosen: list[int] = []
    for _ in range(count):
        told = slope @ spread
        inner = np.eye(6) + told @ np.swapaxes(slope, -1, -2)
        gain = np.linalg.slogdet(inner)[1]
        gain[chosen] = -np.inf
        best = int(np.argmax(gain))
        chosen.append(best)
        spread = spread - told[best].T @ np.linalg.solve(inner[best], told[best])
    return chosen
