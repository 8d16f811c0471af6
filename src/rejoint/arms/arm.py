"""A serial arm: fixed transforms and revolute axes, limits and masses.

Joint i has the frame ``offset[i] @ Rot(axis[i], q[i])`` in the frame of joint i-1 (joint 0: the base). Link i moves
with joint i. ``tip`` is the tool centre point (TCP) in the last frame.
"""

from dataclasses import dataclass, fields
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rejoint.system.errors import InputError
from rejoint.system.numbers import FARTHEST_PLACE
from rejoint.system.records import Readable, value_type

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Index = NDArray[np.intp]


POINT = 1e-3
"""[m] from the resting TCP to the sides of a box that is no region (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Box:
    """An axis-aligned region in the base frame."""

    lower: Array
    """(3,) [m]"""
    upper: Array
    """(3,) [m]"""

    def __post_init__(self) -> None:
        freeze(self)
        if self.ends.size != 6 or np.abs(self.ends).max() > FARTHEST_PLACE or (self.lower >= self.upper).any():
            raise InputError(f"a box needs lower < upper on three axes, in metres, got {self.lower}, {self.upper}")

    @property
    def ends(self) -> Array:
        """(6,) [m] lower, then upper corner."""
        return np.append(self.lower, self.upper)

    @property
    def middle(self) -> Array:
        """(3,) [m]."""
        return 0.5 * (self.lower + self.upper)

    @property
    def is_point(self) -> bool:
        """Whether it is the place of an arm without a region."""
        return bool((self.upper - self.lower).max() < 3.0 * POINT)

    def sample(self, rng: np.random.Generator, shape: tuple[int, ...] = ()) -> Array:
        """Draw points uniformly, ``(*shape, 3)`` [m]."""
        return rng.uniform(self.lower, self.upper, (*shape, 3))

    def grid(self, per_edge: int) -> Array:
        """Points (per_edge^3, 3) [m] of a grid."""
        return np.array([*product(*np.linspace(self.lower, self.upper, per_edge).T)])


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Arm(Readable):
    """A serial arm of n revolute joints."""

    name: str
    joint_names: tuple[str, ...]
    offset: Array
    """(n, 4, 4) to each joint frame at zero"""
    axis: Array
    """(n, 3) unit vectors in the joint frames"""
    tip: Array
    """(4, 4) in the last joint frame"""
    lower: Array
    """(n,) [rad]"""
    upper: Array
    """(n,) [rad]"""
    max_speed: Array
    """(n,) [rad/s]"""
    mass: Array
    """(n,) [kg]"""
    com: Array
    """(n, 3) [m] in the joint frames"""
    inertia: Array
    """(n, 3, 3) [kg m^2] about the centres of mass, joint-frame axes"""
    rest: Array
    """(n,) [rad] start of trials, and of the null space's pull"""
    targets: Box
    """region of targets"""
    floor: float
    """[m] lowest TCP"""
    encoder_step: float
    """[rad] resolution"""
    servo_acceleration: float = np.inf
    """[rad/s^2] limit of the servos' reference; infinite: unknown"""
    servos: tuple[str, ...] = ()
    """(n,) type and gains; empty: unknown"""
    keep_out: tuple[Box, ...] = ()
    """base frame, forbidden"""

    def __post_init__(self) -> None:
        freeze(self)
        n = len(self.joint_names)
        shapes = {
            "offset": (n, 4, 4),
            "axis": (n, 3),
            "tip": (4, 4),
            "com": (n, 3),
            "inertia": (n, 3, 3),
        }
        shapes |= dict.fromkeys(("lower", "upper", "max_speed", "mass", "rest"), (n,))
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise InputError(f"arm {self.name}: {name} has shape {getattr(self, name).shape}, expected {shape}")
        if len(self.servos) not in (0, n):
            raise InputError(
                f"arm {self.name}: {len(self.servos)} servos, expected one for each of {n} joints, or none"
            )
        if np.isnan([box.ends for box in self.keep_out]).any():
            raise InputError(
                "keep_out: a box has a corner that is no number; give its lower and upper corner in metres"
            )
        if (self.lower >= self.upper).any():
            raise InputError(f"arm {self.name}: every lower joint limit must be below the upper one")
        if ((self.rest < self.lower) | (self.rest > self.upper)).any():
            raise InputError(f"arm {self.name}: the rest posture is outside the joint limits")

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.joint_names)

    @property
    def endless(self) -> Mask:
        """(n,) joints without known limits, which have +-180 deg."""
        return (self.upper == np.pi) & (self.lower == -np.pi)

    def drawn(self, count: int, seed: int = 0) -> Array:
        """Draw postures (count, n) [rad] within the limits."""
        return np.random.default_rng(seed).uniform(self.lower, self.upper, (count, self.joints))

    def __repr__(self) -> str:
        return f"Arm({self.name!r} with the joints {', '.join(self.joint_names)})"


def differing(one: Arm, other: Arm) -> tuple[str, ...]:
    """Fields that differ beyond rounding, without `Arm.keep_out`."""
    found = []
    for name in Arm.__dataclass_fields__:
        values = (getattr(arm, name) for arm in (one, other))
        first, second = (value.ends if isinstance(value, Box) else value for value in values)
        if isinstance(first, str | tuple):
            same = first == second
        else:
            same = np.shape(first) == np.shape(second) and np.allclose(first, second, rtol=1e-6, atol=1e-12)
        if name != "keep_out" and not same:
            found.append(name)
    return tuple(found)


def dh_chain(rows: Array) -> tuple[Array, Array, Array]:
    """``offset`` (n, 4, 4), ``axis`` (n, 3) and ``tip`` (4, 4) of a standard Denavit-Hartenberg table.

    ``rows`` (n, 4): d [m], a [m], alpha [rad], offset [rad] of Rz(q + offset) Tz(d) Tx(a) Rx(alpha).
    """
    offsets, before = [], np.eye(4)
    for d, a, alpha, offset in rows:
        offsets.append(before @ _about(offset, 0, 1))
        before = _about(alpha, 1, 2)
        before[:3, 3] = a, 0.0, d
    return np.array(offsets), np.tile([0.0, 0.0, 1.0], (len(rows), 1)), before


def _about(angle: float, one: int, other: int) -> Array:
    """Pose (4, 4) turned by ``angle`` [rad] in the plane of two axes."""
    pose = np.eye(4)
    pose[one, one] = pose[other, other] = np.cos(angle)
    pose[other, one] = np.sin(angle)
    pose[one, other] = -pose[other, one]
    return pose


def frozen(array: ArrayLike) -> NDArray[Any]:
    """Contiguous read-only copy, as compiled loops need."""
    result = np.array(array, order="C")
    result.setflags(write=False)
    return result


def freeze(instance: object) -> None:
    """Replace the arrays of a frozen dataclass by read-only copies."""
    for field in fields(instance):  # type: ignore[arg-type]
        value = getattr(instance, field.name)
        if isinstance(value, np.ndarray | list):
            object.__setattr__(instance, field.name, frozen(np.asarray(value, dtype=float)))


@value_type
class Loaded(Readable):
    """An arm and its assumptions."""

    arm: Arm
    notes: tuple[str, ...] = ()
    """a sentence per missing or wrong value"""


UNKNOWN = Box(lower=np.full(3, np.nan), upper=np.full(3, np.nan))
"""Targets of an unfinished arm"""


MODELS = Path(__file__).parent / "models"
"""Descriptions of the catalogue's arms"""


def mycobot280() -> Arm:
    """Return the myCobot 280 Pi."""
    return described("mycobot280")


def so101() -> Arm:
    """Return the SO-101, joints named as in LeRobot."""
    return described("so101")


@cache
def described(name: str) -> Arm:
    """Return an arm of the catalogue."""
    from rejoint.arms.loading import finish, read_draft  # late: what is left open goes by the measures of a myCobot

    return finish(read_draft(MODELS / f"{name}.toml")).arm
