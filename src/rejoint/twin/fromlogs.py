"""Identification from logs of several motions of a little-known arm.

Only free motion counts, whole motions are held out, priors are wide. After the judgement all motions are fitted, the
table last.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm
from rejoint.logs.exclusions import Exclusions, find_exclusions, table_height
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.twin.fit import Fit, Problem
from rejoint.twin.identify import fitted_twin
from rejoint.twin.judge import Candidate, judge
from rejoint.twin.judgement import NO_TWIN, Judgement, PredictionError
from rejoint.twin.motionfit import (
    DEFAULT_LOG_SETTINGS,
    MOSTLY,
    LogSettings,
    contact_windows,
    fit_motions,
    independent,
    part,
    repeated,
    settle,
    thin,
)
from rejoint.twin.parameters import healthy_parameters, is_hobby, unpack
from rejoint.twin.replay import Replay, powered
from rejoint.twin.table import TablePlane
from rejoint.twin.tablefit import fit_table
from rejoint.twin.twin import HeldOut, Twin
from rejoint.twin.uncertainty import uncertainty

FITTED, HEALTHY = "fitted twin", "healthy twin"
"""Predictions besides `NO_TWIN`"""

LEAST_CONTACT = 5.0
"""[s] least contact for a table fit; chosen"""


FOLLOWED = 0.4
"""Least weight of a motion's worst joint without report; chosen"""
REFITTED = "errors on held-out motion are those of a fit that had not seen it; the values are fitted to all motions"
NOTHING = "the motions tell no joint's stiffness, damping or friction"
REPEATED = "the motions held out repeat those that were fitted: errors on other motion are larger"
UNJUDGED = "no motion was held out: the errors are those on the motions that were fitted"


@dataclass(frozen=True, kw_only=True, eq=False)
class LogIdentification:
    """Result of an identification from logs."""

    twin: Twin
    """``held_out`` are the free-space means of ``judgement``"""
    fitted: tuple[str, ...]
    """motions in the fit"""
    judgement: Judgement
    """on held-out motions"""


def identify_logs(
    arm: Arm,
    logs: Sequence[RunLog],
    settings: LogSettings = DEFAULT_LOG_SETTINGS,
    on_progress: Progress = no_progress,
    beside: Sequence[Candidate] = (),
) -> LogIdentification:
    """Fit a twin to logs; judge it, and the candidates ``beside`` it, on held-out motions.

    The returned twin is fitted to all logs. InputError for another arm or too little motion.
    """
    for log in logs:
        log.require(arm.name, arm.joint_names)
    logs = powered(logs)
    seen, unseen = part(arm, logs, settings.hold_out)
    every, fitted = sorted(logs, key=lambda log: log.label), tuple(log.label for log in seen)
    height = settings.table_height if settings.table_height is not None else table_height(arm, seen)
    excluded = find_exclusions(arm, seen, height)
    on_progress(0.0, "search")
    problem, found, structure = fit_motions(arm, seen, excluded, settings, on_progress)
    table = _fit_table(problem, found, excluded, height, settings)
    on_progress(0.7, "held-out motions")
    candidates = [
        Candidate(
            name=FITTED,
            parameters=unpack(found.vector, arm.joints),
            stiction=structure.stiction,
            table=table,
            acceleration=structure.acceleration,
        ),
        *([Candidate(name=HEALTHY, parameters=healthy_parameters(arm), stiction=1.0)] if is_hobby(arm) else []),
        *beside,
    ]
    judgement = judge(arm, candidates, unseen, table=height, timestep=settings.timestep, threads=settings.threads)
    on_progress(0.8, "all motions")
    note, missing = UNJUDGED, [*judgement.doubts, UNJUDGED]
    if settings.hold_out.names != ():
        alike = bool(np.mean(np.concatenate(repeated(unseen, seen))) > MOSTLY)
        note, missing, seen = REFITTED, [*judgement.doubts, *[REPEATED] * alike], every
        excluded = find_exclusions(arm, every, height)
        problem, found = settle(arm, every, excluded, structure, found.vector, settings)
    on_progress(0.9, "table and intervals")
    with ThreadPoolExecutor(settings.threads) as pool:  # side by side: neither needs the other
        known = pool.submit(lambda: uncertainty(problem, found, independent(problem)))
        on_table = pool.submit(_fit_table, problem, found, excluded, height, settings, table)
        knowledge, table = known.result(), on_table.result()
    twin = fitted_twin(problem, found, knowledge, _held_out(judgement), table)
    notes = (*twin.notes, *_hard_to_follow(problem, found, seen), note)
    on_progress(1.0, "done")
    judgement = replace(judgement, doubts=(*missing, *_unidentified(twin)))
    return LogIdentification(twin=replace(twin, notes=notes), fitted=fitted, judgement=judgement)


def _fit_table(
    problem: Problem,
    found: Fit,
    excluded: Sequence[Exclusions],
    height: float | None,
    settings: LogSettings,
    start: TablePlane | None = None,
) -> TablePlane | None:
    if height is None or not settings.table:
        return None
    replay, parameters = problem.replay, unpack(found.vector, problem.joints)
    windows = contact_windows(replay.logs, excluded, settings.window)
    seconds = sum(float(replay.logs[w.log].time[w.last - 1] - replay.logs[w.log].time[w.first]) for w in windows)
    if seconds < LEAST_CONTACT:
        return None
    chosen = thin(windows, replay.logs, settings.contact_seconds)
    touching = Replay(
        replay.arm, replay.logs, chosen, settings.timestep, settings.threads, replay.stiction, replay.acceleration
    )
    return fit_table(touching, parameters, height, start)


def _unidentified(twin: Twin) -> list[str]:
    kinds = {name.partition(".")[0] for name, known in zip(twin.names, twin.identified, strict=True) if known}
    return [] if kinds & {"stiffness", "damping", "coulomb"} else [NOTHING]


def _hard_to_follow(problem: Problem, found: Fit, logs: Sequence[RunLog]) -> list[str]:
    motion = np.array([w.log for w in problem.replay.windows])[problem.window]
    weight = {logs[i].label: float(found.weights.share[motion == i].mean(axis=0).min()) for i in np.unique(motion)}
    low = {label: share for label, share in weight.items() if share < FOLLOWED}
    if not low:
        return []
    named = ", ".join(f"{label} ({share:.2f})" for label, share in sorted(low.items(), key=lambda pair: pair[1]))
    return [f"weighed down, for no twin of this structure follows them as it follows the others: {named}"]


def _held_out(judgement: Judgement) -> HeldOut:
    def error(name: str) -> PredictionError:
        found = judgement.mean[name].free or judgement.mean[name].all
        if found is None:
            raise InputError("identification: the held-out motions hold no usable row; hold out others")
        return found

    seconds = sum(motion.seconds - motion.contact_seconds - motion.left_out_seconds for motion in judgement.motions)
    healthy = error(HEALTHY) if HEALTHY in judgement.mean else None
    return HeldOut(seconds=seconds, no_twin=error(NO_TWIN), healthy_twin=healthy, twin=error(FITTED))
