"""Identification from logs that somebody else recorded: several motions, an arm of which little is known.

What differs from an excitation (`rejoint.twin.identify`) is the data. Contacts, stops and dead readings
are found and left out. Whole motions are held out, not windows of motions that were seen, and what is
believed before any data is wide. A first fit to a part of the data decides what the twin must hold:
limits of torque and reference speed only if the arm has reached them, and how much a joint sticks. Then
all motions are fitted; the table, if there is one, last.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm
from rejoint.logs.exclusions import Exclusions, find_exclusions, table_height
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.twin.fit import SCALES, Fit, Problem, fit
from rejoint.twin.identify import fitted_twin
from rejoint.twin.judge import TIMESTEP, Candidate, judge
from rejoint.twin.judgement import NO_TWIN, Judgement
from rejoint.twin.parameters import healthy_parameters, unpack
from rejoint.twin.prediction import PredictionError
from rejoint.twin.replay import Replay, Window
from rejoint.twin.segments import by_motion, contact_windows, fastest, free_windows, merged, thin
from rejoint.twin.structure import (
    STICTIONS,
    Structure,
    expressible,
    find_acceleration,
    find_structure,
    rough_fit,
    simplest,
)
from rejoint.twin.table import TablePlane
from rejoint.twin.tablefit import fit_table
from rejoint.twin.twin import HeldOut, Twin
from rejoint.twin.uncertainty import CLUSTER, uncertainty
from rejoint.twin.unknown import unknown_prior

FITTED, HEALTHY = "fitted twin", "healthy twin"
"""Names of the predictions that a judgement holds beside `NO_TWIN`"""

FEW_MOTIONS = 4
"""Below as many motions the end of each is held out instead of whole motions (chosen)"""
KEPT_END = 0.25
"""Share of a motion that is held out then (chosen)"""
CLUSTERED = 8
"""From as many motions on, intervals rest on the differences between motions, below on those between windows
(chosen: a covariance of fewer clusters is mostly noise)"""

STRIDE = 2.5
"""Finite-difference steps over those for an excitation, 11 % of a stiffness: along the common scale of a joint's
torques, which logs hardly fix, smaller ones measure stick-slip (measured on one pair of disjoint halves of a real
low-cost arm's logs: with 4.5 % the elbow's stiffnesses end 60 % apart, with 12 % they end 12 % apart)"""
REFINEMENT = 2
"""Steps of the final descent, which starts at the optimum of a part of its data, with the finite differences of an
excitation: large ones stop short of the optimum (chosen: two more change held-out errors by less than 0.05 mm)"""
MEMORY = CLUSTER
"""[s] of motion that count as one observation beside the prior, as they do for the intervals of an excitation. By their
autocorrelation 0.1 to 0.4 s would, and a single motion then overrules the prior where it hardly tells (measured: an
inertia of the shoulder pan three times that of the other motions, for 1 % of the loss)"""

SHORTEST = 20.0
"""[s] of free motion below which an identification is refused (chosen, as for an excitation)"""
LEAST_CONTACT = 5.0
"""[s] of contact from which a table is fitted (chosen: more than one recovery)"""


@dataclass(frozen=True, kw_only=True)
class LogSettings:
    """How to identify from logs; the defaults take about 30 s of processor time however long the logs are."""

    hold_out: tuple[str, ...] | None = None
    """labels of the motions kept from the fit; None takes every ``hold_out_every``-th by name"""
    hold_out_every: int = 4
    window: float = 8.0
    """[s] between restarts from the measured state; 1 to 50 s make no difference (measured on a real arm)"""
    coarse_seconds: float = 100.0
    """[s] of motion that decides on the structure"""
    fit_seconds: float = 400.0
    """[s] of motion of the final fit, spread over all motions"""
    fast_seconds: float = 40.0
    """[s] of the motion that accelerates most: it decides on a limited acceleration and is always fitted"""
    contact_seconds: float = 80.0
    """[s] of motion in contact that the table is fitted to"""
    table: bool = True
    """whether to fit a table where the arm touches one"""
    table_height: float | None = None
    """[m] of the tip on the table; None finds it in the logs"""
    stictions: tuple[float, ...] = STICTIONS
    """ratios of friction at rest to friction in motion that are tried"""
    timestep: float = TIMESTEP
    threads: int = 2


DEFAULT_LOG_SETTINGS = LogSettings()


@dataclass(frozen=True, kw_only=True, eq=False)
class LogIdentification:
    """What logs have told about an arm."""

    twin: Twin
    """with the table, if there is one; ``twin.held_out`` are the free-space means of ``judgement``"""
    fitted: tuple[str, ...]
    """motions that the fit has seen"""
    judgement: Judgement
    """of the fitted twin, a healthy one and none, on the motions that the fit has not seen"""


def identify_logs(
    arm: Arm,
    logs: Sequence[RunLog],
    settings: LogSettings = DEFAULT_LOG_SETTINGS,
    on_progress: Progress = no_progress,
    beside: Sequence[Candidate] = (),
) -> LogIdentification:
    """Fit a twin to logs and judge it, and the candidates ``beside`` it, on those kept from the fit.

    InputError if the logs are of another arm, hold too little free motion, or lack a motion that is to be held out.
    """
    for log in logs:
        log.require(arm.name, arm.joint_names)
    seen, unseen = hold_out(logs, settings)
    height = settings.table_height if settings.table_height is not None else table_height(arm, seen)
    excluded = find_exclusions(arm, seen, height)
    on_progress(0.0, "search")
    problem, found = fit_motions(arm, seen, excluded, settings, on_progress)
    on_progress(0.7, "table and intervals")
    with ThreadPoolExecutor(settings.threads) as pool:  # side by side: neither needs the other
        known = pool.submit(lambda: uncertainty(problem, found, independent(problem)))
        on_table = pool.submit(_fit_table, problem, found, excluded, height, settings)
        knowledge, table = known.result(), on_table.result()
    on_progress(0.9, "held-out motions")
    parameters, replay = unpack(found.vector, arm.joints), problem.replay
    candidates = [
        Candidate(
            name=FITTED, parameters=parameters, stiction=replay.stiction, table=table, acceleration=replay.acceleration
        ),
        Candidate(name=HEALTHY, parameters=healthy_parameters(arm), stiction=1.0),
        *beside,
    ]
    judgement = judge(arm, candidates, unseen, table=height, timestep=settings.timestep, threads=settings.threads)
    twin = fitted_twin(problem, found, knowledge, _held_out(judgement), table)
    on_progress(1.0, "done")
    return LogIdentification(twin=twin, fitted=tuple(log.label for log in seen), judgement=judgement)


def hold_out(logs: Sequence[RunLog], settings: LogSettings) -> tuple[list[RunLog], list[RunLog]]:
    """Part logs into those to fit and those to judge by; of few motions the last quarter of each is judged."""
    ordered = sorted(logs, key=lambda log: log.label)
    names = [log.label for log in ordered]
    if len(set(names)) != len(names):
        raise InputError("identification: two motions have the same label; give each its own")
    if settings.hold_out is not None:
        missing = sorted(set(settings.hold_out) - set(names))
        if missing or not settings.hold_out or len(settings.hold_out) >= len(names):
            raise InputError(
                f"identification: motions to hold out {', '.join(missing or settings.hold_out) or '(none)'}; expected "
                f"some, but not all, of {', '.join(names)}"
            )
        kept = set(settings.hold_out)
    elif len(ordered) < FEW_MOTIONS:
        cuts = [int(len(log) * (1.0 - KEPT_END)) for log in ordered]
        seen = [log.rows(slice(0, cut)) for log, cut in zip(ordered, cuts, strict=True)]
        ends = [log.rows(slice(cut, None)) for log, cut in zip(ordered, cuts, strict=True)]
        return seen, [replace(end, label=f"{end.label} (end)") for end in ends]
    else:
        kept = set(names[:: settings.hold_out_every])
    return [log for log in ordered if log.label not in kept], [log for log in ordered if log.label in kept]


def fit_motions(
    arm: Arm,
    logs: Sequence[RunLog],
    excluded: Sequence[Exclusions],
    settings: LogSettings,
    on_progress: Progress = no_progress,
) -> tuple[Problem, Fit]:
    """Fit the free motion of logs: a part of the windows decides on the structure, more of them on the values."""
    windows = free_windows(logs, excluded, settings.window)
    seconds = sum(float(logs[w.log].time[w.last - 1] - logs[w.log].time[w.first]) for w in windows)
    if seconds < SHORTEST:
        raise InputError(f"identification: {seconds:.0f} s of free motion, expected at least {SHORTEST:.0f} s")
    belief = unknown_prior(arm)

    def problem(
        chosen: Sequence[Window], structure: Structure, threads: int = settings.threads, stride: float = STRIDE
    ) -> Problem:
        replay = Replay(
            arm, logs, chosen, settings.timestep, threads, structure.stiction, acceleration=structure.acceleration
        )
        return Problem(replay, structure.prior, structure.frozen, stride, MEMORY)

    fast = fastest(windows, logs, settings.fast_seconds)
    slow = thin(windows, logs, settings.coarse_seconds)
    simple = simplest(belief, settings.stictions[0], arm.servo_acceleration)
    x = rough_fit(problem(slow, simple))
    on_progress(0.3, "structure")
    expected, simple = simple, find_acceleration(lambda structure: problem(fast, structure), simple, x)
    if np.isinf(simple.acceleration) != np.isinf(expected.acceleration):
        x = rough_fit(problem(slow, simple))
    usable = expressible(problem(merged(slow, fast), simple), x)
    found = find_structure(
        lambda structure, threads: problem(usable, structure, threads), belief, simple, settings.stictions, x,
        settings.threads,
    )  # fmt: skip
    on_progress(0.5, "fit")
    every = problem(merged(thin(windows, logs, settings.fit_seconds), fast), found.structure)
    chosen = expressible(every, found.vector)
    return problem(chosen, found.structure), fit(
        problem(chosen, found.structure, stride=1.0), found.vector, REFINEMENT, SCALES
    )


def _fit_table(
    problem: Problem, found: Fit, excluded: Sequence[Exclusions], height: float | None, settings: LogSettings
) -> TablePlane | None:
    """Fit the table to motion in contact; None where there is none or too little of it."""
    if height is None or not settings.table:
        return None
    replay, parameters = problem.replay, unpack(found.vector, problem.joints)
    windows = contact_windows(replay.logs, excluded, settings.window)
    seconds = sum(float(replay.logs[w.log].time[w.last - 1] - replay.logs[w.log].time[w.first]) for w in windows)
    if seconds < LEAST_CONTACT:
        return None
    chosen = thin(windows, replay.logs, settings.contact_seconds)
    touching = Replay(
        replay.arm, replay.logs, chosen, settings.timestep, settings.threads, replay.stiction, on_table=True,
        acceleration=replay.acceleration,
    )  # fmt: skip
    return fit_table(touching, parameters, height)


def independent(problem: Problem) -> NDArray[np.integer]:
    """(rows,) numbers of the stretches that intervals take as independent: motions, or windows where there are few."""
    windows = problem.replay.windows
    return by_motion(windows) if len({w.log for w in windows}) >= CLUSTERED else problem.window


def _held_out(judgement: Judgement) -> HeldOut:
    def error(name: str) -> PredictionError:
        found = judgement.mean[name].free or judgement.mean[name].all
        if found is None:
            raise InputError("identification: the held-out motions hold no usable row; hold out others")
        return PredictionError(joints=np.array(found.joints), joint=found.joint, tcp=found.tcp)

    seconds = sum(motion.seconds - motion.contact_seconds - motion.left_out_seconds for motion in judgement.motions)
    return HeldOut(seconds=seconds, no_twin=error(NO_TWIN), healthy_twin=error(HEALTHY), twin=error(FITTED))
