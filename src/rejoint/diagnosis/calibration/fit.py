"""From measurements to a calibration: the likeliest prior, cross-validated."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri, ndtr

from rejoint.arms import Arm, Array
from rejoint.arms.workspace import reach
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.measurements import Measurements, align
from rejoint.diagnosis.calibration.parameters import (
    ASKEW,
    LEVEL,
    Belief,
    DisplacementLayout,
    PriorCase,
    belief,
    floor_of,
    vector_of,
)
from rejoint.diagnosis.calibration.solver import CalibrationProblem, Fittable, Fitted, search, solve
from rejoint.system.errors import InputError

P = TypeVar("P", bound=Fittable)

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


@dataclass(frozen=True, kw_only=True, eq=False)
class LeftOut:
    """Points, predicted from those of other postures."""

    before: Array
    """(M,) [m] distance from the encoders' tool"""
    after: Array
    """(M,) [m] distance from the calibration's tool"""
    surprise: Array
    """(M,) squared Mahalanobis distance: chi-squared"""

    def helps(self, arm: Arm, measured: Measurements) -> bool:
        """Whether the correction is clearly better."""
        postures = np.unique(measured.posture)
        gain = np.array([(self.before - self.after)[measured.posture == p].mean() for p in postures])
        noise = float((measured.sigma**2).mean() + floor_of(arm) ** 2)
        spread = max(noise, float(gain.var(ddof=1)) if len(gain) > 1 else 0.0)
        if astray(arm, self.after):
            return False
        return bool(gain.mean() > max(SURE * np.sqrt(spread / len(gain)), LEAST))

    def suspects(self, known: NDArray[np.bool_]) -> tuple[int, ...]:
        """Rows that do not fit the others, the worst first; ``known`` (M, 3) where measured."""
        freedom = known.sum(axis=1)
        excess = self.surprise / np.where(freedom > 0, chdtri(np.maximum(freedom, 1), ndtr(-WRONG)), np.inf)
        return tuple(int(i) for i in np.argsort(-excess) if excess[i] > 1.0)


def astray(arm: Arm, after: Array) -> bool:
    """Whether over a fifth of the errors (M,) [m] are too large."""
    return bool(np.quantile(after, 0.8, method="lower") > ASTRAY * reach(arm))


def disturbed(suspects: tuple[int, ...], points: int) -> bool:
    """Whether so many do not fit that the setup has moved."""
    return len(suspects) >= max(3, points / 4)


def merge_repeats(measured: Measurements) -> Measurements:
    """Give rows of the same posture one number."""
    number = measured.posture.copy()
    for row in range(1, len(measured)):
        near = np.abs(measured.position[:row] - measured.position[row]).max(axis=1) < SAME
        if near.any():
            number[row] = number[int(np.argmax(near))]
    return measured if (number == measured.posture).all() else replace(measured, posture=number)


def leave_out(problem: Fittable, fitted: Fitted) -> LeftOut:
    """Predict postures from the others, with and without displacement."""
    before, after, surprise = np.zeros((3, len(problem.postures)))
    for out in folds(problem.postures):
        refit, held = solve(problem.rows(~out), fitted.vector), problem.rows(out)
        residual, slope = held.residual(refit.vector)
        total = held.noise(refit.vector) + slope @ refit.covariance @ np.swapaxes(slope, -1, -2)
        off = residual[:, :3]
        after[out] = np.linalg.norm(off, axis=1)
        surprise[out] = np.einsum("mi,mi->m", off, np.linalg.solve(total[:, :3, :3], off[..., None])[..., 0])
        before[out] = np.linalg.norm(problem.uncorrected(out, fitted.vector)[:, :3], axis=1)
    return LeftOut(before=before, after=after, surprise=surprise)


def folds(posture: NDArray[np.int64]) -> list[NDArray[np.bool_]]:
    """Return groups of rows (M,) to leave out."""
    numbers = np.unique(posture)
    groups = np.arange(len(numbers)) % min(FOLDS, len(numbers))
    return [np.isin(posture, numbers[groups == group]) for group in np.unique(groups)]


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
    measurements = merge_repeats(measurements)
    foreign = measurements.frame != "base"
    layout = DisplacementLayout(joints=arm.joints, frame=foreign)
    frame = align(arm, measurements) if foreign else np.eye(4)
    beliefs = beliefs_of(arm, layout, prior, len(np.unique(measurements.posture)))
    problem, fitted = likeliest(
        CalibrationProblem(arm=arm, layout=layout, belief=beliefs[0][0], measurements=measurements, frame=frame),
        beliefs,
    )
    return judged(problem, fitted, measurements, date)


def beliefs_of(
    arm: Arm, layout: DisplacementLayout, prior: Calibration | None, postures: int
) -> list[tuple[Belief, float]]:
    """Priors for so many ``postures``, with log odds."""
    if prior is not None:
        prior.require(arm)
        return [(earlier(arm, layout, prior), 0.0)]
    cases = [case for case in CASES if not (case.twist and postures < LINKS_FROM)]
    return [(belief(arm, layout, case), case.odds) for case in cases]


def earlier(arm: Arm, layout: DisplacementLayout, prior: Calibration) -> Belief:
    """Earlier calibration as prior, widened by `AGE`."""
    base = belief(arm, layout, PriorCase())
    drift = AGE**2 / np.diag(base.precision)
    body, mean = slice(0, layout.body), base.mean.copy()
    mean[body] = vector_of(DisplacementLayout(joints=arm.joints), prior.displacement)
    lower, upper, links = base.lower.copy(), base.upper.copy(), layout.at("twist")
    if prior.displacement.twist.any():
        lower[links], upper[links] = -np.inf, np.inf
    precision = base.precision.copy()
    precision[body, body] = np.linalg.inv(prior.covariance + np.diag(drift[body]))
    return Belief(mean=mean, precision=precision, lower=lower, upper=upper)


def likeliest(problem: P, beliefs: Sequence[tuple[Belief, float]]) -> tuple[P, Fitted]:
    """Solve a problem under each prior with its log odds; return the likeliest."""
    solved = []
    for one, odds in beliefs:
        own, tilt = replace(problem, belief=one), problem.layout.at("tilt").start
        askew = one.precision[tilt, tilt] < LEVEL**-2.0 / 2
        fitted = search(own) if askew else solve(own, one.mean)
        solved.append((fitted.evidence + odds, own, fitted))
    return max(solved, key=lambda each: each[0])[1:]


def judged(problem: Fittable, fitted: Fitted, measured: Measurements, date: str) -> Calibration:
    """Make a calibration of a fit, tested on rows left out."""
    body, tried = slice(0, problem.layout.body), leave_out(problem, fitted)
    return Calibration(
        arm=problem.arm,
        displacement=problem.displacement(fitted.vector),
        covariance=fitted.covariance[body, body],
        frame=fitted.frame,
        frame_name=measured.frame,
        source=measured.source,
        date=date,
        points=len(measured),
        before=float(tried.before.mean()),
        after=float(tried.after.mean()),
        used=tried.helps(problem.arm, measured),
        floor=floor_of(problem.arm),
        suspects=tried.suspects(problem.known[:, :3]),
        left_out=np.stack([tried.before, tried.after], axis=-1),
    )
