"""Windows of the free and of the touching motion in several logs, and the motions that are held out."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import cKDTree

from rejoint.arms import Arm, Array, Index, Mask
from rejoint.logs.consistency import refuse_copies
from rejoint.logs.exclusions import Exclusions, find_exclusions, free_runs, table_height
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.numbers import interpolated
from rejoint.twin.judge import MOVED
from rejoint.twin.replay import Window, durations

SHORTEST_STRETCH = 2.0
"""[s] least free motion of a window; chosen"""

LEAD = 1.0
"""[s] of free motion before a contact; chosen"""


def cut_windows(
    logs: Sequence[RunLog], excluded: Sequence[Exclusions], length: float, *, contact: bool = False
) -> list[Window]:
    """Cut free motion, or that in ``contact`` and readable rows up to `LEAD` before it, into windows.

    Of at most about ``length`` [s].
    """
    windows, lead = [], LEAD if contact else 0.0
    for index, (log, rows) in enumerate(zip(logs, excluded, strict=True)):
        wanted = rows.contact & rows.readable if contact else rows.free
        for first, last in free_runs(wanted, log.time, SHORTEST_STRETCH):
            early = int(np.searchsorted(log.time, log.time[first] - lead))
            while not rows.readable[early:first].all():
                early += 1
            count = max(1, int(np.ceil((log.time[last - 1] - log.time[early]) / length - 0.05)))
            windows += Window(log=index, first=early, last=last).split(count)
    return windows


def thin(windows: Sequence[Window], logs: Sequence[RunLog], seconds: float) -> list[Window]:
    """Keep about ``seconds`` [s] of the windows, evenly spread."""
    lengths = durations(windows, logs)
    total = lengths.sum()
    if total <= seconds:
        return list(windows)
    # Taken whenever the time passed reaches the next multiple: long motions give more than short ones.
    passed = np.floor((np.cumsum(lengths) - 0.5 * lengths) * seconds / total / lengths.mean()).astype(int)
    return [windows[i] for i in np.flatnonzero(np.diff(passed, prepend=-1) > 0).tolist()]


def farthest(windows: Sequence[Window], logs: Sequence[RunLog], seconds: float) -> list[Window]:
    """Keep about ``seconds`` [s] of the windows that are farthest from their commands: limits show there."""
    off = [-np.abs(logs[w.log].command - logs[w.log].position)[w.first : w.last].max() for w in windows]
    order = np.argsort(off, kind="stable")
    passed = np.cumsum(durations(windows, logs)[order])
    return [windows[i] for i in sorted(order[: np.searchsorted(passed, seconds) + 1].tolist())]


FEW_MOTIONS = 4
"""Motions from which whole ones are held out; chosen"""
FOLDS = 4
"""One of as many motions is held out; chosen"""
KEPT_END = 0.25
"""Share of a motion held out, halved until `MOSTLY` is left; chosen"""
GRID, STEPS = 0.2, 10
"""[s] between samples of commands, and samples compared; chosen"""
ALIKE = 0.25
"""Distance of repeated commands over their own motion; chosen: half of `GRID` at constant speed is 0.17"""
MOSTLY = 0.5
"""Share of a motion; chosen"""


def part(
    arm: Arm, logs: Sequence[RunLog], hold_out: Sequence[str] | None = None, seed: int = 0
) -> tuple[list[RunLog], list[RunLog]]:
    """Split logs into those to fit and those to judge, by label; drawn by default, of few motions the end of each.

    Motion that repeats held-out commands is not fitted, unless named or too little is left. Without hold-out both are
    all logs. InputError for duplicate, missing or all labels.
    """
    ordered = sorted(logs, key=lambda log: log.label)
    names = [log.label for log in ordered]
    if len(set(names)) != len(names):
        raise InputError("identification: two motions have the same label; give each its own")
    refuse_copies(ordered, "identification")
    if hold_out is not None:
        missing = sorted(set(hold_out) - set(names))
        if missing or len(hold_out) >= len(names):
            raise InputError(
                f"identification: motions to hold out {', '.join(missing or hold_out)}; expected some, but not all, "
                f"of {', '.join(names)}"
            )
        if not hold_out:
            return ordered, ordered
        kept = set(hold_out)
    elif len(ordered) < FEW_MOTIONS:
        return _ends(ordered)
    else:
        fold = folds(arm, ordered, FOLDS, seed)
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


def repeated(logs: Sequence[RunLog], others: Sequence[RunLog]) -> list[Mask]:
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
    path = interpolated(time, log.time, log.command)
    path = np.pad(path, ((0, STEPS - 1), (0, 0)), mode="edge")
    return time, sliding_window_view(path, STEPS, axis=0).reshape(len(time), -1)


def folds(arm: Arm, logs: Sequence[RunLog], count: int, seed: int = 0) -> Index:
    """(K,) fold of each log, with motions of every kind."""
    touching = [rows.contact.any() for rows in find_exclusions(arm, logs, table_height(arm, logs))]
    speed = [np.sqrt(np.mean((np.diff(log.command, axis=0) / np.diff(log.time)[:, None]) ** 2)) for log in logs]
    order = sorted(range(len(logs)), key=lambda i: (touching[i], round(speed[i], 6), logs[i].label))
    rng, found = np.random.default_rng(seed), np.zeros(len(logs), dtype=int)
    for start in range(0, len(order), count):
        alike = order[start : start + count]
        found[alike] = rng.permutation(count)[: len(alike)]
    return found
