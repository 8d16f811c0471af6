"""Postures on a path, the arm's home, and commands of a motion by the twin.

The posture nearest to home depends on the place alone, so nothing drifts.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rejoint.arms import Arm, Array, collides, frames, gravity_torque, position_kinematics
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.postures import find_postures
from rejoint.arms.rotations import Orientation, task

SPARED = 20.0
"""of the lightest joints over the heaviest (measured)"""
_LIGHT = 0.2  # share of the largest gravity torque below which a joint is light (chosen: the wrist)
_KEEP = 3  # joints that always count as heavy: those of a place in space
_ROUNDS, _FIRST = 4, 40  # steps of the search from a posture nearby, and from rest
_STEP = 0.3  # [rad] largest change of a joint in one of them
_SOFT = 1e-8  # [m^2] keeps singular postures finite


@lru_cache(maxsize=32)
def joint_weights(arm: Arm) -> Array:
    """Weights (n,) from 1 to `SPARED`."""
    postures = np.random.default_rng(0).uniform(arm.lower, arm.upper, (2048, arm.joints))
    load = np.abs(gravity_torque(arm, postures)).max(axis=0)
    weights = np.where(load < _LIGHT * load.max(), SPARED, 1.0)
    lever = np.linalg.norm(position_kinematics(arm, postures)[1], axis=-2).max(axis=0)
    weights[np.argsort(-lever, kind="stable")[:_KEEP]] = 1.0
    return weights


def spread(arm: Arm, jacobian: Array, way: Array) -> Array:
    """Joint motions (..., n) [rad] for tool motions ``way`` (..., k) [m], mostly of heavy joints."""
    turned = np.swapaxes(jacobian, -1, -2) / joint_weights(arm)[:, None]
    ridge = _SOFT * np.eye(way.shape[-1])
    return (turned @ np.linalg.solve(jacobian @ turned + ridge, way[..., None]))[..., 0]


class PathPostures:
    """Postures of B arms."""

    def __init__(self, arm: Arm, place: Array, turn: Orientation | None = None, home: Array | None = None) -> None:
        """Begin at ``place`` (B, 3) [m], turned as in ``turn`` (B,), or near ``home`` (n,) or (B, n) [rad]."""
        self._arm = arm
        self._home = arm.rest if home is None or turn is not None else home
        start = np.broadcast_to(self._home, (len(place), arm.joints))
        start = start if turn is None else find_postures(arm, place, start, turn)
        self.last = self._search(place, start, _FIRST, turn)
        """(B, n) [rad]"""

    def at(self, places: Array, turns: Orientation | None = None) -> Array:
        """Postures (k, B, n) [rad] of ``places`` (k, B, 3) [m] and ``turns`` (k, B); stores the middle one."""
        start = np.broadcast_to(self.last, (len(places), *self.last.shape))
        found = self._search(places, start, _ROUNDS, turns)
        self.last = found[len(found) // 2]
        return found

    def along(self, places: Array, turns: Orientation | None = None) -> Array:
        """Postures (T, B, n) [rad] along ``places`` (T, B, 3) [m]."""
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


_SPARE = 0.35
"""Share of motor torque (chosen)"""
_FOLDS = np.radians([-60.0, 60.0])  # from rest, of one joint (chosen among 30 to 90 deg)
_PLACES = 32  # of the region of targets, at which postures are looked at


def home_of(arm: Arm, servos: Servos) -> Array:
    """Home (B, n) [rad].

    Rest where the loaded motors have spare torque; else the fold that loads the weakest least
    (`python -m benchmarks moving`).
    """
    places = arm.targets.sample(np.random.default_rng(0), (_PLACES,))
    light = joint_weights(arm) > 1.0
    room = np.maximum((1.0 - _SPARE) * servos.torque_limit - servos.coulomb, np.finfo(float).tiny)

    def share(postures: Array) -> Array:  # (B,) of its room, of the joint that is loaded most
        load = np.median(np.abs(gravity_torque(arm, postures)), axis=0)
        return (load / room)[:, ~light].max(axis=-1)

    at_rest = PathPostures(arm, places).last
    least, touching = share(at_rest), collides(arm, at_rest)
    homes = np.broadcast_to(arm.rest, room.shape).copy()
    weak = least > 1.0
    for joint in np.flatnonzero(light) if weak.any() else ():
        for fold in _FOLDS:
            home = arm.rest + fold * np.eye(arm.joints)[joint]
            postures = PathPostures(arm, places, home=home).last
            within = ((home > arm.lower) & (home < arm.upper)).all()
            if within and not (collides(arm, postures) & ~touching).any():
                better = weak & (share(postures) < least)
                homes[better], least = home, np.where(better, share(postures), least)
    return homes


TURNING = 0.015
"""[rad/s] of three quarters of the friction (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Servos:
    """Servos of B arms by a twin."""

    stiffness: Array
    """(B, n) [N m/rad]"""
    damping: Array
    """(B, n) [N m s/rad]"""
    coulomb: Array
    """(B, n) [N m]"""
    armature: Array
    """(B, n) [kg m^2]"""
    torque_limit: Array
    """(B, n) [N m]"""
    offset: Array
    """(B, n) [rad] unloaded joint minus command"""
    delay: Array
    """(B,) [s] command to first effect"""

    def most(self) -> Array:
        """Largest useful following errors (B, n) [rad]."""
        return self.torque_limit / self.stiffness


STEP = 0.03
"""[s] between places for speed and acceleration (chosen)"""


def speed_of(around: Array) -> Array:
    """Speeds (B, n) [rad/s] in the middle of positions (3, B, n) [rad], `STEP` apart."""
    return (around[2] - around[0]) / (2.0 * STEP)


def command_for(arm: Arm, servos: Servos, around: Array) -> Array:
    """Commands (B, n) [rad] by the twin's inverse, with point masses; ``around`` as in `speed_of`."""
    f = frames(arm, around)
    centre = f.position + np.einsum("tbnij,nj->tbni", f.rotation, arm.com)
    pull = (centre[2] - 2.0 * centre[1] + centre[0]) / STEP**2 - GRAVITY
    force = arm.mass[:, None] * pull
    moment = np.cross(centre[1], force)
    # Of all that hangs on each joint: force and moment, the latter about the joint's own place.
    force, moment = (np.cumsum(part[:, ::-1], axis=1)[:, ::-1] for part in (force, moment))
    links, speed = (f.axis[1] * (moment - np.cross(f.position[1], force))).sum(axis=-1), speed_of(around)
    acceleration = (around[2] - 2.0 * around[1] + around[0]) / STEP**2
    friction = servos.coulomb * np.tanh(speed / TURNING)
    torque = links + friction + servos.damping * speed + servos.armature * acceleration
    return around[1] - servos.offset + torque / servos.stiffness
