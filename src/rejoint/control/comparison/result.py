"""What a comparison found, as plain numbers, strings and tuples: `runs.write_json` and `read_json` take it as it is.

Metres, seconds, shares between 0 and 1. Encoder and true TCP error have separate fields everywhere;
the true one is None where nobody knows it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.control.accuracy import NOT_KNOWN, TrueError
from rejoint.control.comparison.racing import NO_BETTER, WAS_BEATEN, Race
from rejoint.system.errors import InputError
from rejoint.system.statistics import Estimate, Spread

Values = tuple[float | None, ...]
_SEVERAL = ("stay", "stayed", "modelled")  # fields of `Outcomes` with more than one value for each target


@dataclass(frozen=True, kw_only=True)
class Stay:
    """Time after which the error stays below a distance until the end of the hold."""

    within: float
    """[m]"""
    share: Estimate
    """of the holds in which it does"""
    median: float | None
    """[s] over all holds; None where fewer than half ever stay"""


@dataclass(frozen=True, kw_only=True)
class CrossingRow:
    """Protocol of Park et al. 2024, section IV-F: next target at the first crossing of the threshold."""

    success: Estimate
    """share of the targets reached in time"""
    error: Spread | None
    """[m] encoder error at the crossing or the time-out"""
    true_error: Spread | None
    """[m] true error at the same moments"""
    cycle_time: Spread | None
    """[s] for a whole set of targets; in a race from the mean of those that were driven, each come to from rest"""


@dataclass(frozen=True, kw_only=True)
class PoseAccuracy:
    """Accuracy in the terms of ISO 9283, over all targets as poses."""

    cycles: int
    """that each pose was attained; the norm asks for 30"""
    accuracy: Spread
    """[m] position accuracy AP"""
    repeatability: Spread | None
    """[m] position repeatability RP; None for a single cycle"""


@dataclass(frozen=True, kw_only=True)
class HoldRow:
    """Every target held for a while, whether it is reached or not."""

    settled: Spread | None
    """[m] encoder error, mean of the last part of each hold"""
    settled_true: Spread | None
    """[m] true error over the same time"""
    stays: tuple[Stay, ...]
    """from the widest distance to the narrowest; empty where nothing was held"""
    oscillation: Spread | None
    """[m] root mean square distance of the encoder TCP from its mean, last part of each hold"""
    poses: PoseAccuracy | None = None
    """by the encoders; None in files of earlier versions"""
    poses_true: PoseAccuracy | None = None
    """of the tool itself; None where nobody knows it"""
    settled_modelled: TrueError | None = None
    """true error over the same time by a calibration of the arm; None where it is known, or there is no calibration"""
    turned: Spread | None = None
    """[rad] orientation error by the encoders over the same time; None where targets have no orientation"""

    @property
    def true_error(self) -> TrueError:
        """Mean true error over the targets, and how it is known."""
        if self.settled_true is not None:
            return TrueError.of("known", self.settled_true.mean)
        return self.settled_modelled or NOT_KNOWN


@dataclass(frozen=True, kw_only=True)
class GuardCount:
    """How often the guard stepped in for one reason."""

    reason: str
    cycles: int
    share: float
    """of all cycles"""


@dataclass(frozen=True, kw_only=True)
class Outcomes:
    """Results per target: flat tuples ordered by (target set, repetition, target); None where there is no result."""

    shape: tuple[int, int, int]
    """target sets S, repetitions R, targets K"""
    within: tuple[float, ...]
    """[m] distances of the ``stay`` tuples"""
    crossed: Values
    """1 where the threshold was crossed in time, else 0"""
    crossing_error: Values
    """[m]"""
    crossing_true: Values
    """[m]"""
    crossing_time: Values
    """[s] in force until the crossing or the time-out"""
    settled: Values
    """[m]"""
    settled_true: Values
    """[m]"""
    oscillation: Values
    """[m]"""
    stay: tuple[Values, ...]
    """[s] per distance; the length of the hold where the error does not stay below it"""
    stayed: tuple[Values, ...]
    """per distance: 1 where the error stays below it, else 0; None where the target was not held"""
    modelled: tuple[Values, ...] = ()
    """[m] true error by a calibration, value and ends of its interval; empty where there is none, or it is known"""
    turned: Values = ()
    """[rad] orientation error by the encoders, mean of the last part of a hold; empty where targets have none"""

    def array(self, name: str) -> Array:
        """Return one field as (S, R, K), or (W, S, R, K) for ``stay``, ``stayed`` and ``modelled``; NaN for None."""
        return np.array(getattr(self, name), dtype=float).reshape((-1, *self.shape) if name in _SEVERAL else self.shape)


@dataclass(frozen=True, kw_only=True)
class Ended:
    """Why a run, which is a trial under one protocol, ended before its last target was done."""

    protocol: str
    """``crossing`` or ``hold``"""
    target_set: int
    repetition: int
    target: int
    """index of the target in force"""
    why: str
    """such as ``not finite``, a trip of the guard, in the words of `Guarded.reasons`"""


@dataclass(frozen=True, kw_only=True)
class ControllerRow:
    """Everything about one controller."""

    controller: str
    crossing: CrossingRow
    hold: HoldRow
    guard: tuple[GuardCount, ...]
    """reasons that occurred, the most frequent first"""
    failures: int
    """runs (a trial under one protocol) that ended early by a fault: a trip of the guard, or a command that is none"""
    outcomes: Outcomes
    ended: tuple[Ended, ...] = ()
    """all runs that ended early, in the order in which they were driven"""
    out: str = ""
    """why the controller was not driven to the end of the comparison, such as ``3 missed targets in a row``; what it
    did not drive counts neither for nor against it. Empty where it was driven to the end"""
    source: str = ""
    """where its first results are from if they were not driven for this comparison, such as ``the diagnosis``"""

    @property
    def beaten(self) -> bool:
        """Whether it is ``out`` because another one was better or as good, and not because it failed."""
        return self.out.startswith((WAS_BEATEN, NO_BETTER))

    @property
    def needless(self) -> bool:
        """Whether it is ``out`` because it is no better by what matters than a simpler one."""
        return self.out.startswith(NO_BETTER)

    @property
    def held(self) -> int:
        """Number of targets at which it was held."""
        return sum(value is not None for value in self.outcomes.settled)


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """Settings of both protocols."""

    threshold: float = 0.010
    """[m] a target is reached below this; Park et al. 2024, section IV-A"""
    dwell: float = 20.0
    """[s] longest time per target; Park et al. 2024, section IV-F"""
    hold: float = 8.0
    """[s] per target in the hold protocol (chosen: slow controllers have settled by then)"""
    window: float = 1.0
    """[s] last part of a hold, over which the settled error is the mean (chosen)"""
    within: tuple[float, ...] = (0.010, 0.005, 0.002)
    """[m] distances to come and stay within (chosen)"""

    def __post_init__(self) -> None:
        for name in ("threshold", "dwell", "hold", "window"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"protocol: {name} must be positive, got {getattr(self, name)}")
        if not self.window < self.hold:
            raise InputError(f"protocol: the window ({self.window} s) must be shorter than the hold ({self.hold} s)")
        if not self.within or min(self.within) <= 0.0:
            raise InputError(f"protocol: distances to stay within must be positive, got {self.within}")


@dataclass(frozen=True, kw_only=True)
class TargetErrors:
    """Errors at each of K targets."""

    encoders: Values
    """[m] encoder error, from the aim"""
    true: tuple[TrueError, ...]
    """of the tool, from the target, and how it is known"""


@dataclass(frozen=True, kw_only=True)
class DirectionVariation:
    """Multi-directional variation of pose accuracy, vAP after ISO 9283: poses come to along three axes of the base."""

    controller: str
    poses: int
    cycles: int
    """that each pose was attained from each direction; the norm asks for 30"""
    encoders: Spread
    """[m] over the poses, by the encoders"""
    tool: Spread | None
    """[m] of the tool itself; None where nobody knows it"""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Every controller on the same arm with the same targets."""

    robot: str
    """address"""
    arm: str
    seed: int
    batched: bool
    """whether all trials ran side by side on equal emulated arms, rather than one after the other on one arm"""
    true_known: bool
    """whether the true TCP was known"""
    repetitions: int
    targets: tuple[tuple[tuple[float, float, float], ...], ...]
    """(S, K, 3) [m]"""
    protocol: Protocol
    clusters: str
    """what the intervals resample: ``target sets``, ``trials`` or ``targets``"""
    rows: tuple[ControllerRow, ...]
    targets_file: str = ""
    """file that the targets were read from, as it was named; empty where they were drawn"""
    period: tuple[float, float] | None = None
    """[s] shortest and longest control period that was asked for; None: the robot's own"""
    left_out: tuple[str, ...] = ()
    """sentences: which controllers did not take part, what was not driven beside them, and why"""
    calibration: str = ""
    """date of the calibration by which all controllers were aimed; empty where there was none"""
    race: Race | None = None
    """when it counted as decided, if it was driven no longer than that"""
    most: tuple[int, int] | None = None
    """target sets and repetitions after which such a race would have ended undecided"""
    as_found: TargetErrors | None = None
    """errors at the first target set of an arm driven by its own controller without any aim; None where that was not
    driven beside a comparison that was aimed"""
    directions: DirectionVariation | None = None
    """of the recommended controller; None where that was not asked for"""
    orientations: tuple[tuple[str, ...], ...] = ()
    """how the tool was to be turned at the targets, in words; empty where targets are points"""

    def row(self, controller: str) -> ControllerRow:
        """Return the row of a controller; InputError names those there are."""
        for row in self.rows:
            if row.controller == controller:
                return row
        raise InputError(f"no controller {controller!r} in this comparison; it has {self.controllers}")

    @property
    def controllers(self) -> tuple[str, ...]:
        """Names in the order of the rows."""
        return tuple(row.controller for row in self.rows)
