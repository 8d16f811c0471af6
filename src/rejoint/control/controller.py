"""The interface of controllers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from rejoint.arms import Arm, Array, frames
from rejoint.arms.rotations import Orientation
from rejoint.control.robot import JointState, Mask

if TYPE_CHECKING:
    from rejoint.control.moving.reference import Routes


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlInput:
    """Inputs of a controller."""

    state: JointState
    target: Array
    """(B, 3) [m] TCP targets"""
    goal: Array
    """(B, n) [rad] of the targets"""
    sent: Array
    """(B, n) [rad] last command, after the guard"""
    since_target: Array
    """(B,) [s]"""
    route: Routes | None = None
    """of moving targets"""
    turn: Orientation | None = None
    """(B,) wanted orientations; None: any"""

    def aims(self, later: Array) -> Array:
        """TCP targets (k, B, 3) [m] in ``later`` (k,) or (k, B) [s]."""
        count = len(self.since_target)
        later = np.broadcast_to(later if np.ndim(later) == 2 else np.asarray(later)[:, None], (len(later), count))
        if self.route is None:
            return np.broadcast_to(self.target, (len(later), count, 3))
        return self.route.aims(self.since_target, later)

    def turns(self, later: Array) -> Orientation | None:
        """Orientations (k, B) then; None: any."""
        if self.route is None or self.turn is None:
            return (
                None
                if self.turn is None
                else self.turn[np.zeros(len(later), dtype=np.intp)[:, None], np.arange(len(self.since_target))]
            )
        later = np.broadcast_to(
            later if np.ndim(later) == 2 else np.asarray(later)[:, None], (len(later), len(self.since_target))
        )
        return self.route.turns(self.since_target, later)


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
