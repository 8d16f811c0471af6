"""Backlash inside the servo loop: motors and joints that are not always in contact.

An unloaded joint rests anywhere between the flanks; to turn it back the motor first crosses the backlash. Logs do not
separate it from friction: only training draws it.

Out of contact, motor and joint are two bodies; they exchange momentum when they meet (Nordin and Gutman 2002).
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
from __future__ import annotations

import numpy as np
from numba import njit

RESTITUTION = 0.5
"""Of motor and joint; chosen: greased steel"""

SOFT = 0.01
"""[rad/s] closing speed without rebound; chosen"""


@njit(cache=True, nogil=True, error_model="numpy")
def cross(gear, motor, lead, speed, friction, step):  # noqa: ANN001, ANN201 - compiled: types come from the arguments
    """Move one motor for ``step`` [s]; return its place, speed and flank, whether it was free, and the joint's speed.

    ``gear``: half the backlash [rad], place ahead of the joint [rad], speed [rad/s], flank (1, -1, or 0: between them)
    and inertia [kg m^2] of what the joint turns. ``motor``: stiffness, torque limit, damping and armature. ``lead``
    [rad] of the command, ``speed`` [rad/s] of the joint, dry ``friction`` [N m].
    """
    (edge, place, v, flank, link), (stiffness, limit, damping, armature) = gear, motor
    torque = min(max(stiffness * lead, -limit), limit)
    if flank != 0.0:
        at_rest = abs(speed) < 1e-3
        net = torque - np.sign(torque if at_rest else speed) * friction - damping * speed
        if (at_rest and abs(torque) <= friction) or net * flank >= 0.0:
            return place, v, flank, False, speed  # the motor pushes, or both stand still
        flank, v = 0.0, speed
    if v != 0.0 or abs(torque) > friction:
        against = np.sign(v) if v != 0.0 else np.sign(torque)
        h = step / armature
        v = (v + h * (torque - against * friction)) / (1.0 + h * damping)
        v = v if v * against > 0.0 else 0.0  # friction stops a motor, it does not turn it back
    place += step * (v - speed)
    if abs(place) >= edge:
        place = np.sign(place) * edge
        closing, whole = v - speed, armature + link
        common = (armature * v + link * speed) / whole
        bounce = RESTITUTION if abs(closing) > SOFT else 0.0
        v = common - bounce * closing * link / whole
        speed = common + bounce * closing * armature / whole
        if bounce == 0.0:
            flank = np.sign(place)
    return place, v, flank, True, speed
