"""What the owner says on LeRobot's command line."""

from dataclasses import dataclass, field

from lerobot.cameras import CameraConfig
from lerobot.robots.config import RobotConfig


@dataclass(kw_only=True)
class RejointConfig(RobotConfig):
    """An arm that `rejoint` has repaired. Angles are LeRobot's degrees; the gripper goes from 0 to 100."""

    port: str
    """of the arm: a device, or the address that `rejoint` was given, which may hold zeros and gains"""
    run: str
    """run folder of the repair"""
    rejoint: str = "rejoint"
    """the program, in its own environment"""
    period_ms: float = 20.0
    """control period of the arm, whatever LeRobot's own rate is"""
    use_degrees: bool = True
    """nothing else is offered"""
    cameras: dict[str, CameraConfig] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what is not offered."""
        super().__post_init__()
        if not self.use_degrees:
            raise ValueError("rejoint speaks degrees; set use_degrees=true, also of the teleoperator")


@RobotConfig.register_subclass("rejoint_so101")
@dataclass(kw_only=True)
class RejointSo101Config(RejointConfig):
    """An SO-100 or SO-101."""


@RobotConfig.register_subclass("rejoint_koch")
@dataclass(kw_only=True)
class RejointKochConfig(RejointConfig):
    """A Koch v1.1 follower."""


@RobotConfig.register_subclass("rejoint_viperx")
@dataclass(kw_only=True)
class RejointViperxConfig(RejointConfig):
    """A ViperX 300S or WidowX 250S."""
