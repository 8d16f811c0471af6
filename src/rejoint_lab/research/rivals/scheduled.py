"""Gain-scheduled integral control, alone or with gravity feed-forward.

A rate by distance (Rugh and Shamma, Automatica 36, 2000), and conditional integration (Astrom and Rundqwist, ACC 1989).
Gains are numbers or (B, 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, clip_norm, gravity_torque, position_kinematics
from rejoint.arms.workspace import torque_size
from rejoint.control.controller import ControlInput
from rejoint.control.feedforward import NOMINAL_STIFFNESS
from rejoint.control.law import Pace, dls_step, limit_position, null_space
from rejoint.control.robot import Mask

Gain = float | Array


@dataclass(frozen=True, kw_only=True, eq=False)
class ScheduledGains:
    """Gains; the last four are for the feed-forward."""

    far_rate: Gain
    """[1/s] integrated fraction of the joint step, far away"""
    near_rate: Gain
    """[1/s] the same at the target"""
    schedule: Gain
    """[m] distance of the mean rate"""
    deadband: Gain
    """[m]"""
    proportional: Gain
    """fraction of the joint step, not integrated"""
    damping: Gain
    """[s] of the measured joint speed"""
    prediction: Gain
    """[s] of extrapolation"""
    moving: Gain
    """[rad/s] joints above it are not integrated"""
    speed: Gain
    """[rad/s] limit of the integration"""
    lead: Gain
    """[rad] anti-windup: largest correction"""
    feedforward: Gain = 0.0
    """compensated share of nominal servos' sag"""
    ramp: Gain = 100.0
    """[rad/s] to the raised posture"""
    carry: Gain = 1.0
    """share of the correction kept at a new target"""


class ScheduledController:
    """The law; ``anchored`` to the goal posture (feed-forward) or not."""

    def __init__(self, arm: Arm, name: str, gains: ScheduledGains, *, anchored: bool) -> None:
        self._arm, self._name, self._gains, self._anchored = arm, name, gains, anchored
        self._pace, self._speed = Pace(), JointSpeed()
        self._stiffness = NOMINAL_STIFFNESS * torque_size(arm)
        self._start = self._raised = self._integral = np.zeros((0, arm.joints))

    @property
    def name(self) -> str:
        """Name in tables."""
        return self._name

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
