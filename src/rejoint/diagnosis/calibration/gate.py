"""What measurements say about points that a fit has not seen: whether to use it, and which of them look wrong."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.workspace import reach
from rejoint.diagnosis.calibration.framing import align
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.model import floor_of
from rejoint.diagnosis.calibration.solver import CalibrationProblem, Fitted, solve

FOLDS = 12
"""Postures are left out one by one up to so many, in so many groups beyond (chosen: time)"""
SURE = 1.3
"""Standard errors by which a correction must help at points left out to be used (chosen: nine in ten)"""
LEAST = 1e-4
"""[m] least gain that is worth a correction (chosen)"""
ASTRAY = 0.04
"""Share of an arm's summed link lengths: what leaves more at over a fifth of the points left out, 21 mm on a myCobot,
describes no arm that measures its targets so, but points in other units, columns or frames (chosen: 14 times what a
worn arm is left with, and a third of what such mistakes leave, at the least)"""
SAME = np.radians(0.5)
"""[rad] rows all of whose joints are so near are of one posture, whatever they are numbered (chosen: postures of a plan
are tens of degrees apart, visits of one from two sides have one number)"""
WRONG = 2.9
"""Standard deviations of a normal distribution whose chance is that of a right point being called wrong (chosen: of
ten right points, one arm in fifty has one)"""
DISTURBED = (
    "So many do not fit that something changed between them: a horn that slipped, an encoder that jumped, an arm or a "
    "camera that was moved. Look at the arm, and measure all of them again."
)
"""What is said where `disturbed` holds"""


@dataclass(frozen=True, kw_only=True, eq=False)
class LeftOut:
    """Every measured point, predicted from those of other postures."""

    before: Array
    """(M,) [m] distance of the point from where the encoders say the tool is"""
    after: Array
    """(M,) [m] distance from where the calibration on the others says it is"""
    surprise: Array
    """(M,) squared distance by its predicted covariance: chi-squared, of as many degrees as there are coordinates"""

    def helps(self, arm: Arm, measured: Measurements) -> bool:
        """Tell whether the correction is clearly nearer than the encoders."""
        postures = np.unique(measured.posture)
        gain = np.array([(self.before - self.after)[measured.posture == p].mean() for p in postures])
        noise = float((measured.sigma**2).mean() + floor_of(arm) ** 2)
        spread = max(noise, float(gain.var(ddof=1)) if len(gain) > 1 else 0.0)
        if astray(arm, self.after):
            return False
        return bool(gain.mean() > max(SURE * np.sqrt(spread / len(gain)), LEAST))

    def suspects(self, known: NDArray[np.bool_]) -> tuple[int, ...]:
        """Rows, the worst first, whose points (M, 3), ``known`` where measured, do not fit to the others."""
        freedom = known.sum(axis=1)
        excess = self.surprise / np.array([chi_squared(int(count), WRONG) for count in freedom])
        return tuple(int(i) for i in np.argsort(-excess) if excess[i] > 1.0)


def astray(arm: Arm, after: Array) -> bool:
    """Tell whether the errors ``after`` (M,) [m] at points left out are so large that the points cannot be right.

    A fifth of them may be: a slip of the pen at a single point is named, and spoils no other.
    """
    return bool(np.quantile(after, 0.8, method="lower") > ASTRAY * reach(arm))


def disturbed(suspects: tuple[int, ...], points: int) -> bool:
    """Tell whether so many of ``points`` do not fit to the others that it is not they that are wrong.

    From three and a quarter of them on: mistakes of a hand come one at a time.
    """
    return len(suspects) >= max(3, points / 4)


def merge_repeats(measured: Measurements) -> Measurements:
    """Return the same measurements with one number for rows of one posture: those do not test one another."""
    number = measured.posture.copy()
    for row in range(1, len(measured)):
        near = np.abs(measured.position[:row] - measured.position[row]).max(axis=1) < SAME
        if near.any():
            number[row] = number[int(np.argmax(near))]
    return measured if (number == measured.posture).all() else replace(measured, posture=number)


def leave_out(problem: CalibrationProblem, fitted: Fitted) -> LeftOut:
    """Predict every point from fits that have not seen any of its posture."""
    m = problem.measurements
    count = len(m)
    before, after, surprise = np.zeros(count), np.zeros(count), np.zeros(count)
    for out in folds(m.posture):
        rows = np.flatnonzero(out)
        others = m.rows(~out)
        refit = solve(replace(problem, measurements=others), fitted.vector)
        held = replace(problem, measurements=m.rows(out))
        residual, slope = held.residual(refit.vector)
        total = held.noise(refit.vector) + slope @ refit.covariance @ np.swapaxes(slope, -1, -2)
        after[rows] = np.linalg.norm(residual, axis=1)
        surprise[rows] = np.einsum("mi,mi->m", residual, np.linalg.solve(total, residual[..., None])[..., 0])
        before[rows] = np.linalg.norm(_uncorrected(problem.arm, problem, others, held.measurements), axis=1)
    return LeftOut(before=before, after=after, surprise=surprise)


def folds(posture: NDArray[np.int64]) -> list[NDArray[np.bool_]]:
    """Rows (M,) that are left out together."""
    numbers = np.unique(posture)
    groups = np.arange(len(numbers)) % min(FOLDS, len(numbers))
    return [np.isin(posture, numbers[groups == group]) for group in np.unique(groups)]


def chi_squared(freedom: int, deviations: float) -> float:
    """Quantile of chi-squared at that of a normal distribution (Wilson and Hilferty 1931)."""
    if freedom == 0:
        return np.inf
    spread = 2.0 / (9.0 * freedom)
    return float(freedom * (1.0 - spread + deviations * np.sqrt(spread)) ** 3)


def _uncorrected(arm: Arm, problem: CalibrationProblem, others: Measurements, held: Measurements) -> Array:
    """Residuals (M, 3) [m] of the encoders' own forward kinematics, zero where nothing was measured."""
    pose = align(arm, others) if problem.layout.frame else problem.frame
    seen = (tcp_position(arm, held.position) - pose[:3, 3]) @ pose[:3, :3]
    return np.where(np.isfinite(held.point), seen - held.point, 0.0)
