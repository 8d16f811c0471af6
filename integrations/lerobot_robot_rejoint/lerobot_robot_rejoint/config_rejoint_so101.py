"""What the owner says on LeRobot's command line."""

from dataclasses import dataclass, field

from lerobot.cameras import CameraConfig
from lerobot.robots.config import RobotConfig


@RobotConfig.register_subclass("rejoint_so101")
@dataclass(kw_only=True)
class RejointSo101Config(RobotConfig):
    """An SO-101 that `rejoint` has repaired. Angles are LeRobot's degrees; the gripper goes from 0 to 100."""

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
            raise ValueError("rejoint_so101 speaks degrees; set use_degrees=true, also of the teleoperator")
