"""The observation of a policy, from joint readings alone.

``residual`` (11n + 9): following errors, the damped least-squares step at three scales, velocities and actions of three
cycles. ``equation-16`` (3n + 10): Park et al. 2024 without theta_target; Delta theta is command minus position, in
``equation-16-action`` the last action.
"""

from dataclasses import replace
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Mask, collides, position_kinematics
from rejoint.arms.kinematics import DAMPING
from rejoint.control.robot import ControlInput
from rejoint.system.files import read_shipped
from rejoint.system.records import value_type

Layout = Literal["residual", "equation-16", "equation-16-action"]
Observation = NDArray[np.float32]

LIMIT = 8.0
"""Observations are clipped to +-8 (chosen)"""

SUCCESS_DISTANCE = 0.005
"""[m] of buffer S; Park et al. 2024, section III-D"""

HISTORY = 3
"""(chosen)"""


_RIDGE = DAMPING**2 * np.eye(3)
LONGEST_WAIT = 2.0
"""[s] of the time since the target (chosen)"""
MIDDLE_PERIOD, LONGEST_PERIOD = 0.035, 0.1
"""[s] trained; longest trusted"""
PERIOD_SMOOTHING = 0.3
"""Share of the newest period (chosen)"""


@value_type
class Slot:
    """A group of numbers in the observation."""

    name: str
    size: int
    formula: str
    """x: position, s: last command, e: TCP error"""


class View(NamedTuple):
    """The target seen from the measured arm."""

    tcp: Array
    """(B, 3) [m] measured"""
    error: Array
    """(B, 3) [m] target minus measured TCP"""
    distance: Array
    """(B,) [m]"""
    step: Array
    """(B, n) [rad] damped least-squares step"""
    homing: Array
    """(B, n) [rad] null-space way to the goal posture"""


def look(arm: Arm, position: Array, target: Array, goal: Array) -> View:
    """View of targets (B, 3) [m] and ``goal`` postures from positions, (B, n) [rad]."""
    tcp, jacobian = position_kinematics(arm, position)
    transpose = jacobian.mT
    error = target - tcp
    away = goal - position
    wanted = np.empty((*error.shape, 2))
    wanted[..., 0] = error
    np.matmul(jacobian, away[..., None], out=wanted[..., 1:])
    both = transpose @ np.linalg.solve(jacobian @ transpose + _RIDGE, wanted)
    distance = np.sqrt(np.einsum("...i,...i->...", error, error))
    return View(tcp, error, distance, both[..., 0], away - both[..., 1])


class _LayoutRow(NamedTuple):
    """A slot of an arm of any size."""

    name: str
    per_joint: bool
    numbers: int
    """in all, or for each joint"""
    factor: float
    formula: str


_ROWS = read_shipped(__file__, "layouts.toml", dict[Layout, list[_LayoutRow]])


def _sizes(layout: Layout, joints: int) -> list[int]:
    return [row.numbers * (joints if row.per_joint else 1) for row in _ROWS[layout]]


def layout_slots(layout: Layout, joints: int) -> tuple[Slot, ...]:
    """Slots in order."""
    slots = zip(_ROWS[layout], _sizes(layout, joints), strict=True)
    return tuple(Slot(name=row.name, size=size, formula=row.formula) for row, size in slots)


@cache
def layout_factors(layout: Layout, joints: int) -> Array:
    """Factors of the numbers in the observation."""
    return np.repeat([row.factor for row in _ROWS[layout]], _sizes(layout, joints))


class Observer:
    """Turns control inputs of B arms into observations.

    Call `observe` once per cycle, then `acted`; `view` is the last geometry.
    """

    xp: Any = np
    """functions of the arrays; PyTorch's where a controller is exported"""

    def __init__(self, arm: Arm, count: int, layout: Layout = "residual") -> None:
        n = arm.joints
        self.arm, self.count, self.layout = arm, count, layout
        self._factors = layout_factors(layout, n)
        self.size = len(self._factors)
        self._body = replace(arm, keep_out=()) if arm.keep_out else arm  # no policy has learned an owner's boxes
        self._position, self._time = np.zeros((count, n)), np.full(count, np.nan)
        self._period = np.full(count, MIDDLE_PERIOD)
        self._velocity, self._action = np.zeros((2, count, HISTORY, n))
        self.view: View

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Start from rest where ``where`` (B,)."""
        self._position[where] = inputs.state.position[where]
        self._time[where] = inputs.state.time[where]
        self._velocity[where] = self._action[where] = 0.0

    def reset_learned(self, where: Mask) -> None:
        """Drop learned periods where ``where`` (B,)."""
        self._period[where] = MIDDLE_PERIOD

    def observe(self, inputs: ControlInput) -> Observation:
        """Observation (B, size); the same once more where no time has passed."""
        view = look(self.arm, inputs.state.position, inputs.target, inputs.goal)
        return self.numbers(inputs, view).astype(np.float32)

    def numbers(self, inputs: ControlInput, view: View) -> Array:
        """Observation by what is seen in ``view``, in full precision."""
        xp, usual, velocity = self.xp, self._period, self._velocity
        position, time = xp.asarray(inputs.state.position, copy=True), inputs.state.time + 0.0
        elapsed = time - self._time
        later = elapsed > 0.0  # not where nothing was seen before
        latest = (position - self._position) / xp.where(later, elapsed, 1.0)[:, None]
        shifted = xp.concatenate([latest[:, None], velocity[:, :-1]], axis=1)
        period = usual + PERIOD_SMOOTHING * (elapsed.clip(None, LONGEST_PERIOD) - usual)
        self._velocity, self._period = xp.where(later[:, None, None], shifted, velocity), xp.where(later, period, usual)
        self._position, self._time, self.view = position, time, view
        numbers = xp.concatenate(self._parts(inputs, position, view), axis=1) * self._factors
        if self.layout == "residual":
            first, last = (2 + HISTORY) * self.arm.joints, (4 + HISTORY) * self.arm.joints
            near = xp.tanh(numbers[:, first:last])
            numbers = xp.concatenate([numbers[:, :first], near, numbers[:, last:]], axis=1)
        return numbers.clip(-LIMIT, LIMIT)

    def _parts(self, inputs: ControlInput, position: Array, view: View) -> list[Array]:
        waited, drive = inputs.since_target.clip(None, LONGEST_WAIT), inputs.sent - position
        velocity, action, distance = self._velocity, self._action, view.distance[:, None]
        if self.layout == "residual":
            return [
                drive,
                velocity.reshape(len(position), -1),
                view.step,
                view.step,
                view.step,
                position,
                view.error,
                view.error / (distance + 0.003),
                self.xp.log(distance + 0.0003) + 5.0,
                waited[:, None] - 0.5,
                self._period[:, None] - MIDDLE_PERIOD,
                action.reshape(len(position), -1),
            ]
        return [
            waited[:, None],
            drive if self.layout == "equation-16" else action[:, 0],
            position,
            velocity[:, 0],
            inputs.target,
            view.tcp,
            distance,
            collides(self._body, position)[:, None],
            distance < SUCCESS_DISTANCE,
        ]

    def acted(self, action: Array) -> None:
        """Store the action (B, n)."""
        self._action = self.xp.concatenate([action[:, None], self._action[:, :-1]], axis=1)

    def drop_actions(self, where: Mask) -> None:
        """Drop last actions where ``where`` (B,)."""
        self._action[where] = 0.0
