"""Identification: a twin with intervals from logs of an excitation, judged on held-out windows.

Coarse fit from many starts (`rejoint.twin.fit`), final one, intervals (`rejoint.twin.uncertainty`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, gravity_torque
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.twin.declaration import TIMESTEP
from rejoint.twin.fit import Fit, Problem, fit, search
from rejoint.twin.judgement import prediction_error
from rejoint.twin.loads import prior_by_loads
from rejoint.twin.parameters import (
    Layout,
    Prior,
    TwinParameters,
    healthy_parameters,
    is_hobby,
    pack,
    prior,
    unpack,
)
from rejoint.twin.replay import Replay, cut, divide, measured_velocity
from rejoint.twin.twin import HeldOut, Twin
from rejoint.twin.uncertainty import CLUSTER, uncertainty


@dataclass(frozen=True, kw_only=True)
class IdentifySettings:
    """Settings of an identification."""

    window: float = 6.0
    """[s] between restarts from the measured state; measured: 1 to 50 s are equal"""
    coarse_window: float = 2.0
    """[s] the same for the search"""
    hold_out: int = 4
    """every hold_out-th window is held out"""
    starts: int = 24
    """candidates per round of the random search"""
    timestep: float = TIMESTEP
    """[s] of the final fit"""
    iterations: int = 15
    threads: int = 2
    seed: int = 0


DEFAULT_SETTINGS = IdentifySettings()

IDENTIFIED = 0.5
"""Sigma over the prior's of an identified parameter; chosen"""

STILL_SPEED = 0.03
"""[rad/s] of a still joint; chosen"""

SHORTEST = 20.0
"""[s] least motion; chosen"""


def identify(
    arm: Arm,
    logs: Sequence[RunLog],
    settings: IdentifySettings = DEFAULT_SETTINGS,
    on_progress: Progress = no_progress,
) -> Twin:
    """Fit a twin to an excitation; InputError for another arm or too little motion."""
    seconds = sum(float(log.time[-1] - log.time[0]) for log in logs)
    windows = cut(logs, settings.window)
    seen = [w for i, w in enumerate(windows) if i % settings.hold_out != settings.hold_out - 1]
    unseen = [w for i, w in enumerate(windows) if i % settings.hold_out == settings.hold_out - 1]
    if seconds < SHORTEST or not unseen:
        raise InputError(
            f"identification: {seconds:.0f} s of motion in {len(windows)} windows of about {settings.window:g} s, "
            f"expected at least {SHORTEST:.0f} s and {settings.hold_out} windows, one held out; record a longer log"
        )
    belief = prior_by_loads(arm, logs) or prior(arm)

    period = seconds / sum(len(log) - 1 for log in logs)
    pieces = divide(seen, round(settings.coarse_window / period))
    coarse = Problem(Replay(arm, logs, pieces, 2 * settings.timestep, settings.threads), belief)
    fine = Problem(Replay(arm, logs, seen, settings.timestep, settings.threads), belief)
    rng = np.random.default_rng(settings.seed)
    on_progress(0.0, "search")
    x = search(coarse, _starts(arm, belief, settings.starts, rng), rng)
    on_progress(0.3, "descent")
    x = fit(coarse, x, settings.iterations).vector
    x = search(coarse, np.tile(x, (settings.starts, 1)), rng, rounds=2)
    on_progress(0.6, "refinement")
    found = fit(fine, x, settings.iterations)
    on_progress(0.9, "intervals")
    held_out = _held_out(replace(fine.replay, windows=unseen), found.vector)
    twin = fitted_twin(fine, found, fine.clusters(CLUSTER), held_out)
    on_progress(1.0, "done")
    return twin


def fitted_twin(problem: Problem, found: Fit, clusters: NDArray[np.integer], held_out: HeldOut) -> Twin:
    """Assemble a twin with its intervals by ``clusters`` (rows,); the torques seen bound it."""
    replay, belief, parameters = problem.replay, problem.prior, unpack(found.vector, problem.joints)
    covariance = uncertainty(problem, found, clusters)
    narrowing = np.sqrt(np.diag(covariance)) / belief.sigma
    identified = (narrowing < IDENTIFIED) & ~found.at_bound & ~problem.frozen
    held = largest_static_torque(replay.arm, replay.logs, parameters.coulomb)
    limited = identified[problem.layout.at("torque_limit")]
    shown = np.where(limited, held, np.maximum(held, largest_drive_torque(problem, parameters)))
    lower = unpack(belief.lower, problem.joints)
    raised = np.clip(shown, lower.torque_limit, 0.99 * parameters.torque_limit)
    twin = Twin(
        arm=replay.arm.name,
        joint_names=replay.arm.joint_names,
        parameters=parameters,
        covariance=covariance,
        lower=pack(replace(lower, torque_limit=raised)),
        upper=belief.upper,
        narrowing=narrowing,
        identified=identified,
        held_out=held_out,
        fit_seconds=replay.seconds,
        stiction=replay.stiction,
        acceleration=replay.acceleration,
    )
    return replace(twin, notes=tuple(_notes(twin, found, held)))


def _starts(arm: Arm, belief: Prior, count: int, rng: np.random.Generator) -> Array:
    drawn = belief.mean + belief.sigma * Layout(arm.joints).normal(rng, max(count - 2, 1))
    starts = np.vstack([belief.mean, pack(healthy_parameters(arm)), drawn])
    of_arm = Layout(arm.joints).of_arm
    starts[2:, of_arm] = belief.mean[of_arm]
    return np.clip(starts, belief.lower, belief.upper)


def _held_out(replay: Replay, vector: Array) -> HeldOut:
    arm, measured = replay.arm, np.concatenate(replay.measured())
    both = np.vstack([vector, *([pack(healthy_parameters(arm))] if is_hobby(arm) else [])])
    predicted = [np.concatenate(replay.commands()), *np.concatenate(replay.predict(unpack(both, arm.joints)), axis=1)]
    no_twin, twin, *healthy = (prediction_error(arm, positions, measured) for positions in predicted)
    return HeldOut(seconds=replay.seconds, no_twin=no_twin, healthy_twin=healthy[0] if healthy else None, twin=twin)


def largest_static_torque(arm: Arm, logs: Sequence[RunLog], coulomb: Array) -> Array:
    """(n,) [N m] largest gravity torque held, less friction."""
    largest = np.zeros(arm.joints)
    for log in logs:
        still = np.abs(measured_velocity(log)) < STILL_SPEED
        held = np.where(still, np.abs(gravity_torque(arm, log.position)) - coulomb, 0.0)
        largest = np.maximum(largest, held.max(axis=0))
    return largest


def largest_drive_torque(problem: Problem, parameters: TwinParameters) -> Array:
    """(n,) [N m] servo torque without limit, exceeded in one row of 200."""
    lead = np.concatenate(problem.replay.references(parameters)) + parameters.offset - problem.measured
    return np.quantile(np.abs(parameters.stiffness * lead), 0.995, axis=0)


def _notes(twin: Twin, found: Fit, held: Array) -> list[str]:
    notes, held_out = [], twin.held_out
    if twin.unknown_scale:
        notes.append(
            f"only the ratios of stiffness, damping, friction, inertia and torque limit are known, not their common "
            f"scale: {', '.join(twin.unknown_scale)}"
        )
    if not found.converged:
        notes.append(f"the fit still improved after {found.iterations} steps; more iterations may help")
    pressed = [name for name, at in zip(twin.names, found.at_bound, strict=True) if at]
    if pressed:
        notes.append(f"held at a physical bound: {', '.join(pressed)}")
    rivals = [held_out.no_twin, *([held_out.healthy_twin] if held_out.healthy_twin else [])]
    if held_out.twin.joint > min(rival.joint for rival in rivals):
        notes.append(
            "on motion it has not seen the twin predicts worse than a healthy twin or none: do not train in it"
        )
    weak = twin.parameters.torque_limit < 1.1 * held
    if weak.any():
        names = ", ".join(name for name, is_weak in zip(twin.joint_names, weak, strict=True) if is_weak)
        notes.append(f"torque limit close to the gravity torque held in the log: {names}")
    return notes
