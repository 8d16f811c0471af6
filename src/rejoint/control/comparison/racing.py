"""A race: on one real arm a comparison lasts until what matters is decided, and no longer.

At every target two controllers are judged in the order of the recommendation: who reached it, who came to rest nearer,
who stayed near sooner; a difference that does not matter leaves them even (prioritised outcomes: Pocock et al., The win
ratio, Eur. Heart J. 33, 2012). What counts is the *lead*: the share of targets at which one is better less that at
which it is worse (the net benefit of Buyse, Stat. Med. 29, 2010). A controller is driven no further when one of two
claims is refuted: that no other leads it (it is beaten), or that it leads all simpler ones by as much as matters (it is
needless: a tie goes to the simpler one). Between the two lies a zone of indifference, where either may happen
(Bechhofer, Ann. Math. Stat. 25, 1954), and with it an end.

A claim is tested by bets on the next target that lose in the mean while it is true: the `stake` ever becomes 1 / error
with a chance of at most ``error``, whenever and however often one looks (Ville, Etude critique de la notion de
collectif, 1939; bets on means: Waudby-Smith and Ramdas, J. R. Stat. Soc. B 86, 2024). How much is bet is mixed over by
the arcsine law (Krichevsky and Trofimov, IEEE Trans. Inf. Theory 27, 1981), which learns from few targets. Where a
claim is about several others, the bets against each are made with equal parts of one stake, so that the sum counts: who
loses to three at once is out sooner, and the best one is called beaten with that chance in all. Controllers drop out
one by one (Maron and Moore, Hoeffding races, NIPS 1993).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from rejoint.arms import Array
from rejoint.system.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Race:
    """When a race is decided."""

    error: float = 0.05
    """chance, at most, that a race ever calls the best controller beaten, and that it passes over one that leads all
    simpler ones by ``lead`` (chosen: that of the intervals)"""
    nearer: float = 0.0005
    """[m] difference of settled errors that matters (chosen: what one step of an encoder of 12 bits moves a tool 0.3 m
    away)"""
    sooner: float = 0.2
    """[s] difference of times to stay that matters (chosen: what one sees)"""
    lead: float = 0.5
    """by which a controller is to lead all simpler ones for being worth it (chosen: better at three targets for each at
    which it is worse)"""
    likely: float = 0.25
    """lead by which one of those that are left undecided is taken to be better than a simpler one (chosen on
    14 arms; on 20 others what is then recommended was within 2 mm 0.1 s sooner, in the mean, than by intervals)"""
    least: int = 5
    """targets at which a controller is held at least, unless it fails (chosen: an interval needs five)"""

    def __post_init__(self) -> None:
        if not 0.0 < self.error < 1.0 or self.nearer < 0.0 or self.sooner < 0.0 or self.least < 1:
            raise InputError(f"race: expected an error between 0 and 1, and no negative differences, got {self}")
        if not 0.0 < self.likely <= self.lead < 1.0:
            raise InputError(f"race: expected leads between 0 and 1, the likely one no larger, got {self}")


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


@lru_cache(maxsize=4096)
def stake(against: int, even: int, in_favour: int, lead: float = 0.0) -> float:
    """Return what a stake of 1 has become by bets against the claim that one controller leads another by ``lead``.

    ``against`` and ``in_favour`` are the targets at which the other and the one was better. A bet of a share u of what
    may be lost is mixed over by the arcsine law of (1 + u) / 2 in (1/2, 1).
    """
    u = -np.cos(2.0 * _ANGLES)
    odds = lead / (1.0 - lead)
    grown = (1.0 + u * (1.0 + 2.0 * odds)) ** against * (1.0 + u * odds) ** even * (1.0 - u) ** in_favour
    return float(grown.mean())


_ANGLES = np.pi / 4 * (1.0 + (np.arange(256) + 0.5) / 256)
"""Midpoints over a quarter of the circle: exact for polynomials of all degrees that a race comes to"""

WAS_BEATEN = "was beaten by "
NO_BETTER = "is hardly better than "
"""How it begins to be said that a controller was"""


@dataclass(frozen=True, kw_only=True)
class Out:
    """A controller that is driven no further."""

    controller: str
    why: str
    """such as ``was beaten by policy (worse at 6 of 6 targets, better at 0)``"""
    certainty: float
    """stake over what it takes, at least 1"""


def next_out(results: dict[str, Results], field: Sequence[str], race: Race) -> Out | None:
    """Return who is out most clearly among those that are left, whose ``results`` stand by name; None while nobody is.

    ``field`` are all that took part when the race began, from the simplest on.
    """
    found = [*_beaten(results, len(field) - 1, race), *_needless(results, field, race)]
    return max(found, key=lambda out: out.certainty, default=None)


def _beaten(results: dict[str, Results], rivals: int, race: Race) -> Iterable[Out]:
    """Those of whom it is not to be believed that nobody leads them."""
    for name, ours in results.items():
        counts = {other: _count(theirs, ours, race) for other, theirs in results.items() if other != name}
        yield from _refuted(name, counts, 0.0, rivals / race.error, WAS_BEATEN)


def _needless(results: dict[str, Results], field: Sequence[str], race: Race) -> Iterable[Out]:
    """Those of whom it is not to be believed that they lead all simpler ones by as much as matters."""
    for name, ours in results.items():
        simpler = field[: field.index(name)]
        counts = {other: _count(results[other], ours, race) for other in simpler if other in results}
        yield from _refuted(name, counts, race.lead, len(simpler) / race.error, NO_BETTER)


def _refuted(
    name: str, counts: dict[str, tuple[int, int, int]], lead: float, needed: float, verb: str
) -> Iterable[Out]:
    """Tell by ``counts``, for each other the targets at which it was better, even and worse."""
    stakes = {other: stake(*count, lead) for other, count in counts.items()}
    if sum(stakes.values()) >= needed and stakes:
        other = max(stakes, key=lambda one: stakes[one])
        worse, even, better = counts[other]
        why = f"{verb}{other} (worse at {worse} of {worse + even + better} targets, better at {better})"
        yield Out(controller=name, why=why, certainty=sum(stakes.values()) / needed)


def leads(results: dict[str, Results], race: Race) -> dict[tuple[str, str], tuple[int, int, int]]:
    """Return, for each two of whom the first is likely better, at how many targets it was better, even, and worse."""
    counts = {
        (one, other): _count(results[one], results[other], race) for one in results for other in results if one != other
    }
    return {pair: count for pair, count in counts.items() if count[0] - count[2] >= max(race.likely * sum(count), 1)}


def fewest(race: Race) -> int:
    """Targets before which nobody can be out but by failing: looking earlier is in vain."""
    count = race.least
    while stake(count, 0, 0) < 1.0 / race.error:
        count += 1
    return count


def _count(ours: Results, theirs: Results, race: Race) -> tuple[int, int, int]:
    """Targets at which ours was better, even, and worse, of those that both had."""
    judged = preferences(ours, theirs, race)
    return int((judged > 0).sum()), int((judged == 0).sum()), int((judged < 0).sum())
