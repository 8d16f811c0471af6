"""Cuts a serial chain out of a model; all other joints are frozen."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import takewhile

import numpy as np

from rejoint.arms.arm import Arm, Array
from rejoint.arms.draft import UNKNOWN, Loaded
from rejoint.arms.inertia import rigid_body
from rejoint.arms.modelfile import WORLD, Tree
from rejoint.arms.rotations import inverse, pose_of, rotation_about
from rejoint.system.errors import InputError


def cut(tree: Tree, base: str | None, tip: str | None) -> Loaded:
    """Unfinished arm from body ``base`` to the body or site ``tip``, see `rejoint.arms.draft.finish`.

    Default ``tip``: last link of the longest chain of hinges without a gripper; default ``base``: the root. Slides are
    held; other bodies add mass to their link. InputError for unknown names, an ambiguous choice, or a joint that can be
    neither driven nor held.
    """
    notes = list(tree.notes)
    start = None if base is None else tree.find(base, "body")
    end = _longest(tree, start, notes) if tip is None else tree.find(tip, "body or site")
    if start is None:
        start = _root_of(tree, end, notes)
    path = tree.path(end)
    if start != WORLD and start not in path:
        raise InputError(f"{tip} does not hang below {base}; the bodies above it are: {tree.listed(path)}")
    links = path if start == WORLD else path[path.index(start) + 1 :]
    joints = _hinges(tree, tree.joints_of(links), f"{tree.names[start]} and {tree.names[end]}", notes)
    frame = tree.poses[start]
    if frame[2, 2] < 1 - 1e-9:
        tilt = np.degrees(np.arccos(np.clip(frame[2, 2], -1.0, 1.0)))
        notes.append(
            f"base: {tree.names[start]} is tilted by {tilt:.0f} deg in the file; gravity, floor and targets are "
            "taken as if it stood upright, which is right only where the arm itself does"
        )
    return Loaded(arm=_arm(tree, joints, frame, tree.poses[end]), notes=tuple(notes))


def _arm(tree: Tree, joints: list[int], frame: Array, tip: Array) -> Arm:
    """``frame`` of the base and ``tip``: (4, 4) in the world."""
    model, data, n = tree.model, tree.data, len(joints)
    bodies = model.jnt_bodyid[joints]
    poses = [
        pose_of(tree.poses[body][:3, :3], anchor) for body, anchor in zip(bodies, data.xanchor[joints], strict=True)
    ]
    axes = [pose[:3, :3].T @ axis for pose, axis in zip(poses, data.xaxis[joints], strict=True)]
    at_zero = [
        pose @ pose_of(rotation_about(axis, -tree.position(j)), np.zeros(3))
        for pose, axis, j in zip(poses, axes, joints, strict=True)
    ]
    offsets = inverse(np.array([frame, *poses[:-1]])) @ np.array(at_zero)
    low, high = np.where(model.jnt_limited[joints, None], model.jnt_range[joints], np.nan).T
    mass, com, inertia = zip(*_links(tree, bodies.tolist(), poses), strict=True)
    return Arm(
        name=tree.name,
        joint_names=tuple(tree.joint_names[j] for j in joints),
        offset=offsets,
        axis=np.array(axes),
        tip=inverse(poses[-1]) @ tip,
        lower=low,
        upper=high,
        max_speed=np.array([tree.speeds.get(tree.joint_names[j], np.nan) for j in joints]),
        mass=np.array(mass),
        com=np.array(com),
        inertia=np.array(inertia),
        rest=np.full(n, np.nan),
        targets=UNKNOWN,
        floor=np.nan,
        encoder_step=np.nan,
    )


def _links(tree: Tree, carriers: list[int], poses: list[Array]) -> list[tuple[float, Array, Array]]:
    """Mass, centre and inertia of each link, in its joint's frame; NaN where most of the mass has no usable inertia."""
    owner = {body: i for i, body in enumerate(carriers)}  # of several joints of a body the last carries it
    whole, doubtful = np.zeros((len(poses), 4, 4)), np.zeros(len(poses))
    for body in range(1, tree.model.nbody):
        link = owner.get(body, owner.get(int(tree.model.body_parentid[body])))
        if link is not None:
            owner[body] = link
            pose = inverse(poses[link]) @ tree.poses[body]
            whole[link] += pose @ tree.content[body] @ pose.T
            doubtful[link] += tree.content[body][3, 3] * tree.doubtful[body]
    found = [rigid_body(one) for one in whole]
    unknown = doubtful > whole[:, 3, 3] / 2
    return [(m, com, np.where(doubt, np.nan, own)) for (m, com, own), doubt in zip(found, unknown, strict=True)]


def _hinges(tree: Tree, joints: list[int], between: str, notes: list[str]) -> list[int]:
    driven = [j for j in joints if tree.kind(j) == "hinge"]
    for j in joints:
        name, kind, leader = tree.joint_names[j], tree.kind(j), tree.leader(j)
        follower = f", or hold it with the joint that it follows: --hold {name}=0deg,{leader}=0deg" if leader else ""
        if kind == "slide":
            notes.append(_slide_held(tree, j))
        elif kind not in ("hinge", "held"):
            raise InputError(
                f"{tree.name}: joint {name} between {between} is a {kind} joint, and only revolute joints "
                f"of their own can be driven; choose a base and a tip with it outside of the chain{follower}"
            )
        elif leader in {tree.joint_names[other] for other in driven}:
            raise InputError(
                f"{tree.name}: joint {name} cannot be held alone: it follows {leader}, which is driven{follower}"
            )
    if not driven:
        raise InputError(f"{tree.name}: there is no revolute joint between {between}; choose another base or tip")
    return driven


def _slide_held(tree: Tree, j: int) -> str:
    low, high = 1e3 * tree.model.jnt_range[j]
    span = f" ({low:.0f} to {high:.0f} mm)" if tree.model.jnt_limited[j] else ""
    name, place = tree.joint_names[j], f"{1e3 * tree.position(j):.0f}"
    return (
        f"joint {name} slides{span} and is not driven, only revolute joints are; it is taken as fixed at {place} "
        f"mm, which the arm has to keep; if it stands elsewhere: --hold {name}={place}mm"
    )


_GRIPPER = re.compile("grip|jaw|finger|claw", re.IGNORECASE)
"""Joints of grippers (URDFs of SO-100, WidowX, Koch)"""

_FLANGE = "tool0"
"""Flange in URDFs of ROS-Industrial"""

_TOOL = re.compile(r"tool|tcp|grasp|end_?effector|(^|_)eef?(_|$)", re.IGNORECASE)
"""Tool frames (URDFs of Universal Robots, Kinova, PAL, Franka Emika)"""

_ACROSS = 1e-6
"""Largest product of orthogonal unit vectors (rounding)"""


def _root_of(tree: Tree, end: int, notes: list[str]) -> int:
    """First body of the arm to ``end``: the root, the load of a mobile base, or the world."""
    path = tree.path(end)
    moving = _mobile_base(tree, tree.joints_of(path))
    if moving:
        root = int(tree.model.jnt_bodyid[moving[-1]])
        names = ", ".join(tree.joint_names[j] for j in moving)
        notes.append(f"base: none given; {tree.names[root]} taken; {names} before it move all of it")
        return root
    first = path[0] if path else WORLD
    root = WORLD if any(tree.kind(j) not in ("free", "slide") for j in tree.joints_of([first])) else first
    notes.append(f"base: none given; {tree.names[root]} taken, the root of the tree")
    return root


def _mobile_base(tree: Tree, joints: list[int]) -> list[int]:
    """Two slides or more, and a hinge across them, at the beginning of a chain."""
    slides = list(takewhile(lambda j: tree.kind(j) == "slide", joints))
    axes, turn = tree.data.xaxis, joints[len(slides) : len(slides) + 1]
    across = all(tree.kind(j) == "hinge" and (np.abs(axes[slides] @ axes[j]) < _ACROSS).all() for j in turn)
    return [] if len(slides) < 2 else slides + (turn if across else [])


def _longest(tree: Tree, start: int | None, notes: list[str]) -> int:
    """Last link of the longest chain of hinges below ``start`` (None: anywhere), without gripper."""
    hinges = _chains(tree, start)
    leaves = hinges.keys() - {tree.parent(body) for body in hinges if body not in (start, WORLD)}
    most = max(hinges[body] for body in leaves)
    ends = [body for body in sorted(leaves) if hinges[body] == most]
    if most == 0:
        raise InputError(f"{tree.name}: no chain of hinges was found; the bodies are: {tree.listed(hinges)}")
    carried: dict[int, list[int]] = {}  # ends by the last joint before them
    for body in ends:
        carried.setdefault(tree.joints_of(tree.path(body))[-1], []).append(body)
    if len(carried) > 1:
        names = tree.listed(_frame(tree, bodies) for bodies in carried.values())
        raise InputError(
            f"{tree.name}: several links could be the tip of the arm ({most} joints each): {names}; name the tip"
        )
    end = _frame(tree, ends)
    behind = [place for place in range(len(tree.names)) if place != WORLD and tree.parent(place) in (end, *ends)]
    others = [body for body in ends if body != end] + [place for place in behind if place >= tree.model.nbody]
    more = f" (beside it are {tree.listed(others)}, which can be named instead)" if others else ""
    notes.append(f"tip: none given; {tree.names[end]} taken, the end of the longest chain{more}")
    beyond = ", ".join(tree.joint_names[j] for j in tree.joints_of(behind) if tree.kind(j) == "hinge")
    if beyond:
        notes.append(f"tip: {beyond} behind it taken for a gripper's and held; name a tip to drive it")
    return end


def _chains(tree: Tree, start: int | None) -> dict[int, int]:
    """Hinges before each body that a chain from ``start`` can end at: not behind a slide."""
    hinges = {}
    for body in range(tree.model.nbody):
        path = tree.path(body)
        if start not in (None, WORLD, *path):
            continue
        joints = tree.joints_of(path[path.index(start) + 1 :] if start in path else path)
        if start is None and joints and tree.kind(joints[0]) == "free":
            del joints[0]
        if all(_passable(tree, j) for j in joints) and not (joints and tree.kind(joints[-1]) == "slide"):
            hinges[body] = sum(tree.kind(j) == "hinge" for j in joints)
    return hinges


def _passable(tree: Tree, j: int) -> bool:
    """Whether a chain goes on behind a joint: not behind those of grippers, which lead joints of other branches."""
    bodies = tree.model.jnt_bodyid.tolist()
    led = [other for other in range(tree.model.njnt) if tree.leader(other) == tree.joint_names[j]]
    leads = any(bodies[j] not in tree.path(bodies[other]) for other in led)
    gripper = leads or _GRIPPER.search(tree.joint_names[j])
    return tree.kind(j) == "held" or (tree.kind(j) in ("hinge", "slide") and not gripper)


def _frame(tree: Tree, ends: Iterable[int]) -> int:
    """Choose the tool's frame of bodies on one link, else the last body before all of them."""
    named = {tree.names[body]: body for body in ends}
    tools = [body for name, body in named.items() if _TOOL.search(name)]
    if _FLANGE in named:
        return named[_FLANGE]
    if len(named) == 1 or len(tools) == 1:
        return (tools or list(named.values()))[0]
    return [bodies[0] for bodies in zip(*map(tree.path, named.values()), strict=False) if len(set(bodies)) == 1][-1]
