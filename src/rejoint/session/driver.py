"""What holds an arm; the only caller of the control loop."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

from rejoint.arms import Arm, Array
from rejoint.control.contract import check_controller_period
from rejoint.control.controller import ControlInput, Controller, heeds_turn
from rejoint.control.correction import Apparent, Modelled
from rejoint.control.feedforward import FeedforwardController
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import Schedule, run
from rejoint.control.observer import Observer
from rejoint.control.posture import PostureController, PostureGains
from rejoint.control.recording import Cycle, OnCycle, Recording, recording_of
from rejoint.control.reference import Reference
from rejoint.control.robot import Mask, Robot
from rejoint.control.servogains import limits_under, under_gains
from rejoint.control.start import begin, check_ready, move
from rejoint.robots import open_robot
from rejoint.robots.wrapper import WallClock
from rejoint.runs.run import exclusive
from rejoint.runs.run import metered as meter_of
from rejoint.session.context import calibration_of, corrected_by, guard_limits, stance_of, twin_in_force
from rejoint.session.controllers import ControllerLike, choice, make_factories, name_of, quick_note
from rejoint.session.inputs import (
    ArmLike,
    RobotLike,
    RunLike,
    address_of,
    arm_of,
    as_run,
    as_twin,
    is_virtual,
    period_of,
)
from rejoint.session.payload import equipped
from rejoint.session.recorder import RunRecorder
from rejoint.session.rehearsal import RehearsedRobot, copied
from rejoint.session.settings import Settings, settled
from rejoint.system.errors import InputError
from rejoint.system.files import require_space
from rejoint.system.numbers import as_seed
from rejoint.system.progress import RateLimit
from rejoint.system.stopping import noted

if TYPE_CHECKING:
    from rejoint.diagnosis.calibration.calibration import Calibration
    from rejoint.twin.twin import Twin


class ArmDriver:
    """An arm with everything that drives it; a session adds the motions."""

    def __init__(
        self,
        robot: RobotLike | None,
        *,
        run: RunLike | None = None,
        arm: ArmLike | None = None,
        settings: Settings | None = None,
        observer: Observer | None = None,
        pace: float | None = None,
    ) -> None:
        """Take the run for this process; the robot opens when it is needed.

        Without a robot: for recordings. ``pace`` [simulated seconds per second] ties virtual time to the wall clock.
        """
        about, self.observer = None if run is None else as_run(run), observer or Observer()
        self.settings, kept = settled(settings, about, robot)
        for line in filter(None, (quick_note(about), kept)):
            self.observer.message(line)
        about = about and about.seeded(self.settings.seed)
        if robot is None and about is None and arm is None:
            raise InputError("session: without a robot and a run the arm is needed")
        bare = about.arm if about is not None else arm_of(robot, arm)
        self.arm: Arm = equipped(bare, robot, self.settings)
        """with payload and tool of the settings"""
        self.seed = as_seed(self.settings.seed) if about is None else about.seed
        self.address = "" if robot is None else address_of(robot)
        self.period = None if robot is None else period_of(robot, self.settings.period)
        """[s] interval of control periods; None: the open robot knows"""
        self.limits: GuardLimits | None = None
        """of the guard; None before the robot is open"""
        self.beside: list[Callable[[], object]] = []
        """called in every cycle"""
        self.watching: list[OnCycle] = []
        """called with every cycle, and with every reading between motions"""
        self._given, self._pace = robot, pace
        self._stack, self._alone = ExitStack(), ExitStack()
        self._stack.enter_context(self._alone)
        self._alone.enter_context(exclusive(about))
        self._named = about  # as the user knows it, also where a copy is worked on
        self.rehearsal: RehearsedRobot | None = None
        self.run = about if about is None or not self.settings.dry_run else self._stack.enter_context(copied(about))
        """a copy in a dry run; None: nothing is written"""
        self.recorder = RunRecorder(self.run, self.observer.message)
        self._base: GuardLimits | None = None
        self._gains, self._in_charge = ExitStack(), cast("Controller | None", object())
        self._chosen: dict[bool, tuple[str, Controller]] = {}
        self._announced = set[str]()
        self._last: Cycle | None = None
        self._sent: Array | None = None
        self._usual, self._rested = float("nan"), False
        self._progress = RateLimit(self.observer.progress)
        self._asking = threading.RLock()  # of threads that ask the arm or begin a motion

    @cached_property
    def robot(self) -> Robot:
        """The open robot."""
        if self.run is not None:
            require_space(self.run.path)
        with noted():
            if self._given is None:
                raise InputError("session: there is no robot to drive")
            robot = self._given
            if isinstance(robot, str):
                robot = open_robot(robot, arm=self.arm, seed=self.seed, period=self.period)
                self._stack.callback(robot.close)
            if robot.count != 1:
                raise InputError(f"a session drives one arm, {robot.address} has {robot.count}")
            if self.settings.dry_run:
                robot = self.rehearsal = RehearsedRobot(robot, self.twin, self.period)
            self._stack.enter_context(self._gains)
            self._base = guard_limits(self.run, self.arm, self.address)
            self.limits = limits_under(self._base, robot, None)
            virtual = self.rehearsal is not None or (isinstance(self._given, str) and is_virtual(robot))
            if self._pace is not None and virtual:
                robot = WallClock(robot, lambda: self._pace or 1.0)
        paced = None if self._pace is None else False
        return self.observer.watch(robot, twin=self.twin, within=self.settings.within, paced=paced)

    @contextmanager
    def metered(self, stage: str) -> Iterator[Robot]:
        """Robot for a ``stage`` that drives it by itself, metered."""
        with meter_of(None if self.run is None else self.run.folder, stage) as meter:
            yield meter.watch(self.robot)

    @cached_property
    def twin(self) -> Twin | None:
        """The twin of the settings or the run, as fitted."""
        if self.settings.twin is not None:
            return as_twin(self.settings.twin)
        return None if self.run is None else self.run.twin

    @property
    def twin_now(self) -> Twin | None:
        """The twin under the gains in force."""
        if self.settings.twin is not None or self.run is None:
            return self.twin
        return twin_in_force(self.run, self.robot)

    @cached_property
    def calibration(self) -> Calibration | None:
        """The calibration in use; a message says why one is not."""
        return calibration_of(self.settings.calibration, self.run, self.arm, self.address, self.observer.message)

    @cached_property
    def correction(self) -> Modelled | None:
        """Corrects where the tool is sent by the calibration."""
        return corrected_by(self.calibration, self.arm)

    @property
    def apparent(self) -> Apparent:
        """Postures of a perfect arm with the tool in the same place, by the calibration."""
        return Apparent(arm=self.arm, shift=None if self.correction is None else self.correction.shift)

    @property
    def controller(self) -> str:
        """Name of the controller that drives to points."""
        return self.driver()[0]

    def driver(self, *, posed: bool = False) -> tuple[str, Controller]:
        """Name and object of the controller to points, or to ``posed`` targets; a message says why."""
        if posed not in self._chosen:
            wanted, why = self._to_points()
            name, controller = self._made(wanted)
            if posed and not heeds_turn(controller):
                why = f"{name} does not turn the tool"
                name, controller = self._made(FeedforwardController.name)
            self.announce(name, why)
            self._chosen[posed] = name, controller
        return self._chosen[posed]

    def _to_points(self) -> tuple[ControllerLike, str]:
        asked = self.settings.controller
        return choice(self._named, self.arm, self.period) if asked is None else (asked, "as asked for")

    def _made(self, given: ControllerLike) -> tuple[str, Controller]:
        ((name, make),) = make_factories([given], self.arm, self.period, run=self.run, twin=self.twin).items()
        return name, make(self.arm)

    def announce(self, name: str, why: str) -> None:
        """Report once that the controller ``name`` drives, and why."""
        if name not in self._announced:
            self._announced.add(name)
            self.observer.message(f"Controller: {name} ({why}).")

    def instead(self, name: str, why: str) -> None:
        """Report once that ``name`` drives instead, and why."""
        best, reason = self._to_points()
        self.announce(name, f"{why}; {name_of(best)} drives to points: {reason}")

    def take_up(self, controller: Controller | None) -> None:
        """Put a controller's gains and limits in force."""
        robot = self.robot
        if controller is self._in_charge:
            return
        self._gains.close()
        self._gains.enter_context(under_gains(robot, controller))
        self.limits = limits_under(self._base, robot, controller)
        self._in_charge = controller

    def posture_controller(self, gains: PostureGains | None = None) -> PostureController:
        """Return what brings every joint to its goal, by the twin."""
        twin = self.twin_now
        self.instead(PostureController.name, f"for joint positions, {'without a' if twin is None else 'by the'} twin")
        if twin is None:
            return PostureController(self.arm, gains=gains)
        own = twin.parameters
        return PostureController(self.arm, stiffness=own.stiffness, offset=own.offset, gains=gains)

    # --- the one place where the control loop is called ---------------------------------------

    def begin(self, controller: Controller | None = None, *, rest: bool = True) -> tuple[Array, float]:
        """Look at the arm, and bring it to rest the first time.

        Return the command (1, n) [rad] in force and the usual period [s] (NaN: not known). NotReadyError if it is
        unsafe to move the arm; ContractError if ``controller`` does not suit the period.
        """
        self.take_up(controller)
        if rest and not self._rested:
            stance = stance_of(self.twin_now, self.run)
            start = self._kept(lambda see: begin(self.robot, self.limits, stance, see), take=False)
            self._usual, self._sent, self._rested = start.usual_period(), start.command[-1], True
        elif self._sent is None:
            check_ready(self.robot)
            self._sent = self.robot.read().position.copy()
        if controller is not None:
            check_controller_period(controller, self._usual)
        return self._sent, self._usual

    def drive(
        self, controller: Controller, schedule: Schedule, reference: Reference, on_cycle: OnCycle | None = None
    ) -> Recording:
        """Let ``controller`` drive from here where a ``reference`` says, by a ``schedule``.

        Every motion ends here, guarded and recorded; raises as `rejoint.control.loop.run`, with a note on the log.
        """
        self.take_up(controller)
        assert self._sent is not None  # noqa: S101 - callers have begun
        plan = replace(schedule, sent=self._sent)
        return self._kept(
            lambda see: run(self.robot, controller, reference, plan, limits=self.limits, on_cycle=see), on_cycle
        )

    def go(self, posture: Array, give_up: Callable[[ControlInput], Mask] | None = None) -> Recording:
        """Bring the arm slowly to ``posture`` (n,) [rad]."""
        return self._kept(
            lambda see: move(
                self.robot, posture, sent=self._sent, settle=0.5, limits=self.limits, give_up=give_up, on_cycle=see
            ),
            take=False,
        )

    def _kept(
        self, motion: Callable[[OnCycle], Recording], on_cycle: OnCycle | None = None, *, take: bool = True
    ) -> Recording:
        observed = self.observer.cycle if type(self.observer).cycle is not Observer.cycle else None

        def see(cycle: Cycle) -> None:
            self._last = cycle
            if take:
                self.recorder.see(cycle)
            for watch in filter(None, (on_cycle, observed, *self.watching)):
                watch(cycle)
            for ask in self.beside:
                ask()

        try:
            recording = motion(see)
        except BaseException as error:
            partial = recording_of(error)
            if partial is not None and len(partial.time):
                self._sent = partial.command[-1]
            self.recorder.rescue(error)
            raise
        self._sent = recording.command[-1]
        if take:
            self.recorder.take(recording)
        return recording

    def progress(self, share: float, what: str) -> None:
        """Hand on the progress of the motion, rate-limited."""
        self._progress(share, what)
