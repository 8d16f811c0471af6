"""Model-based control: inverse kinematics, gravity feed-forward, and an integrator.

The command is raised by the servo's sag: gravity torque over stiffness. The integrator corrects slow joints, also for
the next target. A stuck joint is pushed harder until its reading changes; then most of that push is removed. Constants
without a source are chosen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, Mask, gravity_torque, tcp_position
from rejoint.arms.rotations import task
from rejoint.arms.workspace import length_size, torque_size
from rejoint.control.controllers.classical import (
    FADE,
    LONGEST_PERIOD,
    RATE,
    Pace,
    between,
    dls_step,
    fade,
    limit_position,
    null_space,
)
from rejoint.control.robot import ControlInput
from rejoint.system.errors import InputError

NOMINAL_STIFFNESS = 6.0
"""[N m/rad] of a worn myCobot's servos (chosen: twins have 3 to 12); other arms scale with load"""

LOOSEN, TAKEN_BACK, CALMER, CLOSE = float(np.radians(10.0)), 0.9, 0.7, 4e-4
"""[rad/s] fastest push of a stationary joint; removed share; remaining share when a joint breaks loose the other way;
[m] of a myCobot 280 without a push (chosen on family 1)"""

GENTLE, EARLY, LEAST_PUSH = 2e-3, 6.0, 0.5
"""Pushes are slower by the error over the [m] of a myCobot 280 and the time over the [s], and their least share (chosen
by `python -m benchmarks postures`)"""

HELD_BACK = float(np.radians(3.0))
"""[rad] excess over the last command that stops the integrator"""

SPEED_SMOOTHING = 0.5
"""Share of the newest difference"""


@dataclass(frozen=True, kw_only=True)
class FeedforwardGains:
    """Settings of the integrator."""

    rate: float = RATE
    """[1/s] integrated share of the step"""
    fade: float = FADE
    """[m] distance at which the steps fade to half"""
    learned_limit: float = float(np.radians(45.0))
    """[rad] largest correction (chosen: other joints make up for a stuck one)"""
    forgetting: float = 2.0
    """[1/s] decay of the correction's null-space part far from the target"""
    far: tuple[float, float] = (0.005, 0.015)
    """[m] distances between which that begins, and a new goal clears it"""
    moving: float = 0.1
    """[rad/s] of a moving joint (chosen: two encoder counts per 30 ms)"""


class FeedforwardController:
    """Gravity feed-forward with an integrator."""

    name = "feedforward"
    heeds_turn = True

    def __init__(
        self,
        arm: Arm,
        stiffness: Array | float | None = None,
        gains: FeedforwardGains | None = None,
        loosen: float = LOOSEN,
    ) -> None:
        """``stiffness`` (n,) or (B, n) [N m/rad]; ``loosen`` as `LOOSEN`, larger for arms longer than a myCobot 280."""
        self._arm, self._gains = arm, gains or FeedforwardGains()
        self.loosen = loosen * max(length_size(arm), 1.0)
        self.close, self.gentle = np.array([CLOSE, GENTLE]) * length_size(arm)
        stiffness = NOMINAL_STIFFNESS * torque_size(arm) if stiffness is None else stiffness
        self.stiffness = np.atleast_2d(np.asarray(stiffness, dtype=float) + np.zeros(arm.joints))
        if not (self.stiffness > 0.0).all():
            raise InputError(f"feedforward: stiffness must be positive in N m/rad, got {self.stiffness.tolist()}")
        self._goal = self._raised = self._correction = self._speed = self._position = np.zeros((0, arm.joints))
        self._pushed = self._eager = self._came = self._asked = self._position
        self._idle: Array = np.zeros((0, arm.joints, arm.joints))  # (B, n, n) projection onto the null space
        self._pace = Pace()

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Take new goals of ``where`` (B,); corrections stay. Far from the target their null-space parts go."""
        if len(self._position) != len(inputs.sent):
            self.reset_learned(inputs, np.ones(len(inputs.sent), dtype=bool))
        self._take(inputs, where)
        distance = np.linalg.norm(inputs.target - tcp_position(self._arm, inputs.state.position), axis=-1)
        self._correction -= (where * self._far(distance))[:, None] * self._unneeded()

    def on_the_way(self, inputs: ControlInput) -> Mask:
        """Arms (B,) with moving goals."""
        moved: Mask = np.logical_or.reduce(inputs.goal != self._goal, axis=-1)
        return moved

    def _unneeded(self) -> Array:
        """Null-space parts (B, n) [rad] of the corrections."""
        part: Array = (self._idle @ self._correction[..., None])[..., 0]
        return part

    def _far(self, distance: Array) -> Array:
        """Share (B,), from 0 near to 1 far, at ``distance`` (B,) [m]."""
        near, far = self._gains.far
        return between((distance - near) / (far - near), 0.0, 1.0)

    def _take(self, inputs: ControlInput, where: Mask) -> None:
        goal = self._goal[where] = inputs.goal[where]
        self._eager[where], self._came[where] = 1.0, 0.0
        stiffness = np.broadcast_to(self.stiffness, self._goal.shape)[where]
        self._raised[where] = goal + gravity_torque(self._arm, goal) / stiffness
        turn = None if inputs.turn is None else inputs.turn[where]
        jacobian = task(self._arm, goal, inputs.target[where], turn)[1]
        self._idle[where] = null_space(jacobian[:, None], np.eye(self._arm.joints)).swapaxes(-1, -2)

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        seen = dls_step(self._arm, inputs.state.position, inputs.target, inputs.turn)
        step = fade(seen.error, self._gains.fade) * seen.step
        distance = np.linalg.norm(seen.error[:, :3], axis=-1)
        extra, short = self.loosening(inputs, seen.step, distance), self._asked - inputs.sent
        held = np.abs(short) > HELD_BACK  # nothing winds up that is not sent
        step, extra = (np.where(held & (short * one > 0.0), 0.0, one) for one in (step, extra))
        self._asked = self.correct(inputs, step, extra, distance)
        return self._asked.copy()

    def loosening(self, inputs: ControlInput, step: Array, distance: Array) -> Array:
        """Push (B, n) [rad] of stuck joints; call `correct` next.

        ``step`` (B, n) [rad]: joint errors; ``distance`` (B,) [m]: tool errors.
        """
        moved = inputs.state.position - self._position
        elapsed = between(inputs.state.time - self._pace.last, 0.0, LONGEST_PERIOD)[:, None]
        stays = ~self.on_the_way(inputs)[:, None]
        sticks = stays & (moved == 0.0)
        most = np.maximum(np.abs(step).max(axis=-1, keepdims=True), 1e-9)
        strength = between(distance / self.gentle + inputs.since_target / EARLY, LEAST_PUSH, 1.0)[:, None]
        added = (
            elapsed * self.loosen * strength * self._eager * (step / most) * (sticks & (distance > self.close)[:, None])
        )
        loose = stays & (moved * self._pushed > 0.0)
        taken, back = np.where(loose, TAKEN_BACK * self._pushed, 0.0), loose * np.sign(self._pushed)
        self._eager = np.where(back * self._came < 0.0, CALMER * self._eager, self._eager)
        self._came, self._pushed = np.where(loose, back, self._came), np.where(sticks, self._pushed + added, 0.0)
        return added - taken

    def correct(self, inputs: ControlInput, step: Array, extra: Array, distance: Array) -> Array:
        """Integrate ``step`` (B, n) [rad] of slow joints and add ``extra`` (B, n) [rad]; returns the commands.

        ``distance`` as in `loosening`.
        """
        position = inputs.state.position
        moved = self.on_the_way(inputs)
        if np.count_nonzero(moved):
            self._take(inputs, moved)
        gains, elapsed = self._gains, self._pace.tick(inputs.state.time)
        if np.count_nonzero(distance > gains.far[0]):
            forgotten = self._far(distance) * -np.expm1(-gains.forgetting * elapsed)
            self._correction -= forgotten[:, None] * self._unneeded()
        # Bounded by itself, not by the measured position: on the way the command leads by the whole distance.
        self._integrate(position, elapsed[:, None], step, extra)
        return limit_position(self._arm, self._raised + self._correction)

    def _integrate(self, position: Array, elapsed: Array, step: Array, extra: Array) -> None:
        gains, speed = self._gains, self._speed
        newest = np.divide(position - self._position, elapsed, out=speed.copy(), where=elapsed > 0.0)
        speed[...] = SPEED_SMOOTHING * newest + (1.0 - SPEED_SMOOTHING) * speed
        push = gains.rate * elapsed * step
        push = np.where((np.abs(speed) > gains.moving) & (speed * push > 0.0), 0.0, push)
        self._position[...], limit = position, gains.learned_limit
        self._correction[...] = between(self._correction + push + extra, -limit, limit)

    def reset_learned(self, inputs: ControlInput, where: Mask) -> None:
        """Clear corrections of ``where`` (B,); call `reset` next."""
        if len(self._position) != len(inputs.sent):
            self._goal, self._raised, self._correction, self._speed, self._position = np.zeros((5, *inputs.sent.shape))
            self._pushed, self._eager, self._came, self._asked = np.zeros((4, *inputs.sent.shape))
            self._idle = np.zeros((*inputs.sent.shape, self._arm.joints))
        self._correction[where] = self._speed[where] = self._pushed[where] = 0.0
        self._asked[where] = inputs.sent[where]
        self._position = np.where(where[:, None], inputs.state.position, self._position)
        self._pace.begin(inputs.state.time, where)

    def take_over(self, inputs: ControlInput, where: Mask) -> None:
        """Continue from another controller's command, where ``where`` (B,)."""
        self._correction[where] = inputs.sent[where] - self._raised[where]
        self._asked[where] = inputs.sent[where]
        self._pushed[where] = 0.0
