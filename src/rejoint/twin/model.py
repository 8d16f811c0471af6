"""From an arm to a MuJoCo model: a serial chain whose joints are driven by position servos.

This is the twin's physics. It never imports `rejoint.robots.lab.plant` and shares no code with it, for the
reason given in `rejoint.twin.parameters`.

Per joint: torque = clip(stiffness (command + offset - q), +-limit) - damping qdot - dry friction.
Delay and reference ramp act on the command before it reaches the model (`rejoint.twin.reference`).
Contacts and joint stops are left out, since the guard keeps commands away from both; a table can be put
under the tip, to replay logs of an arm that has touched its own (`rejoint.twin.table`).

Three settings matter. Dry friction must hold: with MuJoCo's default solver settings a joint creeps about
1 deg/s near the friction limit, with its hardest ones up to 0.01, which is half a degree in a log of a minute
(measured), with those here below 1e-4 deg/s. The constraint Jacobian stays dense, since the sparse Cholesky
factorisation of MuJoCo 4.0.0 has a known fault. And the solver is projected Gauss-Seidel: a step of a moving arm
costs 30 % less than with Newton's method, which moreover stops too early on friction this hard: joints that should
rest slide by degrees (measured).
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.kinematics import GRAVITY
from rejoint.system.errors import InputError
from rejoint.twin.declaration import TIMESTEP
from rejoint.twin.friction import friction_fields
from rejoint.twin.parameters import TwinParameters
from rejoint.twin.tablemodel import add_table

FRICTION_IMPEDANCE = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""solimp of the friction constraints (MuJoCo, modelling, solver parameters): nearly rigid"""
FRICTION_SOFTNESS = 0.01
"""On top of it, factor on MuJoCo's estimate of what a torque accelerates (``dof_invweight0``), to which the softness of
friction constraints, and of no others here, is proportional (chosen: below it nothing changes)"""

TCP_SITE = "tcp"


def twin_model(
    arm: Arm,
    parameters: TwinParameters,
    timestep: float = TIMESTEP,
    gravity_scale: float = 1.0,
    table: bool = False,
) -> mujoco.MjModel:
    """Compile the model of one twin; actuators and joints are in the arm's order, with its names.

    With ``table`` it stands on a plane, to be placed with `rejoint.twin.table.table_fields`.
    """
    if parameters.shape or parameters.joints != arm.joints:
        raise InputError(
            f"twin: parameters of shape {parameters.stiffness_shape}, expected one twin of {arm.joints} joints"
        )
    model = twin_spec(arm, table).compile()
    for name, value in model_fields(parameters, np.asarray(timestep), np.asarray(gravity_scale)):
        if name == "opt.timestep":
            model.opt.timestep = float(value)
        elif name == "opt.gravity":
            model.opt.gravity = value
        else:
            getattr(model, name)[:] = value
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.dof_invweight0 *= FRICTION_SOFTNESS
    return model


def model_fields(parameters: TwinParameters, timestep: Array, gravity_scale: Array) -> Iterator[tuple[str, Array]]:
    """Yield every field of the model that a twin decides, as (name, value), for any leading shape.

    The only place where parameters become physics: a single model and a batch are both filled from
    here. ``timestep`` [s] and ``gravity_scale`` have the parameters' leading shape or none.
    """
    p, shape = parameters, parameters.stiffness_shape
    timestep = np.broadcast_to(timestep, p.shape)
    gain = np.zeros((*shape, mujoco.mjNGAIN))
    gain[..., 0] = p.stiffness
    bias = np.zeros((*shape, mujoco.mjNBIAS))
    bias[..., 0], bias[..., 1] = p.stiffness * p.offset, -p.stiffness
    yield "actuator_gainprm", gain
    yield "actuator_biasprm", bias
    yield "actuator_forcerange", np.stack([-p.torque_limit, p.torque_limit], axis=-1)
    yield from friction_fields(p)
    yield "dof_armature", p.armature
    yield "dof_solref", np.broadcast_to(friction_solref(timestep)[..., None, :], (*shape, 2))
    yield "opt.timestep", timestep
    yield "opt.gravity", np.broadcast_to(gravity_scale, p.shape)[..., None] * GRAVITY


def friction_solref(timestep: Array) -> Array:
    """Solref (..., 2) of the friction constraints: as fast as the time step (...) [s] allows, without bounce."""
    return np.stack([2.0 * timestep, np.ones_like(timestep)], axis=-1)


def twin_spec(arm: Arm, table: bool = False) -> mujoco.MjSpec:
    """Describe the model of an arm without the parameters of a twin; actuators and joints in the arm's order."""
    spec = mujoco.MjSpec()
    spec.modelname = arm.name
    option = spec.option
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.solver = mujoco.mjtSolver.mjSOL_PGS
    disable = mujoco.mjtDisableBit
    option.disableflags |= (
        disable.mjDSBL_CONTACT | disable.mjDSBL_LIMIT | disable.mjDSBL_EQUALITY | disable.mjDSBL_SENSOR
        | disable.mjDSBL_SPRING | disable.mjDSBL_ISLAND
    )  # fmt: skip
    body = spec.worldbody
    for i, name in enumerate(arm.joint_names):
        body = body.add_body(name=f"link{i + 1}", pos=arm.offset[i, :3, 3], quat=_quaternion(arm.offset[i, :3, :3]))
        body.explicitinertial = True
        body.mass, body.ipos = arm.mass[i], arm.com[i]
        inertia = arm.inertia[i]
        body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        # A value above zero, so that MuJoCo reserves the friction constraints; the writer sets the real one.
        body.add_joint(name=name, axis=arm.axis[i], frictionloss=1.0, solimp_friction=FRICTION_IMPEDANCE)
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=1.0)
        servo.forcelimited, servo.forcerange = True, (-1.0, 1.0)
    if table:
        add_table(spec, body, arm.tip[:3, 3])
    body.add_site(name=TCP_SITE, pos=arm.tip[:3, 3], quat=_quaternion(arm.tip[:3, :3]))
    return spec


def _quaternion(rotation: Array) -> Array:
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    return quaternion
