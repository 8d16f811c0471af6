"""Where a displaced arm's tool is, how that changes with every parameter, and how much of it chance decides.

A joint that gravity presses to a flank of its play lies there each time. One without weight floats: where it came to
lie depends on how the arm got there, so its play is no shift but a scatter along the direction in which it moves the
tool. A fit that took that scatter for noise of equal size in all directions would trust the wrong coordinates.
"""

from __future__ import annotations

from statistics import NormalDist

import numpy as np

from rejoint.arms import Arm, Array, Displacement, frames, position_kinematics
from rejoint.arms.displacement import FLOATING, direction
from rejoint.arms.size import length_size
from rejoint.diagnosis.calibration.parameters import DisplacementLayout, displacement_of, gravity_of

FLOOR = 0.5e-3
"""[m] standard deviation, over the reach of a myCobot 280, of what no displacement explains (chosen: runout of gears,
ripple and a simplified law of play leave 0.5 to 1 mm on emulated worn arms)"""
SCATTER = 1.0 / 3.0
"""Variance of where a floating joint lies in its play, by the square of half of it: a third where every place is as
likely, one where it always lies at a flank (chosen on emulated worn arms)"""
_STEP = 1e-6  # [rad] for the derivative of the direction of gravity
_DRAWS = np.array([NormalDist().inv_cdf((k + 0.5) / 64) for k in range(64)])  # of a torque that is not known exactly


def linearised(
    arm: Arm, layout: DisplacementLayout, vector: Array, position: Array, approach: Array | None = None, *,
    flanks: bool = True,
) -> tuple[Array, Array]:  # fmt: skip
    """Return the tool (M, 3) [m] at encoder positions (M, n) and its derivative (M, 3, k) by the arm's parameters.

    ``approach`` (M, n) [rad] is where the encoders came from, as in `Displacement.joints`. Without ``flanks`` the
    derivative leaves out that joints change the flank of their play: as a slope that holds within `FLOATING` alone.
    """
    displacement = displacement_of(layout, vector)
    moved, loads = displacement.moved(arm), link_loads(arm, position)
    torque = loads @ displacement.gravity @ displacement.mass
    side = np.tanh(torque / FLOATING)
    free, came = 1.0 - side**2, direction(position, approach)
    ahead = side - displacement.carry * free * came
    joints = position + displacement.offset - displacement.compliance * torque - 0.5 * displacement.play * ahead
    tool, lever = position_kinematics(moved, joints)
    derivative = np.zeros((*position.shape[:-1], 3, layout.body))
    derivative[..., layout.at("offset")] = lever
    derivative[..., layout.at("compliance")] = -lever * torque[:, None, :]
    derivative[..., layout.at("play")] = -0.5 * lever * ahead[:, None, :]
    derivative[..., layout.at("carry")] = 0.5 * lever * (displacement.play * free * came)[:, None, :]
    # torque moves joints by flex and by the side of the play
    turning = 0.5 * displacement.play * free / FLOATING * (1.0 + 2.0 * displacement.carry * side * came)
    yielding = -lever * (displacement.compliance + flanks * turning)[:, None, :]
    slopes = torque_slopes(layout, vector, loads)
    for name in ("mass", "tilt"):
        derivative[..., layout.at(name)] = yielding @ slopes[..., layout.at(name)]
    if len(position):
        derivative[..., layout.at("twist")] = _by_twist(moved, joints, tool)
    return tool, derivative


def torque_slopes(layout: DisplacementLayout, vector: Array, loads: Array) -> Array:
    """Return the derivative (M, n, k) [N m] of the torques by the arm's parameters, from its `link_loads`."""
    displacement, tilt = displacement_of(layout, vector), vector[layout.at("tilt")]
    slopes = np.zeros((*loads.shape[:2], layout.body))
    slopes[..., layout.at("mass")] = loads @ displacement.gravity
    for i, step in enumerate(_STEP * np.eye(2)):
        turn = (gravity_of(tilt + step) - gravity_of(tilt - step)) / (2 * _STEP)
        slopes[..., layout.at("tilt").start + i] = loads @ turn @ displacement.mass
    return slopes


def link_loads(arm: Arm, position: Array) -> Array:
    """Return what each link weighs on each joint: (M, n joints, n links, 3) [N m / (m/s^2)], torque by acceleration."""
    f = frames(arm, position)
    com = f.position + np.einsum("mnij,nj->mni", f.rotation, arm.com)
    away = com[:, None] - f.position[:, :, None]
    carried = np.triu(np.ones((arm.joints, arm.joints)))[..., None] * arm.mass[:, None]
    return -carried * np.cross(f.axis[:, :, None], away)


def _by_twist(arm: Arm, joints: Array, tool: Array) -> Array:
    """Return the derivative (M, 3, 6 n + 6) of the tool by small errors of the transforms to joint frames and TCP."""
    f, count = frames(arm, joints), len(joints)
    first = np.broadcast_to(np.eye(3), (count, 1, 3, 3))
    turned = np.concatenate([first, f.rotation], axis=1)  # frame before each transform
    place = np.concatenate([np.zeros((count, 1, 3)), f.position], axis=1)
    axes = np.swapaxes(turned, -1, -2)  # (M, n + 1, 3 axes, 3)
    swing = np.cross(axes, (tool[:, None] - place)[:, :, None, :])
    both = np.concatenate([axes, swing], axis=2)  # (M, n + 1, 6, 3)
    return np.moveaxis(both.reshape(count, 6 * (arm.joints + 1), 3), 1, 2)


def scatter(arm: Arm, displacement: Displacement, position: Array, doubt: Array | None = None) -> Array:
    """Covariance (..., 3, 3) [m^2] of the tool by joints that float in their play at ``position`` (..., n) [rad].

    With the ``doubt`` (..., n) [N m], the standard deviation of each torque, also by those that may lie on the other
    flank than their torque says. No joint leaves its play, however large the doubt is.
    """
    lever, torque = position_kinematics(arm, position)[1], displacement.torque(arm, position)
    side = np.tanh(torque / FLOATING)
    free, other = 1.0 - side**2, np.zeros_like(side)
    if doubt is not None:
        sides = np.tanh((torque[..., None] + doubt[..., None] * _DRAWS) / FLOATING)
        free = (1.0 - sides**2).mean(axis=-1)
        other = ((sides - side[..., None]) ** 2).mean(axis=-1)
    variance = (0.5 * displacement.play) ** 2 * (SCATTER * free + other)
    return np.asarray((lever * variance[..., None, :]) @ np.swapaxes(lever, -1, -2))


def floor_of(arm: Arm) -> float:
    """[m] standard deviation of each coordinate by what no displacement explains, on an arm of this size."""
    return FLOOR * length_size(arm)
