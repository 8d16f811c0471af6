"""Named spans of an excitation, or of any logs; ten targets open loop, and other rest.

Logs share one clock; spans hold only rows of the free arm (`rejoint.logs.exclusions`). Ten targets: tool errors at rest
(Park et al. 2024, Figs. 8 and 9).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
from scipy.ndimage import gaussian_filter1d

from rejoint.arms import CATALOGUE, Arm, Array, Index, Mask, gravity_torque, tcp_position
from rejoint.arms.kinematics import frames
from rejoint.control.correction import NOT_KNOWN, ToolModel, TrueError, mean_modelled, modelled
from rejoint.control.servoreference import ServoReference
from rejoint.diagnosis.regression import mean_of, scaled
from rejoint.logs.columns import ZEROS
from rejoint.logs.exclusions import Exclusions, free_runs, joint_speed
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.records import entity, value_type
from rejoint.system.statistics import Estimate

_KEY = "segments"


@value_type
class Segment:
    """A named span of an excitation."""

    name: str
    """such as ``step/2/0``"""
    kind: str
    """approach, still, sweep, step, multisine or hold"""
    start: float
    """[s] since the excitation began; in a log on its clock"""
    stop: float
    """[s]"""
    joints: tuple[int, ...] = ()
    """that it judges"""
    log: int = 0
    """number of its log, of several"""


def attach_segments(log: RunLog, segments: Sequence[Segment], waits: Array) -> RunLog:
    """Log with its excitation's segments, which waited ``waits`` (k, 2) [s]."""
    begin = float(log.time[0])

    def on_clock(time: float) -> float:
        return begin + time + float(waits[waits[:, 0] <= time, 1].sum())

    shifted = [dataclasses.replace(s, start=on_clock(s.start), stop=on_clock(s.stop)) for s in segments]
    return dataclasses.replace(log, extra={**log.extra, _KEY: msgspec.json.encode(shifted).decode()})


TARGETS_LABEL = "diagnosis/targets"
"""Of the log of ten targets"""


def is_excitation(log: RunLog) -> bool:
    """Whether a log is of an excitation."""
    return _KEY in log.extra


def of_diagnosis(logs: Sequence[RunLog]) -> bool:
    """Whether logs are of excitations, beside their targets."""
    return any(map(is_excitation, logs)) and all(is_excitation(log) or log.label == TARGETS_LABEL for log in logs)


SMOOTHED = 0.01
"""[s] standard deviation of a mean before readings are differentiated twice; chosen: encoder steps vanish"""


@entity
class ExcitationLog:
    """A run log with segments and derived signals."""

    arm: Arm
    log: RunLog
    segments: tuple[Segment, ...]

    @classmethod
    def of(cls, arm: Arm, log: RunLog) -> ExcitationLog:
        """Read a log; InputError for another arm or no segments."""
        log.require(arm)
        if _KEY not in log.extra:
            raise InputError(f"run log {log.label} holds no excitation; record one with `rejoint diagnose`")
        segments = msgspec.json.decode(log.extra[_KEY], type=tuple[Segment, ...])
        free = Segment(name=FREE, kind=FREE, start=float(log.time[0]), stop=float(log.time[-1]))
        return cls(arm=arm, log=log, segments=(*segments, free))

    @cached_property
    def gravity(self) -> Array:
        """(T, n) [N m] that holds the arm."""
        return gravity_torque(self.arm, self.log.position)

    @cached_property
    def gain(self) -> Array:
        """(T, n) over each joint's largest."""
        found = np.ones_like(self.log.position) if self.log.gain is None else self.log.gain
        return np.where((found > 0.0).all(axis=0), found / found.max(axis=0).clip(1e-9), 1.0)

    @cached_property
    def references(self) -> list[ServoReference]:
        """Of each joint; known servos ramp to each command at top speed."""
        log, known = self.log, is_excitation(self.log) or self.arm.name in CATALOGUE
        speed = self.arm.max_speed * (1.0 if known else 1e3)
        return [ServoReference(log.time, log.command[:, [j]], speed[j]) for j in range(self.arm.joints)]

    @cached_property
    def load(self) -> Array:
        """(T, n) [N m] that gravity and, where effort is logged, the links' inertia take."""
        if self.effort_unit is None:
            return self.gravity
        logs = np.split(self.log.position, np.flatnonzero(np.diff(self.log.time) > _APART / 2) + 1)
        smooth = [gaussian_filter1d(one, SMOOTHED / self.log.period, axis=0, mode="nearest") for one in logs]
        return self.gravity + inertial_torque(self.arm, self.log.time, np.concatenate(smooth))

    @property
    def effort(self) -> Array:
        """(T, n) measured torque, else current, else NaN."""
        found = self.log.current if self.log.torque is None else self.log.torque
        return np.full_like(self.log.position, np.nan) if found is None else found

    @property
    def effort_unit(self) -> str | None:
        """Empty where the log does not say it; None without a column."""
        name = "current" if self.log.torque is None else "torque"
        return None if getattr(self.log, name) is None else self.log.units.get(name, "")

    def of_kind(self, kind: str, joint: int | None = None) -> list[Segment]:
        """Segments of a kind; with ``joint``, only those that judge it."""
        return [s for s in self.segments if s.kind == kind and (joint is None or joint in s.joints)]

    def rows(self, segment: Segment, *, skip: float = 0.0, last: float = np.inf) -> Index:
        """Rows of a segment without its first ``skip`` [s]; only the ``last`` [s]."""
        begin = max(segment.start + skip, segment.stop - last)
        return np.arange(*np.searchsorted(self.log.time, [begin, segment.stop]))

    def require(self, enough: bool, what: str, joint: int) -> None:
        """Raise InputError unless there is ``enough`` to judge a joint."""
        if not enough:
            raise InputError(
                f"run log {self.log.label} holds too few {what} of joint {joint + 1}; record the excitation again"
            )


def inertial_torque(arm: Arm, time: Array, position: Array) -> Array:
    """Torques (T, n) [N m] for the acceleration of the links along ``position`` (T, n) [rad] at ``time`` (T,) [s]."""
    f = frames(arm, position)

    def rate(values: Array) -> Array:
        return np.gradient(values, time, axis=0)

    com = f.position + np.einsum("...nij,nj->...ni", f.rotation, arm.com)
    spin = np.cumsum(rate(position)[..., None] * f.axis, axis=1)
    inertia = f.rotation @ arm.inertia @ f.rotation.mT
    force = arm.mass[:, None] * rate(rate(com))
    moment = np.cross(com, force) + rate(np.einsum("...ij,...j->...i", inertia, spin))
    force, moment = (np.cumsum(one[:, ::-1], axis=1)[:, ::-1] for one in (force, moment))  # of all behind each joint
    return (f.axis * (moment - np.cross(f.position, force))).sum(axis=-1)


FREE, STEP, HOLD, STILL, SWEEP = "free", "step", "hold", "still", "sweep"
"""Kinds; all but the first belong to an excitation"""

_APART = 60.0
"""[s] between logs on the common clock"""

SHORTEST = 1.0
"""[s] least free motion of a span; chosen"""

LONGEST = 300.0
"""[s] longest span of free motion; chosen"""

QUIET, SETTLED_HOLD = 1.0, 2.0
"""[s] of constant commands of a step or rest, and of a hold that outlasts a swing; chosen"""

SETTLED_LAST = 0.4
"""[s] of rest, also at the end of a hold; chosen"""

STEP_TIME, STEP_SIZE = 0.15, 0.05
"""[s] and [rad] of a command step; chosen"""

STEP_LENGTH = 3.0
"""[s] of a step that are used; chosen"""

_SAME = 1e-6
"""[rad] rounding of a constant command; chosen"""


def join_logs(arm: Arm, excluded: Sequence[Exclusions]) -> ExcitationLog:
    """Join logs on one clock."""
    segments, logs = list[Segment](), [rows.log for rows in excluded]
    times, begin = [], 0.0
    for number, rows in enumerate(excluded):
        time = rows.log.time - rows.log.time[0] + begin
        segments += _spans(number, rows, time)
        times.append(time)
        begin = time[-1] + _APART
    names = [name for name in ("torque", "current", "gain") if all(getattr(log, name) is not None for log in logs)]
    names += ["position", "command", "target", "true_tcp"]
    arrays: dict[str, Any] = {name: np.concatenate([getattr(log, name) for log in logs]) for name in names}
    everything = RunLog(
        arm=arm.name,
        joint_names=arm.joint_names,
        robot="logs",
        label=f"{len(logs)} logs",
        time=np.concatenate(times),
        units=logs[0].units,
        extra={key: said for log in logs for key, said in log.extra.items() if key == ZEROS},
        **arrays,
    )
    return ExcitationLog(arm=arm, log=everything, segments=tuple(segments))


def _spans(number: int, rows: Exclusions, time: Array) -> Iterator[Segment]:
    log, free = rows.log, rows.free

    def segment(kind: str, first: int, last: int, joints: tuple[int, ...]) -> Segment:
        start, stop = float(time[first]), float(time[last - 1])
        return Segment(name=kind, kind=kind, start=start, stop=stop, joints=joints, log=number)

    everyone = tuple(range(log.position.shape[1]))
    still = np.abs(np.diff(log.command, axis=0, prepend=log.command[:1])) < _SAME
    for first, last in free_runs(free, time, SHORTEST):
        count = int(np.ceil((time[last - 1] - time[first]) / LONGEST))
        edges = np.linspace(first, last, count + 1).astype(int).tolist()
        for a, b in pairwise(edges):
            yield segment(FREE, a, b, everyone)
    for kind, shortest in ((HOLD, SETTLED_HOLD), (STILL, QUIET)):
        for first, last in free_runs(free & still.all(axis=1), time, shortest):
            yield segment(kind, first, last, everyone)
    for joint in everyone:
        for first, last in _steps(log, free, still[:, joint], joint):
            yield segment(STEP, first, last, (joint,))


def _steps(log: RunLog, free: Mask, still: Mask, joint: int) -> Iterator[tuple[int, int]]:
    for arrived, last in free_runs(still, log.time, QUIET):
        first = np.searchsorted(log.time, log.time[arrived] - STEP_TIME)
        moved = np.abs(np.diff(log.command[first : arrived + 1, joint]))
        if abs(log.command[arrived, joint] - log.command[first, joint]) < STEP_SIZE:
            continue
        first += np.argmax(moved > _SAME)
        last = min(last, np.searchsorted(log.time, log.time[first] + STEP_LENGTH))
        before = np.searchsorted(log.time, log.time[first] - QUIET)
        if free[first:last].all() and still[before + 1 : first + 1].all():  # no end of a longer motion
            yield first, last


TARGETS = 10
"""Park et al. 2024, section IV-A"""

DWELL = 4.5
"""[s] per target; chosen: a worn arm rests after 3 s"""

SETTLED = 1.0
"""[s] at the end of each target for its error; chosen"""


@value_type
class TargetError:
    """One target."""

    target_mm: tuple[float, float, float]
    error_mm: float
    """settled, by encoders"""
    true_error_mm: float | None
    """of the tool itself"""


@value_type
class OpenLoop:
    """Ten targets."""

    targets: tuple[TargetError, ...]
    error_mm: Estimate
    """mean, 95 % interval"""
    spread_mm: float
    """standard deviation"""
    true_error_mm: Estimate | None

    @property
    def true_error(self) -> TrueError:
        """Mean true error over the targets, and its source."""
        return NOT_KNOWN if self.true_error_mm is None else TrueError.of("known", scaled(self.true_error_mm, 1e-3))


def settled_rows(log: RunLog) -> list[Index]:
    """Rows of the last second of every target; InputError without targets."""
    known = np.asarray(np.isfinite(log.target).all(axis=1))
    if not known.any():
        raise InputError(f"run log {log.label} holds no targets; record one with `rejoint diagnose`")
    visits = (visit for visit in log.visits() if known[visit[0]])
    return [visit[log.time[visit] >= log.time[visit[-1]] - SETTLED] for visit in visits]


def open_loop_errors(arm: Arm, log: RunLog) -> OpenLoop:
    """Judge the log of an open-loop run."""
    rows, tcp = settled_rows(log), tcp_position(arm, log.position)

    def apart(one: Array, other: Array) -> Array:
        """Mean distances [mm] at the targets."""
        return 1e3 * np.array([np.linalg.norm(one[part] - other[part], axis=1).mean() for part in rows])

    errors, truth = apart(log.target, tcp), apart(log.target, log.true_tcp)
    known = np.isfinite(truth).all()
    found = [
        TargetError(
            target_mm=tuple((1e3 * log.target[part[0]]).tolist()),
            error_mm=float(error),
            true_error_mm=float(true) if known else None,
        )
        for part, error, true in zip(rows, errors, truth, strict=True)
    ]
    return OpenLoop(
        targets=tuple(found),
        error_mm=mean_of(errors),
        spread_mm=float(errors.std(ddof=1)) if len(errors) > 1 else 0.0,
        true_error_mm=mean_of(truth) if known else None,
    )


def modelled_errors(log: RunLog, model: ToolModel) -> TrueError:
    """Mean true error by a later model of the arm."""
    target = np.stack([log.target[part[0]] for part in settled_rows(log)])
    return mean_modelled(modelled(model, settled_postures(log)[0], target))


AT_REST = 0.05
"""[rad/s] of the fastest joint and command at rest; chosen"""

STANDS = 3.0
"""[s] after which a command has stood for long; chosen"""

PER_LOG = 20
"""Most postures taken from each log; chosen"""


Postures = Array
"""(2, K, n) [rad] K postures of rest: measured, and commanded"""


def settled_postures(targets: RunLog) -> Postures:
    """Means over each target's settled end; InputError without targets."""
    return _means(targets, settled_rows(targets))


def _means(log: RunLog, parts: Sequence[Index]) -> Postures:
    means = [[joints[part].mean(axis=0) for part in parts] for joints in (log.position, log.command)]
    return np.reshape(means, (2, -1, log.position.shape[1]))


def resting_postures(excluded: Exclusions, *, stops: bool = False) -> Postures:
    """Evenly spread rests of the free arm, each a mean over about a second; with ``stops`` also blocked ones.

    The last second of a command that stands for long counts, though joints swing or jitter about one place.
    """
    log, usable = excluded.log, ~(excluded.contact | excluded.stale) if stops else excluded.free
    time = log.time
    stands = usable & (joint_speed(time, log.command) < AT_REST)
    quiet = stands & (joint_speed(time, log.position) < AT_REST)
    for a, b in free_runs(stands, time, STANDS):
        last = np.flatnonzero(time[a:b] >= time[b - 1] - SETTLED) + a
        early, late = (log.position[half].mean(axis=0) for half in np.array_split(last, 2))
        quiet[last] |= (np.abs(late - early) < AT_REST * SETTLED / 2).all()  # else it is on its way
    runs = free_runs(quiet, time, SETTLED_LAST)  # shorter ones are turning points
    parts = [part for a, b in runs for part in np.array_split(range(a, b), int((b - a) * log.period) or 1)]
    return _means(log, parts[:: len(parts) // PER_LOG + 1])
