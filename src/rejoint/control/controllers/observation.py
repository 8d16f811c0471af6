"""The observation of a policy, from joint readings alone.

``residual`` (11n + 9): following errors, the damped least-squares step at three scales, velocities and actions of three
cycles. ``equation-16`` (3n + 10): the state of Park et al. 2024 without theta_target; Delta theta is command minus
position, in ``equation-16-action`` the last action.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, collides, position_kinematics
from rejoint.arms.inverse import DAMPING
from rejoint.control.robot import ControlInput, Mask
from rejoint.system.errors import InputError

Layout = Literal["residual", "equation-16", "equation-16-action"]
Rows = slice | NDArray[np.intp]
Observation = NDArray[np.float32]

ALL = slice(None)
LIMIT = 8.0
"""Observations are clipped to +-8 (chosen)"""

SUCCESS_DISTANCE = 0.005
"""[m] of buffer S; Park et al. 2024, section III-D"""

POINT_SCALE = 5.0
"""[1/m] in equation 16 (chosen)"""

HISTORY = 3
"""(chosen)"""


_RIDGE = DAMPING**2 * np.eye(3)
LONGEST_WAIT = 2.0
"""[s] of the time since the target (chosen)"""
MIDDLE_PERIOD, LONGEST_PERIOD = 0.035, 0.1
"""[s] trained; longest trusted"""
PERIOD_SMOOTHING = 0.3
"""Share of the newest period (chosen)"""
_ONE_DEGREE, _FIFTH_OF_A_DEGREE = float(np.radians(1.0)), float(np.radians(0.2))


@dataclass(frozen=True, kw_only=True)
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


class ObservationInput(NamedTuple):
    """Inputs of an observation, for B arms."""

    position: Array
    velocity: Array
    """(B, HISTORY, n) newest first"""
    drive: Array
    view: View
    target: Array
    since_target: Array
    period: Array
    action: Array
    """(B, HISTORY, n) newest first"""


def look(arm: Arm, position: Array, target: Array, goal: Array) -> View:
    """View of targets (B, 3) [m] and ``goal`` postures from positions, (B, n) [rad]."""
    tcp, jacobian = position_kinematics(arm, position)
    transpose = np.swapaxes(jacobian, -1, -2)
    error = target - tcp
    away = goal - position
    wanted = np.empty((*error.shape, 2))
    wanted[..., 0] = error
    np.matmul(jacobian, away[..., None], out=wanted[..., 1:])
    both = transpose @ np.linalg.solve(jacobian @ transpose + _RIDGE, wanted)
    distance = np.sqrt(np.einsum("...i,...i->...", error, error))
    return View(tcp, error, distance, both[..., 0], away - both[..., 1])


def layout_slots(layout: Layout, joints: int) -> tuple[Slot, ...]:
    """Slots in order."""
    n = joints
    rows: tuple[tuple[str, int, str], ...]
    if layout == "residual":
        rows = (
            ("drive", n, "4 (s - x) [1/rad]"),
            ("velocity", HISTORY * n, "0.5 dx/dt [s/rad], differences of successive measurements, newest first"),
            ("step", n, "5 dls(e) [1/rad]"),
            ("step.near", n, "tanh(dls(e) / 1 deg)"),
            ("step.fine", n, "tanh(dls(e) / 0.2 deg)"),
            ("position", n, "x [rad]"),
            ("error", 3, "20 e [1/m]"),
            ("direction", 3, "e / (|e| + 3 mm)"),
            ("distance", 1, "(ln(|e| / 1 m + 0.0003) + 5) / 2"),
            ("waited", 1, "min(time since the target was set, 2 s) - 0.5"),
            ("period", 1, "20 p - 0.7 [1/s], p the running mean of the control period"),
            ("action", HISTORY * n, "last actions, newest first"),
        )
    elif layout in ("equation-16", "equation-16-action"):
        rows = (
            ("time", 1, "min(time since the target was set, 2 s) [s]"),
            ("drive", n, "4 (s - x) [1/rad]") if layout == "equation-16" else ("action", n, "last action"),
            ("position", n, "x [rad]"),
            ("velocity", n, "0.5 dx/dt [s/rad], difference of the last two measurements"),
            ("target", 3, "5 target [1/m]"),
            ("tcp", 3, "5 tcp(x) [1/m]"),
            ("distance", 1, "5 |e| [1/m]"),
            ("collision", 1, "1 where x has a link touch another one or the ground"),
            ("success", 1, "1 where |e| < 5 mm"),
        )
    else:
        raise InputError(
            f"no observation layout is called {layout!r}; known: residual, equation-16, equation-16-action"
        )
    return tuple(Slot(name=name, size=size, formula=formula) for name, size, formula in rows)


def layout_size(layout: Layout, joints: int) -> int:
    """Size of the observation."""
    return sum(slot.size for slot in layout_slots(layout, joints))


class Observer:
    """Turns control inputs of B arms into observations.

    Call `observe` once per cycle, then `acted`; `view` is the last geometry.
    """

    def __init__(self, arm: Arm, count: int, layout: Layout = "residual") -> None:
        n = arm.joints
        self.arm, self.count, self.layout = arm, count, layout
        self.size = layout_size(layout, n)
        self._body = replace(arm, keep_out=()) if arm.keep_out else arm  # no policy has learned an owner's boxes
        self._position, self._time = np.zeros((count, n)), np.full(count, np.nan)
        self._period, self._everyone = np.full(count, MIDDLE_PERIOD), np.arange(count)
        self._velocity, self._action = np.zeros((2, count, HISTORY, n))
        self.view = View(*(np.zeros((count, *tail)) for tail in ((3,), (3,), (), (n,), (n,))))

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Start from rest where ``where`` (B,)."""
        self._position[where] = inputs.state.position[where]
        self._time[where] = inputs.state.time[where]
        self._velocity[where] = 0.0
        self._action[where] = 0.0

    def reset_learned(self, where: Mask) -> None:
        """Drop learned periods where ``where`` (B,)."""
        self._period[where] = MIDDLE_PERIOD

    def observe(self, inputs: ControlInput, rows: Rows = ALL) -> Observation:
        """Observation (B, size), or of ``rows``."""
        state = inputs.state
        position = state.position[rows]
        self._differentiate(state.time[rows], position, rows)
        view = look(self.arm, position, inputs.target[rows], inputs.goal[rows])
        if isinstance(rows, slice) and rows == ALL:
            self.view = view
        else:
            for whole, part in zip(self.view, view, strict=True):
                whole[rows] = part
        reading = ObservationInput(
            position,
            self._velocity[rows],
            inputs.sent[rows] - position,
            view,
            inputs.target[rows],
            np.minimum(inputs.since_target[rows], LONGEST_WAIT),
            self._period[rows],
            self._action[rows],
        )
        out = np.empty((len(position), self.size), dtype=np.float32)
        if self.layout == "residual":
            _residual(out, reading)
        else:
            change = 4.0 * reading.drive if self.layout == "equation-16" else reading.action[:, 0]
            _equation_16(out, reading, change, self._body)
        return np.minimum(np.maximum(out, -LIMIT, out=out), LIMIT, out=out)

    def acted(self, action: Array) -> None:
        """Store the action (B, n)."""
        self._action[:, 1:] = self._action[:, :-1]
        self._action[:, 0] = action

    def drop_actions(self, where: Mask) -> None:
        """Drop last actions where ``where`` (B,)."""
        self._action[where] = 0.0

    def _differentiate(self, time: Array, position: Array, rows: Rows) -> None:
        chosen = self._everyone[rows]
        if not (time.shape == chosen.shape and position.shape == (len(chosen), self.arm.joints)):
            raise InputError(
                f"observer: {time.shape} times and positions {position.shape}, expected those of {len(chosen)} arms"
            )
        elapsed = time - self._time[rows]
        later = elapsed > 0.0  # not where nothing was seen before
        chosen, elapsed = chosen[later], elapsed[later]
        self._velocity[chosen, 1:] = self._velocity[chosen, :-1]
        self._velocity[chosen, 0] = (position[later] - self._position[chosen]) / elapsed[:, None]
        self._period[chosen] += PERIOD_SMOOTHING * (np.minimum(elapsed, LONGEST_PERIOD) - self._period[chosen])
        self._time[rows], self._position[rows] = time, position


def _residual(out: Observation, reading: ObservationInput) -> None:
    """Fill ``out`` (B, 11n + 9)."""
    view, (count, n) = reading.view, reading.position.shape
    distance = view.distance[:, None]
    parts = [
        reading.drive,
        reading.velocity.reshape(count, -1),
        view.step,
        view.step,
        view.step,
        reading.position,
        view.error,
        view.error / (distance + 0.003),
        np.log(distance + 0.0003) + 5.0,
        reading.since_target[:, None] - 0.5,
        reading.period[:, None] - MIDDLE_PERIOD,
        reading.action.reshape(count, -1),
    ]
    numbers = np.concatenate(parts, axis=1)
    numbers *= residual_factors(n)
    near = numbers[:, (2 + HISTORY) * n : (4 + HISTORY) * n]
    np.tanh(near, out=near)
    out[...] = numbers


@cache
def residual_factors(n: int) -> Array:
    """Factors (11n + 9,)."""
    factors = [4.0, 0.5, 5.0, 1.0 / _ONE_DEGREE, 1.0 / _FIFTH_OF_A_DEGREE, 1.0, 20.0, 1.0, 0.5, 1.0, 20.0, 1.0]
    return np.repeat(factors, [n, HISTORY * n, n, n, n, n, 3, 3, 1, 1, 1, HISTORY * n])


def _equation_16(out: Observation, reading: ObservationInput, change: Array, arm: Arm) -> None:
    """Fill ``out`` (B, 3n + 10), with ``change`` (B, n) for Delta theta."""
    n, view = reading.position.shape[1], reading.view
    columns = out.T
    columns[0] = reading.since_target
    out[:, 1 : n + 1] = change
    out[:, n + 1 : 2 * n + 1] = reading.position
    out[:, 2 * n + 1 : 3 * n + 1] = 0.5 * reading.velocity[:, 0]
    m = 3 * n + 1
    out[:, m : m + 3] = POINT_SCALE * reading.target
    out[:, m + 3 : m + 6] = POINT_SCALE * view.tcp
    columns[m + 6] = POINT_SCALE * view.distance
    columns[m + 7] = collides(arm, reading.position)
    columns[m + 8] = view.distance < SUCCESS_DISTANCE
