"""An arm whose tip may touch a table: the plane, its fit to motion in contact, and its simulation by MuJoCo.

Per joint: torque = clip(stiffness (command + offset - q) - (damping - b) qdot, +-limit) - b qdot - dry friction with
`back_emf` b, without contacts of links and joint stops.
Friction constraints are nearly rigid (MuJoCo's default creeps 1 deg/s). The Jacobian is dense (the sparse Cholesky of
MuJoCo 4.0.0 has a fault), the solver projected Gauss-Seidel (Newton's method stops too early).

Only the TCP touches the table, with a soft sphere.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.batch import Batch

from rejoint.arms import Arm, Array
from rejoint.arms.inertia import inertia_values
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.rotations import quaternion_of
from rejoint.twin.fit import influence
from rejoint.twin.parameters import TIMESTEP, TwinParameters, back_emf, dry_friction, friction_terms
from rejoint.twin.replay import Replay
from rejoint.twin.twin import TablePlane

FRICTION_IMPEDANCE = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""solimp of the friction constraints: nearly rigid"""
FRICTION_SOFTNESS = 0.01
"""Factor on ``dof_invweight0`` for friction; chosen"""

RADIUS = 0.005
"""[m] of the sphere; chosen"""

IMPEDANCE = 0.9
"""solimp of the contact: constant"""

PLANE, TIP = "table", "tip"
"""Names in the model"""


class TableBatch:
    """Simulations of one arm by MuJoCo in lockstep; ``qpos`` and ``qvel`` (m, n) are their state."""

    def __init__(
        self,
        arm: Arm,
        twins: TwinParameters,
        tables: Sequence[TablePlane] = (),
        timestep: float | Array = TIMESTEP,
    ) -> None:
        """Take the parameters (m,), m tables or none, and time steps [s], a number or (m,)."""
        count = twins.shape[0]
        self._terms = friction_terms(twins)
        steps = np.broadcast_to(timestep, twins.shape).astype(float)
        self._batch = Batch(twin_spec(arm, table=bool(tables)).compile(), nsim=count)
        self.qpos: Array = self._batch.bind("qpos")
        self.qvel: Array = self._batch.bind("qvel")
        self._ctrl: Array = self._batch.bind("ctrl")
        gain = np.zeros((*twins.stiffness.shape, mujoco.mjNGAIN))
        bias = np.zeros((*twins.stiffness.shape, mujoco.mjNBIAS))
        gain[..., 0], beside = twins.stiffness, back_emf(arm, twins)
        bias[..., 0], bias[..., 1] = twins.stiffness * twins.offset, -twins.stiffness
        bias[..., 2] = beside - twins.damping
        values = {
            "actuator_gainprm": gain,
            "actuator_biasprm": bias,
            "actuator_forcerange": np.stack([-twins.torque_limit, twins.torque_limit], axis=-1),
            "dof_damping": beside,
            "dof_frictionloss": twins.coulomb,
            "dof_armature": twins.armature,
            "dof_solref": np.stack([2.0 * steps, np.ones_like(steps)], axis=-1)[:, None],
            "opt.timestep": steps,
            "opt.gravity": GRAVITY,
        }
        for name, value in values.items():
            self._batch.expand(name)[:] = value
        self._batch.set_const(np.arange(count, dtype=np.int32))
        self._batch.expand("dof_invweight0")[:] *= FRICTION_SOFTNESS
        for i, table in enumerate(tables):
            self._put(i, table, steps[i])

    def _put(self, i: int, table: TablePlane, timestep: float) -> None:
        """Set one simulation's table; stiffness = k d / (1 - d) / inverse mass of the tip."""
        tip, d = self._batch.model.geom(TIP), IMPEDANCE
        inverse_mass = self._batch.expand("body_invweight0")[i, tip.bodyid[0], 0]
        k = np.minimum(table.stiffness * (1 - d) / d * inverse_mass, (2 * timestep * d) ** -2.0)
        normal = np.array([-table.slope_x, -table.slope_y, 1.0]) / np.sqrt(1 + table.slope_x**2 + table.slope_y**2)
        self._batch.bind("mocap_pos")[i, 0] = np.array([0.0, 0.0, table.height]) - RADIUS * normal
        mujoco.mju_quatZ2Vec(self._batch.bind("mocap_quat")[i, 0], normal)
        self._batch.expand("geom_solref")[i, tip.id] = -k * d, -2 * np.sqrt(k) * d
        self._batch.expand("geom_friction")[i, tip.id] = table.friction, 0.0, 0.0

    def restart(self, position: Array, velocity: Array | float = 0.0) -> None:
        """Restart at ``position`` (m, n) [rad] with ``velocity`` [rad/s], without warm start."""
        self._batch.bind("qacc_warmstart")[:] = 0.0
        self.qpos[:], self.qvel[:], self._ctrl[:] = position, velocity, position

    def rollout(self, control: Array) -> Array:
        """Advance by ``control`` (m, steps, n) [rad]; return such positions."""
        path = np.empty_like(control)
        driving, bias = self._batch.bind("qfrc_actuator"), self._batch.bind("qfrc_bias")
        friction = self._batch.expand("dof_frictionloss")
        self._ctrl[:] = control[:, 0]
        self._batch.forward()  # what presses the gears at the start
        for k in range(control.shape[1]):
            self._ctrl[:] = control[:, k]
            load = 0.5 * np.abs(driving + bias)  # a step ago
            friction[:] = dry_friction(self._terms, self.qvel, load)
            self._batch.step(None, nstep=1)
            path[:, k] = self.qpos
        return path


def twin_spec(arm: Arm, *, table: bool = False) -> mujoco.MjSpec:
    """Describe the model of an arm without twin."""
    spec = mujoco.MjSpec()
    spec.modelname = arm.name
    option = spec.option
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.solver = mujoco.mjtSolver.mjSOL_PGS
    for name in ("CONTACT", "LIMIT", "EQUALITY", "SENSOR", "SPRING", "ISLAND"):
        if name != "CONTACT" or not table:
            option.disableflags |= getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}")
    body = spec.worldbody
    for i, name in enumerate(arm.joint_names):
        body = body.add_body(name=f"link{i + 1}", pos=arm.offset[i, :3, 3], quat=quaternion_of(arm.offset[i, :3, :3]))
        body.explicitinertial = True
        body.mass, body.ipos = arm.mass[i], arm.com[i]
        body.fullinertia = inertia_values(arm.inertia[i])
        # A value above zero, so that MuJoCo reserves the friction constraints; the writer sets the real one.
        body.add_joint(name=name, axis=arm.axis[i], frictionloss=1.0, solimp_friction=FRICTION_IMPEDANCE)
        servo = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp=1.0)
        servo.forcelimited, servo.forcerange = True, (-1.0, 1.0)
    if table:
        _add_table(spec, body, arm.tip[:3, 3])
    body.add_site(name="tcp", pos=arm.tip[:3, 3], quat=quaternion_of(arm.tip[:3, :3]))
    return spec


def _add_table(spec: mujoco.MjSpec, tip: mujoco.MjsBody, position: Array) -> None:
    """Add the plane and, at ``position`` (3,) [m] on ``tip``, the sphere."""
    spec.option.tolerance = 1e-5  # measured: 0.001 deg from the finest, in four fifths of the time
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


# height [m], slopes, log stiffness [N/m], log friction
_SIGMA = np.array([0.02, 0.05, 0.05, 1.0, 0.7])
"""Prior sigma; chosen: level within 3 degrees, stiffness within a factor of e"""
_STEP = np.array([0.001, 0.01, 0.01, 0.2, 0.2])
"""Finite-difference steps (chosen)"""
_LOWER = np.array([-np.inf, -0.3, -0.3, np.log(100.0), np.log(0.05)])
_UPPER = np.array([np.inf, 0.3, 0.3, np.log(1e5), np.log(1.5)])

STIFFNESS, FRICTION = 1000.0, 0.3
"""Start of a fit [N/m], [1]; chosen: a hand-sized arm"""

NOISE, ROWS = np.radians(0.5), 50
"""[rad] error in contact, and rows of one observation; chosen"""


STEPS, SMALL = 12, 0.5
"""Most Gauss-Newton steps, and the prior sigmas of a last one; chosen"""


def fit_table(replay: Replay, parameters: TwinParameters, height: float) -> TablePlane:
    """Fit the table from level at ``height`` [m], by Gauss-Newton with pseudo-Huber loss."""
    measured, noise = replay.measured, NOISE * ROWS**0.5
    mean = np.array([height, 0.0, 0.0, np.log(STIFFNESS), np.log(FRICTION)])
    x, step = mean, _SIGMA
    for _ in range(STEPS):
        if (np.abs(step) < SMALL * _SIGMA).all():
            break
        moves = np.where(x + _STEP > _UPPER, -_STEP, _STEP)
        vectors = np.vstack([x, x + np.diag(moves)])
        paths = replay.predict(parameters.repeat(len(vectors)), [_plane(v) for v in vectors])
        base, *moved = (paths - measured).reshape(len(vectors), -1)
        slopes = (np.array(moved) - base) / moves[:, None]
        weighted = slopes * influence(base) / noise**2
        curvature, pull = weighted @ slopes.T + np.diag(_SIGMA**-2.0), weighted @ base + (x - mean) / _SIGMA**2
        step = np.clip(x - np.clip(np.linalg.solve(curvature, pull), -_SIGMA, _SIGMA), _LOWER, _UPPER) - x
        x = x + step
    return _plane(x)


def _plane(vector: Array) -> TablePlane:
    values = [*vector[:3].tolist(), *np.exp(vector[3:]).tolist()]
    return TablePlane(**dict(zip(TablePlane.__dataclass_fields__, values, strict=True)))
