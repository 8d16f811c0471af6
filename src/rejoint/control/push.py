"""The feed-forward with a push against friction, and a little dither.

A joint that stands still needs a torque beyond its friction before it moves. The command of a joint that is to move is
led by a share of that friction over its servo's stiffness, and trembles by another share, so that the joint creeps
where it would stick and then jump. Both fade while the joint moves, and at the target. Owners and makers of torque
arms publish such laws (i2rt, pull request 37; almond-bot/axol, pull request 317, where the error at rest fell from
0.58 to 0.14 degrees); here the servo is given an angle, so the push is a lead. What the friction is, the arm's twin
says.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.controller import ControlInput
from rejoint.control.feedforward import SPEED_SMOOTHING, FeedforwardController
from rejoint.control.law import dls_step, fade, limit_position
from rejoint.control.pace import Pace
from rejoint.control.robot import Mask
from rejoint.system.errors import InputError

GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
"""[rad] by which the dithers of neighbouring joints are out of step: no two of them push the tool alike"""


@dataclass(frozen=True, kw_only=True)
class PushGains:
    """Settings of the push, chosen on emulated SO-101 under tuned gains (`python -m benchmarks.so101 push`)."""

    push: float = 0.3
    """share of the dry friction by which a joint is led (chosen: from half of it on, arms that stick most hunt)"""
    dither: float = 0.3
    """amplitude of the dither in the same terms (chosen: likewise)"""
    frequency: float = 8.0
    """[Hz] of the dither (chosen: six commands of 20 ms a period)"""
    moving: float = 0.05
    """[rad/s] at which a joint's push has faded to 1/e (chosen: one encoder count in 30 ms)"""
    sign: float = 1.5
    """[encoder steps] of missing motion over which the push turns its sign (chosen: a reading is sure to one)"""
    near: float = 3e-4
    """[m] distance from the target at which the push has faded to half (chosen: what an encoder step moves the tool)"""
    most: float = float(np.radians(5.0))
    """[rad] most that a joint's friction counts for (chosen: the elbow of an SO-101 as found has 4.7 deg at P = 16)"""


class PushController:
    """Feed-forward, led by a share of each joint's friction."""

    name = "push"
    heeds_turn = True

    def __init__(
        self, arm: Arm, stiffness: Array | float, friction: Array | float, gains: PushGains | None = None
    ) -> None:
        """``stiffness`` [N m/rad] and dry ``friction`` [N m] of the servos, (n,) or one for all."""
        self._arm, self._gains, self._base = arm, gains or PushGains(), FeedforwardController(arm, stiffness)
        lead = np.broadcast_to(np.asarray(friction, dtype=float) / stiffness, (arm.joints,))
        if not (lead >= 0.0).all():
            raise InputError(f"push: friction must not be negative, in N m, got {np.asarray(friction).tolist()}")
        self._lead = np.minimum(lead, self._gains.most)
        self._pace, self._last, self._speed = Pace(), np.zeros((0, arm.joints)), np.zeros((0, arm.joints))

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Solve for the new targets of the arms in ``where`` (B,)."""
        self._base.reset(inputs, where)

    def command(self, inputs: ControlInput) -> Array:
        """Return the feed-forward's commands, pushed, (B, n) [rad]."""
        arm, gains, position = self._arm, self._gains, inputs.state.position
        seen = dls_step(arm, position, inputs.target, inputs.turn)
        push = gains.push * np.tanh(seen.step / (gains.sign * arm.encoder_step))
        phase = 2.0 * np.pi * gains.frequency * inputs.state.time[:, None] + GOLDEN * np.arange(arm.joints)
        standing = np.exp(-((self._speeds(inputs) / gains.moving) ** 2))
        lead = self._lead * standing * fade(seen.error, gains.near) * (push + gains.dither * np.sin(phase))
        return limit_position(arm, self._base.command(inputs) + lead)

    def _speeds(self, inputs: ControlInput) -> Array:
        """Estimate the speeds (B, n) [rad/s] of the joints; those of a state that says nothing new stay."""
        position, elapsed = inputs.state.position, self._pace.tick(inputs.state.time)[:, None]
        if len(self._last) != len(position):
            self._last, self._speed = position.copy(), np.zeros_like(position)
        newest = np.where(elapsed > 0.0, (position - self._last) / np.maximum(elapsed, 1e-9), self._speed)
        self._speed = SPEED_SMOOTHING * newest + (1.0 - SPEED_SMOOTHING) * self._speed
        self._last = position.copy()
        return self._speed
