"""Which stretches of several logs a fit is given: windows of free motion, and windows around contacts."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rejoint.logs.exclusions import Exclusions, free_runs
from rejoint.logs.runlog import RunLog
from rejoint.twin.replay import Window

SHORTEST = 2.0
"""[s] of free motion that are worth a window: a few times the memory of a geared joint (chosen)"""

LEAD = 1.0
"""[s] of free motion before a contact that its window starts with (chosen)"""


def free_windows(logs: Sequence[RunLog], excluded: Sequence[Exclusions], length: float) -> list[Window]:
    """Cut the free motion of the logs into windows of at most about ``length`` [s], replayed from their own starts."""
    windows: list[Window] = []
    for index, (log, rows) in enumerate(zip(logs, excluded, strict=True)):
        for run in free_runs(rows.free, log.time, SHORTEST):
            windows += _pieces(index, log, run, length)
    return windows


def contact_windows(logs: Sequence[RunLog], excluded: Sequence[Exclusions], length: float) -> list[Window]:
    """Cut what surrounds the contacts of the logs into windows of about ``length`` [s]."""
    windows: list[Window] = []
    for index, (log, rows) in enumerate(zip(logs, excluded, strict=True)):
        for first, last in free_runs(rows.contact & rows.readable, log.time, SHORTEST):
            early = int(np.searchsorted(log.time, log.time[first] - LEAD))
            while not rows.readable[early:first].all():
                early += 1
            windows += _pieces(index, log, (early, last), length)
    return windows


def thin(windows: Sequence[Window], logs: Sequence[RunLog], seconds: float) -> list[Window]:
    """Keep about ``seconds`` [s] of the windows, evenly spread over them and so over the motions."""
    lengths = np.array([logs[w.log].time[w.last - 1] - logs[w.log].time[w.first] for w in windows])
    total = float(lengths.sum())
    if total <= seconds:
        return list(windows)
    # Taken whenever the time passed reaches the next multiple: long motions give more than short ones.
    passed = np.floor((np.cumsum(lengths) - 0.5 * lengths) * seconds / total / lengths.mean()).astype(int)
    chosen = np.diff(passed, prepend=-1) > 0
    return [w for w, wanted in zip(windows, chosen, strict=True) if wanted]


def fastest(windows: Sequence[Window], logs: Sequence[RunLog], seconds: float) -> list[Window]:
    """Keep about ``seconds`` [s] of the windows, those whose commands accelerate most: they show a servo's limits.

    Only commands that keep changing count: jumps to a goal that is then held pass a limited acceleration by.
    """

    def acceleration(w: Window) -> float:
        time, command = logs[w.log].time[w.first : w.last], logs[w.log].command[w.first : w.last]
        speed = np.diff(command, axis=0) / np.diff(time)[:, None]
        changing = speed != 0.0
        lasting = changing[:-2] & changing[1:-1] & changing[2:]
        change = (speed[2:] - speed[:-2]) / (time[2:-1] - time[:-3])[:, None]
        return float(np.sqrt(np.mean(np.where(lasting, change, 0.0) ** 2)))

    order = sorted(range(len(windows)), key=lambda i: -acceleration(windows[i]))
    lengths = np.array([logs[windows[i].log].time[windows[i].last - 1] - logs[windows[i].log].time[windows[i].first]
                        for i in order])  # fmt: skip
    return [windows[i] for i in sorted(order[: int(np.searchsorted(np.cumsum(lengths), seconds)) + 1])]


def merged(one: Sequence[Window], other: Sequence[Window]) -> list[Window]:
    """Put two selections of windows together, each window once."""
    every = {(w.log, w.first, w.last): w for w in (*one, *other)}
    return [every[key] for key in sorted(every)]


def by_motion(windows: Sequence[Window]) -> NDArray[np.integer]:
    """(rows,) number of the motion that each row of the windows is of."""
    motions = np.repeat([w.log for w in windows], [w.last - w.first for w in windows])
    return np.unique(motions, return_inverse=True)[1].ravel()


def _pieces(index: int, log: RunLog, run: tuple[int, int], length: float) -> list[Window]:
    first, last = run
    count = max(1, int(np.ceil(float(log.time[last - 1] - log.time[first]) / length - 0.05)))
    edges = np.linspace(first, last, count + 1).astype(int).tolist()
    return [Window(log=index, first=a, last=b) for a, b in pairwise(edges) if b - a > 2]
