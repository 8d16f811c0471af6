"""Targets that move, as the control loop and its controllers see them."""

from __future__ import annotations

from typing import Protocol

from rejoint.arms import Array
from rejoint.arms.orientation import Orientation
from rejoint.control.robot import Mask


class Route(Protocol):
    """Where the targets of B arms are over time, and how much of it is known ahead. Times are since the start."""

    @property
    def count(self) -> int:
        """Number B of arms."""

    @property
    def waits(self) -> Mask:
        """(B,) whose time stands still while an arm does not answer; what arrives as it goes does not wait."""

    def place(self, now: Array) -> Array:
        """Return the targets (B, 3) [m] at ``now`` (B,) [s]."""

    def aims(self, now: Array, later: Array) -> Array:
        """Return where the encoders are to see the tools ``later`` (k, B) [s] than ``now`` (B,) [s]: (k, B, 3) [m].

        By all that is known at ``now``: a path knows its future, a stream guesses it.
        """

    def turns(self, now: Array, later: Array) -> Orientation | None:
        """Return how the tools are to be turned then, (k, B); None where that does not matter."""
