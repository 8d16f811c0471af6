"""Connecting to a robot: to its bare joints, or, with a run, to an arm that hits what it is sent to."""

from __future__ import annotations

import threading
from contextlib import ExitStack
from dataclasses import dataclass, fields, replace
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self, overload

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.comparison.targets import require_reachable
from rejoint.control.contract import check_controller_period
from rejoint.control.controller import ControlInput
from rejoint.control.loop import Schedule
from rejoint.control.loop import run as drive
from rejoint.control.recording import Cycle, Recording, recording_of
from rejoint.control.robot import Mask, Robot
from rejoint.control.servogains import limits_under, under_gains
from rejoint.control.start import begin
from rejoint.robots import open_robot
from rejoint.runs.given import ArmLike, CalibrationLike, Period, RunLike, as_arm, as_run
from rejoint.runs.run import Run, exclusive
from rejoint.runs.stages.driving import (
    ControllerLike,
    correction_of,
    guard_limits,
    make_factories,
    recommended,
    stance_of,
    start_journal,
)
from rejoint.system.errors import InputError, NotReachedError, NotReadyError
from rejoint.system.files import require_space
from rejoint.system.stopping import noted, pause

if TYPE_CHECKING:
    from rejoint.logs.journal import Journal

CALM = 0.3
"""[s] for which the tool has to stay near its target before that counts as reached (chosen: longer than a worn joint
rings)"""
_LOOK = 0.01  # [s] between two looks at whether a motion has ended (chosen)
_LABEL = "move"


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
    """(3,) where the arm was sent last"""
    error_m: float | None = None
    """of the tool from where it was sent, by the encoders"""


@overload
def connect(
    address: str, *, arm: ArmLike | None = None, seed: int = 0, count: int = 1, period: Period | None = None
) -> Robot: ...
@overload
def connect(
    address: str, *, run: RunLike, controller: ControllerLike | None = None,
    calibration: CalibrationLike | None = None, seed: int = 0, period: Period | None = None,
) -> DrivenArm: ...  # fmt: skip
def connect(
    address: str, *, run: RunLike | None = None, controller: ControllerLike | None = None,
    calibration: CalibrationLike | None = None, arm: ArmLike | None = None, seed: int = 0, count: int = 1,
    period: Period | None = None,
) -> Robot | DrivenArm:  # fmt: skip
    """Connect to a robot; nothing moves. With a run, the arm is then driven to points, under the guard.

    Parameters
    ----------
    address
        ``emulated:worn`` (in this process, virtual time), ``tcp://HOST:PORT`` or ``serial:///dev/DEVICE``
    run
        run, or its folder: its controller drives the arm, and what it does is logged there
    controller
        policy, its file, or the name of a baseline; by default what the run recommends
    calibration
        what lies behind the encoders, or its file, or ``none``; by default that of ``run``
    arm
        arm, name or file; by default that of the run, or the one that the address names, else a myCobot 280
    seed
        of everything random in an emulated arm, and of the lengths of the control cycles
    count
        number of emulated arms that move side by side as one batch; one with a run
    period
        [s] interval from which the length of every control cycle is drawn; by default the robot's own

    Returns
    -------
    Robot or DrivenArm
        Without a run a robot: read it with ``read()``, command it with ``step(command)``, (count, n) [rad], and end
        with ``close()``. Nothing between the two guards the arm. With a run a `DrivenArm`.

    Raises
    ------
    AddressError
        if nothing usable is there
    MissingExtraError
        for an emulated arm without the simulator
    InputError, ContractError
        if run, controller and arm do not fit

    Examples
    --------
    >>> robot = rejoint.connect("emulated:worn")
    >>> state = robot.step(robot.read().position + 0.01)
    >>> robot.close()
    >>> with rejoint.connect("tcp://192.168.1.20:9000", run="runs/mine") as arm:
    ...     arm.move_to([0.2, 0.05, 0.18])
    """
    if run is None:
        if controller is not None or calibration is not None:
            raise InputError("connect: a controller and a calibration need a run: connect(address, run=...)")
        return open_robot(address, arm=None if arm is None else as_arm(arm), seed=seed, count=count, period=period)
    if arm is not None or count != 1:
        raise InputError("connect: with a run there is one arm, that of the run; leave arm and count out")
    return DrivenArm(address, as_run(run), controller=controller, calibration=calibration, seed=seed, period=period)


class DrivenArm:
    """An arm that is sent to points, and hits them: by the controller that its run recommends, under the guard.

    Before its first motion the arm is looked at and goes slowly to its rest posture. Between motions it holds. Made by
    `rejoint.connect`; use it in a ``with`` block, which ends in a hold.

    Examples
    --------
    >>> with rejoint.connect("tcp://192.168.1.20:9000", run="runs/mine") as arm:
    ...     arm.move_to([0.2, 0.05, 0.18])
    ...     print(arm.state.error_m)
    """

    def __init__(
        self, address: str, run: Run, *, controller: ControllerLike | None, calibration: CalibrationLike | None,
        seed: int, period: Period | None,
    ) -> None:  # fmt: skip
        """Connect; see `rejoint.connect`."""
        self._run = run
        with ExitStack() as stack:
            stack.enter_context(exclusive(run))
            require_space(run.path)
            twin = run.twin
            ((self.controller, make),) = make_factories(
                [recommended(run) if controller is None else controller], run.arm, period, run=run, twin=twin
            ).items()
            self._robot = open_robot(address, arm=run.arm, seed=seed, period=period)
            stack.callback(self._robot.close)
            self._driver, self._stance = make(run.arm), stance_of(twin)
            correct = correction_of(calibration, run, run.arm, address)
            self._correction = None if correct is None else correct(run.arm)
            self._limits = limits_under(guard_limits(run, run.arm, address), self._robot, self._driver)
            stack.enter_context(under_gains(self._robot, self._driver))
            self._stack = stack.pop_all()
        self._sent: Array | None = None
        self._pieces: list[Recording] = []
        self._journal: Journal | None = None
        self._last: Cycle | None = None
        self._motion: _MoveTo | None = None

    @property
    def arm(self) -> Arm:
        """The arm's kinematics, limits and masses."""
        return self._run.arm

    @property
    def state(self) -> ArmState:
        """What is known now: during a motion of its last control cycle, else read from the arm."""
        cycle, motion = self._last, self._motion
        if motion is not None and motion.is_alive() and cycle is not None:
            return self._state(float(cycle.time[0]), cycle.position[0], moving=True)
        read = self._robot.read()
        return self._state(float(read.time[0]), read.position[0], moving=False)

    def move_to(
        self, target_m: ArrayLike, *, within_m: float = 0.002, timeout_s: float = 10.0, wait: bool = True
    ) -> ArmState | None:
        """Bring the tool to ``target_m`` (3,) [m] in the base frame.

        It counts as reached once the tool stays ``within_m`` of where it is sent, by the encoders. With ``wait`` this
        returns the state at the end; without, it returns None at once: then `wait`, `state` and `stop` tell and end the
        motion. InputError for a target out of reach, before anything moves; NotReachedError after ``timeout_s``;
        GuardTripError or RobotError where the motion had to be ended. In any case the arm then holds.
        """
        target = np.asarray(target_m, dtype=float)
        if target.shape != (3,) or not np.isfinite(target).all():
            raise InputError(f"move_to: expected a point (3,) in metres, got {target_m!r}")
        if not (within_m > 0.0 and timeout_s > 0.0):
            raise InputError(f"move_to: within_m and timeout_s are positive, got {within_m} and {timeout_s}")
        require_reachable(self.arm, target[None, None])
        self._require_free()
        self._motion = _MoveTo(self, target, within_m, timeout_s)
        self._motion.start()
        return self.wait() if wait else None

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
        except KeyboardInterrupt:
            self.stop()
            raise
        if motion.is_alive():
            raise NotReachedError(f"the arm is still on its way to {_mm(motion.target)} after {timeout_s} s of waiting")
        self._motion = None
        if motion.error is not None:
            raise motion.error
        return self.state

    def stop(self) -> None:
        """End the motion under way; the arm holds where it is."""
        motion, self._motion = self._motion, None
        if motion is not None:
            motion.ended.set()
            motion.join()
        self._robot.stop()

    def close(self) -> None:
        """End the motion under way, keep the log, and let go of the arm, which holds."""
        try:
            if self._motion is not None:
                self.stop()
            self._keep()
        finally:
            self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _require_free(self) -> None:
        if self._motion is not None and self._motion.is_alive():
            raise NotReadyError("the arm is still on its way; wait() for it, or stop() it first")

    def _state(self, time: float, joints: Array, *, moving: bool) -> ArmState:
        tool = tcp_position(self.arm, joints)
        cycle = self._last
        target = None if cycle is None else cycle.target[0]
        error = None if cycle is None else float(np.linalg.norm(cycle.aim[0] - tool))
        return ArmState(
            time_s=time, joints_rad=joints.copy(), tool_m=tool, moving=moving, target_m=target, error_m=error
        )

    def _drive(self, target: Array, schedule: Schedule) -> None:
        """Drive to ``target`` (3,) [m]; for the thread of a motion."""
        if self._sent is None:
            start = begin(self._robot, self._limits, self._stance)
            check_controller_period(self._driver, start.usual_period())
            self._sent = start.command[-1]
            self._journal = start_journal(self._run, _LABEL, self._robot, f"{_LABEL}/{self.controller}")
        try:
            recording = drive(
                self._robot, self._driver, target[None, None], replace(schedule, sent=self._sent),
                limits=self._limits, correction=self._correction, on_cycle=self._see,
            )  # fmt: skip
        except BaseException as error:
            partial = recording_of(error)
            if partial is not None and len(partial.time):
                self._take(partial)
            raise
        self._take(recording)

    def _see(self, cycle: Cycle) -> None:
        self._last = cycle
        if self._journal is not None:
            self._journal.see(cycle)

    def _take(self, recording: Recording) -> None:
        self._sent = recording.command[-1]
        self._pieces.append(recording)

    def _keep(self) -> None:
        """Write the log of all motions."""
        journal, self._journal = self._journal, None
        if journal is not None and self._pieces:
            journal.finish(_joined(self._pieces).log(0, f"{_LABEL}/{self.controller}"))
        elif journal is not None:
            journal.discard()


class _MoveTo(threading.Thread):
    """One motion to a target; `error` is what ended it early."""

    def __init__(self, driven: DrivenArm, target: Array, within: float, timeout: float) -> None:
        super().__init__(name="move_to", daemon=True)
        self.target, self.ended = target, threading.Event()
        self.error: BaseException | None = None
        self._driven, self._within, self._timeout = driven, within, timeout
        self._near_since: float | None = None
        self._reached = False

    def run(self) -> None:
        """Drive until the target is reached, the time is over or the end is asked for."""
        schedule = Schedule(dwell=self._timeout, give_up=self._done)
        try:
            self._driven._drive(self.target, schedule)
        except BaseException as error:  # noqa: BLE001 - raised again where somebody waits
            self.error = error
            return
        if not (self._reached or self.ended.is_set()):
            off = self._driven.state.error_m
            told = "" if off is None else f", still {1e3 * off:.1f} mm off"
            self.error = NotReachedError(
                f"the arm did not come within {1e3 * self._within:g} mm of {_mm(self.target)} in {self._timeout:g} s"
                f"{told}; it holds. Give it more time or room, or look whether something is in its way"
            )

    def _done(self, inputs: ControlInput) -> Mask:
        arm = self._driven.arm
        error = float(np.linalg.norm(inputs.target[0] - tcp_position(arm, inputs.state.position[0])))
        now = float(inputs.state.time[0])
        self._near_since = (self._near_since if self._near_since is not None else now) if error < self._within else None
        self._reached = self._near_since is not None and now - self._near_since >= CALM
        return np.array([self._reached or self.ended.is_set()])


def _joined(pieces: list[Recording]) -> Recording:
    """Return one recording of several, in their order."""
    arrays = [item.name for item in fields(Recording) if isinstance(getattr(pieces[0], item.name), np.ndarray)]
    joined: dict[str, Any] = {
        name: np.concatenate([getattr(piece, name) for piece in pieces]) for name in arrays if name != "tripped"
    }
    return replace(pieces[-1], **joined)


def _mm(point: Array) -> str:
    return f"({', '.join(f'{1e3 * value:.0f}' for value in point)}) mm"
