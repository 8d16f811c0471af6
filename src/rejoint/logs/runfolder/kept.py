"""What a run has taken over from an earlier repair of the same arm."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Kept:
    """From which repair a run has its twin and its policy, and why."""

    run: str
    """folder"""
    since: str
    """local date and time when that repair began, ISO 8601"""
    error: float
    """[m] of the tool, root mean square, that the twin makes in the new excitation"""
    fitted: float
    """[m] the same in motion that it had not seen, when it was fitted"""

    def __str__(self) -> str:
        """Say it in a sentence."""
        return (
            f"the arm still moves as its twin of {self.since[:10]} says, within {1e3 * self.error:.1f} mm "
            f"({1e3 * self.fitted:.1f} then); twin and policy are kept from {self.run}"
        )
