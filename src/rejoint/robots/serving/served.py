"""The computer that clients speak to: it plans moves as the vendor's, and reports the last state.

The control loop calls `advance`; the server's thread carries out orders. Clients see a perfect arm whose tool is where
this one's is.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from rejoint.arms import (
    Arm,
    Array,
    Motors,
    choose_postures,
    tcp_pose,
    tcp_position,
)
from rejoint.arms.postures import too_heavy
from rejoint.arms.rotations import WEIGHT, Orientation, tool_axis
from rejoint.control.controllers.posture import PostureGains
from rejoint.control.controllers.unloading import OFF, Unloading
from rejoint.control.correction import Apparent
from rejoint.control.guard import GuardLimits, clear_by
from rejoint.control.reference import Reference, Setpoint
from rejoint.control.robot import JointState, Mask
from rejoint.robots.mycobot.mover import ARRIVED_LENGTH, COLLISION, Mover, Sensed, at_angles, at_place

IN_PLACE = PostureGains.close
"""[m] of the tool at the end of a move: where the controller rests"""
CALM = 0.3
"""[s] there (chosen: longer than a worn joint rings)"""
STANDS = 0.15
"""[s] for which a stopped arm is slow before it is held (chosen)"""
PATIENCE = 8.0
"""[s] of bringing it nearer (chosen: worn joints stick for seconds)"""
LONGEST = 0.1
"""[s] of the reference per cycle at most (chosen)"""
TOUCH = 1e-6
"""[m] of rounding in comparisons of goals (chosen)"""
LOST = 1.0
"""[s] until a silent robot's state is not reported (chosen: five slow periods)"""
_SMOOTHING = 0.5  # share of the newest difference in the speed that is told (chosen)


class MoveEnd(NamedTuple):
    """The end of a move."""

    error: float
    """[m] of the tool from its goal, by the encoders"""
    angle: float
    """[rad] of the joint that is farthest away"""
    after: float
    """[s] from the end of the planned way"""
    held_back: str = ""
    """what the guard kept it from, or empty"""
    short: str = ""
    """which joint stands off its goal, in words, or empty"""


class ServedArm(Mover, Reference):
    """One arm of n joints at rest at ``position`` (n,) [rad]."""

    def __init__(
        self,
        arm: Arm,
        position: Array,
        *,
        apparent: Apparent | None = None,
        limits: GuardLimits | None = None,
        motors: Motors | None = None,
    ) -> None:
        """Refuse orders that ``limits`` or ``motors`` rule out."""
        self._limits, self._motors = limits, motors
        self.note = ""
        """what a motor is too weak for in the last order, or empty"""
        self._apparent = apparent or Apparent(arm=arm)
        self._unloading = Unloading(arm, motors)
        super().__init__(arm, self._apparent.shown(position))
        self._lock = threading.RLock()
        self.on_arrival: Callable[[MoveEnd], object] = lambda _: None
        """is told how each move ended"""
        self.held_back = ""
        """what the guard keeps the arm from now, in words"""
        self._time: float | None = None
        self._seen = time.monotonic()
        self._position = position.copy()
        self._speed = np.zeros(arm.joints)
        self._state: JointState | None = None
        self._apparent.came = position.copy()
        self._wanted = self._aim = Setpoint(position[None].copy())
        # when [s] the reference ended its way; None while it moves
        self._since: float | None = None
        self._settled = True
        # when [s] the tool came within `IN_PLACE`, or a stopped arm became slow; None where it is not
        self._close_since: float | None = None
        # whether the move was stopped: it ends where the arm comes to stand
        self._stopped = False

    @contextmanager
    def carrying_out(self) -> Iterator[None]:
        """Keep the control loop from half-changed plans."""
        with self._lock:
            yield

    # --- what the control loop does ---------------------------------------------------------

    def advance(self, state: JointState, since: Array, /) -> Setpoint:  # noqa: ARG002 - moves have their own clock
        """Take a reading; return where the arm is to be."""
        if not self._lock.acquire(blocking=False):
            return self._wanted  # a posture is being searched: the reference waits
        try:
            self._observe(state)
            self._aim = self._next()
            ends = self._settled or self._stopped
            self._wanted = self._aim if ends else self._unloading.advance(state, self._aim)
            self._judge()
            return self._wanted
        finally:
            self._lock.release()

    def _observe(self, state: JointState) -> None:
        now, position = float(state.time[0]), state.position[0].copy()
        elapsed = 0.0 if self._time is None else now - self._time
        if elapsed > 0.0:
            self._speed += _SMOOTHING * ((position - self._position) / elapsed - self._speed)
            self._motion.advance(min(elapsed, LONGEST))
        self._time, self._position, self._seen, self._state = now, position, time.monotonic(), state

    def _next(self) -> Setpoint:
        under_way = self._motion.moving and not self.paused
        if under_way or self._since is None:
            posture = self._apparent.measured(self._motion.reference)
        else:
            posture = self._aim.goal[0]
        return Setpoint(posture[None], arrived=np.array([not under_way]))

    def _judge(self) -> None:
        assert self._time is not None  # noqa: S101 - for the type checker; `_observe` was called
        if not self._wanted.arrived[0]:
            self._since, self._settled, self._close_since = None, False, None
            return
        if self._since is None:
            self._since = self._time
        if self._settled:
            return
        if self._stopped:
            self._judge_stopped(self._time)
            return
        posture = self._wanted.goal[0]
        error = float(np.linalg.norm(tcp_position(self.arm, posture) - tcp_position(self.arm, self._position)))
        after = self._time - self._since
        away = float(np.abs(posture - self._position).max())
        near = error < IN_PLACE and (away < OFF or self._unloading.given_up)
        self._close_since = (self._close_since or self._time) if near else None
        calm = self._close_since is not None and self._time - self._close_since >= CALM
        if calm or after > PATIENCE:
            self._settled, self._apparent.came = True, posture.copy()
            held_back = self.held_back if error > ARRIVED_LENGTH else ""
            if held_back:  # what is ordered next begins where the arm is, not where it will never come
                self._stay()
                self._hold_here()
            short = self._unloading.short(self._position)
            self.on_arrival(MoveEnd(error=error, angle=away, after=after, held_back=held_back, short=short))

    def _judge_stopped(self, now: float) -> None:
        slow = bool((np.abs(self._speed) < PostureGains.moving).all())
        self._close_since = (self._close_since or now) if slow else None
        if self._close_since is not None and now - self._close_since >= STANDS:
            self._stay()
            self._hold_here()
            self._settled = True

    def _hold_here(self) -> None:
        self._apparent.came = here = self._position.copy()
        self._wanted = self._aim = Setpoint(here[None].copy())

    def _stay(self) -> None:
        for joint, angle in enumerate(np.clip(self.angles, self.lower, self.upper)):
            self._motion.place(joint, float(angle))

    # --- what clients ask -------------------------------------------------------------------

    @property
    def is_lost(self) -> bool:
        """Whether the robot has not answered for `LOST`."""
        return time.monotonic() - self._seen > LOST

    @property
    def angles(self) -> Array:
        """(n,) [rad] shown joint angles."""
        return self._apparent.shown(self._position)

    def sensed(self) -> Sensed:
        """Return what the robot tells, else zeros."""
        none, state = np.zeros(self.arm.joints), self._state
        heat = None if state is None else state.temperature
        fault = None if state is None else state.fault
        return Sensed(
            speed=self._speed,
            current=none,
            voltage=none,
            temperature=none if heat is None else heat[0],
            alarms=(none if fault is None else fault[0]).astype(np.uint8),
        )

    @property
    def moving(self) -> bool:
        """Whether a move or its last approach is under way."""
        return not self.paused and (self._motion.moving or not self._settled)

    @property
    def on_its_way(self) -> bool:
        """Whether the reference still moves."""
        return self._motion.moving

    def in_position(self, angles: Array) -> bool:
        """Whether the arm is at ``angles`` (n,) [rad], after the move."""
        if not at_angles(self.planned_angles, angles):
            return at_angles(self.angles, angles)
        return not self.moving and self._is_near(tcp_pose(self.arm, angles))

    def at_pose(self, pose: Array) -> bool:
        """Whether the tool is at ``pose`` (4, 4), after the move."""
        if not at_place(tcp_pose(self.arm, self.planned_angles), pose):
            return at_place(self.pose, pose)
        return not self.moving and self._is_near(pose)

    def _is_near(self, pose: Array) -> bool:
        return bool(np.linalg.norm(self.pose[:3, 3] - pose[:3, 3]) < ARRIVED_LENGTH)

    # --- what clients order -----------------------------------------------------------------

    def stop(self, joint: int | None = None) -> None:
        """Hold one joint where the reference is, or the arm where it is: it may be far behind."""
        under_way = self.on_its_way or not self._settled
        self._motion.hold(joint)
        if joint is None and under_way:
            self._stay()
            self._since, self._settled, self._stopped = None, False, True

    def power(self, on: bool) -> None:
        """Do nothing: clients may not switch the power."""

    def enable(self, wanted: Mask) -> None:
        """Do nothing: clients may not release servos."""

    def calibrate(self, joint: int) -> None:
        """Do nothing: the zeros of the joints stay."""

    def _posture(self, pose: Array, start: Array, *, turned: bool) -> Array | None:
        turn = Orientation(
            rotation=pose[None, :3, :3],
            whole=np.ones(1, dtype=bool),
            weight=np.full(1, WEIGHT),
            axis=tool_axis(self.arm),
        )
        found = self._held(pose, start, turn)
        if found is not None:
            return found
        found = super()._posture(pose, start, turned=turned)
        if found is None or turned or self._too_heavy(found)[0] is None:
            return found
        alone = self._held(pose, start, None)
        if alone is not None:
            self.note = f"with this orientation {self._too_heavy(found)[1]}; the tool comes there turned otherwise"
        return found if alone is None else alone

    def _held(self, pose: Array, start: Array, turn: Orientation | None) -> Array | None:
        """Return a posture (n,) [rad] that the motors hold, or None."""
        found = choose_postures(self.arm, pose[None, :3, 3], start, turn=turn, motors=self._motors, thorough=False)
        return None if found.refusals[0] else found.q[0]

    def _too_heavy(self, angles: Array) -> tuple[int | None, str]:
        """Return the joint that cannot hold ``angles`` (n,) [rad], and why, or None."""
        if self._motors is None:
            return None, ""
        return too_heavy(self.arm, self._apparent.measured(angles), self._motors.limit)

    def _is_clear(self, angles: Array) -> bool:
        """Whether motors and guard allow ``angles`` (n,) [rad]; in contact it may go nearer to what is clear."""
        joint, why = self._too_heavy(angles)
        if joint is not None:
            self.error, self.note = joint + 1, f"too heavy: {why} (error {joint + 1})"
            return False
        if self._limits is None:
            return True
        goal, here = (self._apparent.measured(one) for one in (angles, self.planned_angles))
        clear = clear_by(self._limits, np.stack([goal, here]))
        if (clear[0] >= np.minimum(clear[1], 0.0) - TOUCH).all():
            return True
        self.error = COLLISION
        return False

    def _ready(self) -> bool:
        self._settled, self._since, self._stopped = False, None, False
        return True
