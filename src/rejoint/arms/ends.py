"""Where in a tree the arm begins and ends: as its user says, or the one choice that the tree leaves."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence

from rejoint.arms.arm import Array
from rejoint.arms.tree import WORLD, Joint, Tree
from rejoint.system.errors import InputError

_GRIPPER = re.compile("grip|jaw|finger|claw", re.IGNORECASE)
"""In the name of a joint: it opens and closes a gripper (as named in the URDFs of SO-100, WidowX and Koch arms)."""

_FLANGE = "tool0"
"""Name of the frame at an arm's flange in the URDFs of ROS-Industrial."""

_TOOL = re.compile(r"tool|tcp|grasp|end_?effector|(^|_)eef?(_|$)", re.IGNORECASE)
"""In the name of a frame: it is a tool's (as named in the URDFs of Universal Robots, Kinova, PAL and Franka Emika)."""

_ACROSS = 1e-6
"""Largest product of unit vectors that are at right angles (rounding)."""


def body_called(tree: Tree, name: str) -> int:
    """Index of a body; InputError with the names there are."""
    names = [body.name for body in tree.bodies]
    if name not in names:
        raise InputError(unknown(name, "body", names))
    return names.index(name)


def tip_called(tree: Tree, name: str) -> tuple[int, Array]:
    """Body that a tip is on, and the tip's pose (4, 4) in the world; it is a body or a site."""
    names = [body.name for body in tree.bodies]
    if name in names:
        return names.index(name), tree.bodies[names.index(name)].pose
    for site in tree.sites:
        if site.name == name:
            return site.body, site.pose
    raise InputError(unknown(name, "body or site", names + [site.name for site in tree.sites]))


def root_of(tree: Tree, end: int, notes: list[str]) -> int:
    """Body at which the arm that ends at ``end`` begins: the root above it, or what a mobile base carries.

    It is the world where the root itself turns on a hinge.
    """
    path = tree.path(end)
    moving = _mobile_base(tree.joints_of(path))
    if moving:
        root = moving[-1].body
        notes.append(f"base: none given; {tree.bodies[root].name} taken; {_listed(moving)} before it move all of it")
        return root
    first = path[0] if path else WORLD
    root = WORLD if any(joint.kind not in ("free", "slide") for joint in tree.joints_of([first])) else first
    notes.append(f"base: none given; {tree.bodies[root].name} taken, the root of the tree")
    return root


def longest(tree: Tree, start: int | None, notes: list[str]) -> tuple[int, Array]:
    """Last link of the single longest chain of hinges below ``start`` (anywhere if None), and its pose.

    Slides are passed on the way to hinges; those behind the last hinge, and a gripper's, are not of the arm.
    """
    hinges, slid = _chains(tree, start)
    parents = {tree.bodies[index].parent for index in hinges if index not in (start, WORLD) and not slid[index]}
    leaves = [index for index in hinges if index not in parents and not slid[index]]
    most = max((hinges[index] for index in leaves), default=0)
    ends = [index for index in leaves if hinges[index] == most]
    hint = _behind_others(tree, most)
    if most == 0:
        found = tree.names(index for index in hinges if not slid[index])
        raise InputError(f"{tree.name}: no chain of hinges was found; the bodies are: {found}{hint}")
    carriers = {index: _carrier(tree, index) for index in ends}
    if len(set(carriers.values())) > 1:
        hint = hint or f"; name the tip that you mean{_parting(tree, ends)}"
        chosen = [_frame(tree, [i for i in ends if carriers[i] == body]) for body in dict.fromkeys(carriers.values())]
        names = tree.names(chosen)
        raise InputError(f"{tree.name}: several links could be the tip of the arm ({most} joints each): {names}{hint}")
    end = _frame(tree, ends)
    others = [tree.bodies[index].name for index in ends if index != end]
    others += [site.name for site in tree.sites if site.body in (end, *ends)]
    more = f" (beside it are {', '.join(others)}, which can be named instead)" if others else ""
    notes.append(f"tip: none given; {tree.bodies[end].name} taken, the end of the longest chain{more}")
    beyond = [
        joint.name for joint in tree.joints if joint.kind == "hinge" and tree.bodies[joint.body].parent in (end, *ends)
    ]
    if beyond:
        notes.append(f"tip: {', '.join(beyond)} behind it taken for a gripper's and held; name a tip to drive it")
    notes += [note for joint in tree.joints if (note := _cut_at(tree, joint, (end, *ends)))]
    return end, tree.bodies[end].pose


def _cut_at(tree: Tree, joint: Joint, ends: Sequence[int]) -> str:
    """Say that the chain ends where a joint follows another one, if joints of their own come behind it."""
    if joint.kind != "coupled" or tree.bodies[joint.body].parent not in ends:
        return ""
    behind = [other.name for other in tree.joints if other.kind == "hinge" and joint.body in tree.path(other.body)]
    if not behind:
        return ""
    return (
        f"tip: {joint.name} behind it follows {joint.follows}, so {', '.join(behind)} is left out; with "
        f"--hold {joint.name}=0deg,{joint.follows}=0deg the arm goes on there"
    )


def unknown(name: str, kind: str, names: Sequence[str]) -> str:
    """Say that a model has nothing of that name, and what it has."""
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean {close[0]}? " if close else ""
    shown = [known for known in names if known][:40]
    return f"the model has no {kind} called {name!r}; {hint}it has: {', '.join(shown)}"


def _chains(tree: Tree, start: int | None) -> tuple[dict[int, int], dict[int, bool]]:
    """Bodies that a chain of the arm's joints reaches: hinges up to each, and whether a slide is the last joint."""
    hinges: dict[int, int] = {}
    slid: dict[int, bool] = {}
    for index, body in enumerate(tree.bodies):
        if index in (WORLD, start):
            if start is None or index == start:
                hinges[index], slid[index] = 0, False
            continue
        own = tree.joints_of([index])
        floating = start is None and body.parent == WORLD and [joint.kind for joint in own] == ["free"]
        if body.parent in hinges and (floating or all(map(_passable, own))):
            hinges[index] = hinges[body.parent] + sum(joint.kind == "hinge" for joint in own)
            slid[index] = own[-1].kind == "slide" if own else slid[body.parent]
    return hinges, slid


def _passable(joint: Joint) -> bool:
    """Tell a joint that an arm moves by, or is fixed at, from a gripper's."""
    if joint.kind == "held":
        return True
    return joint.kind in ("hinge", "slide") and not joint.drives and not _GRIPPER.search(joint.name)


def _carrier(tree: Tree, end: int) -> int:
    """Body with the last joint on the way to ``end``: what is rigidly on it needs no choice between arms."""
    return next((index for index in tree.path(end)[::-1] if tree.joints_of([index])), WORLD)


def _frame(tree: Tree, ends: list[int]) -> int:
    """Choose among links that are rigidly on one: the flange, the one tool, or the link that carries them."""
    names = [tree.bodies[index].name for index in ends]
    if _FLANGE in names:
        return ends[names.index(_FLANGE)]
    tools = [index for index, name in zip(ends, names, strict=True) if _TOOL.search(name)]
    if len(ends) == 1 or len(tools) == 1:
        return (tools or ends)[0]
    return [bodies[0] for bodies in zip(*map(tree.path, ends), strict=False) if len(set(bodies)) == 1][-1]


def _mobile_base(joints: list[Joint]) -> list[Joint]:
    """Joints at the root that move a whole robot: slides across each other, and of two the hinge across both."""
    moving: list[Joint] = []
    for joint in joints:
        across = all(abs(float(joint.axis @ other.axis)) < _ACROSS for other in moving)
        if not across or joint.kind not in (("slide", "hinge") if len(moving) == 2 else ("slide",)):
            break
        moving.append(joint)
    return moving if len(moving) > 1 else []


def _behind_others(tree: Tree, most: int) -> str:
    """Where a chain of more than ``most`` hinges begins behind a joint of another kind, as a hint."""
    start, hinges = {WORLD: WORLD}, {WORLD: 0}
    for index, body in enumerate(tree.bodies[1:], start=1):
        own = tree.joints_of([index])
        whole = all(map(_passable, own))
        start[index] = start[body.parent] if whole else index
        hinges[index] = hinges[body.parent] + sum(joint.kind == "hinge" for joint in own) if whole else 0
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


def _listed(joints: list[Joint]) -> str:
    return ", ".join(joint.name for joint in joints)
