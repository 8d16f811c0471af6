"""The arms of the catalogue.

myCobot 280 Pi (all zero: upright). Geometry: DH table of the vendor's manual (``SDH.png`` in
elephantrobotics/mycobot_docs); Park et al. 2024, Table 1, is the same mechanism. Limits, speed, encoders: the manual
and pymycobot 4.0.7. Masses: estimates that sum, with the base, to the published 0.86 kg. Targets: Park et al. 2024,
section IV-A.

SO-101 of TheRobotStudio, jaw frozen at zero. Frames, limits, masses, inertias, TCP (``gripperframe``):
``Simulation/SO101/so101_new_calib.xml`` in TheRobotStudio/SO-ARM100 (Apache-2.0). Servos: Feetech STS3215, 12 V
(SO-ARM100, issue 134); acceleration as LeRobot's ``configure_motors`` sets it. Rest, targets, floor:
`rejoint.arms.workspace`, seed 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rejoint.arms.arm import Arm, Array, Box, DhRow, dh_chain
from rejoint.arms.inertia import SpatialInertia, combined, cylinder, inertia_matrix, link_ends
from rejoint.arms.rotations import pose_of, rotation_of

DH_TABLE = (
    DhRow(d=0.13122, a=0.0, alpha=np.pi / 2),
    DhRow(d=0.0, a=-0.1104, alpha=0.0, offset=-np.pi / 2),
    DhRow(d=0.0, a=-0.096, alpha=0.0),
    DhRow(d=0.0634, a=0.0, alpha=np.pi / 2, offset=-np.pi / 2),
    DhRow(d=0.07505, a=0.0, alpha=-np.pi / 2, offset=np.pi / 2),
    DhRow(d=0.0456, a=0.0, alpha=0.0),
)

PAPER_DH_TABLE = (
    DhRow(d=0.1312, a=0.0, alpha=-np.pi / 2),
    DhRow(d=0.0, a=0.1104, alpha=0.0),
    DhRow(d=0.0, a=0.096, alpha=0.0),
    DhRow(d=0.0634, a=0.0, alpha=np.pi / 2),
    DhRow(d=0.0741, a=0.0, alpha=-np.pi / 2),
    DhRow(d=0.0456, a=0.0, alpha=0.0),
)
"""Table 1 of Park et al. 2024"""

PAPER_ANGLE_SHIFT = np.radians([180.0, -90.0, 0.0, 90.0, 90.0, 0.0])
"""Angles of the paper minus the vendor's"""

_LIMITS_DEG = np.array([[-168, 168], [-140, 140], [-150, 150], [-150, 150], [-155, 160], [-180, 180]])
_MASSES = np.array([0.16, 0.18, 0.15, 0.09, 0.09, 0.04])
_LINK_RADIUS = 0.025


def mycobot280() -> Arm:
    """Build the myCobot 280 Pi."""
    offset, axis, tip = dh_chain(DH_TABLE)
    ends = link_ends(offset, tip)
    return Arm(
        name="mycobot280",
        joint_names=tuple(f"joint{i}" for i in range(1, 7)),
        offset=offset,
        axis=axis,
        tip=tip,
        lower=np.radians(_LIMITS_DEG[:, 0]),
        upper=np.radians(_LIMITS_DEG[:, 1]),
        max_speed=np.full(6, np.radians(150.0)),
        mass=_MASSES,
        com=ends / 2,
        inertia=np.array([cylinder(m, end, _LINK_RADIUS) for m, end in zip(_MASSES, ends, strict=True)]),
        rest=np.radians(REST_DEG),
        targets=Box(lower=np.array([0.130, -0.100, 0.150]), upper=np.array([0.230, 0.100, 0.250])),
        floor=0.02,
        encoder_step=2 * np.pi / 4096,
    )


REST_DEG = (20.0, 0.0, -85.0, -5.0, 0.0, 0.0)
"""Elbow up, flange down, TCP among the targets (chosen)"""


class _MjcfBody(NamedTuple):
    """A body of the MJCF, in its parent's frame."""

    joint: str
    position: tuple[float, float, float]
    """[m]"""
    quaternion: tuple[float, float, float, float]
    """w, x, y, z"""
    limits: tuple[float, float]
    """[rad]"""
    mass: float
    """[kg]"""
    com: tuple[float, float, float]
    """[m]"""
    inertia: tuple[float, float, float, float, float, float]
    """[kg m^2] xx, yy, zz, xy, xz, yz"""


_PARTS = (
    _MjcfBody(
        "shoulder_pan", (0.0388353, -8.97657e-09, 0.0624), (3.56167e-16, 1.22818e-15, -1.0, -4.14635e-16),
        (-1.9198621771937616, 1.9198621771937634), 0.100006, (-0.0307604, -1.66727e-05, -0.0252713),
        (8.3759e-05, 8.10403e-05, 2.39783e-05, 7.55525e-08, -1.16342e-06, 1.54663e-07),
    ),
    _MjcfBody(
        "shoulder_lift", (-0.0303992, -0.0182778, -0.0542), (0.5, -0.5, -0.5, -0.5),
        (-1.7453292519943224, 1.7453292519943366), 0.103, (-0.0898471, -0.00838224, 0.0184089),
        (4.08002e-05, 0.000147318, 0.000142487, -1.97819e-05, -4.03016e-08, 8.97326e-09),
    ),
    _MjcfBody(
        "elbow_flex", (-0.11257, -0.028, 1.73763e-16), (0.707107, -5.98613e-17, -2.58051e-17, 0.707107),
        (-1.69, 1.69), 0.104, (-0.0980701, 0.00324376, 0.0182831),
        (2.87438e-05, 0.000159844, 0.00014529, 7.41152e-06, 1.26409e-06, -4.90188e-08),
    ),
    _MjcfBody(
        "wrist_flex", (-0.1349, 0.0052, 3.62355e-17), (0.707107, 9.58722e-16, -7.51313e-16, -0.707107),
        (-1.6580628494556928, 1.6580627293335335), 0.079, (-0.000103312, -0.0386143, 0.0281156),
        (3.68263e-05, 2.5391e-05, 2.1e-05, 1.7893e-08, -5.28128e-08, 3.6412e-06),
    ),
    _MjcfBody(
        "wrist_roll", (5.55112e-17, -0.0611, 0.0181), (0.0172091, -0.0172091, 0.706897, 0.706897),
        (-2.7438472969992493, 2.841206309382605), 0.087, (0.000213627, 0.000245138, -0.025187),
        (2.75087e-05, 4.33657e-05, 3.45059e-05, -3.35241e-07, -5.7352e-06, -5.17847e-08),
    ),
)  # fmt: skip

_JAW = _MjcfBody(
    "gripper",
    (0.0202, 0.0188, -0.0234),
    (0.707107, 0.707107, -1.85362e-08, 1.85362e-08),
    (-0.17453297762778586, 1.7453291995659765),
    0.012,
    (-0.00157495, -0.0300244, 0.0192755),
    (6.61427e-06, 1.89032e-06, 5.28738e-06, -3.19807e-07, -5.90717e-09, -1.09945e-07),
)

_TCP_POSITION = (-0.0079, -0.000218121, -0.0981274)
_TCP_QUATERNION = (0.707107, 0.0, 0.707107, -2.37788e-17)

_SERVO = "STS3215"
_MAX_SPEED_RPM = 45.0
_COUNTS = 4096
_ACCELERATION = 254 * 100 * 2 * np.pi / _COUNTS
"""[rad/s^2]"""

_SO101_REST_DEG = (0.0, -12.0, -12.0, 48.0, 3.0)


def so101() -> Arm:
    """Build the SO-101, joints named as in LeRobot."""
    links = [_content(part) for part in _PARTS]
    links[-1] = combined([links[-1], _content(_JAW).seen_from(_frame(_JAW))])
    n = len(_PARTS)
    return Arm(
        name="so101",
        joint_names=tuple(part.joint for part in _PARTS),
        offset=np.array([_frame(part) for part in _PARTS]),
        axis=np.tile([0.0, 0.0, 1.0], (n, 1)),
        tip=pose_of(rotation_of(np.array(_TCP_QUATERNION)), np.array(_TCP_POSITION)),
        lower=np.array([part.limits[0] for part in _PARTS]),
        upper=np.array([part.limits[1] for part in _PARTS]),
        max_speed=np.full(n, _MAX_SPEED_RPM * 2 * np.pi / 60),
        mass=np.array([link.mass for link in links]),
        com=np.array([link.com for link in links]),
        inertia=np.array([link.inertia for link in links]),
        rest=np.radians(_SO101_REST_DEG),
        targets=Box(lower=np.array([0.289, -0.096, 0.173]), upper=np.array([0.384, 0.095, 0.267])),
        floor=0.019,
        encoder_step=2 * np.pi / _COUNTS,
        servo_acceleration=_ACCELERATION,
        servos=(_SERVO,) * n,
    )


def _content(part: _MjcfBody) -> SpatialInertia:
    return SpatialInertia(mass=part.mass, com=np.array(part.com), inertia=inertia_matrix(part.inertia))


def _frame(part: _MjcfBody) -> Array:
    return pose_of(rotation_of(np.array(part.quaternion)), np.array(part.position))
