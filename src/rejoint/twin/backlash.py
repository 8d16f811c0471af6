"""Backlash inside the servo loop: motors and joints that are not always in contact.

An unloaded joint rests anywhere between the flanks; to turn it back the motor first crosses the backlash. Logs do not
separate it from friction: only training draws it.

Out of contact, motor and joint are two bodies; they exchange momentum when they meet (Nordin and Gutman 2002).
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, link_inertia
from rejoint.arms.workspace import unloaded_joints
from rejoint.control.robot import Mask
from rejoint.twin.friction import dry_friction
from rejoint.twin.parameters import TwinParameters

if TYPE_CHECKING:
    from rejoint.twin.simulation import Twins

RESTITUTION = 0.5
"""Of motor and joint; chosen: greased steel"""

SOFT = 0.01
"""[rad/s] closing speed without rebound; chosen"""

_MOTOR = ("stiffness", "damping", "armature", "torque_limit", "offset")
_DAMPING, _ARMATURE = _MOTOR.index("damping"), _MOTOR.index("armature")

_dry_friction = njit(cache=True, nogil=True)(dry_friction)


class Backlash:
    """Motors of N arms of n joints in their backlash."""

    def __init__(self, arm: Arm, count: int) -> None:
        shape = (count, arm.joints)
        self._arm = arm
        self._half, self._ahead, self._speed = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._touch = np.ones(shape)  # 1 and -1: at the flanks, 0 between them
        self._grease, self._motor = np.zeros((count, 1)), np.ones((*shape, len(_MOTOR)))

    @cached_property
    def _unloaded(self) -> NDArray[np.bool_]:
        """(n,) joints on no flank."""
        return unloaded_joints(self._arm)

    @cached_property
    def _link(self) -> Array:
        """(n,) [kg m^2] inertia at a motor."""
        return link_inertia(self._arm, self._arm.rest)

    @property
    def present(self) -> bool:
        """Whether any arm has backlash."""
        return bool(self._half.any())

    def renew(self, twin: TwinParameters, backlash: Array, grease: Array, where: Mask) -> None:
        """Start the arms (m,) in ``where`` (N,), motors in the middle of the ``backlash`` (m, n) [rad].

        ``grease`` (m,): damping of a joint in the backlash relative to its motor's.
        """
        self._half[where] = 0.5 * backlash * self._unloaded if backlash.any() else 0.0
        self._ahead[where] = self._speed[where] = 0.0
        self._touch[where] = np.where(self._half[where] > 0.0, 0.0, 1.0)
        self._grease[where] = grease[:, None]
        self._motor[where] = np.stack([getattr(twin, name) for name in _MOTOR], axis=-1)

    def part(self, twins: Twins, terms: Array, friction: Array) -> None:
        """Separate motors from joints for one step of ``twins`` with set references.

        Joints out of contact get no torque, motor inertia, damping and ``friction`` (N, n) [N m]; ``terms`` (t, N, n)
        as in `rejoint.twin.friction`.
        """
        if not self.present:
            return
        of_motor = _dry_friction(terms, np.where(self._touch == 0.0, self._speed, twins.qvel))
        gear, arm = (self._half, self._ahead, self._speed, self._touch), (twins.ctrl, twins.qpos, twins.qvel)
        _drive(gear, of_motor, self._motor, self._link, arm, twins.timestep)
        free = self._touch == 0.0
        twins.set_motors(
            armature=np.where(free, 0.0, self._motor[..., _ARMATURE]),
            damping=self._motor[..., _DAMPING] * np.where(free, self._grease, 1.0),
        )
        friction[free] = 0.0


@njit(cache=True, nogil=True)
def _drive(gear, friction, motor, link, arm, step):  # noqa: ANN001, ANN202
    (half, ahead, speed, touch), (ctrl, qpos, qvel) = gear, arm
    for i in range(half.shape[0]):
        for j in range(half.shape[1]):
            edge = half[i, j]
            if edge == 0.0:
                continue
            stiffness, damping, armature, limit, offset = motor[i, j]
            most = friction[i, j]
            torque = min(max(stiffness * (ctrl[i, j] + offset - qpos[i, j]), -limit), limit)
            if touch[i, j] != 0.0:
                v = qvel[i, j]
                at_rest = abs(v) < 1e-3
                net = torque - np.sign(torque if at_rest else v) * most - damping * v
                if (at_rest and abs(torque) <= most) or net * touch[i, j] >= 0.0:
                    continue  # the motor pushes, or both stand still
                touch[i, j], speed[i, j] = 0.0, v
            ctrl[i, j] = qpos[i, j] - offset
            v = speed[i, j]
            if v != 0.0 or abs(torque) > most:
                against = np.sign(v) if v != 0.0 else np.sign(torque)
                h = step[i] / armature
                v = (v + h * (torque - against * most)) / (1.0 + h * damping)
                v = v if v * against > 0.0 else 0.0  # friction stops a motor, it does not turn it back
            place = ahead[i, j] + step[i] * (v - qvel[i, j])
            if abs(place) >= edge:
                place = np.sign(place) * edge
                closing, whole = v - qvel[i, j], armature + link[j]
                common = (armature * v + link[j] * qvel[i, j]) / whole
                bounce = RESTITUTION if abs(closing) > SOFT else 0.0
                v = common - bounce * closing * link[j] / whole
                qvel[i, j] = common + bounce * closing * armature / whole
                if bounce == 0.0:
                    touch[i, j] = np.sign(place)
            ahead[i, j], speed[i, j] = place, v
