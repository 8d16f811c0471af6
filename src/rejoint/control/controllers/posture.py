"""Brings a worn arm to joint positions, its tool first.

The command is the posture, raised by the twin's sag and an integrator. A joint without torque keeps its following
error; others make up for the tool.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, clip_norm, dls, frames, gravity_torque, position_kinematics, tcp_position
from rejoint.arms.rotations import rotation_error
from rejoint.arms.workspace import torque_size
from rejoint.control.controllers.classical import between, limit_position
from rejoint.control.controllers.feedforward import NOMINAL_STIFFNESS
from rejoint.control.robot import ControlInput, JointState, Mask

STILL = 1.5
"""encoder counts of a stationary reading (chosen)"""
_SMOOTHING = 0.5  # share of the newest difference in the speed estimate (chosen, as in the feed-forward controller)


# Chosen by `python -m benchmarks serve`:
RATE = 4.0
"""[1/s] integrated share of the error"""
FADE = np.radians(0.3)
"""[rad] error at which that fades to half"""
PUSH, WITHIN = np.radians(5.0), np.radians(0.06)
"""[rad/s] extra push at rest, and [rad] error without it"""
TAKEN_BACK = 0.9
"""removed share of the push after motion"""
MOVING, STANDING = np.radians(5.0), np.radians(1.0)
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


class PostureController:
    """Brings B arms to their goals, joint by joint."""

    name = "posture"

    def __init__(
        self,
        arm: Arm,
        *,
        stiffness: Array | None = None,
        offset: Array | float = 0.0,
        gains: PostureGains | None = None,
    ) -> None:
        """``stiffness`` (n,) [N m/rad] and ``offset`` (n,) [rad] of the twin."""
        self._arm, self._gains = arm, gains or PostureGains()
        nominal = np.full(arm.joints, NOMINAL_STIFFNESS * torque_size(arm))
        self._stiffness, self._offset = nominal if stiffness is None else stiffness, offset
        self._time: Array | None = None
        self._position = self._speed = self._learned = self._pushed = self._command = np.zeros((0, arm.joints))
        self._anchor = self._position
        self._stood: Array = np.zeros(0)
        self._weak: Mask = np.zeros((0, arm.joints), dtype=bool)
        self._rests: Mask = np.zeros(0, dtype=bool)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Do nothing."""

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        state = inputs.state
        raised = inputs.goal + gravity_torque(self._arm, inputs.goal) / self._stiffness - self._offset
        if self._time is None:
            self._begin(inputs, raised)
        moved, elapsed = self._observe(state)
        goal = self._goal(inputs)
        error = np.where(self._weak, inputs.goal, goal) - state.position
        rests = self._at_rest(inputs)[:, None]
        arrived = inputs.arrived[:, None]
        added = self._learn(error, moved, elapsed, arrived)
        command = limit_position(self._arm, raised + self._learned)
        lead = np.where(self._weak, 1.25 * self._gains.weak, self._gains.lead)  # more would only heat it
        command = between(command, state.position - lead, state.position + lead)
        self._command = np.where(rests, self._command, command)
        lost = raised + self._learned - self._command
        self._learned = self._command - raised  # nothing winds up beyond what can be sent
        sent = between(added - lost, np.minimum(added, 0.0), np.maximum(added, 0.0))
        self._pushed = np.where((moved == 0.0) & arrived, self._pushed + sent, 0.0)
        return self._command.copy()

    def _begin(self, inputs: ControlInput, raised: Array) -> None:
        position = inputs.state.position
        self._time, self._position = inputs.state.time.copy(), position.copy()
        self._speed, self._pushed = np.zeros_like(position), np.zeros_like(position)
        self._learned, self._command = inputs.sent - raised, inputs.sent.copy()
        self._anchor, self._stood = position.copy(), np.zeros(len(position))
        self._weak, self._rests = np.zeros(position.shape, dtype=bool), np.zeros(len(position), dtype=bool)

    def _observe(self, state: JointState) -> tuple[Array, Array]:
        """Motion (B, n) [rad] and time [s] (B, 1) since the last cycle."""
        assert self._time is not None  # noqa: S101 - for the type checker
        elapsed = between(state.time - self._time, 0.0, 0.1)[:, None]
        moved = state.position - self._position
        speed = moved / np.maximum(elapsed, 1e-3)
        self._speed = np.where(elapsed > 0.0, self._speed + _SMOOTHING * (speed - self._speed), self._speed)
        self._time, self._position = state.time.copy(), state.position.copy()
        far = np.abs(self._position - self._anchor) > STILL * self._arm.encoder_step
        gone: Mask = np.logical_or.reduce(far, axis=1)
        self._anchor = np.where(gone[:, None], self._position, self._anchor)
        self._stood = np.where(gone, 0.0, self._stood + elapsed[:, 0])
        return moved, elapsed

    def _goal(self, wanted: ControlInput) -> Array:
        """Postures (B, n) [rad] that place the tools despite weak joints."""
        gains, posture = self._gains, wanted.goal
        lead, away = self._command - self._position, posture - self._position
        off = wanted.arrived[:, None] & (np.abs(away) > OFF)
        spent = (np.abs(lead) > gains.weak) & (away * lead > 0.0) & (np.abs(self._speed) < STANDING)
        self._weak = (self._weak | spent) & off
        rows = self._weak.any(axis=1)
        if not rows.any():
            return posture
        goal = posture.copy()
        goal[rows] = _without(self._arm, posture[rows], self._position[rows], self._weak[rows])
        return goal

    def _at_rest(self, wanted: ControlInput) -> Mask:
        """Stationary arms (B,) whose tool is close."""
        gains = self._gains
        away = tcp_position(self._arm, self._position) - tcp_position(self._arm, wanted.goal)
        distance = np.linalg.norm(away, axis=-1)
        stands = (self._stood >= CALM) & wanted.arrived
        self._rests = stands & np.where(self._rests, distance < gains.again, distance < gains.close)
        return self._rests

    def _learn(self, error: Array, moved: Array, elapsed: Array, arrived: Mask) -> Array:
        """Integrate the ``error`` (B, n) [rad] of slow joints; returns the change."""
        size = np.abs(error)
        on_its_way = (np.abs(self._speed) > MOVING) & (self._speed * error > 0.0)
        push = PUSH * np.sign(error) * ((size > WITHIN) & arrived)
        added = elapsed * np.where(on_its_way, 0.0, RATE * error * size / (size + FADE) + push)
        loose = (moved != 0.0) & arrived & (self._pushed * moved > 0.0)
        taken = np.where(loose, TAKEN_BACK * self._pushed, 0.0)
        self._learned = self._learned + added - taken
        return added


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
