"""From measurements to a calibration: parameters of an arm, and of whatever measures it, cross-validated.

Maximum a posteriori by bounded least squares under each prior; the likeliest is taken. Noise of measuring, model and
floating joints; Huber's loss (1964).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist
from scipy.special import chdtri, ndtr

from rejoint.arms import Arm, Array, Displacement, Mask, jacobian
from rejoint.arms.rotations import difference, inverse, moved, pose_of
from rejoint.arms.workspace import reach
from rejoint.diagnosis.calibration.calibration import (
    ANYWHERE,
    ASKEW,
    NOTHING,
    SCATTER,
    Belief,
    Calibration,
    DisplacementLayout,
    PriorCase,
    belief,
    floor_of,
    scatter,
)
from rejoint.diagnosis.calibration.measurements import Measurements, align
from rejoint.system.errors import InputError
from rejoint.system.records import entity, taken
from rejoint.system.stopping import check

LEAST_PLAY = np.radians(0.05)
"""[rad] from which scatter tells play; chosen"""
SLIP, MOST_SLIPS = 30.0, 0.25
"""Residual [sigma] of an outlier, and their largest share; chosen"""
TURNED = np.radians(0.15)
"""[rad] unexplained turn of the tool; chosen"""
ITERATIONS = 40
_HUBER = 0.05  # share of normal residuals for which the loss is linear
_ROUNDS = 12  # of a descent with the noise and the weights as they were, at most
_SMALL = 1e-4  # relative gain of a step, or of a round, after which the fit ends
_STEP = 1e-6  # [m] and [rad] of numerical derivatives


@entity
class Fitted:
    """A solution and its uncertainty."""

    vector: Array
    """(k,)"""
    covariance: Array
    """(k, k)"""
    evidence: float
    """log marginal likelihood up to a constant (Laplace's approximation)"""


ROWS = ("seen", "by_lens", "known", "spread", "position", "posture")
"""Fields of `ToolProblem` with a row each"""


@entity
class ToolProblem:
    """What a device saw of the tool in R postures, and a prior.

    Unknown outside the arm: `frame`, then `mounted` (6 each: shift, turn), then a lens.
    """

    arm: Arm
    belief: Belief
    seen: Array
    """(R, 4, 4) what the tool carries, in the measuring frame; turned anyhow where only a point was measured"""
    by_lens: Array
    """(R, 6, lens) derivative of `seen` by the lens; of its inverse where ``inverted``"""
    known: Mask
    """(R, 6) which coordinates of shift and turn were measured"""
    spread: Array
    """(R, 6, 6) covariance of the tool's measured pose, base axes"""
    position: Array
    """(R, n) [rad] by encoders"""
    posture: NDArray[np.int64]
    """(R,) posture number of each"""
    frame: Array
    """(4, 4) pose of the measuring frame in the base, first estimate"""
    mounted: Array
    """(4, 4) pose of what the tool carries in the TCP frame, first estimate"""
    joint: float = 0.0
    """[rad] unexplained sigma of each joint"""
    inverted: bool = False
    """whether the tool carries the device: `seen` is the inverse of its picture"""

    @property
    def layout(self) -> DisplacementLayout:
        """Places in the vector."""
        return DisplacementLayout(self.arm)

    def rows(self, where: Mask) -> ToolProblem:
        """Problem of some rows."""
        return taken(self, ROWS, where)

    def outside(self, vector: Array) -> tuple[Array, Array, Array]:
        """Poses (..., 4, 4) of frame and mounting, and the lens's change, for the unknowns (..., k)."""
        # zeros for what is not unknown
        rest = np.append(vector, 0.0 * vector[..., :12], axis=-1)[..., self.layout.body :]
        frame, mounted, lens = np.split(rest, [6, 12], axis=-1)
        return moved(self.frame, frame), moved(self.mounted, mounted), lens[..., : self.by_lens.shape[-1]]

    def tool(self, vector: Array) -> Array:
        """Measured tool (..., R, 4, 4) in the measuring frame."""
        _, mounted, lens = self.outside(vector)
        change = np.einsum("rcl,...l->...rc", self.by_lens, lens)
        seen = moved(inverse(self.seen) if self.inverted else self.seen, change)
        return (inverse(seen) if self.inverted else seen) @ inverse(mounted)[..., None, :, :]

    def misfit(self, vector: Array) -> Array:
        """Predicted less measured shift [m] and turn [rad] (R, 6), axes of the measuring frame; 0: not measured."""
        return self._misfit(vector, self.layout.displacement(vector).tool_pose(self.arm, self.position))

    def slope(self, vector: Array) -> Array:
        """Return the derivative (R, 6, k) of `misfit`; by the turn as for small ones."""
        body, back = self.layout.body, np.kron(np.eye(2), self.outside(vector)[0][:3, :3]).T
        predicted, slope = self.layout.linearised(vector, self.position)
        by_arm = np.where(self.known[..., None], back @ slope, 0.0)

        *there, here = self._misfit(vector + _STEP * np.eye(len(vector) + 1)[body:, :-1], predicted)
        return np.concatenate([by_arm, *((one - here)[..., None] / _STEP for one in there)], axis=-1)

    def _misfit(self, vector: Array, predicted: Array) -> Array:
        off = difference(inverse(self.outside(vector)[0])[..., None, :, :] @ predicted, self.tool(vector))
        return np.where(self.known, off, 0.0)

    def noise(self, vector: Array) -> Array:
        """Covariance (R, 6, 6) of `misfit` for known parameters; 1 where not measured."""
        turn = np.kron(np.eye(2), self.outside(vector)[0][:3, :3])
        rest = np.diag([floor_of(self.arm) ** 2] * 3 + [TURNED**2] * 3)
        total = scatter(self.arm, self.layout.displacement(vector), self.position, self.joint) + rest + self.spread
        return np.where(self.known[:, :, None] & self.known[:, None, :], turn.T @ total @ turn, np.eye(6))

    def weighed(self, vector: Array) -> tuple[Array, Array, Array]:
        """Matrices (R, 6, 6) that whiten residuals, white residuals (R, 6), and Huber's weights (R,)."""
        whitener = np.linalg.inv(np.linalg.cholesky(self.noise(vector)))
        white = (whitener @ self.misfit(vector)[..., None])[..., 0]
        limit = np.sqrt(chdtri(np.maximum(self.known.sum(axis=1), 1), _HUBER))
        return whitener, white, np.minimum(1.0, limit / np.maximum(np.linalg.norm(white, axis=1), 1e-12))

    def by_scatter(self, vector: Array) -> tuple[Array, Array]:
        """Play (n,) [rad] of joints by how much the tool scatters where they float, and its precision (n,)."""
        whitener, white, weight = self.weighed(vector)
        shape, turn = self.layout.displacement(vector), np.kron(np.eye(2), self.outside(vector)[0][:3, :3])
        lever = whitener @ np.where(self.known[..., None], turn.T @ jacobian(self.arm, self.position), 0.0)
        share = 0.25 * SCATTER * shape.floats(self.arm, self.position)  # of the squared play in the variance
        size, pull = (lever**2).sum(axis=1), np.einsum("rcj,rc->rj", lever, white) ** 2
        weight = weight**2 / np.bincount(self.posture)[self.posture]  # an outlier tells little, a posture once
        play = np.maximum(shape.play, LEAST_PLAY)
        precision = np.maximum(2.0 * play**2 * (weight @ (share * size) ** 2), 1.0)  # Fisher's
        return play + play * (weight @ (share * (pull - size))) / precision, precision

    def uncorrected(self, out: Mask, start: Array) -> Array:
        """Misfit (r, 6) of rows ``out`` by encoders; the others fit what is outside the arm from ``start`` (k,)."""
        own, none = self.belief, self.layout.vector(Displacement.none(self.arm))
        held = {name: np.append(none, getattr(own, name)[len(none) :]) for name in ("mean", "lower", "upper")}
        rigid = replace(self, belief=replace(own, **held))  # type: ignore[arg-type]
        return rigid.rows(out).misfit(solve(rigid.rows(~out), start).vector)


def solve(problem: ToolProblem, start: Array) -> Fitted:
    """Iterate from ``start`` (k,), with the noise and the weights of the last iterate."""
    belief, vector = problem.belief, np.array(start, dtype=float)
    free, cost, root = belief.upper > belief.lower, np.inf, np.linalg.cholesky(belief.precision).T
    vector[~free] = belief.lower[~free]
    bounds = belief.lower[free], belief.upper[free]

    def whole(x: Array) -> Array:
        full = vector.copy()
        full[free] = x
        return full

    curvature = belief.precision.copy()
    for step in range(_ROUNDS if free.any() else 0):
        whitener, white, weight = problem.weighed(vector)
        slips = np.linalg.norm(white, axis=1) > SLIP
        if step and slips.sum() <= MOST_SLIPS * len(slips):
            weight = np.where(slips, 0.0, weight)
        whitener = whitener * np.sqrt(weight)[:, None, None]

        def residual(x: Array, whitener: Array = whitener) -> Array:
            check()
            white = whitener @ problem.misfit(whole(x))[..., None]
            return np.concatenate([white.ravel(), root @ (whole(x) - belief.mean)])

        def derivative(x: Array, whitener: Array = whitener) -> Array:
            slope = whitener @ problem.slope(whole(x))[..., free]
            return np.concatenate([slope.reshape(-1, free.sum()), root[:, free]])

        begin = np.clip(vector[free], *bounds)
        found = least_squares(
            residual, begin, derivative, bounds, x_scale="jac", max_nfev=ITERATIONS, ftol=_SMALL, xtol=_SMALL
        )
        vector, before, cost = whole(found.x), cost, found.cost
        curvature[np.ix_(free, free)] = found.jac.T @ found.jac
        if abs(before - cost) <= _SMALL * (1.0 + cost):
            break
    whitener, white, weight = problem.weighed(vector)
    off = vector - belief.mean
    cost = 0.5 * (weight * (2.0 - weight) * (white**2).sum(axis=1)).sum() + off @ belief.precision @ off
    spread = np.log(np.abs(np.diagonal(whitener, axis1=1, axis2=2))).sum()
    evidence = -cost + spread + 0.5 * (np.linalg.slogdet(belief.precision)[1] - np.linalg.slogdet(curvature)[1])
    return Fitted(vector=vector, covariance=np.asarray(np.linalg.inv(curvature), dtype=float), evidence=float(evidence))


def scattered(problem: ToolProblem, fitted: Fitted) -> Fitted:
    """Learn the play of floating joints from the scatter that a fit has left, by an iterated Kalman filter."""
    play, spread, vector = problem.layout.at("play"), fitted.covariance, fitted.vector
    for _ in range(_ROUNDS):
        seen, precision = problem.by_scatter(vector)
        gain = spread[:, play] @ np.linalg.inv(spread[play, play] + np.diag(1.0 / precision))
        vector = fitted.vector + gain @ (seen - fitted.vector[play])
        vector[play] = np.maximum(vector[play], 0.0)
    return replace(fitted, vector=vector, covariance=spread - gain @ spread[play])


FOLDS = 12
"""Groups for cross-validation; chosen for time"""
SURE = 1.3
"""Standard errors by which a correction must help; chosen"""
LEAST, FEWEST = 1e-4, 3
"""[m] least useful gain, and postures that tell it from a misreading; chosen"""
ASTRAY = 0.04
"""Error over summed link lengths of wrong units, columns or frames; chosen"""
SAME = np.radians(0.5)
"""[rad] within which rows are of one posture; chosen"""
WRONG = 2.9
"""Standard deviations of a suspect point; chosen"""
DISTURBED = (
    "So many do not fit that something changed between them, or that they were not measured from the base: a horn that "
    "slipped, an encoder that jumped, an arm or a camera that was moved, another origin (--frame). Look, and measure "
    "all of them again."
)


def helps(arm: Arm, measured: Measurements, before: Array, after: Array) -> bool:
    """Whether the correction is clearly better at points left out: errors (M,) [m] without and with it."""
    numbers = np.unique(measured.posture)
    gain = np.mean([(before - after)[measured.posture == number].mean() for number in numbers])
    noise = (measured.sigma**2).mean() + floor_of(arm) ** 2
    return len(numbers) >= FEWEST and bool(gain > max(SURE * np.sqrt(noise / len(numbers)), LEAST))


def disturbed(suspects: tuple[int, ...], points: int) -> bool:
    """Whether so many do not fit that the setup has moved."""
    return len(suspects) >= min(max(3, points / 4), points)


def fitting(suspects: tuple[int, ...], points: int) -> Mask:
    """Points (M,) that count in a mean error: all, where so many do not fit."""
    return ~np.isin(np.arange(points), suspects) | disturbed(suspects, points)


def leave_out(problem: ToolProblem, fitted: Fitted) -> Array:
    """Predict postures from the others: (3, M).

    Distances [m] from the encoders' and from the calibration's tool, and the squared Mahalanobis distance.
    """
    found, numbers = np.zeros((3, len(problem.posture))), np.unique(problem.posture)
    for group in range(min(FOLDS, len(numbers))):
        out = np.isin(problem.posture, numbers[group::FOLDS])
        refit, held = solve(problem.rows(~out), fitted.vector), problem.rows(out)
        off, slope = held.misfit(refit.vector)[:, :3], held.slope(refit.vector)[:, :3]
        total = held.noise(refit.vector)[:, :3, :3] + slope @ refit.covariance @ slope.mT
        before = np.linalg.norm(problem.uncorrected(out, fitted.vector)[:, :3], axis=1)
        surprise = np.einsum("mi,mi->m", off, np.linalg.solve(total, off[..., None])[..., 0])
        found[:, out] = before, np.linalg.norm(off, axis=1), surprise
    return found


CASES = (
    PriorCase(),
    PriorCase(play=np.radians(0.15), play_sigma=np.radians(0.15), compliance=0.003),
    PriorCase(tilt=ASKEW, odds=-0.5),
    PriorCase(twist=1.0, odds=-1.0),
    PriorCase(offset=np.radians(6.0), odds=-1.0),
)
"""A worn arm, a healthy one, a tilted base, inexact links, and wrong zeros (a tooth of a horn is 14 degrees)"""
AGE = 0.3
"""Change since an earlier calibration, in sigmas of the prior; chosen"""


def fit(arm: Arm, measurements: Measurements, *, prior: Calibration | None = None, date: str = "") -> Calibration:
    """Fit a displacement to ``measurements`` and test it on points left out.

    ``prior``: an earlier calibration; ContractError for another arm's. InputError for unusable measurements.
    """
    position, point, foreign = measurements.position, measurements.point, measurements.frame != "base"
    if position.shape[1] != arm.joints:
        raise InputError(
            f"measurements of {position.shape[1]} joints, the arm {arm.name} has {arm.joints}; take those of this arm"
        )
    same = (cdist(position, position, "chebyshev") < SAME) | (measurements.posture[:, None] == measurements.posture)
    measurements = replace(measurements, posture=connected_components(same)[1])  # rows of one posture, one number
    beliefs = beliefs_of(arm, prior, ANYWHERE**-2.0 * np.eye(6 * foreign))
    problem = ToolProblem(
        arm=arm,
        belief=beliefs[0],
        seen=pose_of(np.eye(3), np.nan_to_num(point)),
        by_lens=np.zeros((len(point), 6, 0)),
        known=np.isfinite(np.append(point, np.nan * point, axis=1)),
        spread=measurements.sigma[:, None, None] ** 2 * np.eye(6),
        position=position,
        posture=measurements.posture,
        frame=align(arm, measurements) if foreign else np.eye(4),
        mounted=np.eye(4),
    )
    return judged(*likeliest(problem, beliefs), measurements, date)


def beliefs_of(arm: Arm, prior: Calibration | None, outside: Array) -> list[Belief]:
    """Priors of an arm: every case, and an earlier calibration, which may be wrong; ``outside``: see `belief`."""
    cases = [belief(arm, case, outside) for case in CASES]
    if prior is None:
        return cases
    prior.require(arm)
    return [earlier(arm, prior, outside), *cases]


def earlier(arm: Arm, prior: Calibration, outside: Array = NOTHING) -> Belief:
    """Earlier calibration as prior, widened by `AGE`."""
    layout = DisplacementLayout(arm)
    body, fits_links = slice(0, layout.body), prior.displacement.twist.any()
    found = belief(arm, PriorCase(twist=1.0 if fits_links else 0.0), outside)
    usual = 1.0 / np.diag(belief(arm, PriorCase()).precision)
    found.mean[body] = layout.vector(prior.displacement)
    found.precision[body, body] = np.linalg.inv(prior.covariance + AGE**2 * np.diag(usual))
    return found


def likeliest(problem: ToolProblem, beliefs: list[Belief]) -> tuple[ToolProblem, Fitted]:
    """Solve a problem under each prior; return the likeliest."""
    tried = [(replace(problem, belief=one), solve(replace(problem, belief=one), one.mean)) for one in beliefs]
    return max(tried, key=lambda each: each[1].evidence + each[0].belief.odds)


def judged(problem: ToolProblem, fitted: Fitted, measured: Measurements, date: str) -> Calibration:
    """Make a calibration of a fit, tested on rows left out; InputError for what no arm is."""
    body, (before, after, surprise) = slice(0, problem.layout.body), leave_out(problem, fitted)
    fitted = scattered(problem, fitted)
    off = np.quantile(after, 0.8, method="lower")
    if off > ASTRAY * reach(problem.arm) and len(np.unique(measured.posture)) >= FEWEST:
        raise InputError(
            f"points lie {1e3 * off:.0f} mm or more from where the others put the tool, and no arm is that far from "
            "its description: are units, columns, joint positions and the frame of the points right, and is it this "
            "arm?"
        )
    freedom = problem.known[:, :3].sum(axis=1)
    excess = surprise / np.where(freedom > 0, chdtri(np.maximum(freedom, 1), ndtr(-WRONG)), np.inf)  # by chi-squared
    suspects = tuple(int(i) for i in np.argsort(-excess) if excess[i] > 1.0)
    fits = fitting(suspects, len(measured))
    return Calibration(
        arm=problem.arm,
        displacement=problem.layout.displacement(fitted.vector),
        covariance=fitted.covariance[body, body],
        frame=problem.outside(fitted.vector)[0],
        frame_name=measured.frame,
        source=measured.source,
        date=date,
        points=len(measured),
        before=float(before[fits].mean()),
        after=float(after[fits].mean()),
        used=helps(problem.arm, measured, before, after) and not disturbed(suspects, len(measured)),
        floor=floor_of(problem.arm),
        suspects=suspects,
        left_out=np.stack([before, after], axis=-1),
    )
