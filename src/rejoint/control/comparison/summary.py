"""From results per target to the rows of a comparison."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Array
from rejoint.control.accuracy import mean_modelled
from rejoint.control.comparison import iso
from rejoint.control.comparison.driven import Driven, Places
from rejoint.control.comparison.protocols import Kind
from rejoint.control.comparison.result import (
    Comparison,
    ControllerRow,
    CrossingRow,
    Ended,
    GuardCount,
    HoldRow,
    Outcomes,
    PoseAccuracy,
    Protocol,
    Stay,
    Values,
)
from rejoint.control.robot import Robot
from rejoint.system.statistics import Labels, cluster, clustered_share, spread


class Tally:
    """Collects the results of one controller, trial by trial."""

    def __init__(self, shape: tuple[int, int, int], protocol: Protocol, *, raced: bool = False) -> None:
        self.shape, self.protocol, self._raced = shape, protocol, raced
        self.crossed, self.crossing_error, self.crossing_true, self.crossing_time = _unknown(4, shape)
        self.settled, self.settled_true, self.oscillation, self.turned = _unknown(4, shape)
        self.stay = _unknown(len(protocol.within), shape)
        self.away, self.away_true = _unknown(2, (*shape, 3))
        self.modelled = _unknown(3, shape)
        self.held = np.zeros(shape, dtype=bool)
        self.cycles, self.out, self.source = 0, "", ""
        self.ended: list[Ended] = []
        self.reasons: dict[str, int] = {}

    def add(self, driven: Driven) -> None:
        """Take over what was driven."""
        at = _index(driven.places, driven.first, driven.targets)
        if driven.crossings is not None:
            found = driven.crossings
            self.crossed[at], self.crossing_error[at] = found.crossed, found.error
            self.crossing_true[at], self.crossing_time[at] = found.true_error, found.time
        if driven.holds is not None:
            held = driven.holds
            self.held[at] = True
            self.settled[at], self.settled_true[at] = held.settled, held.settled_true
            self.oscillation[at], self.stay[(slice(None), *at)] = held.oscillation, held.stay
            self.away[at], self.away_true[at] = held.away, held.away_true
            self.modelled[(slice(None), *at)], self.turned[at] = held.modelled, held.turned
        self.cycles += driven.cycles
        self.ended += driven.ended
        for reason, cycles in driven.reasons.items():
            self.reasons[reason] = self.reasons.get(reason, 0) + cycles

    def has(self, kind: Kind, place: tuple[int, int], first: int, count: int) -> bool:
        """Tell whether ``count`` targets of a trial (set, repetition), from its ``first`` on, are there."""
        known = self.held if kind == "hold" else np.isfinite(self.crossed)
        return bool(known[place][first : first + count].all())

    def cut(self, sets: int, repetitions: int) -> None:
        """Forget all trials from these numbers of sets and repetitions on."""
        for name, value in vars(self).items():
            if isinstance(value, np.ndarray):
                lead = (slice(None),) if name in ("stay", "modelled") else ()
                setattr(self, name, value[(*lead, slice(sets), slice(repetitions))])
        self.shape = (sets, repetitions, self.shape[2])

    def row(self, controller: str) -> ControllerRow:
        """Statistics of everything collected."""
        _, labels = cluster(self.shape)
        return ControllerRow(
            controller=controller,
            crossing=self._crossing_row(labels),
            hold=self._hold_row(labels),
            guard=self._guard_counts(),
            failures=len(self.ended),
            outcomes=self._outcomes(),
            ended=tuple(self.ended),
            out=self.out,
            source=self.source,
        )

    def _crossing_row(self, labels: Labels) -> CrossingRow:
        whole = self.crossing_time.sum(axis=-1)  # NaN where a trip ended the trial
        if self._raced:  # until it was decided, which may have been within a set
            driven = np.isfinite(self.crossed)
            time = np.where(driven, self.crossing_time, 0.0).sum(axis=-1)
            whole = self.shape[2] * time / np.where(driven.any(axis=-1), driven.sum(axis=-1), np.nan)
        return CrossingRow(
            success=clustered_share(self.crossed.ravel(), labels),
            error=spread(self.crossing_error.ravel(), labels),
            true_error=spread(self.crossing_true.ravel(), labels),
            cycle_time=spread(whole.ravel(), labels.reshape(self.shape)[..., 0].ravel()),
        )

    def _hold_row(self, labels: Labels) -> HoldRow:
        stays = []
        held = self.held.ravel()
        for within, time in zip(self.protocol.within, self.stay, strict=True) if held.any() else ():
            # A hold that was cut short did not stay.
            finite = np.isfinite(time.ravel()[held])
            median = float(np.median(np.where(finite, time.ravel()[held], np.inf)))
            share = clustered_share(finite.astype(float), labels[held])
            stays.append(Stay(within=within, share=share, median=median if np.isfinite(median) else None))
        return HoldRow(
            settled=spread(self.settled.ravel(), labels),
            settled_true=spread(self.settled_true.ravel(), labels),
            stays=tuple(stays),
            oscillation=spread(self.oscillation.ravel(), labels),
            poses=_pose_accuracy(self.away),
            poses_true=_pose_accuracy(self.away_true),
            settled_modelled=mean_modelled(self.modelled) if np.isfinite(self.modelled).any() else None,
            turned=spread(self.turned.ravel(), labels),
        )

    def _guard_counts(self) -> tuple[GuardCount, ...]:
        counts = [
            GuardCount(reason=reason, cycles=cycles, share=cycles / self.cycles)
            for reason, cycles in self.reasons.items()
        ]
        return tuple(sorted(counts, key=lambda count: -count.cycles))

    def _outcomes(self) -> Outcomes:
        stayed = np.where(self.held, np.isfinite(self.stay), np.nan)
        stay = np.where(np.isfinite(self.stay), self.stay, np.where(np.isnan(self.stay), np.nan, self.protocol.hold))
        return Outcomes(
            shape=self.shape,
            within=self.protocol.within,
            crossed=_values(self.crossed),
            crossing_error=_values(self.crossing_error),
            crossing_true=_values(self.crossing_true),
            crossing_time=_values(self.crossing_time),
            settled=_values(self.settled),
            settled_true=_values(self.settled_true),
            oscillation=_values(self.oscillation),
            stay=tuple(_values(part) for part in stay),
            stayed=tuple(_values(part) for part in stayed),
            modelled=tuple(_values(part) for part in self.modelled) if np.isfinite(self.modelled).any() else (),
            turned=_values(self.turned) if np.isfinite(self.turned).any() else (),
        )


def summarise(robot: Robot, seed: int, batched: bool, targets: Array, tallies: dict[str, Tally]) -> Comparison:
    """Make the comparison of all controllers from their tallies; ``targets`` is (S, K, 3) [m]."""
    first = next(iter(tallies.values()))
    return Comparison(
        robot=robot.address,
        arm=robot.arm.name,
        seed=seed,
        batched=batched,
        true_known=any(np.isfinite(tally.settled_true).any() for tally in tallies.values()),
        repetitions=first.shape[1],
        targets=tuple(tuple((float(x), float(y), float(z)) for x, y, z in points) for points in targets),
        protocol=first.protocol,
        clusters=cluster(first.shape)[0],
        rows=tuple(tally.row(name) for name, tally in tallies.items()),
    )


def cut_to_driven(tallies: dict[str, Tally]) -> int:
    """Forget the sets and repetitions to which a race never came; returns how many sets are left."""
    found = [np.isfinite(tally.crossed).any(axis=-1) | tally.held.any(axis=-1) for tally in tallies.values()]
    driven = np.logical_or.reduce(found)
    sets, repetitions = (int(np.flatnonzero(driven.any(axis=axis))[-1]) + 1 for axis in (1, 0))
    for tally in tallies.values():
        tally.cut(sets, repetitions)
    return sets


def _pose_accuracy(away: Array) -> PoseAccuracy | None:
    """Accuracy of the poses (S, K) from what R cycles attained of each, ``away`` (S, R, K, 3) [m] from where it is."""
    places = np.moveaxis(away, 1, 2)  # (S, K, R, 3)
    each = np.arange(places.shape[0] * places.shape[1])
    accuracy = spread(iso.position_accuracy(places, np.zeros(3)).ravel(), each)
    repeatability = spread(iso.position_repeatability(places).ravel(), each)
    if accuracy is None:
        return None
    return PoseAccuracy(cycles=places.shape[2], accuracy=accuracy, repeatability=repeatability)


def _unknown(count: int, shape: tuple[int, ...]) -> Array:
    return np.full((count, *shape), np.nan)


def _index(places: Places, first: int, count: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Index of ``count`` targets of trials, from their ``first`` on, in arrays (S, R, K)."""
    sets, repetitions = np.array(places).T
    return sets[:, None], repetitions[:, None], np.arange(first, first + count)[None]


def _values(array: Array) -> Values:
    return tuple(float(value) if np.isfinite(value) else None for value in array.ravel())
