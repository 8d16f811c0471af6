"""Recording of the control loop, one row per cycle, and observers of a drive."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import fields, replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from rejoint.arms import Array, Index, Mask
from rejoint.control.guard import Reason, Reasons
from rejoint.control.robot import JointState, Robot
from rejoint.logs.runlog import RunLog
from rejoint.system.progress import Progress, RateLimit, part
from rejoint.system.records import as_options, entity

GAP = 0.8
"""[s] of a gap (chosen)"""
_CLOCK = 1e-6  # [s] rounding of clocks that have run for long


@entity
class Cycle:
    """One control cycle of B arms."""

    time: Array
    """(B,) [s] robot clock"""
    position: Array
    """(B, n) [rad]"""
    command: Array
    """(B, n) [rad] sent afterwards"""
    target: Array
    """(B, 3) [m] in force; NaN: none"""
    aim: Array
    """(B, 3) [m] corrected target"""
    target_index: Index
    since_target: Array
    """(B,) [s]"""
    true_tcp: Array
    """(B, 3) [m], NaN: unknown"""
    active: Mask
    """(B,) new reading"""
    reasons: Reasons
    load: Array
    """(B, n) as `JointState.load`"""
    turned: Array
    """(B,) [rad] orientation error"""

    def at(self, *index: Any) -> Cycle:  # noqa: ANN401 - whatever arrays take
        """Select by an index of the leading axes."""
        return Cycle(**{item.name: getattr(self, item.name)[index] for item in fields(Cycle)})

    def later(self, robot: Robot, state: JointState, command: Array) -> Cycle:
        """Cycle at a later ``state``, with another ``command`` (B, n) [rad]."""
        return replace(
            self,
            time=state.time,
            position=state.position,
            command=command,
            true_tcp=robot.true_tcp().copy(),
            load=state.known_load,
            turned=np.full(len(state.time), np.nan),
        )


PIECE = 600.0
"""[s] of an endless run log (chosen)"""

OnCycle = Callable[[Cycle], object]
"""Receives every cycle; an exception ends the run"""


Look = Callable[[Cycle, JointState, Array], object]
"""Receives a cycle, state and wanted positions (B, n) [rad]"""


@runtime_checkable
class LookedAt(Protocol):
    """A robot that someone looks at."""

    def onlooker(self, controller: str) -> Look:
        """Make a `Look` for a run."""


@entity
class Recording(Cycle):
    """T cycles of B arms; fields of `Cycle` with a leading T."""

    arm: str
    joint_names: tuple[str, ...]
    robot: str
    controller: str
    tripped: Reasons
    """(B,) flags of the trip"""

    def driven(self, b: int = 0) -> Cycle:
        """Rows (T', ...) of the cycles in which arm ``b`` was active."""
        return self.at(self.active[:, b], b)

    def usual_period(self) -> float:
        """Median control period [s] of the first arm; NaN: none."""
        periods = np.diff(self.driven().time)
        return float(np.median(periods)) if len(periods) else np.nan

    def gaps(self) -> Array:
        """Gap lengths (T',) [s] before the rows of the first arm, else 0."""
        rows = self.driven()
        elapsed = np.diff(rows.time, prepend=rows.time[:1])
        marked = (rows.reasons & Reason.GAP) != 0
        return np.where(marked & (elapsed > GAP), elapsed, 0.0)  # it also goes on so after a joint was led back

    def timing(self) -> dict[str, Any]:
        """Fields ``period`` [s], None: unknown, and ``gaps`` [s] of a result."""
        period, gaps = self.usual_period(), self.gaps()
        return {"period": period if np.isfinite(period) else None, "gaps": tuple(gaps[gaps > 0.0].tolist())}

    def waits(self, b: int = 0) -> Array:
        """Return times [s since the target] and lengths [s] of waits, (k, 2)."""
        rows = self.driven(b)
        waited = np.diff(rows.time) - np.diff(rows.since_target)
        where = (np.diff(rows.target_index) == 0) & (np.abs(waited) > _CLOCK)
        return np.column_stack([rows.since_target[1:][where], waited[where]])

    def log(self, b: int, label: str, extra: Mapping[str, str] | None = None) -> RunLog:
        """Run log of arm ``b``."""
        rows = self.driven(b)
        rows = rows.at(rows.time >= np.maximum.accumulate(rows.time))
        rows = rows.at(np.diff(rows.time, append=np.inf) > 0.0)  # the last command of one time is in force
        return RunLog(
            arm=self.arm,
            joint_names=self.joint_names,
            robot=self.robot,
            label=label,
            time=rows.time,
            position=rows.position,
            command=rows.command,
            target=rows.target,
            true_tcp=rows.true_tcp,
            servo_load=None if np.isnan(rows.load).all() else rows.load,
            aim=None if np.array_equal(rows.aim, rows.target, equal_nan=True) else rows.aim,
            extra={"controller": self.controller, **(extra or {})},
        )


def recorded(robot: Robot, controller: str, cycles: list[Cycle], tripped: Reasons) -> Recording:
    """Make a recording of ``cycles``, at least one; ``tripped`` (B,)."""
    columns = {item.name: np.stack([getattr(cycle, item.name) for cycle in cycles]) for item in fields(Cycle)}
    return Recording(
        arm=robot.arm.name,
        joint_names=robot.arm.joint_names,
        robot=robot.address,
        controller=controller,
        tripped=np.array(tripped),
        **columns,
    )


def cycle_at_rest(state: JointState, true_tcp: Array, command: Array | None) -> Cycle:
    """Cycle of B undriven arms; ``true_tcp`` (B, 3) [m], ``command`` (B, n) [rad] in force."""
    none, nowhere, zero = np.full_like(state.position, np.nan), np.full_like(true_tcp, np.nan), np.zeros(len(true_tcp))
    return Cycle(
        time=state.time,
        position=state.position,
        command=none if command is None else command,
        target=nowhere,
        aim=nowhere,
        target_index=zero.astype(np.intp),
        since_target=zero,
        true_tcp=true_tcp,
        active=zero == 0.0,
        reasons=zero.astype(np.uint16),
        load=state.known_load,
        turned=nowhere[:, 0],
    )


def recording_of(error: BaseException) -> Recording | None:
    """Return recording of a failed run, or None."""
    return getattr(error, "recording", None)


class Observer:
    """Receives progress, messages and cycles; override the methods you need.

    The thread that drives the arm calls the methods: return at once. An exception ends the motion.

    Examples
    --------
    >>> class Printing(rejoint.Observer):
    ...     def message(self, line: str) -> None:
    ...         print(line)
    >>> rejoint.deploy("emulated:worn", observer=Printing())
    """

    def message(self, line: str) -> None:
        """Receive a sentence for the user."""

    def progress(self, share: float, what: str) -> None:
        """Receive the done share, 0 to 1, of the call or stage, and its label, at most ten times a second."""

    def stage(self, stage: object) -> None:
        """Receive a `Stage` of a repair at its start and end."""

    def partial(self, result: object) -> None:
        """Receive the result of a motion up to its error."""

    def served(self, address: str) -> None:
        """Receive the address of a served arm."""

    def cycle(self, cycle: Cycle) -> None:
        """Receive a control cycle."""

    def watch(
        self,
        robot: Robot,
        *,
        twin: object = None,  # noqa: ARG002 - for those who show it
        within: float | None = None,  # noqa: ARG002
        paced: bool = True,  # noqa: ARG002
    ) -> Robot:
        """Return the robot to drive, perhaps wrapped.

        ``twin``: the `Twin` or None; ``within`` [m]: accepted error; ``paced``: virtual time may be slowed.
        """
        return robot


def _to_all(method: str) -> Callable[..., None]:
    def pass_on(self: Observers, *given: object) -> None:
        for one in self.observers:
            getattr(one, method)(*given)

    return pass_on


class Observers(Observer):
    """Passes everything on to several observers."""

    def __init__(self, *observers: Observer) -> None:
        self.observers = observers

    message, progress, stage = _to_all("message"), _to_all("progress"), _to_all("stage")
    partial, served, cycle = _to_all("partial"), _to_all("served"), _to_all("cycle")

    def watch(self, robot: Robot, **facts: Any) -> Robot:  # noqa: ANN401 - as given
        """See `Observer`."""
        for one in self.observers:
            robot = one.watch(robot, **facts)
        return robot


class StageObserver(Observers):
    """Observer of one stage; its progress goes from ``start`` to ``end``."""

    def __init__(self, observer: Observer, start: float, end: float) -> None:
        super().__init__(observer)
        self._part = part(observer.progress, start, end)

    def progress(self, share: float, what: str) -> None:
        """See `Observer`."""
        self._part(share, what)


@contextmanager
def pacing(observer: Observer | None) -> Iterator[Progress]:
    """Rate-limited progress of an observer; reports the end."""
    pace = RateLimit(as_options(observer, Observer).progress)
    yield pace
    pace(1.0, "done")
