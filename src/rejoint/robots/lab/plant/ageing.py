"""How an emulated arm ages: wear grows with travel and load, so that years of use can be tried in minutes.

Material that is rubbed off goes with load times way (Archard, J. Appl. Phys. 24, 1953). A joint's load is its gravity
torque over the region of targets and its own friction, as a share of its motor's torque; its way is how far it turns
from one target to the next. So shoulder and elbow of a small arm age first, and a joint that turns for no target not
at all. The damage of a joint grows as a gamma process, the usual model of what only ever gets worse
(van Noortwijk, Reliab. Eng. Syst. Saf. 94, 2009), at a pace of its own for gear, friction and drive. A damage of one is
what lies between the profiles ``healthy`` and ``worn`` of the same arm.

Warmth is no wear: a servo that is warmer than `AMBIENT` has thinner grease and stands off a little.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque
from rejoint.arms.inverse import solve_position
from rejoint.robots.lab.plant.servo import AMBIENT

if TYPE_CHECKING:
    from rejoint.robots.lab.plant.wear import Wear

LIFE = 2500.0
"""[h] of use after which the damage of a joint of mean load and travel is one (chosen: the profile ``worn`` stands for
hundreds of hours, and the shoulder, at 2.8 times the mean, has a damage of one after 900)"""

_BLOCK = 5.0  # [h] in which damage comes by a draw of its own (chosen: less than a month of use)
_SHAPE = 0.5  # of the gamma distribution of a block: damage of 2500 h then scatters by 6 % (chosen)
_PACE = 0.3  # standard deviation of the logarithm of a joint's own pace (chosen: as `draw_wear` spreads profiles)
_WEAKENING = 0.3  # logarithm by which a damage of one lowers the torque of a motor (chosen: brushes and magnets)
_OFFSET_PER_DEGREE = np.radians(0.02)
"""[rad/K] by which the zero of an STS3215 moves, at most (shared facts on monitoring)"""
_GREASE_PER_DEGREE = 0.01
"""[1/K] by which friction falls with warmth (chosen: Bittencourt and Axehill, J. Dyn. Syst. Meas. Control 134, 2012,
see viscous friction halve in 47 K)"""

_DRIVE, _FRICTION, _GEAR = range(3)
_ADDED = {"coulomb": _FRICTION, "stiction": _FRICTION, "load_friction": _FRICTION, "ripple": _FRICTION,
          "torque_noise": _FRICTION, "play": _GEAR}  # fmt: skip
"""Parameters that grow by what lies between young and old, per damage, and of which mechanism"""
_SOFTENED = {"position_gain": _DRIVE, "link_stiffness": _GEAR}
"""Parameters whose inverse grows so"""


def aged(wear: Wear, arm: Arm, hours: float, *, seed: int, young: Wear, old: Wear, least_torque: Array) -> Wear:
    """Return ``wear`` after ``hours`` of use; the same seed always ages in the same way, and never gets better.

    ``young`` and ``old`` are the profiles between which lies a damage of one; no motor gets weaker than
    ``least_torque`` (n,) [N m], which still lifts the arm.
    """
    damage = damages(young, arm, hours, seed)
    changed = {
        name: getattr(wear, name) + damage[kind] * np.maximum(getattr(old, name) - getattr(young, name), 0.0)
        for name, kind in _ADDED.items()
    }
    for name, kind in _SOFTENED.items():
        softer = np.maximum(1.0 / getattr(old, name) - 1.0 / getattr(young, name), 0.0)
        changed[name] = 1.0 / (1.0 / getattr(wear, name) + damage[kind] * softer)
    changed["damping_gain"] = wear.damping_gain * changed["position_gain"] / wear.position_gain
    weaker = wear.torque_limit * np.exp(-_WEAKENING * damage[_DRIVE])
    changed["torque_limit"] = np.maximum(weaker, np.minimum(wear.torque_limit, least_torque))
    return replace(wear, name=f"{wear.name}, {hours:g} h", **changed)


def warmed(wear: Wear, ambient: float, *, seed: int) -> Wear:
    """Return ``wear`` in a room of ``ambient`` [deg C]: friction and the servos' zeros go with it, wear does not."""
    above = ambient - AMBIENT
    own = np.random.default_rng([seed, 2]).uniform(-1.0, 1.0, len(wear.position_gain))
    thinner = float(np.exp(-_GREASE_PER_DEGREE * above))
    return replace(
        wear, coulomb=wear.coulomb * thinner, stiction=wear.stiction * thinner, ambient=ambient,
        offset=wear.offset + own * _OFFSET_PER_DEGREE * above,
    )  # fmt: skip


def damages(young: Wear, arm: Arm, hours: float, seed: int) -> Array:
    """Damage (3, n) of drive, friction and gear of every joint after ``hours``; it grows between its draws as well."""
    blocks = int(hours // _BLOCK) + 1
    pace = np.exp(np.random.default_rng([seed, 1]).normal(-0.5 * _PACE**2, _PACE, (3, arm.joints)))
    # One generator for each mechanism and joint, so that more blocks change none of the earlier ones.
    draws = np.array(
        [[np.random.default_rng([seed, 1, kind, j]).gamma(_SHAPE, 1.0 / _SHAPE, blocks) for j in range(arm.joints)]
         for kind in range(3)]
    )  # fmt: skip
    passed = draws[..., :-1].sum(axis=-1) + draws[..., -1] * (hours / _BLOCK - (blocks - 1))
    return np.asarray(pace * severity(young, arm) * passed * _BLOCK / LIFE)


def severity(young: Wear, arm: Arm) -> Array:
    """Return load times travel of every joint (n,) in use, over their mean: at random targets of the arm's region."""
    axes = [np.linspace(low, high, 4) for low, high in zip(arm.targets.lower, arm.targets.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    posture = solve_position(arm, grid, arm.rest).q
    travel = np.abs(posture[:, None] - posture[None]).mean(axis=(0, 1))
    load = (np.abs(gravity_torque(arm, posture)).mean(axis=0) + young.coulomb) / young.torque_limit
    rubbed: Array = travel * load / (travel * load).mean()
    return rubbed
