"""The rigid bodies of the plant: an arm as a MuJoCo model with two hinges per axis.

Hinge 2i is the servo output of axis i; it carries the reflected inertia of motor and gear as
armature. Hinge 2i+1 on the same axis is what lies behind it, gear play and link compliance.
Nothing else is left to MuJoCo: gravity, motor, friction, play and flex reach it as applied torques,
so contacts, limits and constraints are off.

This module shares no code with `rejoint.twin`, on purpose (see the package docstring).
"""

from __future__ import annotations

import mujoco
import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.kinematics import GRAVITY
from rejoint.robots.lab.plant.servo import STEP

_DISABLED = (
    mujoco.mjtDisableBit.mjDSBL_CONSTRAINT,
    mujoco.mjtDisableBit.mjDSBL_CONTACT,
    mujoco.mjtDisableBit.mjDSBL_ACTUATION,
    mujoco.mjtDisableBit.mjDSBL_SENSOR,
    mujoco.mjtDisableBit.mjDSBL_SPRING,
    mujoco.mjtDisableBit.mjDSBL_DAMPER,
    mujoco.mjtDisableBit.mjDSBL_WARMSTART,
    mujoco.mjtDisableBit.mjDSBL_AUTORESET,
)
_ARMATURE = {"servo": 0.01, "gear": 0.001}
"""[kg m^2] placeholders that keep the inertia matrix regular while MuJoCo compiles the chain."""


def build_model(arm: Arm, gravity: Array = GRAVITY) -> mujoco.MjModel:
    """Compile the chain of ``arm`` with 2n hinges under ``gravity`` (3,); the plant sets the armatures of each arm."""
    spec = mujoco.MjSpec()
    spec.option.gravity = gravity
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    for flag in _DISABLED:
        spec.option.disableflags |= flag
    body = spec.worldbody
    for i, name in enumerate(arm.joint_names):
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, arm.offset[i, :3, :3].flatten())
        inertia = arm.inertia[i]
        body = body.add_body(
            name=name,
            pos=arm.offset[i, :3, 3],
            quat=quaternion,
            mass=arm.mass[i],
            ipos=arm.com[i],
            fullinertia=[*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]],
            explicitinertial=True,
        )
        for part, armature in _ARMATURE.items():
            body.add_joint(name=f"{name}/{part}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=arm.axis[i], armature=armature)
    return spec.compile()
