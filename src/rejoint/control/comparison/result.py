"""Result of a comparison: one tidy table, and statistics per controller.

Metres, seconds, shares from 0 to 1; None: unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa

from rejoint.arms import Array
from rejoint.control.correction import NOT_KNOWN, TrueError
from rejoint.system.errors import InputError
from rejoint.system.statistics import Estimate, Spread

Values = tuple[float | None, ...]

WAS_WORSE = "was worse than "

METRICS = {
    "crossed": "1 where the threshold was crossed in time, else 0",
    "crossing_error": "[m] encoder error at the crossing or the time-out",
    "crossing_true": "[m] true error at that moment",
    "crossing_time": "[s] until then",
    "held": "1 where the target was held",
    "settled": "[m] encoder error, mean of the last part of the hold; None where the guard ended it before",
    "settled_true": "[m] true error over the same time",
    "oscillation": "[m] root mean square distance of the encoder TCP from its mean over the same time",
    "turned": "[rad] orientation error by the encoders over the same time; None where no orientation is asked for",
    **{f"away_{axis}": "[m] mean place of the tool by the encoders less the corrected target" for axis in "xyz"},
    **{f"away_true_{axis}": "[m] mean place of the tool itself less the target" for axis in "xyz"},
    "modelled": "[m] true error by a calibration, where it is not known",
    "modelled_low": "[m] lower end of its 95 % interval",
    "modelled_high": "[m] upper end",
}
"""Columns, besides `Protocol.stay_names` [s] (the hold's length: never)"""


@dataclass(frozen=True, kw_only=True)
class Stay:
    """Time within a distance."""

    within: float
    """[m]"""
    share: Estimate
    """of the holds"""
    median: float | None
    """[s] over all holds; None: in fewer than half"""


@dataclass(frozen=True, kw_only=True)
class Ended:
    """A trial that ended early."""

    protocol: str
    """``crossing`` or ``hold``"""
    target_set: int
    repetition: int
    target: int
    """index"""
    why: str
    """see `reason_names`"""


@dataclass(frozen=True, kw_only=True)
class ControllerRow:
    """Statistics of one controller; None: unknown."""

    controller: str
    success: Estimate | None
    """share reached in time"""
    crossing_error: Spread | None
    """[m] encoder error at a target's end"""
    crossing_true: Spread | None
    """[m] true error there"""
    cycle_time: Spread | None
    """[s] per set; extrapolated after an elimination"""
    settled: Spread | None
    """[m] encoder error at the end of each hold"""
    settled_true: Spread | None
    """[m] true"""
    settled_modelled: TrueError | None
    """true, by a calibration"""
    oscillation: Spread | None
    """[m] rms motion there"""
    turned: Spread | None
    """[rad] orientation error there"""
    accuracy: Spread | None = None
    """[m] AP of ISO 9283, encoders"""
    repeatability: Spread | None = None
    """[m] RP, encoders"""
    accuracy_true: Spread | None = None
    """[m] AP, tool"""
    repeatability_true: Spread | None = None
    """[m] RP, tool"""
    stays: tuple[Stay, ...]
    held: int
    """targets held to the end"""
    guard: dict[str, float] = field(default_factory=dict)
    """share of cycles per reason"""
    ended: tuple[Ended, ...] = ()
    out: str = ""
    """reason of elimination"""
    source: str = ""
    """origin of first trials"""

    @property
    def beaten(self) -> bool:
        """Whether eliminated by a better one."""
        return self.out.startswith(WAS_WORSE)

    @property
    def failures(self) -> int:
        """Trials that ended early."""
        return len(self.ended)

    @property
    def reached(self) -> float:
        """Share reached in time; NaN: not tried."""
        return np.nan if self.success is None else self.success.value

    @property
    def true_error(self) -> TrueError:
        """Mean true error over the holds."""
        if self.settled_true is not None:
            return TrueError.of("known", self.settled_true.mean)
        return self.settled_modelled or NOT_KNOWN


@dataclass(frozen=True, kw_only=True)
class Protocol:
    """Settings of both protocols."""

    threshold: float = 0.010
    """[m] Park et al. 2024, section IV-A"""
    dwell: float = 20.0
    """[s] longest per target; Park et al. 2024, section IV-F"""
    hold: float = 8.0
    """[s] (chosen)"""
    window: float = 1.0
    """[s] averaged end (chosen)"""
    within: tuple[float, ...] = (0.010, 0.005, 0.002)
    """[m] (chosen)"""

    def __post_init__(self) -> None:
        for name in ("threshold", "dwell", "hold", "window"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"protocol: {name} must be positive, got {getattr(self, name)}")
        if not self.window < self.hold:
            raise InputError(f"protocol: the window ({self.window} s) must be shorter than the hold ({self.hold} s)")
        if not self.within or min(self.within) <= 0.0:
            raise InputError(f"protocol: distances to stay within must be positive, got {self.within}")

    @property
    def stay_names(self) -> tuple[str, ...]:
        """Columns such as ``stay_2mm``."""
        return tuple(f"stay_{1e3 * within:g}mm" for within in self.within)


@dataclass(frozen=True, kw_only=True)
class TargetErrors:
    """Errors at targets."""

    encoders: Values
    """[m] from the corrected target"""
    true: tuple[TrueError, ...]
    """of the tool"""


@dataclass(frozen=True, kw_only=True)
class DirectionVariation:
    """VAP of ISO 9283 along three axes."""

    controller: str
    poses: int
    cycles: int
    """per direction; ISO asks for 30"""
    encoders: Spread
    """[m]"""
    tool: Spread | None
    """[m] tool"""


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Controllers on one arm with the same targets."""

    robot: str
    """address"""
    arm: str
    seed: int
    batched: bool
    """side by side on emulated arms"""
    repetitions: int
    targets: tuple[tuple[tuple[float, float, float], ...], ...]
    """(S, K, 3) [m]"""
    protocol: Protocol
    clusters: str
    """unit of resampling: ``target sets``, ``trials`` or ``targets``"""
    rows: tuple[ControllerRow, ...]
    results: dict[str, Values] = field(repr=False)
    """columns (`METRICS`) of `table`"""
    targets_file: str = ""
    """empty: drawn"""
    period: tuple[float, float] | None = None
    """[s] requested; None: the robot's own"""
    left_out: tuple[str, ...] = ()
    """sentences with reasons"""
    calibration: str = ""
    """date, or empty"""
    block: int = 0
    """targets between eliminations; 0: none"""
    as_found: TargetErrors | None = None
    """uncorrected arm, first target set"""
    directions: DirectionVariation | None = None
    """of the recommended controller"""
    orientations: tuple[tuple[str, ...], ...] = ()
    """in words"""

    def row(self, controller: str) -> ControllerRow:
        """Statistics of a controller; InputError."""
        return self.rows[self._index(controller)]

    @property
    def controllers(self) -> tuple[str, ...]:
        """In row order."""
        return tuple(row.controller for row in self.rows)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Sets S, repetitions R, targets K."""
        return len(self.targets), self.repetitions, len(self.targets[0])

    @property
    def true_known(self) -> bool:
        """Whether true errors are known."""
        return "settled_true" in self.results

    def array(self, metric: str, controller: str) -> Array:
        """Column of a controller, (S, R, K); NaN: none."""
        values = self.results.get(metric)
        if values is None:
            return np.full(self.shape, np.nan)
        return np.array(values, dtype=float).reshape(len(self.rows), *self.shape)[self._index(controller)]

    def table(self) -> pa.Table:
        """Tidy table: a row per controller, target set, repetition and target."""
        names = ("controller", "target_set", "repetition", "target")
        keys = dict(zip(names, np.indices((len(self.rows), *self.shape)).reshape(len(names), -1), strict=True))
        return pa.table(keys | {"controller": np.array(self.controllers)[keys["controller"]]} | self.results)

    def to_pandas(self) -> Any:  # noqa: ANN401 - pandas is not part of the installation
        """Table as a data frame (needs pandas)."""
        return self.table().to_pandas()

    def _index(self, controller: str) -> int:
        if controller not in self.controllers:
            raise InputError(f"no controller {controller!r} in this comparison; it has {self.controllers}")
        return self.controllers.index(controller)
