"""Postures to measure at, the most informative first.

Each lessens the tool's variance most (I-optimal design; Atkinson and Donev, Optimum Experimental Designs, 1992, chapter
10). Joints approach alternately from below and above.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Mask, collides, gravity_torque, heights, solve_position
from rejoint.arms.displacement import FLOATING
from rejoint.arms.postures import comfortable_postures
from rejoint.arms.workspace import length_size, rising_frames
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import earlier
from rejoint.diagnosis.calibration.parameters import (
    PLAY,
    PLAY_SIGMA,
    Belief,
    DisplacementLayout,
    PriorCase,
    belief,
    displacement_of,
    floor_of,
    linearised,
    scatter,
)
from rejoint.system.errors import InputError

CANDIDATES = 300
"""Postures to choose from; chosen"""
BEFORE = np.radians(6.0)
"""[rad] of each approach; chosen: three times the play"""
MARGIN = 0.05
"""Part of a joint's range kept from each limit; chosen"""
CLEARANCE = 0.03
"""[m] above the floor at a myCobot 280's reach; chosen: worn arms sag"""
WITHIN = 100
"""Candidates in the region of targets; chosen"""
LINKS = 0.3
"""Scale of the links' errors for the choice; chosen: little is lost with exact links"""
_WIDEST = PLAY + 2.0 * PLAY_SIGMA  # [rad] play that a joint may have
_PLACES = 32  # postures in the region of targets, and as many elsewhere, over which the error is expected (chosen)


@dataclass(frozen=True, kw_only=True, eq=False)
class Suggestion:
    """Postures to visit in order."""

    postures: Array
    """(K, n) [rad]"""
    posture: NDArray[np.int64]
    """(K,) visits of one posture share a number"""

    @property
    def digest(self) -> str:
        """Digest of the postures, to a microradian."""
        return hashlib.sha256(np.round(1e6 * self.postures).astype("<i8").tobytes()).hexdigest()[:16]


def before(posture: Array, visit: int) -> Array:
    """Where visit number ``visit`` comes to a ``posture`` (n,) [rad] from: from below and from above, in turn."""
    return posture - BEFORE * (-1.0) ** visit


def suggest(
    arm: Arm,
    count: int,
    *,
    visits: int = 2,
    sigma: float = 5e-4,
    prior: Calibration | None = None,
    seed: int = 0,
) -> Suggestion:
    """Choose ``count`` visits for measurements of ``sigma`` [m] per coordinate, ``visits`` (1 or 2) per posture.

    InputError for too few free postures.
    """
    known = earlier(arm, prior) if prior is not None else belief(arm, PriorCase(twist=LINKS))
    postures = np.concatenate(_candidates(arm, seed))
    if len(postures) * visits < count:
        raise InputError(
            f"arm {arm.name}: only {len(postures)} postures are free of limits, floor and collisions, {count} are to "
            "be measured; ask for fewer"
        )
    slopes, noises = _seen(arm, known, postures, sigma)
    covariance: Array = np.asarray(np.linalg.inv(known.precision), dtype=float)
    places = [np.random.default_rng(0).permutation(one)[:_PLACES] for one in _candidates(arm, seed + 1)]
    region = _seen(arm, known, np.concatenate(places), 0.0)[0]
    weight = np.einsum("pik,pil->kl", region, region)
    chosen: list[int] = []
    while len(chosen) < count:
        again = len(chosen) % visits > 0
        best = chosen[-1] if again else _most_telling(slopes, noises, covariance, weight, chosen)
        covariance = narrowed(covariance, slopes[best], noises[best])
        chosen.append(best)
    return Suggestion(postures=postures[chosen], posture=np.unique(chosen, return_inverse=True)[1])


def _candidates(arm: Arm, seed: int) -> tuple[Array, Array]:
    """Free postures (C, n) [rad] in the region of targets, and elsewhere, approachable from both sides."""
    rng = np.random.default_rng(seed)
    solution = solve_position(arm, arm.targets.sample(rng, (CANDIDATES,)), arm.rest)
    inside, anywhere = solution.q[solution.converged], comfortable_postures(arm)
    most = np.abs(gravity_torque(arm, inside)).max(axis=0, initial=FLOATING)
    ways = np.stack([anywhere - BEFORE, anywhere, anywhere + BEFORE])
    light = anywhere[(np.abs(gravity_torque(arm, ways)) <= most).all(axis=(0, 2))]
    within = _approachable(arm, inside)[:WITHIN]
    return within, _approachable(arm, rng.permutation(light))[: CANDIDATES - len(within)]


def _approachable(arm: Arm, q: Array) -> Array:
    """Those of postures (C, n) [rad] that are free, and from both sides, where no joint may rest on either flank."""
    free = [_free(arm, q - away) for away in (0.0, BEFORE, -BEFORE)]
    loads = [gravity_torque(arm, q + side * 0.5 * _WIDEST) for side in (1.0, -1.0)]
    either = (np.minimum(*loads) < -FLOATING) & (np.maximum(*loads) > FLOATING)
    return q[np.logical_and.reduce(free) & ~either.any(axis=1)]


def _free(arm: Arm, q: Array) -> Mask:
    """Which postures (C, n) keep clear of limits, floor and collisions."""
    room = MARGIN * (arm.upper - arm.lower)
    inside = ((q > arm.lower + room) & (q < arm.upper - room)).all(axis=1)
    moving = np.append(rising_frames(arm), True)
    above = (heights(arm, q)[:, moving] > arm.floor + CLEARANCE * length_size(arm)).all(axis=1)
    return inside & above & ~collides(arm, q)


def _seen(arm: Arm, known: Belief, postures: Array, sigma: float) -> tuple[Array, Array]:
    """Return derivatives (C, 3, k) and covariances (C, 3, 3) of the tool."""
    layout = DisplacementLayout(joints=arm.joints)
    slope = linearised(arm, layout, known.mean, postures)[1][:, :3]
    believed = displacement_of(layout, known.mean)
    variance = np.diag(np.linalg.inv(known.precision))[layout.at("play")]
    noise = scatter(arm, replace(believed, play=np.hypot(believed.play, np.sqrt(variance))), postures)
    return slope, noise[:, :3, :3] + (sigma**2 + floor_of(arm) ** 2) * np.eye(3)


def _most_telling(slope: Array, noise: Array, covariance: Array, weight: Array, chosen: list[int]) -> int:
    """Candidate that lessens the trace of ``weight`` (k, k) times ``covariance`` (k, k) most.

    Candidates have ``slope`` (C, d, k) and ``noise`` (C, d, d).
    """
    told = slope @ covariance
    gain = np.linalg.solve(told @ np.swapaxes(slope, -1, -2) + noise, told @ weight @ np.swapaxes(told, -1, -2))
    variance = np.trace(gain, axis1=1, axis2=2)
    variance[chosen] = -np.inf
    return int(np.argmax(variance))


def narrowed(covariance: Array, slope: Array, noise: Array) -> Array:
    """Return the ``covariance`` (k, k) after a measurement with derivative (d, k)."""
    told = covariance @ slope.T
    return covariance - told @ np.linalg.solve(slope @ told + noise, told.T)
