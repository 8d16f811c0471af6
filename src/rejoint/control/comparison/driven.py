"""What driving one controller under one protocol brought, as plain numbers that can be kept."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.accuracy import ToolModel
from rejoint.control.comparison.protocols import Crossings, Holds, Kind, measure_crossings, measure_holds
from rejoint.control.comparison.result import Ended, Protocol
from rejoint.control.guard import Reason, reason_names
from rejoint.control.recording import Recording

Places = tuple[tuple[int, int], ...]
"""Trials (target set, repetition)"""
Key = tuple[str, str, Places, int]
"""Controller, protocol, trials, index of the first target"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Driven:
    """One trial on one arm, or those of a whole batch side by side."""

    controller: str
    kind: Kind
    places: Places
    crossings: Crossings | None
    """results (B, K) under the crossing protocol; of a hold, where it was to tell them as well"""
    holds: Holds | None
    """results (B, K) under the hold protocol"""
    cycles: int
    """control cycles with news"""
    reasons: dict[str, int]
    """cycles in which the guard gave each of its reasons, by name"""
    ended: tuple[Ended, ...]
    """runs that ended early"""
    failed: bool = False
    """whether the controller gave a command that is not a number"""
    first: int = 0
    """index of its first target in the set: in a race, a set is held in parts"""

    @property
    def key(self) -> Key:
        """What tells it from the others of its comparison."""
        return self.controller, self.kind, self.places, self.first

    @property
    def targets(self) -> int:
        """Number of its targets."""
        found = self.crossings.crossed if self.crossings is not None else self.holds.settled  # type: ignore[union-attr]
        return int(found.shape[1])


def measure(
    arm: Arm, recording: Recording, targets: Array, protocol: Protocol, *, controller: str, kind: Kind, places: Places,
    failed: bool = False, model: ToolModel | None = None, first: int = 0, both: bool = False,
) -> Driven:  # fmt: skip
    """Measure a recording of a protocol with ``targets`` (B, K, 3) [m], one arm per trial in ``places``.

    ``first`` is the index of the first of them in its set. ``both``: a hold tells as well when its target was crossed.
    A target that is not crossed while it is held counts as missed, although the other protocol waits longer.
    """
    crossings = holds = None
    if kind == "crossing":
        crossings = measure_crossings(arm, recording, targets, protocol)
    else:
        holds = measure_holds(arm, recording, targets, protocol, model)
    if both and holds is not None:
        judged = replace(protocol, dwell=min(protocol.dwell, protocol.hold))
        crossings = measure_crossings(arm, recording, targets, judged)
        crossings.time[crossings.crossed == 0.0] = np.nan
    counts = {reason: int(np.count_nonzero(recording.reasons & np.uint16(reason.value))) for reason in Reason}
    return Driven(
        controller=controller, kind=kind, places=places, failed=failed, first=first,
        crossings=crossings, holds=holds, cycles=int(recording.active.sum()), ended=_ended(recording, kind, places),
        reasons={reason_names(reason)[0]: count for reason, count in counts.items() if count},
    )  # fmt: skip


def _ended(recording: Recording, kind: Kind, places: Places) -> tuple[Ended, ...]:
    return tuple(
        Ended(
            protocol=kind, target_set=places[b][0], repetition=places[b][1],
            target=int(recording.target_index[-1, b]), why=", ".join(reason_names(int(recording.tripped[b]))),
        )
        for b in np.flatnonzero(recording.tripped)
    )  # fmt: skip
