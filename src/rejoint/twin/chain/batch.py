"""Many twins of one free arm in lockstep, by the compiled step."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise

import numpy as np

from rejoint.arms import Arm, Array, Index, Mask, link_inertia
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.workspace import unloaded_joints
from rejoint.twin.chain.dynamics import CARRIED, GROUP, INERTIA, LINK, MASS, MOMENT, PLACE, ROTATION
from rejoint.twin.chain.step import advance, workspace
from rejoint.twin.parameters import DRY, TIMESTEP, TwinParameters, back_emf, friction_terms, nominal_parameters

Ids = Index | Mask | None

ROWS = ("stiffness", "offset", "torque_limit", "damping", "armature")
"""Rows of parameters for `rejoint.twin.chain.step`, before the share of the damping within the limit"""


class ChainBatch:
    """``nsim`` simulations of one arm; ``qpos`` and ``qvel`` (nsim, n) are live."""

    def __init__(self, arm: Arm, nsim: int, timestep: float = TIMESTEP, threads: int = 1) -> None:
        self.arm, self.nsim = arm, nsim
        shape = (nsim, arm.joints)
        self.qpos, self.qvel = np.zeros((2, *shape))
        self.timestep = np.full(nsim, float(timestep))
        """(nsim,) [s]"""
        self._links = chain_links(arm)
        self._impulse, self._parameters = np.zeros(shape), np.zeros((len(ROWS) + 1, *shape))
        self._terms = np.zeros((len(DRY), *shape))
        self._gravity, self._carried = np.zeros((nsim, 3)), np.zeros(arm.joints)
        self._gear = np.zeros((5, *shape))
        """half of the backlash, place of the motor, its speed, flank, and grease, see `cross` of the step"""
        groups = -(-nsim // GROUP)
        bounds = np.linspace(0, groups, min(threads, groups) + 1).astype(int) * GROUP
        self._parts = [(first, min(last, nsim), workspace(arm.joints)) for first, last in pairwise(bounds)]
        self._pool = ThreadPoolExecutor(len(self._parts)) if len(self._parts) > 1 else None
        self.write(nominal_parameters(arm))

    def write(
        self,
        parameters: TwinParameters,
        ids: Ids = None,
        *,
        gravity_scale: float | Array = 1.0,
    ) -> None:
        """Set parameters (m,) of the simulations ``ids`` (indices or mask; default: all), not their state.

        ``gravity_scale``: a number or (m,).
        """
        chosen = slice(None) if ids is None else ids
        *rows, gain = self._parameters
        for row, name in zip(rows, ROWS, strict=True):
            row[chosen] = getattr(parameters, name)
        gain[chosen] = parameters.damping - back_emf(self.arm, parameters)
        for row, term in zip(self._terms, friction_terms(parameters), strict=True):
            row[chosen] = term
        self._gravity[chosen] = np.multiply.outer(gravity_scale, GRAVITY)

    def loosen(self, backlash: Array, grease: Array, ids: Ids = None) -> None:
        """Put motors in the middle of the ``backlash`` (m, n) [rad], in joints that no load presses to a flank.

        ``grease`` (m,): damping of a joint in the backlash relative to its motor's.
        """
        chosen = slice(None) if ids is None else ids
        half = np.zeros_like(backlash)
        if backlash.any():
            half = 0.5 * backlash * unloaded_joints(self.arm)
            self._carried[:] = link_inertia(self.arm, self.arm.rest)
        still, flank = np.zeros_like(half), np.where(half > 0.0, 0.0, 1.0)
        self._gear[:, chosen] = np.stack([half, still, still, flank, still + grease[:, None]])

    def rollout(self, control: Array) -> Array:
        """Advance by ``control`` (nsim, steps, n) [rad]; return such positions."""
        path = np.empty_like(control)
        control = np.ascontiguousarray(control)
        motors, state = (self._parameters, self._terms), (self.qpos, self.qvel, self._impulse)
        gears = (self._gear, self._carried, bool(self._gear[0].any()))
        arrays = (self._links, motors, gears, (self._gravity, self.timestep), control, state, path)
        if self._pool is None:
            advance(*arrays, self._parts[0])
        else:
            list(self._pool.map(lambda part: advance(*arrays, part), self._parts))
        return path

    def restart(self, position: Array, velocity: Array | float = 0.0, ids: Ids = None) -> None:
        """Restart at ``position`` (m, n) [rad] with ``velocity`` [rad/s], without friction impulses."""
        chosen = slice(None) if ids is None else ids
        self.qpos[chosen] = position
        self.qvel[chosen], self._impulse[chosen] = velocity, 0.0


def chain_links(arm: Arm) -> Array:
    """(n, LINK) the constants of each link, see `rejoint.twin.chain.dynamics`."""
    links, before = np.zeros((arm.joints, LINK)), np.eye(3)
    for j, row in enumerate(links):
        turn = _z_frame(arm.axis[j])
        place, com = before.T @ arm.offset[j, :3, 3], turn.T @ arm.com[j]
        inertia = turn.T @ arm.inertia[j] @ turn + arm.mass[j] * (com @ com * np.eye(3) - np.outer(com, com))
        row[ROTATION:PLACE] = (before.T @ arm.offset[j, :3, :3] @ turn).ravel()
        row[PLACE:MASS] = place
        row[MASS], row[MOMENT:INERTIA] = arm.mass[j], arm.mass[j] * com
        row[INERTIA:CARRIED] = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        row[CARRIED] = arm.mass[j:].sum()
        before = turn
    return links


def _z_frame(axis: Array) -> Array:
    away = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(away, axis) / np.linalg.norm(np.cross(away, axis))
    return np.stack([x, np.cross(axis, x), axis], axis=-1)
