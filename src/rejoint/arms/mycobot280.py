"""Elephant Robotics myCobot 280 Pi in the vendor's convention (all zero: the arm stands upright).

Sources
-------
Geometry: the standard DH table of the vendor's manual for the myCobot 280 Pi 2023
(``SDH.png`` in elephantrobotics/mycobot_docs). Park et al. 2024, Table 1, is the same mechanism with
the joint offsets dropped and d5 0.95 mm shorter; a test shows it.
Limits: the vendor's manual and the limit table of pymycobot 4.0.7. Speed 150 deg/s: same manual.
Encoders: 4096 steps a turn (same manual).
Masses: the vendor publishes none beyond the total of 0.86 kg. The moving links are
estimates that sum, with a base of 0.14 kg, to 0.85 kg; inertias are those of solid
cylinders of 25 mm radius (chosen) between the joints.
Target region: Park et al. 2024, section IV-A.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms.arm import Arm, Box, DhRow, dh_chain
from rejoint.arms.inertia import cylinder, link_ends

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
"""Table 1 of Park et al. 2024."""

PAPER_ANGLE_SHIFT = np.radians([180.0, -90.0, 0.0, 90.0, 90.0, 0.0])
"""Angles of the paper's table minus the vendor's, for the same posture."""

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
"""Elbow up, flange down, TCP inside the target region (chosen)."""
