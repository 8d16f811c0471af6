"""Which logs are kept from a fit, to judge it by: whole motions, drawn by a seed, of every kind alike.

Motions are ordered by what tells most about how hard they are to predict: whether the arm leans on something, then how
fast it is told to move. Of each few that follow one another one is drawn, so that names decide nothing, and what is
held out is neither all slow nor all in contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm
from rejoint.logs.copies import refuse_copies
from rejoint.logs.exclusions import find_exclusions, table_height
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError

FEW_MOTIONS = 4
"""Below as many motions the end of each is held out instead of whole motions (chosen)"""
KEPT_END = 0.25
"""Share of a motion that is held out then (chosen)"""


@dataclass(frozen=True, kw_only=True)
class HoldOut:
    """How to part logs."""

    names: tuple[str, ...] | None = None
    """labels of the motions kept from the fit; empty: none, and the fit is judged on what it has seen; None: drawn"""
    every: int = 4
    """one motion of as many is drawn"""
    seed: int = 0


def part(arm: Arm, logs: Sequence[RunLog], how: HoldOut) -> tuple[list[RunLog], list[RunLog]]:
    """Part logs into those to fit and those to judge by; of few motions the last quarter of each is judged.

    Where nothing is held out both are all of the logs. InputError where labels are not unique, or those to hold out
    are not there or are all there is.
    """
    ordered = sorted(logs, key=lambda log: log.label)
    names = [log.label for log in ordered]
    if len(set(names)) != len(names):
        raise InputError("identification: two motions have the same label; give each its own")
    refuse_copies(ordered, "identification")
    if how.names is not None:
        missing = sorted(set(how.names) - set(names))
        if missing or len(how.names) >= len(names):
            raise InputError(
                f"identification: motions to hold out {', '.join(missing or how.names)}; expected some, but not all, "
                f"of {', '.join(names)}"
            )
        if not how.names:
            return ordered, ordered
        kept = set(how.names)
    elif len(ordered) < FEW_MOTIONS:
        cuts = [int(len(log) * (1.0 - KEPT_END)) for log in ordered]
        seen = [log.rows(slice(0, cut)) for log, cut in zip(ordered, cuts, strict=True)]
        ends = [log.rows(slice(cut, None)) for log, cut in zip(ordered, cuts, strict=True)]
        return seen, [replace(end, label=f"{end.label} (end)") for end in ends]
    else:
        fold = folds(arm, ordered, how.every, how.seed)
        kept = {name for name, number in zip(names, fold, strict=True) if number == 0}
    return [log for log in ordered if log.label not in kept], [log for log in ordered if log.label in kept]


def folds(arm: Arm, logs: Sequence[RunLog], count: int, seed: int = 0) -> NDArray[np.integer]:
    """(K,) number below ``count`` of the fold that each log falls into: each fold has motions of every kind.

    Logs may come in any order; their labels only decide between motions that are otherwise equal.
    """
    touching = [rows.contact.any() for rows in find_exclusions(arm, logs, table_height(arm, logs))]
    speed = [float(np.sqrt(np.mean((np.diff(log.command, axis=0) / np.diff(log.time)[:, None]) ** 2))) for log in logs]
    order = sorted(range(len(logs)), key=lambda i: (bool(touching[i]), round(speed[i], 6), logs[i].label))
    rng, found = np.random.default_rng(seed), np.zeros(len(logs), dtype=int)
    for start in range(0, len(order), count):
        alike = order[start : start + count]
        found[alike] = rng.permutation(count)[: len(alike)]
    return found
