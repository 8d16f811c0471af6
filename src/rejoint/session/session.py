"""The session: a program drives an arm, one motion at a time."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent import futures
from contextlib import contextmanager
from math import radians
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Array, JointTrajectory, Motors, choose_postures, plan
from rejoint.arms.rotations import Orientation
from rejoint.control.controllers.posture import OFF, PlannedWay, PostureController, PostureGains, Unloading
from rejoint.control.correction import tool_error
from rejoint.control.guard import GuardLimits, clear_by
from rejoint.control.loop import Schedule
from rejoint.control.recording import PIECE, Cycle, Observer, cycle_at_rest, recording_of
from rejoint.control.reference import Reference, TargetSequence, with_ways
from rejoint.control.targets import Pose, in_mm, placed
from rejoint.robots import is_virtual
from rejoint.session.driver import ArmDriver, ArmMotion, GoalStream, RunRecorder
from rejoint.system.errors import InputError, NotReachedError, NotReadyError, RejointError
from rejoint.system.numbers import as_floats, as_place, as_positive, as_seconds, as_within
from rejoint.system.progress import RateLimit
from rejoint.system.records import Readable, entity
from rejoint.system.stopping import noted, pause

if TYPE_CHECKING:
    from rejoint.control.moving.drive import Deployed, Followed
    from rejoint.control.moving.reference import Stream
    from rejoint.logs.runlog import RunLog
    from rejoint.session.inputs import ArmLike, RobotLike, RunLike, Settings, Targets
    from rejoint.session.motions import PathLike

WITHIN, WITHIN_TURN = 0.002, radians(1.0)
"""[m] and [rad] within which poses are reached (chosen)"""
WITHIN_JOINT = radians(0.5)
"""[rad] within which joint positions are reached (chosen)"""
EVERY_JOINT = PostureGains(weak=np.inf, close=1e-4, lead=radians(19.5))
"""Joint positions without a place: every joint is brought close (measured)"""
HALF_TURN = np.pi
"""[rad] beyond the limits, from which a joint position is not in radians; chosen: no leader's joints turn so far"""
ANGLE = "a positive angle in radians"
STARTING = 5.0
"""[s] for the first cycle of a stream (chosen)"""
EVERY = 0.02
"""[s] between readings of an arm that is recorded and not driven (chosen)"""
_LOOK = 0.01  # [s] between two looks at whether a motion has ended (chosen)
_SHARES = np.linspace(0.0, 1.0, 65)[:, None]  # of a way back from joint positions


@entity
class ArmState(Readable):
    """What is known of an arm at a moment."""

    time_s: float
    """on the robot's clock"""
    joints_rad: Array
    """(n,) measured"""
    tool_m: Array
    """(3,) tool centre point: by the calibration, else by the encoders"""
    moving: bool
    """whether a motion is under way; a stream: until it rests"""
    target_m: Array | None
    """(3,) last target; None before the first cycle"""
    error_m: float | None
    """of the tool from where it was sent, by the encoders"""
    turned_rad: float | None
    """orientation error by the encoders; None for points"""


class Session(ArmDriver):
    """An arm and everything that drives it, one motion at a time and always guarded.

    Before the first target or path, the arm goes slowly to its rest posture. Between motions it holds. Use it in a
    ``with`` block.

    Examples
    --------
    >>> with rejoint.connect("tcp://192.168.1.20:9000", run="runs/mine") as arm:
    ...     arm.move_to([0.2, 0.05, 0.18])
    ...     arm.move_joints(arm.state.joints_rad + 0.1)
    ...     print(arm.follow("drawing.csv").passes[-1].encoder.rms)
    """

    followed: Followed | None = None
    """of the last path"""
    _motion: ArmMotion | None = None
    _goals: GoalStream | None = None
    _seen: Cycle | None = None
    _closed = False

    @property
    def _moving(self) -> bool:
        return self._motion is not None and not self._motion.done()

    @property
    def _rests(self) -> bool:
        return self._goals is not None and self._goals.reached is self._goals.goal

    # --- motions ------------------------------------------------------------------------------

    def move_to(
        self,
        target_m: ArrayLike | Pose,
        *,
        within_m: float | None = None,
        within_rad: float = WITHIN_TURN,
        timeout_s: float = 10.0,
        wait: bool = True,
    ) -> ArmState | None:
        """Bring the tool to ``target_m`` (3,) [m] in the base frame, or to a `Pose`.

        It is reached once the tool stays ``within_m`` (default: the settings', else 2 mm) of its corrected target and
        ``within_rad`` of its orientation, by the encoders. With ``wait`` return the last state, else None at once; the
        next order or `close` raises what ended the motion.

        InputError for a target out of reach; NotReadyError during a motion; NotReachedError after ``timeout_s``;
        GuardTripError or RobotError. The arm then holds.
        """
        target, turns = as_place("move_to", target_m.place_m if isinstance(target_m, Pose) else target_m), None
        within = as_within("move_to", (self.settings.within or WITHIN) if within_m is None else within_m)
        wanted, within_rad = f"{1e3 * within:.3g} mm", as_positive("move_to", within_rad, ANGLE)
        if isinstance(target_m, Pose):
            turns = placed(self.arm, [target_m])[1]
            wanted += f" and {np.degrees(within_rad):.3g} deg"
        timeout = as_seconds("move_to", timeout_s)
        self._require_free()
        ways = self.ways(target[None], turns)
        reference = TargetSequence(
            self.arm, target[None, None], ways=[ways], turns=turns and turns[None], correction=self.correction
        )
        name, controller = self.driver(posed=turns is not None)

        def work(motion: ArmMotion) -> None:
            self.begin("move", name, controller)
            self.arrive(motion, controller, reference, timeout, wanted, (within, within_rad))

        return self._start(ArmMotion(in_mm(target), work), wait=wait)

    def ways(
        self, targets: Array, turns: Orientation | None = None, motors: Motors | None = None
    ) -> tuple[JointTrajectory, ...]:
        """Choose postures for ``targets`` (K, 3) [m], turned so (K,), and plan the ways; InputError if impossible.

        ``motors`` are by default those of now, for which the robot is opened.
        """
        motors, start = motors or self.motors, self.state.joints_rad if self._rested else self.arm.rest
        found = choose_postures(self.arm, targets, start, turn=turns, motors=motors, chained=True)
        for k, why in enumerate(found.refusals):
            if why:
                number = f" {k + 1}" if len(targets) > 1 else ""
                raise InputError(f"target{number} {in_mm(targets[k])}: {why}")
        here = "where the arm is now" if self._rested else "the rest posture"
        self.say_heavy([here, *map(in_mm, targets)], np.vstack([start, found.q]), motors)
        return with_ways(self.arm, found.q, start, motors=motors)

    def move_joints(
        self, joints_rad: ArrayLike, *, within_rad: float = WITHIN_JOINT, timeout_s: float = 10.0, wait: bool = True
    ) -> ArmState | None:
        """Bring the joints to ``joints_rad`` (n,) [rad] by the encoders, on a planned way; else as `move_to`.

        InputError for a wrong number, degrees, limits, floor, contacts, or no way.
        """
        goal = self._joints("move_joints", joints_rad)
        beyond = np.maximum(self.arm.lower - goal, goal - self.arm.upper)
        if beyond.max() > 0.0:
            j = beyond.argmax()
            raise InputError(
                f"move_joints: {self.arm.joint_names[j]} at {np.degrees(goal[j]):.0f} deg is outside its limits of "
                f"{np.degrees(self.arm.lower[j]):.0f} to {np.degrees(self.arm.upper[j]):.0f} deg"
            )
        within, timeout = as_positive("move_joints", within_rad, ANGLE), as_seconds("move_joints", timeout_s)
        self._require_free()
        self.look()
        if not self._clear(goal):
            raise InputError("move_joints: there the arm would touch itself, the ground or a box; choose other ones")

        way = plan(self.arm, self.state.joints_rad, goal, motors=self.motors)

        def work(motion: ArmMotion) -> None:
            controller, unloaded = self._joint_drive(PlannedWay(self.arm, way), min(within, OFF))
            wanted = f"{np.degrees(within):.3g} deg"
            self.arrive(motion, controller, unloaded, timeout, wanted, (np.inf, within), goal)

        return self._start(ArmMotion("its joint positions", work), wait=wait)

    def _joint_drive(self, way: Reference, off: float = OFF) -> tuple[PostureController, Unloading]:
        """Return what brings every joint where a way says, over other postures where one stays ``off`` [rad]."""
        self.begin("joints", PostureController.name, rest=False)
        unloading = Unloading(self.arm, self.motors, off, self.observer.message, way)
        return self.posture_controller(EVERY_JOINT), unloading

    def send_joints(self, joints_rad: ArrayLike) -> Array:
        """Send joint positions (n,) [rad] of a stream; return what the limits and contacts leave of them (n,).

        With a calibration they are those of a perfect arm: the tool goes where its tool would be. The arm follows in
        its own thread, and rests where the stream stops. InputError for a wrong number, or degrees.
        """
        goal = np.clip(self._joints("send_joints", joints_rad), self.arm.lower, self.arm.upper)
        with self._asking:
            goals = self._stream()
            last = goals.goal if goals.goal is not None else self.shown_joints()
            way = goal + _SHARES * (last - goal)
            goals.goal = goal = next((one for one in way if self._clear(goals.apparent.measured(one))), last)
            return goal.copy()

    def shown_joints(self) -> Array:
        """Joint positions (n,) [rad] as in `send_joints`: of a perfect arm with its tool where this one's is.

        Without a calibration they are the measured ones.
        """
        return (self._goals or self).apparent.shown(self.state.joints_rad)

    def hold(self) -> None:
        """Hold the arm until the next order; raises what ended the hold."""
        with self._asking:
            self._stream()

    def _stream(self) -> GoalStream:
        self._require_open()
        if self._goals is not None and self._moving:
            return self._goals
        self._require_free()
        goals = GoalStream(self.apparent, self.robot.read().position[0].copy())

        def work(motion: ArmMotion) -> None:
            controller, unloaded = self._joint_drive(goals)
            while not motion.ended.is_set():
                self.drive(controller, Schedule(dwell=PIECE, give_up=motion.give_up), unloaded)
                if not motion.ended.is_set():  # else the braking command is the last row
                    self.recorder.turn()

        motion = ArmMotion("the newest joint positions", work)
        self._start(motion, wait=False)
        self._goals = goals
        for _ in range(round(STARTING / _LOOK)):
            if self._last is not None or futures.wait([motion], _LOOK).done:
                break
        if not self._moving:
            self._tell_last()
        return goals

    def _joints(self, who: str, given: ArrayLike) -> Array:
        """Return joint positions (n,) [rad]; InputError for what are none."""
        goal = as_floats(who, given, f"{self.arm.joints} joint positions in radians")
        if goal.shape != (self.arm.joints,) or not np.isfinite(goal).all():
            raise InputError(f"{who}: expected {self.arm.joints} joint positions in radians, got {given!r}")
        if np.maximum(self.arm.lower - goal, goal - self.arm.upper).max() > HALF_TURN:
            raise InputError(f"{who}: joint positions {given!r} are far beyond the limits; give radians")
        return goal

    def _clear(self, posture: Array) -> bool:
        """Whether the guard lets the arm go to ``posture`` (n,) [rad]."""
        return bool((clear_by(self.limits or GuardLimits.of(self.arm), posture) >= 0.0).all())

    def follow(
        self,
        path: PathLike | Stream,
        *,
        repeat: int = 1,
        duration_s: float | None = None,
        within_m: float | None = None,
        wait: bool = True,
    ) -> Followed | None:
        """Drive the tool along ``path``; ``repeat`` as in `rejoint.follow`, ``wait`` as in `move_to`.

        A `Stream` needs ``duration_s`` and a first target. NotReachedError after `stop`, or away from the start.
        InputError for a path out of reach or too fast, or without a twin.
        """
        from rejoint.session.motions import along

        self._require_free()
        work = along(self, path, repeat=repeat, duration=duration_s, within=within_m)
        self.followed = None
        self._start(ArmMotion("the end of its path", work), wait=wait)
        if wait and self.followed is None:
            raise NotReachedError("the path was ended before its end; the arm holds")
        return self.followed if wait else None

    def deploy(self, targets: Targets | None = None) -> Deployed:
        """Drive to targets in turn; see `rejoint.deploy`."""
        from rejoint.session.motions import to_targets

        self._require_free()
        motion = ArmMotion("its targets", to_targets(self, targets))
        self._start(motion, wait=True)
        return motion.result()

    # --- what looks at motions and ends them ----------------------------------------------------

    @property
    def state(self) -> ArmState:
        """State of the last cycle of a motion, else read now."""
        return self.look()

    def look(self) -> ArmState:
        """Ask the arm, unless a motion does; all that watch see the reading."""
        with self._asking:
            self._require_open()
            moving = self._moving
            if not moving or self._seen is None:  # else the robot is the motion's to ask
                self._seen = cycle_at_rest(self.robot.read(), self.robot.true_tcp(), self._sent)
                for see in self.watching:
                    see(self._seen)
            sent = self._last or self._seen  # of a reading at rest, target and errors are unknown
            newest = sent if moving else self._seen
            joints, turned = newest.position[0], float(sent.turned[0])
            error = float(tool_error(self.arm, joints, sent.aim[0]))
            return ArmState(
                time_s=float(newest.time[0]),
                joints_rad=joints.copy(),
                tool_m=self.apparent.tool(joints),
                moving=moving and not self._rests,
                target_m=sent.target[0].copy() if np.isfinite(error) else None,
                error_m=error if np.isfinite(error) else None,
                turned_rad=turned if np.isfinite(turned) else None,
            )

    @contextmanager
    def recording(self, name: str = "record") -> Iterator[RunRecorder]:
        """Record in a ``with`` block what the arm does, by any controller or program.

        Afterwards ``log`` of what is yielded is a `RunLog`; with a run also ``logs/NAME-DATE.parquet``.
        """
        self._require_open()
        recorder, over = RunRecorder(self.run, self.observer.message), threading.Event()

        def look() -> None:
            try:
                while not over.wait(EVERY):
                    self.look()
            except RejointError as error:
                recorder.error = error

        recorder.begin(self.robot, name, name)
        self.watching.append(recorder.see)
        looking = threading.Thread(target=look, name=name, daemon=True)
        try:
            self.look()
            looking.start()
            yield recorder
        finally:
            over.set()
            if looking.ident is not None:
                looking.join()
            self.watching.remove(recorder.see)
            recorder.end()
        if recorder.error is not None:
            raise recorder.error

    def record(self, duration_s: float, *, name: str = "record") -> RunLog:
        """Record for ``duration_s`` on the robot's clock, as `recording`; without a motion an emulated arm holds."""
        seconds = as_seconds("record", duration_s)
        with noted(), self.recording(name) as recorder:
            virtual, held = self.rehearsal is not None or is_virtual(self.address), False
            while recorder.seconds < seconds and recorder.error is None:
                held = held or (virtual and not self._moving)
                if held:  # its time passes only in motions
                    self.hold()
                pause(_LOOK)
            if held:
                self.stop()
        assert recorder.log is not None  # noqa: S101 - for the type checker; the block is over
        return recorder.log

    def wait(self, timeout_s: float | None = None) -> ArmState:
        """Wait for the end of the motion, or for a stream to rest, and return the state; raises what ended it.

        NotReachedError after ``timeout_s``; the motion goes on. Ctrl-C stops the arm.
        """
        motion, waited = self._motion, 0.0
        if motion is None:
            return self.state
        try:
            with noted():
                while not motion.done() and (timeout_s is None or waited < timeout_s):
                    if self._rests:
                        return self.state
                    pause(_LOOK)
                    waited += _LOOK
        except BaseException:  # Ctrl-C, or what the program's own handler of a signal raises
            self.stop()
            raise
        if not motion.done():
            raise NotReachedError(f"the arm is still on its way to {motion.goal} after {timeout_s} s of waiting")
        self._tell_last()
        return self.state

    def stop(self) -> None:
        """End the motion; the arm holds."""
        motion = self._motion
        if motion is not None:
            motion.ended.set()  # at once: who asks the arm may have to wait for its answer
            if motion.thread == threading.get_ident() and not motion.done():
                return  # an observer of the motion, which ends after this cycle
        with self._asking:
            motion, self._motion = self._motion, None
            if self._closed and motion is None:
                return
            if motion is not None:
                motion.ended.set()
                motion.exception()  # when it is over
            self._goals = None
            self.robot.stop()
            if motion is not None:
                self.brake()

    def close(self) -> None:
        """End the motion, keep the log and release the arm, which holds; raises what ended the last motion."""
        self.__exit__(None, None, None)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        motion = self._motion
        if motion is not None:
            motion.ended.set()
        with self._asking:
            if self._closed:
                return
            self._closed = True
            try:
                if self._motion is not None:
                    self.stop()
                if self.rehearsal is not None and (error is None or recording_of(error) is not None):
                    self.observer.message(self.rehearsal.summary())
                    if error is not None:  # a forecast, no order to the arm
                        error.__notes__ = ["So it would end in the simulation. Nothing moved or was recorded."]
            finally:
                self._stack.__exit__(kind, error, trace)
        if error is None and motion is not None:
            motion.result()

    def _require_open(self) -> None:
        if self._closed:
            raise NotReadyError("the arm is closed, and others may drive it; call rejoint.connect again")

    def _require_free(self) -> None:
        self._require_open()
        if self._goals is not None and self._moving:
            self.stop()  # a stream of joint positions gives way to any other motion
        if self._moving:
            raise NotReadyError("the arm is still on its way; wait() for it, or stop() it first")
        self._tell_last()

    def _tell_last(self) -> None:
        motion, self._motion = self._motion, None
        if motion is not None:
            motion.result()

    def _start(self, motion: ArmMotion, *, wait: bool) -> ArmState | None:
        with self._asking:  # two threads may have looked before either started
            self._require_free()
            self.robot  # noqa: B018 - opened by this thread, so that errors are raised here
            last, self._last = self._last, None  # its target is not where the arm is sent now
            if last is not None and (self._seen is None or last.time[0] > self._seen.time[0]):
                self._seen = last
            self._motion, self._goals, self.progress = motion, None, RateLimit(self.observer.progress)
            if not wait:
                threading.Thread(target=motion.run, name="motion", daemon=True).start()
                return None
        with noted():
            motion.run()
            self._motion = None  # else an interruption at the end would leave it for the next motion to raise
        motion.result()
        return self.state


def connect(
    address: RobotLike,
    *,
    run: RunLike | None = None,
    arm: ArmLike | None = None,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Session:
    """Connect to an arm, to drive it under the guard; nothing moves yet.

    Without a guard: `rejoint.open_robot`.

    Parameters
    ----------
    address
        ``emulated:worn`` (virtual time), ``tcp://HOST:PORT``, ``serial:///dev/DEVICE``, ``feetech:///dev/DEVICE``, or
        an open robot
    run
        run, or its folder, for twin, calibration, controller and logs; without one the generic policy drives, if any
    arm
        arm, name or file; default: by the run or the address
    settings
        controller, payload, control period and so on
    observer
        receives messages, progress, control cycles

    Returns
    -------
    Session
        the arm

    Raises
    ------
    AddressError
        if nothing usable is there
    MissingExtraError
        without the simulator of an emulated arm
    InputError, ContractError
        if run, controller and arm do not fit

    Examples
    --------
    >>> with rejoint.connect("tcp://192.168.1.20:9000", run="runs/mine") as arm:
    ...     arm.move_to([0.2, 0.05, 0.18])
    >>> settings = rejoint.Settings(payload=0.1)
    >>> arm = rejoint.connect("emulated:worn", settings=settings)
    """
    found = Session(address, run=run, arm=arm, settings=settings, observer=observer)
    try:
        found.driver()
        found.correction  # noqa: B018 - what does not fit is refused now
        found.look()
        return found
    except BaseException as error:
        found.__exit__(type(error), error, error.__traceback__)
        raise
