"""The links of an arm as its compiled step takes them: in frames whose z axis is the joint."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.twin.chain.dynamics import CARRIED, INERTIA, LINK, MASS, MOMENT, PLACE, ROTATION


def chain_links(arm: Arm) -> Array:
    """Return (n, LINK) the constants of each link, laid out as `rejoint.twin.chain.dynamics` says, in SI units."""
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
    """Rotation (3, 3) whose z axis is ``axis``."""
    away = np.eye(3)[np.argmin(np.abs(axis))]
    x = np.cross(away, axis) / np.linalg.norm(np.cross(away, axis))
    return np.stack([x, np.cross(axis, x), axis], axis=-1)
