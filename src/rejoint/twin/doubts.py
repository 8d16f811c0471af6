"""Why no prediction of some logs is to be trusted, however small its error: what the logs do not show.

An arm that stands still is predicted well by anything, readings that are copies of the commands by the commands, and
clocks that differ are fitted as a delay. So a twin is trusted only where joints moved, readings come often enough, on
the clock of the commands, and the twin predicts them better than the commands do, also when those are delayed by
whatever suits best.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.logs.exclusions import Exclusions
from rejoint.logs.runlog import RunLog
from rejoint.system.statistics import above_zero, bootstrap_mean

MOVED = np.radians(2.0)
"""[rad] of travel below which a joint has not moved: little more than friction hides (chosen)"""
COARSEST = 0.1
"""[s] between readings above which motion shows no friction and no lag (chosen, as for a diagnosis)"""
EARLIEST, LATEST = -0.05, 0.3
"""[s] by which readings may follow commands: two periods early where a recorder stamps late, and no servo that follows
at all is later (chosen)"""
LAGS = np.arange(-0.5, 0.81, 0.01)
"""[s] that are tried"""
ROWS = 1000
"""Rows of a log that a lag is sought in (chosen)"""
FEWEST = 3
"""Motions below which no interval is known (chosen, as for the report)"""
CLEARLY = 0.8
"""Error over that of the commands that counts as smaller there (chosen)"""


def doubts(arm: Arm, logs: Sequence[RunLog], rows: Sequence[Exclusions], paths: dict[str, list[Array]]) -> list[str]:
    """Say what is missing for any of the predictions ``paths`` of the logs to be trusted; empty where nothing is.

    The first of the paths is that of no twin.
    """
    found = []
    travel = max(float(np.ptp(log.position, axis=0).max()) for log in logs)
    if travel < MOVED:
        return [f"no joint moved by more than {np.degrees(travel):.2g} deg, expected at least {np.degrees(MOVED):g}"]
    period = float(np.median(np.concatenate([np.diff(log.time) for log in logs])))
    if period > COARSEST:
        found.append(f"readings are {period:.2g} s apart, expected at most {COARSEST:g} s")
    lag, left = command_lag(logs)
    if left < arm.encoder_step:
        found.append("the readings are copies of the commands, and show nothing of the arm")
    elif not EARLIEST <= lag <= LATEST:
        found.append(
            f"the readings follow the commands by {lag:.2f} s, expected {EARLIEST:g} to {LATEST:g} s: clocks differ"
        )
    twins = [paths[name] for name in list(paths)[1:]]
    delayed = [_delayed(log, lag) for log in logs]
    for name, without in (("the command", next(iter(paths.values()))), (f"the command {lag:.2f} s later", delayed)):
        if not any(_better(arm, logs, rows, twin, without) for twin in twins):
            found.append(f"no twin predicts measurably better than {name} does")
            break
    return found


def command_lag(logs: Sequence[RunLog]) -> tuple[float, float]:
    """Lag [s] of the commands that suits the readings of all logs best, and what it leaves [rad], root mean square.

    Joints that hardly move say nothing of it; a constant difference, such as sag, is left out.
    """
    totals, count = np.zeros(len(LAGS)), 0
    for log in logs:
        moving = np.flatnonzero(np.ptp(log.position, axis=0) > MOVED)
        if not len(moving):
            continue
        chosen = np.unique(np.linspace(0, len(log) - 1, min(len(log), ROWS)).astype(int))
        count += len(chosen) * len(moving)
        for i, lag in enumerate(LAGS):
            gap = (_delayed(log, float(lag))[chosen] - log.position[chosen])[:, moving]
            totals[i] += float(((gap - gap.mean(axis=0)) ** 2).sum())
    best = int(np.argmin(totals))
    return float(LAGS[best]), float(np.sqrt(totals[best] / max(count, 1)))


def _delayed(log: RunLog, lag: float) -> Array:
    """Commands (T, n) [rad] that were in force ``lag`` [s] before each reading."""
    return np.asarray(
        log.command[np.clip(np.searchsorted(log.time, log.time - lag, side="right") - 1, 0, len(log) - 1)]
    )


def _better(
    arm: Arm, logs: Sequence[RunLog], rows: Sequence[Exclusions], twin: Sequence[Array], without: Sequence[Array]
) -> bool:
    """Tell whether the tool is predicted measurably better in free space, over the motions."""

    def error(log: RunLog, path: Array, own: Exclusions) -> float:
        gap = tcp_position(arm, path[own.free]) - tcp_position(arm, log.position[own.free])
        return float(np.sqrt(np.mean(np.sum(gap**2, axis=-1))))

    known = [i for i, own in enumerate(rows) if own.free.any()]
    ours, theirs = (np.array([error(logs[i], path[i], rows[i]) for i in known]) for path in (twin, without))
    if len(known) < FEWEST:
        return bool(len(known) and ours.mean() < CLEARLY * theirs.mean())
    return above_zero(bootstrap_mean(theirs - ours, np.arange(len(known)), fewest=FEWEST))
