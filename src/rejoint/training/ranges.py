"""Which twins a policy is trained on: draws of everything that differs from arm to arm.

`BroadRanges` is what one believes of a worn hobby arm without any data; `IdentifiedRanges` draws from
the covariance of an identified twin. `MixedRanges` takes each episode from one or the other: where
the data speak too surely (a twin is simpler than an arm), the broad half keeps the policy robust.

The numbers of `BroadRanges` were measured in simulation: a policy trained on them alone kept its accuracy
on arms it had not met. Breadth matters more than the centre.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.workspace import length_size, torque_size
from rejoint.twin.parameters import PARAMETERS, STICTION, TwinParameters, nominal_parameters
from rejoint.twin.simulation import Draw
from rejoint.twin.twin import LEAST_SPREAD, Twin

Interval = tuple[float, float]

TWIN_SHARE = 0.5
"""Fraction of the arms that are drawn around the identified twin (chosen: with 0.8 the policy is a little faster on
the arm itself, with 0.5 a little steadier on one whose gears play inside the loop)."""

SLOW_BACKLASH: Interval = (0.0, float(np.radians(1.8)))
"""[rad] backlash of arms whose motors cross it slowly (chosen: new servos of this class show about a degree).

A motor crosses backlash in its width times damping over spare torque: with the prior's damping within a control
period or two, with that of an SO-101 in ten. There a policy that has never met it swings; elsewhere training with it
cost accuracy where there was no backlash (chosen for that)."""


class Ranges(Protocol):
    """A distribution of arms."""

    def draw(self, rng: np.random.Generator, count: int) -> Draw:
        """Draw ``count`` arms."""


@dataclass(frozen=True, kw_only=True)
class BroadRanges:
    """Independent ranges around the prior of an arm. Intervals are factors on the prior's medians."""

    arm: Arm
    stiffness: Interval = (3.0 / 7.0, 12.0 / 7.0)
    """3 to 12 N m/rad near the base of a myCobot 280: 0.06 times the P of 50 to 200 of Park et al. 2024"""
    joint_spread: Interval = (0.75, 1.25)
    """factor of each joint's stiffness on its own"""
    damping: Interval = (0.4, 2.4)
    """log-uniform; 0.1 to 0.6 N m s/rad"""
    damping_spread: Interval = (0.8, 1.2)
    armature: Interval = (0.5, 2.0)
    """log-uniform; 0.01 to 0.04 kg m^2"""
    coulomb: Interval = (0.0, 0.25 / 0.08)
    """up to 0.25 N m"""
    frictionless: float = 0.2
    """fraction of the arms without any dry friction (chosen: with half of them, settling on worn arms suffers)"""
    stiction: Interval = (1.0, 2.2)
    """friction at rest over friction in motion (chosen: lubricated gears up to dry plastic)"""
    torque_limit: Interval = (0.65 / 0.92, 1.3 / 0.92)
    """0.65 to 1.3 N m: some arms can barely lift themselves"""
    weak_joints: float = 0.08
    """chance that a joint is nearly powerless: the others must then do its work (chosen: one in every second arm)"""
    weakness: Interval = (0.05, 0.5)
    """factor on the torque limit of such a joint: from stuck to slow"""
    ramp_speed: Interval = (0.7, 1.31)
    """80 to 150 deg/s"""
    acceleration: float = np.inf
    """[rad/s^2] of the servos' references; inf: their speed is limited instead"""
    offset: float = float(np.radians(0.5))
    """[rad] standard deviation of the joint offsets"""
    gravity_scale: Interval = (0.85, 1.15)
    command_delay: Interval = (0.005, 0.040)
    """[s]"""
    readback_delay: Interval = (0.005, 0.030)
    """[s]"""
    period: Interval = (0.018, 0.055)
    """[s] what the wires of hobby arms allow, from an idle bus to 50 ms over TCP"""
    backlash: Interval = (0.0, 0.0)
    """[rad] of arms whose encoders sit behind the gears; see `SLOW_BACKLASH`"""
    backlash_free: float = 0.4
    """fraction of the arms whose encoders sit before the gears, so that the servos see no backlash (chosen)"""
    grease: Interval = (0.02, 0.2)
    """log-uniform; from a joint that coasts through a degree of backlash to one that hardly does (chosen)"""

    def draw(self, rng: np.random.Generator, count: int) -> Draw:
        """Draw ``count`` arms."""
        base, n = nominal_parameters(self.arm), self.arm.joints
        joints, one, whole = (count, n), (count, 1), (count,)
        friction = rng.uniform(*self.coulomb, joints) * (rng.random(one) >= self.frictionless)
        twin = TwinParameters(
            stiffness=base.stiffness * rng.uniform(*self.stiffness, one) * rng.uniform(*self.joint_spread, joints),
            damping=base.damping * _log_uniform(rng, self.damping, one) * rng.uniform(*self.damping_spread, joints),
            coulomb=base.coulomb * friction,
            armature=base.armature * _log_uniform(rng, self.armature, joints),
            torque_limit=base.torque_limit * rng.uniform(*self.torque_limit, joints) * self.weaken(rng, count),
            offset=rng.normal(0.0, self.offset, joints),
            delay=np.zeros(count),
            ramp_speed=base.ramp_speed * rng.uniform(*self.ramp_speed, whole),
        )
        return Draw(
            twin=twin,
            command_delay=rng.uniform(*self.command_delay, whole),
            readback_delay=rng.uniform(*self.readback_delay, whole),
            stiction=rng.uniform(*self.stiction, joints),
            acceleration=np.full(count, self.acceleration),
            gravity_scale=rng.uniform(*self.gravity_scale, whole),
            period=rng.uniform(*self.period, whole),
            **self._draw_backlash(rng, count),
        )

    def _draw_backlash(self, rng: np.random.Generator, count: int) -> dict[str, Array]:
        joints, whole = (count, self.arm.joints), (count,)
        if self.backlash[1] == 0.0:  # nothing is drawn, so that ranges without backlash stay what they were
            return {"backlash": np.zeros(joints), "grease": np.ones(whole)}
        seen = rng.random((count, 1)) >= self.backlash_free
        return {"backlash": rng.uniform(*self.backlash, joints) * seen, "grease": _log_uniform(rng, self.grease, whole)}

    def reaching(self, twin: Twin) -> BroadRanges:
        """Shift the intervals of all torques until each holds the twin's geometric mean over the joints.

        Arms of another make than the prior's, such as one with much more friction, lie far outside of it; a
        broad half that has none like them would teach the policy to shake them. One with more damping than any of
        the prior's gets `SLOW_BACKLASH`.
        """
        base = nominal_parameters(self.arm)
        moved: dict[str, Any] = {}
        for name in ("stiffness", "damping", "coulomb", "torque_limit"):
            low, high = getattr(self, name)
            ratio = np.exp(np.log(getattr(twin.parameters, name) / getattr(base, name)).mean())
            shift = ratio / np.clip(ratio, low, high)
            moved[name] = (float(low * shift), float(high * shift))
        if moved["damping"][1] > self.damping[1]:
            moved["backlash"] = SLOW_BACKLASH
        return replace(self, **moved)

    def weaken(self, rng: np.random.Generator, count: int) -> Array:
        """Draw factors (count, n) on the torque limits that make some joints nearly powerless."""
        shape = (count, self.arm.joints)
        return np.where(rng.random(shape) < self.weak_joints, rng.uniform(*self.weakness, shape), 1.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class IdentifiedRanges:
    """Draws from the correlated covariance of an identified twin.

    Its intervals hold the truth as often as they say (`python -m benchmarks truth`), so they are not widened.
    Parameters that the data could not tell apart keep their prior range. Stiction is the twin's where logs have told
    it; where it is assumed it is drawn broadly (chosen: an assumption is not knowledge). What a twin does not hold
    (gravity, period, the way out's share of the delay) is drawn from ``broad``, and so are powerless joints: an
    excitation that never needs a joint's full torque does not show them.
    """

    broad: BroadRanges
    twin: Twin
    outward: Interval = (0.3, 0.7)
    """share of the total delay that lies on the way out"""

    def draw(self, rng: np.random.Generator, count: int) -> Draw:
        """Draw ``count`` arms."""
        free, twins = self.broad.draw(rng, count), self.twin.sample(rng, count)
        share = rng.uniform(*self.outward, count)
        known = self.twin.stiction != STICTION
        return Draw(
            twin=replace(twins, torque_limit=twins.torque_limit * self.broad.weaken(rng, count)),
            command_delay=share * twins.delay,
            readback_delay=(1.0 - share) * twins.delay,
            stiction=np.full_like(free.stiction, self.twin.stiction) if known else free.stiction,
            gravity_scale=free.gravity_scale,
            period=free.period,
            backlash=free.backlash,
            grease=free.grease,
            acceleration=self._accelerations(rng, count),
        )

    def _accelerations(self, rng: np.random.Generator, count: int) -> Array:
        """Limits (count,) [rad/s^2] of the servos' references, spread as `Twin.sample` spreads what it knows."""
        if self.twin.acceleration == np.inf:  # nothing is drawn: other numbers stay what they were
            return np.full(count, np.inf)
        return self.twin.acceleration * np.exp(LEAST_SPREAD * rng.standard_normal(count))


@dataclass(frozen=True, kw_only=True, eq=False)
class MixedRanges:
    """Takes each arm from ``first`` with probability ``share``, otherwise from ``second``."""

    first: Ranges
    second: Ranges
    share: float = 0.5

    def draw(self, rng: np.random.Generator, count: int) -> Draw:
        """Draw ``count`` arms."""
        from_first = rng.random(count) < self.share
        first, second = self.first.draw(rng, count), self.second.draw(rng, count)

        def pick(one: Array, other: Array) -> Array:
            return np.where(from_first.reshape(-1, *[1] * (one.ndim - 1)), one, other)

        twin = TwinParameters(**{p.name: pick(getattr(first.twin, p.name), getattr(second.twin, p.name))
                                 for p in PARAMETERS})  # fmt: skip
        others = {
            f.name: pick(getattr(first, f.name), getattr(second, f.name)) for f in fields(Draw) if f.name != "twin"
        }
        return Draw(twin=twin, **others)


HEALTHY_STIFFNESS, HEALTHY_DAMPING = 1e4, 1e3
"""P and D with which an arm moves as one without wear; Park et al. 2024, section IV-C, first condition of Fig. 10."""


@dataclass(frozen=True, kw_only=True)
class PaperRanges:
    """The randomisation of Park et al. 2024, section III-D, rescaled to an arm of this weight.

    Their P and D are units of a physics engine: P = 50..200 read as N m/rad leaves nothing to learn
    on a 0.85 kg arm. With 0.06 P N m/rad and 0.012 D N m s/rad their Fig. 10 holds (measured).
    """

    arm: Arm
    stiffness: Interval = (50.0, 200.0)
    """P of the paper"""
    damping_divisor: Interval = (10.0, 50.0)
    """D lies between P/50 and P/10"""
    stiffness_unit: float = 0.06
    """[N m/rad] of one unit of P on a myCobot 280; goes with the load of the arm, as the other torques"""
    damping_unit: float = 0.012
    """[N m s/rad] of one unit of D"""
    armature: float = 0.02
    """[kg m^2]"""
    joint_noise: float = float(np.radians(1.0))
    """[rad] standard deviation of equation 19, drawn once per episode. The paper's 5 degrees exceed what the
    action can correct together with the sag, and cannot be learned (measured)"""
    frequency: Interval = (30.0, 60.0)
    """[Hz] control frequency"""

    @classmethod
    def healthy(cls, arm: Arm, joint_noise: float) -> PaperRanges:
        """Make the ranges of the same task without wear: one pair of P and D, that of a normal arm."""
        one, ratio = (HEALTHY_STIFFNESS, HEALTHY_STIFFNESS), HEALTHY_STIFFNESS / HEALTHY_DAMPING
        return cls(arm=arm, stiffness=one, damping_divisor=(ratio, ratio), joint_noise=joint_noise)

    def draw(self, rng: np.random.Generator, count: int) -> Draw:
        """Draw ``count`` arms."""
        p = rng.uniform(*self.stiffness, (count, 1))
        d = rng.uniform(p / self.damping_divisor[1], p / self.damping_divisor[0])
        noise = rng.normal(0.0, self.joint_noise, (count, self.arm.joints))
        twin = replace(self.twins(p, d), offset=noise)
        return replace(Draw.of(twin), period=1.0 / rng.uniform(*self.frequency, count))

    def twins(self, p: Array, d: Array) -> TwinParameters:
        """Return twins with the paper's P and D (count, 1): PD servos of ample torque, without friction or delay."""
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


def identified_ranges(arm: Arm, twin: Twin) -> MixedRanges:
    """Mix draws around an identified twin with the broad ranges; `TWIN_SHARE` of the arms come from the twin."""
    broad = BroadRanges(arm=arm).reaching(twin)
    return MixedRanges(first=IdentifiedRanges(broad=broad, twin=twin), second=broad, share=TWIN_SHARE)


def _log_uniform(rng: np.random.Generator, interval: Interval, shape: tuple[int, ...]) -> Array:
    low, high = np.log(interval)
    return np.exp(rng.uniform(low, high, shape))
