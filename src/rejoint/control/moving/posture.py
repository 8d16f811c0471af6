"""Which posture an arm takes on a path: one that depends on the place alone, and that spares the light joints.

Of all postures with the tool at a place, the one nearest to home is taken, which is rest unless said otherwise. Joints
that carry little count for more: they are weak, stick, and turn round often, and an arm with six joints can do without
them. So a path that comes back finds the same postures, and nothing drifts.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque, position_kinematics
from rejoint.arms.orientation import Orientation, task
from rejoint.arms.posing import find_postures

SPARED = 20.0
"""Weight of the lightest joints by that of the heaviest (measured on four worn arms: 5 to 100 make no difference, with
1 the error of random paths at 0.5 Hz is 3.4 instead of 1.9 mm under an integral)"""
_LIGHT = 0.2  # share of the largest gravity torque below which a joint is light (chosen: the wrist)
_KEEP = 3  # joints that always count as heavy: those of a place in space
_ROUNDS, _FIRST = 4, 40  # steps of the search from a posture nearby, and from rest
_STEP = 0.3  # [rad] largest change of a joint in one of them
_SOFT = 1e-8  # [m^2] keeps singular postures finite


@lru_cache(maxsize=32)
def joint_weights(arm: Arm) -> Array:
    """Weights (n,) of the joints: 1, or `SPARED` for those that carry little."""
    postures = np.random.default_rng(0).uniform(arm.lower, arm.upper, (2048, arm.joints))
    load = np.abs(gravity_torque(arm, postures)).max(axis=0)
    weights = np.where(load < _LIGHT * load.max(), SPARED, 1.0)
    lever = np.linalg.norm(position_kinematics(arm, postures)[1], axis=-2).max(axis=0)
    weights[np.argsort(-lever, kind="stable")[:_KEEP]] = 1.0
    return weights


def spread(arm: Arm, jacobian: Array, way: Array) -> Array:
    """Joint motions (..., n) [rad] that move the tool by ``way`` (..., k) [m], mostly of the heavy joints."""
    turned = np.swapaxes(jacobian, -1, -2) / joint_weights(arm)[:, None]
    ridge = _SOFT * np.eye(way.shape[-1])
    return (turned @ np.linalg.solve(jacobian @ turned + ridge, way[..., None]))[..., 0]


class PathPostures:
    """PathPostures of B arms; the search goes on from the last one."""

    def __init__(
        self, arm: Arm, place: Array, turn: Orientation | None = None, home: Array | None = None
    ) -> None:  # fmt: skip
        """Begin at ``place`` (B, 3) [m], with the tools turned as in ``turn`` (B,).

        They keep near to ``home`` (n,) or (B, n) [rad] where no turn is given; by default to rest.
        """
        self._arm = arm
        self._home = arm.rest if home is None or turn is not None else home
        start = np.broadcast_to(self._home, (len(place), arm.joints))
        start = start if turn is None else find_postures(arm, place, start, turn)
        self.last = self._search(place, start, _FIRST, turn)
        """(B, n) [rad]"""

    def at(self, places: Array, turns: Orientation | None = None) -> Array:
        """Return the postures (k, B, n) [rad] of ``places`` (k, B, 3) [m] near the last ones; keep the middle one.

        The tools are turned there as in ``turns`` (k, B).
        """
        start = np.broadcast_to(self.last, (len(places), *self.last.shape))
        found = self._search(places, start, _ROUNDS, turns)
        self.last = found[len(found) // 2]
        return found

    def along(self, places: Array, turns: Orientation | None = None) -> Array:
        """Return the postures (T, B, n) [rad] along ``places`` (T, B, 3) [m], one after the other."""
        return np.concatenate([self.at(place[None], turns and turns[k, None]) for k, place in enumerate(places)])

    def _search(self, place: Array, q: Array, rounds: int, turn: Orientation | None) -> Array:
        arm = self._arm
        for _ in range(rounds):
            missed, jacobian = task(arm, q, place, turn)
            home = self._home - q
            way = missed - (jacobian @ home[..., None])[..., 0]
            step = home + spread(arm, jacobian, way)
            largest = np.abs(step).max(axis=-1, keepdims=True)
            q = np.clip(q + step * np.minimum(1.0, _STEP / np.maximum(largest, _STEP)), arm.lower, arm.upper)
        return q
