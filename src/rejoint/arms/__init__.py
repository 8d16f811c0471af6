"""What an arm is: geometry, limits, masses; forward and inverse kinematics; the catalogue."""

from collections.abc import Callable

from rejoint.arms.arm import Arm, Array, Box
from rejoint.arms.inverse import Solution, clip_norm, dls, solve_position
from rejoint.arms.kinematics import frames, gravity_torque, jacobian, position_jacobian, tcp_pose, tcp_position
from rejoint.arms.mycobot280 import mycobot280
from rejoint.errors import InputError

CATALOGUE: dict[str, Callable[[], Arm]] = {"mycobot280": mycobot280}


def load_arm(name: str) -> Arm:
    """Build the arm of the catalogue called ``name``; InputError names the alternatives."""
    if name not in CATALOGUE:
        raise InputError(f"no arm is called {name!r}; known arms: {', '.join(sorted(CATALOGUE))}")
    return CATALOGUE[name]()


__all__ = [
    "CATALOGUE", "Arm", "Array", "Box", "Solution", "clip_norm", "dls", "frames", "gravity_torque", "jacobian",
    "load_arm", "mycobot280", "position_jacobian", "solve_position", "tcp_pose", "tcp_position",
]  # fmt: skip
