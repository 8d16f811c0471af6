"""Maximum a posteriori fit of a twin's parameters to windows of motion, by block Gauss-Newton.

Levenberg-Marquardt (Nocedal and Wright, chapter 10), pseudo-Huber loss (Charbonnier et al. 1997), Gaussian prior;
residuals within `MEMORY` are one observation.

Its uncertainty is the jackknife over clusters (motions, or stretches of an excitation), each left out by one Newton
step (CR3 of Bell and McCaffrey 2002; Cameron and Miller 2015), with Student's quantile. What a fit holds fixed widens
it ("consider" covariance, Schmidt 1966; Bierman 1977, chapter 8).
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from rejoint.arms import Array, Index, Mask, gravity_torque, link_inertia
from rejoint.diagnosis.measurement import CENTRE, MASS
from rejoint.logs.exclusions import UNPOWERED
from rejoint.system.records import entity
from rejoint.system.statistics import NORMAL95, student95
from rejoint.twin.parameters import PARAMETERS, Prior, number, unpack
from rejoint.twin.replay import Replay

HUBER = np.radians(1.7)
"""[rad] where the loss becomes linear; measured on a real low-cost arm"""

POSTURES = 500
"""Rows for a mean gravity torque; chosen"""

STIFFNESS, TORQUE_LIMIT = number("stiffness"), number("torque_limit")

SCALES = (0.5, 0.7, 0.85, 1.18, 1.41, 2.0)
"""Tried factors of a joint's common scale; chosen"""

DAMPINGS = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Levenberg-Marquardt, relative to the curvature's diagonal; chosen"""

LEAST_GAIN = 0.5
"""Gain that ends a descent; chosen"""

MEMORY = 1.0
"""[s] of one observation beside the prior; chosen"""

LIMIT_GAIN = 0.15
"""Relative gain of a limit; chosen: a wrong one gains 6 %"""

ROUNDS = 10
"""Rounds to find weights and scale of windows; chosen"""


@entity
class Fit:
    """Result of a fit."""

    vector: Array
    """(k,)"""
    at_bound: Mask
    """(k,) held at a physical bound"""


class Problem:
    """Residuals, costs and Jacobians of one set of windows under one prior.

    ``frozen`` parameters keep their start. ``stride`` scales finite differences; window errors have ``freedom``
    degrees of freedom (Student).
    """

    def __init__(
        self,
        replay: Replay,
        prior: Prior,
        frozen: Collection[str] = (),
        stride: float = 1.0,
        freedom: float = np.inf,
    ) -> None:
        self.replay, self.prior, self.freedom = replay, prior, freedom
        self.joints = replay.arm.joints
        self.measured, self.window = replay.measured, replay.window
        silent = [w.log.extra.get(UNPOWERED, "").split(",") for w in replay.windows]
        self.powered = ~np.array([np.isin(replay.arm.joint_names, names) for names in silent])[self.window]
        self.floor = replay.arm.encoder_step / np.sqrt(12.0)
        self.dependent = max(MEMORY * (len(self.measured) - len(replay.windows)) / replay.seconds, 1.0)  # rows
        self.layout = prior.layout
        self.owner = self.layout.owner
        self.steps = stride * self.layout.has("difference")
        self._live = [index for index, p in enumerate(PARAMETERS) if p.fitted and p.name not in frozen]
        self.frozen = ~np.isin(self.layout.kind, self._live)

    def residuals(self, vectors: Array) -> Array:
        """Predicted minus measured positions (m, rows, n) [rad] for vectors (m, k); zero without power."""
        return (self.replay.predict(unpack(vectors)) - self.measured) * self.powered

    def weights(self, residual: Array) -> Array:
        """Weights (rows, n) [1/rad^2] of squared residuals (rows, n), by their scale."""
        share = self.shares(residual)
        square = 2.0 * (share * loss(residual)).sum(axis=0) / np.maximum(self.powered.sum(axis=0), 1)
        scale = np.maximum(np.sqrt(square), self.floor)
        return share / (scale**2 * self.dependent)

    def shares(self, residual: Array) -> Array:
        """Weights (rows, n) of each window's motion, by Student's distribution.

        Iteratively reweighted (Lange, Little and Taylor 1989).
        """
        if self.freedom == np.inf:
            return np.ones_like(residual)
        count, total = self._by_window(self.powered), self._by_window(loss(residual))
        by_window, share = total / np.maximum(count, 1.0), np.ones_like(total)
        for _ in range(ROUNDS):
            scale = (share * total).sum(axis=0) / np.maximum(count.sum(axis=0), 1.0)
            share = (self.freedom + 1.0) / (self.freedom + by_window / np.maximum(scale, 0.5 * self.floor**2))
        return share[self.window]

    def _by_window(self, values: Array) -> Array:
        """Sum values (rows, n) in each window."""
        return np.stack([np.bincount(self.window, column) for column in values.T], axis=1)

    def costs(self, vectors: Array, residuals: Array, weights: Array) -> tuple[Array, Array]:
        """Costs (m, n) of each joint alone, and (m,) of all."""
        precision, away, moved = self.prior.precision, vectors - self.prior.mean, vectors - vectors[0]
        pull = away @ precision
        data = (loss(residuals) * weights).sum(axis=1)
        own = (moved * (pull[0] + 0.5 * np.diag(precision) * moved))[:, self.owner >= 0]
        alone = data + own.reshape(len(own), -1, self.joints).sum(axis=1)
        return alone, data.sum(axis=1) + 0.5 * (pull * away).sum(axis=1)

    def perturbations(self, vector: Array, signs: Array) -> Array:
        """Vectors (p, k), each with one parameter of every joint, or one of the arm, moved.

        Instead of the stiffness, torques and inertia move.
        """
        steps = signs * self.steps
        own = self.layout.kind == np.arange(len(PARAMETERS))[:, None]
        moved = vector + np.where(own, steps, 0.0)
        for row in self._scaled():
            moved[STIFFNESS, own[row]] += steps[own[STIFFNESS]]
        return self.prior.clip(moved[self._live])

    def rescaled(self, vector: Array, factors: Sequence[float]) -> Array:
        """Vectors (f, k) with torques and inertia scaled by ``factors``."""
        at, factor = self.layout.at, np.array(factors)[:, None]
        stiffness, armature = np.exp(vector[at("stiffness")]), np.exp(vector[at("armature")])
        scaled = vector + np.log(factor) * self.layout.has("scaled")
        motor = factor * (self.link_inertia + armature) - self.link_inertia
        scaled[:, at("armature")] = np.log(np.maximum(motor, np.exp(self.prior.lower[at("armature")])))
        held = (1.0 - vector[at("compensation")]) * self.gravity
        scaled[:, at("offset")] += held / stiffness * (1.0 / factor - 1.0)
        return self.prior.clip(np.where(self.frozen, vector, scaled))

    @cached_property
    def gravity(self) -> Array:
        """(n,) [N m] torque against gravity, mean over the motion."""
        rows = np.linspace(0, len(self.measured) - 1, min(len(self.measured), POSTURES)).astype(int)
        return gravity_torque(self.replay.arm, self.measured[rows]).mean(axis=0)

    @cached_property
    def link_inertia(self) -> Array:
        """(n,) [kg m^2] of all links behind each joint, mean posture."""
        return link_inertia(self.replay.arm, self.measured.mean(axis=0))

    def inward(self, vector: Array, signs: Array) -> Array:
        """Flip ``signs`` (k,) whose step would leave the bounds."""
        moved = vector + signs * self.steps
        return np.where((moved > self.prior.upper) | (moved < self.prior.lower), -signs, signs)

    def jacobian(self, base: Array, moved: Array, signs: Array) -> Array:
        """Sensitivities (rows, n, q) of each joint to its own parameters and, last, the arm's.

        ``base`` (rows, n) and ``moved`` (p, rows, n): residuals there and at `perturbations`.
        """
        slopes = np.zeros((len(PARAMETERS), *base.shape))
        for row, residual in zip(self._live, moved, strict=True):
            slopes[row] = (residual - base) / (signs * self.steps)[self.layout.kind == row]
        for row in self._scaled():
            slopes[STIFFNESS] -= slopes[row]
        return np.moveaxis(slopes, 0, -1)

    def system(self, jacobian: Array, weight: Array, residual: Array) -> tuple[Array, Array]:
        """Curvature (k, k) and gradient (k,) of squared residuals (rows, n) by their ``weight`` (rows, n)."""
        k = len(self.prior.mean)
        curvature, gradient = np.zeros((k, k)), np.zeros(k)
        for joint in range(self.joints):
            place = np.flatnonzero(np.isin(self.owner, [joint, -1]))  # its parameters and, last, the arm's
            scaled = jacobian[:, joint].T * weight[:, joint]
            curvature[np.ix_(place, place)] += scaled @ jacobian[:, joint]
            gradient[place] += scaled @ residual[:, joint]
        return curvature, gradient

    def _scaled(self) -> list[int]:
        return [i for i in self._live if i != STIFFNESS and PARAMETERS[i].per_joint and PARAMETERS[i].log]


def fit(problem: Problem, start: Array, iterations: int, scales: Sequence[float] = ()) -> Fit:
    """Descend from ``start`` (k,) until a step gains almost nothing.

    First joints take the best of the ``scales`` as long as that gains.
    """
    x = problem.prior.clip(start)
    rescaling = np.inf if scales else 0.0
    residual = problem.residuals(x[None])[0]
    for iteration in range(1, iterations + 1):
        weights = problem.weights(residual)
        if rescaling >= LEAST_GAIN:
            around = np.vstack([x, problem.rescaled(x, scales)])
            x, rescaling, residual = line_up(problem, around, residual[None], weights)
            weights = problem.weights(residual)
        signs = problem.inward(x, _alternating(problem, iteration))
        jacobian = problem.jacobian(residual, problem.residuals(problem.perturbations(x, signs)), signs)
        curvature, gradient = problem.system(jacobian, weights * influence(residual), residual)
        curvature += problem.prior.precision
        gradient += problem.prior.precision @ (x - problem.prior.mean)
        fixed = problem.frozen | _pressed(problem.prior, x, gradient)
        trials = _steps(problem, x, curvature, gradient, fixed)
        x, gained, residual = line_up(problem, np.vstack([x, trials]), residual[None], weights)
        if gained + rescaling < LEAST_GAIN:
            break
    return Fit(vector=x, at_bound=fixed & ~problem.frozen)


def search(problem: Problem, starts: Array, rng: np.random.Generator, rounds: int) -> Array:
    """Search at random from ``starts`` (s, k), joint by joint: saturation hides stiffness."""
    prior, candidates = problem.prior, starts
    for i in range(rounds):
        residuals = problem.residuals(candidates)
        weights = problem.weights(residuals[np.argmin(loss(residuals).sum(axis=(1, 2)))])
        x = line_up(problem, candidates, residuals, weights)[0]
        count, layout = len(starts) - 1, problem.layout
        chosen = layout.fitted(rng.choice([0.0, 1.0], size=(count, layout.is_fitted.sum())))
        spread = np.where(problem.frozen, 0.0, prior.sigma) * 0.5**i * chosen
        around = x + spread * layout.normal(rng, count)
        candidates = prior.clip(np.vstack([x, around]))
    return x


def _alternating(problem: Problem, iteration: int) -> Array:
    parity = iteration + np.where(problem.owner >= 0, problem.layout.kind + problem.owner, 0)
    return np.where(parity % 2 == 0, 1.0, -1.0)


def _pressed(prior: Prior, x: Array, gradient: Array) -> Mask:
    edge = 1e-9 * (prior.upper - prior.lower)
    return ((x <= prior.lower + edge) & (gradient > 0)) | ((x >= prior.upper - edge) & (gradient < 0))


def _steps(problem: Problem, x: Array, curvature: Array, gradient: Array, fixed: Mask) -> Array:
    """Return new vectors (d, k), one per damping, within bounds and a sigma of ``x``."""
    free = np.flatnonzero(~fixed)
    block, sigma = curvature[np.ix_(free, free)], problem.prior.sigma[free]
    damped = block + np.multiply.outer(DAMPINGS, np.diag(np.diag(block)))
    trial = np.tile(x, (len(DAMPINGS), 1))
    trial[:, free] -= np.clip(np.linalg.solve(damped, gradient[free, None])[..., 0], -sigma, sigma)
    return problem.prior.clip(trial)


def line_up(problem: Problem, candidates: Array, residuals: Array, weights: Array) -> tuple[Array, float, Array]:
    """Best of the candidates (s, k) and the mixture of each joint's best; returns gain and residuals too.

    ``residuals`` (r, rows, n) of the first candidates.
    """
    if len(residuals) < len(candidates):
        residuals = np.concatenate([residuals, problem.residuals(candidates[len(residuals) :])])
    alone, total = problem.costs(candidates, residuals, weights)
    choice = np.append(np.argmin(alone, axis=0), np.argmin(total))  # the arm's own parameters: of the best
    mixed = candidates[choice[problem.owner], np.arange(candidates.shape[1])]
    candidates = np.vstack([candidates, mixed])
    residuals = np.concatenate([residuals, problem.residuals(mixed[None])])
    total = problem.costs(candidates, residuals, weights)[1]
    best = np.argmin(total)
    return candidates[best], total[0] - total[best], residuals[best]


def loss(residual: Array) -> Array:
    """Pseudo-Huber loss: r^2/2 for small residuals [rad], linear beyond `HUBER`."""
    return HUBER**2 * (np.sqrt(1.0 + (residual / HUBER) ** 2) - 1.0)


def influence(residual: Array) -> Array:
    """Weight of a residual in the linear problem, loss'(r) / r."""
    return 1.0 / np.sqrt(1.0 + (residual / HUBER) ** 2)


def explained(residual: Array) -> Mask:
    """(n,) whether each joint is explained, by rms residuals (rows, n) [rad]."""
    return (residual**2).mean(axis=0) < HUBER**2


CLUSTER = 3.0
"""[s]; chosen: longer than stick-slip and the slowest oscillation"""

SCALE_STEP = SCALES[-2]
"""Step of `SCALES`; measured: without it only 4 of 5 intervals agree"""


def uncertainty(problem: Problem, found: Fit, clusters: Index) -> Array:
    """Covariance (k, k) of an estimate from the scores of ``clusters`` (rows,) and what it holds fixed."""
    prior = problem.prior
    residual, jacobian = _central_differences(problem, found.vector)
    weight = problem.weights(residual) * influence(residual)
    rows = np.arange(clusters.max() + 1)[:, None] == clusters
    parts = [problem.system(jacobian[own], weight[own], residual[own]) for own in rows]
    curvatures, scores = map(np.stack, zip(*parts, strict=True))
    covariance = jackknife(prior, curvatures, scores) + _scale(problem, found.vector)
    covariance += fixed_covariance(problem, found, residual, jacobian, weight, curvatures.sum(axis=0) + prior.precision)
    covariance += np.diag(problem.layout.has("beside") ** 2)
    return 0.5 * (covariance + covariance.T)


def _scale(problem: Problem, x: Array) -> Array:
    """Covariance (k, k) of joints' common scales, by the ladder, and the prior's gravity and stiffness."""
    owner, at, sigma = problem.owner, problem.layout.at, problem.prior.sigma
    up, down = problem.rescaled(x, (SCALE_STEP**0.5, SCALE_STEP**-0.5))
    sag, scale = np.zeros_like(x), np.minimum(sigma[at("compensation")], sigma[at("stiffness")])
    # gravity that is fed forward, or of other masses, looks like an offset
    sag[at("offset")] = sigma[at("compensation")] * problem.gravity / np.exp(x[at("stiffness")])
    steps = np.stack([(up - down) / NORMAL95, np.where(problem.layout.is_log & (owner >= 0), scale[owner], 0.0), sag])
    return steps.T @ steps * (owner[:, None] == owner)


def jackknife(prior: Prior, curvatures: Array, scores: Array) -> Array:
    """Covariance (k, k) of a posterior from the curvatures (g, k, k) and scores (g, k) of g clusters."""
    count, precision = len(scores), prior.precision
    whole = curvatures.sum(axis=0)
    without = np.linalg.solve(whole - curvatures + precision, scores[..., None])[..., 0]
    inverse = np.linalg.inv(whole + precision)
    factor = (student95(max(count - 1, 1)) / NORMAL95) ** 2
    return (
        factor * (count - 1) / count * without.T @ without
        + factor * inverse @ whole @ inverse
        + inverse @ precision @ inverse
    )


def _central_differences(problem: Problem, x: Array) -> tuple[Array, Array]:
    """Residual (rows, n) at ``x`` and sensitivities (rows, n, q), one-sided near a bound."""
    ones = np.ones(len(x))
    up, down = problem.inward(x, ones), problem.inward(x, -ones)
    residuals = problem.residuals(np.vstack([x, problem.perturbations(x, up), problem.perturbations(x, down)]))
    base, moved = residuals[0], np.split(residuals[1:], 2)
    forward, backward = map(problem.jacobian, (base, base), moved, (up, down))
    central = 0.5 * (forward + backward)
    shown = limiting(problem, x)
    lost = central[..., TORQUE_LIMIT] - np.where(shown, forward[..., TORQUE_LIMIT], 0.0)
    central[..., TORQUE_LIMIT] -= lost
    central[..., STIFFNESS] += lost  # the slope along the common scale stays what was simulated
    return base, central


GAIN = 0.02
"""Least gain of a limit that shows, and first gain of one that is tried; chosen"""


def limiting(problem: Problem, x: Array) -> Mask:
    """(n,) whether each joint's motion is explained worse without its torque limit in ``x`` (k,)."""
    place = problem.layout.at("torque_limit")
    lifted = np.tile(x, (problem.joints, 1))
    np.fill_diagonal(lifted[:, place], problem.prior.upper[place])
    losses = loss(problem.residuals(np.vstack([x, lifted]))).sum(axis=1)
    return (1.0 - GAIN) * np.diag(losses[1:]) > losses[0]


COMMON = 0.10
"""Sigma of the log mass of all links; chosen"""
STEP = 0.05
"""Finite-difference step of the logarithms; chosen"""


def fixed_covariance(
    problem: Problem, found: Fit, residual: Array, jacobian: Array, weight: Array, curvature: Array
) -> Array:
    """Covariance (k, k) of an estimate by what it holds fixed.

    ``residual`` (rows, n), ``jacobian`` (rows, n, q), ``weight`` (rows, n) and ``curvature`` (k, k), with
    the prior, at the estimate.
    """
    moved = []
    for other, sigma in others(problem.replay):
        path = other.predict(unpack(found.vector[None]))[0]
        change = (path - problem.measured - residual) * (sigma / STEP)
        pull = problem.system(jacobian, weight, change)[1]
        moved.append(np.where(problem.frozen | found.at_bound, 0.0, pull))
    by = np.linalg.solve(curvature, np.array(moved).T)
    return by @ by.T


def others(replay: Replay) -> Iterator[tuple[Replay, float]]:
    """Replays with one thing changed by `STEP` that a fit holds fixed, and its sigma."""
    arm, every = replay.arm, np.ones(replay.arm.joints)
    for factor, sigma in ((every, COMMON), *((row, MASS) for row in np.eye(arm.joints))):
        change = np.exp(STEP * factor)
        heavier = replace(arm, mass=arm.mass * change, inertia=arm.inertia * change[:, None, None])
        yield replace(replay, arm=heavier), sigma
    for row in np.eye(arm.joints):
        yield replace(replay, arm=replace(arm, com=arm.com * np.exp(STEP * row)[:, None])), CENTRE
