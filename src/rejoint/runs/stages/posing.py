"""An arm that follows joint goals as they come: a program sends postures, our law and guard drive, in a thread."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import ExitStack
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Arm, Array
from rejoint.control.controller import ControlInput
from rejoint.control.loop import Schedule
from rejoint.control.loop import run as drive
from rejoint.control.posture import PostureController, Wanted
from rejoint.control.recording import PIECE, Cycle, recording_of
from rejoint.control.robot import JointState, Mask, Robot
from rejoint.control.servogains import limits_under
from rejoint.control.start import check_ready
from rejoint.logs.runlog import TWO_TURNS
from rejoint.robots import open_robot
from rejoint.runs.given import Period, RunLike, as_run
from rejoint.runs.run import Run, exclusive
from rejoint.runs.stages.known import guard_limits, twin_in_force
from rejoint.runs.stages.longlog import LongLog
from rejoint.system.errors import InputError, NotReadyError
from rejoint.system.files import require_space

RESTS = 0.25
"""[s] without a new goal after which the arm is to come to rest there (chosen: several goals of a program at 30 Hz)"""
STARTING = 5.0
"""[s] that the first control cycle may take (chosen: ten times what it does)"""
LABEL = "joints/posture"

Beside = Callable[[], object] | None


class GoalWay:
    """Goes to the newest goal, every joint as fast as the arm allows."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._goal: Array | None = None
        self._posture = self._last = np.zeros(0)
        self._time = self._changed = -np.inf

    def send(self, goal: Array) -> Array:
        """Take a goal (n,) [rad]; returns it within the limits of the joints."""
        self._goal = np.clip(goal, self._arm.lower, self._arm.upper)
        return self._goal

    def advance(self, state: JointState) -> Wanted:
        """Return where the arm is to be now: at first, where it is."""
        now, goal = float(state.time[0]), self._goal
        if not len(self._posture):
            self._posture, self._time = state.position[0].copy(), now
            self._last = self._posture
        goal = self._last if goal is None else goal
        if (goal != self._last).any():
            self._last, self._changed = goal, now
        reach = self._arm.max_speed * max(now - self._time, 0.0)
        self._posture = self._posture + np.clip(goal - self._posture, -reach, reach)
        self._time = now
        arrived = now - self._changed > RESTS and bool((self._posture == goal).all())
        return Wanted(posture=self._posture[None], arrived=np.array([arrived]))


class PosedArm:
    """An arm that follows joint goals, at once and in a thread of its own; use it in a ``with`` block.

    Nothing moves before the first goal: the arm is looked at, and held where it is. Goals are the postures that the
    encoders are to show, so the arm is raised by what its twin says that each joint gives way, and what is left is
    learned. Every command passes the guard. What ends the drive, an error of the robot or the guard, is raised by the
    next call; the arm then holds, as at the end.

    Examples
    --------
    >>> with PosedArm("feetech:///dev/ttyACM0", "runs/mine") as arm:
    ...     arm.send([0.0, -0.5, 0.5, 0.2, 0.0])
    ...     print(arm.position)
    """

    def __init__(
        self,
        address: str,
        run: RunLike,
        *,
        period: Period | None = None,
        beside: Callable[[Robot], Beside] | None = None,
        say: Callable[[str], object] = lambda _: None,
    ) -> None:
        """Connect and hold; AddressError or NotReadyError where the arm had better not be driven.

        What ``beside`` makes for the open robot is called once in every control cycle, for what is none of the joints.
        ``say`` is told what a person should know.
        """
        self._run = about = as_run(run)
        self._say = say
        self.arm = about.arm
        with ExitStack() as stack:
            stack.enter_context(exclusive(about))
            require_space(about.path)
            self._robot = open_robot(address, arm=about.arm, seed=about.seed, period=period)
            stack.callback(self._robot.close)
            check_ready(self._robot)
            self._limits = limits_under(guard_limits(about, about.arm, address), self._robot, None)
            self._way = GoalWay(about.arm)
            self._controller = _controller(about, self._robot, self._way)
            self._beside = None if beside is None else beside(self._robot)
            self._position = self._robot.read().position[0]
            self._over, self._began = threading.Event(), threading.Event()
            self._error: BaseException | None = None
            self._thread = threading.Thread(target=self._drive, name="joints", daemon=True)
            self._thread.start()
            self._stack = stack.pop_all()
        self._began.wait(STARTING)

    @property
    def position(self) -> Array:
        """(n,) [rad] as the encoders told in the last control cycle; raises what ended the drive."""
        self.check()
        return self._position

    def send(self, goal: ArrayLike) -> Array:
        """Send joint positions (n,) [rad]; returns them as they were taken, within the joints' limits.

        InputError for positions that no joint has in radians: cut to the limits, degrees would send the arm far away.
        """
        wanted = np.asarray(goal, dtype=float)
        if wanted.shape != (self.arm.joints,) or not np.isfinite(wanted).all():
            raise InputError(f"expected {self.arm.joints} joint positions in radians, got {goal!r}")
        if np.abs(wanted).max() > TWO_TURNS:
            raise InputError(f"joint positions {goal!r} are beyond two turns; give radians")
        self.check()
        return self._way.send(wanted)

    def check(self) -> None:
        """Raise what ended the drive; NotReadyError after the end."""
        if self._error is not None:
            raise self._error
        if not self._thread.is_alive():
            raise NotReadyError("the arm is not driven any more; connect again")

    def close(self) -> None:
        """End the drive, keep its log, and let go of the arm, which holds."""
        self._over.set()
        self._thread.join()
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _drive(self) -> None:
        """Drive piece by piece until the end."""
        sent: Array | None = None
        try:
            log = LongLog(self._run, self._robot, "joints", LABEL, self._say)
            while not self._over.is_set():
                sent = self._piece(sent, log)
            log.end(None)
            self._robot.stop()
        except BaseException as error:  # noqa: BLE001 - raised again where somebody asks
            self._error = error
            self._began.set()  # nothing is left to wait for

    def _piece(self, sent: Array | None, log: LongLog) -> Array:
        """Drive for up to `PIECE`; returns the last command (1, n) [rad]."""

        def see(cycle: Cycle) -> None:
            self._position = cycle.position[0].copy()
            self._began.set()
            log.see(cycle)
            if self._beside is not None:
                self._beside()

        def over(_: ControlInput) -> Mask:
            return np.array([self._over.is_set()])

        nowhere = np.full((1, 1, 3), np.nan)  # postures are followed, and no target
        schedule = Schedule(dwell=PIECE, sent=sent, give_up=over)
        try:
            recording = drive(self._robot, self._controller, nowhere, schedule, limits=self._limits, on_cycle=see)
        except BaseException as error:
            error.add_note(log.rescue(recording_of(error)))
            raise
        log.turn(recording)
        return recording.command[-1]


def _controller(run: Run, robot: Robot, way: GoalWay) -> PostureController:
    """Return what brings the arm to its goals, by what the twin says of servos with the gains that they have now."""
    twin = twin_in_force(run, robot)
    if twin is None:
        return PostureController(run.arm, way)
    return PostureController(run.arm, way, stiffness=twin.parameters.stiffness, offset=twin.parameters.offset)
