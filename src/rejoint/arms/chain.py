"""Cut a serial chain out of a tree of bodies, and freeze everything else that hangs on it."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rejoint.arms.arm import Array
from rejoint.arms.draft import Draft
from rejoint.arms.inertia import SpatialInertia, combined
from rejoint.arms.rotations import inverse, pose_of, rotation_about
from rejoint.system.errors import InputError

_GRIPPER = re.compile("grip|jaw|finger|claw", re.IGNORECASE)
"""In the name of a joint: it opens and closes a gripper (as named in the URDFs of SO-100, WidowX and Koch arms)."""

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
    """``hinge``, ``slide``, ``ball``, ``free``, or ``coupled`` where it follows another joint"""
    body: int
    anchor: Array
    """(3,) [m] a point of the axis, in the world"""
    axis: Array
    """(3,) unit vector in the world"""
    angle: float
    """[rad] joint position in the tree's posture"""
    lower: float
    upper: float
    """[rad] limits, NaN where there is none"""
    speed: float
    """[rad/s] speed limit, NaN where there is none"""
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


def cut(tree: Tree, base: str | None, tip: str | None) -> Draft:
    """Make a draft of the chain from the body ``base`` to the body or site ``tip``.

    Without ``tip`` it is the last link of the longest chain of hinges, a gripper's left out, without ``base`` the
    root that the tip hangs on. Bodies beside the chain are frozen where they are and add their mass to the link
    that carries them. InputError when a name is unknown, the choice is ambiguous, or a joint
    of the chain is not a hinge.
    """
    notes = list(tree.notes)
    start = None if base is None else _body(tree, base)
    end, pose = _longest(tree, start, notes) if tip is None else _tip(tree, tip)
    if start is None:
        start = _root(tree, end)
        notes.append(f"base: none given; {tree.bodies[start].name} taken, the root of the tree")
    path = tree.path(end)
    if start != WORLD and start not in path:
        raise InputError(f"{tip} does not hang below {base}; the bodies above it are: {_names(tree, path)}")
    links = path if start == WORLD else path[path.index(start) + 1 :]
    joints = tree.joints_of(links)
    _check_hinges(tree, joints, start, end)
    frame = tree.bodies[start].pose
    if frame[2, 2] < 1 - 1e-9:
        notes.append(f"base: {tree.bodies[start].name} is tilted in the file; gravity is taken along its own -z axis")
    return _draft(tree, joints, frame, pose, notes)


def _draft(tree: Tree, joints: list[Joint], frame: Array, tip: Array, notes: list[str]) -> Draft:
    """Draft of the chain of ``joints`` from the base's ``frame`` to the ``tip`` (4, 4), both in the world."""
    offsets, axes, before = [], [], frame
    poses = []
    for joint in joints:
        pose = pose_of(tree.bodies[joint.body].pose[:3, :3], joint.anchor)
        axis = pose[:3, :3].T @ joint.axis
        back = pose_of(rotation_about(axis, -joint.angle), np.zeros(3))
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
    """Everything that moves with each joint of the chain and not with the next, in the joint frames."""
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


def _body(tree: Tree, name: str) -> int:
    names = [body.name for body in tree.bodies]
    if name not in names:
        raise InputError(_unknown(name, "body", names))
    return names.index(name)


def _tip(tree: Tree, name: str) -> tuple[int, Array]:
    names = [body.name for body in tree.bodies]
    if name in names:
        return names.index(name), tree.bodies[names.index(name)].pose
    for site in tree.sites:
        if site.name == name:
            return site.body, site.pose
    raise InputError(_unknown(name, "body or site", names + [site.name for site in tree.sites]))


def _root(tree: Tree, end: int) -> int:
    """Root body above ``end``; the world where the root itself turns on a hinge."""
    first = tree.path(end)[0] if end != WORLD else WORLD
    return WORLD if any(joint.kind != "free" for joint in tree.joints_of([first])) else first


def _longest(tree: Tree, start: int | None, notes: list[str]) -> tuple[int, Array]:
    """Last link of the single longest chain of hinges below ``start`` (anywhere if None), and its pose."""
    hinges: dict[int, int] = {}
    for index, body in enumerate(tree.bodies):
        if index in (WORLD, start):
            if start is None or index == start:
                hinges[index] = 0
            continue
        own = tree.joints_of([index])
        floating = start is None and body.parent == WORLD and [joint.kind for joint in own] == ["free"]
        if body.parent in hinges and (floating or all(map(_of_the_arm, own))):
            hinges[index] = hinges[body.parent] + (0 if floating else len(own))
    parents = {tree.bodies[index].parent for index in hinges if index != start and index != WORLD}
    leaves = [index for index in hinges if index not in parents]
    most = max((hinges[index] for index in leaves), default=0)
    longest = [index for index in leaves if hinges[index] == most]
    if most == 0:
        hint = _behind_others(tree, most)
        raise InputError(f"{tree.name}: no chain of hinges was found; the bodies are: {_names(tree, hinges)}{hint}")
    if len(longest) > 1:
        hint = _behind_others(tree, most) or f"; name the tip that you mean{_parting(tree, longest)}"
        ends = _names(tree, longest)
        raise InputError(f"{tree.name}: several links could be the tip of the arm ({most} joints each): {ends}{hint}")
    end = longest[0]
    sites = [site.name for site in tree.sites if site.body == end]
    more = f" (it carries the sites {', '.join(sites)}, which can be named instead)" if sites else ""
    notes.append(f"tip: none given; {tree.bodies[end].name} taken, the end of the longest chain ({most} joints){more}")
    beyond = [joint.name for joint in tree.joints if joint.kind == "hinge" and tree.bodies[joint.body].parent == end]
    if beyond:
        notes.append(f"tip: {', '.join(beyond)} behind it taken for a gripper's and held; name a tip to drive it")
    return end, tree.bodies[end].pose


def _of_the_arm(joint: Joint) -> bool:
    """Tell a hinge that an arm turns by from a gripper's."""
    return joint.kind == "hinge" and not joint.drives and not _GRIPPER.search(joint.name)


def _behind_others(tree: Tree, most: int) -> str:
    """Where a chain of more than ``most`` hinges begins behind a joint of another kind, as a hint."""
    start, hinges = {WORLD: WORLD}, {WORLD: 0}
    for index, body in enumerate(tree.bodies[1:], start=1):
        own = tree.joints_of([index])
        whole = all(map(_of_the_arm, own))
        start[index] = start[body.parent] if whole else index
        hinges[index] = hinges[body.parent] + len(own) if whole else 0
    end = max(hinges, key=lambda index: hinges[index])
    if hinges[end] <= most:
        return ""
    base = start[end]
    kinds = ", ".join(f"{joint.name} is a {joint.kind} joint" for joint in tree.joints_of([base]))
    return f"; a chain of {hinges[end]} hinges begins behind {tree.bodies[base].name} ({kinds}): give that as the base"


def _parting(tree: Tree, ends: list[int]) -> str:
    """Where the paths to ``ends`` part, as a hint: a gripper's fingers part at its palm."""
    shared = [bodies[0] for bodies in zip(*map(tree.path, ends), strict=False) if len(set(bodies)) == 1]
    if not tree.joints_of(shared):
        return ""
    return f", such as {tree.bodies[shared[-1]].name}, where they part"


def _check_hinges(tree: Tree, joints: list[Joint], start: int, end: int) -> None:
    names = f"{tree.bodies[start].name} and {tree.bodies[end].name}"
    if not joints:
        raise InputError(f"{tree.name}: there is no joint between {names}; choose another base or tip")
    for joint in joints:
        if joint.kind != "hinge":
            raise InputError(
                f"{tree.name}: joint {joint.name} between {names} is a {joint.kind} joint, and only revolute joints "
                "of their own can be driven; choose a base and a tip with it outside of the chain"
            )


def _unknown(name: str, kind: str, names: list[str]) -> str:
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    shown = [known for known in names if known][:40]
    return f"the model has no {kind} called {name!r}; {hint}it has: {', '.join(shown)}"


def _names(tree: Tree, bodies: Iterable[int]) -> str:
    return ", ".join(tree.bodies[index].name for index in bodies)
