"""Where a displaced arm's tool is, how that changes with every parameter, and how much of it chance decides.

A joint that gravity presses to a flank of its play lies there each time. One without weight floats: where it came to
lie depends on how the arm got there, so its play is no shift but a scatter along the direction in which it moves the
tool. A fit that took that scatter for noise of equal size in all directions would trust the wrong coordinates.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rejoint.arms import Arm, Array, Displacement, frames, gravity_torque, position_kinematics
from rejoint.arms.displacement import FLOATING, direction
from rejoint.arms.size import length_size
from rejoint.diagnosis.calibration.parameters import Layout, displacement_of, gravity_of

FLOOR = 1e-3
"""[m] standard deviation, over the reach of a myCobot 280, of what no displacement explains (chosen: runout of gears,
ripple and a simplified law of play leave 0.5 to 1 mm on emulated worn arms)"""
SCATTER = 0.45
"""Variance of where a floating joint lies in its play, by the square of half of it: a third where every place is as
likely, one where it always lies at a flank (chosen on emulated worn arms)"""
_STEP = 1e-6  # [rad] for the derivative of the direction of gravity


def linearised(
    arm: Arm, layout: Layout, vector: Array, position: Array, approach: Array | None = None
) -> tuple[Array, Array]:
    """Return the tool (M, 3) [m] at encoder positions (M, n) and its derivative (M, 3, k) by the arm's parameters.

    ``approach`` (M, n) [rad] is where the encoders came from, as in `Displacement.joints`.
    """
    displacement = displacement_of(layout, vector)
    moved = displacement.moved(arm)
    torque = displacement.torque(arm, position)
    side = np.tanh(torque / FLOATING)
    free, came = 1.0 - side**2, direction(position, approach)
    joints = displacement.joints(arm, position, approach)
    tool, lever = position_kinematics(moved, joints)
    derivative = np.zeros((*position.shape[:-1], 3, layout.body))
    derivative[..., layout.at("offset")] = lever
    derivative[..., layout.at("compliance")] = -lever * torque[:, None, :]
    derivative[..., layout.at("play")] = -0.5 * lever * (side - displacement.carry * free * came)[:, None, :]
    derivative[..., layout.at("carry")] = 0.5 * lever * (displacement.play * free * came)[:, None, :]
    # torque moves joints by flex and by the side of the play
    turning = 0.5 * displacement.play * free / FLOATING * (1.0 + 2.0 * displacement.carry * side * came)
    yielding = -lever * (displacement.compliance + turning)[:, None, :]
    for i in range(arm.joints):
        only = np.where(np.arange(arm.joints) == i, arm.mass, 0.0)
        one = gravity_torque(replace(arm, mass=only), position, displacement.gravity)
        derivative[..., layout.at("mass").start + i] = np.einsum("mij,mj->mi", yielding, one)
    loaded = replace(arm, mass=arm.mass * displacement.mass)
    tilt = vector[layout.at("tilt")]
    for i, step in enumerate(_STEP * np.eye(2)):
        turn = (gravity_of(tilt + step) - gravity_of(tilt - step)) / (2 * _STEP)
        one = gravity_torque(loaded, position, turn)
        derivative[..., layout.at("tilt").start + i] = np.einsum("mij,mj->mi", yielding, one)
    derivative[..., layout.at("twist")] = _by_twist(moved, joints, tool)
    return tool, derivative


def _by_twist(arm: Arm, joints: Array, tool: Array) -> Array:
    """Derivative (M, 3, 6 n + 6) of the tool by small errors of the transforms to joint frames and TCP."""
    f, count = frames(arm, joints), len(joints)
    first = np.broadcast_to(np.eye(3), (count, 1, 3, 3))
    turned = np.concatenate([first, f.rotation], axis=1)  # frame before each transform
    place = np.concatenate([np.zeros((count, 1, 3)), f.position], axis=1)
    axes = np.swapaxes(turned, -1, -2)  # (M, n + 1, 3 axes, 3)
    swing = np.cross(axes, (tool[:, None] - place)[:, :, None, :])
    both = np.concatenate([axes, swing], axis=2)  # (M, n + 1, 6, 3)
    return np.moveaxis(both.reshape(count, 6 * (arm.joints + 1), 3), 1, 2)


def scatter(arm: Arm, displacement: Displacement, position: Array) -> Array:
    """Covariance (..., 3, 3) [m^2] of the tool by joints that float in their play at ``position`` (..., n) [rad]."""
    lever = position_kinematics(arm, position)[1]
    free = 1.0 - np.tanh(displacement.torque(arm, position) / FLOATING) ** 2
    variance = SCATTER * (0.5 * displacement.play) ** 2 * free
    return np.asarray((lever * variance[..., None, :]) @ np.swapaxes(lever, -1, -2))


def floor_of(arm: Arm) -> float:
    """[m] standard deviation of each coordinate by what no displacement explains, on an arm of this size."""
    return FLOOR * length_size(arm)
