"""How an arm is drawn: one capsule along each link, in the frame of the joint that it moves with.

They are the capsules by which the guard sees contacts (`rejoint.arms.collision`). A scene that nests every joint's
frame in the one before needs nothing but the turns of the joints; the places of the frames in each other do not change.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.collision import collision_shape
from rejoint.arms.rotations import quaternion_of

Colour = tuple[int, int, int]

LINKS: tuple[Colour, Colour] = (214, 219, 225), (168, 179, 192)
"""of the arm's links, in turns, so that they are told apart"""
GHOST: Colour = (47, 111, 237)
TRAIL: Colour = (235, 120, 30)
TARGET: Colour = (30, 160, 90)
TRUE: Colour = (200, 30, 160)
"""of the tool itself, as far as it is known"""
NARROWER = 0.97
"""Thickness of every other link, by that of its neighbours: caps in the same place flicker (chosen)"""
TOOL_SHARE = 0.3
"""Thickness of the tool as it is drawn, by that of a link (chosen: the target shows beside it)"""


def cell_of(size: float) -> float:
    """[m] edge of the squares on the ground under an arm that reaches ``size`` [m]."""
    return 0.05 if size < 1.0 else 0.1


def css(colour: Colour) -> str:
    """Write a colour as style sheets have it."""
    return f"rgb{colour}"


@dataclass(frozen=True, kw_only=True, eq=False)
class Skeleton:
    """The parts of an arm of n joints; link 0 is its base, link i + 1 moves with joint i."""

    end: Array
    """(n + 1, 3) [m] where each link ends, in the frame that it moves with; it begins at the origin of that"""
    place: Array
    """(n, 3) [m] origin of each joint frame in the one before"""
    axis: Array
    """(n, 3) joint axes in the joint frames"""
    zero: Array
    """(n, 4) orientation of each joint frame in the one before with the joint at 0: quaternions, w first"""
    radius: float
    """[m] of all capsules"""

    def shape(self, link: int) -> tuple[Array, float]:
        """Where the capsule of a link ends (3,) [m] that begins at the origin of its frame, and its radius [m].

        That of the tool is thinner than the guard takes it to be, and its cap ends at the TCP, so that one sees where
        this is.
        """
        if link < len(self.place):
            return self.end[link], self.radius * (1.0 if link % 2 else NARROWER)
        thin, length = TOOL_SHARE * self.radius, float(np.linalg.norm(self.end[link]))
        return self.end[link] * max(1.0 - thin / length, 0.0) if length > thin else self.end[link], thin

    @staticmethod
    def of(arm: Arm) -> Skeleton:
        """Derive it from the arm's description."""
        place = arm.offset[:, :3, 3]
        return Skeleton(
            end=np.vstack([place, arm.tip[:3, 3]]), place=place, axis=arm.axis,
            zero=np.array([quaternion_of(offset[:3, :3]) for offset in arm.offset]), radius=collision_shape(arm).radius,
        )  # fmt: skip

    def turns(self, q: Array) -> Array:
        """Orientations (n, 4) of the joint frames, each in the one before, at ``q`` (n,) [rad]: w first."""
        half = 0.5 * q
        w, x = self.zero[:, 0], self.zero[:, 1:]
        c, s = np.cos(half), np.sin(half)[:, None] * self.axis
        turned = np.empty((len(q), 4))
        turned[:, 0] = w * c - (x * s).sum(axis=1)
        turned[:, 1:] = w[:, None] * s + c[:, None] * x + np.cross(x, s)
        return turned


def capsule(end: Array, radius: float, share: float = 1.0, sides: int = 20, rings: int = 6) -> tuple[Array, Array]:
    """Return vertices (v, 3) [m] and triangles (f, 3), seen from outside, of a capsule from the origin to ``end`` (3,).

    All in [m]; it is as thick as a ``share`` of ``radius``, has ``sides`` about its axis, and ``rings`` in each cap.
    """
    radius = share * radius
    length = float(np.linalg.norm(end))
    up = end / length if length > 1e-9 else np.array([0.0, 0.0, 1.0])
    side = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    side /= np.linalg.norm(side)
    across = np.cross(up, side)
    tilt = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 2 * rings)
    along = radius * np.sin(tilt) + np.where(np.arange(2 * rings) < rings, 0.0, length)
    round_ = 2.0 * np.pi * np.arange(sides) / sides
    wide = radius * np.cos(tilt)[:, None, None]
    circle = np.cos(round_)[:, None] * side + np.sin(round_)[:, None] * across
    vertices = (along[:, None, None] * up + wide * circle).reshape(-1, 3)
    one, two = np.divmod(np.arange((2 * rings - 1) * sides), sides)
    a, b = one * sides + two, one * sides + (two + 1) % sides
    return vertices, np.concatenate([np.stack([a, b, b + sides], 1), np.stack([a, b + sides, a + sides], 1)])
