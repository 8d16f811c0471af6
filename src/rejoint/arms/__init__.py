"""What an arm is: geometry, limits, masses; forward and inverse kinematics; the catalogue and arms from files."""

from rejoint.arms.arm import Arm, Array, Box, differing
from rejoint.arms.collision import clearances, collides, segment_distance
from rejoint.arms.displacement import Displacement
from rejoint.arms.draft import Loaded
from rejoint.arms.inverse import Solution, clip_norm, dls, solve_position
from rejoint.arms.kinematics import (
    frames,
    gravity_torque,
    heights,
    jacobian,
    link_inertia,
    position_kinematics,
    tcp_pose,
    tcp_position,
)
from rejoint.arms.loading import CATALOGUE, load_arm, read_arm
from rejoint.arms.mycobot280 import mycobot280
from rejoint.arms.so101 import so101
from rejoint.arms.tomlfile import write_arm_toml

__all__ = [
    "CATALOGUE", "Arm", "Array", "Box", "Displacement", "Loaded", "Solution", "clearances", "clip_norm", "collides",
    "differing", "dls", "frames", "gravity_torque", "heights", "jacobian", "link_inertia", "load_arm", "mycobot280",
    "position_kinematics", "read_arm", "segment_distance", "so101", "solve_position", "tcp_pose", "tcp_position",
    "write_arm_toml",
]  # fmt: skip
