"""A lone servo with a pendulum, of known truth: a plant of its own, which shares no code with any twin.

The servo's firmware runs at 1 kHz on what its 12-bit encoder reads, with a dead zone of one count and a limited torque;
friction sticks, and has a Stribeck curve and a part that grows with the load. Integrated at 4 kHz.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from rejoint.arms import Arm, Box
from rejoint.logs.runlog import RunLog
from rejoint.twin.parameters import TwinParameters

MASS, LENGTH = 0.25, 0.10
"""[kg] and [m] of the pendulum: 0.25 N m when it stands out level"""
COUNT = 2 * np.pi / 4096
GAINS = (0.36, 1.0, 3.0, 9.0)
"""[N m/rad] stiffness of the servo at four settings: with the weakest it sags by 35 degrees"""
PERIOD, STEP = 0.01, 0.00025
DAMPING, COULOMB, ARMATURE, TORQUE, DELAY = 0.02, 0.03, 0.002, 1.5, 0.006

ARM = Arm(
    name="rig", joint_names=("servo",), offset=np.eye(4)[None], axis=np.array([[0.0, 1.0, 0.0]]),
    tip=np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -0.12], [0, 0, 0, 1.0]]), lower=np.array([-3.0]),
    upper=np.array([3.0]), max_speed=np.array([10.0]), mass=np.array([MASS]), com=np.array([[0.0, 0.0, -LENGTH]]),
    inertia=1e-5 * np.eye(3)[None], rest=np.zeros(1), targets=Box(lower=-np.ones(3), upper=np.ones(3)), floor=-1.0,
    encoder_step=COUNT,
)  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Motion:
    """What the servo is told: sums of sines, or steps to goals that it holds."""

    seed: int
    seconds: float = 10.0
    steps: bool = False


def truth(stiffness):
    """The twin with the plant's own parameters, as far as a twin has them."""
    return TwinParameters(
        stiffness=[stiffness], damping=[DAMPING * max(stiffness, 1.0) ** 0.5], coulomb=[COULOMB], armature=[ARMATURE],
        torque_limit=[TORQUE], offset=[0.0], delay=DELAY, ramp_speed=50.0,
    )  # fmt: skip


def record(stiffness, motion, friction=1.0):
    """Run log of one motion with a servo of this stiffness [N m/rad], and as many times the usual dry friction."""
    rng = np.random.default_rng(motion.seed)
    time = np.arange(0.0, motion.seconds, PERIOD)
    if motion.steps:
        command = rng.uniform(-1.2, 1.2, int(motion.seconds) + 1)[(time / 1.25).astype(int)]
    else:
        command = sum(
            size * np.sin(2 * np.pi * f * rng.uniform(0.8, 1.2) * time + rng.uniform(0, 6.3))
            for f, size in ((0.15, 0.6), (0.5, 0.4), (1.1, 0.15))
        )
    command *= np.minimum(time, 1.0)
    damping = DAMPING * max(stiffness, 1.0) ** 0.5
    position = _simulate(time, command, stiffness, damping, friction * COULOMB, STEP)
    noise = rng.uniform(-0.5, 0.5, len(time))  # where the count flips
    position = np.round(position / COUNT + 0.1 * noise) * COUNT
    nowhere = np.full((len(time), 3), np.nan)
    return RunLog(
        arm=ARM.name, joint_names=ARM.joint_names, robot="rig", label=f"motion{motion.seed}", time=time,
        position=position[:, None], command=command[:, None], target=nowhere, true_tcp=nowhere,
    )  # fmt: skip


def minute(stiffness, seed=0):
    """Six logs of ten seconds: half of them steps."""
    return [record(stiffness, Motion(seed=100 * seed + k, steps=k % 2 == 1)) for k in range(6)]


@njit(cache=True)
def _simulate(time, command, stiffness, damping, coulomb, step):
    inertia = MASS * LENGTH**2 + 1e-5 + ARMATURE
    q, v, torque, tick = 0.0, 0.0, 0.0, 0
    path = np.empty(len(time))
    for k in range(len(time)):
        path[k] = q
        for _ in range(round((time[1] - time[0]) / step)):
            if tick % round(0.001 / step) == 0:  # the firmware's loop
                late = max(np.searchsorted(time, tick * step - DELAY, side="right") - 1, 0)
                error = command[late] - np.round(q / COUNT) * COUNT
                torque = 0.0 if abs(error) < 1.01 * COUNT else min(max(stiffness * error, -TORQUE), TORQUE)
            tick += 1
            load = MASS * 9.81 * LENGTH * np.sin(q)
            drive = torque - load - damping * v
            dry = (coulomb + 0.03 * abs(load)) * (1.0 + 0.25 * np.exp(-((v / 0.1) ** 2)))
            free = v + step * drive / inertia
            slowed = step * dry / inertia
            v = 0.0 if abs(free) <= slowed else free - np.sign(free) * slowed
            q += step * v
    return path
