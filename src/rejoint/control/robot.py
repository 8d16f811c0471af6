"""The interfaces of robots and controllers: B arms, each with its own clock; arrays lead with B."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from rejoint.arms import Arm, Array, Mask
from rejoint.arms.postures import missed_pose
from rejoint.arms.rotations import Orientation
from rejoint.system.records import entity
from rejoint.system.stopping import pause

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True, eq=False)
class JointState:
    """Reading of the joints; None: unknown."""

    time: Array
    """(B,) [s] robot clock"""
    position: Array
    """(B, n) [rad]"""
    age: Array
    """(B,) [s] since the last fresh answer"""
    temperature: Array | None = None
    """(B, n) [deg C]"""
    fault: Mask | None = None
    """(B, n)"""
    trouble: tuple[str, ...] | None = None
    """(n,) servo faults in words"""
    load: Array | None = None
    """(B, n) torque over the largest, -1 to 1, positive with the joint"""
    voltage: Array | None = None
    """(B, n) [V]"""
    elsewhere: Mask | None = None
    """(B,) others moved the arm in a pause"""

    @property
    def known_load(self) -> Array:
        """`load`; NaN where it is unknown."""
        return np.full(self.position.shape, np.nan) if self.load is None else self.load


@runtime_checkable
class Robot(Protocol):
    """One arm, or a batch."""

    @property
    def arm(self) -> Arm:
        """Kinematics, limits and masses."""

    @property
    def address(self) -> str:
        """As the user wrote it."""

    @property
    def count(self) -> int:
        """Number of arms."""

    def read(self) -> JointState:
        """Newest state; RobotError."""

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Send ``command`` (B, n) [rad], wait a period, read; arms not ``active`` (B,) repeat their state."""

    def true_tcp(self) -> Array:
        """Return true tool positions (B, 3) [m]; NaN: unknown."""

    def stop(self) -> None:
        """Hold; the power stays on."""

    def close(self) -> None:
        """Close the connection; the arm holds."""


@runtime_checkable
class Relaying(Protocol):
    """Relays words to other devices on its wire, such as a gripper."""

    def relay(self, command: int, payload: bytes) -> bytes | None:
        """Ask a device; None: no answer."""


def part_of(robot: Robot, kind: type[T]) -> T | None:
    """Find the ``robot`` or wrapped robot of a ``kind``; or None."""
    inner: object = robot
    while inner is not None and not isinstance(inner, kind):
        inner = getattr(inner, "robot", None)
    return inner


@entity
class ControlInput:
    """Inputs of a controller: readings, and where B arms are to be now."""

    state: JointState
    target: Array
    """(B, 3) [m] of the tools, corrected; NaN: the joints alone count"""
    goal: Array
    """(B, n) [rad] of the targets"""
    sent: Array
    """(B, n) [rad] last command, after the guard"""
    since_target: Array
    """(B,) [s] since the goal stopped, 0 on a planned way; along a path since it began"""
    turn: Orientation | None = None
    """(B,) wanted orientations, now; None: any"""
    aim_turn: Orientation | None = None
    """(B,) the same at the end of the way; None: as now"""
    arrived: Mask = field(default_factory=lambda: np.full(1, True))
    """(B,) the goals have stopped"""
    place: Array | None = None
    """(B, 3) [m] recorded target, at the end of the way; None: the tool's at the goal"""
    aim: Array | None = None
    """(B, 3) [m] the same, corrected; None: as ``place``"""
    ahead: Callable[[Array], Array] | None = None
    """goals (k, B, n) [rad] in ``later`` (k, B) [s]; None: as now"""

    def goals(self, later: Array) -> Array:
        """Goals (k, B, n) [rad] in ``later`` (k, B) [s], as far as known."""
        return np.broadcast_to(self.goal, (len(later), *self.goal.shape)) if self.ahead is None else self.ahead(later)


def heeds_turn(controller: object) -> bool:
    """Whether a controller can turn tools."""
    return bool(getattr(controller, "heeds_turn", False))


def turned_off(arm: Arm, inputs: ControlInput) -> Array:
    """Orientation errors (B,) [rad] by the encoders; NaN: none wanted."""
    turn = inputs.aim_turn or inputs.turn
    if turn is None:
        return np.full(len(inputs.since_target), np.nan)
    return missed_pose(arm, inputs.state.position, inputs.target, turn)[1]


@runtime_checkable
class Controller(Protocol):
    """Turns inputs into commands."""

    @property
    def name(self) -> str:
        """Name."""

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Forget old targets of ``where`` (B,)."""

    def command(self, inputs: ControlInput) -> Array:
        """Commands (B, n) [rad]."""


class Stillness:
    """Measures how long joints have stood."""

    def __init__(self, within: Array | float) -> None:
        """``within`` [rad], a number or (n,): the farthest that a joint which stands is from where it came to stand."""
        self._within = within
        self._anchor = self._since = np.zeros((0, 0))

    def look(self, time: Array, position: Array) -> Array:
        """Time (B, n) [s] for which joints at ``position`` (B, n) [rad] have stood; the first call begins."""
        if self._anchor.shape != position.shape:
            self._anchor, self._since = np.full((2, *position.shape), np.nan)
        moved = ~(np.abs(position - self._anchor) <= self._within)
        self._anchor = np.where(moved, position, self._anchor)
        self._since = np.where(moved, time[:, None], self._since)
        return time[:, None] - self._since


@entity
class Servos:
    """Servos of arms, with any leading shape."""

    stiffness: Array
    """(..., n) [N m/rad] the servo's position gain"""
    damping: Array
    """(..., n) [N m s/rad] viscous friction, back-EMF and derivative gain"""
    coulomb: Array
    """(..., n) [N m] dry friction"""
    armature: Array
    """(..., n) [kg m^2] inertia of motor and gears at the joint"""
    torque_limit: Array
    """(..., n) [N m]"""
    offset: Array
    """(..., n) [rad] position without load minus command"""
    delay: Array
    """(...) [s] from a command to reading its first effect"""


BEHIND = 1.0
"""[s] of lost time that is not made up for (chosen)"""


class RobotWrapper:
    """Passes on to ``robot``; what else that can do finds `rejoint.control.robot.part_of`."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.arm, self.address, self.count = robot, robot.arm, robot.address, robot.count

    def read(self) -> JointState:
        """Read."""
        return self.robot.read()

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Step."""
        return self.robot.step(command, active)

    def true_tcp(self) -> Array:
        """(B, 3) [m]."""
        return self.robot.true_tcp()

    def stop(self) -> None:
        """Hold."""
        self.robot.stop()

    def close(self) -> None:
        """Close."""
        self.robot.close()


class WatchedRobot(RobotWrapper):
    """Shows every reading to ``see``, after a step with its command; what that raises ends the motion."""

    def __init__(self, robot: Robot, see: Callable[[JointState, Array | None], object]) -> None:
        super().__init__(robot)
        self._see = see

    def read(self) -> JointState:
        """Read."""
        state = super().read()
        self._see(state, None)
        return state

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Step."""
        state = super().step(command, active)
        self._see(state, command)
        return state


class WallClock(RobotWrapper):
    """Slows virtual time to ``pace()`` simulated seconds per second."""

    def __init__(self, robot: Robot, pace: Callable[[], float]) -> None:
        super().__init__(robot)
        self._pace = pace
        self._due = -np.inf  # [s] of the wall clock, until when the last step is to take
        self._time = 0.0  # [s] of the arm that is farthest

    def step(self, command: Array, active: Mask | None = None) -> JointState:
        """Step, and wait for the time."""
        state = super().step(command, active)
        now, reached = time.monotonic(), float(state.time.max())
        if now - self._due > BEHIND:
            self._due = now
        else:
            self._due += max(reached - self._time, 0.0) / self._pace()
        self._time = reached
        pause(self._due - now)
        return state
