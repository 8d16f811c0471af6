"""Fit of a twin to the free motion of several logs: first what it must hold, then its values.

A part of the motion decides on the structure (`rejoint.twin.structure`): limits of torque and reference speed only if
the arm has reached them, and how much a joint sticks. Then windows spread over all motions are fitted. Those that no
twin of the structure follows as it follows the others count less, or not at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.logs.exclusions import Exclusions
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.twin.fit import SCALES, Fit, Problem, fit
from rejoint.twin.holdout import HoldOut
from rejoint.twin.judge import TIMESTEP
from rejoint.twin.replay import Replay, Window
from rejoint.twin.segments import SHORTEST as LEAST
from rejoint.twin.segments import by_motion, fastest, free_windows, merged, thin
from rejoint.twin.structure import (
    STICTIONS,
    Structure,
    expressible,
    find_acceleration,
    find_structure,
    rough_fit,
    simplest,
)
from rejoint.twin.unknown import unknown_prior

CLUSTERED = 8
"""From as many motions on, intervals rest on the differences between motions, below on those between windows
(chosen: a covariance of fewer clusters is mostly noise)"""

STRIDE = 2.5
"""Finite-difference steps over those for an excitation, 11 % of a stiffness: along the common scale of a joint's
torques, which logs hardly fix, smaller ones measure stick-slip (measured on one pair of disjoint halves of a real
low-cost arm's logs: with 4.5 % the elbow's stiffnesses end 60 % apart, with 12 % they end 12 % apart)"""
REFINEMENT = 6
"""Most steps of the final descent, which starts at the optimum of a part of its data, with the finite differences of an
excitation: large ones stop short of the optimum (chosen: two or three do on a real low-cost arm)"""
MEMORY = 1.0
"""[s] of motion that count as one observation beside the prior. By their autocorrelation 0.1 to 0.4 s would, and one
motion then overrules the prior where it hardly tells (measured: an inertia of the shoulder pan three times that of the
other motions, for 1 % of the loss). With 3 s the prior overruled a minute of a lone servo (measured, by others), and
on a real low-cost arm nothing is gained by them (four folds: 2.45 mm with 3 s and 2.46 mm with 1 s, a single trial)"""

FREEDOM = 2.0
"""Degrees of freedom of the errors of windows (chosen: with so few, up to a third of them may be as far off as
they like; with the usual four it is a fifth, which is one motion of five)"""

SHORTEST = 10.0
"""[s] of free motion below which an identification is refused (chosen: ten observations of each joint)"""


@dataclass(frozen=True, kw_only=True)
class LogSettings:
    """How to identify from logs; the defaults take about 30 s of processor time however long the logs are."""

    hold_out: HoldOut = field(default_factory=HoldOut)
    """which motions are kept from the fit that is judged"""
    window: float = 8.0
    """[s] between restarts from the measured state; 1 to 50 s make no difference (measured on a real arm)"""
    coarse_seconds: float = 100.0
    """[s] of motion that decides on the structure"""
    fit_seconds: float = 400.0
    """[s] of motion of the final fit, spread over all motions"""
    fast_seconds: float = 40.0
    """[s] of the motion that accelerates most: it decides on a limited acceleration and is always fitted"""
    contact_seconds: float = 240.0
    """[s] of motion in contact that the table is fitted to (measured: with 80 s errors in contact are up to a fifth
    larger, single trials)"""
    table: bool = True
    """whether to fit a table where the arm touches one"""
    table_height: float | None = None
    """[m] of the tip on the table; None finds it in the logs"""
    stictions: tuple[float, ...] = STICTIONS
    """ratios of friction at rest to friction in motion that are tried"""
    timestep: float = TIMESTEP
    threads: int = 2


DEFAULT_LOG_SETTINGS = LogSettings()


def fit_motions(
    arm: Arm,
    logs: Sequence[RunLog],
    excluded: Sequence[Exclusions],
    settings: LogSettings = DEFAULT_LOG_SETTINGS,
    on_progress: Progress = no_progress,
) -> tuple[Problem, Fit, Structure]:
    """Find the structure of a twin for the free motion of logs, and fit it.

    InputError where there is too little free motion.
    """
    windows = free_windows(logs, excluded, settings.window)
    seconds = sum(float(logs[w.log].time[w.last - 1] - logs[w.log].time[w.first]) for w in windows)
    if seconds < SHORTEST:
        whole = sum(float(log.time[-1] - log.time[0]) for log in logs)
        raise InputError(
            f"identification: {seconds:.0f} s of free motion in stretches of {LEAST:g} s and more, of {whole:.0f} s "
            f"in {len(logs)} log(s), expected at least {SHORTEST:.0f} s; record longer motions, off table and stops"
        )
    belief = unknown_prior(arm)

    def problem(chosen: Sequence[Window], structure: Structure, threads: int = settings.threads) -> Problem:
        return _problem(arm, logs, chosen, structure, settings, threads)

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
    return *settle(arm, logs, excluded, found.structure, found.vector, settings), found.structure


def settle(
    arm: Arm, logs: Sequence[RunLog], excluded: Sequence[Exclusions], structure: Structure, start: Array | None,
    settings: LogSettings = DEFAULT_LOG_SETTINGS,
) -> tuple[Problem, Fit]:  # fmt: skip
    """Fit windows spread over all of the logs, from the optimum ``start`` (k,) of a part of them, sought if None."""
    windows = free_windows(logs, excluded, settings.window)
    if start is None:
        slow = thin(windows, logs, settings.coarse_seconds)
        start = rough_fit(_problem(arm, logs, slow, structure, settings, settings.threads))
    fast = fastest(windows, logs, settings.fast_seconds)
    every = merged(thin(windows, logs, settings.fit_seconds), fast)
    problem = _problem(arm, logs, every, structure, settings, settings.threads, stride=1.0)
    return problem, fit(problem, start, REFINEMENT, SCALES)


def _problem(
    arm: Arm, logs: Sequence[RunLog], windows: Sequence[Window], structure: Structure, settings: LogSettings,
    threads: int, stride: float = STRIDE,
) -> Problem:  # fmt: skip
    replay = Replay(
        arm, logs, windows, settings.timestep, threads, structure.stiction, acceleration=structure.acceleration
    )
    return Problem(replay, structure.prior, structure.frozen, stride, MEMORY, FREEDOM)


def independent(problem: Problem) -> NDArray[np.integer]:
    """(rows,) numbers of the stretches that intervals take as independent: motions, or windows where there are few."""
    windows = problem.replay.windows
    return by_motion(windows) if len({w.log for w in windows}) >= CLUSTERED else problem.window
