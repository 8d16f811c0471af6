"""What a controller promises: joint commands from joint states, once per control cycle."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from rejoint.arms import Arm, Array, frames
from rejoint.arms.orientation import Orientation
from rejoint.control.robot import JointState, Mask
from rejoint.control.route import Route


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlInput:
    """All that a controller knows when it decides."""

    state: JointState
    target: Array
    """(B, 3) [m] TCP targets"""
    sent: Array
    """(B, n) [rad] last command as it was sent, after the guard"""
    since_target: Array
    """(B,) [s] time since the target was set"""
    route: Route | None = None
    """where the target goes; None where it stands still"""
    turn: Orientation | None = None
    """(B,) how the tools are to be turned there; None where that does not matter"""

    def aims(self, later: Array) -> Array:
        """Return the TCP targets (k, B, 3) [m] ``later`` (k,) or (k, B) [s] than now, by all that is known now."""
        count = len(self.since_target)
        later = np.broadcast_to(later if np.ndim(later) == 2 else np.asarray(later)[:, None], (len(later), count))
        if self.route is None:
            return np.broadcast_to(self.target, (len(later), count, 3))
        return self.route.aims(self.since_target, later)

    def turns(self, later: Array) -> Orientation | None:
        """Return how the tools are to be turned then, (k, B); None where that does not matter."""
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
    """Tell whether a controller turns tools as its inputs say; others bring them to their places only."""
    return bool(getattr(controller, "heeds_turn", False))


def turned_off(arm: Arm, inputs: ControlInput) -> Array:
    """Return by which angle (B,) [rad] the encoders see the tools turned off; NaN where any orientation will do."""
    if inputs.turn is None:
        return np.full(len(inputs.since_target), np.nan)
    return inputs.turn.angle(frames(arm, inputs.state.position).tcp_rotation)


class Controller(Protocol):
    """Turns control inputs into commands; may keep memory between cycles."""

    @property
    def name(self) -> str:
        """Short name used in tables and on the command line."""

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Forget what belongs to the old target, for the arms in ``where`` (B,)."""

    def command(self, inputs: ControlInput) -> Array:
        """Return the wanted joint positions (B, n) [rad]; the guard decides what is sent."""
