"""The privileged observation of the critic: the twin's own state and parameters, scaled to about one.

It makes the policy's gradient less noisy (asymmetric actor-critic; Pinto et al. 2018, arXiv:1710.06542).
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.observation import Observation
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.simulation import Draw

_MOVING_SCALARS = 4
_FIXED_SCALARS = 4


def privileged_size(joints: int) -> int:
    """Length of the privileged observation."""
    return _MOVING_SCALARS + 2 * joints + _FIXED_SCALARS + 6 * joints


def privileged_constants(arm: Arm, draw: Draw) -> Observation:
    """Privileged observation (m, size) of new arms; the varying part is zero."""
    base, twin = nominal_parameters(arm), draw.twin
    scalars = np.stack(
        [
            5.0 * (draw.gravity_scale - 1.0),
            30.0 * draw.command_delay,
            30.0 * draw.readback_delay,
            np.log(twin.ramp_speed / base.ramp_speed),
        ],
        axis=-1,
    )
    parts = [
        np.log(twin.stiffness / base.stiffness),
        np.log(twin.damping / base.damping),
        np.log(twin.armature / base.armature),
        np.log(twin.torque_limit / base.torque_limit),
        0.5 * twin.coulomb / base.coulomb,
        30.0 * twin.offset,
    ]
    moving = np.zeros((len(scalars), _MOVING_SCALARS + 2 * arm.joints))
    return np.concatenate([moving, scalars, *parts], axis=-1).clip(-8.0, 8.0).astype(np.float32)


def fill_privileged(
    privileged: Observation, distance: Array, speed: Array, velocity: Array, lag: Array, period: Array
) -> None:
    """Fill in the varying part.

    ``distance`` (N,) [m] of the TCP, its ``speed`` (N,) [m/s], joint ``velocity`` (N, n) [rad/s], ``lag`` (N, n) [rad]
    behind the servo's reference, control ``period`` (N,) [s].
    """
    n = velocity.shape[1]
    privileged[:, 0] = 10.0 * distance
    privileged[:, 1] = (np.log(distance + 0.0003) + 5.0) / 2.0
    privileged[:, 2] = 3.0 * speed
    privileged[:, 3] = 30.0 * period
    privileged[:, 4 : 4 + n] = np.clip(0.5 * velocity, -8.0, 8.0)
    privileged[:, 4 + n : 4 + 2 * n] = np.clip(4.0 * lag, -8.0, 8.0)
