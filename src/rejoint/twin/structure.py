"""What a twin needs to explain some logs: limits and friction that grows with load."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rejoint.arms import Array, Mask
from rejoint.diagnosis.measurement import sags
from rejoint.diagnosis.regression import fit_believed
from rejoint.diagnosis.segments import ExcitationLog
from rejoint.system.records import entity
from rejoint.twin.fit import GAIN, LIMIT_GAIN, SCALES, Problem, fit, line_up, loss, search
from rejoint.twin.parameters import LEAST_FED, Prior, is_hobby, number, unknown_prior, unpack

LIMITS = ("torque_limit", "ramp_speed")
"""Parameters that show only when reached"""
OPTIONAL = (*LIMITS, "load_friction")
"""Parameters that a twin has only where they explain motion"""
TOGETHER = ("torque_limit", "load_friction")
"""Those that may explain motion only together"""

USUAL_ACCELERATION = 39.0
"""[rad/s^2] limit of the reference's acceleration to try first; that of an STS3215"""
FACTORS = (2.0, 2.0 ** (1 / 3))
"""Steps to other limits, each fitted from the best until none is better; chosen"""
FASTEST = 160.0
"""[rad/s^2] of a limit that does not show any more; chosen"""
BETTER = 0.98
"""Loss over that of the best limit so far, of a better one; chosen"""
EARLIER = 0.01
"""[s] of delay that imitates a limited acceleration; measured"""

SHOWN = 1.0
"""Widest interval of a share of gravity that a sag shows; chosen"""
EARLY_GAIN = 0.05
"""Relative gain of a delay below zero; chosen: a wrong one gains 3 %, right ones 7 % and more"""

EITHER, ABSENT = 2.0, 1e-3
"""Sigma of Coulomb friction beside load friction over that without, and of no load friction; chosen"""
STARTS = 8
"""Candidates of the random search; chosen"""
NEAR = 0.2
"""Relative loss of a good first fit; chosen"""
EFFORT, TRIALS, WIDER = 3e4, 100, 2.0
"""Steps times squared joints of descents from random starts, trials for each, spread over the prior's"""
DESCENTS = 3
"""Descents for joints whose motion is not explained; measured: 6 are equal"""
SHORT = 3
"""Steps of a descent on few windows; chosen"""
ROUGH = 6
"""Steps of the first descent; chosen"""
FURTHER = 2
"""Steps from a similar optimum; chosen"""
SELDOM, OFTEN = 0.005, 0.02
"""Share of rows beyond a torque that counts as reached, chosen, and beyond one that a fit would miss; measured"""

_RAMPS = (1.5, 5.0)
"""[rad/s] tried"""
_TORQUES = (0.4, 0.7, 0.9)
"""Tried, over the largest torque without limit"""
_SHARES = (0.3,)
"""Load friction tried"""


@entity
class Structure:
    """What a fit may vary; by default without limits."""

    belief: Prior
    """of a twin with all of `OPTIONAL`"""
    frozen: tuple[str, ...] = OPTIONAL
    acceleration: float = np.inf
    """[rad/s^2] of the reference, while commands change"""

    @property
    def prior(self) -> Prior:
        """Belief without what is frozen; dry friction that may grow with load is less known."""
        belief, kind = self.belief, self.belief.layout.kind
        off = np.isin(kind, [number(name) for name in self.frozen if name in LIMITS])
        changed, factor = ("load_friction", ABSENT) if "load_friction" in self.frozen else ("coulomb", EITHER)
        return replace(
            belief,
            mean=np.where(off, belief.upper, belief.mean),
            sigma=np.where(kind == number(changed), factor, 1.0) * belief.sigma,
        )


def decide_compensation(data: ExcitationLog) -> Prior:
    """Prior of an arm known by its model, with the stiffness that torque or sag tells, but for hobby servos.

    It tells of equal servos too. Gravity that does not show in the sag is fed forward, or the model is too heavy.
    """
    belief = unknown_prior(data.arm)
    if is_hobby(data.arm):
        return belief
    layout = belief.layout
    stiffness, fed = layout.at("stiffness"), layout.at("compensation")
    softness, value, error = sags(data)
    rows = np.eye(len(layout.kind))[stiffness] / error[:, None]
    moved, covariance = fit_believed(rows, (value - belief.mean[stiffness]) / error, belief.precision)
    mean, sigma = belief.clip(belief.mean + moved), np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    low, high = 1.0 - np.exp(mean[stiffness]) * softness.T[::-1]
    shown = high - low < SHOWN
    least = np.where(shown & np.isfinite(error), -1.0, LEAST_FED)
    mean[fed] = np.clip(np.where(shown, 0.5 * (low + high), 0.0), least, 1.0)
    told = belief.sigma.copy()
    told[fed] = told[stiffness]
    sigma[fed] = np.where(shown, sigma[stiffness], told[fed])
    return replace(belief, mean=mean, sigma=sigma, correlation=correlation, told=told)


def rough_fit(problem: Problem) -> Array:
    """Fit (k,) from the prior's median, else a random search."""
    belief, measured = problem.prior, problem.measured
    x = fit(problem, fit(problem, belief.mean, SHORT).vector, SHORT, SCALES).vector
    no_twin = loss(problem.replay.commands - measured).sum(axis=0)
    if _ratio(_losses(problem, x), no_twin) < NEAR:
        return x
    rng = np.random.default_rng(0)
    y = search(problem, np.vstack([x, _drawn(problem, x, STARTS - 1, rng)]), rng, rounds=2)
    return fit(problem, y, ROUGH, SCALES).vector


def explored(problem: Problem, x: Array, joints: Mask | None = None) -> Array:
    """Best of ``x`` (k,) and of descents from random parameters of some ``joints`` (n,).

    By default from those of all joints and the arm, as many descents as are cheap: with few joints.
    """
    rows = max(len(problem.measured), problem.replay.seconds / problem.replay.timestep)  # simulated, or read
    count = int(EFFORT / (rows * problem.joints**2)) if joints is None else DESCENTS * int(joints.any())
    if count == 0:
        return x
    rng = np.random.default_rng(0)
    drawn = _drawn(problem, x, TRIALS * count, rng, WIDER)
    starts = drawn if joints is None else np.where(np.append(joints, False)[problem.owner], drawn, x)
    losses = [loss(problem.residuals(part)).sum(axis=(1, 2)) for part in np.array_split(starts, count)]  # memory
    order = np.argsort(np.concatenate(losses))[:count]
    found = [fit(problem, start, 2 * ROUGH, SCALES).vector for start in starts[order]]
    return search(problem, np.array([x, *found]), rng, rounds=1)


def _drawn(problem: Problem, x: Array, count: int, rng: np.random.Generator, wider: float = 1.0) -> Array:
    """Random vectors (count, k), with the frozen elements of ``x`` (k,)."""
    belief = problem.prior
    drawn = belief.mean + wider * belief.sigma * problem.layout.normal(rng, count)
    return belief.clip(np.where(problem.frozen, x, drawn))


def find_acceleration(make: Callable[[Structure], Problem], simple: Structure, start: Array) -> Structure:
    """Limit the reference's acceleration where that explains the windows farthest off, from ``start`` (k,).

    ``make`` turns a structure into a problem. Without evidence, that of ``simple`` holds.
    """
    usual = min(simple.acceleration, USUAL_ACCELERATION)

    def tried(acceleration: float, y: Array, before: float) -> tuple[Array, Array]:
        problem, moved = make(replace(simple, acceleration=acceleration)), y.copy()
        moved[problem.layout.at("delay")] += EARLIER * (float(before < np.inf) - float(acceleration < np.inf))
        found = fit(problem, moved, SHORT).vector
        return _losses(problem, found), found

    best, (losses, y) = usual, tried(usual, start, simple.acceleration)
    for factor in FACTORS:
        while True:
            near = {acceleration: tried(acceleration, y, best) for acceleration in (best / factor, best * factor)}
            nearest = min(near, key=lambda one: _ratio(near[one][0], losses))
            if nearest >= FASTEST or _ratio(near[nearest][0], losses) >= BETTER:
                break
            best, (losses, y) = nearest, near[nearest]
    held, without = (tried(acceleration, y, best)[0] for acceleration in (usual, np.inf))
    if _ratio(losses, without) < 1.0 - LIMIT_GAIN:
        return replace(simple, acceleration=best)
    return simple if _ratio(held, without) < 1.0 / (1.0 - LIMIT_GAIN) else replace(simple, acceleration=np.inf)


def find_structure(make: Callable[[Structure], Problem], structure: Structure, start: Array) -> tuple[Structure, Array]:
    """Compare structures on the same windows, from a simple one and its ``start`` (k,); returns the optimum too.

    ``make`` turns a structure into a problem. The delay is below zero only with evidence.
    """
    problem = make(structure)
    x = explored(problem, fit(problem, start, FURTHER, SCALES).vector)
    best = _losses(problem, x)
    for limit in OPTIONAL:
        frozen = tuple(name for name in structure.frozen if name != limit)
        # A reference has one limit: either its speed or its acceleration.
        acceleration = np.inf if limit == "ramp_speed" else structure.acceleration
        freed = replace(structure, frozen=frozen, acceleration=acceleration)
        problem = make(freed)
        y = with_limit(problem, x, limit)
        losses = _losses(problem, y)
        if _ratio(losses, best) < 1.0 - LIMIT_GAIN:
            structure, x, best = freed, y, losses
    belief = structure.belief
    lower = np.where(belief.layout.kind == number("delay"), 0.0, belief.lower)
    timely = replace(structure, belief=replace(belief, lower=lower))
    problem = make(timely)
    y = fit(problem, x, FURTHER, SCALES).vector
    early = _ratio(_losses(problem, x), _losses(problem, y)) < 1.0 - EARLY_GAIN
    return (structure, x) if early else (timely, y)


def with_limit(problem: Problem, x: Array, limit: str) -> Array:
    """Optimum (k,) with one limit freed, or ``x`` (k,) where that gains nothing."""
    place, before = problem.layout.at(limit), problem.residuals(x[None])
    values = {
        "torque_limit": np.log(np.outer(_TORQUES, drive_torque(problem, x))),
        "load_friction": _SHARES,
        "ramp_speed": np.log(_RAMPS),
    }[limit]
    fits = [x]
    for value in values:  # other parameters have stood for the limit so far
        start = x.copy()
        start[place] = value
        fits.append(fit(problem, start, FURTHER).vector)
    y = explored(problem, line_up(problem, np.array(fits), before, problem.weights(before[0]))[0])
    gains = _ratio(_losses(problem, y), loss(before[0]).sum(axis=0)) < 1.0 - GAIN
    return fit(problem, y, FURTHER).vector if gains else x


def with_both(problem: Problem, x: Array) -> Array:
    """Start (k,) with `TOGETHER` from an optimum ``x`` (k,) without them."""
    y = x.copy()
    y[problem.layout.at("torque_limit")] = np.log(_TORQUES[1] * drive_torque(problem, x))
    y[problem.layout.at("load_friction")] = _SHARES
    return y


def drive_torque(problem: Problem, x: Array, share: float = SELDOM, damping: float = 0.0) -> Array:
    """(n,) [N m] servo torque without limit, exceeded in a ``share`` of the rows; ``damping``: its part within."""
    parameters = unpack(x)
    lead = problem.replay.references(parameters) + parameters.offset - problem.measured
    lead -= damping * parameters.damping / parameters.stiffness * problem.replay.speed
    lead = np.minimum(np.abs(lead), np.abs(lead - problem.residuals(x[None])[0]))
    return np.quantile(parameters.stiffness * np.maximum(lead, problem.floor), 1.0 - share, axis=0)


def _losses(problem: Problem, x: Array) -> Array:
    return loss(problem.residuals(x[None])[0]).sum(axis=0)


def _ratio(losses: Array, reference: Array) -> float:
    least = np.finfo(float).tiny  # a joint that stands still is predicted without any loss
    return np.exp(np.mean(np.log((losses + least) / (reference + least))))
