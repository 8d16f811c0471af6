"""The computer that clients speak to: it plans moves as the vendor's does, and reports the state read last.

The control loop calls `advance` once a cycle; the server's thread carries out orders. Clients see the posture of a
perfect arm whose tool is where this one's tool really is.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
from rejoint.arms.wire.computer import COLLISION, HAS_ARRIVED_LENGTH, at_angles, at_place
from rejoint.arms.wire.mover import Mover
from rejoint.control.correction import Apparent
from rejoint.control.guard import GuardLimits, clear_by
from rejoint.control.posture import PostureGains
from rejoint.control.reference import Reference, Setpoint
from rejoint.control.robot import JointState, Mask
from rejoint.control.unloading import OFF, Unloading

IN_PLACE = PostureGains.close
"""[m] of the tool within which a move has ended: where the controller lets the arm rest"""
CALM = 0.3
"""[s] for which it has to stay there (chosen: longer than a worn joint rings)"""
STANDS = 0.15
"""[s] for which a stopped arm has to be slow before it is held where it is (chosen)"""
PATIENCE = 8.0
"""[s] after the end of its way for which a move is brought nearer (chosen: worn joints stick for seconds)"""
LONGEST = 0.1
"""[s] by which the reference goes on in one cycle at most (chosen)"""
TOUCH = 1e-6
"""[m] that a goal may be lower than what it is compared with: rounding (chosen)"""
LOST = 1.0
"""[s] without an answer of the robot after which its state is not reported (chosen: five slow periods)"""
_SMOOTHING = 0.5  # share of the newest difference in the speed that is told (chosen)


@dataclass(frozen=True, kw_only=True)
class MoveEnd:
    """The end of a move."""

    error: float
    """[m] of the tool, by the encoders, from where it was sent"""
    angle: float
    """[rad] of the joint that is farthest away"""
    after: float
    """[s] from the end of the planned way"""
    held_back: str = ""
    """what the guard kept it from, in words; empty where it did not"""
    short: str = ""
    """which joint stands off its goal, and by how much; empty where none does"""


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
        """Refuse orders to places that the guard's ``limits`` or the ``motors`` rule out."""
        self._limits, self._motors = limits, motors
        self.note = ""
        """what a motor is too weak for in the last order; empty where none is"""
        self._apparent = apparent or Apparent(arm=arm)
        self._unloading = Unloading(arm, motors)
        super().__init__(arm, self._apparent.shown(position))
        self._lock = threading.RLock()
        self.powered = True
        self.enabled: Mask = np.ones(arm.joints, dtype=bool)
        self.registers: dict[tuple[int, int], int] = {}
        self.on_arrival: Callable[[MoveEnd], object] = lambda _: None
        """is told how each move ended"""
        self.held_back = ""
        """what the guard keeps the arm from now, in words; the control loop tells"""
        self._time: float | None = None
        self._seen = time.monotonic()
        self._position = position.copy()
        self._speed = np.zeros(arm.joints)
        self._temperature: Array | None = None
        self._fault: Mask | None = None
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
        """Keep the control loop from reading a half-changed plan."""
        with self._lock:
            yield

    # --- what the control loop does ---------------------------------------------------------

    def advance(self, state: JointState, since: Array, /) -> Setpoint:  # noqa: ARG002 - moves have their own clock
        """Take what was read, let the reference go on, and return where the arm is to be now."""
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
        self._time, self._position, self._seen = now, position, time.monotonic()
        self._temperature = None if state.temperature is None else state.temperature[0].copy()
        self._fault = None if state.fault is None else state.fault[0].copy()

    def _next(self) -> Setpoint:
        under_way = self._motion.moving and not self._motion.paused
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
            held_back = self.held_back if error > HAS_ARRIVED_LENGTH else ""
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
        """Whether the robot itself has not answered for `LOST`: what is known of it is old."""
        return time.monotonic() - self._seen > LOST

    @property
    def angles(self) -> Array:
        """(n,) [rad] shown joint angles."""
        return self._apparent.shown(self._position)

    @property
    def pose(self) -> Array:
        """(4, 4) TCP pose: where the tool really is, as far as a calibration tells."""
        return tcp_pose(self.arm, self.angles)

    @property
    def speed(self) -> Array:
        """(n,) [rad/s]."""
        return self._speed

    @property
    def temperature(self) -> Array:
        """(n,) [deg C]; 0 where the arm does not tell."""
        return np.zeros(self.arm.joints) if self._temperature is None else self._temperature

    @property
    def current(self) -> Array:
        """(n,) [A]; 0, since drivers do not ask for it."""
        return np.zeros(self.arm.joints)

    @property
    def voltage(self) -> Array:
        """(n,) [V]; 0, since drivers do not ask for it."""
        return np.zeros(self.arm.joints)

    @property
    def alarms(self) -> NDArray[np.uint8]:
        """(n,) status bits: the lowest where a servo reports a fault."""
        return np.zeros(self.arm.joints, np.uint8) if self._fault is None else self._fault.astype(np.uint8)

    @property
    def moving(self) -> bool:
        """Whether a move is under way, or the arm is still brought nearer to its end."""
        return not self.paused and (self._motion.moving or not self._settled)

    @property
    def on_its_way(self) -> bool:
        """Whether the reference of a move has not come to its end."""
        return self._motion.moving

    def in_position(self, angles: Array) -> bool:
        """Whether the arm is at ``angles`` (n,) [rad]; at the end of a move, once that has ended."""
        if not at_angles(self.planned_angles, angles):
            return at_angles(self.angles, angles)
        return not self.moving and self._is_near(tcp_pose(self.arm, angles))

    def at_pose(self, pose: Array) -> bool:
        """Whether the tool is at ``pose`` (4, 4); at the end of a move, once that has ended."""
        if not at_place(tcp_pose(self.arm, self.planned_angles), pose):
            return at_place(self.pose, pose)
        return not self.moving and self._is_near(pose)

    def _is_near(self, pose: Array) -> bool:
        return bool(np.linalg.norm(self.pose[:3, 3] - pose[:3, 3]) < HAS_ARRIVED_LENGTH)

    # --- what clients order -----------------------------------------------------------------

    def stop(self, joint: int | None = None) -> None:
        """Hold one joint where the reference is, or the arm where it is itself.

        A worn arm is far behind its reference.
        """
        under_way = self.on_its_way or not self._settled
        self._motion.hold(joint)
        if joint is None and under_way:
            self._stay()
            self._since, self._settled, self._stopped = None, False, True

    def pause(self) -> None:
        """Hold where the reference is, to go on later."""
        self._motion.paused = True

    def resume(self) -> None:
        """Go on."""
        self._motion.paused = False

    def power(self, on: bool) -> None:
        """Do nothing: the arm has power, and clients may not take it; see `rejoint.robots.serving.server`."""

    def enable(self, wanted: Mask) -> None:
        """Do nothing: all servos hold, and clients may not release them."""

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
        """Return a posture (n,) [rad] that the motors hold; None where none was found at once."""
        found = choose_postures(self.arm, pose[None, :3, 3], start, turn=turn, motors=self._motors, thorough=False)
        return None if found.refusals[0] else found.q[0]

    def _too_heavy(self, angles: Array) -> tuple[int | None, str]:
        """Return the joint whose motor cannot hold ``angles`` (n,) [rad], and why; None where all can."""
        if self._motors is None:
            return None, ""
        return too_heavy(self.arm, self._apparent.measured(angles), self._motors.limit)

    def _is_clear(self, angles: Array) -> bool:
        """Whether motors and guard allow the arm at ``angles`` (n,) [rad].

        In contact it may go nearer to what is clear.
        """
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
