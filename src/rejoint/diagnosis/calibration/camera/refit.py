"""The arm and the rig from where the camera saw the board, once the lens is known: small enough to be fitted often.

The bundle adjustment settles the lens and the board's pose in each view. What is left are the poses of camera and board
on the arm, and the arm's displacement. They are fitted under each belief that `rejoint.diagnosis.calibration.fit` has,
and again without each posture, so that a correction is judged on views that it has not seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Displacement
from rejoint.arms.camera.poses import inverse, moved
from rejoint.arms.camera.rig import Rig
from rejoint.diagnosis.calibration.camera.adjustment import NOWHERE, Tip, difference, looseness
from rejoint.diagnosis.calibration.gate import LeftOut, folds
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.parameters import Belief, DisplacementLayout, displacement_of, vector_of
from rejoint.diagnosis.calibration.solver import Fitted, solve

HUBER = 3.55
"""Length of a view's residual in standard deviations from which the loss grows linearly (95 % of six numbers that are
normally distributed are shorter)"""
POSES = 12
"""Unknowns after the arm's: shift [m] and turn [rad] of `Rig.standing` and of `Rig.mounted`"""
_STEP = 1e-6  # [m] and [rad] of numerical derivatives


@dataclass(frozen=True, kw_only=True, eq=False)
class TieProblem:
    """Poses of the board in views, and beliefs: what `rejoint.diagnosis.calibration.solver` solves."""

    arm: Arm
    layout: DisplacementLayout
    belief: Belief
    """of the arm's parameters and of the `POSES` after them"""
    rig: Rig
    """the estimate"""
    sights: Array
    """(V, 4, 4) of the board in the frame of the camera"""
    spread: Array
    """(V, 6, 6) covariance of the tool's pose by what the corners leave open, base axes"""
    position: Array
    """(V, n) [rad]"""
    approach: Array
    """(V, n) [rad]; NaN where nobody knows"""
    posture: NDArray[np.int64]
    """(V,)"""
    tip: Tip | None = None
    huber: float = HUBER

    @property
    def known(self) -> NDArray[np.bool_]:
        """(V, 6) all of them."""
        return np.ones((len(self.posture), 6), dtype=bool)

    def rows(self, where: NDArray[np.bool_]) -> TieProblem:
        """Return the problem of some of the views."""
        return replace(
            self, sights=self.sights[where], spread=self.spread[where], position=self.position[where],
            approach=self.approach[where], posture=self.posture[where],
        )  # fmt: skip

    def rig_of(self, vector: Array) -> Rig:
        """Return the rig for the unknowns (k,)."""
        small = vector[self.layout.body :]
        return replace(
            self.rig, standing=moved(self.rig.standing, small[:6]), mounted=moved(self.rig.mounted, small[6:])
        )

    def displacement(self, vector: Array) -> Displacement:
        """Return the arm's displacement for the unknowns (k,)."""
        return displacement_of(self.layout, vector[: self.layout.body])

    def pose(self, vector: Array) -> Array:
        """Pose (4, 4) in the base of what stands beside the arm: the frame of the measurements."""
        return self.rig_of(vector).standing

    def misfit(self, vector: Array) -> Array:
        """Shift [m] and turn [rad] (V, 6) of the tool, see `residual`."""
        return difference(self._seen(vector), self._reported(vector))

    def residual(self, vector: Array) -> tuple[Array, Array]:
        """Shift [m] and turn [rad] (V, 6) of the tool, seen less told by the arm; with the derivative (V, 6, k)."""
        seen, told = self._seen(vector), self._reported(vector)
        base, body = difference(seen, told), self.layout.body
        slope = np.zeros((*base.shape, len(vector)))
        free = self.belief.upper > self.belief.lower
        for i in np.flatnonzero(free).tolist():
            other = vector.copy()
            other[i] += _STEP
            ends = (seen, self._reported(other)) if i < body else (self._seen(other), told)
            slope[..., i] = (difference(*ends) - base) / _STEP
        return base, slope

    def noise(self, vector: Array) -> Array:
        """Covariance (V, 6, 6) of a residual for known parameters."""
        return looseness(self.arm, self.displacement(vector), self.position) + self.spread

    def whitener(self, vector: Array) -> Array:
        """Matrices (V, 6, 6) that turn residuals into numbers of unit variance."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.noise(vector))))

    def measurements(self, vector: Array) -> Measurements:
        """Where the tool was seen, in the frame of what stands beside the arm."""
        rig = self.rig_of(vector)
        point = (inverse(rig.standing) @ rig.tool(self.sights))[:, :3, 3]
        sigma = np.sqrt(np.trace(self.spread[:, :3, :3], axis1=1, axis2=2) / 3.0)
        return Measurements(
            position=self.position, approach=self.approach, point=point, sigma=sigma, posture=self.posture,
            frame="camera" if rig.carried == "board" else "board", source="camera",
        )  # fmt: skip

    def _seen(self, vector: Array) -> Array:
        return self.rig_of(vector).tool(self.sights)

    def _reported(self, vector: Array) -> Array:
        return self.displacement(vector).tool_pose(self.arm, self.position, self.approach)


def with_poses(own: Belief, rig: Rig, tip: Tip | None) -> Belief:
    """Return beliefs of the arm and of `POSES`, of which nothing is believed but where the ``tip`` was measured."""
    anywhere = np.full(POSES, np.inf)
    mean, precision = np.concatenate([own.mean, np.zeros(POSES)]), np.zeros((len(own.mean) + POSES,) * 2)
    precision[: len(own.mean), : len(own.mean)] = own.precision
    precision[len(own.mean) :, len(own.mean) :] = NOWHERE**-2.0 * np.eye(POSES)
    if tip is not None:  # the tip is where the tool's frame begins, so that it moves with what is mounted on the tool
        place = slice(len(own.mean) + 6, len(own.mean) + POSES)
        at, slope = _tip(rig.mounted)
        off = np.linalg.lstsq(slope, tip.place - at, rcond=None)[0]
        mean[place] = off
        precision[place, place] += slope.T @ slope / tip.sigma**2
    return Belief(
        mean=mean, precision=precision, lower=np.concatenate([own.lower, -anywhere]),
        upper=np.concatenate([own.upper, anywhere]),
    )  # fmt: skip


def _tip(mounted: Array) -> tuple[Array, Array]:
    """Where the tip is on what is ``mounted`` (4, 4), and how that changes (3, 6) as this is shifted and turned."""
    at = inverse(mounted)[:3, 3]
    moves = [(inverse(moved(mounted, _STEP * row))[:3, 3] - at) / _STEP for row in np.eye(6)]
    return at, np.array(moves).T


def tool_spread(rig: Rig, sights: Array, covariance: Array) -> Array:
    """Covariance (V, 6, 6) of the tool's pose, base axes, where the board's has ``covariance`` (V, 6, 6) by itself."""
    base = rig.tool(sights)
    rows = [difference(rig.tool(moved(sights, _STEP * row)), base) / _STEP for row in np.eye(6)]
    slope = np.stack(rows, axis=-1)
    return np.asarray(slope @ covariance @ np.swapaxes(slope, -1, -2))


def leave_views_out(problem: TieProblem, fitted: Fitted) -> LeftOut:
    """Predict every view from fits that have seen none of its posture, with a displacement and without."""
    count = len(problem.posture)
    before, after, surprise = np.zeros(count), np.zeros(count), np.zeros(count)
    rigid = replace(problem, belief=_rigid(problem))
    for out in folds(problem.posture):
        refit = solve(problem.rows(~out), fitted.vector)
        held = problem.rows(out)
        residual, slope = held.residual(refit.vector)
        total = held.noise(refit.vector) + slope @ refit.covariance @ np.swapaxes(slope, -1, -2)
        place, shift = total[:, :3, :3], residual[:, :3]
        after[out] = np.linalg.norm(shift, axis=1)
        surprise[out] = np.einsum("mi,mi->m", shift, np.linalg.solve(place, shift[..., None])[..., 0])
        plain = solve(rigid.rows(~out), fitted.vector)
        before[out] = np.linalg.norm(rigid.rows(out).misfit(plain.vector)[:, :3], axis=1)
    return LeftOut(before=before, after=after, surprise=surprise)


def _rigid(problem: TieProblem) -> Belief:
    """Believe that the tool is where the encoders see it."""
    body, own = slice(0, problem.layout.body), problem.belief
    mean, lower, upper = own.mean.copy(), own.lower.copy(), own.upper.copy()
    mean[body] = lower[body] = upper[body] = vector_of(problem.layout, Displacement.none(problem.arm))
    return Belief(mean=mean, precision=own.precision, lower=lower, upper=upper)
