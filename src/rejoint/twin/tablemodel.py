"""The table in the simulation: a plane that the tip touches with one soft sphere.

Only the TCP touches: of the shape of a gripper nothing is known, and a log shows no more than where the
tip was held up. The sphere has no size of its own, so the plane's height is that of the TCP when it touches.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from rejoint.arms import Array
from rejoint.twin.table import TablePlane

RADIUS = 0.005
"""[m] of the sphere (chosen; the plane lies that much lower)"""

IMPEDANCE = 0.9
"""solimp of the contact (MuJoCo, modelling, solver parameters): constant, so that stiffness decides what gives"""

PLANE, TIP = "table", "tip"
"""Names of the two geometries in the model"""


def add_table(spec: mujoco.MjSpec, tip: mujoco.MjsBody, position: Array) -> None:
    """Give a model the plane and, on the body ``tip`` at ``position`` (3,) [m], the sphere that touches it."""
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC  # a pyramid would stiffen as friction vanishes
    sphere, plane = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_PLANE
    # A mocap body: its pose is part of the state, and so free in every simulation of a batch.
    body = spec.worldbody.add_body(name=PLANE, mocap=True)
    body.add_geom(name=PLANE, type=plane, size=(0.0, 0.0, 1.0), contype=1, conaffinity=0)
    # Its own priority: friction and softness are the sphere's alone, not mixed with the plane's.
    tip.add_geom(name=TIP, type=sphere, size=(RADIUS, 0.0, 0.0), pos=position, contype=0, conaffinity=1,
                 condim=3, priority=1, mass=0.0, solimp=(IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2.0))  # fmt: skip


def table_pose(table: TablePlane) -> tuple[Array, Array]:
    """Position (3,) [m] and quaternion (4,) of the plane that holds up the sphere's centre at the table's height."""
    normal = np.array([-table.slope_x, -table.slope_y, 1.0]) / np.sqrt(1 + table.slope_x**2 + table.slope_y**2)
    turn = np.zeros(4)
    mujoco.mju_quatZ2Vec(turn, normal)
    return np.array([0.0, 0.0, table.height]) - RADIUS * normal, turn


def table_fields(table: TablePlane, timestep: float, inverse_mass: Array) -> Iterator[tuple[str, Array]]:
    """Yield what a table decides of the tip's geometry in models with `add_table`, as (field, value).

    ``inverse_mass`` (...) [1/kg] is the ``body_invweight0`` of the tip's body, one for each model: MuJoCo
    sets softness as an acceleration (stiffness = k d / (1 - d) / inverse mass). Critically damped, and no
    faster than the time step allows.
    """
    d = IMPEDANCE
    k = np.minimum(table.stiffness * (1 - d) / d * inverse_mass, (2 * timestep * d) ** -2.0)
    yield "geom_solref", np.stack([-k * d, -2 * np.sqrt(k) * d], axis=-1)
    yield "geom_friction", np.array([table.friction, 0.0, 0.0])
