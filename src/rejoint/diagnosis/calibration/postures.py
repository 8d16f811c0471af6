"""Postures to measure at: those that tell most, in order, and what error they leave, before anything was measured.

Chosen one by one among candidates in the region of targets, each for the largest gain of information on all parameters
together with those before it (D-optimal design; Atkinson and Donev, Optimum Experimental Designs, 1992, chapter 11).
Every posture is come to from a posture some degrees away, so that each joint's last motion is known; the joints of one
visit come from sides of their own, and the next visit of the posture comes from the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, collides, frames, heights, solve_position
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.size import length_size
from rejoint.arms.workspace import rising_frames
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import earlier
from rejoint.diagnosis.calibration.model import floor_of, linearised, scatter
from rejoint.diagnosis.calibration.parameters import Belief, Case, Layout, belief, displacement_of
from rejoint.system.errors import InputError

CANDIDATES = 300
"""Postures to choose from (chosen: twice as many gain 1 % of information)"""
AROUND = np.radians(30.0)
"""[rad] how far candidates start from the rest posture, so that one point is met in several postures (chosen)"""
BEFORE = np.radians(6.0)
"""[rad] distance of the posture that each is come to from, joint by joint (chosen: three times the play)"""
MARGIN = 0.05
"""Part of a joint's range that is kept from each limit (chosen)"""
CLEARANCE = 0.03
"""[m] least height above the floor of the guard on an arm of the reach of a myCobot 280: worn arms sag (chosen)"""
ENOUGH = 1.1
"""Expected error by that of all suggested points at which fewer suffice (chosen)"""
_REGION = 64  # targets over which the error is expected (chosen)


@dataclass(frozen=True, kw_only=True, eq=False)
class Suggestion:
    """Postures to visit one after the other."""

    postures: Array
    """(K, n) [rad]"""
    approach: Array
    """(K, n) [rad] where each is come to from"""
    posture: NDArray[np.int64]
    """(K,) number of the posture: visits of the same one from different sides have the same"""
    expected: Array
    """(K + 1,) [m] root mean square true error in the region of targets that is left after so many"""

    @property
    def fewest(self) -> int:
        """How many of them suffice: more gain less than a tenth."""
        return int(np.argmax(self.expected <= ENOUGH * self.expected[-1]))


def suggest(
    arm: Arm, count: int, *, visits: int = 1, sigma: float = 5e-4, prior: Calibration | None = None,
    gravity: Array = GRAVITY, seed: int = 0,
) -> Suggestion:  # fmt: skip
    """Choose ``count`` visits for measurements of standard deviation ``sigma`` [m] on each coordinate.

    Each posture is visited ``visits`` (1 or 2) times, from opposite sides. ``prior`` is what is known already.
    InputError where the region of targets has too few postures that are free.
    """
    layout = Layout(joints=arm.joints)
    known = earlier(arm, layout, prior) if prior is not None else belief(arm, layout, Case(twist=1.0), gravity)
    postures, sides = _candidates(arm, seed)
    if len(postures) * visits < count:
        raise InputError(
            f"arm {arm.name}: only {len(postures)} of {CANDIDATES} postures in the region of targets are free of limits, "
            f"floor and collisions, {count} are to be measured; ask for fewer, or give the arm another region of targets"
        )
    signs = [sides] if visits == 1 else [sides, -sides]
    slopes, noises = zip(*(_seen(arm, known, postures, side, sigma) for side in signs), strict=True)
    covariance, region = np.linalg.inv(known.precision), _region(arm, known)
    chosen: list[tuple[int, int]] = []
    expected = [_expected(region, covariance)]
    while len(chosen) < count:
        best = chosen[-1][0] if len(chosen) % visits else _most_telling(slopes[0], noises[0], covariance, chosen)
        visit = len(chosen) % visits
        slope, noise = slopes[visit][best], noises[visit][best]
        gain = covariance @ slope.T @ np.linalg.inv(slope @ covariance @ slope.T + noise)
        covariance = covariance - gain @ slope @ covariance
        chosen.append((best, visit))
        expected.append(_expected(region, covariance))
    places = np.array([place for place, _ in chosen])
    came = np.array([signs[visit][place] for place, visit in chosen])
    return Suggestion(
        postures=postures[places], approach=postures[places] - BEFORE * came,
        posture=np.unique(places, return_inverse=True)[1], expected=np.array(expected),
    )  # fmt: skip


def _candidates(arm: Arm, seed: int) -> tuple[Array, Array]:
    """Free postures (C, n) [rad] with the tool in the region of targets, and the sides (C, n) they are come to from."""
    rng = np.random.default_rng(seed)
    points = arm.targets.sample(rng, (CANDIDATES,))
    starts = np.clip(arm.rest + rng.uniform(-AROUND, AROUND, (CANDIDATES, arm.joints)), arm.lower, arm.upper)
    solution = solve_position(arm, points, starts, rest_gain=0.0)
    sides = rng.choice([-1.0, 1.0], solution.q.shape)
    good = solution.converged
    for away in (0.0, BEFORE, -BEFORE):
        good = good & _free(arm, solution.q - away * sides)
    return solution.q[good], sides[good]


def _free(arm: Arm, q: Array) -> NDArray[np.bool_]:
    """Tell which postures (C, n) keep clear of limits, floor and collisions."""
    room = MARGIN * (arm.upper - arm.lower)
    inside = ((q > arm.lower + room) & (q < arm.upper - room)).all(axis=1)
    moving = np.append(rising_frames(arm), True)
    above = (heights(arm, q)[:, moving] > arm.floor + CLEARANCE * length_size(arm)).all(axis=1)
    return np.asarray(inside & above & ~collides(arm, frames(arm, q)))


def _seen(arm: Arm, known: Belief, postures: Array, sides: Array, sigma: float) -> tuple[Array, Array]:
    """What measurements tell: derivatives (C, 3, k) and covariances (C, 3, 3) of the tool."""
    layout = Layout(joints=arm.joints)
    _, slope = linearised(arm, layout, known.mean, postures, postures - BEFORE * sides)
    noise = scatter(arm, displacement_of(layout, known.mean), postures)
    return slope, noise + (sigma**2 + floor_of(arm) ** 2) * np.eye(3)


def _region(arm: Arm, known: Belief) -> tuple[Array, Array]:
    """Derivatives (R, 3, k) of the tool in the region of targets, and the covariances (R, 3, 3) that stay."""
    points = arm.targets.sample(np.random.default_rng(0), (_REGION,))
    slope, noise = _seen(arm, known, solve_position(arm, points, arm.rest).q, np.zeros(arm.joints), 0.0)
    return slope, noise


def _most_telling(slope: Array, noise: Array, covariance: Array, chosen: list[tuple[int, int]]) -> int:
    """Return the candidate that adds most to the determinant of the information."""
    gain = np.linalg.slogdet(np.eye(3) + np.linalg.solve(noise, slope @ covariance @ np.swapaxes(slope, -1, -2)))[1]
    gain[[place for place, _ in chosen]] = -np.inf
    return int(np.argmax(gain))


def _expected(region: tuple[Array, Array], covariance: Array) -> float:
    slope, noise = region
    total = slope @ covariance @ np.swapaxes(slope, -1, -2) + noise
    return float(np.sqrt(np.trace(total, axis1=1, axis2=2).mean()))
