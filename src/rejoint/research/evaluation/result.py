"""What an evaluation says: a row per variant and controller, pairs, and failures."""

from __future__ import annotations

from dataclasses import dataclass

from rejoint.control.comparison.result import Protocol
from rejoint.research.evaluation.failures import Failure
from rejoint.research.evaluation.family import ArmFamily
from rejoint.system.statistics import Estimate


@dataclass(frozen=True, kw_only=True)
class Within:
    """Coming and staying within a distance."""

    distance: float
    """[m]"""
    share: Estimate
    """of the holds"""
    median: float | None
    """[s] over all holds; None where fewer than half ever stay"""


@dataclass(frozen=True, kw_only=True)
class VariantRow:
    """One controller, or several seeds of a learner together, on one variant."""

    variant: str
    controller: str
    seeds: int
    """trainings that are put together"""
    settled: Estimate | None
    """[m] encoder error, mean of the last second; None, as the four below, where the guard stopped every hold"""
    settled_p95: float | None
    """[m]"""
    settled_true: Estimate | None
    """[m]"""
    true_p95: float | None
    """[m]"""
    oscillation: float | None
    """[m] mean"""
    outside: Estimate
    """share of the holds that end farther away than 5 mm, or that the guard stopped"""
    within: tuple[Within, ...]
    success: Estimate | None
    """share of the targets reached in the protocol of Park et al. 2024; None where it was not run"""
    cycle_time: Estimate | None
    """[s] for ten targets of that protocol"""
    crossing_error: Estimate | None
    """[m]"""


@dataclass(frozen=True, kw_only=True)
class Pair:
    """A controller against another, target by target on the same arms."""

    variant: str
    controller: str
    rival: str
    settled: Estimate | None
    """[m] mean difference, negative where the controller is better"""
    settled_true: Estimate | None
    """[m]"""
    stay_ratio: tuple[Estimate, ...]
    """median ratio of the times to stay within each distance, below 1 where the controller is faster"""
    cycle_time: Estimate | None
    """[s] mean difference for ten targets of the crossing protocol"""


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """Everything."""

    arm: str
    software: str
    family: ArmFamily
    protocol: Protocol
    variants: tuple[str, ...]
    meanings: dict[str, str]
    """of the variants, in words"""
    controllers: tuple[str, ...]
    rows: tuple[VariantRow, ...]
    best: dict[str, str]
    """per variant, the rival that is soonest within the narrowest distance"""
    pairs: tuple[Pair, ...]
    failures: tuple[Failure, ...]

    def row(self, variant: str, controller: str) -> VariantRow:
        """Return one row."""
        return next(row for row in self.rows if (row.variant, row.controller) == (variant, controller))
