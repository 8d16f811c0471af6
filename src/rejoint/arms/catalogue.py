"""The arms of the catalogue: descriptions in ``models`` that name their sources, and two tables of one mechanism."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

from rejoint.arms.arm import Arm, DhRow

MODELS = Path(__file__).parent / "models"

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


def mycobot280() -> Arm:
    """Return the myCobot 280 Pi."""
    return _described("mycobot280")


def so101() -> Arm:
    """Return the SO-101, joints named as in LeRobot."""
    return _described("so101")


@cache
def _described(name: str) -> Arm:
    from rejoint.arms.loading import read_arm  # late: what a description leaves open goes by the measures of a myCobot

    return read_arm(MODELS / f"{name}.toml").arm
