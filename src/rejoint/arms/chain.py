"""Cut a serial chain out of a tree of bodies, and freeze everything else that hangs on it."""

from __future__ import annotations

import numpy as np

from rejoint.arms.arm import Array
from rejoint.arms.draft import Draft
from rejoint.arms.ends import body_called, longest, root_of, tip_called
from rejoint.arms.inertia import SpatialInertia, combined
from rejoint.arms.rotations import inverse, pose_of, rotation_about
from rejoint.arms.tree import WORLD, Joint, Tree
from rejoint.system.errors import InputError


def cut(tree: Tree, base: str | None, tip: str | None) -> Draft:
    """Make a draft of the chain from the body ``base`` to the body or site ``tip``.

    Without ``tip`` it is the last link of the longest chain of hinges, a gripper's left out, without ``base`` the
    root that the tip hangs on. Slides of the chain are held where they are; bodies beside it are frozen where they
    are and add their mass to the link that carries them. InputError when a name is unknown, the choice is
    ambiguous, or a joint of the chain can be neither driven nor held.
    """
    notes = list(tree.notes)
    start = None if base is None else body_called(tree, base)
    end, pose = longest(tree, start, notes) if tip is None else tip_called(tree, tip)
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
    return _draft(tree, joints, frame, pose, notes)


def _draft(tree: Tree, joints: list[Joint], frame: Array, tip: Array, notes: list[str]) -> Draft:
    """Draft of the chain of ``joints`` from the base's ``frame`` to the ``tip`` (4, 4), both in the world."""
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


def _hinges(tree: Tree, joints: list[Joint], between: str, notes: list[str]) -> list[Joint]:
    """Joints that are driven; those that are held instead are noted."""
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
