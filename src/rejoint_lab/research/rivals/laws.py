"""Rivals of the policy: classical and adaptive laws with tuned gains.

Gain-scheduled integral control, alone or with gravity feed-forward: a rate by distance (Rugh and Shamma, Automatica 36,
2000), and conditional integration (Astrom and Rundqwist, ACC 1989).

Adaptive regulation of an arm with unknown servos and load: Tomei, IEEE Trans. Robotics and Automation 7(4), 1991: PD
plus gravity compensation Y(q) p with ``dp/dt = G Y' (2 e / (1 + 2 e'e) - m v)``. The servo is the PD law, so the
command gets ``load / k + mass * lever / k + offset``. Dead zone: Peterson and Narendra, IEEE Trans. Automatic Control
27(3), 1982.

Gains are numbers or (B, 1); their bounds are chosen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array, clip_norm, gravity_torque, position_kinematics
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.workspace import torque_size
from rejoint.control.controllers.feedforward import NOMINAL_STIFFNESS
from rejoint.control.controllers.law import Pace, dls_step, limit_position, null_space
from rejoint.control.robot import ControlInput, Controller, Mask
from rejoint.system.errors import InputError
from rejoint.system.files import read_json

Gain = float | Array
Interval = tuple[float, float]


def bounds(low: float, high: float) -> dict[str, Interval]:
    """Metadata of a gain that is searched between ``low`` and ``high``."""
    return {"bounds": (low, high)}


@dataclass(frozen=True, kw_only=True, eq=False)
class ScheduledGains:
    """Gains; the last four are for the feed-forward."""

    far_rate: Gain = field(metadata=bounds(0.5, 30.0))
    """[1/s] integrated fraction of the joint step, far away"""
    near_rate: Gain = field(metadata=bounds(0.3, 20.0))
    """[1/s] the same at the target"""
    schedule: Gain = field(metadata=bounds(0.5e-3, 20e-3))
    """[m] distance of the mean rate"""
    deadband: Gain = field(metadata=bounds(1e-5, 1e-3))
    """[m]"""
    proportional: Gain = field(metadata=bounds(1e-3, 1.0))
    """fraction of the joint step, not integrated"""
    damping: Gain = field(metadata=bounds(1e-4, 0.3))
    """[s] of the measured joint speed"""
    prediction: Gain = field(metadata=bounds(1e-3, 0.1))
    """[s] of extrapolation"""
    moving: Gain = field(metadata=bounds(0.01, 3.0))
    """[rad/s] joints above it are not integrated"""
    speed: Gain = field(metadata=bounds(0.05, 5.0))
    """[rad/s] limit of the integration"""
    lead: Gain = field(metadata=bounds(np.radians(4.0), np.radians(40.0)))
    """[rad] anti-windup: largest correction"""
    feedforward: Gain = field(default=0.0, metadata=bounds(0.2, 1.8))
    """compensated share of nominal servos' sag"""
    ramp: Gain = field(default=100.0, metadata=bounds(0.5, 20.0))
    """[rad/s] to the raised posture"""
    carry: Gain = field(default=1.0, metadata=bounds(0.2, 1.0))
    """share of the correction kept at a new target"""


class ScheduledController:
    """The law; ``anchored`` to the goal posture (feed-forward) or not."""

    def __init__(self, arm: Arm, name: str, gains: ScheduledGains, *, anchored: bool) -> None:
        self._arm, self.name, self._gains, self._anchored = arm, name, gains, anchored
        self._pace, self._speed = Pace(), JointSpeed()
        self._stiffness = NOMINAL_STIFFNESS * torque_size(arm)
        self._start = self._raised = self._integral = np.zeros((0, arm.joints))

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Take new targets of the arms in ``where`` (B,)."""
        gains, sent = self._gains, inputs.sent
        if len(self._integral) != len(sent):
            self._integral = np.zeros_like(sent) if self._anchored else sent.copy()
            self._start, self._raised = sent.copy(), sent.copy()
        if not self._anchored:
            return
        goal = inputs.goal[where]
        # What was learned in the null space moves no tool, but adds up from target to target until the arm folds.
        idle = null_space(position_kinematics(self._arm, goal)[1], self._integral[where])
        carry = np.broadcast_to(gains.carry, (len(sent), 1))[where]
        share = np.broadcast_to(gains.feedforward, (len(sent), 1))[where]
        self._integral[where] = carry * (self._integral[where] - idle)
        self._start[where] = sent[where] - self._integral[where]
        self._raised[where] = goal + share * gravity_torque(self._arm, goal) / self._stiffness

    def command(self, inputs: ControlInput) -> Array:
        """Command (B, n) [rad]."""
        arm, gains, measured = self._arm, self._gains, inputs.state.position
        elapsed = self._pace.tick(inputs.state.time)[:, None]
        speed = self._speed.observe(measured, elapsed)
        seen = dls_step(arm, measured + gains.prediction * speed, inputs.target)
        distance = np.linalg.norm(seen.error, axis=-1, keepdims=True)
        rate = gains.near_rate + (gains.far_rate - gains.near_rate) * distance / (distance + gains.schedule)
        step = seen.step * np.maximum(distance - gains.deadband, 0.0) / np.maximum(distance, 1e-9)
        push = elapsed * clip_norm(rate * step, gains.speed)
        on_its_way = (np.abs(speed) > gains.moving) & (speed * push > 0.0)
        passing = gains.proportional * step - gains.damping * speed
        integral = self._integral + np.where(on_its_way, 0.0, push)
        if self._anchored:
            self._integral = np.clip(integral, -gains.lead, gains.lead)
            way = self._raised - self._start
            reach = gains.ramp * inputs.since_target[:, None]
            return limit_position(arm, self._start + np.clip(way, -reach, reach) + self._integral + passing)
        pull = clip_norm(null_space(seen.jacobian, 0.01 * (inputs.goal - integral)), np.radians(0.1))
        integral = integral + (distance > 0.01) * pull  # keeps the arm from folding, see `IntegratorGains`
        self._integral = limit_position(arm, np.clip(integral, measured - gains.lead, measured + gains.lead))
        return limit_position(arm, self._integral + passing)


class JointSpeed:
    """Joint speeds, smoothed over about two cycles."""

    def __init__(self) -> None:
        self._position = self._speed = np.zeros((0, 0))

    def observe(self, position: Array, elapsed: Array) -> Array:
        """Speeds (B, n) [rad/s] of positions (B, n) [rad], ``elapsed`` (B, 1) [s] apart."""
        if self._position.shape != position.shape:
            self._position, self._speed = position.copy(), np.zeros_like(position)
        news = elapsed > 0.0
        difference = (position - self._position) / np.where(news, elapsed, 1.0)
        self._speed = np.where(news, 0.5 * difference + 0.5 * self._speed, self._speed)
        self._position = position.copy()
        return self._speed


_UNIT_MASS = 0.1  # [kg] scale of the unknown load (chosen: brings its regressor to the size of the arm's own)


@dataclass(frozen=True, kw_only=True, eq=False)
class AdaptiveGains:
    """Settings; each a number or (B, 1)."""

    softness_rate: Gain = field(metadata=bounds(0.3, 100.0))
    """[1/(s rad)] adaptation of the relative inverse stiffness"""
    load_rate: Gain = field(metadata=bounds(0.3, 100.0))
    """[1/(s rad)] adaptation of the load"""
    offset_rate: Gain = field(metadata=bounds(0.1, 10.0))
    """[1/s] adaptation of the offset"""
    scale: Gain = field(metadata=bounds(np.radians(0.5), np.radians(30.0)))
    """[rad] error of saturation"""
    damping: Gain = field(metadata=bounds(1e-4, 1.0))
    """[s] weight of the joint speed"""
    dead_zone: Gain = field(metadata=bounds(np.radians(0.01), np.radians(1.0)))
    """[rad]"""
    proportional: Gain = field(metadata=bounds(1e-3, 1.0))
    """beside the servo's own"""
    derivative: Gain = field(metadata=bounds(1e-4, 0.1))
    """[s] of the joint speed"""
    prior: Gain = field(metadata=bounds(0.2, 1.8))
    """[1] initial relative softness"""


class AdaptiveController:
    """Tomei's law for position servos."""

    def __init__(self, arm: Arm, name: str, gains: AdaptiveGains) -> None:
        self._arm, self.name, self._gains = arm, name, gains
        self._pace, self._speed = Pace(), JointSpeed()
        self._stiffness = NOMINAL_STIFFNESS * torque_size(arm)
        self._regressor = self._estimate = np.zeros((3, 0, arm.joints))

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Take new goals in ``where`` (B,); the estimates stay."""
        count, n = inputs.sent.shape
        if self._estimate.shape[1] != count:
            self._estimate, self._regressor = np.zeros((2, 3, count, n))
            self._estimate[0] = self._gains.prior
        goal = inputs.goal[where]
        lever = position_kinematics(self._arm, goal)[1][..., 2, :]
        self._regressor[0][where] = gravity_torque(self._arm, goal) / self._stiffness
        self._regressor[1][where] = _UNIT_MASS * -GRAVITY[2] * lever / self._stiffness
        self._regressor[2][where] = 1.0

    def command(self, inputs: ControlInput) -> Array:
        """Goal posture with its compensation, (B, n) [rad]."""
        gains, measured = self._gains, inputs.state.position
        elapsed = self._pace.tick(inputs.state.time)[:, None]
        speed = self._speed.observe(measured, elapsed)
        error = inputs.goal - measured
        outside = np.sign(error) * np.maximum(np.abs(error) - gains.dead_zone, 0.0)
        size = np.linalg.norm(error / gains.scale, axis=-1, keepdims=True)
        drive = outside / (1.0 + size**2) - gains.damping * speed * (np.abs(outside) > 0.0)
        rates = (gains.softness_rate, gains.load_rate, gains.offset_rate)
        for estimate, regressor, rate in zip(self._estimate, self._regressor, rates, strict=True):
            estimate += elapsed * rate * regressor * drive
        raised = inputs.goal + (self._estimate * self._regressor).sum(axis=0)
        return limit_position(self._arm, raised + gains.proportional * error - gains.derivative * speed)


MakeController = Callable[[Arm, Mapping[str, Array]], Controller]
"""The controller of arms from gains by name, numbers or (B, 1)"""


@dataclass(frozen=True, kw_only=True)
class Rival:
    """A controller with tunable gains."""

    make: MakeController
    intervals: Mapping[str, Interval]
    """bounds of the search"""
    gains: Mapping[str, float]


GAINS = read_json(Path(__file__).with_name("gains.json"), dict[str, dict[str, float]])
"""By ``rejoint research tune`` on the broad ranges, seed 0"""


def _bounds(kind: type[ScheduledGains | AdaptiveGains], *, optional: bool = True) -> dict[str, Interval]:
    return {one.name: one.metadata["bounds"] for one in fields(kind) if optional or one.default is MISSING}


def _scheduled(name: str, *, anchored: bool) -> Rival:
    return Rival(
        make=lambda arm, gains: ScheduledController(arm, name, ScheduledGains(**gains), anchored=anchored),
        intervals=_bounds(ScheduledGains, optional=anchored),
        gains=GAINS[name],
    )


RIVALS = {
    "tuned-integrator": _scheduled("tuned-integrator", anchored=False),
    "tuned-feedforward": _scheduled("tuned-feedforward", anchored=True),
    "adaptive": Rival(
        make=lambda arm, gains: AdaptiveController(arm, "adaptive", AdaptiveGains(**gains)),
        intervals=_bounds(AdaptiveGains),
        gains=GAINS["adaptive"],
    ),
}


def find_rival(name: str) -> Rival:
    """Look up a rival; InputError lists them."""
    if name not in RIVALS:
        raise InputError(f"no rival is called {name!r}; known rivals: {', '.join(RIVALS)}")
    return RIVALS[name]


def make_rival(name: str, arm: Arm, gains: Mapping[str, float] | None = None) -> Controller:
    """Build a rival, default: tuned; InputError for other names."""
    rival = find_rival(name)
    gains = rival.gains if gains is None else gains
    if set(gains) != set(rival.intervals):
        raise InputError(f"{name}: gains {sorted(gains)}, expected {sorted(rival.intervals)}")
    return rival.make(arm, {key: np.asarray(value) for key, value in gains.items()})
