"""Model-based control: inverse kinematics, gravity feed-forward, and the integrator for the rest.

A servo of stiffness k sags by gravity torque / k, so the command is raised by that much beforehand.
What the model gets wrong the integrator removes and remembers: its correction carries over to the
next target. Only joints that are not on their way already are corrected; a joint that moves towards
its goal needs no push, one that is stuck does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, gravity_torque
from rejoint.arms.orientation import task
from rejoint.arms.size import torque_size
from rejoint.control.controller import ControlInput
from rejoint.control.goal import Goal
from rejoint.control.integrator import IntegratorGains
from rejoint.control.law import dls_step, fade, limit_position, null_space, plain
from rejoint.control.pace import Pace
from rejoint.control.robot import Mask
from rejoint.system.errors import InputError
from rejoint.system.late import Late

compiled = Late("rejoint.control.compiled")

NOMINAL_STIFFNESS = 6.0
"""[N m/rad] assumed of the servos of a worn arm of a myCobot's size where nothing is known (chosen: middle of the 3
to 12 of the twins trained on); other arms scale with the load of their joints."""

SPEED_SMOOTHING = 0.5
"""Share of the newest difference in the speed estimate (chosen)"""


@dataclass(frozen=True, kw_only=True)
class FeedforwardGains:
    """Settings of what the feed-forward controller learns."""

    rate: float = IntegratorGains.rate
    """[1/s] fraction of the step that is integrated per second"""
    fade: float = IntegratorGains.fade
    """[m] distance at which the steps have faded to half"""
    learned_limit: float = float(np.radians(45.0))
    """[rad] largest correction of a joint (chosen: where one is stuck, the others must make up for it)"""
    moving: float = 0.1
    """[rad/s] a joint faster than this is on its way (chosen: two encoder counts per period of 30 ms)"""


class FeedforwardController:
    """Sends the posture that a sagging arm needs, then integrates what is left."""

    name = "feedforward"
    heeds_turn = True

    def __init__(self, arm: Arm, stiffness: Array | float | None = None, gains: FeedforwardGains | None = None) -> None:
        self._arm, self._gains, self._goal = arm, gains or FeedforwardGains(), Goal(arm)
        stiffness = NOMINAL_STIFFNESS * torque_size(arm) if stiffness is None else stiffness
        self._stiffness = np.broadcast_to(np.asarray(stiffness, dtype=float), (arm.joints,)).copy()
        if not (self._stiffness > 0.0).all():
            raise InputError(f"feedforward: stiffness must be positive in N m/rad, got {self._stiffness.tolist()}")
        self._raised = self._correction = self._speed = self._position = np.zeros((0, arm.joints))
        self._pace = Pace()

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Solve for the new targets of the arms in ``where`` (B,); what was learned carries over."""
        if len(self._position) != len(inputs.sent):
            self.reset_learned(inputs, np.ones(len(inputs.sent), dtype=bool))
        self._goal.reset(inputs, where)
        goal = self._goal.position[where]
        # What was learned in the null space moves no tool, but adds up from target to target until the arm folds.
        turn = None if inputs.turn is None else inputs.turn[where]
        idle = null_space(task(self._arm, goal, inputs.target[where], turn)[1], self._correction[where])
        self._correction[where] -= idle
        self._raised[where] = goal + gravity_torque(self._arm, goal) / self._stiffness

    def foresee(self, target: Array, start: Array, where: Mask) -> None:
        """Solve ahead for the ``target`` (B, 3) of the next `reset` of the arms in ``where``, from ``start`` (B, n)."""
        self._goal.foresee(target, start, where)

    def command(self, inputs: ControlInput) -> Array:
        """Return the raised goal postures plus the correction, (B, n) [rad]."""
        seen = dls_step(self._arm, inputs.state.position, inputs.target, inputs.turn)
        step = fade(seen.error, self._gains.fade) * seen.step
        return self.correct(inputs, step, np.zeros_like(step))

    def correct(self, inputs: ControlInput, step: Array, extra: Array) -> Array:
        """Integrate ``step`` (B, n) [rad] where joints are not on their way and add ``extra`` (B, n) [rad] everywhere.

        Returns what `command` returns; call one of the two per cycle.
        """
        position = plain(inputs.state.position)
        if not step.shape == extra.shape == position.shape == self._correction.shape:
            raise InputError(
                f"feedforward: step {step.shape}, extra {extra.shape}, position {position.shape}; expected "
                f"{self._correction.shape}, as at the last reset"
            )
        step, extra = plain(step), plain(extra)
        gains, elapsed = self._gains, self._pace.tick(inputs.state.time)
        # Bounded by itself, not by the measured position: on the way the command leads by the whole distance.
        compiled.integrate(
            self._correction, self._speed, self._position, position, elapsed, step, extra,
            gains.rate, gains.learned_limit, gains.moving, SPEED_SMOOTHING,
        )  # fmt: skip
        return limit_position(self._arm, self._raised + self._correction)

    def reset_learned(self, inputs: ControlInput, where: Mask) -> None:
        """Drop what was learned about the arms in ``where`` (B,), exchanged for others; `reset` must follow."""
        if len(self._position) != len(inputs.sent):
            self._raised, self._correction, self._speed, self._position = np.zeros((4, *inputs.sent.shape))
        self._correction[where] = self._speed[where] = 0.0
        self._position = np.where(where[:, None], inputs.state.position, self._position)
        self._pace.begin(inputs.state.time, where)

    def take_over(self, inputs: ControlInput, where: Mask) -> None:
        """Go on from the last command of the arms in ``where`` (B,), which another controller gave."""
        self._correction[where] = inputs.sent[where] - self._raised[where]

    def memory(self) -> dict[str, Array]:
        """Return everything that is remembered, by name; live arrays."""
        return {
            "goal": self._goal.position, "raised": self._raised, "correction": self._correction, "speed": self._speed,
            "position": self._position, "time": self._pace.last,
        }  # fmt: skip
