"""How far a predicted motion is from the measured one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, tcp_position


@dataclass(frozen=True, kw_only=True, eq=False)
class PredictionError:
    """Distance between predicted and measured motion, root mean square over time."""

    joints: Array
    """(n,) [rad]"""
    joint: float
    """[rad] over all joints"""
    tcp: float
    """[m] of the TCP by forward kinematics of the encoders"""


def prediction_error(arm: Arm, predicted: Array, measured: Array) -> PredictionError:
    """Compare positions (T, n) [rad]; the error of "no twin" is that of the command as the prediction."""
    difference = predicted - measured
    joints = np.sqrt(np.mean(difference**2, axis=0))
    gap = tcp_position(arm, predicted) - tcp_position(arm, measured)
    tcp = np.sqrt(np.mean(np.sum(gap**2, axis=-1)))
    return PredictionError(joints=joints, joint=float(np.sqrt(np.mean(difference**2))), tcp=float(tcp))
