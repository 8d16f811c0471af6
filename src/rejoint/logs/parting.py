"""A recording with a long pause is several motions: what the arm did in between nobody knows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np

from rejoint.logs.checks import GAP_PERIODS
from rejoint.logs.track import RecordedMotion, Track

PAUSE = 1.0
"""[s] without a state from which a motion ends (chosen: ten times the lag of a hobby servo, so that a replay across it
says nothing about the arm)"""
FEWEST = 2
"""Rows of a log"""


def parted(motion: RecordedMotion) -> Iterator[RecordedMotion]:
    """Give the motions between the pauses of a recording; one without pauses, or with a damaged clock, as it is."""
    time = motion.state.time
    steps = np.diff(time)
    if not len(steps) or not np.isfinite(steps).all() or (steps < 0).any():
        yield motion
        return
    pauses = np.flatnonzero(steps > max(PAUSE, GAP_PERIODS * float(np.median(steps)))) + 1
    bounds = [(a, b) for a, b in pairwise([0, *pauses.tolist(), len(time)]) if b - a >= FEWEST]
    if not len(pauses) or not bounds:
        yield motion
        return
    worst = int(pauses[np.argmax(steps[pauses - 1])])
    lost = len(time) - sum(b - a for a, b in bounds)
    note = (
        f"state: {len(pauses)} pause(s) longer than {PAUSE:g} s, the longest {steps[worst - 1]:.3g} s before "
        f"{motion.state.where(worst)}; cut there into {len(bounds)} log(s)"
    ) + (f", {lost} lone sample(s) left out" if lost else "")
    for index, (first, last) in enumerate(bounds, start=1):
        rows = np.zeros(len(time), dtype=bool)
        rows[first:last] = True
        yield replace(
            motion, name=f"{motion.name}-{index}of{len(bounds)}", state=motion.state.take(rows),
            command=None if motion.command is None else _in_force(motion.command, time[first], time[last - 1]),
            notes=(*motion.notes, note),
        )  # fmt: skip


def _in_force(command: Track, first: float, last: float) -> Track:
    """Keep the commands from the one that holds at ``first`` [s] to ``last`` [s]; all where the clocks differ."""
    before = np.flatnonzero(command.time <= first)
    start = command.time[before[-1]] if len(before) else first
    chosen = (command.time >= start) & (command.time <= last)
    return command.take(chosen) if chosen.any() else command
