"""Fit of a twin to the free motion of several logs: windows, held-out motions, structure, values.

Part of the motion decides on the structure (`rejoint.twin.structure`). Held-out motions are drawn among similar ones,
by contact and commanded speed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from rejoint.arms import Arm, Array
from rejoint.logs.consistency import refuse_copies
from rejoint.logs.exclusions import Exclusions, find_exclusions, free_runs, table_height
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.twin.fit import SCALES, Fit, Problem, fit
from rejoint.twin.judge import MOVED, TIMESTEP
from rejoint.twin.parameters import unknown_prior
from rejoint.twin.replay import Replay, Window
from rejoint.twin.structure import (
    STICTIONS,
    Structure,
    decide_compensation,
    expressible,
    find_acceleration,
    find_structure,
    rough_fit,
    simplest,
)

SHORTEST_STRETCH = 2.0
"""[s] least free motion of a window; chosen"""

LEAD = 1.0
"""[s] of free motion before a contact; chosen"""


def free_windows(logs: Sequence[RunLog], excluded: Sequence[Exclusions], length: float) -> list[Window]:
    """Cut free motion into windows of at most about ``length`` [s]."""
    windows: list[Window] = []
    for index, (log, rows) in enumerate(zip(logs, excluded, strict=True)):
        for run in free_runs(rows.free, log.time, SHORTEST_STRETCH):
            windows += _pieces(index, log, run, length)
    return windows


def contact_windows(logs: Sequence[RunLog], excluded: Sequence[Exclusions], length: float) -> list[Window]:
    """Cut the surroundings of contacts into windows of about ``length`` [s]."""
    windows: list[Window] = []
    for index, (log, rows) in enumerate(zip(logs, excluded, strict=True)):
        for first, last in free_runs(rows.contact & rows.readable, log.time, SHORTEST_STRETCH):
            early = int(np.searchsorted(log.time, log.time[first] - LEAD))
            while not rows.readable[early:first].all():
                early += 1
            windows += _pieces(index, log, (early, last), length)
    return windows


def thin(windows: Sequence[Window], logs: Sequence[RunLog], seconds: float) -> list[Window]:
    """Keep about ``seconds`` [s] of the windows, evenly spread."""
    lengths = np.array([logs[w.log].time[w.last - 1] - logs[w.log].time[w.first] for w in windows])
    total = float(lengths.sum())
    if total <= seconds:
        return list(windows)
    # Taken whenever the time passed reaches the next multiple: long motions give more than short ones.
    passed = np.floor((np.cumsum(lengths) - 0.5 * lengths) * seconds / total / lengths.mean()).astype(int)
    chosen = np.diff(passed, prepend=-1) > 0
    return [w for w, wanted in zip(windows, chosen, strict=True) if wanted]


def fastest(windows: Sequence[Window], logs: Sequence[RunLog], seconds: float) -> list[Window]:
    """Keep about ``seconds`` [s] of the windows whose commands accelerate most.

    Not jumps to a constant goal, where a limited acceleration does not show.
    """

    def acceleration(w: Window) -> float:
        time, command = logs[w.log].time[w.first : w.last], logs[w.log].command[w.first : w.last]
        speed = np.diff(command, axis=0) / np.diff(time)[:, None]
        changing = speed != 0.0
        lasting = changing[:-2] & changing[1:-1] & changing[2:]
        change = (speed[2:] - speed[:-2]) / (time[2:-1] - time[:-3])[:, None]
        return float(np.sqrt(np.mean(np.where(lasting, change, 0.0) ** 2)))

    order = sorted(range(len(windows)), key=lambda i: -acceleration(windows[i]))
    lengths = np.array(
        [logs[windows[i].log].time[windows[i].last - 1] - logs[windows[i].log].time[windows[i].first] for i in order]
    )
    return [windows[i] for i in sorted(order[: int(np.searchsorted(np.cumsum(lengths), seconds)) + 1])]


def merged(one: Sequence[Window], other: Sequence[Window]) -> list[Window]:
    """Merge two selections of windows without duplicates."""
    every = {(w.log, w.first, w.last): w for w in (*one, *other)}
    return [every[key] for key in sorted(every)]


def by_motion(windows: Sequence[Window]) -> NDArray[np.integer]:
    """(rows,) motion number of each row of the windows."""
    motions = np.repeat([w.log for w in windows], [w.last - w.first for w in windows])
    return np.unique(motions, return_inverse=True)[1].ravel()


def _pieces(index: int, log: RunLog, run: tuple[int, int], length: float) -> list[Window]:
    first, last = run
    count = max(1, int(np.ceil(float(log.time[last - 1] - log.time[first]) / length - 0.05)))
    edges = np.linspace(first, last, count + 1).astype(int).tolist()
    return [Window(log=index, first=a, last=b) for a, b in pairwise(edges) if b - a > 2]


FEW_MOTIONS = 4
"""Motions from which whole ones are held out; chosen"""
KEPT_END = 0.25
"""Share of a motion held out, halved until `MOSTLY` is left; chosen"""
GRID, STEPS = 0.2, 10
"""[s] between samples of commands, and samples compared; chosen"""
ALIKE = 0.25
"""Distance of repeated commands over their own motion; chosen: half of `GRID` at constant speed is 0.17"""
MOSTLY = 0.5
"""Share of a motion; chosen"""


@dataclass(frozen=True, kw_only=True)
class HoldOut:
    """Which motions to hold out."""

    names: tuple[str, ...] | None = None
    """their labels; empty: none; None: drawn"""
    every: int = 4
    """one of as many is drawn"""
    seed: int = 0


def part(arm: Arm, logs: Sequence[RunLog], how: HoldOut) -> tuple[list[RunLog], list[RunLog]]:
    """Split logs into those to fit and those to judge; of few motions the end of each.

    Motion that repeats held-out commands is not fitted, unless names are given or too little would be left. Without
    hold-out both are all logs. InputError for duplicate, missing or all labels.
    """
    ordered = sorted(logs, key=lambda log: log.label)
    names = [log.label for log in ordered]
    if len(set(names)) != len(names):
        raise InputError("identification: two motions have the same label; give each its own")
    refuse_copies(ordered, "identification")
    if how.names is not None:
        missing = sorted(set(how.names) - set(names))
        if missing or len(how.names) >= len(names):
            raise InputError(
                f"identification: motions to hold out {', '.join(missing or how.names)}; expected some, but not all, "
                f"of {', '.join(names)}"
            )
        if not how.names:
            return ordered, ordered
        kept = set(how.names)
    elif len(ordered) < FEW_MOTIONS:
        return _ends(ordered)
    else:
        fold = folds(arm, ordered, how.every, how.seed)
        drawn = {name for name, number in zip(names, fold, strict=True) if number == 0}
        again = repeated(ordered, [log for log in ordered if log.label in drawn])
        kept = drawn | {name for name, same in zip(names, again, strict=True) if same.mean() > MOSTLY}
        kept = kept if len(kept) < len(names) else drawn
    return [log for log in ordered if log.label not in kept], [log for log in ordered if log.label in kept]


def _ends(logs: Sequence[RunLog]) -> tuple[list[RunLog], list[RunLog]]:
    for halvings in (0, 1, 2, 3, 4, 0):  # where even a short end repeats all the rest, as without a repetition
        cuts = [int(len(log) * (1.0 - KEPT_END * 0.5**halvings)) for log in logs]
        seen = [log.rows(slice(0, cut)) for log, cut in zip(logs, cuts, strict=True)]
        ends = [log.rows(slice(cut, None)) for log, cut in zip(logs, cuts, strict=True)]
        fresh = [
            replace(log.rows(slice(a, b)), label=f"{log.label} (from {log.time[a]:.1f} s)")
            for log, same in zip(seen, repeated(seen, ends), strict=True)
            for a, b in free_runs(~same, log.time, SHORTEST_STRETCH)
        ]
        if sum(map(len, fresh)) > MOSTLY * sum(map(len, logs)):
            seen = fresh
            break
    return seen, [replace(end, label=f"{end.label} (end)") for end in ends]


def repeated(logs: Sequence[RunLog], others: Sequence[RunLog]) -> list[NDArray[np.bool_]]:
    """Rows (T,) of each log whose commands move as some of ``others``."""
    known, found = cKDTree(np.concatenate([_stretches(log)[1] for log in others])), []
    for log in logs:
        start, paths = (values[:: STEPS // 2] for values in _stretches(log))
        steps = paths.reshape(len(paths), -1, STEPS)
        motion = np.linalg.norm(steps - steps.mean(axis=-1, keepdims=True), axis=(1, 2))
        same = start[(motion > MOVED) & (known.query(paths)[0] < ALIKE * motion)]
        latest = np.append(-np.inf, same)[np.searchsorted(same, log.time, side="right")]
        found.append(log.time - latest <= STEPS * GRID)
    return found


def _stretches(log: RunLog) -> tuple[Array, Array]:
    """Beginnings (S,) [s] and commands (S, n `STEPS`) [rad] of all stretches of a log; after its end it rests."""
    time = np.arange(log.time[0], log.time[-1] + GRID, GRID)
    path = np.stack([np.interp(time, log.time, column) for column in log.command.T], axis=1)
    path = np.pad(path, ((0, STEPS - 1), (0, 0)), mode="edge")
    return time, sliding_window_view(path, STEPS, axis=0).reshape(len(time), -1)


def folds(arm: Arm, logs: Sequence[RunLog], count: int, seed: int = 0) -> NDArray[np.integer]:
    """(K,) fold of each log, with motions of every kind."""
    touching = [rows.contact.any() for rows in find_exclusions(arm, logs, table_height(arm, logs))]
    speed = [float(np.sqrt(np.mean((np.diff(log.command, axis=0) / np.diff(log.time)[:, None]) ** 2))) for log in logs]
    order = sorted(range(len(logs)), key=lambda i: (bool(touching[i]), round(speed[i], 6), logs[i].label))
    rng, found = np.random.default_rng(seed), np.zeros(len(logs), dtype=int)
    for start in range(0, len(order), count):
        alike = order[start : start + count]
        found[alike] = rng.permutation(count)[: len(alike)]
    return found


CLUSTERED = 8
"""Motions from which intervals rest on them, not on windows; chosen"""

STRIDE = 2.5
"""Finite-difference steps over those for an excitation; measured: smaller ones fit stick-slip"""
REFINEMENT = 6
"""Most steps of the final descent; chosen"""
MEMORY = 1.0
"""[s] of one observation beside the prior; chosen"""

FREEDOM = 2.0
"""Degrees of freedom of window errors; chosen"""

SHORTEST = 10.0
"""[s] least free motion; chosen"""


@dataclass(frozen=True, kw_only=True)
class LogSettings:
    """Settings of an identification from logs."""

    hold_out: HoldOut = field(default_factory=HoldOut)
    window: float = 8.0
    """[s] between restarts from the measured state; measured: 1 to 50 s are equal"""
    coarse_seconds: float = 100.0
    """[s] for the structure"""
    fit_seconds: float = 400.0
    """[s] for the final fit"""
    fast_seconds: float = 40.0
    """[s] of the fastest motion, which shows a limited acceleration"""
    contact_seconds: float = 240.0
    """[s] of contact for the table; measured: 80 s are a fifth worse"""
    table: bool = True
    """whether to fit a table in contact"""
    table_height: float | None = None
    """[m] of the tip; None: found in the logs"""
    stictions: tuple[float, ...] = STICTIONS
    """to try"""
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
    """Find a twin's structure, and fit it; InputError for too little motion."""
    windows = free_windows(logs, excluded, settings.window)
    seconds = sum(float(logs[w.log].time[w.last - 1] - logs[w.log].time[w.first]) for w in windows)
    if seconds < SHORTEST:
        whole = sum(float(log.time[-1] - log.time[0]) for log in logs)
        raise InputError(
            f"identification: {seconds:.0f} s of free motion in stretches of {SHORTEST_STRETCH:g} s and more, of "
            f"{whole:.0f} s in {len(logs)} log(s), expected at least {SHORTEST:.0f} s; record longer "
            "motions, off table and stops"
        )
    belief = decide_compensation(unknown_prior(arm), arm, logs, excluded)

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
        lambda structure, threads: problem(usable, structure, threads),
        belief,
        simple,
        settings.stictions,
        x,
        settings.threads,
    )
    on_progress(0.5, "fit")
    return *settle(arm, logs, excluded, found.structure, found.vector, settings), found.structure


def settle(
    arm: Arm,
    logs: Sequence[RunLog],
    excluded: Sequence[Exclusions],
    structure: Structure,
    start: Array | None,
    settings: LogSettings = DEFAULT_LOG_SETTINGS,
) -> tuple[Problem, Fit]:
    """Fit windows from all logs, from ``start`` (k,), default: searched."""
    windows = free_windows(logs, excluded, settings.window)
    if start is None:
        slow = thin(windows, logs, settings.coarse_seconds)
        start = rough_fit(_problem(arm, logs, slow, structure, settings, settings.threads))
    fast = fastest(windows, logs, settings.fast_seconds)
    every = merged(thin(windows, logs, settings.fit_seconds), fast)
    problem = _problem(arm, logs, every, structure, settings, settings.threads, stride=1.0)
    return problem, fit(problem, start, REFINEMENT, SCALES)


def _problem(
    arm: Arm,
    logs: Sequence[RunLog],
    windows: Sequence[Window],
    structure: Structure,
    settings: LogSettings,
    threads: int,
    stride: float = STRIDE,
) -> Problem:
    replay = Replay(
        arm, logs, windows, settings.timestep, threads, structure.stiction, acceleration=structure.acceleration
    )
    return Problem(replay, structure.prior, structure.frozen, stride, MEMORY, FREEDOM)


def independent(problem: Problem) -> NDArray[np.integer]:
    """(rows,) numbers of independent motions or windows."""
    windows = problem.replay.windows
    return by_motion(windows) if len({w.log for w in windows}) >= CLUSTERED else problem.window
