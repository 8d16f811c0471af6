"""The arm of `rejoint.connect` with a run: sent to points and along paths, it hits."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from dataclasses import dataclass
from types import TracebackType
from typing import Literal, Self, overload

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.comparison.targets import require_reachable
from rejoint.control.controller import heeds_turn
from rejoint.control.moving.drive import Followed
from rejoint.control.moving.routes import Stream
from rejoint.control.poses import Pose, placed
from rejoint.control.recording import Cycle
from rejoint.control.robot import JointState
from rejoint.control.servogains import limits_under, under_gains
from rejoint.robots import open_robot
from rejoint.runs.given import CalibrationLike, Period
from rejoint.runs.run import Run, exclusive
from rejoint.runs.stages.armdrive import ArmDrive
from rejoint.runs.stages.controllers import ControllerLike, make_factories, recommended, usual_controller
from rejoint.runs.stages.known import correction_of, guard_limits, stance_of, twin_in_force
from rejoint.runs.stages.loads import Say, say_folded, say_heavy
from rejoint.runs.stages.motions import AlongPath, MotionThread, MoveTo
from rejoint.runs.stages.pathdrive import TRACKER, WITHIN, PathLike, followable, follower_of, require_repeatable, turned
from rejoint.system.errors import InputError, NotReachedError, NotReadyError
from rejoint.system.files import require_space
from rejoint.system.numbers import as_floats, as_within
from rejoint.system.stopping import noted, pause

WITHIN_TURN = float(np.radians(1.0))
"""[rad] within which an orientation counts as reached where an arm is sent to a pose (chosen: as the vendor's)"""
_BOUNDS = "positive numbers as within_rad and timeout_s, the latter finite"
_POINT = "a point (3,) in metres"
_LOOK = 0.01  # [s] between two looks at whether a motion has ended (chosen)


@dataclass(frozen=True, kw_only=True, eq=False)
class ArmState:
    """What is known of an arm at a moment."""

    time_s: float
    """on the robot's clock"""
    joints_rad: Array
    """(n,) measured"""
    tool_m: Array
    """(3,) tool centre point by the encoders"""
    moving: bool
    """whether a motion is under way"""
    target_m: Array | None = None
    """(3,) where the arm was sent last; None until the first control cycle towards it"""
    error_m: float | None = None
    """of the tool from where it was sent, by the encoders"""
    turned_rad: float | None = None
    """of the tool from how it was to be turned, by the encoders; None where it was sent to a point"""


class DrivenArm:
    """An arm that is sent to points, and hits them: by the controller that its run recommends, under the guard.

    Before its first motion the arm is looked at and goes slowly to its rest posture. Between motions it holds. Made by
    `rejoint.connect`; use it in a ``with`` block, which ends in a hold.

    Examples
    --------
    >>> with rejoint.connect("tcp://192.168.1.20:9000", run="runs/mine") as arm:
    ...     arm.move_to([0.2, 0.05, 0.18])
    ...     print(arm.state.error_m)
    ...     print(arm.follow("drawing.csv").passes[-1].encoder.rms)
    """

    def __init__(
        self, address: str, run: Run, *, arm: Arm, controller: ControllerLike | None,
        calibration: CalibrationLike | None, seed: int, period: Period | None, say: Say,
    ) -> None:  # fmt: skip
        """Connect; see `rejoint.connect`."""
        self._run, self._arm, self._period, self._say = run, arm, period, say
        with ExitStack() as stack:
            stack.enter_context(exclusive(run))
            require_space(run.path)
            ((self.controller, make),) = make_factories(
                [recommended(run) if controller is None else controller], arm, period, run=run, twin=run.twin
            ).items()
            correct = correction_of(calibration, run, arm, address)
            robot = open_robot(address, arm=arm, seed=seed, period=period)
            stack.callback(robot.close)
            driver = make(arm)
            stack.enter_context(under_gains(robot, driver))
            self._twin = twin_in_force(run, robot)
            turning = driver
            if not heeds_turn(driver):
                by = usual_controller(run, posed=True)
                (turn,) = make_factories([by], arm, period, twin=self._twin, posed=True).values()
                turning = turn(arm)
            self._drive = ArmDrive(
                run=run, robot=robot, controller=driver, turning=turning, name=self.controller,
                limits=limits_under(guard_limits(run, arm, address), robot, driver),
                stance=stance_of(self._twin, run),
                correction=None if correct is None else correct(arm), say=say,
            )  # fmt: skip
            self._seen: JointState | Cycle = robot.read()
            self._stack = stack.pop_all()
        self._motion: MotionThread | None = None
        self._followed: Followed | None = None
        self._asking = threading.RLock()
        """of who asks the arm outside of a motion, or begins one: programs look and order in several threads"""
        self._closed = False

    @property
    def arm(self) -> Arm:
        """The arm's kinematics, limits and masses, with the load and tool that were told."""
        return self._arm

    @property
    def state(self) -> ArmState:
        """What is known now: during a motion that of its last control cycle, else read from the arm."""
        with self._asking:
            self._require_open()
            moving = self._motion is not None and self._motion.is_alive()
            if not moving:  # else the robot is the motion's to ask
                self._seen = self._drive.robot.read()
            newest = self._drive.last if moving and self._drive.last is not None else self._seen
            return self._state(float(newest.time[0]), newest.position[0], moving=moving)

    @property
    def followed(self) -> Followed | None:
        """How well the last path was followed; None while the first one is under way."""
        return self._followed

    @overload
    def move_to(
        self, target_m: ArrayLike | Pose, *, within_m: float = 0.002, within_rad: float = WITHIN_TURN,
        timeout_s: float = 10.0, wait: Literal[True] = True,
    ) -> ArmState: ...  # fmt: skip
    @overload
    def move_to(
        self, target_m: ArrayLike | Pose, *, within_m: float = 0.002, within_rad: float = WITHIN_TURN,
        timeout_s: float = 10.0, wait: bool,
    ) -> ArmState | None: ...  # fmt: skip
    def move_to(
        self, target_m: ArrayLike | Pose, *, within_m: float = 0.002, within_rad: float = WITHIN_TURN,
        timeout_s: float = 10.0, wait: bool = True,
    ) -> ArmState | None:  # fmt: skip
        """Bring the tool to ``target_m`` (3,) [m] in the base frame, or to a `Pose`.

        It counts as reached once the tool stays ``within_m`` of where it is sent, by the encoders, and where the target
        has an orientation ``within_rad`` of that. To poses the feed-forward drives, where the controller of the run
        does not turn the tool. With ``wait`` this returns the state at the end; without, it returns None at once: then
        `wait`, `state` and `stop` tell and end the motion, and what ended one that nobody waited for is raised by the
        next order, or by `close`. InputError for a target out of reach, before anything moves; NotReadyError while a
        motion is under way, and once the arm is closed; NotReachedError after ``timeout_s``; GuardTripError or
        RobotError where the motion had to be ended. In any case the arm then holds.
        """
        pose = target_m if isinstance(target_m, Pose) else None
        target = as_floats("move_to", target_m if pose is None else pose.place_m, _POINT)
        if target.shape != (3,) or not np.isfinite(target).all():
            raise InputError(f"move_to: expected {_POINT}, got {target_m!r}")
        within_m, given = as_within("move_to", within_m), (within_rad, timeout_s)
        bounds = as_floats("move_to", given, _BOUNDS)
        if bounds.shape != (2,) or not (bounds > 0.0).all() or np.isinf(bounds[1]):
            raise InputError(f"move_to: expected {_BOUNDS}, got {given}")
        within_rad, timeout_s = bounds.tolist()
        turns = None if pose is None else placed(self.arm, [pose])[1]
        require_reachable(self.arm, target[None, None], turns and turns[None])
        self._require_free()
        say_heavy(self.arm, self._twin, target, self._say, turns)
        self._start(MoveTo(self._drive, target, (within_m, within_rad), timeout_s, turns and turns[0]))
        return self.wait() if wait else None

    @overload
    def follow(
        self, path: PathLike | Stream, *, repeat: int = 1, rate_hz: float | None = None,
        duration_s: float | None = None, within_m: float = WITHIN, wait: Literal[True] = True,
    ) -> Followed: ...  # fmt: skip
    @overload
    def follow(
        self, path: PathLike | Stream, *, repeat: int = 1, rate_hz: float | None = None,
        duration_s: float | None = None, within_m: float = WITHIN, wait: bool,
    ) -> Followed | None: ...  # fmt: skip
    def follow(
        self, path: PathLike | Stream, *, repeat: int = 1, rate_hz: float | None = None,
        duration_s: float | None = None, within_m: float = WITHIN, wait: bool = True,
    ) -> Followed | None:  # fmt: skip
        """Drive the tool along ``path``, with the twin of the run; path, ``repeat`` and rate as in `rejoint.follow`.

        From where it stands the arm goes slowly to the start, stands there for two seconds, and moves off. A `Stream`
        needs a ``duration_s``, and a first target. With ``wait`` this returns how well the path was followed; where
        another thread has called `stop`, NotReachedError. Without, it returns None at once: then `wait`, `state` and
        `stop` tell and end the motion, and `followed` says at its end how well.
        InputError for a path out of reach or too fast, and where the run has no twin, before anything moves;
        GuardTripError or RobotError where the motion had to be ended. In any case the arm then holds.
        """
        self._require_free()
        require_repeatable(path, repeat, rate_hz, within_m)
        given = followable(path, self.arm, self._run.seed, duration_s)
        tracker = follower_of(TRACKER, self.arm, self._period, self._run, self._twin)
        if not turned(given):
            say_folded(self.arm, tracker.home, self._say)
        self._followed = None
        self._start(
            AlongPath(
                self._drive, given, tracker, repeat=repeat, rate=rate_hz, duration=duration_s, within=within_m,
                keep=self._keep_followed,
            )
        )  # fmt: skip
        if not wait:
            return None
        self.wait()
        found = self.followed
        if found is None:
            raise NotReachedError("the path was ended before its end; the arm holds")
        return found

    def wait(self, timeout_s: float | None = None) -> ArmState:
        """Wait until the motion under way has ended, and return the state then.

        NotReachedError if it does not end within ``timeout_s``; the motion then goes on. Otherwise raises what ended
        the motion. Ctrl-C brings the arm to a hold.
        """
        motion, waited = self._motion, 0.0
        if motion is None:
            return self.state
        try:
            with noted():
                while motion.is_alive() and (timeout_s is None or waited < timeout_s):
                    pause(_LOOK)
                    waited += _LOOK
        except BaseException:  # Ctrl-C, or what the program's own handler of a signal raises
            self.stop()
            raise
        if motion.is_alive():
            raise NotReachedError(f"the arm is still on its way to {motion.goal} after {timeout_s} s of waiting")
        self._tell_last()
        return self.state

    def stop(self) -> None:
        """End the motion under way, however it went; the arm holds where it is. One that is closed holds already."""
        motion = self._motion
        if motion is not None:
            motion.ended.set()  # at once: whoever asks the arm may have to wait for its answer
        with self._asking:
            motion, self._motion = self._motion, None
            if self._closed and motion is None:
                return
            if motion is not None:
                motion.ended.set()
                motion.join()
            self._drive.robot.stop()

    def close(self) -> None:
        """End the motion under way, keep the log, and let go of the arm, which holds; it takes no orders any more.

        Then raises what ended the last motion, where nobody has waited for it.
        """
        motion = self._motion
        self._let_go()
        if motion is not None and motion.error is not None:
            raise motion.error

    def _let_go(self) -> None:
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
                self._drive.keep()
            finally:
                self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            self._let_go()

    def _require_open(self) -> None:
        if self._closed:
            raise NotReadyError("the arm is closed, and others may drive it; call rejoint.connect again")

    def _require_free(self) -> None:
        self._require_open()
        if self._motion is not None and self._motion.is_alive():
            raise NotReadyError("the arm is still on its way; wait() for it, or stop() it first")
        self._tell_last()

    def _tell_last(self) -> None:
        """Raise what ended the last motion, once."""
        motion, self._motion = self._motion, None
        if motion is not None and motion.error is not None:
            raise motion.error

    def _start(self, motion: MotionThread) -> None:
        with self._asking:  # two threads may have looked before either started
            self._require_free()
            last, self._drive.last = self._drive.last, None  # its target is not where the arm is sent now
            if last is not None and last.time[0] > self._seen.time[0]:
                self._seen = last
            self._motion = motion
            motion.start()

    def _keep_followed(self, followed: Followed) -> None:
        self._followed = followed

    def _state(self, time: float, joints: Array, *, moving: bool) -> ArmState:
        tool = tcp_position(self.arm, joints)
        cycle = self._drive.last
        aimed = cycle is not None and bool(np.isfinite(cycle.aim[0]).all())
        return ArmState(
            time_s=time, joints_rad=joints.copy(), tool_m=tool, moving=moving,
            target_m=cycle.target[0].copy() if cycle is not None and aimed else None,
            error_m=float(np.linalg.norm(cycle.aim[0] - tool)) if cycle is not None and aimed else None,
            turned_rad=None if cycle is None or np.isnan(cycle.turned[0]) else float(cycle.turned[0]),
        )  # fmt: skip
