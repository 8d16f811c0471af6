"""Many twins of one arm in lockstep, each with its own parameters, time step and gravity."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from mujoco.batch import Batch
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.system.errors import InputError
from rejoint.twin.declaration import TIMESTEP
from rejoint.twin.model import FRICTION_SOFTNESS, friction_solref, model_fields, twin_model
from rejoint.twin.parameters import TwinParameters, nominal_parameters
from rejoint.twin.table import TablePlane
from rejoint.twin.tablemodel import TIP, table_fields, table_pose

Ids = NDArray[np.integer] | NDArray[np.bool_] | None


class TwinBatch:
    """``nsim`` simulations of one arm; bit for bit what as many single models would do.

    The arrays ``qpos``, ``qvel``, ``ctrl`` (nsim, n) are live: writing to them sets the state of the
    next step.
    """

    def __init__(self, arm: Arm, nsim: int, timestep: float = TIMESTEP, threads: int = 1, table: bool = False) -> None:
        if nsim < 1 or threads < 1:
            raise InputError(f"twin batch: {nsim} simulations on {threads} threads, expected at least one of each")
        self.arm = arm
        start = nominal_parameters(arm)
        stop_clock()
        self._batch = Batch(twin_model(arm, start, timestep, table=table), nsim=nsim, nthread=threads)
        self.qpos: Array = self._batch.bind("qpos")
        self.qvel: Array = self._batch.bind("qvel")
        self.ctrl: Array = self._batch.bind("ctrl")
        self._timestep = np.full(nsim, float(timestep))
        self.write(start.repeat(nsim))

    @property
    def nsim(self) -> int:
        """Number of simulations."""
        return int(self._batch.nsim)

    @property
    def timestep(self) -> Array:
        """(nsim,) [s] time step of each simulation, read-only."""
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
        """Give the simulations in ``ids`` (all by default) new parameters; their state stays.

        ``parameters`` have the leading shape (m,) of the m simulations chosen, or none for the same
        twin everywhere. ``ids`` are increasing indices or a mask (nsim,). ``timestep`` [s], a number or
        (m,), is kept where it is not given; ``gravity_scale``, a number or (m,), is 1 where not given.
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
        """Put each simulation of a batch made with ``table`` on its table; after `write`, whose masses it needs."""
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
        """Change the time step [s] of every simulation, a number or (nsim,), and what depends on it."""
        self._timestep[:] = timestep
        self._batch.expand("opt.timestep")[:] = self._timestep
        self._batch.expand("dof_solref")[:] = friction_solref(self._timestep)[:, None]

    def set_friction(self, friction: Array) -> None:
        """Change the dry friction (nsim, n) [N m] of every simulation, for friction that depends on the speed."""
        self._batch.expand("dof_frictionloss")[:] = friction

    def set_motors(self, *, armature: Array, damping: Array) -> None:
        """Change armature (nsim, n) [kg m^2] and damping (nsim, n) [N m s/rad] of every simulation.

        For joints that lose touch with their motors. What MuJoCo derives from them beforehand (`set_const`) stays,
        which are scales of its solver.
        """
        self._batch.expand("dof_armature")[:] = armature
        self._batch.expand("dof_damping")[:] = damping

    def state(self) -> dict[str, Array]:
        """Everything that a checkpoint must keep, as live arrays: states, parameters, constants."""
        fields = ("actuator_gainprm", "actuator_biasprm", "actuator_forcerange", "actuator_acc0", "dof_damping",
                  "dof_frictionloss", "dof_armature", "dof_solref", "dof_invweight0", "dof_M0", "body_invweight0",
                  "opt.timestep", "opt.gravity")  # fmt: skip
        return {name: self._batch.expand(name) for name in fields} | {
            "timestep": self._timestep, "integration": self._batch.state
        }  # fmt: skip

    def step(self, substeps: int = 1, ids: Ids = None) -> None:
        """Advance the simulations in ``ids`` (all by default) under the present ``ctrl``."""
        self._batch.step(ids, nstep=substeps)

    def rollout(self, control: Array) -> Array:
        """Advance by ``control`` (nsim, steps, n) [rad], one row a step; return positions (nsim, steps, n)."""
        return self._batch.rollout(control.shape[1], control, record=("qpos",))["qpos"]

    def model(self, index: int) -> mujoco.MjModel:
        """Copy of one simulation's model, for rendering or inspection."""
        return self._batch.get_model(index)

    def bind(self, name: str) -> Array:
        """Live (nsim, ...) array of any other MjData field, such as ``site_xpos`` or ``qfrc_constraint``."""
        return self._batch.bind(name)

    def restart(self, position: Array, velocity: Array | float = 0.0, ids: Ids = None) -> None:
        """Put simulations at ``position`` (m, n) [rad] with ``velocity`` [rad/s], and forget the solver's memory."""
        chosen = np.arange(self.nsim)[slice(None) if ids is None else ids]
        self._batch.bind("qacc_warmstart")[chosen] = 0.0
        self._batch.bind("time")[chosen] = 0.0
        self.qpos[chosen] = position
        self.qvel[chosen] = velocity
        self.ctrl[chosen] = position


@cache
def stop_clock() -> None:
    """Let MuJoCo not read the clock in each stage of a step, for timers (`MjData.timer`) that nobody reads here.

    A fifth of the time of such small models (measured). ``mjcb_time`` may be null by MuJoCo's manual, but its Python
    bindings set it; where the library or the name is not found, as in a build of one's own, nothing is changed.
    """
    for library in Path(mujoco.__file__).parent.glob("*mujoco.*"):
        try:
            ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), "mjcb_time").value = None
        except (OSError, ValueError):
            continue
