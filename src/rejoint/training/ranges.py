"""The twins that a policy is trained on: random draws of all differences between arms.

`BroadRanges` is the prior of a worn hobby arm, measured in simulation; `IdentifiedRanges` draws from a twin,
`MixedRanges` from one or the other.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any, Protocol

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.system.records import entity, value_type
from rejoint.twin.parameters import TwinParameters, nominal_parameters
from rejoint.twin.simulation import Draw
from rejoint.twin.twin import LEAST_SPREAD, Twin

Interval = tuple[float, float]

TWIN_SHARE = 0.5
"""Fraction of arms drawn around the identified twin; chosen: steadier with backlash than 0.8"""

OUTWARD: Interval = (0.3, 0.7)
"""Share of the command delay in a twin's delay; chosen"""

SLOW_BACKLASH: Interval = (0.0, float(np.radians(1.8)))
"""[rad] of arms whose motors cross backlash slowly, as an SO-101; chosen: new servos show about a degree"""


class Ranges(Protocol):
    """A distribution of arms."""

    def draw(self, rng: np.random.Generator, count: int) -> Draw:
        """Draw ``count`` arms."""


@value_type
class BroadRanges:
    """Independent ranges around the prior of an arm; intervals are factors on its medians."""

    arm: Arm
    stiffness: Interval = (3.0 / 7.0, 12.0 / 7.0)
    """3 to 12 N m/rad near the base of a myCobot 280: 0.06 times P of Park et al. 2024"""
    joint_spread: Interval = (0.75, 1.25)
    """of each joint's stiffness"""
    damping: Interval = (0.4, 2.4)
    """log-uniform; 0.1 to 0.6 N m s/rad"""
    damping_spread: Interval = (0.8, 1.2)
    armature: Interval = (0.5, 2.0)
    """log-uniform; 0.01 to 0.04 kg m^2"""
    coulomb: Interval = (0.0, 0.25 / 0.08)
    """up to 0.25 N m"""
    frictionless: float = 0.2
    """fraction of arms without dry friction; chosen"""
    stiction: Interval = (1.0, 2.2)
    """static over kinetic friction; chosen: lubricated gears up to dry plastic"""
    torque_limit: Interval = (0.65 / 0.92, 1.3 / 0.92)
    """0.65 to 1.3 N m: some arms can barely lift themselves"""
    weak_joints: float = 0.08
    """probability of a nearly powerless joint; chosen"""
    weakness: Interval = (0.05, 0.5)
    """factor on its torque limit"""
    ramp_speed: Interval = (0.7, 1.31)
    """80 to 150 deg/s"""
    acceleration: float = np.inf
    """[rad/s^2] of the servos' references; inf: limited speed instead"""
    offset: float = float(np.radians(0.5))
    """[rad] sigma"""
    gravity_scale: Interval = (0.85, 1.15)
    command_delay: Interval = (0.005, 0.040)
    """[s]"""
    readback_delay: Interval = (0.005, 0.030)
    """[s]"""
    period: Interval = (0.018, 0.055)
    """[s] from an idle bus to 50 ms over TCP"""
    backlash: Interval = (0.0, 0.0)
    """[rad], with encoders behind the gears; see `SLOW_BACKLASH`"""
    backlash_free: float = 0.4
    """fraction of arms with encoders before the gears; chosen"""
    grease: Interval = (0.02, 0.2)
    """log-uniform; chosen: some joints coast through a degree of backlash"""

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
        drawn = replace(
            Draw.of(twin, acceleration=self.acceleration),
            command_delay=rng.uniform(*self.command_delay, whole),
            readback_delay=rng.uniform(*self.readback_delay, whole),
            twin=replace(twin, stiction=rng.uniform(*self.stiction, joints)),
            gravity_scale=rng.uniform(*self.gravity_scale, whole),
            period=rng.uniform(*self.period, whole),
        )
        if self.backlash[1] == 0.0:  # nothing more is drawn, so that ranges without backlash stay what they were
            return drawn
        seen = rng.random(one) >= self.backlash_free
        return replace(
            drawn, backlash=rng.uniform(*self.backlash, joints) * seen, grease=_log_uniform(rng, self.grease, whole)
        )

    def reaching(self, twin: Twin) -> BroadRanges:
        """Shift the intervals of all torques to hold the twin's geometric mean over the joints.

        An arm with more damping than the prior gets `SLOW_BACKLASH`.
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
        """Draw factors (count, n) on the torque limits."""
        shape = (count, self.arm.joints)
        return np.where(rng.random(shape) < self.weak_joints, rng.uniform(*self.weakness, shape), 1.0)


@entity
class IdentifiedRanges:
    """Draws from the covariance of an identified twin.

    Its intervals are calibrated (`python -m benchmarks truth`). What a twin does not hold comes from ``broad``.
    """

    broad: BroadRanges
    twin: Twin

    def draw(self, rng: np.random.Generator, count: int) -> Draw:
        """Draw ``count`` arms."""
        free, twins = self.broad.draw(rng, count), self.twin.sample(rng, count)
        share, acceleration = rng.uniform(*OUTWARD, count), np.full(count, np.inf)
        weakened = twins.torque_limit * self.broad.weaken(rng, count)
        if self.twin.acceleration < np.inf:  # else nothing is drawn: other numbers stay what they were
            acceleration = self.twin.acceleration * np.exp(LEAST_SPREAD * rng.standard_normal(count))
        return replace(
            free,
            twin=replace(twins, torque_limit=weakened),
            command_delay=share * twins.delay,
            readback_delay=(1.0 - share) * twins.delay,
            acceleration=acceleration,
        )


@entity
class MixedRanges:
    """Takes each arm from ``first`` with probability ``share``, else from ``second``."""

    first: Ranges
    second: Ranges
    share: float

    def draw(self, rng: np.random.Generator, count: int) -> Draw:
        """Draw ``count`` arms."""
        from_first = rng.random(count) < self.share
        first, second = self.first.draw(rng, count), self.second.draw(rng, count)

        def pick(one: Any, other: Any) -> Any:  # noqa: ANN401 - an array, or what holds arrays
            if not isinstance(one, np.ndarray):
                return replace(one, **{f.name: pick(getattr(one, f.name), getattr(other, f.name)) for f in fields(one)})
            return np.where(from_first.reshape(-1, *[1] * (one.ndim - 1)), one, other)

        drawn: Draw = pick(first, second)
        return drawn


def training_ranges(arm: Arm, twin: Twin | None) -> Ranges:
    """Arms to train on: draws around a twin mixed with broad ranges, else broad ones."""
    if twin is None:
        return BroadRanges(arm=arm)
    broad = BroadRanges(arm=arm).reaching(twin)
    return MixedRanges(first=IdentifiedRanges(broad=broad, twin=twin), second=broad, share=TWIN_SHARE)


def _log_uniform(rng: np.random.Generator, interval: Interval, shape: tuple[int, ...]) -> Array:
    low, high = np.log(interval)
    return np.exp(rng.uniform(low, high, shape))
