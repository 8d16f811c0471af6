"""Play inside the servo loop of the arms in training: motors and joints that are not always in touch.

Where an encoder sits behind the gear, a joint that carries no weight rests anywhere between the flanks of its teeth.
To turn it back the motor first has to cross the play, while the encoder shows nothing; and once it moves, nothing
but the other flank stops it. A policy that has never met that pushes on, and swings about the target: on an
arm with play of a degree and strong friction this was most of the settled error (measured). A joint that carries
weight rests on one flank, which no servo of a settled arm leaves.

The twin of identification knows no play, since logs do not tell it from friction; here it is drawn. Motor and joint
are one body as long as the motor pushes (the twin's), else two: the motor with the servo's torque, damping and
friction, and the joint free but for some grease. Where they meet, they exchange momentum and part again with some of
the closing speed, until it is small (Nordin and Gutman 2002 review such models).
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from __future__ import annotations

import numpy as np
from numba import njit

from rejoint.arms import Arm, Array, link_inertia
from rejoint.arms.size import weightless
from rejoint.control.robot import Mask
from rejoint.training.ranges import Draw
from rejoint.twin.batch import TwinBatch
from rejoint.twin.model import STRIBECK_SPEED, stribeck_friction

RESTITUTION = 0.5
"""Part of the closing speed with which motor and joint part again when they meet (chosen: steel teeth, some grease)."""

SOFT = 0.01
"""[rad/s] closing speed below which they stay in touch (chosen: an encoder count in 0.15 s)"""

_MOTOR = ("stiffness", "damping", "coulomb", "armature", "torque_limit", "offset")
_DAMPING, _COULOMB, _ARMATURE = (_MOTOR.index(name) for name in ("damping", "coulomb", "armature"))


class Play:
    """Motors of N agents of n joints, and where they stand between the flanks."""

    def __init__(self, arm: Arm, agents: int) -> None:
        shape = (agents, arm.joints)
        self._light = weightless(arm)
        self._link = link_inertia(arm, arm.rest)
        self._half, self._ahead, self._speed = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._touch = np.ones(shape)  # 1 and -1: at the flanks, 0 between them
        self._stiction, self._grease = np.ones(shape), np.zeros((agents, 1))
        self._motor = np.ones((*shape, len(_MOTOR)))

    def renew(self, draw: Draw, where: Mask) -> None:
        """Take over the arms of ``draw`` (m,) in ``where`` (N,), their motors in the middle of the play."""
        self._half[where] = 0.5 * draw.play * self._light
        self._ahead[where] = self._speed[where] = 0.0
        self._touch[where] = np.where(self._half[where] > 0.0, 0.0, 1.0)
        self._stiction[where], self._grease[where] = draw.stiction, draw.grease[:, None]
        self._motor[where] = np.stack([getattr(draw.twin, name) for name in _MOTOR], axis=-1)

    def drive(self, twins: TwinBatch, step: Array) -> None:
        """Prepare ``twins``, whose references are set, for one step of ``step`` (N,) [s].

        They get the dry friction of their speeds. Joints that are out of touch with their motors get no torque and none
        of their friction, armature and damping; those that meet them get a common speed.
        """
        friction = stribeck_friction(self._motor[..., _COULOMB], self._stiction, twins.qvel)
        if self._half.any():
            state = (self._half, self._ahead, self._speed, self._touch)
            _drive(*state, self._stiction, self._motor, self._link, twins.ctrl, twins.qpos, twins.qvel, step)
            free = self._touch == 0.0
            twins.set_motors(
                armature=np.where(free, 0.0, self._motor[..., _ARMATURE]),
                damping=self._motor[..., _DAMPING] * np.where(free, self._grease, 1.0),
            )
            friction[free] = 0.0
        twins.set_friction(friction)

    def state(self) -> dict[str, Array]:
        """Everything that a checkpoint must keep, as live arrays."""
        return {
            "half": self._half, "ahead": self._ahead, "speed": self._speed, "touch": self._touch,
            "stiction": self._stiction, "grease": self._grease, "motor": self._motor,
        }  # fmt: skip


@njit(cache=True, nogil=True)
def _friction(coulomb, stiction, speed):  # noqa: ANN001, ANN202
    """As `rejoint.twin.model.stribeck_friction`."""
    return coulomb * (1.0 + (stiction - 1.0) * np.exp(-((speed / STRIBECK_SPEED) ** 2)))


@njit(cache=True, nogil=True)
def _drive(half, ahead, speed, touch, stiction, motor, link, ctrl, qpos, qvel, step):  # noqa: ANN001, ANN202
    for i in range(half.shape[0]):
        for j in range(half.shape[1]):
            edge = half[i, j]
            if edge == 0.0:
                continue
            stiffness, damping, coulomb, armature, limit, offset = motor[i, j]
            torque = min(max(stiffness * (ctrl[i, j] + offset - qpos[i, j]), -limit), limit)
            if touch[i, j] != 0.0:
                v = qvel[i, j]
                most = _friction(coulomb, stiction[i, j], v)
                at_rest = abs(v) < 1e-3
                net = torque - np.sign(torque if at_rest else v) * most - damping * v
                if (at_rest and abs(torque) <= most) or net * touch[i, j] >= 0.0:
                    continue  # the motor pushes, or both stand still
                touch[i, j], speed[i, j] = 0.0, v
            ctrl[i, j] = qpos[i, j] - offset
            v = speed[i, j]
            most = _friction(coulomb, stiction[i, j], v)
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
