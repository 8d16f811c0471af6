"""An arm as URDF, the description that other programs read: joints with their origins, limits and masses, no shapes.

Errors of zeros and links go into the joint origins, and not into ``<calibration>`` tags, which other programs ignore.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np

from rejoint.arms.arm import Arm, Array
from rejoint.arms.displacement import Displacement
from rejoint.arms.inverse import solve_position
from rejoint.arms.rotations import rotation_about
from rejoint.system.files import write_whole

EFFORT = "1000"
"""[N m] limit that a URDF has to name (chosen: none is known, and zero would keep simulators from moving the arm)"""
BASE, TOOL = "base", "tool"
"""Names of the first and the last link"""


def unit_arm(arm: Arm, displacement: Displacement) -> Arm:
    """Return the arm as this unit of it is built: links as they are, each zero where its encoder has it.

    Its forward kinematics of what the encoders say is that of ``displacement`` but for compliance and play, which
    depend on the load and have no place in a description of rigid links.
    """
    moved = displacement.moved(arm)
    offset = moved.offset.copy()
    for i, (axis, angle) in enumerate(zip(arm.axis, displacement.offset, strict=True)):
        offset[i, :3, :3] = offset[i, :3, :3] @ rotation_about(axis, float(angle))
    return replace(moved, offset=offset)


def at_targets(arm: Arm) -> Array:
    """Postures (27, n) [rad] over the region of targets, for which a unit is described."""
    axes = np.linspace(arm.targets.lower, arm.targets.upper, 3).T
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return solve_position(arm, grid, arm.rest).q


def write_urdf(path: Path, arm: Arm, note: str = "") -> None:
    """Write the URDF of an arm, with ``note`` as a comment at its top."""
    text = urdf_text(arm, note)
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def urdf_text(arm: Arm, note: str = "") -> str:
    """Return the URDF; links are called `BASE`, ``link1`` and so on, and `TOOL` at the TCP."""
    root = ET.Element("robot", name=arm.name)
    if note:
        root.append(ET.Comment(f" {note.replace('--', '-')} "))
    ET.SubElement(root, "link", name=BASE)
    for i, name in enumerate(arm.joint_names):
        _link(root, arm, i)
        joint = _joint(root, name, "revolute", BASE if i == 0 else f"link{i}", f"link{i + 1}", arm.offset[i])
        ET.SubElement(joint, "axis", xyz=_numbers(arm.axis[i]))
        limit = {"lower": arm.lower[i], "upper": arm.upper[i], "velocity": arm.max_speed[i]}
        ET.SubElement(joint, "limit", {key: repr(float(value)) for key, value in limit.items()}, effort=EFFORT)
    ET.SubElement(root, "link", name=TOOL)
    _joint(root, f"{TOOL}_joint", "fixed", f"link{arm.joints}", TOOL, arm.tip)
    ET.indent(root)
    return f'<?xml version="1.0"?>\n{ET.tostring(root, encoding="unicode")}\n'


def _link(root: ET.Element, arm: Arm, i: int) -> None:
    link = ET.SubElement(root, "link", name=f"link{i + 1}")
    if not arm.mass[i] > 0.0:
        return
    inertial, inertia = ET.SubElement(link, "inertial"), arm.inertia[i]
    ET.SubElement(inertial, "origin", xyz=_numbers(arm.com[i]), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=repr(float(arm.mass[i])))
    places = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
    ET.SubElement(inertial, "inertia", {key: repr(float(inertia[place])) for key, place in places.items()})


def _joint(root: ET.Element, name: str, kind: str, parent: str, child: str, pose: Array) -> ET.Element:
    joint = ET.SubElement(root, "joint", name=name, type=kind)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=_numbers(pose[:3, 3]), rpy=_numbers(roll_pitch_yaw(pose[:3, :3])))
    return joint


def roll_pitch_yaw(rotation: Array) -> Array:
    """Angles (3,) [rad] about fixed x, y and z of a ``rotation`` (3, 3), as URDF has them.

    Pitch and roll are read off what is left after the yaw, so that they are exact also where the yaw is not sure.
    """
    yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    rest = rotation_about(np.array([0.0, 0.0, 1.0]), -yaw) @ rotation
    return np.array([np.arctan2(-rest[1, 2], rest[1, 1]), np.arctan2(-rest[2, 0], rest[0, 0]), yaw])


def _numbers(values: Array) -> str:
    return " ".join(repr(float(value)) for value in values)
