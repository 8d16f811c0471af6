"""Brings a worn arm to joint positions, its tool first.

The law of the feed-forward controller, with joint errors as steps. Other joints make up for one without torque.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, Mask, clip_norm, dls, frames, position_kinematics, tcp_position
from rejoint.arms.rotations import rotation_error
from rejoint.control.controllers.classical import between, limit_lead, limit_position
from rejoint.control.controllers.feedforward import TAKEN_BACK, FeedforwardController, FeedforwardGains
from rejoint.control.robot import ControlInput, Stillness

STILL = 1.5
"""encoder counts of a stationary reading (chosen)"""

# Chosen by `python -m benchmarks serve`:
FADE = np.radians(0.3)
"""[rad] error at which the integrated share of it fades to half"""
PUSH, WITHIN = np.radians(5.0), np.radians(0.06)
"""[rad/s] extra push at rest, and [rad] error without it"""
MOVING, STANDING = float(np.radians(5.0)), np.radians(1.0)
"""[rad/s] without correction, and of a stationary joint"""
OFF = np.radians(0.3)
"""[rad] error of a joint without torque"""
TURN = 0.03
"""[m/rad] of the tool's direction"""
CALM = 0.15
"""[s] within `STILL` of a stationary arm"""


@dataclass(frozen=True, kw_only=True)
class PostureGains:
    """Settings; chosen likewise."""

    weak: float = float(np.radians(12.0))
    """[rad] following error without torque"""
    close: float = 4e-4
    """[m] uncorrected tool error at rest"""
    again: float = 7e-4
    """[m] corrected again"""
    lead: float = float(np.radians(18.0))
    """[rad] largest following error, below the guard's"""


class PostureController(FeedforwardController):
    """Brings B arms to their goals, joint by joint."""

    name = "posture"
    heeds_turn = False

    def __init__(
        self,
        arm: Arm,
        *,
        stiffness: Array | None = None,
        offset: Array | float = 0.0,
        gains: PostureGains | None = None,
    ) -> None:
        """``stiffness`` (n,) [N m/rad] and ``offset`` (n,) [rad] of the twin."""
        super().__init__(arm, stiffness, FeedforwardGains(moving=MOVING))
        self._settings, self._offset = gains or PostureGains(), offset
        self._still = Stillness(STILL * arm.encoder_step)
        self._weak: Mask = np.zeros((0, arm.joints), dtype=bool)
        self._rests: Mask = np.zeros(0, dtype=bool)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Do nothing."""

    def _take(self, inputs: ControlInput, where: Mask) -> None:
        super()._take(inputs, where)
        self._raised[where] -= self._offset

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        position, everyone = inputs.state.position, np.ones(len(inputs.sent), dtype=bool)
        if len(self._position) != len(position):
            self.reset_learned(inputs, everyone)
            self._take(inputs, everyone)
            self.take_over(inputs, everyone)
            self._weak, self._rests = np.zeros(position.shape, dtype=bool), ~everyone
        moved, goal = position - self._position, self._goals_of(inputs)
        error, arrived = np.where(self._weak, inputs.goal, goal) - position, inputs.arrived[:, None]
        rests, size, stays = self._at_rest(inputs)[:, None], np.abs(error), (moved == 0.0) & arrived
        push = PUSH / self._gains.rate * np.sign(error) * ((size > WITHIN) & arrived)
        loose = arrived & (self._pushed * moved > 0.0)
        taken, before = np.where(loose, TAKEN_BACK * self._pushed, 0.0), self._correction.copy()
        command = self.correct(inputs, error * size / (size + FADE) + push, -taken, np.zeros(len(error)))
        lead = np.where(self._weak, 1.25 * self._settings.weak, self._settings.lead)  # more would only heat it
        self._asked = np.where(rests, self._asked, limit_lead(command, position, lead))
        added, lost = self._correction + taken - before, self._raised + self._correction - self._asked
        self._correction -= lost  # nothing winds up beyond what can be sent
        sent = between(added - lost, np.minimum(added, 0.0), np.maximum(added, 0.0))
        self._pushed = np.where(stays, self._pushed + sent, 0.0)
        return self._asked.copy()

    def _at_rest(self, inputs: ControlInput) -> Mask:
        """Stationary arms (B,) whose tool is close."""
        position = inputs.state.position
        stood = self._still.look(inputs.state.time, position).min(axis=1)
        away = tcp_position(self._arm, position) - tcp_position(self._arm, inputs.goal)
        near = np.linalg.norm(away, axis=-1) < np.where(self._rests, self._settings.again, self._settings.close)
        self._rests = (stood >= CALM) & inputs.arrived & near
        return self._rests

    def _goals_of(self, inputs: ControlInput) -> Array:
        """Postures (B, n) [rad] that place the tools despite weak joints."""
        position, posture = inputs.state.position, inputs.goal
        lead, away = self._asked - position, posture - position
        off = inputs.arrived[:, None] & (np.abs(away) > OFF)
        spent = (np.abs(lead) > self._settings.weak) & (away * lead > 0.0) & (np.abs(self._speed) < STANDING)
        self._weak = (self._weak | spent) & off
        rows = self._weak.any(axis=1)
        if not rows.any():
            return posture
        goal = posture.copy()
        goal[rows] = _without(self._arm, posture[rows], position[rows], self._weak[rows])
        return goal


def _without(arm: Arm, posture: Array, position: Array, weak: Mask) -> Array:
    """Postures (B, n) [rad] near ``posture`` with the same tool place and constant ``weak`` joints."""
    goal = np.where(weak, position, posture)
    place, direction = tcp_position(arm, posture), frames(arm, posture).tcp_rotation
    free = ~weak[:, None, :]
    for weight, damping in ((TURN, 0.004), (TURN, 0.004), (TURN, 0.004), (0.0, 0.001)):  # its place comes last
        tool, jacobian = position_kinematics(arm, goal)
        seen = frames(arm, goal)
        turning = weight * rotation_error(seen.tcp_rotation, direction)
        both = np.concatenate([jacobian, weight * np.swapaxes(seen.axis, -1, -2)], axis=-2) * free
        step = dls(both, np.concatenate([place - tool, turning], axis=-1), damping)
        goal = goal + clip_norm(step, np.radians(8.0))
    return limit_position(arm, goal)
