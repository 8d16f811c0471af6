"""Where an arm is at home while it follows: at rest, or folded so that its motors can lift it.

A worn motor that hardly lifts what hangs on its joint stands still on slow paths. So a joint that carries little is
turned then, by the same angle all along: what folds as it goes has to move such joints, and they stick too. On eight
arms whose third motor is as weak as it gets (10007, 10021, 10061, 30018, 40023, 40045, 40069, 40077) the mean of the
standard paths was 1.84 mm at rest, 1.98 mm folded as it goes, and is 0.97 mm.
"""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, collides, frames, gravity_torque
from rejoint.control.moving.posture import PathPostures, joint_weights
from rejoint.control.moving.servos import Servos
from rejoint.control.robot import Mask

_SPARE = 0.35
"""Share of a motor's torque that is to be left for what sticks, beyond gravity and sliding friction (measured: those
arms have 0.18 to 0.35 left by their twins, eight others at least 0.39)"""
_FOLDS = np.radians([-60.0, 60.0])  # from rest, of one joint (measured there: by 90 deg it does as badly as by 30)
_PLACES = 32  # of the region of targets, at which loads are looked at


def home_of(arm: Arm, servos: Servos) -> Array:
    """Return the postures (B, n) [rad] that B arms keep near to on their way."""
    places = arm.targets.sample(np.random.default_rng(0), (_PLACES,))
    light = joint_weights(arm) > 1.0
    at_rest = _loads(arm, arm.rest, places)
    homes = np.broadcast_to(arm.rest, servos.stiffness.shape).copy()
    room = np.maximum((1.0 - _SPARE) * servos.torque_limit - servos.coulomb, np.finfo(float).tiny)
    weak = ((at_rest / room)[:, ~light] > 1.0).any(axis=-1)
    if weak.any() and light.any():
        known = np.stack([arm.rest, *_folded(arm, light, places)])
        loads = np.stack([at_rest, *(_loads(arm, home, places) for home in known[1:])])
        share = (loads[:, None] / room)[..., ~light].max(axis=-1)  # (homes, B)
        homes[weak] = known[share.argmin(axis=0)][weak]
    return homes


def _folded(arm: Arm, light: Mask, places: Array) -> list[Array]:
    """Return the postures (n,) [rad] in which one of the ``light`` joints (n,) is turned away from rest.

    Those are left out that are beyond its limits, or in which the arm touches itself or the ground at ``places``.
    """
    turned = [arm.rest + fold * np.eye(arm.joints)[joint] for joint in np.flatnonzero(light) for fold in _FOLDS]
    within = [home for home in turned if ((home > arm.lower) & (home < arm.upper)).all()]
    at_rest = _touching(arm, arm.rest, places)
    return [home for home in within if not (_touching(arm, home, places) & ~at_rest).any()]


def _touching(arm: Arm, home: Array, places: Array) -> Mask:
    return collides(arm, frames(arm, PathPostures(arm, places, home=home).last))


def _loads(arm: Arm, home: Array, places: Array) -> Array:
    """Return the usual torques (n,) [N m] of gravity at ``places`` (K, 3) [m], near ``home`` (n,) [rad]."""
    return np.asarray(np.median(np.abs(gravity_torque(arm, PathPostures(arm, places, home=home).last)), axis=0))
