"""A model of bodies and joints as a file describes it, in one posture; an arm is a chain that is cut out of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from rejoint.arms.arm import Array
from rejoint.arms.inertia import SpatialInertia

WORLD = 0
"""Index of the world, the parent of every root body."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Body:
    """A rigid body of a tree."""

    name: str
    parent: int
    pose: Array
    """(4, 4) in the world, in the posture of the tree's joints"""
    content: SpatialInertia
    """mass, centre and inertia in the body's frame"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Joint:
    """A joint between a body and its parent."""

    name: str
    kind: str
    """``hinge``, ``slide``, ``ball``, ``free``, ``coupled`` where it follows another joint, or ``held`` where the user
    has said so"""
    body: int
    anchor: Array
    """(3,) [m] a point of the axis, in the world"""
    axis: Array
    """(3,) unit vector in the world"""
    position: float
    """[rad] joint position in the tree's posture; [m] of a slide"""
    lower: float
    upper: float
    """[rad] limits, NaN where there is none; [m] of a slide"""
    speed: float
    """[rad/s] speed limit, NaN where there is none"""
    follows: str = ""
    """joint that moves it where it is coupled, empty where none does"""
    drives: bool = False
    """whether joints of other branches follow it, as the fingers of a gripper follow its motor"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Site:
    """A named frame on a body."""

    name: str
    body: int
    pose: Array
    """(4, 4) in the world"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tree:
    """A whole model in one posture; body 0 is the world, parents come before children."""

    name: str
    bodies: tuple[Body, ...]
    joints: tuple[Joint, ...]
    """in the order in which they act on their body"""
    sites: tuple[Site, ...] = ()
    notes: tuple[str, ...] = ()

    def path(self, body: int) -> list[int]:
        """Bodies from a root down to ``body``, without the world."""
        found = []
        while body != WORLD:
            found.append(body)
            body = self.bodies[body].parent
        return found[::-1]

    def joints_of(self, bodies: Iterable[int]) -> list[Joint]:
        """Joints of the given bodies, in their order."""
        return [joint for body in bodies for joint in self.joints if joint.body == body]

    def names(self, bodies: Iterable[int]) -> str:
        """Names of bodies, for a message."""
        return ", ".join(self.bodies[index].name for index in bodies)
