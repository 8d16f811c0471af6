"""Cuts a serial chain out of a tree; all others are frozen."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms.arm import Array
from rejoint.arms.draft import Draft
from rejoint.arms.inertia import NOTHING, SpatialInertia, combined
from rejoint.arms.rotations import inverse, pose_of, rotation_about
from rejoint.system.errors import InputError


def cut(tree: Tree, base: str | None, tip: str | None) -> Draft:
    """Draft of the chain from body ``base`` to the body or site ``tip``.

    Default ``tip``: last link of the longest chain of hinges without a gripper; default ``base``: the root. Slides are
    held; other bodies add mass to their link. InputError for unknown names, an ambiguous choice, or a joint that can be
    neither driven nor held.
    """
    notes = list(tree.notes)
    start = None if base is None else body_called(tree, base, "body")
    end = longest(tree, start, notes) if tip is None else body_called(tree, tip, "body or site")
    if start is None:
        start = root_of(tree, end, notes)
    path = tree.path(end)
    if start != WORLD and start not in path:
        raise InputError(f"{tip} does not hang below {base}; the bodies above it are: {tree.names(path)}")
    links = path if start == WORLD else path[path.index(start) + 1 :]
    joints = _hinges(tree, tree.joints_of(links), f"{tree.bodies[start].name} and {tree.bodies[end].name}", notes)
    frame = tree.bodies[start].pose
    if frame[2, 2] < 1 - 1e-9:
        tilt = np.degrees(np.arccos(np.clip(frame[2, 2], -1.0, 1.0)))
        notes.append(
            f"base: {tree.bodies[start].name} is tilted by {tilt:.0f} deg in the file; gravity, floor and targets are "
            "taken as if it stood upright, which is right only where the arm itself does"
        )
    return _draft(tree, joints, frame, tree.bodies[end].pose, notes)


def _draft(tree: Tree, joints: list[Joint], frame: Array, tip: Array, notes: list[str]) -> Draft:
    """``frame`` of the base and ``tip``: (4, 4) in the world."""
    offsets, axes, before = [], [], frame
    poses = []
    for joint in joints:
        pose = pose_of(tree.bodies[joint.body].pose[:3, :3], joint.anchor)
        axis = pose[:3, :3].T @ joint.axis
        back = pose_of(rotation_about(axis, -joint.position), np.zeros(3))
        offsets.append(inverse(before) @ pose @ back)
        axes.append(axis)
        poses.append(pose)
        before = pose
    return Draft(
        name=tree.name,
        joint_names=tuple(joint.name for joint in joints),
        offset=np.array(offsets),
        axis=np.array(axes),
        tip=inverse(before) @ tip,
        lower=np.array([joint.lower for joint in joints]),
        upper=np.array([joint.upper for joint in joints]),
        max_speed=np.array([joint.speed for joint in joints]),
        links=_links(tree, joints, poses),
        notes=tuple(notes),
    )


def _links(tree: Tree, joints: list[Joint], poses: list[Array]) -> tuple[SpatialInertia, ...]:
    carriers = {joint.body: i for i, joint in enumerate(joints)}  # of several joints of a body the last carries it
    owner: dict[int, int] = {}
    pieces: list[list[SpatialInertia]] = [[] for _ in joints]
    for index, body in enumerate(tree.bodies[1:], start=1):
        if index in carriers:
            owner[index] = carriers[index]
        elif body.parent in owner:
            owner[index] = owner[body.parent]
        if index in owner:
            pose = inverse(poses[owner[index]]) @ body.pose
            pieces[owner[index]].append(body.content.seen_from(pose))
    return tuple(combined(piece) for piece in pieces)


def _hinges(tree: Tree, joints: list[Joint], between: str, notes: list[str]) -> list[Joint]:
    driven = [joint for joint in joints if joint.kind == "hinge"]
    for joint in joints:
        if joint.kind == "slide":
            notes.append(_slide_held(joint))
        elif joint.kind not in ("hinge", "held"):
            raise InputError(
                f"{tree.name}: joint {joint.name} between {between} is a {joint.kind} joint, and only revolute joints "
                f"of their own can be driven; choose a base and a tip with it outside of the chain{_follower(joint)}"
            )
        elif joint.follows in {other.name for other in driven}:
            raise InputError(
                f"{tree.name}: joint {joint.name} cannot be held alone: it follows {joint.follows}, which is driven"
                f"{_follower(joint)}"
            )
    if not driven:
        raise InputError(f"{tree.name}: there is no revolute joint between {between}; choose another base or tip")
    return driven


def _follower(joint: Joint) -> str:
    if not joint.follows:
        return ""
    return f", or hold it with the joint that it follows: --hold {joint.name}=0deg,{joint.follows}=0deg"


def _slide_held(joint: Joint) -> str:
    ends = (joint.lower, joint.upper)
    span = f" ({1e3 * ends[0]:.0f} to {1e3 * ends[1]:.0f} mm)" if np.isfinite(ends).all() else ""
    place = f"{1e3 * joint.position:.0f}"
    return (
        f"joint {joint.name} slides{span} and is not driven, only revolute joints are; it is taken as fixed at {place} "
        f"mm, which the arm has to keep; if it stands elsewhere: --hold {joint.name}={place}mm"
    )


_GRIPPER = re.compile("grip|jaw|finger|claw", re.IGNORECASE)
"""Joints of grippers (URDFs of SO-100, WidowX, Koch)"""

_FLANGE = "tool0"
"""Flange in URDFs of ROS-Industrial"""

_TOOL = re.compile(r"tool|tcp|grasp|end_?effector|(^|_)eef?(_|$)", re.IGNORECASE)
"""Tool frames (URDFs of Universal Robots, Kinova, PAL, Franka Emika)"""

_ACROSS = 1e-6
"""Largest product of orthogonal unit vectors (rounding)"""


def body_called(tree: Tree, name: str, kind: str) -> int:
    """Index of a body or site; InputError."""
    names = [body.name for body in tree.bodies]
    if name not in names:
        raise InputError(unknown(name, kind, names))
    return names.index(name)


def root_of(tree: Tree, end: int, notes: list[str]) -> int:
    """First body of the arm to ``end``: the root, the load of a mobile base, or the world."""
    path = tree.path(end)
    moving = _mobile_base(tree.joints_of(path))
    if moving:
        root = moving[-1].body
        names = ", ".join(joint.name for joint in moving)
        notes.append(f"base: none given; {tree.bodies[root].name} taken; {names} before it move all of it")
        return root
    first = path[0] if path else WORLD
    root = WORLD if any(joint.kind not in ("free", "slide") for joint in tree.joints_of([first])) else first
    notes.append(f"base: none given; {tree.bodies[root].name} taken, the root of the tree")
    return root


def longest(tree: Tree, start: int | None, notes: list[str]) -> int:
    """Last link of the longest chain of hinges below ``start`` (None: anywhere), without gripper."""
    hinges, slid = _chains(tree, start)
    parents = {tree.bodies[index].parent for index in hinges if index not in (start, WORLD) and not slid[index]}
    leaves = [index for index in hinges if index not in parents and not slid[index]]
    most = max((hinges[index] for index in leaves), default=0)
    ends = [index for index in leaves if hinges[index] == most]
    if most == 0:
        found = tree.names(index for index in hinges if not slid[index])
        raise InputError(f"{tree.name}: no chain of hinges was found; the bodies are: {found}")
    carriers = {index: _carrier(tree, index) for index in ends}
    if len(set(carriers.values())) > 1:
        chosen = [_frame(tree, [i for i in ends if carriers[i] == body]) for body in dict.fromkeys(carriers.values())]
        names = tree.names(chosen)
        raise InputError(
            f"{tree.name}: several links could be the tip of the arm ({most} joints each): {names}; name the tip"
        )
    end = _frame(tree, ends)
    others = [tree.bodies[index].name for index in ends if index != end]
    others += [body.name for body in tree.bodies if body.site and body.parent in (end, *ends)]
    more = f" (beside it are {', '.join(others)}, which can be named instead)" if others else ""
    notes.append(f"tip: none given; {tree.bodies[end].name} taken, the end of the longest chain{more}")
    beyond = [
        joint.name for joint in tree.joints if joint.kind == "hinge" and tree.bodies[joint.body].parent in (end, *ends)
    ]
    if beyond:
        notes.append(f"tip: {', '.join(beyond)} behind it taken for a gripper's and held; name a tip to drive it")
    return end


def unknown(name: str, kind: str, names: Sequence[str]) -> str:
    """Report an unknown name."""
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    shown = [known for known in names if known][:40]
    return f"the model has no {kind} called {name!r}; {hint}it has: {', '.join(shown)}"


def _chains(tree: Tree, start: int | None) -> tuple[dict[int, int], dict[int, bool]]:
    hinges: dict[int, int] = {}
    slid: dict[int, bool] = {}
    for index, body in enumerate(tree.bodies):
        if body.site:
            continue
        if index in (WORLD, start):
            if start is None or index == start:
                hinges[index], slid[index] = 0, False
            continue
        own = tree.joints_of([index])
        floating = start is None and body.parent == WORLD and [joint.kind for joint in own] == ["free"]
        if body.parent in hinges and (floating or all(_passable(tree, joint) for joint in own)):
            hinges[index] = hinges[body.parent] + sum(joint.kind == "hinge" for joint in own)
            slid[index] = own[-1].kind == "slide" if own else slid[body.parent]
    return hinges, slid


def _passable(tree: Tree, joint: Joint) -> bool:
    """Whether a chain goes on behind a joint: not behind those of grippers, which lead joints of other branches."""
    leads = any(other.follows == joint.name and joint.body not in tree.path(other.body) for other in tree.joints)
    gripper = leads or _GRIPPER.search(joint.name)
    return joint.kind == "held" or (joint.kind in ("hinge", "slide") and not gripper)


def _carrier(tree: Tree, end: int) -> int:
    return next((index for index in tree.path(end)[::-1] if tree.joints_of([index])), WORLD)


def _frame(tree: Tree, ends: list[int]) -> int:
    names = [tree.bodies[index].name for index in ends]
    if _FLANGE in names:
        return ends[names.index(_FLANGE)]
    tools = [index for index, name in zip(ends, names, strict=True) if _TOOL.search(name)]
    if len(ends) == 1 or len(tools) == 1:
        return (tools or ends)[0]
    return [bodies[0] for bodies in zip(*map(tree.path, ends), strict=False) if len(set(bodies)) == 1][-1]


def _mobile_base(joints: list[Joint]) -> list[Joint]:
    moving: list[Joint] = []
    for joint in joints:
        across = all(abs(float(joint.axis @ other.axis)) < _ACROSS for other in moving)
        if not across or joint.kind not in (("slide", "hinge") if len(moving) == 2 else ("slide",)):
            break
        moving.append(joint)
    return moving if len(moving) > 1 else []


WORLD = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class ModelBody:
    """A rigid body, or a named frame of one."""

    name: str
    parent: int
    pose: Array
    """(4, 4) in the world"""
    content: SpatialInertia = NOTHING
    """in the body frame"""
    site: bool = False
    """a named frame without mass"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Joint:
    """A joint between a body and its parent."""

    name: str
    kind: str
    """``hinge``, ``slide``, ``ball``, ``free``, ``coupled`` (to another joint) or ``held`` (by the user)"""
    body: int
    anchor: Array
    """(3,) [m] point of the axis, in the world"""
    axis: Array
    """(3,) unit vector in the world"""
    position: float
    """[rad], [m] of a slide"""
    lower: float
    upper: float
    """[rad], [m] of a slide; NaN: none"""
    speed: float
    """[rad/s], NaN: none"""
    follows: str = ""
    """leading joint, or empty"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Tree:
    """Bodies; body 0 is the world, parents first, sites last."""

    name: str
    bodies: tuple[ModelBody, ...]
    joints: tuple[Joint, ...]
    """in order per body"""
    notes: tuple[str, ...] = ()

    def path(self, body: int) -> list[int]:
        """Bodies from a root to ``body``."""
        found = []
        while body != WORLD:
            found.append(body)
            body = self.bodies[body].parent
        return found[::-1]

    def joints_of(self, bodies: Iterable[int]) -> list[Joint]:
        """Joints in order."""
        return [joint for body in bodies for joint in self.joints if joint.body == body]

    def names(self, bodies: Iterable[int]) -> str:
        """Names."""
        return ", ".join(self.bodies[index].name for index in bodies)
