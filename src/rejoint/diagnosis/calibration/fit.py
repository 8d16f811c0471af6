"""From measurements to a calibration: the likeliest prior, cross-validated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist
from scipy.special import chdtri, ndtr

from rejoint.arms import Arm, Array, Mask
from rejoint.arms.workspace import reach
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.measurements import Measurements, align
from rejoint.diagnosis.calibration.parameters import (
    ANYWHERE,
    ASKEW,
    Belief,
    DisplacementLayout,
    PriorCase,
    belief,
    floor_of,
    vector_of,
)
from rejoint.diagnosis.calibration.solver import Fitted, ToolProblem, search, solve
from rejoint.system.errors import InputError

FOLDS = 12
"""Groups for cross-validation; chosen for time"""
SURE = 1.3
"""Standard errors by which a correction must help; chosen"""
LEAST = 1e-4
"""[m] least useful gain; chosen"""
ASTRAY = 0.04
"""Error over summed link lengths of wrong units, columns or frames; chosen"""
SAME = np.radians(0.5)
"""[rad] within which rows are of one posture; chosen"""
WRONG = 2.9
"""Standard deviations of a suspect point; chosen"""
DISTURBED = (
    "So many do not fit that something changed between them: a horn that slipped, an encoder that jumped, an arm or a "
    "camera that was moved. Look at the arm, and measure all of them again."
)


def helps(arm: Arm, measured: Measurements, before: Array, after: Array) -> bool:
    """Whether the correction is clearly better at points left out: errors (M,) [m] without and with it."""
    numbers = np.unique(measured.posture)
    gain = np.array([(before - after)[measured.posture == number].mean() for number in numbers])
    noise = float((measured.sigma**2).mean() + floor_of(arm) ** 2)
    spread = max(noise, float(gain.var(ddof=1)) if len(gain) > 1 else 0.0)
    return not astray(arm, after) and bool(gain.mean() > max(SURE * np.sqrt(spread / len(gain)), LEAST))


def suspects_of(surprise: Array, known: Mask) -> tuple[int, ...]:
    """Rows that do not fit the others, the worst first, by chi-squared (M,); ``known`` (M, 3) where measured."""
    freedom = known.sum(axis=1)
    excess = surprise / np.where(freedom > 0, chdtri(np.maximum(freedom, 1), ndtr(-WRONG)), np.inf)
    return tuple(int(i) for i in np.argsort(-excess) if excess[i] > 1.0)


def astray(arm: Arm, after: Array) -> bool:
    """Whether over a fifth of the errors (M,) [m] are too large."""
    return bool(np.quantile(after, 0.8, method="lower") > ASTRAY * reach(arm))


def disturbed(suspects: tuple[int, ...], points: int) -> bool:
    """Whether so many do not fit that the setup has moved."""
    return len(suspects) >= max(3, points / 4)


def merge_repeats(measured: Measurements) -> Measurements:
    """Give rows of the same posture one number."""
    near = cdist(measured.position, measured.position, "chebyshev") < SAME
    same = near | (measured.posture[:, None] == measured.posture)
    return replace(measured, posture=connected_components(same)[1])


def leave_out(problem: ToolProblem, fitted: Fitted) -> Array:
    """Predict postures from the others: (3, M).

    Distances [m] from the encoders' and from the calibration's tool, and the squared Mahalanobis distance.
    """
    found, numbers = np.zeros((3, len(problem.posture))), np.unique(problem.posture)
    for group in range(min(FOLDS, len(numbers))):
        out = np.isin(problem.posture, numbers[group::FOLDS])
        refit, held = solve(problem.rows(~out), fitted.vector), problem.rows(out)
        off, slope = held.misfit(refit.vector)[:, :3], held.slope(refit.vector)[:, :3]
        total = held.noise(refit.vector)[:, :3, :3] + slope @ refit.covariance @ np.swapaxes(slope, -1, -2)
        before = np.linalg.norm(problem.uncorrected(out, fitted.vector)[:, :3], axis=1)
        surprise = np.einsum("mi,mi->m", off, np.linalg.solve(total, off[..., None])[..., 0])
        found[:, out] = before, np.linalg.norm(off, axis=1), surprise
    return found


CASES = (
    PriorCase(),
    PriorCase(play=np.radians(0.15), play_sigma=np.radians(0.15), compliance=0.003),
    PriorCase(tilt=ASKEW, odds=-0.5),
    PriorCase(twist=1.0, odds=-1.0),
)
"""A worn arm, a healthy one, a tilted base, and inexact links"""
AGE = 0.3
"""Change since an earlier calibration, in sigmas of the prior; chosen"""

LINKS_FROM = 5
"""Postures from which links are fitted; chosen"""


def fit(arm: Arm, measurements: Measurements, *, prior: Calibration | None = None, date: str = "") -> Calibration:
    """Fit a displacement to ``measurements`` and test it on points left out.

    ``prior``: an earlier calibration; ContractError for another arm's. InputError for unusable measurements.
    """
    if measurements.position.shape[1] != arm.joints:
        raise InputError(
            f"measurements of {measurements.position.shape[1]} joints, the arm {arm.name} has {arm.joints}; take those "
            "of this arm"
        )
    if not np.isfinite(measurements.point).any():
        raise InputError("measurements: no coordinate was measured; expected at least one")
    measurements, foreign = merge_repeats(measurements), measurements.frame != "base"
    seen = np.tile(np.eye(4), (len(measurements), 1, 1))
    seen[:, :3, 3] = np.nan_to_num(measurements.point)
    beliefs = beliefs_of(arm, measurements.posture, prior, ANYWHERE**-2.0 * np.eye(6 * foreign))
    problem = ToolProblem(
        arm=arm,
        belief=beliefs[0],
        seen=seen,
        by_lens=np.zeros((len(seen), 6, 0)),
        known=np.isfinite(np.pad(measurements.point, ((0, 0), (0, 3)), constant_values=np.nan)),
        spread=measurements.sigma[:, None, None] ** 2 * np.eye(6),
        position=measurements.position,
        posture=measurements.posture,
        frame=align(arm, measurements) if foreign else np.eye(4),
        mounted=np.eye(4),
    )
    return judged(*likeliest(problem, beliefs), measurements, date)


def beliefs_of(arm: Arm, posture: NDArray[np.int64], prior: Calibration | None, outside: Array) -> list[Belief]:
    """Priors for rows of numbered postures (M,); ``outside``: see `belief`."""
    if prior is not None:
        prior.require(arm)
        return [earlier(arm, prior, outside)]
    few = len(np.unique(posture)) < LINKS_FROM
    return [belief(arm, case, outside) for case in CASES if not (case.twist and few)]


def earlier(arm: Arm, prior: Calibration, outside: Array | None = None) -> Belief:
    """Earlier calibration as prior, widened by `AGE`."""
    layout = DisplacementLayout(joints=arm.joints)
    body, links = slice(0, layout.body), prior.displacement.twist.any()
    found = belief(arm, PriorCase(twist=1.0 if links else 0.0), outside)
    usual = 1.0 / np.diag(belief(arm, PriorCase()).precision)
    found.mean[body] = vector_of(layout, prior.displacement)
    found.precision[body, body] = np.linalg.inv(prior.covariance + AGE**2 * np.diag(usual))
    return found


def likeliest(problem: ToolProblem, beliefs: list[Belief]) -> tuple[ToolProblem, Fitted]:
    """Solve a problem under each prior; return the likeliest."""
    tried = [replace(problem, belief=one) for one in beliefs]
    return max(zip(tried, map(search, tried), strict=True), key=lambda each: each[1].evidence + each[0].belief.odds)


def judged(problem: ToolProblem, fitted: Fitted, measured: Measurements, date: str) -> Calibration:
    """Make a calibration of a fit, tested on rows left out."""
    body, (before, after, surprise) = slice(0, problem.layout.body), leave_out(problem, fitted)
    return Calibration(
        arm=problem.arm,
        displacement=problem.displacement(fitted.vector),
        covariance=fitted.covariance[body, body],
        frame=problem.outside(fitted.vector)[0],
        frame_name=measured.frame,
        source=measured.source,
        date=date,
        points=len(measured),
        before=float(before.mean()),
        after=float(after.mean()),
        used=helps(problem.arm, measured, before, after),
        floor=floor_of(problem.arm),
        suspects=suspects_of(surprise, problem.known[:, :3]),
        left_out=np.stack([before, after], axis=-1),
    )
