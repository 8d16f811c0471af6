"""The one control loop: every motion of every robot goes through `run`.

In each cycle the controller commands, the guard limits, the robot moves. Every arm has its own clock and target.
Constants without a source are chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from rejoint.arms import Array, Mask, tcp_position
from rejoint.arms.arm import frozen
from rejoint.arms.rotations import REACHED_TURN
from rejoint.control.correction import tool_error
from rejoint.control.guard import (
    MAX_AGE,
    MAX_LEAD,
    MAX_TEMPERATURE,
    TRIPS,
    Guarded,
    GuardLimits,
    Reason,
    Reasons,
    guard,
    reason_names,
    servo_trips,
    warm_up,
)
from rejoint.control.monitor import Following
from rejoint.control.recording import GAP, Cycle, LookedAt, OnCycle, Recording, recorded
from rejoint.control.reference import Reference, TargetSequence
from rejoint.control.robot import ControlInput, Controller, JointState, Robot, RobotWrapper, part_of, turned_off
from rejoint.system.errors import GuardTripError, InputError, NotReadyError, PowerLostError, RejointError, first_line
from rejoint.system.numbers import as_floats
from rejoint.system.records import entity
from rejoint.system.stopping import Interrupted, check, noted, shielded

FIRST_PERIOD = 0.02
"""[s] assumed before a period is measured (chosen: the shortest)"""

GAP_PERIODS = 3.0
"""Times the usual period that a gap also exceeds"""
LATE_PERIODS = 2.0
"""Times the usual period from which a cycle is late"""
_SMOOTHING = 0.1  # share of the newest period in that mean (chosen)

ELSEWHERE = np.radians(5.0)
"""[rad] off the way to the last command, of a joint that others moved"""
EASE = 1.0
"""[s] of slow motion after a gap"""
BRAKE, LAG = np.radians(3.0), 0.2
"""[rad] and [s] of a command ahead of a joint that is to stop (chosen: as far as worn arms sag, twice what they lag)"""
EASE_SHARE = 0.2
"""(chosen: the share that `move` takes by default)"""


def elsewhere(before: Array, command: Array, position: Array) -> Mask:
    """Arms (B,) with a ``position`` (B, n) [rad] off the way from ``before`` to ``command`` (B, n)."""
    low, high = np.minimum(before, command) - ELSEWHERE, np.maximum(before, command) + ELSEWHERE
    return ((position < low) | (position > high)).any(axis=-1)


def in_force(state: JointState, sent: Array | None) -> Array:
    """``sent`` (B, n) [rad], or the measured positions where it is unknown, or others moved the arm."""
    known = np.array(state.position if sent is None else sent, dtype=float)
    return known if state.elsewhere is None else np.where(state.elsewhere[:, None], state.position, known)


@entity
class Schedule:
    """What a run starts from, and how long targets last."""

    dwell: float
    """[s] longest time per target"""
    stop_below: float | None = None
    """[m] TCP error that ends a target; None: the dwell alone"""
    keep_going: bool = False
    """the other arms go on after a trip"""
    sent: Array | None = None
    """(B, n) [rad] command in force before the run; None: the measured position"""
    give_up: Callable[[ControlInput], bool] | None = None
    """called once per cycle: whether the arms are done, and hold"""
    ways: float | None = None
    """[s] of the dwell for a planned way, from whose start times count; None: from its end"""


def run(
    robot: Robot,
    controller: Controller,
    reference: Reference | Array,
    schedule: Schedule,
    *,
    limits: GuardLimits | None = None,
    on_cycle: OnCycle | None = None,
) -> Recording:
    """Drive ``robot`` along a ``reference``, or to targets (B, K, 3) [m] in turn.

    An exception first stops the robot, and carries the recording (`recording_of`).
    """
    limits = limits or GuardLimits.of(robot.arm)
    if not isinstance(reference, Reference):
        reference = TargetSequence(limits.arm, reference)
    warm_up(limits)
    run_state: RunState | None = None
    with noted(), _alone(robot):
        try:
            check()
            run_state = RunState(robot, controller, reference, schedule, limits, on_cycle)
            controller.reset(run_state.inputs, np.full(robot.count, True))
            while run_state.cycle():
                check()
            if run_state.tripped.any():
                robot.stop()
        except BaseException as error:
            held = _hold(robot, run_state, error)
            if run_state is not None and run_state.cycles:
                error.recording = run_state.recording()  # type: ignore[attr-defined]
            if robot.count == 1:
                error.add_note(held)
            raise
        return run_state.recording()


_MOVING = set[int]()
"""Ids of the robots that move"""


@contextmanager
def _alone(robot: Robot) -> Iterator[None]:
    """Refuse a second motion of a robot."""
    while isinstance(robot, RobotWrapper):
        robot = robot.robot
    if id(robot) in _MOVING:
        raise NotReadyError(f"{robot.address} is moved already by this program; end that motion first")
    _MOVING.add(id(robot))
    try:
        yield
    finally:
        _MOVING.discard(id(robot))


def brake(robot: Robot, last: Cycle, see: OnCycle) -> None:
    """Bring a stopped arm to rest behind its ``last`` command: a weak joint would go on there for long.

    ``see`` receives the cycle that does it, if one is needed.
    """
    now = own(robot.read())
    ahead, came = last.command - now.position, np.abs(now.position - last.position)
    most = np.maximum(BRAKE, LAG * came / np.maximum(now.time - last.time, FIRST_PERIOD)[:, None])
    if (np.abs(ahead) > most).any():
        braking = replace(last.later(robot, now, now.position + np.clip(ahead, -most, most)), turned=last.turned)
        robot.step(braking.command)
        see(braking)


def _hold(robot: Robot, run_state: RunState | None, error: BaseException) -> str:
    """Stop the robot; returns what became of it."""
    with shielded():
        try:
            robot.stop()
        except Exception as other:  # noqa: BLE001 - also a bug of its driver; the first error is the one to report
            return (
                f"The order to stop did not arrive ({first_line(other)}). By itself the arm goes to the last command "
                "and holds there; nothing was powered off. Look at it before you go on."
            )
    if run_state is not None and run_state.cycles and isinstance(error, Interrupted):
        with shielded(), suppress(Exception):  # the order to stop has arrived, and the first error is the one to report
            brake(robot, run_state.cycles[-1], run_state.record)
    if isinstance(error, PowerLostError) or (isinstance(error, GuardTripError) and error.limp):
        return (
            "What has no torque does not hold; the rest of the arm was stopped and holds. Look at it before you go on."
        )
    return "The arm was stopped and holds its position; nothing was powered off. Look at it before you go on."


TEN_TURNS = 20.0 * np.pi
"""[rad] no command is so far; chosen: the paper's integrator asks for some turns"""
PULL_CYCLES, RELEASE_CYCLES = 12, 18
"""Cycles that pull a flagged joint back, and those until its last equilibrium"""
LOOSE = 3
"""Encoder steps after which a joint is trusted again"""
MOST_DOUBTED = 2
"""Times in a run that an arm goes on after that"""


S = TypeVar("S", JointState, ControlInput)


def own(seen: S) -> S:
    """Copy with arrays that no controller can change: the guard reads them too."""
    arrays: dict[str, Any] = {k: frozen(one) for k, one in vars(seen).items() if isinstance(one, np.ndarray)}
    return replace(seen, **arrays)


@dataclass(eq=False)
class RunState:
    """State of a run."""

    robot: Robot
    controller: Controller
    reference: Reference
    schedule: Schedule
    limits: GuardLimits
    on_cycle: OnCycle | None

    def __post_init__(self) -> None:
        robot, limits, count, sent = self.robot, self.limits, self.robot.count, self.schedule.sent
        self.cycles: list[Cycle] = []
        shown = part_of(robot, LookedAt)
        self.look = None if shown is None else shown.onlooker(self.controller.name)
        self.state = state = own(robot.read())
        self.sent = in_force(state, sent)
        self.following = Following(limits.arm, state, self.sent, limits.bands)
        self.unbelieved = self.following.falling  # (B, n) joints that are not trusted in this cycle
        self.speed, self.wanted = np.zeros_like(self.sent), self.sent
        self.index, self.doubted = np.zeros((2, count), dtype=np.intp)  # the latter: times that a joint broke loose
        # [s] of the target, shifted by gaps and waits; the same with waits
        self.set_at = self.begun = state.time
        self.active = np.full(count, True)
        self.gap = np.full(count, False)  # whether the state came after a gap
        self.tripped = np.zeros(count, dtype=np.uint16)
        self.period, self.usual = np.full(count, FIRST_PERIOD), np.full(count, np.nan)  # [s] newest, and their mean
        self.eased_until = np.full(count, -np.inf)
        self.reference.begin(self.active, self.index, self.sent, state.position)
        self._ask()
        if state.elsewhere is not None:
            self._ease(state.elsewhere, self.sent if sent is None else sent)

    def recording(self) -> Recording:
        """Return all cycles so far."""
        return recorded(self.robot, self.controller.name, self.cycles, self.tripped)

    def record(self, cycle: Cycle) -> None:
        """Take a cycle, also for those who look on."""
        self.cycles.append(cycle)
        if self.on_cycle is not None:
            self.on_cycle(cycle)

    def _ask(self) -> None:
        nowhere, since = np.full((self.robot.count, 3), np.nan), self.state.time - self.set_at
        asked = ControlInput(state=self.state, target=nowhere, goal=self.sent, sent=self.sent, since_target=since)
        self.inputs = now = own(self.reference.advance(asked))
        # (B, 3) [m] recorded
        self.place = tcp_position(self.limits.arm, now.goal) if now.place is None else now.place
        self.aim = self.place if now.aim is None else now.aim

    def _since(self) -> Array:
        """(B,) [s] since the target."""
        return self.inputs.since_target if self.schedule.ways is None else self.state.time - self.begun

    def _advance(self, finished: Mask) -> Mask:
        if not finished.any():
            return finished
        last = self.index == self.reference.legs - 1
        renewed = finished & ~last
        self.active = self.active & ~(finished & last)
        self.index = self.index + renewed
        self.set_at, self.begun = (np.where(renewed, self.state.time, old) for old in (self.set_at, self.begun))
        if renewed.any():
            self.reference.begin(renewed, self.index, self.sent, self.state.position)
            self._ask()
        return renewed

    def _stepped(self, state: JointState, command: Array, speed: Array) -> None:
        self.sent, self.speed = np.where(self.active[:, None], command, self.sent), speed
        elapsed = state.time - self.state.time
        self.gap = elapsed > np.fmax(GAP, GAP_PERIODS * self.usual)
        late = elapsed > LATE_PERIODS * self.usual  # NaN: not known yet
        # A repeated answer has no news of the clock: the last period stands.
        self.period = np.where(elapsed > 0.0, np.where(late, self.usual, elapsed), self.period)
        known, moved = np.where(np.isnan(self.usual), elapsed, self.usual), self.gap
        if self.gap.any():
            self._wait(self.gap, elapsed)
            moved = moved & elsewhere(self.state.position, self.sent, state.position)
        left_out = self.reference.left_out(self.state.time - self.set_at, self.state.position, state.position)
        self.set_at = self.set_at + left_out * np.clip(elapsed, 0.0, self.period)
        self.usual = np.where(elapsed > 0.0, known + _SMOOTHING * (np.minimum(elapsed, GAP) - known), self.usual)
        self.state = state
        if self.gap.any():
            self._begin_again(self.gap, moved)
        self._ask()

    def _wait(self, where: Mask, elapsed: Array) -> None:
        """Leave a gap of ``elapsed`` (B,) [s] out of the time of what waits."""
        usual = np.where(np.isnan(self.usual), FIRST_PERIOD, self.usual)
        left_out = np.where(where & self.reference.waits, elapsed - usual, 0.0)
        self.set_at, self.begun = self.set_at + left_out, self.begun + left_out

    def _begin_again(self, where: Mask, moved: Mask) -> None:
        self.period = np.where(where, FIRST_PERIOD, self.period)
        self.eased_until = np.where(where, self.state.time + EASE, self.eased_until)
        # An arm that sags keeps its command; one that stands elsewhere no longer knows it.
        far = where[:, None] & (np.abs(self.sent - self.state.position) > MAX_LEAD)
        told, self.sent = self.sent, np.where(far | moved[:, None], self.state.position, self.sent)
        self._ease(moved, told)
        self.speed = np.where(where[:, None], 0.0, self.speed)

    def _ease(self, where: Mask, told: Array) -> None:
        way = np.max(np.abs(told - self.state.position) / (EASE_SHARE * self.limits.max_speed), axis=-1)
        self.eased_until = np.where(where, self.state.time + EASE + way, self.eased_until)

    def cycle(self) -> bool:
        """Do a cycle; returns whether another follows."""
        before, state, target, aim = self.inputs, self.state, self.place, self.aim
        fresh, index, since, turned = self.active, self.index, self._since(), turned_off(self.robot.arm, before)
        if self.schedule.give_up is not None and self.schedule.give_up(before):
            self.active = fresh & (servo_trips(state) != 0)  # the guard says it
        command, reasons, speed = self._decide(self._advance(self.active & self._finished(turned)))
        cycle = Cycle(
            time=state.time,
            position=state.position,
            command=command,
            target=target,
            aim=aim,
            target_index=index,
            since_target=since,
            true_tcp=self.robot.true_tcp().copy(),
            active=fresh,
            reasons=reasons,
            load=state.known_load,
            turned=turned,
        )
        if self.look is not None:
            self.look(cycle, state, self.wanted)
        self.record(cycle)
        if self._stop_tripped(reasons):
            return True
        if self.active.any():
            self._stepped(own(self.robot.step(command, self.active)), command, speed)
        return bool(self.active.any())

    def _finished(self, turned: Array) -> Mask:
        """Arms (B,) whose target has ended; ``turned`` (B,) [rad]: their orientation errors."""
        dwell, below = self.schedule.dwell, self.schedule.stop_below
        # of the dwell, at the end of a way at least what is not for ways
        spent = np.minimum(self._since(), self.inputs.since_target + (self.schedule.ways or 0.0))
        finished = spent >= dwell
        finished = finished | (self.state.time - self.begun >= dwell + self.reference.patience)
        if below is not None:
            near = tool_error(self.robot.arm, self.state.position, self.aim) < below
            finished = finished | (near & ~(turned > REACHED_TURN))
        return finished

    def _decide(self, renewed: Mask) -> Guarded:
        active = self.active
        if not active.any():
            return Guarded(self.sent, np.zeros_like(self.tripped), self.speed)
        fresh, corrected = renewed | self.gap, self.reference.again(self.inputs)
        if corrected is not None:
            self._ask()
            fresh = fresh | (corrected & active)
        inputs = self.inputs
        if fresh.any():
            self.controller.reset(inputs, fresh)
        aimed = np.isfinite(inputs.target[:, 0])
        self.unbelieved = self.following.check(self.state, self.sent, aimed, inputs.goal)
        asked, who = self.controller.command(inputs), f"command of the controller {self.controller.name}"
        asked = as_floats(who, asked, expected := f"joint positions {self.sent.shape}: arms, joints")
        if asked.shape != self.sent.shape:
            raise InputError(f"{who}: of shape {asked.shape}, expected {expected}")
        if (np.abs(asked) > TEN_TURNS).any():
            raise InputError(f"{who}: beyond ten turns; give radians")
        self.wanted, wanted = asked, self.following.bound(asked, self.state.position, aimed)
        # After a gap: slower time for the guard is a slower arm.
        ease = np.where(self.state.time < self.eased_until, EASE_SHARE, 1.0)
        last, period = self.speed / ease[:, None], ease * self.period
        moving = (inputs.since_target == 0.0) & self.reference.planned
        guarded = guard(self.limits, wanted, self.sent, last, self.state, period, (inputs.goal, moving))
        held = ((wanted != asked) & (guarded.command == wanted)).any(axis=-1)
        lost = self.unbelieved.any(axis=-1)
        reasons = guarded.reasons + self.gap * np.uint16(Reason.GAP)
        reasons = reasons | held * np.uint16(Reason.LEAD) | lost * np.uint16(Reason.NOT_FOLLOWING)
        return Guarded(
            np.where((active & ~lost)[:, None], guarded.command, self.sent),
            reasons * active,
            ease[:, None] * guarded.speed,
        )

    def _stop_tripped(self, reasons: Reasons) -> bool:
        trips = reasons & np.uint16(TRIPS)
        if not trips.any():
            return False
        since = self.state.time
        alive = self._release(trips) & (trips == Reason.NOT_FOLLOWING) & ~self.following.falling.any(axis=-1)
        trips = trips * ~alive
        self.tripped = self.tripped | trips
        if trips.any() and not self.schedule.keep_going:
            raise trip_error(int(np.flatnonzero(trips)[0]), self)
        self.active = self.active & (trips == 0)
        if not alive.any():
            return False
        newest = self.cycles.pop()  # what an arm that goes on reads there is the next cycle's
        if (newest.active & ~alive).any():
            self.cycles.append(replace(newest, active=newest.active & ~alive))
        self.doubted = self.doubted + alive
        self.following.believe(self.state, self.sent, self.unbelieved & alive[:, None])
        self._wait(alive, self.state.time - since)
        self.gap = self.gap | alive
        self._begin_again(alive, np.zeros_like(alive))
        self._ask()
        return True

    def _release(self, trips: Reasons) -> Mask:
        """Pull flagged joints back; returns the arms (B,) that moved."""
        where = self.active & ((trips & Reason.NOT_FOLLOWING) != 0)
        if not where.any():
            return where
        joints = self.unbelieved & where[:, None]
        held, back = (ask(joints, self.sent) for ask in (self.following.balance, self.following.pulled))
        sent, speed, stood = self.sent, np.zeros_like(self.sent), self.state.position
        loose = ~self.unbelieved
        with shielded(), suppress(RejointError, OSError):  # the trip is the error to report
            for k in range(RELEASE_CYCLES):
                goal = np.where(loose | (k >= PULL_CYCLES), held, back)
                sent, _, speed = guard(self.limits, goal, sent, speed, self.state, self.period)
                self.state = own(self.robot.step(sent, where))
                loose = loose | (np.abs(self.state.position - stood) >= LOOSE * self.robot.arm.encoder_step)
                self.record(replace(self.cycles[-1].later(self.robot, self.state, sent), active=where))
        self.sent = np.where(where[:, None], sent, self.sent)
        return where & loose.all(axis=-1) & (self.doubted < MOST_DOUBTED)


def trip_error(b: int, run_state: RunState) -> GuardTripError:
    """Error of the arm ``b`` that tripped."""
    state, flags = run_state.state, Reason(int(run_state.tripped[b]))
    names = run_state.limits.arm.joint_names
    details = []
    if Reason.STALE in flags:
        details.append(f"the joint state is {state.age[b]:.2f} s old, limit {MAX_AGE:.2f} s; check the connection")
    if Reason.TEMPERATURE in flags and state.temperature is not None:
        details.append(say_hot(names, state.temperature[b], MAX_TEMPERATURE))
    if Reason.SERVO_FAULT in flags and state.fault is not None:
        details.append(say_faulty(names, state.fault[b], state.trouble))
    if Reason.OUT_OF_RANGE in flags:
        degrees = np.round(np.degrees(state.position[b]), 1).tolist()
        details.append(f"measured {degrees} deg lies far outside the joint limits; check the arm's zero")
    if Reason.NOT_FOLLOWING in flags:
        details += [run_state.following.describe(b, j) for j in np.flatnonzero(run_state.unbelieved[b]).tolist()]
    if Reason.NOT_FINITE in flags:
        details.append("a command or a measured position is not a number; check the controller and the connection")
    since, which = run_state.state.time[b] - run_state.set_at[b], f" of arm {b + 1}" * (len(state.position) > 1)
    where = f"{since:.2f} s into target {int(run_state.index[b]) + 1}{which}"
    limp = Reason.SERVO_FAULT in flags or bool(run_state.following.falling[b].any())
    return GuardTripError(", ".join(reason_names(flags)), f"{'; '.join(details)} ({where})", limp=limp)


def say_hot(names: tuple[str, ...], temperature: Array, limit: float) -> str:
    """Name the hottest joint at ``temperature`` (n,) [deg C]."""
    hot = temperature.argmax()
    return f"{names[hot]} is at {temperature[hot]:.0f} deg C, limit {limit:.0f}; support the arm and switch it off"


def say_faulty(names: tuple[str, ...], fault: Mask, trouble: tuple[str, ...] | None = None) -> str:
    """Name the joints with a servo ``fault`` (n,), and what they report."""
    faulty = ", ".join(np.array(names)[fault])
    found = list(dict.fromkeys(part for one in trouble or () for part in one.split(", ") if part))
    starved = bool(found) and all(one == "voltage" or one.startswith("the supply sags") for one in found)
    advice = "free the arm and clear the fault"
    if starved:
        advice = "look at its supply, which may be too weak, and at the cables"
    verb = "reports" if np.count_nonzero(fault) == 1 else "report"
    words = f" ({'; '.join(found)})" if found else ""
    return f"{faulty} {verb} a servo fault{words}; {advice}"
