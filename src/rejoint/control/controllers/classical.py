"""Parts of control laws, and two classical controllers: integrator, and the arm's default (open loop).

Base law: Park et al. 2024, equation 17, with theta_t read as the last command: ``c_t = c_{t-1} + GAIN * step``, then
`limit_lead` and joint limits. Default: one posture per target (section IV-F).
"""

from typing import NamedTuple

import numpy as np

from rejoint.arms import Arm, Array, Mask, clip_norm, dls
from rejoint.arms.kinematics import task
from rejoint.arms.planning import LEAD
from rejoint.arms.rotations import Orientation
from rejoint.control.robot import ControlInput

GAIN = 0.1
"""Share of the step per cycle (chosen: 0.2 oscillates on worn arms)"""

STEP_LIMIT = np.radians(5.0)
"""[rad] per joint; Park et al. 2024, section IV-D: 0.5 to 5 degrees"""

PROJECTION_DAMPING = 1e-4
"""[m] of the null-space projection (chosen)"""


class DlsStep(NamedTuple):
    """Damped least-squares step."""

    step: Array
    """(..., n) [rad], scaled down to STEP_LIMIT"""
    error: Array
    """(..., k) [m] target minus measured TCP, then the orientation's"""
    jacobian: Array
    """(..., k, n) [m/rad], see `rejoint.arms.kinematics.task`"""


def dls_step(arm: Arm, measured: Array, target: Array, turn: Orientation | None = None) -> DlsStep:
    """Step from ``measured`` (..., n) [rad] towards ``target`` (..., 3) [m], turned as in ``turn``."""
    error, jacobian = task(arm, measured, target, turn)
    return DlsStep(clip_norm(dls(jacobian, error), STEP_LIMIT), error, jacobian)


def fade(error: Array, distance: float) -> Array:
    """Factor |e| / (|e| + distance), (..., 1), for TCP errors (..., 3) [m]: against hunting under stiction."""
    size = (error**2).sum(axis=-1, keepdims=True) ** 0.5
    return size / (size + distance)


def limit_lead(command: Array, measured: Array, lead: float | Array) -> Array:
    """Keep ``command`` (..., n) [rad] within ``lead`` [rad] of the measured position (anti-windup)."""
    return command.clip(measured - lead, measured + lead)


def limit_position(arm: Arm, command: Array) -> Array:
    """Keep ``command`` (..., n) [rad] inside the joint limits."""
    return command.clip(arm.lower, arm.upper)


def null_space(jacobian: Array, motion: Array) -> Array:
    """Part of a joint motion (..., n) [rad] that does not move the TCP, to first order."""
    moved = (jacobian @ motion[..., None])[..., 0]
    return motion - dls(jacobian, moved, PROJECTION_DAMPING)


NOMINAL_PERIOD = 0.025
"""[s] before a measurement (chosen: 20 to 30 ms)"""

LONGEST_PERIOD = 0.1
"""[s] (chosen)"""


class Pace:
    """Measures the periods of B arms."""

    def __init__(self) -> None:
        self.last = np.zeros(0)
        """(B,) [s]"""

    def tick(self, time: Array) -> Array:
        """Period (B,) [s] before ``time`` (B,) [s] of joint states; 0 for an old state."""
        if len(self.last) != len(time):
            elapsed = np.full(len(time), NOMINAL_PERIOD)
        else:
            elapsed = (time - self.last).clip(0.0, LONGEST_PERIOD)
        self.last = time + 0.0  # a copy, also of a tensor
        return elapsed

    def begin(self, time: Array, where: Mask) -> None:
        """Restart at ``time`` (B,) [s] where ``where`` (B,)."""
        self.last = np.where(where, time, self.last) if len(self.last) == len(time) else time.copy()


# Chosen on simulated worn arms:
RATE = GAIN / NOMINAL_PERIOD
"""[1/s] share of the step; twice as much oscillates in play"""
FADE = 4e-3
"""[m] error at which the steps fade to half"""
REST_GAIN, REST_STEP, REST_DISTANCE = 0.01, np.radians(0.1), 0.01
"""Pull to rest per cycle, in the null space; its largest step [rad], an encoder count; [m] from the target, below which
there is none"""


class IntegratorController:
    """Adds shares of the damped least-squares step to the last command, with anti-windup."""

    name = "integrator"
    heeds_turn = True

    def __init__(self, arm: Arm) -> None:
        self._arm, self._pace = arm, Pace()
        self._goal = np.zeros((0, arm.joints))

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Store the goals of ``where`` (B,)."""
        if len(self._goal) != len(inputs.goal):
            self._goal = inputs.goal.copy()
        self._goal[where] = inputs.goal[where]

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        arm, measured = self._arm, inputs.state.position
        elapsed = self._pace.tick(inputs.state.time)[:, None]
        seen = dls_step(arm, measured, inputs.target, inputs.turn)
        step = RATE * elapsed * fade(seen.error, FADE) * seen.step
        pull = clip_norm(null_space(seen.jacobian, REST_GAIN * (inputs.goal - inputs.sent)), REST_STEP)
        far = np.linalg.norm(seen.error, axis=-1, keepdims=True) > REST_DISTANCE
        along = inputs.goal - self._goal if len(self._goal) == len(inputs.goal) else 0.0  # on the way the goal moves
        self._goal = inputs.goal.copy()
        return limit_position(arm, limit_lead(inputs.sent + along + step + far * pull, measured, LEAD))


class DefaultController:
    """Open loop."""

    name = "default"
    heeds_turn = True

    def __init__(self, arm: Arm) -> None:
        self._arm = arm

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Do nothing."""

    def command(self, inputs: ControlInput) -> Array:
        """Goal postures (B, n) [rad]."""
        return inputs.goal.copy()
