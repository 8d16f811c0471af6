"""Named spans of an excitation, and how a run log carries them, so that logs alone suffice later."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, gravity_torque
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError

_KEY = "segments"


@dataclass(frozen=True, kw_only=True)
class Segment:
    """A named span of an excitation."""

    name: str
    """unique, such as ``step/2/0``"""
    kind: str
    """approach, still, sweep, step, multisine or hold"""
    start: float
    """[s] since the excitation began; in a run log on the robot's clock"""
    stop: float
    """[s]"""
    joints: tuple[int, ...] = ()
    """indices of the joints that it judges"""


def attach_segments(log: RunLog, segments: tuple[Segment, ...], waits: Array | None = None) -> RunLog:
    """Return the log with the segments of its excitation in it; the excitation began with the first row.

    The motion waited for the arm as ``waits`` (k, 2) [s] tell: when, since it began, and for how long
    (`Recording.waits`).
    """
    begin, waited = float(log.time[0]), np.zeros((0, 2)) if waits is None else waits

    def on_clock(time: float) -> float:
        return begin + time + float(waited[waited[:, 0] <= time, 1].sum())

    shifted = [dataclasses.replace(s, start=on_clock(s.start), stop=on_clock(s.stop)) for s in segments]
    return dataclasses.replace(log, extra={**log.extra, _KEY: msgspec.json.encode(shifted).decode()})


def is_excitation(log: RunLog) -> bool:
    """Tell whether a log says that it is of an excitation."""
    return _KEY in log.extra


@dataclass(frozen=True, kw_only=True, eq=False)
class ExcitationLog:
    """A run log of an excitation with what every measurement needs of it."""

    arm: Arm
    log: RunLog
    segments: tuple[Segment, ...]
    gravity: Array
    """(T, n) [N m] torque that holds the arm against gravity at the measured postures"""
    reference: Array
    """(T, n) [rad] where a servo that ramps to each command at the joint's top speed is, when the next one comes"""

    @classmethod
    def of(cls, arm: Arm, log: RunLog) -> ExcitationLog:
        """Read the segments that a log carries; InputError if it is of another arm or carries none."""
        log.require(arm.name, arm.joint_names)
        if _KEY not in log.extra:
            raise InputError(f"run log {log.label} holds no excitation; record one with `rejoint diagnose`")
        try:
            segments = msgspec.json.decode(log.extra[_KEY], type=tuple[Segment, ...])
        except msgspec.MsgspecError as error:
            raise InputError(f"run log {log.label}: its segments are damaged ({error}); record it again") from error
        return cls.with_segments(arm, log, segments)

    @classmethod
    def with_segments(cls, arm: Arm, log: RunLog, segments: tuple[Segment, ...]) -> ExcitationLog:
        """Take segments that somebody has found in a log, on the log's clock."""
        return cls(
            arm=arm, log=log, segments=segments, gravity=gravity_torque(arm, log.position), reference=_ramp(arm, log)
        )

    def commanded(self, joint: int, time: Array) -> Array:
        """Return the reference [rad] of a joint at ``time`` (...) [s]: ramps to each command at its top speed.

        Servos do not jump to a new command; without the ramp a moving command would seem to come later.
        """
        log, speed = self.log, float(self.arm.max_speed[joint])
        row = np.clip(np.searchsorted(log.time, time, side="right") - 1, 0, len(log) - 1)
        start, goal = self.reference[row, joint], log.command[row, joint]
        way = speed * np.maximum(time - log.time[row], 0.0)
        return start + np.clip(goal - start, -way, way)

    def of_kind(self, kind: str, joint: int | None = None) -> list[Segment]:
        """Segments of a kind; with ``joint``, only those that judge it."""
        return [s for s in self.segments if s.kind == kind and (joint is None or joint in s.joints)]

    def rows(self, segment: Segment, *, skip: float = 0.0, last: float = np.inf) -> NDArray[np.intp]:
        """Rows of a segment without its first ``skip`` [s], and of those only the ``last`` [s]."""
        begin = max(segment.start + skip, segment.stop - last)
        return np.arange(*np.searchsorted(self.log.time, [begin, segment.stop]))

    def require(self, enough: bool, what: str, joint: int) -> None:
        """Raise InputError unless there is ``enough`` of something to judge a joint by."""
        if not enough:
            raise InputError(
                f"run log {self.log.label} holds too few {what} of joint {joint + 1}; record the excitation again"
            )


def _ramp(arm: Arm, log: RunLog) -> Array:
    """Return the reference (T, n) [rad] at every row, just before its command takes effect."""
    reference = np.empty_like(log.command)
    reference[0] = log.command[0]
    way = np.diff(log.time)[:, None] * arm.max_speed
    for k in range(len(log) - 1):
        step = log.command[k] - reference[k]
        reference[k + 1] = reference[k] + np.minimum(np.maximum(step, -way[k]), way[k])
    return reference
