"""Repaired arms as robots of LeRobot: ``--robot.type=rejoint_so101``, ``rejoint_koch`` or ``rejoint_viperx``."""

from .config import RejointKochConfig, RejointSo101Config, RejointViperxConfig
from .robot import RejointKoch, RejointSo101, RejointViperx

__all__ = [
    "RejointKoch",
    "RejointKochConfig",
    "RejointSo101",
    "RejointSo101Config",
    "RejointViperx",
    "RejointViperxConfig",
]
