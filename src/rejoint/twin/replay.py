"""Open-loop replay of run logs by twins; windows of logs, and motions that are held out.

Windows start from the measured state and run as one batch. The delay contains the age of the reading. A log may declare
(`RunLog.extra`) ``gain``, the servos' position gain over the twin's (``0.5`` or ``1 0.5 1``). Joints that never answer
stay at the measured position.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress, pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import cKDTree

from rejoint.arms import Arm, Array, Index, Mask, gravity_torque
from rejoint.control.correction import rms
from rejoint.control.servoreference import ServoReference
from rejoint.logs.consistency import refuse_copies
from rejoint.logs.exclusions import Exclusions, find_exclusions, free_runs, recorded_gain, table_height, velocity
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.numbers import interpolated
from rejoint.system.records import value_type
from rejoint.twin.parameters import TIMESTEP, TwinParameters
from rejoint.twin.simulation import ChainBatch, Draw

if TYPE_CHECKING:
    from rejoint.twin.table import TableBatch
    from rejoint.twin.twin import TablePlane

PARTS = 6
"""Instants of a step whose mean reference counts; chosen"""
VELOCITY = 2
"""Rows on each side of a velocity; chosen"""
THREADS = 2
"""of the simulation; no effect on results"""


@value_type
class Window:
    """Rows ``first`` to ``last`` (exclusive) of one log."""

    log: RunLog
    first: int
    last: int

    def split(self, count: int) -> list[Window]:
        """Split it into ``count`` windows of equal length."""
        return _between(self.log, np.linspace(self.first, self.last, count + 1).astype(int).tolist())


def cut(logs: Sequence[RunLog], length: float) -> list[Window]:
    """Cut logs into windows of about ``length`` [s]."""
    windows = []
    for log in logs:
        count = max(1, round(log.duration / length))
        edges = np.searchsorted(log.time, log.time[0] + log.duration * np.arange(1, count) / count)
        windows += _between(log, [0, *edges.tolist(), len(log)])
    return windows


def _between(log: RunLog, edges: Sequence[int]) -> list[Window]:
    return [Window(log=log, first=a, last=b) for a, b in pairwise(edges) if b - a > 2]


def durations(windows: Sequence[Window]) -> Array:
    """Lengths (w,) [s] of windows."""
    return np.array([w.log.time[w.last - 1] - w.log.time[w.first] for w in windows])


def in_force(log: RunLog) -> Array:
    """Commands (T, n) [rad] in force at each reading: row k is sent after its answer."""
    return log.command[np.maximum(np.arange(len(log)) - 1, 0)]


@dataclass(frozen=True, eq=False)
class Replay:
    """Replays windows of logs for many twins at once."""

    arm: Arm
    windows: Sequence[Window]
    timestep: float = TIMESTEP
    acceleration: float = np.inf
    gain: Array | None = None
    """(n,) P gain that the stiffness is for; None: that of the logs"""

    def __post_init__(self) -> None:
        for w in self.windows:
            w.log.require(self.arm)

    @cached_property
    def seconds(self) -> float:
        """[s] of motion in all windows."""
        return float(sum(durations(self.windows)))

    @cached_property
    def window(self) -> Index:
        """(rows,) number of each row's window."""
        return np.repeat(np.arange(len(self.windows)), [w.last - w.first for w in self.windows])

    @cached_property
    def motion(self) -> Index:
        """(rows,) number of each row's log."""
        logs = list(dict.fromkeys(w.log for w in self.windows))
        return np.array([logs.index(w.log) for w in self.windows])[self.window]

    @cached_property
    def time(self) -> Array:
        """(rows,) [s] since the start of each row's window."""
        start = np.array([w.log.time[w.first] for w in self.windows])
        return self._rows(lambda log: log.time) - start[self.window]

    @cached_property
    def measured(self) -> Array:
        """(rows, n) [rad] measured positions."""
        return self._rows(lambda log: log.position)

    @cached_property
    def commands(self) -> Array:
        """(rows, n) [rad] commands in force."""
        return self._rows(in_force)

    @cached_property
    def speed(self) -> Array:
        """(rows, n) [rad/s] of the measured positions."""
        return self._rows(lambda log: velocity(log.time, log.position, VELOCITY))

    def _rows(self, values: Callable[[RunLog], Array]) -> Array:
        """Rows of all windows of a log's ``values`` (T, ...)."""
        return np.concatenate([values(w.log)[w.first : w.last] for w in self.windows])

    @cached_property
    def _start(self) -> Array:
        """(3, windows, n) first positions [rad] and speeds [rad/s], and gains."""
        of_logs = {}
        for log in {w.log for w in self.windows}:
            rate = velocity(log.time, log.position, VELOCITY)
            of_logs[log] = np.stack(np.broadcast_arrays(log.position, rate, self._gain(log)))
        return np.stack([of_logs[w.log][:, w.first] for w in self.windows], axis=1)

    def _gain(self, log: RunLog) -> Array:
        """Position gain (n,) of a log's servos over the twin's."""
        own = recorded_gain([log])
        return np.ones(self.arm.joints) if own is None or self.gain is None else own / self.gain

    @cached_property
    def _grid(self) -> Array:
        """Times (steps,) [s] of the simulation steps."""
        longest = durations(self.windows).max()
        return np.arange(np.ceil(longest / self.timestep) + 1) * self.timestep

    def predict(self, parameters: TwinParameters, tables: Sequence[TablePlane] = ()) -> Array:
        """Positions (m, rows, n) [rad] of twins (m,) in all windows, with m ``tables``."""
        m, count = parameters.shape[0], len(self.windows)
        which = np.tile(np.arange(m), count)  # simulation = window * m + twin
        start, velocity, gain = np.repeat(self._start, m, axis=1)
        arms = parameters[which]
        arms, control = replace(arms, stiffness=arms.stiffness * gain), self._control(parameters)
        twins: ChainBatch | TableBatch
        if tables:
            from rejoint.twin.table import TableBatch  # late: free arms need no MuJoCo

            twins = TableBatch(self.arm, arms, [tables[i] for i in which], self.timestep)
        else:
            twins = self._batches.get(m) or ChainBatch(self.arm, m * count, self.timestep, THREADS)
            self._batches[m] = twins
            twins.write(Draw.of(arms))
        twins.restart(start, velocity)
        path = np.concatenate([start[:, None], twins.rollout(control)], axis=1)
        place = self.time / self.timestep
        index = np.minimum(place.astype(int), path.shape[1] - 2)
        row, part = (self.window * m + np.arange(m)[:, None]) * path.shape[1] + index, (place - index)[:, None]
        before, after = (path.reshape(-1, self.arm.joints).take(row + i, axis=0) for i in (0, 1))
        return before * (1 - part) + after * part

    def references(self, parameters: TwinParameters) -> Array:
        """One twin's references (rows, n) [rad] at the readings."""
        delay, speed = np.atleast_1d(parameters.delay), float(parameters.ramp_speed)
        parts = [self._reference(w.log, speed).sample(w.log.time[w.first : w.last], delay)[0] for w in self.windows]
        return np.concatenate(parts)

    def _control(self, parameters: TwinParameters) -> Array:
        """Return references (windows * m, steps, n), means over each simulation step."""
        limits = np.stack([parameters.ramp_speed, parameters.delay])
        (speed, delay), which = np.unique(limits, axis=1, return_inverse=True)
        late = {one: delay[speed == one] for one in speed.tolist()}  # by speed, in its order
        control = np.empty((len(self.windows) * len(which), len(self._grid), self.arm.joints))
        around = ((np.arange(PARTS) + 0.5) / PARTS - 0.5) * self.timestep
        for w, part in zip(self.windows, np.split(control, len(self.windows)), strict=True):
            time = w.log.time[w.first] + self._grid
            sampled = [self._reference(w.log, one).sample(time, own, around) for one, own in late.items()]
            part[:] = np.concatenate(sampled)[which]
        if parameters.compensation.any():
            share = (parameters.compensation / parameters.stiffness)[:, None]
            control += (share * self._gravity).reshape(control.shape)
        return control

    @cached_property
    def _batches(self) -> dict[int, ChainBatch]:
        return {}

    @cached_property
    def _last(self) -> dict[RunLog, tuple[float, ServoReference]]:
        return {}

    def _reference(self, log: RunLog, speed: float) -> ServoReference:
        """Return a log's reference."""
        # the last is kept: most twins of a fit ask for the same speed
        last = self._last.get(log)
        if last is None or last[0] != speed:
            last = self._last[log] = speed, ServoReference(*log.sent, speed, self.acceleration)
        return last[1]

    @cached_property
    def _gravity(self) -> Array:
        """Gravity torques (windows, 1, steps, n) [N m] at the commands."""
        starts = [(w.log, w.log.time[w.first]) for w in self.windows]
        paths = [interpolated(start + self._grid, log.time, log.command) for log, start in starts]
        return gravity_torque(self.arm, np.stack(paths))[:, None]


MOVED = np.radians(2.0)
"""[rad] least travel of a moving joint; chosen"""

SHORTEST_STRETCH = 2.0
"""[s] least free motion of a window; chosen"""

LEAD = 1.0
"""[s] of free motion before a contact; chosen"""


def cut_windows(excluded: Sequence[Exclusions], length: float, *, contact: bool = False) -> list[Window]:
    """Cut free motion, or that in ``contact`` and readable rows up to `LEAD` before it, into windows.

    Of at most about ``length`` [s].
    """
    windows, lead = [], LEAD if contact else 0.0
    for rows in excluded:
        log = rows.log
        wanted = rows.contact & rows.readable if contact else rows.free
        for first, last in free_runs(wanted, log.time, SHORTEST_STRETCH):
            early = np.searchsorted(log.time, log.time[first] - lead)
            while not rows.readable[early:first].all():
                early += 1
            count = max(1, int(np.ceil((log.time[last - 1] - log.time[early]) / length - 0.05)))
            windows += Window(log=log, first=early, last=last).split(count)
    return windows


def thin(windows: Sequence[Window], seconds: float) -> list[Window]:
    """Keep about ``seconds`` [s] of the windows, evenly spread."""
    lengths = durations(windows)
    total = lengths.sum()
    if total <= seconds:
        return list(windows)
    # Taken whenever the time passed reaches the next multiple: long motions give more than short ones.
    passed = np.floor((np.cumsum(lengths) - 0.5 * lengths) * seconds / total / lengths.mean()).astype(int)
    return [windows[i] for i in np.flatnonzero(np.diff(passed, prepend=-1) > 0).tolist()]


def farthest(windows: Sequence[Window], seconds: float) -> list[Window]:
    """Keep about ``seconds`` [s] of the windows farthest from their commands: limits show there."""
    off = [-np.abs(w.log.command - w.log.position)[w.first : w.last].max() for w in windows]
    order = np.argsort(off, kind="stable")
    passed = np.cumsum(durations(windows)[order])
    return [windows[i] for i in sorted(order[: np.searchsorted(passed, seconds) + 1].tolist())]


FOLDS = 4
"""One of as many programs is held out; chosen"""
FEWEST_OUT = 2
"""Motions held out; chosen: an interval takes two"""
STILL_SPEED = 0.03
"""[rad/s] of joints at rest; chosen"""
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

    Motions that repeat one another stay together, unless named. Without hold-out both are all logs. InputError for
    duplicate, missing or all labels.
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
    else:
        programs = _programs(ordered)
        fold = folds(arm, [logs[0] for logs in programs], seed)
        kept = {log.label for logs, number in zip(programs, fold, strict=True) if number == 0 for log in logs}
        if len(programs) < FOLDS or len(kept) < FEWEST_OUT:
            return _ends(ordered)
    return [log for log in ordered if log.label not in kept], [log for log in ordered if log.label in kept]


def _programs(logs: Sequence[RunLog]) -> list[list[RunLog]]:
    """Put motions together that repeat a first one."""
    found, left = list[list[RunLog]](), list(logs)
    while left:
        first, *others = left
        again = [same.mean() > MOSTLY for same in repeated(others, [first])]
        found.append([first, *compress(others, again)])
        left = [log for log, same in zip(others, again, strict=True) if not same]
    return found


def _ends(logs: Sequence[RunLog]) -> tuple[list[RunLog], list[RunLog]]:
    for halvings in (0, 1, 2, 3, 4, 0):  # where even a short end repeats all the rest, as without a repetition
        cuts = [_cut(log, 1.0 - KEPT_END * 0.5**halvings) for log in logs]
        seen = [log.rows(slice(0, cut)) for log, cut in zip(logs, cuts, strict=True)]
        ends = [log.rows(slice(cut, None)) for log, cut in zip(logs, cuts, strict=True)]
        fresh = [
            replace(log.rows(slice(a, b)), label=f"{log.label} (from {log.time[a]:.1f} s)")
            for log, same in zip(seen, repeated(seen, ends), strict=True)
            for a, b in free_runs(~same, log.time, SHORTEST_STRETCH)
        ]
        told = max(end.duration for end in ends) >= STEPS * GRID  # a shorter one cannot repeat anything
        if told and sum(map(len, fresh)) > MOSTLY * sum(map(len, logs)):
            seen = fresh
            break
    return seen, [replace(end, label=f"{end.label} (end)") for end in ends]


def _cut(log: RunLog, share: float) -> int:
    """First row after this ``share`` of the motion, on the grid of its commands."""
    moves = np.abs(velocity(log.time, log.position, VELOCITY)).max(axis=1) > STILL_SPEED
    passed, since = np.cumsum(moves + 1e-3), log.time - log.time[0]
    steps = since[np.searchsorted(passed, share * passed[-1])] / GRID
    return int(np.searchsorted(since, GRID * np.round(steps) - 1e-9).clip(1, len(log) - 1))


def repeated(logs: Sequence[RunLog], others: Sequence[RunLog]) -> list[Mask]:
    """Rows (T,) of each log whose commands move as some of ``others``."""
    known, found = cKDTree(np.concatenate([_stretches(log)[1] for log in others])), []
    for log in logs:
        start, paths = (values[:: STEPS // 2] for values in _stretches(log))
        steps = paths.reshape(len(paths), -1, STEPS)
        motion = np.linalg.norm(steps - steps.mean(axis=-1, keepdims=True), axis=(1, 2))
        most = ALIKE * np.where(motion > MOVED, motion, 0.0)
        same = start[known.query(paths, distance_upper_bound=most.max(initial=0.0))[0] < most]
        latest = np.append(-np.inf, same)[np.searchsorted(same, log.time, side="right")]
        found.append(log.time - latest <= STEPS * GRID)
    return found


def _stretches(log: RunLog) -> tuple[Array, Array]:
    """Beginnings (S,) [s] and commands (S, n `STEPS`) [rad] of all stretches of a log; after its end it rests."""
    time = np.arange(log.time[0], log.time[-1] + GRID, GRID)
    path = interpolated(time, log.time, log.command)
    path = np.pad(path, ((0, STEPS - 1), (0, 0)), mode="edge")
    return time, sliding_window_view(path, STEPS, axis=0).reshape(len(time), -1)


def folds(arm: Arm, logs: Sequence[RunLog], seed: int) -> Index:
    """(K,) fold of each log, of `FOLDS` with motions of every kind."""
    touching = [rows.contact.any() for rows in find_exclusions(arm, logs, table_height(arm, logs))]
    speed = [rms(np.diff(log.command, axis=0) / np.diff(log.time)[:, None]) for log in logs]
    order = sorted(range(len(logs)), key=lambda i: (touching[i], round(speed[i], 6), logs[i].label))
    rng, found = np.random.default_rng(seed), np.zeros(len(logs), dtype=int)
    for start in range(0, len(order), FOLDS):
        alike = order[start : start + FOLDS]
        found[alike] = rng.permutation(FOLDS)[: len(alike)]
    return found
