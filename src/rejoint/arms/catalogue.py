"""The arms of the catalogue: descriptions in ``models`` that name their sources."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from rejoint.arms.arm import Arm

MODELS = Path(__file__).parent / "models"


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
