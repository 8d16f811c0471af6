"""What holds an arm or its simulation, drives it, and writes its logs; the only caller of the control loop."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeAlias

import numpy as np

from rejoint.arms import Arm, Array, Displacement, Motors, tcp_position
from rejoint.arms.inertia import LoadedArm
from rejoint.arms.postures import too_heavy
from rejoint.arms.workspace import length_size
from rejoint.control.controllers.catalogue import CONTROLLERS
from rejoint.control.controllers.feedforward import FeedforwardController
from rejoint.control.controllers.policy import check_controller_period
from rejoint.control.controllers.posture import PostureController, PostureGains
from rejoint.control.correction import Modelled, tool_error
from rejoint.control.guard import GuardLimits, clear_by
from rejoint.control.loop import BRAKE, Schedule, brake, run
from rejoint.control.recording import PIECE, Cycle, Observer, OnCycle, Recording, recorded, recording_of
from rejoint.control.reference import Reference
from rejoint.control.robot import (
    ControlInput,
    Controller,
    Robot,
    WallClock,
    WatchedRobot,
    heeds_turn,
    part_of,
    turned_off,
)
from rejoint.control.servogains import RIVALS, ServoGains, Tunable, gains_in_force, limits_under, under_gains
from rejoint.control.start import begin, check_ready, move
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.logs.journal import Journal
from rejoint.logs.runfolder import RunFolder
from rejoint.logs.runlog import RunLog
from rejoint.robots import is_virtual, open_robot
from rejoint.runs.run import Run, dated, exclusive, staged
from rejoint.session.context import (
    ControllerMaker,
    Factory,
    believed_motors,
    correction_of,
    guard_limits,
    heavy,
    is_own,
    noticed_load,
    quick_note,
    stance_of,
    twin_under,
    zeros_of,
)
from rejoint.session.inputs import (
    ArmLike,
    ControllerLike,
    Period,
    RobotLike,
    RunLike,
    Settings,
    address_of,
    arm_of,
    as_calibration,
    as_twin,
    each_once,
    equipped,
    opened,
    period_of,
    settled,
)
from rejoint.system.errors import FileError, InputError, NotReachedError, RejointError
from rejoint.system.files import require_space
from rejoint.system.numbers import as_seed
from rejoint.system.progress import RateLimit
from rejoint.system.records import as_options
from rejoint.system.stopping import noted
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.twin import Twin

LogKind: TypeAlias = tuple[Robot, str, str]
"""Robot, name of the file before its date, and label of a log"""


class RunRecorder:
    """Writes ``logs/NAME-DATE.parquet`` of a run, one log for motions of a kind, a new one every `PIECE`.

    FileError without disk space before the arm moves; later ``say`` reports it once.
    """

    log: RunLog | None = None
    """newest one that has ended"""
    error: RejointError | None = None
    """why a reading failed"""

    def __init__(self, run: Run | None, say: Callable[[str], object]) -> None:
        self._run, self._say = run, say
        self._kind: LogKind | None = None
        self._journal: Journal | None = None
        self._cycles: list[Cycle] = []
        self._told = False

    @property
    def seconds(self) -> float:
        """Length of what was seen [s]."""
        return float(self._cycles[-1].time[0] - self._cycles[0].time[0]) if self._cycles else 0.0

    def begin(self, robot: Robot, name: str, label: str) -> None:
        """Start or continue a log of this kind."""
        kind = (robot, name, label)
        if self._kind != kind:
            self.end()
            self._start(kind)
        elif self.seconds > PIECE:
            self.turn()

    def see(self, cycle: Cycle) -> None:
        """Take a control cycle."""
        self._cycles.append(cycle)
        if self._journal is not None:
            self._journal.see(cycle)

    def turn(self, *, keep: bool = True) -> None:
        """Write what was seen if it is worth it, and continue in a new log."""
        kind = self._kind
        try:
            self.end(keep=keep)
            if kind is not None:
                self._start(kind)
        except FileError as error:
            self._kind = kind
            if not self._told:
                self._say(f"{error}; until then the arm goes on without a log of its motion")
                self._told = True

    def end(self, *, keep: bool = True, extra: Mapping[str, str] | None = None) -> None:
        """Write what was seen; FileError where that fails."""
        journal, cycles, kind = self._ended()
        self.log = _log(kind, cycles, extra=extra) if kind is not None and cycles and keep else None
        if journal is not None and self.log is not None:
            journal.finish(self.log)
        elif journal is not None:
            journal.discard()

    def rescue(self, error: BaseException) -> None:
        """Write what was seen until ``error``; its note says where."""
        journal, cycles, kind = self._ended()
        partial = recording_of(error)
        if self._run is None or kind is None:
            return
        if journal is None:
            error.add_note("The disk had no room for what was recorded until then.")
        elif cycles:
            error.add_note(journal.rescue(_log(kind, cycles, "/stopped")))
        elif partial is not None:  # on the way to its beginning
            error.add_note(journal.rescue(partial.log(0, f"{kind[1]}/begin/stopped")))
        else:
            journal.discard()

    def _ended(self) -> tuple[Journal | None, list[Cycle], LogKind | None]:
        ended = self._journal, self._cycles, self._kind
        self._journal, self._cycles, self._kind = None, [], None
        return ended

    def _start(self, kind: LogKind) -> None:
        self._kind = kind
        if self._run is not None:
            require_space(self._run.path)  # some is left for other programs
            robot, name, label = kind
            self._journal = Journal(dated(self._run, name), robot.arm, robot.address, label)


def _log(kind: LogKind, cycles: list[Cycle], end: str = "", extra: Mapping[str, str] | None = None) -> RunLog:
    """Log of what was seen; before the first command the positions count as commands, if any came."""
    robot, _, label = kind
    _, controller, *_ = (*label.split("/"), label)
    found = recorded(robot, controller, cycles, np.zeros(1, dtype=np.uint16))
    sent = np.isfinite(found.command)
    if sent.any():
        found = replace(found, command=np.where(sent, found.command, found.position))
    return found.log(0, label + end, extra)


PERIOD = (0.02, 0.03)
"""[s] default control periods (chosen)"""


@contextmanager
def copied(run: Run) -> Iterator[Run]:
    """Return a temporary copy of a run."""
    with TemporaryDirectory(prefix="rejoint-dry-run-") as folder:
        if run.path.is_dir():
            left_out = shutil.ignore_patterns(".lock", "pictures", "training", "figures")
            shutil.copytree(run.path, folder, ignore=left_out, dirs_exist_ok=True)
        yield replace(run, folder=RunFolder(Path(folder)))


class RehearsedRobot(WatchedRobot):
    """Simulates a robot at its present posture; with nominal servos without a twin."""

    def __init__(
        self, robot: Robot, twin: Twin | None, period: Period | None, calibration: Calibration | None = None
    ) -> None:
        """NotReadyError where the arm would not be moved either."""
        from rejoint.twin.simulation import Draw, TwinRobot

        check_ready(robot)
        arm, start = robot.arm, robot.read().position[0]
        own, limit = (nominal_parameters(arm), np.inf) if twin is None else (twin.parameters, twin.acceleration)
        low, high = period or PERIOD
        draw = replace(Draw.of(own.repeat(1), limit), period=np.array([(low + high) / 2]))
        jitter = (high - low) / (high + low)
        own_address = f"simulation of {robot.address}"  # it is no run's own: its friction is not the measured one
        simulated = TwinRobot(arm, draw, seed=0, jitter=jitter, posture=start, address=own_address)
        super().__init__(simulated, lambda state, _: self._positions.append(state.position[0].copy()))
        self._calibration, self._positions = calibration, [start.copy()]
        servos = part_of(robot, Tunable)
        self._gains, self.rungs = (None, tuple) if servos is None else (servos.servo_gains(), servos.rungs)

    def true_tcp(self) -> Array:
        """(1, 3) [m] by the calibration, if there is one."""
        return super().true_tcp() if self._calibration is None else self._calibration.tool(self.read().position)

    def servo_gains(self) -> ServoGains | None:
        """Gains that the arm has, or would have; the simulation ignores them."""
        return self._gains

    def tune(self, gains: ServoGains) -> None:
        """Take ``gains``; the arm keeps its own."""
        self._gains = dict(gains)

    keep = tune

    def summary(self) -> str:
        """Say how far, how long and how close to limits it moved."""
        arm, way = self.arm, np.array(self._positions)
        tool = np.linalg.norm(np.diff(tcp_position(arm, way), axis=0), axis=-1).sum()
        turned = np.abs(np.diff(way, axis=0)).sum(axis=0)
        most = turned.argmax()
        spare = np.minimum(way - arm.lower, arm.upper - way).min(axis=0)
        near = spare.argmin()
        return (
            f"Dry run, nothing moved. The arm would move for {self.read().time[0]:.0f} s: the tool by "
            f"{1e3 * tool:.0f} mm, joints by up to {np.degrees(turned[most]):.0f} deg ({arm.joint_names[most]}). "
            f"Closest to a limit: {arm.joint_names[near]}, {np.degrees(spare[near]):.0f} deg; to a contact: "
            f"{1e3 * clear_by(GuardLimits.of(arm), way).min():.0f} mm."
        )


CALM = 0.3
"""[s] at the goal (chosen)"""
RESTS, JITTER = 0.8, np.radians(0.3)
"""[s] from the last new joint goal to rest, and [rad] jitter of a resting hand (chosen)"""

FAR = 0.005
"""[m] of a tool that something keeps from its goal, for a myCobot 280; chosen"""


class ArmMotion(Future[Any]):
    """What ``work`` finds by driving, or what ended it early; `ended` asks it to end."""

    def __init__(self, goal: str, work: Callable[[ArmMotion], object]) -> None:
        super().__init__()
        self._work, self.ended, self.thread = work, threading.Event(), 0
        self.goal = goal
        """where the arm is on its way to, in words"""

    def run(self) -> None:
        """Drive until the end."""
        self.thread = threading.get_ident()
        try:
            self.set_result(self._work(self))
        except BaseException as error:  # noqa: BLE001 - raised again where a caller waits
            self.set_exception(error)

    def give_up(self, _: ControlInput) -> bool:
        """Tell the control loop whether to end, see `rejoint.control.loop.Schedule`."""
        return self.ended.is_set()


class GoalStream(Reference):
    """Goes to the newest joint goal at full speed; rests after `RESTS` without a new one.

    Goals are those of a perfect arm.
    """

    def __init__(self, apparent: Modelled, position: Array) -> None:
        """Begin at ``position`` (n,) [rad]."""
        self.apparent = apparent
        self.goal: Array | None = None
        """(n,) [rad]; None: stay"""
        self.reached: Array | None = None
        """the last goal at which it rested"""
        self._mean, self._posture = np.full_like(position, np.nan), position
        self._time, self._changed = np.inf, -np.inf

    def advance(self, now: ControlInput) -> ControlInput:
        """Return where the arm is to be: at first, where it is."""
        time, goal = float(now.state.time[0]), self.goal
        elapsed, self._time = max(time - self._time, 0.0), time
        rested = time - self._changed > RESTS
        if goal is None:
            return replace(now, goal=self._posture[None])
        if not np.abs(goal - self._mean).max() < JITTER:
            self._mean, self._changed, rested = goal, time, False
        # The mean over all the rest: one that goes on wandering with the hand moves joints that stick.
        self._mean = self._mean + elapsed / (time - self._changed + RESTS) * (goal - self._mean)
        aim = self.apparent.measured(self._mean if rested else goal)
        reach = self.apparent.arm.max_speed * elapsed
        self._posture = self._posture + np.clip(aim - self._posture, -reach, reach)
        arrived = rested and (self._posture == aim).all()
        if arrived:
            self.reached = goal
        return replace(now, goal=self._posture[None], arrived=np.array([arrived]))


NAMED = 5
"""Targets that a line names at most (chosen)"""
SURE = 3.0
"""Standard errors from which a load counts as noticed (chosen)"""


class ArmDriver:
    """An arm with everything that drives it; a session adds the motions."""

    usual = np.nan
    """[s] usual control period, after the first motion"""
    heard = np.inf
    """[s] monotonic time of the newest cycle"""
    limits: GuardLimits | None = None
    """of the guard; None before the robot is open"""
    rehearsal: RehearsedRobot | None = None
    """in a dry run"""
    _base: GuardLimits | None = None  # under the gains that the robot had when it was opened
    _in_charge: Controller | None = None
    _last: Cycle | None = None
    _sent: Array | None = None  # (1, n) [rad]; None: nothing yet
    _rested = False

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
        about, self.observer = None if run is None else opened(run, arm), as_options(observer, Observer)
        self.settings, kept = settled(settings, about, robot)
        for line in filter(None, (quick_note(about), kept)):
            self.observer.message(line)
        about = about and about.seeded(self.settings.seed)
        built = arm_of(robot, arm if about is None else about.arm)
        if about is not None:
            about.require(built)
            built = replace(built, keep_out=each_once(*built.keep_out, *about.arm.keep_out))
        self.arm: Arm = equipped(built, robot, self.settings)
        """with payload and tool of the settings"""
        self.seed = as_seed(self.settings.seed) if about is None else about.seed
        self.address = "" if robot is None else address_of(robot)
        self.period = None if robot is None else period_of(robot, self.settings.period)
        """[s] interval of control periods; None: the open robot knows"""
        self.watching: list[OnCycle] = []
        """called with every cycle, and with every reading between motions"""
        self.given, self._pace = robot, pace
        """the robot or its address, as the user gave it"""
        self._stack, self._gains = ExitStack(), ExitStack()
        self._stack.enter_context(exclusive(None if self.settings.dry_run else about))
        self._named = about  # as the user knows it, also where a copy is worked on
        self.run = about if about is None or not self.settings.dry_run else self._stack.enter_context(copied(about))
        """a copy in a dry run; None: nothing is written"""
        self.recorder = RunRecorder(self.run, self.observer.message)
        self._stack.callback(self.recorder.end)
        self._chosen: dict[bool, tuple[str, Controller]] = {}
        self._announced = set[str]()
        self.progress = RateLimit(self.observer.progress)
        """receives the progress of the motion"""
        self._asking = threading.RLock()  # of threads that ask the arm or begin a motion

    @cached_property
    def robot(self) -> Robot:
        """The open robot."""
        robot = self.given
        if robot is None:
            raise InputError("session: there is no robot to drive")
        virtual = is_virtual(robot)
        if self.run is not None:
            require_space(self.run.path)
        with noted():
            if isinstance(robot, str):
                robot = open_robot(robot, arm=self.arm, seed=self.seed, period=self.period)
                self._stack.callback(robot.close)
            if robot.count != 1:
                raise InputError(f"a session drives one arm, {robot.address} has {robot.count}")
            if self.settings.dry_run:
                robot = self.rehearsal = RehearsedRobot(robot, self.twin, self.period, self.calibration)
            self._stack.enter_context(self._gains)
            self._base = guard_limits(self.run, self.arm, robot.address)
            self.limits = limits_under(self._base, robot, None)
            pace = self._pace
            if pace is not None and (self.rehearsal is not None or virtual):
                robot = WallClock(robot, lambda: pace)
            return self.observer.watch(robot, twin=self.twin, within=self.settings.within, paced=pace is None)

    @contextmanager
    def metered(self, stage: str) -> Iterator[Robot]:
        """Robot for a ``stage`` that drives it by itself; see `staged`."""
        with staged(self.run, stage) as watch:
            yield watch(self.robot)

    @cached_property
    def twin(self) -> Twin | None:
        """The twin of the settings or the run, as fitted; ContractError for another arm's."""
        if self.settings.twin is not None:
            return as_twin(self.settings.twin, self.arm)
        return self.run.twin if self.run else None

    @property
    def twin_now(self) -> Twin | None:
        """The twin under the gains in force."""
        diagnosis = None if self.settings.twin is not None or self.run is None else self.run.diagnosis
        if self.twin is None or diagnosis is None:
            return self.twin
        return twin_under(self.twin, diagnosis.servo_gains, gains_in_force(self.robot))

    @cached_property
    def calibration(self) -> Calibration | None:
        """The calibration of the settings, or that of the run for its own robot, where it helps.

        A message says why one is not in use. ContractError for another arm's.
        """
        given, run = self.settings.calibration, self.run
        found = as_calibration(given, run, self.arm)
        if found is None:
            return None
        why = "" if found.used else "it did not clearly help"
        if given is None and found.zeros != zeros_of(self.address):
            why = "the zeros of the joints are others than then; calibrate again"
        if given is None and run is not None and not is_own(run, self.address):
            why = f"it is not of {self.address}"
        if not why:
            return found
        known = self._named.folder.calibration if self._named else "the calibration"
        name = given if isinstance(given, str | Path) else known
        self.observer.message(f"Not corrected: {name} is not applied; {why}.")
        return None

    @cached_property
    def correction(self) -> Modelled | None:
        """Corrects where the tool is sent by the calibration."""
        return correction_of(self.calibration, self.arm)

    @property
    def apparent(self) -> Modelled:
        """Shows postures of a perfect arm with the tool in the same place; without a calibration, the arm's own."""
        return self.correction or Modelled(self.arm, Displacement.none(self.arm))

    @property
    def controller(self) -> str:
        """Name of the controller that drives to points."""
        return self.driver()[0]

    def driver(self, *, posed: bool = False) -> tuple[str, Controller]:
        """Name and object of the controller to points, or to ``posed`` targets; a message says why."""
        if posed not in self._chosen:
            asked, own = self.settings.controller, ControllerMaker(self.arm, self.period, self._named)
            wanted, why = own.choice() if asked is None else (asked, "as asked for")
            if asked is None and wanted not in (*CONTROLLERS, *RIVALS):
                wanted, why = own.fallback(f"recommends {wanted}, which only a program has")
            name, make = self.maker(wanted, self.twin)
            if posed and not heeds_turn(make(self.arm)):
                why = f"{name} does not turn the tool"
                name, make = self.maker(FeedforwardController.name, self.twin)
            controller = make(self.arm)
            self.announce(name, why)
            self._chosen[posed] = name, controller
        return self._chosen[posed]

    def maker(self, given: ControllerLike, twin: Twin | None, *, posed: bool = False) -> tuple[str, Factory]:
        """Return the name of a controller, and what makes it; refuses what does not fit."""
        (made,) = ControllerMaker(self.arm, self.period, self.run, twin).factories([given], posed=posed).items()
        return made

    def announce(self, name: str, why: str) -> None:
        """Report once that the controller ``name`` drives, and why."""
        if name not in self._announced:
            self._announced.add(name)
            self.observer.message(f"Controller: {name} ({why}).")

    def take_up(self, controller: Controller | None) -> None:
        """Put a controller's gains and limits in force."""
        robot = self.robot
        if controller is not self._in_charge:
            self._gains.close()
            self._gains.enter_context(under_gains(robot, controller))
            self.limits, self._in_charge = limits_under(self._base, robot, controller), controller

    @property
    def motors(self) -> Motors | None:
        """What the motors hold and lift, by the twin under the gains in force; None without one."""
        twin = self.twin_now
        return None if twin is None else believed_motors(self.arm, twin)

    def say_heavy(self, places: Iterable[str], postures: Array, motors: Motors | None) -> None:
        """Report K ``places`` whose ``postures`` (K, n) [rad] the ``motors`` may not lift."""
        if motors is None:
            return
        judged = zip(places, heavy(self.arm, postures, motors), strict=True)
        if found := [f"{place}: {why}" for place, why in judged if why]:
            more = f", and {len(found) - NAMED} more" if len(found) > NAMED else ""
            self.observer.message(
                f"Too heavy by the twin: {'; '.join(found[:NAMED])}{more}. The arm tries, but may not arrive, or not "
                "leave again."
            )

    def overloaded(self, posture: Array) -> str:
        """Say which motor perhaps does not lift the arm from ``posture`` (n,) [rad]; empty: each does."""
        joint, why = too_heavy(self.arm, posture, self.motors.usable) if self.motors else (None, "")
        return "" if joint is None else f"the load may be too heavy there: {why}"

    def say_noticed(self, log: RunLog | None) -> None:
        """Report an unexpected load that the sag of a ``log`` shows."""
        twin = self.twin_now
        found = None if twin is None or log is None else noticed_load(self.arm, twin, log)
        if found is None or not found[0] > SURE * found[1]:
            return
        more = " more than was told" if isinstance(self.arm, LoadedArm) else ""
        self.observer.message(
            f"The joints sag as if the hand carried about {1e3 * found[0]:.0f} g{more}: tell it with --payload, or "
            "identify again if the arm itself has changed."
        )

    def posture_controller(self, gains: PostureGains | None = None) -> PostureController:
        """Return what brings every joint to its goal, by the twin."""
        twin = self.twin_now
        self.announce(PostureController.name, f"for joint positions, {'without a' if twin is None else 'by the'} twin")
        return PostureController(self.arm, None if twin is None else twin.parameters, gains)

    # --- the one place where the control loop is called ---------------------------------------

    def begin(self, motion: str, by: str, controller: Controller | None = None, *, rest: bool = True) -> None:
        """Look at the arm, and bring it to rest the first time; record a ``motion`` of this name ``by`` a controller.

        NotReadyError if it is unsafe to move the arm.
        """
        if not rest and self._sent is None:
            check_ready(self.robot)
        self.recorder.begin(self.robot, motion, f"{motion}/{by}")
        self.take_up(controller)
        if rest and not self._rested:
            stance = stance_of(self.twin_now, self.run)
            start = self._seen_through(lambda see: begin(self.robot, self.limits, stance, see))
            self.usual, self._rested = start.usual_period(), True

    def drive(self, controller: Controller, schedule: Schedule, reference: Reference, *watches: OnCycle) -> Recording:
        """Let ``controller`` drive from here where a ``reference`` says, by a ``schedule``.

        Every motion ends here, guarded and recorded; raises as `rejoint.control.loop.run`, with a note on the log.
        ContractError if ``controller`` does not suit the period.
        """
        check_controller_period(controller, self.usual)
        self.take_up(controller)
        plan = replace(schedule, sent=self._sent)
        return self._seen_through(
            lambda see: run(self.robot, controller, reference, plan, limits=self.limits, on_cycle=see),
            self.recorder.see,
            *watches,
        )

    def arrive(
        self,
        motion: ArmMotion,
        controller: Controller,
        reference: Reference,
        timeout: float,
        wanted: str,
        within: tuple[float, float],
        joints: Array | None = None,
    ) -> None:
        """Drive until the encoders stay at the goal for `CALM`; NotReachedError after ``timeout`` [s].

        ``within`` [m] and [rad] of the tool, or the latter of each of the ``joints`` (n,) [rad]; in words ``wanted``.
        """
        arm, here, left, lags = self.arm, self.arm.rest, "", ""
        since, reached, far = np.inf, False, False  # [s] close since then

        def look(inputs: ControlInput) -> bool:
            nonlocal since, reached, far, left, lags, here
            now, here = float(inputs.state.time[0]), inputs.state.position[0]
            away = np.abs(here - (inputs.sent[0] if joints is None else joints))
            worst = away.argmax()
            lags = f"{arm.joint_names[worst]} is {np.degrees(away[worst]):.1f} deg from where it was sent"
            if joints is None:
                aim = inputs.target if inputs.aim is None else inputs.aim  # the target moves along the way
                error = tool_error(arm, here, aim[0])
                turned = turned_off(arm, inputs)[0]
                near = inputs.arrived[0] and error < within[0] and not turned > within[1]
                far = bool(error > FAR * length_size(arm))
                left = f"{1e3 * error:.1f} mm" + (f" and {np.degrees(turned):.1f} deg" if np.isfinite(turned) else "")
            else:
                near, far = away[worst] < within[1], bool(away[worst] > BRAKE)
                left = f"{np.degrees(away[worst]):.1f} deg at {arm.joint_names[worst]}"
            since = min(since, now) if near else np.inf
            reached = now - since >= CALM
            return motion.give_up(inputs) or reached

        self.drive(controller, Schedule(dwell=timeout, give_up=look), reference)
        if not (reached or motion.ended.is_set()):
            if far:  # what is in the way, or weighs too much, bears no full torque for long
                self.brake()
            heavy_there = self.overloaded(here)
            raise NotReachedError(
                f"the arm did not come within {wanted} of {motion.goal}, still {left} off; it holds. {lags}. Give it "
                f"more time or room, or look whether something is in its way{heavy_there and f'; {heavy_there}'}"
            )

    def brake(self) -> None:
        """Let the arm rest about where it is."""

        def see(braking: Cycle) -> None:
            with suppress(Exception):  # the arm holds, whatever an observer makes of it
                self._see(braking, self.recorder.see)

        if self._last is not None:
            brake(self.robot, self._last, see)

    def go(self, posture: Array, give_up: Callable[[ControlInput], bool]) -> None:
        """Bring the arm slowly to ``posture`` (n,) [rad]."""
        self._seen_through(
            lambda see: move(
                self.robot, posture, settle=0.5, on_cycle=see, sent=self._sent, limits=self.limits, give_up=give_up
            )
        )

    def _see(self, cycle: Cycle, *watches: OnCycle) -> None:
        self._last, self._sent, self.heard = cycle, cycle.command, time.monotonic()
        for watch in (*watches, self.observer.cycle, *self.watching):
            watch(cycle)

    def _seen_through(self, motion: Callable[[OnCycle], Recording], *watches: OnCycle) -> Recording:
        """Do a motion that observers see."""
        try:
            return motion(lambda cycle: self._see(cycle, *watches))
        except BaseException as error:
            self.recorder.rescue(error)
            raise
