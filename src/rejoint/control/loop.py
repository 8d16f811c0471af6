"""The one control loop: every motion of every robot, emulated or real, goes through `run`.

Each cycle: the state read last decides whether the target is done; the controller says what it
wants; the guard says what may be sent; the robot is stepped. Every arm of a batch has its own
clock and its own target; an arm that is done is not stepped any more.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from rejoint.arms import Array, tcp_position
from rejoint.control.controller import Controller, Situation
from rejoint.control.following import Following
from rejoint.control.guard import TRIPS, GuardLimits, Reason, Reasons, guard, reason_names, warm_up
from rejoint.control.recording import Cycle, OnCycle, Recorder, Recording, attach
from rejoint.control.robot import JointState, Mask, Robot
from rejoint.errors import GuardTripError, InputError, RejointError

FIRST_PERIOD = 0.02
"""[s] period assumed before one has been measured (chosen: the shortest regular one, so the smallest first step)."""

RELEASE_CYCLES = 12
"""Cycles in which a joint that is not believed is led back to where it was in balance (chosen: twice what the longest
lead needs at the largest step)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Schedule:
    """What a run starts from, and how long each target is in force."""

    dwell: float
    """[s] longest time per target"""
    stop_below: float | None = None
    """[m] go to the next target at the first measured TCP error below this; None: always the whole dwell"""
    keep_going: bool = False
    """whether the other arms of a batch go on when the guard stops one; else GuardTripError is raised"""
    sent: Array | None = None
    """(B, n) [rad] command in force before the run; None: the measured position. An arm that sags drops by
    its sag where this is forgotten."""

    def __post_init__(self) -> None:
        if not 0.0 < self.dwell < np.inf:
            raise InputError(f"schedule: the dwell must be a positive time in seconds, got {self.dwell}")
        if self.stop_below is not None and not self.stop_below > 0.0:
            raise InputError(f"schedule: stop_below must be a positive distance in metres, got {self.stop_below}")


def run(
    robot: Robot,
    controller: Controller,
    targets: Array,
    schedule: Schedule,
    *,
    limits: GuardLimits | None = None,
    on_cycle: OnCycle | None = None,
) -> Recording:
    """Drive ``robot`` to its ``targets`` (B, K, 3) [m], one after the other.

    The last command carries over between targets. A target of NaN is no target: it lasts its whole
    dwell. Whatever ends the run early (a trip of the guard, an error of the robot, Ctrl-C) first
    stops the robot; the recording so far is on the error, see `recording_of`.
    """
    targets = np.asarray(targets, dtype=float)
    if targets.ndim != 3 or targets.shape[0] != robot.count or targets.shape[1] == 0 or targets.shape[2] != 3:
        raise InputError(f"targets have shape {targets.shape}, expected ({robot.count}, K, 3) with K > 0")
    limits = GuardLimits.of(robot.arm) if limits is None else limits
    recorder = Recorder(robot=robot, controller=controller.name)
    loop = _Loop(
        robot=robot, controller=controller, schedule=schedule, limits=limits, recorder=recorder, on_cycle=on_cycle
    )
    progress: _Progress | None = None
    warm_up(limits)
    try:
        progress = _Progress.begin(_own(robot.read()), targets, schedule.sent, limits)
        controller.reset(progress.situation(), np.ones(robot.count, dtype=bool))
        while loop.cycle(progress):
            pass
        if progress.tripped.any():
            robot.stop()
    except BaseException as error:
        with suppress(RejointError, OSError):  # the first error is the one to report
            robot.stop()
        if progress is not None:
            attach(error, recorder.recording(progress.tripped))
        raise
    return recorder.recording(progress.tripped)


def play(
    robot: Robot,
    trajectory: Callable[[Array], Array],
    duration: float,
    *,
    limits: GuardLimits | None = None,
    on_cycle: OnCycle | None = None,
) -> Recording:
    """Send ``trajectory(time)`` for ``duration`` [s], without a target.

    ``trajectory`` turns times since the start (B,) [s] into commands (B, n) [rad]. Loop and guard
    are those of `run`: a trajectory faster than the guard allows is slowed down, not followed.
    """
    targets = np.full((robot.count, 1, 3), np.nan)
    return run(robot, Playback(trajectory), targets, Schedule(dwell=duration), limits=limits, on_cycle=on_cycle)


def move(
    robot: Robot, posture: Array, *, sent: Array | None = None, speed: float = 0.5, settle: float = 1.0
) -> Recording:
    """Bring every arm to ``posture`` (n,) [rad] at ``speed`` [rad/s] of its farthest joint and wait ``settle`` [s].

    The way starts at the last command ``sent`` (B, n) [rad], by default at the measured position.
    The default speed is chosen: a fifth of what the joints can do.
    """
    start = np.array(robot.read().position if sent is None else sent, dtype=float)
    way = posture - start
    duration = max(float(np.abs(way).max()) / speed, 1e-3)

    def trajectory(time: Array) -> Array:
        return start + np.minimum(time / duration, 1.0)[:, None] * way

    schedule = Schedule(dwell=duration + settle, sent=start)
    return run(robot, Playback(trajectory), np.full((robot.count, 1, 3), np.nan), schedule)


class Playback:
    """Controller that follows a trajectory by the clock."""

    name = "playback"

    def __init__(self, trajectory: Callable[[Array], Array]) -> None:
        self._trajectory = trajectory

    def reset(self, situation: Situation, where: Mask) -> None:
        """Do nothing: the clock is the situation's."""

    def command(self, situation: Situation) -> Array:
        """Return the trajectory's posture (B, n) [rad] at this time."""
        return self._trajectory(situation.since_target)


@dataclass(kw_only=True, eq=False)
class _Progress:
    """Where every arm is in its sequence of targets."""

    state: JointState
    targets: Array
    sent: Array
    index: np.typing.NDArray[np.intp]
    set_at: Array
    active: Mask
    tripped: Reasons
    period: Array
    following: Following
    unbelieved: Mask | None = None
    """(B, n) joints whose readings are not believed in this cycle, None where all are"""
    last_time: Array = field(init=False)

    def __post_init__(self) -> None:
        self.last_time = self.state.time

    @classmethod
    def begin(cls, state: JointState, targets: Array, sent: Array | None, limits: GuardLimits) -> _Progress:
        count = len(targets)
        if sent is not None and np.shape(sent) != state.position.shape:
            raise InputError(f"schedule: sent has shape {np.shape(sent)}, expected {state.position.shape}")
        sent = np.array(state.position if sent is None else sent, dtype=float)
        return cls(
            state=state, targets=targets, sent=sent, index=np.zeros(count, dtype=np.intp),
            set_at=state.time.copy(), active=np.ones(count, dtype=bool), tripped=np.zeros(count, dtype=np.uint16),
            period=np.full(count, FIRST_PERIOD), following=Following(limits.arm, state, sent, limits.servos),
        )  # fmt: skip

    @property
    def target(self) -> Array:
        return self.targets[np.arange(len(self.index)), self.index]

    def situation(self) -> Situation:
        since = self.state.time - self.set_at
        return Situation(state=self.state, target=self.target, sent=self.sent, since_target=since)

    def advance(self, finished: Mask) -> Mask:
        """Set the next target where the present one is finished; returns the arms that got one."""
        last = self.index == self.targets.shape[1] - 1
        renewed = finished & ~last
        self.active = self.active & ~(finished & last)
        self.index = self.index + renewed
        self.set_at = np.where(renewed, self.state.time, self.set_at)
        return renewed

    def stepped(self, state: JointState, command: Array) -> None:
        """Take over what the robot was sent and what it answered."""
        self.sent = np.where(self.active[:, None], command, self.sent)
        elapsed = state.time - self.last_time
        # A repeated answer has no news of the clock: the last period stands.
        self.period = np.where(elapsed > 0.0, elapsed, self.period)
        self.state, self.last_time = state, state.time


@dataclass(frozen=True, kw_only=True, eq=False)
class _Loop:
    """The parts of a run that stay the same from cycle to cycle."""

    robot: Robot
    controller: Controller
    schedule: Schedule
    limits: GuardLimits
    recorder: Recorder
    on_cycle: OnCycle | None

    def cycle(self, progress: _Progress) -> bool:
        """Do one control cycle; returns whether there is another one."""
        before, fresh, index = progress.situation(), progress.active, progress.index
        renewed = progress.advance(fresh & self._finished(before))
        command, reasons = self._decide(progress, renewed)
        cycle = Cycle(
            time=before.state.time, position=before.state.position, command=command, target=before.target,
            target_index=index, since_target=before.since_target, true_tcp=self.robot.true_tcp().copy(), active=fresh,
            reasons=reasons,
        )  # fmt: skip
        self.recorder.cycles.append(cycle)
        self._stop_tripped(progress, reasons)
        if self.on_cycle is not None:
            self.on_cycle(cycle)
        if progress.active.any():
            progress.stepped(_own(self.robot.step(command, progress.active)), command)
        return bool(progress.active.any())

    def _finished(self, situation: Situation) -> Mask:
        """Arms (B,) that have reached their target or waited long enough."""
        finished: Mask = situation.since_target >= self.schedule.dwell
        if self.schedule.stop_below is not None:
            error = np.linalg.norm(situation.target - tcp_position(self.robot.arm, situation.state.position), axis=-1)
            finished = finished | (error < self.schedule.stop_below)
        return finished

    def _decide(self, progress: _Progress, renewed: Mask) -> tuple[Array, Reasons]:
        """Commands (B, n) that may be sent, and the guard's reasons (B,)."""
        active = progress.active
        if not active.any():
            return progress.sent, np.zeros(len(active), dtype=np.uint16)
        situation = progress.situation()
        if renewed.any():
            self.controller.reset(situation, renewed)
        aimed = np.isfinite(situation.target[:, 0])
        progress.unbelieved = progress.following.check(progress.state, progress.sent, aimed)
        wanted = progress.following.bound(self.controller.command(situation), progress.state.position, aimed)
        guarded = guard(self.limits, wanted, progress.sent, progress.state, progress.period)
        command, reasons = guarded
        if progress.unbelieved is not None:
            lost: Mask = np.logical_or.reduce(progress.unbelieved, axis=-1)
            command = np.where(lost[:, None], progress.sent, command)
            reasons = reasons | lost * np.uint16(Reason.NOT_FOLLOWING)
        return np.where(active[:, None], command, progress.sent), reasons * active

    def _stop_tripped(self, progress: _Progress, reasons: Reasons) -> None:
        trips = reasons & np.uint16(TRIPS.value)
        if not trips.any():
            return
        progress.tripped = progress.tripped | trips
        self._release(progress, trips)
        if not self.schedule.keep_going:
            raise _trip_error(int(np.flatnonzero(trips)[0]), progress, self.limits)
        progress.active = progress.active & (trips == 0)

    def _release(self, progress: _Progress, trips: Reasons) -> None:
        """Lead joints that are not believed back to where they were in balance: to hold a blind one is to drive it."""
        if progress.unbelieved is None:
            return
        where = progress.active & ((trips & np.uint16(Reason.NOT_FOLLOWING)) != 0)
        goal = progress.following.balance(progress.unbelieved & where[:, None], progress.sent)
        sent = progress.sent
        with suppress(RejointError, OSError):  # the trip is the error to report
            for _ in range(RELEASE_CYCLES):
                reach = self.limits.max_speed * np.minimum(progress.period, self.limits.max_period)[:, None]
                sent = np.minimum(np.maximum(goal, sent - reach), sent + reach)
                progress.state = _own(self.robot.step(sent, where))
                last = self.recorder.cycles[-1]
                self.recorder.cycles.append(
                    last._replace(
                        time=progress.state.time, position=progress.state.position, command=sent, active=where,
                        true_tcp=self.robot.true_tcp().copy(),
                    )
                )  # fmt: skip
        progress.sent = np.where(where[:, None], sent, progress.sent)


def _own(state: JointState) -> JointState:
    """Copy what is kept beyond this cycle: a robot may reuse its arrays."""
    return replace(state, time=state.time.copy(), position=state.position.copy())


def _trip_error(b: int, progress: _Progress, limits: GuardLimits) -> GuardTripError:
    state, flags = progress.state, Reason(int(progress.tripped[b]))
    names = limits.arm.joint_names
    details = []
    if Reason.STALE in flags:
        details.append(
            f"the joint state is {state.age[b]:.2f} s old, limit {limits.max_age:.2f} s; check the connection"
        )
    if Reason.TEMPERATURE in flags and state.temperature is not None:
        hot = int(np.argmax(state.temperature[b]))
        details.append(
            f"{names[hot]} is at {state.temperature[b, hot]:.0f} deg C, limit {limits.max_temperature:.0f}; let it cool"
        )
    if Reason.SERVO_FAULT in flags and state.fault is not None:
        faulty = ", ".join(np.array(names)[state.fault[b]])
        details.append(f"{faulty} reports a servo fault; free the arm and clear the fault")
    if Reason.OUT_OF_RANGE in flags:
        degrees = np.round(np.degrees(state.position[b]), 1).tolist()
        details.append(f"measured {degrees} deg lies far outside the joint limits; check the arm's zero")
    if Reason.NOT_FOLLOWING in flags and progress.unbelieved is not None:
        details.append(progress.following.describe(b, progress.unbelieved[b]))
    if Reason.NOT_FINITE in flags:
        details.append("a command or a measured position is not a number; check the controller and the connection")
    where = f"arm {b} at {progress.state.time[b] - progress.set_at[b]:.2f} s into target {int(progress.index[b]) + 1}"
    return GuardTripError(", ".join(reason_names(int(flags))), f"{where}: {'; '.join(details)}")
