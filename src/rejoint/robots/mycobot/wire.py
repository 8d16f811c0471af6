"""The myCobot's wire: frames, numbers (big-endian signed 16-bit, truncated), and answers to requests.

A frame is ``FE FE LEN ID payload FA``, LEN = payload bytes + 2. Angles x100 [deg], positions x10 [mm], joint limits x10
[deg]. One byte acknowledges an order; malformed requests get no answer. Source: elephantrobotics/mycobot_docs,
18-communication, and pymycobot 4.0.7.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rejoint.arms import Arm, Array, Mask, tcp_pose
from rejoint.arms.rotations import difference, moved, to_coords, to_pose
from rejoint.robots.mycobot.motion import FULL_SPEED, Motion, TimedPath, joint_path, line_path, solve_pose
from rejoint.robots.wireserver import Format
from rejoint.system.files import read_shipped

ANGLE_SCALE = 100.0
LENGTH_SCALE = 10.0
LIMIT_SCALE = 10.0

ENCODER_ZERO = 2048
"""at joint angle zero (vendor's calibration examples)"""

_POSE_SCALE = np.array([LENGTH_SCALE * 1e3] * 3 + [np.degrees(1.0) * ANGLE_SCALE] * 3)
_SAME = 6


def pack_int16(values: ArrayLike) -> bytes:
    """Truncate towards zero, clip to 16 bit and pack."""
    whole = np.trunc(np.round(np.asarray(values, dtype=float), _SAME))
    return np.clip(whole, -32768, 32767).astype(">i2").tobytes()


def unpack_int16(payload: bytes) -> Array:
    """Inverse of `pack_int16`; (k,) for 2k bytes."""
    return np.frombuffer(payload, dtype=">i2").astype(float)


def pack_bytes(values: Iterable[float]) -> bytes:
    """Truncate and clip every value to one unsigned byte."""
    return bytes(int(np.clip(value, 0, 255)) for value in values)


def pack_angles(angles: Array) -> bytes:
    """Joint angles (n,) [rad]."""
    return pack_int16(np.degrees(angles) * ANGLE_SCALE)


def unpack_angles(payload: bytes) -> Array:
    """Joint angles (n,) [rad]."""
    return np.radians(unpack_int16(payload) / ANGLE_SCALE)


def pack_coords(pose: Array) -> bytes:
    """TCP pose (4, 4) as position and orientation."""
    return pack_int16(to_coords(pose) * _POSE_SCALE)


def unpack_coords(payload: bytes) -> Array:
    """Inverse of `pack_coords`."""
    return to_pose(unpack_int16(payload) / _POSE_SCALE)


def pack_encoders(angles: Array, step: float) -> bytes:
    """Joint angles (n,) [rad] as encoder counts of ``step`` [rad]."""
    return pack_int16(ENCODER_ZERO + np.round(angles / step))


HEADER = b"\xfe\xfe"
FOOTER = 0xFA
MAX_PAYLOAD = 28
"""[bytes] that the client's reader accepts"""

_OVERHEAD = 2
"""[bytes] command id and footer in LEN"""


class Frame(NamedTuple):
    """One command or reply of at most `MAX_PAYLOAD` bytes."""

    command: int
    payload: bytes = b""


def encode(frame: Frame) -> bytes:
    """Bytes of a frame."""
    return HEADER + bytes((len(frame.payload) + _OVERHEAD, frame.command)) + frame.payload + bytes((FOOTER,))


def _size(head: bytes) -> int:
    return head[2] + 3 if _OVERHEAD <= head[2] <= MAX_PAYLOAD + _OVERHEAD else 0


def _read(data: bytes) -> Frame | None:
    return Frame(data[3], data[4:-1]) if data[-1] == FOOTER else None


FORMAT = Format(HEADER, 3, _size, _read, encode)


_JOG_LENGTH = 0.6
"""[m] beyond any reach"""
_JOG_TURN = np.radians(175.0)


NO_SOLUTION, NO_LINE, COLLISION = 32, 33, 16
"""Error codes of the vendor's ``get_error_information``; 1..6: joint over its limit; 16: any contact"""
ARRIVED_ANGLE, ARRIVED_LENGTH = np.radians(1.0), 0.003
"""[rad], [m] (chosen)"""


def at(here: Array, goal: Array) -> bool:
    """Whether angles (n,) [rad] are within a degree of a goal, or a pose (4, 4) within 3 mm and a degree."""
    if goal.ndim == 1:
        return (np.abs(here - goal) < ARRIVED_ANGLE).all()
    shift, turn = np.linalg.norm(difference(here, goal).reshape(2, 3), axis=1)
    return shift < ARRIVED_LENGTH and turn < ARRIVED_ANGLE


class Sensed(NamedTuple):
    """What the servos measure, (n,) each."""

    speed: Array
    """[rad/s]"""
    current: Array
    """[A]"""
    voltage: Array
    """[V]"""
    temperature: Array
    """[deg C]"""
    alarms: NDArray[np.uint8]
    """status bits"""


class Computer(ABC):
    """Computer of an arm of n joints, at ``start`` (n,) [rad]; a command returns False where it is refused."""

    powered = True

    def __init__(self, arm: Arm, start: Array) -> None:
        self.arm = arm
        self.enabled = np.ones(arm.joints, dtype=bool)
        """(n,)"""
        self.lower, self.upper = arm.lower.copy(), arm.upper.copy()
        self.fresh = False
        """a new move replaces the present one, else is queued"""
        self.error = 0
        """as in ``get_error_information``"""
        self.motion = Motion(start)

    @property
    @abstractmethod
    def angles(self) -> Array:
        """(n,) [rad] measured."""

    @property
    @abstractmethod
    def moving(self) -> bool:
        """Whether a move is under way."""

    @property
    @abstractmethod
    def sensed(self) -> Sensed:
        """What else is measured."""

    @abstractmethod
    def stop(self, joint: int | None = None) -> None:
        """Hold: one joint, or the arm."""

    def pause(self, on: bool) -> None:
        """Hold where the reference is, or continue."""
        self.motion.paused = on

    def power(self, on: bool) -> None:  # noqa: B027 - nothing is a sensible answer
        """Power all servos."""

    def enable(self, wanted: Mask) -> None:  # noqa: B027 - nothing is a sensible answer
        """Hold with the servos in ``wanted`` (n,); release the others."""

    def calibrate(self, joint: int) -> None:  # noqa: B027 - nothing is a sensible answer
        """Set a joint's zero here."""

    @property
    def pose(self) -> Array:
        """(4, 4) TCP pose."""
        return self.pose_at(self.angles)

    def is_at(self, goal: Array) -> bool:
        """Whether the arm is at angles (n,) [rad], or its TCP at a pose (4, 4), as `at`."""
        return at(self.angles if goal.ndim == 1 else self.pose, goal)

    @property
    def planned_angles(self) -> Array:
        """(n,) [rad]."""
        return self.motion.reference.copy()

    @property
    def destination(self) -> Array:
        """(n,) [rad]."""
        return self.motion.end

    def move_joints(self, angles: Array, rate: float) -> bool:
        """Move to ``angles`` (n,) [rad]; False beyond a limit."""
        inside = (angles >= self.lower - 1e-9) & (angles <= self.upper + 1e-9)
        if not inside.all():
            self.error = int(np.argmin(inside)) + 1
            return False
        if not self._is_clear(angles) or not self._ready():
            return False
        if not self.fresh:
            return self.motion.enqueue(joint_path(self.destination, angles), rate)
        self.motion.ramp(angles, rate)
        self._write(rate * FULL_SPEED, angles)
        return True

    def move_tool(self, pose: Array, rate: float, mode: int = 0, *, turned: bool = True) -> bool:
        """Bring the tool to ``pose`` (4, 4), in ``mode`` 1 straight; False, and an error code, where no posture does.

        Without ``turned`` orientation is kept where possible.
        """
        start = self.planned_angles if self.fresh else self.destination
        if mode != 1:
            goal = self._posture(pose, start, turned=turned)
            if goal is None:
                self.error = NO_SOLUTION
            return goal is not None and self.move_joints(goal, rate)
        path, complete = line_path(self.arm, start, pose)
        if not self._is_clear(path.points[-1]):
            return False
        if not complete or self._reach(path) < len(path.points):
            self.error = NO_LINE
            return False
        return self._ready() and self.motion.enqueue(path, rate, now=self.fresh)

    def jog_joint(self, joint: int, forwards: int, rate: float) -> bool:
        """Run one joint to its limit or a stop."""
        goal = self.planned_angles
        goal[joint] = self.upper[joint] if forwards else self.lower[joint]
        return self._jog(joint_path(self.planned_angles, np.clip(goal, self.lower, self.upper)), rate)

    def _jog(self, path: TimedPath, rate: float) -> bool:
        reach = self._reach(path)
        if reach < 2:
            self.error = NO_LINE
            return False
        within = TimedPath(path.points[:reach], path.time[:reach])
        return self._ready() and self.motion.enqueue(within, rate, now=True)

    def joint_index(self, identity: int) -> int | None:
        """Index of joint 1..n on the wire; None: another servo."""
        return identity - 1 if 1 <= identity <= self.arm.joints else None

    def clear_error(self) -> None:
        """Forget the last error."""
        self.error = 0

    def set_fresh(self, fresh: int) -> None:
        """Let new moves replace the present one, or wait."""
        self.fresh = fresh == 1

    def release(self, free: int, *_: int) -> None:
        """Let go of all joints, or hold them."""
        self.enable(np.full(self.arm.joints, self.powered and not free))

    def switch(self, on: bool, identity: int, _: int = 0) -> bool:
        """Switch one servo, or by 0 all."""
        joint = self.joint_index(identity)
        if (joint is None and identity != 0) or (on and not self.powered):
            return False
        wanted = self.enabled.copy()
        wanted[slice(None) if joint is None else joint] = on
        self.enable(wanted)
        return True

    def move_joint(self, relative: bool, joint: int, angle: float, rate: float) -> bool:
        """Move one joint to, or by, an ``angle`` [rad]."""
        angles = self.destination
        angles[joint] = angle + (angles[joint] if relative else 0.0)
        return self.move_joints(angles, rate)

    def move_axis(self, relative: bool, number: int, value: float, rate: float) -> bool:
        """Move the tool along or about an axis."""
        axis = number - 1
        if not 0 <= axis < 6:
            return False
        coords = to_coords(self.pose_at(self.destination))
        coords[axis] = value / _POSE_SCALE[axis] + (coords[axis] if relative else 0.0)
        return self.move_tool(to_pose(coords), rate, turned=axis >= 3)

    def jog_axis(self, first: int, number: int, forwards: int, rate: float) -> bool:
        """Run the tool straight along or about an axis; x has the number ``first``."""
        axis = number - first
        if not 0 <= axis < 6:
            return False
        change = np.zeros(6)
        change[axis] = (1.0 if forwards else -1.0) * (_JOG_LENGTH if axis < 3 else _JOG_TURN)
        return self._jog(line_path(self.arm, self.planned_angles, moved(self.planned_pose(), change))[0], rate)

    def set_limit(self, upper: bool, joint: int, word: float) -> bool:
        """Set a limit of a joint within the arm's own."""
        angle, slack = np.radians(word / LIMIT_SCALE), 1e-9
        lower, higher = (self.lower[joint], angle) if upper else (angle, self.upper[joint])
        if lower >= higher or lower < self.arm.lower[joint] - slack or higher > self.arm.upper[joint] + slack:
            return False
        self.lower[joint], self.upper[joint] = lower, higher
        return True

    def is_own(self, frame: bytes) -> bool:
        """Whether a frame is the arm's own."""
        return not any(frame)

    def colour(self, *_: int) -> None:  # noqa: B027 - there is no lamp
        """Do nothing."""

    def is_limp(self) -> bool:
        """Whether all joints are free under power."""
        return self.powered and not self.enabled.any()

    def servo_enabled(self, servo: int) -> bytes:
        """Return a servo's number, and whether it holds."""
        return bytes((servo,)) + flag(0 < servo <= self.arm.joints and self.enabled[servo - 1])

    def is_there(self, place: bytes, is_pose: int) -> bool:
        """Whether the arm has come to a pose, or to angles."""
        return self.is_at(unpack_coords(place) if is_pose else unpack_angles(place))

    def encoder(self, joint: int | None) -> bytes:
        """Return the encoder count of a joint; -1: no gripper."""
        if joint is None:
            return pack_int16([-1])
        return pack_encoders(self.angles[joint : joint + 1], self.arm.encoder_step)

    def limit(self, upper: bool, joint: int | None) -> bytes | None:
        """Return the number and a limit of a joint."""
        if joint is None:
            return None
        angle = (self.upper if upper else self.lower)[joint]
        return bytes((joint + 1,)) + pack_int16([np.degrees(angle) * LIMIT_SCALE])

    def posture(self, pose: Array, start: Array) -> Array | None:
        """Posture (n,) [rad] of a pose near ``start``, or None."""
        return solve_pose(self.arm, pose, start)

    def pose_at(self, angles: Array) -> Array:
        """TCP pose (4, 4) at ``angles`` (n,) [rad]."""
        return tcp_pose(self.arm, angles)

    def planned_pose(self) -> Array:
        """TCP pose (4, 4) of the reference."""
        return self.pose_at(self.planned_angles)

    def angles_and_coords(self) -> bytes:
        """Both, one after the other."""
        return pack_angles(self.angles) + pack_coords(self.pose)

    def _posture(self, pose: Array, start: Array, *, turned: bool) -> Array | None:  # noqa: ARG002 - always turned here
        """Return a posture (n,) [rad] for a pose (4, 4), or None."""
        return self.posture(pose, start)

    def _is_clear(self, angles: Array) -> bool:  # noqa: ARG002 - the vendor's computer does not look
        """Whether ``angles`` (n,) [rad] are clear; else sets an error code."""
        return True

    def _ready(self) -> bool:
        return True

    def _write(self, speed: float, goal: Array) -> None:  # noqa: B027 - nothing is a sensible answer
        """Send a ramp to ``goal`` (n,) [rad] at ``speed`` [rad/s] to the servos."""

    def _reach(self, path: TimedPath) -> int:
        inside = np.all((path.points >= self.lower) & (path.points <= self.upper), axis=1)
        return int(np.argmin(np.append(inside, False)))


def flag(value: object) -> bytes:
    """One byte."""
    return b"\x01" if value else b"\x00"


SIZES = {**dict.fromkeys("bsjy", 1), **dict.fromkeys("wae", 2), **dict.fromkeys("xAEP", 12)}
"""[bytes] of the parts of a payload"""


def read_part(computer: Computer, part: str, data: bytes) -> Any:  # noqa: ANN401
    """Read a part of a payload."""
    match part:
        case "b":
            return data[0]
        case "s":
            return min(max(data[0], 1), 100) / 100.0
        case "j":
            return computer.joint_index(data[0])
        case "a" | "A":
            found = unpack_angles(data)
        case "e" | "E":
            found = (unpack_int16(data) - ENCODER_ZERO) * computer.arm.encoder_step
        case "w":
            found = unpack_int16(data)
        case "P":
            return unpack_coords(data)
        case _:
            return data
    return found if part.isupper() else found[0]


def write_answer(computer: Computer, kind: str, value: Any) -> bytes:  # noqa: ANN401
    """Write an answer of a kind."""
    match kind:
        case "b":
            return bytes((int(value),))
        case "A":
            return pack_angles(value)
        case "P":
            return pack_coords(value)
        case "E":
            return pack_encoders(value, computer.arm.encoder_step)
        case "v":
            return pack_int16(value / computer.arm.encoder_step)
        case "m":
            return pack_int16(value * 1e3)
        case "d":
            return pack_bytes(value * 10.0)
        case "B":
            return pack_bytes(value)
    return bytes(value)


ORDER = "!"


class Row(NamedTuple):
    """What a command of the wire does."""

    command: int
    parts: str
    call: str
    answer: str
    argument: bool | int | None = None


ROWS = {
    (row.command, sum(SIZES[part] for part in row.parts)): row
    for row in read_shipped(__file__, "commands.toml", dict[str, tuple[Row, ...]])["rows"]
}
"""By command and length of the payload [bytes]"""
COMMANDS = frozenset(row.command for row in ROWS.values() if row.answer == ORDER)
"""Those that order something"""


def answer(computer: Computer, request: Frame) -> Frame | None:
    """Execute ``request``; None: silence."""
    row = ROWS.get((request.command, len(request.payload)))
    if row is None:
        return None
    if not row.call:
        return Frame(request.command, bytes.fromhex(row.answer))
    given, start = [] if row.argument is None else [row.argument], 0
    for part in row.parts:
        given.append(read_part(computer, part, request.payload[start : start + SIZES[part]]))
        start += SIZES[part]
    found = attrgetter(row.call)(computer)
    if row.answer == ORDER:
        return Frame(request.command, flag(all(part is not None for part in given) and found(*given) is not False))
    found = found(*given) if callable(found) else found
    return None if found is None else Frame(request.command, write_answer(computer, row.answer, found))
