"""Arms: geometry, limits, masses; kinematics; the catalogue and arms from files."""

from rejoint.arms.arm import Arm, Array, Box, Index, Loaded, Mask, differing, mycobot280, so101
from rejoint.arms.collision import clearances, collides
from rejoint.arms.kinematics import (
    Displacement,
    clip_norm,
    dls,
    frames,
    gravity_torque,
    heights,
    jacobian,
    levers,
    link_inertia,
    position_kinematics,
    solve_position,
    tcp_pose,
    tcp_position,
)
from rejoint.arms.loading import CATALOGUE, ArmLike, load_arm, read_arm, write_arm_toml
from rejoint.arms.planning import JointTrajectory, PlanningError, plan
from rejoint.arms.postures import Motors, choose_postures

__all__ = [
    "CATALOGUE", "Arm", "ArmLike", "Array", "Box", "Displacement", "Index", "JointTrajectory", "Loaded", "Mask",
    "Motors", "PlanningError", "choose_postures", "clearances", "clip_norm", "collides", "differing", "dls",
    "frames", "gravity_torque", "heights", "jacobian", "levers", "link_inertia", "load_arm", "mycobot280", "plan",
    "position_kinematics", "read_arm", "so101", "solve_position", "tcp_pose", "tcp_position", "write_arm_toml",
]  # fmt: skip
