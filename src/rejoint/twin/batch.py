"""Many twins of one arm in lockstep by MuJoCo: the reference for `rejoint.twin.chain`, and arms on a table.

Per joint: torque = clip(stiffness (command + offset - q), +-limit) - damping qdot - dry friction, without contacts and
joint stops. Friction constraints are nearly rigid (MuJoCo's default creeps 1 deg/s, measured). The Jacobian is dense:
the sparse Cholesky of MuJoCo 4.0.0 has a fault. The solver is projected Gauss-Seidel: Newton's method stops too early
(measured).

Only the TCP touches the table, with a soft sphere.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.arms.kinematics import GRAVITY
from rejoint.system.errors import InputError
from rejoint.twin.declaration import TIMESTEP
from rejoint.twin.friction import friction_fields
from rejoint.twin.parameters import TwinParameters, nominal_parameters
from rejoint.twin.table import TablePlane

Ids = NDArray[np.integer] | NDArray[np.bool_] | None


class TwinBatch:
    """``nsim`` simulations of one arm; ``qpos``, ``qvel``, ``ctrl`` (nsim, n) are their state."""

    def __init__(self, arm: Arm, nsim: int, timestep: float = TIMESTEP, threads: int = 1, table: bool = False) -> None:
        if nsim < 1 or threads < 1:
            raise InputError(f"twin batch: {nsim} simulations on {threads} threads, expected at least one of each")
        self.arm = arm
        self._batch = Batch(twin_spec(arm, table).compile(), nsim=nsim, nthread=threads)
        self.qpos: Array = self._batch.bind("qpos")
        self.qvel: Array = self._batch.bind("qvel")
        self.ctrl: Array = self._batch.bind("ctrl")
        self._timestep = np.full(nsim, float(timestep))
        self.write(nominal_parameters(arm).repeat(nsim))

    @property
    def nsim(self) -> int:
        """Number of simulations."""
        return int(self._batch.nsim)

    @property
    def timestep(self) -> Array:
        """(nsim,) [s] of each simulation, read-only."""
        view = self._timestep.view()
        view.setflags(write=False)
        return view

    def write(
        self,
        parameters: TwinParameters,
        ids: Ids = None,
        *,
        timestep: float | Array | None = None,
        gravity_scale: float | Array = 1.0,
    ) -> None:
        """Set parameters of the simulations ``ids`` (indices or mask; default: all), not their state.

        ``parameters``: (m,) or none; ``timestep`` [s] and ``gravity_scale``: a number or (m,).
        """
        chosen = np.arange(self.nsim)[slice(None) if ids is None else ids]
        if parameters.shape == ():
            parameters = parameters.repeat(len(chosen))
        if parameters.stiffness_shape != (len(chosen), self.arm.joints):
            expected = (len(chosen), self.arm.joints)
            raise InputError(f"twin batch: parameters of shape {parameters.stiffness_shape}, expected {expected}")
        if timestep is not None:
            self._timestep[chosen] = timestep
        for name, value in model_fields(parameters, self._timestep[chosen], np.asarray(gravity_scale)):
            self._batch.expand(name)[chosen] = value
        self._batch.set_const(chosen.astype(np.int32))
        self._batch.expand("dof_invweight0")[chosen] *= FRICTION_SOFTNESS

    def put_tables(self, tables: Sequence[TablePlane]) -> None:
        """Set the tables of a batch made with ``table``, after `write`."""
        if len(tables) != self.nsim:
            raise InputError(f"twin batch: {len(tables)} tables, expected {self.nsim}")
        model = self._batch.model
        inverse_mass = self._batch.expand("body_invweight0")[:, model.geom(TIP).bodyid[0], 0]
        position, turn = self._batch.bind("mocap_pos"), self._batch.bind("mocap_quat")
        for i, table in enumerate(tables):
            position[i, 0], turn[i, 0] = table_pose(table)
            for name, value in table_fields(table, self._timestep[i], inverse_mass[i]):
                self._batch.expand(name)[i, model.geom(TIP).id] = value

    def set_timestep(self, timestep: float | Array) -> None:
        """Set the time step [s], a number or (nsim,)."""
        self._timestep[:] = timestep
        self._batch.expand("opt.timestep")[:] = self._timestep
        self._batch.expand("dof_solref")[:] = friction_solref(self._timestep)[:, None]

    def set_friction(self, friction: Array) -> None:
        """Set the dry friction (nsim, n) [N m]."""
        self._batch.expand("dof_frictionloss")[:] = friction

    def set_motors(self, *, armature: Array, damping: Array) -> None:
        """Set armature (nsim, n) [kg m^2] and damping (nsim, n) [N m s/rad]."""
        self._batch.expand("dof_armature")[:] = armature
        self._batch.expand("dof_damping")[:] = damping

    def step(self, substeps: int = 1) -> None:
        """Advance all with the present ``ctrl``."""
        self._batch.step(None, nstep=substeps)

    def rollout(self, control: Array) -> Array:
        """Advance by ``control`` (nsim, steps, n) [rad]; return such positions."""
        return self._batch.rollout(control.shape[1], control, record=("qpos",))["qpos"]

    def model(self, index: int) -> mujoco.MjModel:
        """Copy of one simulation's model."""
        return self._batch.get_model(index)

    def restart(self, position: Array, velocity: Array | float = 0.0, ids: Ids = None) -> None:
        """Restart at ``position`` (m, n) [rad] with ``velocity`` [rad/s], without warm start."""
        chosen = np.arange(self.nsim)[slice(None) if ids is None else ids]
        self._batch.bind("qacc_warmstart")[chosen] = 0.0
        self._batch.bind("time")[chosen] = 0.0
        self.qpos[chosen] = position
        self.qvel[chosen] = velocity
        self.ctrl[chosen] = position


FRICTION_IMPEDANCE = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""solimp of the friction constraints: nearly rigid"""
FRICTION_SOFTNESS = 0.01
"""Factor on ``dof_invweight0`` for friction; chosen"""

TCP_SITE = "tcp"


def model_fields(parameters: TwinParameters, timestep: Array, gravity_scale: Array) -> Iterator[tuple[str, Array]]:
    """Yield the model fields that a twin decides, as (name, value)."""
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
    """Solref (..., 2) of friction for a time step (...) [s]."""
    return np.stack([2.0 * timestep, np.ones_like(timestep)], axis=-1)


def twin_spec(arm: Arm, table: bool = False) -> mujoco.MjSpec:
    """Describe the model of an arm without twin."""
    spec = mujoco.MjSpec()
    spec.modelname = arm.name
    option = spec.option
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.solver = mujoco.mjtSolver.mjSOL_PGS
    disable = mujoco.mjtDisableBit
    option.disableflags |= (
        disable.mjDSBL_CONTACT
        | disable.mjDSBL_LIMIT
        | disable.mjDSBL_EQUALITY
        | disable.mjDSBL_SENSOR
        | disable.mjDSBL_SPRING
        | disable.mjDSBL_ISLAND
    )
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


RADIUS = 0.005
"""[m] of the sphere; chosen"""

IMPEDANCE = 0.9
"""solimp of the contact: constant"""

PLANE, TIP = "table", "tip"
"""Geometries in the model"""


def add_table(spec: mujoco.MjSpec, tip: mujoco.MjsBody, position: Array) -> None:
    """Add the plane and, at ``position`` (3,) [m] on ``tip``, the sphere."""
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC  # a pyramid would stiffen as friction vanishes
    sphere, plane = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_PLANE
    # A mocap body: its pose is part of the state, and so free in every simulation of a batch.
    body = spec.worldbody.add_body(name=PLANE, mocap=True)
    body.add_geom(name=PLANE, type=plane, size=(0.0, 0.0, 1.0), contype=1, conaffinity=0)
    # Its own priority: friction and softness are the sphere's alone, not mixed with the plane's.
    tip.add_geom(
        name=TIP,
        type=sphere,
        size=(RADIUS, 0.0, 0.0),
        pos=position,
        contype=0,
        conaffinity=1,
        condim=3,
        priority=1,
        mass=0.0,
        solimp=(IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2.0),
    )


def table_pose(table: TablePlane) -> tuple[Array, Array]:
    """Position (3,) [m] and quaternion (4,) of the plane."""
    normal = np.array([-table.slope_x, -table.slope_y, 1.0]) / np.sqrt(1 + table.slope_x**2 + table.slope_y**2)
    turn = np.zeros(4)
    mujoco.mju_quatZ2Vec(turn, normal)
    return np.array([0.0, 0.0, table.height]) - RADIUS * normal, turn


def table_fields(table: TablePlane, timestep: float, inverse_mass: Array) -> Iterator[tuple[str, Array]]:
    """Yield the tip's fields that a table decides in models with `add_table`, as (field, value).

    ``inverse_mass`` (...) [1/kg] is the tip's ``body_invweight0``: stiffness = k d / (1 - d) / inverse mass.
    """
    d = IMPEDANCE
    k = np.minimum(table.stiffness * (1 - d) / d * inverse_mass, (2 * timestep * d) ** -2.0)
    yield "geom_solref", np.stack([-k * d, -2 * np.sqrt(k) * d], axis=-1)
    yield "geom_friction", np.array([table.friction, 0.0, 0.0])
