"""The training of Park et al. 2024 to the letter: ranges of arms, reward, task and recipe."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array, Mask, collides
from rejoint.arms.workspace import length_size, torque_size
from rejoint.control.controllers.observation import SUCCESS_DISTANCE
from rejoint.system.files import read_toml
from rejoint.training.presets import PpoSettings, Preset
from rejoint.training.ranges import Interval
from rejoint.training.task import ReachTask, TaskSettings
from rejoint.twin.parameters import TwinParameters, nominal_parameters
from rejoint.twin.simulation import Draw

HEALTHY_STIFFNESS, HEALTHY_DAMPING = 1e4, 1e3
"""P and D without wear; Park et al. 2024, section IV-C, first condition of Fig. 10"""


@dataclass(frozen=True, kw_only=True)
class PaperRanges:
    """The randomisation of Park et al. 2024, section III-D, rescaled to an arm of this weight.

    0.06 P N m/rad and 0.012 D N m s/rad give their Fig. 10 (measured).
    """

    arm: Arm
    stiffness: Interval = (50.0, 200.0)
    """P of the paper"""
    damping_divisor: Interval = (10.0, 50.0)
    """D between P/50 and P/10"""
    stiffness_unit: float = 0.06
    """[N m/rad] per unit of P on a myCobot 280; goes with the load"""
    damping_unit: float = 0.012
    """[N m s/rad] per unit of D"""
    armature: float = 0.02
    """[kg m^2]"""
    joint_noise: float = float(np.radians(1.0))
    """[rad] sigma of equation 19, once per episode; the paper's 5 degrees cannot be learned (measured)"""
    frequency: Interval = (30.0, 60.0)
    """[Hz]"""

    @classmethod
    def healthy(cls, arm: Arm) -> PaperRanges:
        """Make the ranges of the task without wear: one pair of P and D."""
        one, ratio = (HEALTHY_STIFFNESS, HEALTHY_STIFFNESS), HEALTHY_STIFFNESS / HEALTHY_DAMPING
        return cls(arm=arm, stiffness=one, damping_divisor=(ratio, ratio))

    def draw(self, rng: np.random.Generator, count: int) -> Draw:
        """Draw ``count`` arms."""
        p = rng.uniform(*self.stiffness, (count, 1))
        d = rng.uniform(p / self.damping_divisor[1], p / self.damping_divisor[0])
        noise = rng.normal(0.0, self.joint_noise, (count, self.arm.joints))
        twin = replace(self.twins(p, d), offset=noise)
        return replace(Draw.of(twin), period=1.0 / rng.uniform(*self.frequency, count))

    def twins(self, p: Array, d: Array) -> TwinParameters:
        """Twins with the paper's P and D (count, 1), ample torque, no friction or delay."""
        count, joints = len(p), (len(p), self.arm.joints)
        base, load, length = nominal_parameters(self.arm), torque_size(self.arm), length_size(self.arm)
        none, lots = np.zeros(joints), np.full(joints, 100.0)
        return TwinParameters(
            stiffness=none + load * self.stiffness_unit * p,
            damping=none + load * length**0.5 * self.damping_unit * d,
            coulomb=none,
            armature=none + load * length * self.armature,
            torque_limit=lots * base.torque_limit,
            offset=none,
            delay=np.zeros(count),
            ramp_speed=np.full(count, 100.0) * base.ramp_speed,
        )


def paper_reward(
    distance: Array,
    joint_speed: Array,
    collided: Mask,
    reached: Mask,
    timed_out: Mask,
) -> Array:
    """Equation 25 of Park et al. 2024 for ``distance`` (N,) [m] and ``joint_speed`` (N, n) [rad/s].

    Our choice: centimetres, the mean joint speed; the time-out is a penalty.
    """
    travel = -0.1 * 100.0 * distance - 0.1 * np.abs(joint_speed).mean(axis=-1)
    return travel - 5.0 * timed_out - 10.0 * collided + 10.0 * reached


class PaperTask(ReachTask):
    """A reached target ends the episode; a collision exchanges the arm."""

    ends_on_success = True

    def judge(
        self,
        action: Array,  # noqa: ARG002 - costs nothing here
        before: Array,
        distance: Array,
        speed: Array,  # noqa: ARG002
        late: Mask,
    ) -> tuple[Array, Mask, Mask]:
        """Reward by equation 25; see `ReachTask`."""
        position = self.simulation.twins.qpos
        reached, collided = distance < SUCCESS_DISTANCE, collides(self.arm, position)
        joint_speed = (position - before) / self._period[:, None]
        return paper_reward(distance, joint_speed, collided, reached, late & ~reached), reached, collided


@dataclass(frozen=True)
class _PaperRecipe:
    task: TaskSettings
    ppo: PpoSettings


_RECIPE = read_toml(Path(__file__).with_suffix(".toml"), _PaperRecipe, "install rejoint again")
PAPER = Preset(name="paper", make=PaperTask, task=_RECIPE.task, ppo=_RECIPE.ppo)
"""Park et al. 2024, section III-D and Table 3"""
