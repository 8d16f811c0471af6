"""The one control loop: every motion of every robot, emulated or real, goes through `run`.

Each cycle: the state read last decides whether the target is done; the controller says what it
wants; the guard says what may be sent; the robot is stepped. Every arm of a batch has its own
clock and its own target; an arm that is done is not stepped any more.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array, tcp_position
from rejoint.arms.orientation import REACHED_TURN, Orientation
from rejoint.control.controller import ControlInput, Controller, turned_off
from rejoint.control.correction import Correction
from rejoint.control.following import Following
from rejoint.control.guard import TRIPS, Guarded, GuardLimits, Reason, Reasons, guard, suffers, warm_up
from rejoint.control.recording import Cycle, Look, OnCycle, Recorder, Recording, attach, look_of
from rejoint.control.robot import JointState, Mask, Robot
from rejoint.control.route import Route
from rejoint.control.runstate import RunState, own, reported_load
from rejoint.control.trips import trip_error
from rejoint.system.errors import InputError, PowerLostError, RejointError, first_line
from rejoint.system.stopping import check, noted, shielded

RELEASE_CYCLES = 12
"""Cycles in which a joint that is not believed is led back to where it was in balance (chosen: twice what the longest
lead needs at the largest step)."""
LOOSE = 3
"""Encoder steps that a reading must go on, the way its joint was pushed, to be believed again (chosen: a dead encoder
may flicker by one)"""
MOST_DOUBTED = 2
"""Times in a run that an arm goes on after a joint that was not believed broke loose (chosen: an encoder that fails now
and then is to be found)"""


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
    its sag where this is forgotten. One that stands elsewhere since begins where it stands, slowly."""
    stands_for: float | None = None
    """[s] under one command after which an arm that stands has the rest of its dwell left out: the time since its
    target was set jumps to the dwell; None: it is waited for"""
    give_up: Callable[[ControlInput], Mask] | None = None
    """asked once per cycle with what was read: arms (B,) that are done, whatever is left of their targets. They stay
    where they are, at the last command. Servos that suffer are left to the guard"""

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
    correction: Correction | None = None,
    on_cycle: OnCycle | None = None,
    turns: Orientation | None = None,
) -> Recording:
    """Drive ``robot`` to its ``targets`` (B, K, 3) [m], one after the other, with the tools turned as in ``turns``.

    The last command carries over between targets. A target of NaN is no target: it lasts its whole
    dwell. Whatever ends the run early (a trip of the guard, an error of the robot, a signal) first
    stops the robot; the recording so far is on the error, see `recording_of`, and a note of what
    became of the arm. After a gap in its answers an arm goes on from where it is, slowly at first.
    A ``correction`` says where the controller is to send the tool, so that it really arrives at its target.
    """
    targets = np.asarray(targets, dtype=float)
    if targets.ndim != 3 or targets.shape[0] != robot.count or targets.shape[1] == 0 or targets.shape[2] != 3:
        raise InputError(f"targets have shape {targets.shape}, expected ({robot.count}, K, 3) with K > 0")
    if turns is not None and turns.weight.shape != targets.shape[:2]:
        raise InputError(f"orientations have shape {turns.weight.shape}, expected that of the targets")
    loop = _Loop.of(robot, controller, schedule, limits, on_cycle, correction=correction, turns=turns)
    return _drive(loop, targets)


def follow(
    robot: Robot,
    controller: Controller,
    route: Route,
    schedule: Schedule,
    *,
    limits: GuardLimits | None = None,
    on_cycle: OnCycle | None = None,
) -> Recording:
    """Drive ``robot`` behind the moving targets of a ``route``, for the dwell of the schedule; else as `run`.

    Controllers are not reset on the way. The route has the aims, so that no correction is needed.
    """
    if route.count != robot.count:
        raise InputError(f"a route of {route.count} targets, expected one for each of {robot.count} arms")
    loop = _Loop.of(robot, controller, schedule, limits, on_cycle, route=route)
    return _drive(loop, np.full((robot.count, 1, 3), np.nan))


def _warm_up(limits: GuardLimits) -> None:
    """Have everything ready that the first cycle needs: one that waited would be long, and would allow a long step."""
    warm_up(limits)
    rest = limits.arm.rest[None]
    state = JointState(time=np.zeros(1), position=rest, age=np.zeros(1))
    Following(limits.arm, state, rest).check(state, rest, np.ones(1, dtype=bool))


def _drive(loop: _Loop, targets: Array) -> Recording:
    _warm_up(loop.limits)
    with noted():
        return _cycles(loop, targets)


def _cycles(loop: _Loop, targets: Array) -> Recording:
    robot, recorder = loop.robot, loop.recorder
    run_state: RunState | None = None
    try:
        check()
        run_state = RunState.begin(
            own(robot.read()), targets, loop.schedule.sent, loop.limits, loop.correction, loop.route, loop.turns
        )
        loop.controller.reset(run_state.inputs(), np.ones(robot.count, dtype=bool))
        while loop.cycle(run_state):
            check()
        if run_state.tripped.any():
            robot.stop()
    except BaseException as error:
        held = _hold(robot, limp=isinstance(error, PowerLostError))
        if run_state is not None:
            attach(error, recorder.recording(run_state.tripped))
        if robot.count == 1:
            error.add_note(held)
        raise
    return recorder.recording(run_state.tripped)


def _hold(robot: Robot, *, limp: bool = False) -> str:
    """Stop the robot, whatever else happens, and say what became of it; ``limp``: something in it lost its torque."""
    with shielded():
        try:
            robot.stop()
        except (RejointError, OSError) as error:  # the first error is the one to report
            return (
                f"The order to stop did not arrive ({first_line(error)}). By itself the arm goes to the last command "
                "and holds there; nothing was powered off. Look at it before you go on."
            )
    if limp:
        return (
            "What has no torque does not hold; the rest of the arm was stopped and holds. Look at it before you go on."
        )
    return "The arm was stopped and holds its position; nothing was powered off. Look at it before you go on."


@dataclass(frozen=True, kw_only=True, eq=False)
class _Loop:
    """The parts of a run that stay the same from cycle to cycle."""

    robot: Robot
    controller: Controller
    schedule: Schedule
    limits: GuardLimits
    recorder: Recorder
    on_cycle: OnCycle | None
    look: Look | None
    correction: Correction | None = None
    route: Route | None = None
    turns: Orientation | None = None

    @classmethod
    def of(
        cls, robot: Robot, controller: Controller, schedule: Schedule, limits: GuardLimits | None,
        on_cycle: OnCycle | None, *, correction: Correction | None = None, route: Route | None = None,
        turns: Orientation | None = None,
    ) -> _Loop:  # fmt: skip
        """Return the loop of a robot, within the limits of its arm where none are given."""
        limits = GuardLimits.of(robot.arm) if limits is None else limits
        return cls(
            robot=robot, controller=controller, schedule=schedule, limits=limits, on_cycle=on_cycle,
            recorder=Recorder(robot=robot, controller=controller.name), look=look_of(robot, controller.name, limits),
            correction=correction, route=route, turns=turns,
        )  # fmt: skip

    def cycle(self, run_state: RunState) -> bool:
        """Do one control cycle; returns whether there is another one."""
        if self.schedule.stands_for is not None:
            run_state.leave_out(self.schedule.stands_for, self.schedule.dwell)
        before, target = run_state.inputs(), run_state.target
        fresh, index = run_state.active, run_state.index
        if self.schedule.give_up is not None:
            done = self.schedule.give_up(before) & ~suffers(self.limits, before.state)  # that is for the guard to say
            run_state.active = fresh & ~done
        renewed = run_state.advance(run_state.active & self._finished(before))
        command, reasons, speed = self._decide(run_state, renewed)
        cycle = Cycle(
            time=before.state.time, position=before.state.position, command=command, target=target,
            aim=before.target, target_index=index, since_target=before.since_target,
            true_tcp=self.robot.true_tcp().copy(), active=fresh, reasons=reasons, load=reported_load(before.state),
            turned=turned_off(self.robot.arm, before),
        )  # fmt: skip
        self.recorder.cycles.append(cycle)
        if self.look is not None:
            self.look(cycle, before.state, run_state.wanted)
        if self.on_cycle is not None:
            self.on_cycle(cycle)
        if self._stop_tripped(run_state, reasons):
            return True
        if run_state.active.any():
            run_state.stepped(own(self.robot.step(command, run_state.active)), command, speed)
        return bool(run_state.active.any())

    def _finished(self, inputs: ControlInput) -> Mask:
        """Arms (B,) that have reached their target or waited long enough."""
        finished: Mask = inputs.since_target >= self.schedule.dwell
        if self.schedule.stop_below is not None:
            error = np.linalg.norm(inputs.target - tcp_position(self.robot.arm, inputs.state.position), axis=-1)
            turned = turned_off(self.robot.arm, inputs)
            finished = finished | ((error < self.schedule.stop_below) & ~(turned > REACHED_TURN))
        return finished

    def _decide(self, run_state: RunState, renewed: Mask) -> Guarded:
        """Commands (B, n) that may be sent, the guard's reasons (B,), and the speed of the commands."""
        active = run_state.active
        if not active.any():
            return Guarded(run_state.sent, np.zeros(len(active), dtype=np.uint16), run_state.speed)
        inputs, fresh = run_state.inputs(), renewed | run_state.gap
        corrected = run_state.aim_again()
        if corrected is not None:
            inputs, fresh = run_state.inputs(), fresh | corrected
        if fresh.any():
            self.controller.reset(inputs, fresh)
        aimed = np.isfinite(inputs.target[:, 0])
        run_state.unbelieved = run_state.following.check(run_state.state, run_state.sent, aimed)
        wanted = run_state.following.bound(self.controller.command(inputs), run_state.state.position, aimed)
        run_state.wanted = wanted
        ease = run_state.ease  # slower time for the guard is a slower arm
        guarded = guard(
            self.limits,
            wanted,
            run_state.sent,
            run_state.speed / ease[:, None],
            run_state.state,
            ease * run_state.period,
        )
        command = guarded.command
        reasons = guarded.reasons + run_state.gap * np.uint16(Reason.GAP.value)
        if run_state.unbelieved is not None:
            lost: Mask = np.logical_or.reduce(run_state.unbelieved, axis=-1)
            command = np.where(lost[:, None], run_state.sent, command)
            reasons = reasons | lost * np.uint16(Reason.NOT_FOLLOWING.value)
        command = np.where(active[:, None], command, run_state.sent)
        return Guarded(command, reasons * active, ease[:, None] * guarded.speed)

    def _stop_tripped(self, run_state: RunState, reasons: Reasons) -> bool:
        """Stop what tripped; returns whether an arm was let go on after all, so that what was decided is void."""
        trips = reasons & np.uint16(TRIPS.value)
        if not trips.any():
            return False
        alive = self._release(run_state, trips) & (trips == np.uint16(Reason.NOT_FOLLOWING.value))
        trips = trips * ~alive
        run_state.tripped = run_state.tripped | trips
        if trips.any() and not self.schedule.keep_going:
            raise trip_error(int(np.flatnonzero(trips)[0]), run_state, self.limits)
        run_state.active = run_state.active & (trips == 0)
        if not alive.any():
            return False
        newest = self.recorder.cycles.pop()  # what an arm that goes on reads there is the next cycle's
        if (newest.active & ~alive).any():
            self.recorder.cycles.append(newest._replace(active=newest.active & ~alive))
        run_state.go_on(alive)
        return True

    def _release(self, run_state: RunState, trips: Reasons) -> Mask:
        """Lead joints that are not believed back to where they were in balance: to hold a blind one is to drive it.

        Returns the arms (B,) whose joints broke loose meanwhile, and may go on.
        """
        if run_state.unbelieved is None:
            return np.zeros(len(trips), dtype=bool)
        where = run_state.active & ((trips & np.uint16(Reason.NOT_FOLLOWING)) != 0)
        goal = run_state.following.balance(run_state.unbelieved & where[:, None], run_state.sent)
        sent, stood = run_state.sent, run_state.state.position
        farthest = np.zeros_like(stood)
        with shielded(), suppress(RejointError, OSError):  # the trip is the error to report
            for _ in range(RELEASE_CYCLES):
                reach = self.limits.max_speed * np.minimum(run_state.period, self.limits.max_period)[:, None]
                sent = np.minimum(np.maximum(goal, sent - reach), sent + reach)
                run_state.state = own(self.robot.step(sent, where))
                farthest = np.maximum(farthest, run_state.following.onward(run_state.state.position - stood))
                last = self.recorder.cycles[-1]
                self.recorder.cycles.append(
                    last._replace(
                        time=run_state.state.time, position=run_state.state.position, command=sent, active=where,
                        true_tcp=self.robot.true_tcp().copy(), load=reported_load(run_state.state),
                        turned=np.full(len(where), np.nan),
                    )
                )  # fmt: skip
        run_state.sent = np.where(where[:, None], sent, run_state.sent)
        loose: Mask = (farthest >= LOOSE * self.robot.arm.encoder_step) | ~run_state.unbelieved
        return where & loose.all(axis=-1) & (run_state.doubted < MOST_DOUBTED)
