"""Where an arm is at home while it follows: at rest, or folded so that its motors can lift it.

A worn motor that hardly lifts what hangs on its joint stands still on slow paths. So a joint that carries little is
turned then, by the same angle all along: what folds as it goes has to move such joints, and they stick too. What that
brings to arms with the weakest motors of five families is printed by `python -m benchmarks moving`.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, collides, frames, gravity_torque
from rejoint.control.moving.posture import PathPostures, joint_weights
from rejoint.control.moving.servos import Servos

_SPARE = 0.35
"""Share of a motor's torque that is to be left for what sticks, beyond gravity and sliding friction (chosen on the arms
of that benchmark: by their twins seven of eight have less left)"""
_FOLDS = np.radians([-60.0, 60.0])  # from rest, of one joint (chosen among 30 to 90 deg)
_PLACES = 32  # of the region of targets, at which postures are looked at


def home_of(arm: Arm, servos: Servos) -> Array:
    """Return the postures (B, n) [rad] that B arms with these ``servos`` keep near to on their way.

    That is rest where all motors that carry much can lift it with torque to spare, at the usual place of the region of
    targets; else that fold of one joint in which the weakest of them is loaded least. Folds beyond a joint's limits are
    left out, and those in which the arm touches itself or the ground where it does not at rest.
    """
    places = arm.targets.sample(np.random.default_rng(0), (_PLACES,))
    light = joint_weights(arm) > 1.0
    room = np.maximum((1.0 - _SPARE) * servos.torque_limit - servos.coulomb, np.finfo(float).tiny)

    def share(postures: Array) -> Array:  # (B,) of its room, of the joint that is loaded most
        load = np.median(np.abs(gravity_torque(arm, postures)), axis=0)
        return np.asarray((load / room)[:, ~light].max(axis=-1))

    at_rest = PathPostures(arm, places).last
    least, touching = share(at_rest), collides(arm, frames(arm, at_rest))
    homes = np.broadcast_to(arm.rest, room.shape).copy()
    weak = least > 1.0
    for joint in np.flatnonzero(light) if weak.any() else ():
        for fold in _FOLDS:
            home = arm.rest + fold * np.eye(arm.joints)[joint]
            postures = PathPostures(arm, places, home=home).last
            within = ((home > arm.lower) & (home < arm.upper)).all()
            if within and not (collides(arm, frames(arm, postures)) & ~touching).any():
                better = weak & (share(postures) < least)
                homes[better], least = home, np.where(better, share(postures), least)
    return homes
