"""A repaired SO-101 as a robot of LeRobot: ``--robot.type=rejoint_so101``."""

from rejoint_so101 import RejointSo101

from .config_rejoint_so101 import RejointSo101Config

__all__ = ["RejointSo101", "RejointSo101Config"]
