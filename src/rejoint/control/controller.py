"""The interface of controllers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from rejoint.arms import Arm, Array, frames
from rejoint.arms.rotations import Orientation
from rejoint.control.robot import JointState, Mask


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlInput:
    """Inputs of a controller."""

    state: JointState
    target: Array
    """(B, 3) [m] TCP targets; NaN: the joints alone count"""
    goal: Array
    """(B, n) [rad] of the targets"""
    sent: Array
    """(B, n) [rad] last command, after the guard"""
    since_target: Array
    """(B,) [s]"""
    turn: Orientation | None = None
    """(B,) wanted orientations; None: any"""
    arrived: Mask = field(default_factory=lambda: np.ones(1, dtype=bool))
    """(B,) the goals have stopped"""
    ahead: Callable[[Array], Array] | None = None
    """See `goals`"""

    def goals(self, later: Array) -> Array:
        """Goals (k, B, n) [rad] in ``later`` (k, B) [s], as far as known."""
        return np.broadcast_to(self.goal, (len(later), *self.goal.shape)) if self.ahead is None else self.ahead(later)


def heeds_turn(controller: object) -> bool:
    """Whether a controller can turn tools."""
    return bool(getattr(controller, "heeds_turn", False))


def turned_off(arm: Arm, inputs: ControlInput) -> Array:
    """Orientation errors (B,) [rad] by the encoders; NaN: none wanted."""
    if inputs.turn is None:
        return np.full(len(inputs.since_target), np.nan)
    return inputs.turn.angle(frames(arm, inputs.state.position).tcp_rotation)


class Controller(Protocol):
    """Turns inputs into commands."""

    @property
    def name(self) -> str:
        """Name."""

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Forget old targets of ``where`` (B,)."""

    def command(self, inputs: ControlInput) -> Array:
        """Commands (B, n) [rad]."""
