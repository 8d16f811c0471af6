"""Maximum a posteriori parameters by bounded least squares.

The noise is that of measuring, model and floating joints; the loss is Huber's (1964).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from rejoint.arms import Arm, Array, Displacement
from rejoint.arms.rotations import moved
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.parameters import (
    Belief,
    DisplacementLayout,
    displacement_of,
    floor_of,
    linearised,
    scatter,
    vector_of,
)

HUBER = 2.8
"""Residual [sigma] from which the loss is linear: 95 % of three normal coordinates"""
SLIP, MOST_SLIPS = 30.0, 0.25
"""Residual [sigma] of an outlier, and their largest share; chosen"""
ITERATIONS = 40
_ROUNDS = 5  # of a descent with the noise as it was, at most
_SMALL = 1e-4  # relative gain of a step, or of a round, after which the fit ends
_TILT = np.radians(6.0)
_DIRECTIONS, _QUICK = 8, 4


@dataclass(frozen=True, kw_only=True, eq=False)
class Fitted:
    """A solution and its uncertainty."""

    layout: DisplacementLayout
    vector: Array
    """(k,)"""
    covariance: Array
    """(k, k)"""
    frame: Array
    """(4, 4) pose of the measuring frame in the base"""
    evidence: float
    """log marginal likelihood up to a constant (Laplace's approximation)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fittable(ABC):
    """R residuals of d numbers, the first three a position, and a prior."""

    arm: Arm
    layout: DisplacementLayout
    belief: Belief
    huber: float

    @property
    @abstractmethod
    def postures(self) -> NDArray[np.int64]:
        """(R,) posture number of each."""

    @property
    @abstractmethod
    def known(self) -> NDArray[np.bool_]:
        """(R, d) which numbers were measured."""

    @abstractmethod
    def rows(self, where: NDArray[np.bool_]) -> Self:
        """Problem of some residuals."""

    @abstractmethod
    def pose(self, vector: Array) -> Array:
        """Pose (4, 4) of the measuring frame in the base."""

    @abstractmethod
    def residual(self, vector: Array) -> tuple[Array, Array]:
        """Residuals (R, d) and their derivative (R, d, k)."""

    @abstractmethod
    def noise(self, vector: Array) -> Array:
        """Covariance (R, d, d) of a residual for known parameters."""

    def uncorrected(self, out: NDArray[np.bool_], start: Array) -> Array:
        """Residuals (r, d) of rows ``out`` by encoders; the others fit the frame from ``start`` (k,)."""
        body, own = slice(0, self.layout.body), self.belief
        mean, lower, upper = own.mean.copy(), own.lower.copy(), own.upper.copy()
        mean[body] = lower[body] = upper[body] = vector_of(self.layout, Displacement.none(self.arm))[body]
        rigid = replace(self, belief=replace(own, mean=mean, lower=lower, upper=upper))
        return rigid.rows(out).misfit(solve(rigid.rows(~out), start).vector)

    def misfit(self, vector: Array) -> Array:
        """Residuals (R, d)."""
        return self.residual(vector)[0]

    def whitener(self, vector: Array) -> Array:
        """Matrices (R, d, d) that whiten residuals."""
        return np.asarray(np.linalg.inv(np.linalg.cholesky(self.noise(vector))))

    def displacement(self, vector: Array) -> Displacement:
        """Displacement for the unknowns (k,)."""
        return displacement_of(self.layout, vector)


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationProblem(Fittable):
    """Measurements and prior of one arm."""

    measurements: Measurements
    frame: Array
    """(4, 4) first estimate, in the base"""
    huber: float = HUBER

    @property
    def postures(self) -> NDArray[np.int64]:
        """(M,) posture numbers."""
        return self.measurements.posture

    def rows(self, where: NDArray[np.bool_]) -> CalibrationProblem:
        """Problem of some points."""
        return replace(self, measurements=self.measurements.rows(where))

    @property
    def known(self) -> NDArray[np.bool_]:
        """(M, 3) which coordinates were measured."""
        return np.isfinite(self.measurements.point)

    def pose(self, vector: Array) -> Array:
        """Pose (4, 4) of the measuring frame in the base."""
        if not self.layout.frame:
            return self.frame
        return moved(self.frame, vector[self.layout.at("frame")])

    def residual(self, vector: Array) -> tuple[Array, Array]:
        """Predicted less measured (M, 3) [m], zero where not measured; derivative (M, 3, k)."""
        m = self.measurements
        tool, own = linearised(self.arm, self.layout, vector, m.position)
        pose, derivative = self.pose(vector), np.zeros((*tool.shape, self.layout.size))
        derivative[..., : self.layout.body] = own
        if self.layout.frame:
            small = derivative[..., self.layout.at("frame")]
            small[..., :3] = -np.eye(3)
            small[..., 3:] = np.cross((tool - pose[:3, 3])[:, None], np.eye(3)).swapaxes(-1, -2)
        residual = np.where(self.known, (tool - pose[:3, 3]) @ pose[:3, :3] - m.point, 0.0)
        return residual, np.where(self.known[..., None], pose[:3, :3].T @ derivative, 0.0)

    def noise(self, vector: Array) -> Array:
        """Covariance (M, 3, 3) [m^2] of a residual."""
        rotation, m = self.pose(vector)[:3, :3], self.measurements
        spread = rotation.T @ scatter(self.arm, self.displacement(vector), m.position) @ rotation
        spread = spread + (m.sigma**2 + floor_of(self.arm) ** 2)[:, None, None] * np.eye(3)
        both = self.known[:, :, None] & self.known[:, None, :]
        return np.where(both, spread, np.eye(3) * spread)


def solve(problem: Fittable, start: Array, iterations: int = ITERATIONS) -> Fitted:
    """Iterate from ``start`` (k,), with the noise of the last iterate."""
    belief, vector = problem.belief, np.array(start, dtype=float)
    free, cost = belief.upper > belief.lower, np.inf
    vector[~free] = belief.lower[~free]
    root = np.linalg.cholesky(belief.precision).T

    def whole(x: Array) -> Array:
        full = vector.copy()
        full[free] = x
        return full

    for step in range(_ROUNDS if free.any() else 0):
        whitener = problem.whitener(vector)
        if step:
            whitener = whitener * _plausible(whitener, problem.misfit(vector))[:, None, None]

        def residual(x: Array, whitener: Array = whitener) -> Array:
            full = whole(x)
            white, bent, _ = _weighed(problem, whitener, problem.misfit(full))
            return np.concatenate([(white * bent).ravel(), root @ (full - belief.mean)])

        def derivative(x: Array, whitener: Array = whitener) -> Array:
            own, slope = problem.residual(whole(x))
            _, bent, weight = _weighed(problem, whitener, own)
            both = (weight / bent)[..., None] * np.einsum("mij,mjk->mik", whitener, slope[..., free])
            return np.concatenate([both.reshape(-1, free.sum()), root[:, free]])

        found = least_squares(
            residual,
            np.clip(vector, belief.lower, belief.upper)[free],
            derivative,
            x_scale="jac",
            bounds=(belief.lower[free], belief.upper[free]),
            max_nfev=iterations,
            ftol=_SMALL,
            xtol=_SMALL,
        )
        vector, before, cost = whole(found.x), cost, found.cost
        if iterations < ITERATIONS or abs(before - cost) <= _SMALL * (1.0 + cost):
            break
    return _fitted(problem, vector)


def _plausible(whitener: Array, residual: Array) -> NDArray[np.bool_]:
    near: NDArray[np.bool_] = np.linalg.norm(np.einsum("mij,mj->mi", whitener, residual), axis=1) < SLIP
    return near if near.sum() >= (1.0 - MOST_SLIPS) * len(near) else np.ones_like(near)


def _weighed(problem: Fittable, whitener: Array, residual: Array) -> tuple[Array, Array, Array]:
    """White residuals (R, d), factor (R, 1) to half their squared loss, and its slope (R, 1)."""
    white = np.einsum("mij,mj->mi", whitener, residual)
    length = np.maximum(np.linalg.norm(white, axis=1, keepdims=True), 1e-12)
    weight = np.minimum(1.0, problem.huber / length)
    return white, np.sqrt(weight * (2.0 - weight)), weight


def search(problem: Fittable) -> Fitted:
    """Solve from upright and tilted bases: a slight tilt moves a floating joint."""
    upright = solve(problem, problem.belief.mean)
    turns = np.linspace(0.0, 2 * np.pi, _DIRECTIONS, endpoint=False)
    best = upright
    for tilt in _TILT * np.stack([np.cos(turns), np.sin(turns)], axis=-1):
        start = upright.vector.copy()
        start[problem.layout.at("tilt")] = tilt
        quick = solve(problem, start, _QUICK)
        best = quick if quick.evidence > best.evidence else best
    return upright if best is upright else solve(problem, best.vector)


def _fitted(problem: Fittable, vector: Array) -> Fitted:
    whitener, belief = problem.whitener(vector), problem.belief
    residual, derivative = problem.residual(vector)
    white, bent, weight = _weighed(problem, whitener, residual)
    slope = np.sqrt(weight)[..., None] * np.einsum("mij,mjk->mik", whitener, derivative)
    flat, off = slope.reshape(-1, len(vector)), vector - belief.mean
    curvature = flat.T @ flat + belief.precision
    cost = 0.5 * float(((white * bent) ** 2).sum() + off @ belief.precision @ off)
    spread = np.log(np.abs(np.diagonal(whitener, axis1=1, axis2=2)))[problem.known].sum()
    evidence = -cost + spread + 0.5 * (np.linalg.slogdet(belief.precision)[1] - np.linalg.slogdet(curvature)[1])
    return Fitted(
        layout=problem.layout,
        vector=vector,
        covariance=np.asarray(np.linalg.inv(curvature), dtype=float),
        frame=problem.pose(vector),
        evidence=float(evidence),
    )
