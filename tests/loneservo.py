"""A servo of an SO-101 that carries nothing, by the law of the simulated arms."""

from dataclasses import replace
from functools import cache

import numpy as np

from rejoint.arms import Arm, load_arm
from rejoint_lab.plant.plant import StsPlant
from rejoint_lab.plant.sts3215 import GAIN_PER_P
from rejoint_lab.plant.wear import Wear


def lone_servo(count: int = 1, *, blocked: bool = False) -> StsPlant:
    """Servos as sold; a blocked shaft is one of endless inertia. External torques [N m]: the setting ``bias``."""
    return StsPlant(_shaft(), [_wear(1e9 if blocked else 0.0261)] * count, seed=0, gravity=np.zeros(3))


@cache
def _shaft() -> Arm:
    arm = load_arm("so101")
    own = ("joint_names", "offset", "axis", "max_speed", "mass", "com", "inertia", "servos")
    wide = {"lower": np.array([-10.0]), "upper": np.array([10.0]), "rest": np.zeros(1), "servo_acceleration": np.inf}
    return replace(arm, **{name: getattr(arm, name)[-1:] for name in own}, **wide)


def _wear(inertia: float) -> Wear:
    known = dict.fromkeys(("damping_gain", "load_friction", "play", "ripple", "torque_noise"), 0.0)
    known |= {"position_gain": 2.94 * 32 * GAIN_PER_P, "torque_limit": 2.94, "coulomb": 0.05, "stiction": 0.055}
    known |= {"link_stiffness": 150.0, "reflected_inertia": inertia}
    return Wear(name="lone", **{name: np.array([value]) for name, value in known.items()})
