"""The likeliest parameters for some measurements: maximum a posteriori, by Levenberg-Marquardt within bounds.

Residuals are those of single coordinates, so that a height alone is a measurement. They are weighed by what is known
of their noise: of the measuring, of the model, and of joints that float in their play. A loss that grows linearly for
large residuals (Huber 1964) keeps one wrong point from spoiling the fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.arms.rotations import rotation_about
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.model import floor_of, linearised, scatter
from rejoint.diagnosis.calibration.parameters import Belief, DisplacementLayout, displacement_of

HUBER = 2.8
"""Length of a point's residual in standard deviations from which the loss grows linearly (95 % of three coordinates
that are normally distributed are shorter)"""
ITERATIONS = 40
_START, _RISE, _FALL, _MOST = 1e-3, 8.0, 0.2, 1e8  # damping: at first, after a step that fails or helps, at most
_SMALL = 1e-4  # relative gain of a step after which the fit ends
_TILT = np.radians(6.0)
_DIRECTIONS, _QUICK = 8, 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """A solution, and how sure it is."""

    layout: DisplacementLayout
    vector: Array
    """(k,)"""
    covariance: Array
    """(k, k)"""
    frame: Array
    """(4, 4) pose of the measuring frame in the base"""
    evidence: float
    """logarithm of the marginal likelihood, but for a constant of the measurements (Laplace's approximation)"""


class Fittable(Protocol):
    """What is fitted: R residuals of d numbers each that belong together, and beliefs."""

    @property
    def layout(self) -> DisplacementLayout:
        """Where the arm's parameters stand in the vector (k,)."""

    @property
    def belief(self) -> Belief:
        """What is believed of the vector."""

    @property
    def huber(self) -> float:
        """Length of a residual in standard deviations from which the loss grows linearly."""

    @property
    def known(self) -> NDArray[np.bool_]:
        """(R, d) which numbers were measured."""

    def pose(self, vector: Array) -> Array:
        """Pose (4, 4) of the measuring frame in the base."""

    def misfit(self, vector: Array) -> Array:
        """Residuals (R, d)."""

    def residual(self, vector: Array) -> tuple[Array, Array]:
        """Residuals (R, d) and their derivative (R, d, k)."""

    def whitener(self, vector: Array) -> Array:
        """Matrices (R, d, d) that turn residuals into numbers of unit variance."""


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationProblem:
    """Measurements and beliefs of one arm."""

    arm: Arm
    layout: DisplacementLayout
    belief: Belief
    measurements: Measurements
    frame: Array
    """(4, 4) first estimate of the pose of the measuring frame in the base"""
    huber: float = HUBER
    """see `Fittable`"""

    @property
    def known(self) -> NDArray[np.bool_]:
        """(M, 3) which coordinates were measured."""
        return np.isfinite(self.measurements.point)

    def pose(self, vector: Array) -> Array:
        """Pose (4, 4) of the measuring frame in the base."""
        if not self.layout.frame:
            return self.frame
        small = vector[self.layout.at("frame")]
        pose, angle = self.frame.copy(), float(np.linalg.norm(small[3:]))
        if angle > 0.0:
            pose[:3, :3] = rotation_about(small[3:] / angle, angle) @ pose[:3, :3]
        pose[:3, 3] += small[:3]
        return pose

    def misfit(self, vector: Array) -> Array:
        """Predicted less measured coordinates (M, 3) [m], see `residual`."""
        return self.residual(vector)[0]

    def residual(self, vector: Array) -> tuple[Array, Array]:
        """Predicted less measured coordinates (M, 3) [m], zero where not measured, and their derivative (M, 3, k)."""
        m = self.measurements
        tool, own = linearised(self.arm, self.layout, vector, m.position, m.approach)
        pose, derivative = self.pose(vector), np.zeros((*tool.shape, self.layout.size))
        derivative[..., : self.layout.body] = own
        if self.layout.frame:
            away, place = tool - pose[:3, 3], self.layout.at("frame").start
            derivative[..., place : place + 3] = -np.eye(3)
            derivative[..., place + 3 :] = np.swapaxes(np.cross(np.eye(3), away[:, None]), 1, 2) * -1.0
        known = np.isfinite(self.measurements.point)
        seen = (tool - pose[:3, 3]) @ pose[:3, :3]
        residual = np.where(known, seen - self.measurements.point, 0.0)
        turned = np.einsum("ij,mjk->mik", pose[:3, :3].T, derivative)
        return residual, np.where(known[..., None], turned, 0.0)

    def whitener(self, vector: Array) -> Array:
        """Matrices (M, 3, 3) that turn residuals into numbers of unit variance."""
        return np.linalg.inv(np.linalg.cholesky(self.noise(vector)))

    def noise(self, vector: Array) -> Array:
        """Covariance (M, 3, 3) [m^2] of a residual for known parameters; apart where a coordinate was not measured."""
        rotation = self.pose(vector)[:3, :3]
        spread = scatter(self.arm, displacement_of(self.layout, vector), self.measurements.position)
        spread = rotation.T @ spread @ rotation
        floor = floor_of(self.arm)
        spread = spread + (self.measurements.sigma**2 + floor**2)[:, None, None] * np.eye(3)
        known = np.isfinite(self.measurements.point)
        both = known[:, :, None] & known[:, None, :]
        return np.where(both, spread, np.eye(3) * spread)


def solve(problem: Fittable, start: Array, iterations: int = ITERATIONS) -> Fitted:
    """Descend from ``start`` (k,)."""
    belief, vector, damping = problem.belief, np.clip(start, problem.belief.lower, problem.belief.upper), _START
    for _ in range(iterations):
        whitener = problem.whitener(vector)
        cost, gradient, curvature = _system(problem, vector, whitener)
        fixed = ((vector <= belief.lower) & (gradient > 0)) | ((vector >= belief.upper) & (gradient < 0))
        free, gained = ~fixed, 0.0
        while damping < _MOST:
            block = curvature[np.ix_(free, free)] + damping * np.diag(np.diag(curvature)[free])
            trial = vector.copy()
            trial[free] -= np.linalg.solve(block, gradient[free])
            trial = np.clip(trial, belief.lower, belief.upper)
            gained = cost - _cost(problem, trial, whitener)
            if gained >= 0.0:
                vector, damping = trial, damping * _FALL
                break
            damping *= _RISE
        if gained <= _SMALL * (1.0 + cost):
            break
    return _fitted(problem, vector)


def search(problem: Fittable) -> Fitted:
    """Solve from upright and from askew bases: the side of a floating joint's play changes with the slightest tilt."""
    upright = solve(problem, problem.belief.mean)
    turns = np.linspace(0.0, 2 * np.pi, _DIRECTIONS, endpoint=False)
    best = upright
    for tilt in _TILT * np.stack([np.cos(turns), np.sin(turns)], axis=-1):
        start = upright.vector.copy()
        start[problem.layout.at("tilt")] = tilt
        quick = solve(problem, start, _QUICK)
        best = quick if quick.evidence > best.evidence else best
    return upright if best is upright else solve(problem, best.vector)


def _cost(problem: Fittable, vector: Array, whitener: Array) -> float:
    huber, residual = problem.huber, problem.misfit(vector)
    length = np.linalg.norm(np.einsum("mij,mj->mi", whitener, residual), axis=1)
    loss = np.where(length < huber, 0.5 * length**2, huber * (length - 0.5 * huber))
    off = vector - problem.belief.mean
    return float(loss.sum() + 0.5 * off @ problem.belief.precision @ off)


def _system(problem: Fittable, vector: Array, whitener: Array) -> tuple[float, Array, Array]:
    """Cost, its gradient (k,) and its curvature (k, k), with the weights of the loss as they are."""
    huber, (residual, derivative) = problem.huber, problem.residual(vector)
    white = np.einsum("mij,mj->mi", whitener, residual)
    slope = np.einsum("mij,mjk->mik", whitener, derivative)
    length = np.linalg.norm(white, axis=1)
    weight = np.minimum(1.0, huber / np.maximum(length, 1e-12))
    loss = np.where(length < huber, 0.5 * length**2, huber * (length - 0.5 * huber))
    off = vector - problem.belief.mean
    flat = (slope * np.sqrt(weight)[:, None, None]).reshape(-1, len(vector))
    gradient = np.einsum("mik,mi,m->k", slope, white, weight) + problem.belief.precision @ off
    cost = float(loss.sum() + 0.5 * off @ problem.belief.precision @ off)
    return cost, gradient, flat.T @ flat + problem.belief.precision


def _fitted(problem: Fittable, vector: Array) -> Fitted:
    whitener = problem.whitener(vector)
    cost, _, curvature = _system(problem, vector, whitener)
    spread = np.log(np.abs(np.diagonal(whitener, axis1=1, axis2=2)))[problem.known].sum()
    evidence = -cost + spread + 0.5 * (np.linalg.slogdet(problem.belief.precision)[1] - np.linalg.slogdet(curvature)[1])
    return Fitted(
        layout=problem.layout, vector=vector, covariance=np.asarray(np.linalg.inv(curvature), dtype=float),
        frame=problem.pose(vector), evidence=float(evidence),
    )  # fmt: skip
