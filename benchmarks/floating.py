"""What chance leaves of the true error, however well an arm is calibrated: links that float in their backlash.

    python -m benchmarks floating --arms 40

Emulated worn arms are held at fresh targets, not calibrated, and where each link lies beyond its encoder is read from
the plant. For each joint of each arm that is then fitted by the terms of a calibration (offset, load, side of the
backlash, side it came from) in the very targets that are judged: without noise and after the fact. What is left is
chance, and no calibration from measured points leaves less. Printed [mm], mean / 95th percentile: what the encoders
miss, what the links of joint 1 and of all joints add by chance, and encoders and links together.
"""

from dataclasses import replace

import numpy as np

from benchmarks.frame import cell
from rejoint.arms import Arm, Array, gravity_torque, mycobot280, tcp_position
from rejoint.arms.kinematics import GRAVITY, floating
from rejoint.arms.rotations import turned
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.loop import Schedule, run
from rejoint.control.targets import draw_targets
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.research.evaluation.family import FAMILY_SIZE, WORN, ArmFamily, open_family

CARRIED = np.radians(1.0)
"""[rad] shortest motion with a direction; chosen"""


def held(robot: EmulatedRobot, targets: Array) -> tuple[Array, Array]:
    """Return encoders, and links beyond them, (A, K, n) [rad] at the end of each hold of ``targets`` (A, K, 3) [m]."""
    read, beyond = [], []
    for k in range(targets.shape[1]):
        run(
            robot,
            make_controller("feedforward", robot.arm),
            targets[:, k : k + 1],
            Schedule(dwell=Protocol().hold, keep_going=True),
        )
        read.append(robot.plant.encoder())
        beyond.append(robot.plant.link_position() - read[-1])
    return np.stack(read, axis=1), np.stack(beyond, axis=1)


def by_chance(arm: Arm, read: Array, beyond: Array, tilt: float) -> Array:
    """Return what the terms of a calibration, fitted to ``beyond`` itself, leave of it (A, K, n) [rad]."""
    came = np.concatenate([np.broadcast_to(arm.rest, read[:, :1].shape), read[:, :-1]], axis=1)
    gravity = turned(np.array([tilt, 0.0, 0.0])) @ GRAVITY
    load, left = gravity_torque(arm, read, gravity), np.empty_like(beyond)
    side = np.tanh(load / floating(arm))
    terms = np.stack([np.ones_like(load), load, side, (1.0 - side**2) * np.tanh((read - came) / CARRIED)], axis=-1)
    for i, j in np.ndindex(len(read), arm.joints):
        share = np.linalg.lstsq(terms[i, :, j], beyond[i, :, j], rcond=None)[0]
        left[i, :, j] = beyond[i, :, j] - terms[i, :, j] @ share
    return left


def main(arms: int = 40, targets: int = 20, slope: float = 0.0) -> None:
    """Print what chance leaves; ``slope`` [deg] raises the base on one side."""
    arm, drawn = mycobot280(), ArmFamily(arms=arms, targets=targets)
    places = draw_targets(arm, sets=arms, count=targets, seed=FAMILY_SIZE + 1)
    tilt = np.radians(slope)
    robot = open_family(arm, replace(WORN, tilt_deg=slope), drawn)
    read, beyond = held(robot, places)
    left, reached = by_chance(arm, read, beyond, tilt), tcp_position(arm, read)
    first = np.concatenate([left[..., :1], np.zeros_like(left[..., 1:])], axis=-1)
    for name, off in {
        "encoders": reached - places,
        "joint 1 by chance": tcp_position(arm, read + first) - reached,
        "all joints by chance": tcp_position(arm, read + left) - reached,
        "encoders and joints": tcp_position(arm, read + left) - places,
    }.items():
        print(f"{name:22s} {cell(1e3 * np.linalg.norm(off, axis=-1))}", flush=True)
