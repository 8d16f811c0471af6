"""A race: on one real arm a comparison lasts until it is decided, and no longer.

At every target two controllers are judged in the order of the recommendation: who reached it, who came to rest nearer,
who stayed near sooner; a difference that does not matter leaves it open (prioritised outcomes: Pocock et al., The win
ratio, Eur. Heart J. 33, 2012). Whether one wins more often than it loses is a bet on each target that is decided: a
fair coin multiplies the `stake` by 1 in the mean, so that it ever reaches 1 / error with a chance of at most ``error``,
whenever and however often one looks (Ville, Etude critique de la notion de collectif, 1939; the mixture over all coins
that favour one side is that of Robbins, Ann. Math. Stat. 41, 1970; today such tests are called anytime-valid: Ramdas et
al., Stat. Sci. 38, 2023). Controllers drop out as they are beaten (Maron and Moore, Hoeffding races, NIPS 1993). The
error is shared between the rivals of the best one (Bonferroni), so that it is called beaten with that chance in all.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb

import numpy as np

from rejoint.arms import Array
from rejoint.system.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Race:
    """When a race is decided."""

    error: float = 0.05
    """chance, at most, that a race ever calls the best controller beaten (chosen: that of the intervals)"""
    nearer: float = 0.0005
    """[m] difference of settled errors that matters (chosen: what one step of an encoder of 12 bits moves a tool 0.3 m
    away)"""
    sooner: float = 0.2
    """[s] difference of times to stay that matters (chosen: what one sees)"""
    least: int = 5
    """targets at which a controller is held at least, unless it fails (chosen: an interval needs five)"""

    def __post_init__(self) -> None:
        if not 0.0 < self.error < 1.0 or self.nearer < 0.0 or self.sooner < 0.0 or self.least < 1:
            raise InputError(f"race: expected an error between 0 and 1, and no negative differences, got {self}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Results:
    """What one controller reached at N targets, each (N,); NaN where it was not driven."""

    crossed: Array
    """1 where the target was reached in time, else 0"""
    settled: Array
    """[m]"""
    stay: Array
    """[s] to come and stay within the narrowest distance; infinite, or the length of the hold, where it does not"""


def preferences(ours: Results, theirs: Results, race: Race) -> Array:
    """Judge each target (N,): 1 where ours is better, -1 where theirs is, 0 where it makes no difference that matters.

    NaN where one of them was not driven.
    """
    crossed = ours.crossed - theirs.crossed
    settled = theirs.settled - ours.settled
    with np.errstate(invalid="ignore"):
        stay = np.where(ours.stay == theirs.stay, 0.0, theirs.stay - ours.stay)
    later = np.where(np.abs(stay) > race.sooner, np.sign(stay), 0.0)
    at_rest = np.where(np.abs(settled) > race.nearer, np.sign(settled), later)
    found = np.where(crossed != 0.0, np.sign(crossed), at_rest)
    return np.where(np.isfinite(crossed) & np.isfinite(settled), found, np.nan)


def stake(wins: int, losses: int) -> float:
    """Return what a bet of 1 on the winner has become: the mean of (2p)^wins (2 - 2p)^losses over p in (1/2, 1)."""
    tossed = wins + losses
    return sum(comb(tossed + 1, i) for i in range(wins + 1)) / ((tossed + 1) * comb(tossed, wins))


WAS_BEATEN = "was beaten by "
"""How it begins to be said that a controller was"""


@dataclass(frozen=True, kw_only=True)
class Beaten:
    """A controller that is out of a race."""

    controller: str
    by: str
    worse: int
    """targets at which it was the worse one"""
    better: int
    targets: int
    """that both had"""

    @property
    def why(self) -> str:
        """Such as ``was beaten by policy (worse at 8 of 8 targets)``."""
        return f"{WAS_BEATEN}{self.by} (worse at {self.worse} of {self.targets} targets, better at {self.better})"


def beaten(results: dict[str, Results], rivals: int, race: Race) -> list[Beaten]:
    """Return who is beaten among ``results`` by name, by the one that beats it most clearly.

    ``rivals`` are the controllers against which the best one had to stand when the race began.
    """
    found = []
    for name, theirs in results.items():
        counted = {other: _count(ours, theirs, race) for other, ours in results.items() if other != name}
        clear = {other: stake(*count[:2]) for other, count in counted.items()}
        best = max(clear, key=lambda other: clear[other], default=name)
        if best != name and clear[best] >= rivals / race.error:
            wins, losses, both = counted[best]
            found.append(Beaten(controller=name, by=best, worse=wins, better=losses, targets=both))
    return found


def fewest(rivals: int, race: Race) -> int:
    """Targets before which nobody can be beaten: looking earlier is in vain."""
    count = race.least
    while stake(count, 0) < rivals / race.error:
        count += 1
    return count


def _count(ours: Results, theirs: Results, race: Race) -> tuple[int, int, int]:
    """Targets that ours won, that it lost, and that both had."""
    judged = preferences(ours, theirs, race)
    return int((judged > 0).sum()), int((judged < 0).sum()), int(np.isfinite(judged).sum())
