"""Result of a comparison: one tidy table, and statistics per controller.

Metres, seconds, shares from 0 to 1; None: unknown.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
import pyarrow as pa

from rejoint.arms import Array
from rejoint.control.correction import NOT_KNOWN, TrueError, mean_modelled
from rejoint.system.errors import InputError
from rejoint.system.records import Readable, entity, value_type
from rejoint.system.statistics import Estimate, Labels, Spread, cluster, clustered_share, spread

Values = tuple[float | None, ...]

WAS_WORSE = "was worse than "

MODELLED = ("modelled", "modelled_low", "modelled_high")
CROSSING = ("crossed", "crossing_error", "crossing_true", "crossing_time")
"""1 where the threshold was crossed in time, else 0; encoder and true error [m] then or at the time-out; [s] until"""
PLACE = tuple(f"away{whose}_{axis}" for whose in ("", "_true") for axis in "xyz")
"""[m] mean place of the tool, by the encoders less the corrected target, and itself less the target"""
HOLDING = ("held", "settled", "settled_true", "oscillation", "turned", *PLACE, *MODELLED)
"""1 where the target was held; at its end: encoder and true error [m], rms distance [m] of the encoder TCP from its
mean, orientation error [rad], place, and true error by a calibration with its 95 % interval [m]; None: not held"""
METRICS = CROSSING + HOLDING
"""Columns, besides `Protocol.stay_names` [s] (the hold's length: never)"""

Columns = dict[str, Array]
"""Metrics by name, all of one shape, such as (B, K); NaN: none"""


Kind = Literal["crossing", "hold"]
KINDS: tuple[Kind, ...] = ("crossing", "hold")


Places = tuple[tuple[int, int], ...]
"""Target set and repetition of each arm"""


class Key(NamedTuple):
    """Identity of a trial, or of those of a batch."""

    controller: str
    kind: Kind
    places: Places
    first: int = 0
    """index of the first target"""

    @property
    def label(self) -> str:
        """Of the first trial, such as ``hold/policy/0/2``: protocol, controller, target set, repetition."""
        return "/".join(map(str, (self.kind, self.controller, *self.places[0])))


@entity
class Driven:
    """A trial, or those of a batch."""

    key: Key
    columns: Columns
    """(B, K)"""
    cycles: int
    reasons: dict[str, int]
    ended: tuple[str, ...]
    """why trials ended early, see `reason_names`"""
    source: str = ""
    """who drove it before the comparison"""


@value_type
class Stay:
    """Time within a distance."""

    within: float
    """[m]"""
    share: Estimate
    """of the holds"""
    median: float | None
    """[s] over all holds; None: in fewer than half"""


@value_type
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
    ended: tuple[str, ...] = ()
    """why trials ended early"""
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
    crossings: bool = True
    """driven by themselves, as by Park et al. 2024; else read from the holds"""
    hold: float = 8.0
    """[s] (chosen)"""
    window: float = 1.0
    """[s] averaged end (chosen)"""
    within: tuple[float, ...] = (0.010, 0.005, 0.002)
    """[m] (chosen)"""

    def __post_init__(self) -> None:
        least = np.min([self.threshold, self.dwell, self.window, *self.within])
        if not (self.within and least > 0.0 and self.window < self.hold):
            raise InputError(f"expected positive numbers, and a window that is shorter than the hold, got {self}")

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """Protocols that are driven."""
        return KINDS if self.crossings else ("hold",)

    @property
    def stay_names(self) -> tuple[str, ...]:
        """Columns such as ``stay_2mm``."""
        return tuple(f"stay_{1e3 * within:g}mm" for within in self.within)


@value_type
class TargetErrors:
    """Mean errors at targets."""

    encoders: Values
    """[m] from the corrected target"""
    true: tuple[TrueError, ...]
    """of the tool"""

    @classmethod
    def of(cls, found: Columns) -> TargetErrors:
        """Means of columns (R, K) over the repetitions."""
        encoders, known = ([_mean(values) for values in found[name].T] for name in ("settled", "settled_true"))
        modelled = map(mean_modelled, np.stack([found[name].T for name in MODELLED], axis=1))
        true = tuple(
            other if value is None else TrueError(how="known", value=value)
            for value, other in zip(known, modelled, strict=True)
        )
        return cls(encoders=tuple(encoders), true=true)


@value_type
class Comparison(Readable):
    """Controllers on one arm with the same targets."""

    seed: int
    batched: bool
    """side by side on emulated arms"""
    repetitions: int
    targets: tuple[tuple[tuple[float, float, float], ...], ...]
    """(S, K, 3) [m]"""
    protocol: Protocol
    rows: tuple[ControllerRow, ...]
    results: dict[str, Values] = field(repr=False)
    """columns (`METRICS`) of `table`"""
    robot: str = ""
    """address"""
    arm: str = ""
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
    def clusters(self) -> str:
        """Unit of resampling: ``target sets``, ``trials`` or ``targets``."""
        return cluster(self.shape)[0]

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


def row_of(
    controller: str,
    found: Columns,
    protocol: Protocol,
    driven: Sequence[Driven] = (),
    *,
    labels: Labels | None = None,
    out: str = "",
) -> ControllerRow:
    """Statistics of results (S, R, K), and what the guard did while they were ``driven``.

    95 % intervals are over the clusters ``labels``, flat; None: of the shape, with accuracy and repeatability (ISO
    9283) over the repetitions.
    """
    alone, labels = labels is None, cluster(found["crossed"].shape)[1] if labels is None else labels
    crossed, held = found["crossed"].ravel(), found["held"].ravel() == 1.0
    stays = []
    for within, name in zip(protocol.within, protocol.stay_names, strict=True) if held.any() else ():
        time = found[name].ravel()[held]
        stayed = time < protocol.hold  # not where a hold was cut short
        median = float(np.median(np.where(stayed, time, np.inf)))
        share = clustered_share(stayed.astype(float), labels[held])
        stays.append(Stay(within=within, share=share, median=median if np.isfinite(median) else None))
    names = ("crossing_error", "crossing_true", "settled", "settled_true", "oscillation", "turned")
    spreads = {name: spread(found[name].ravel(), labels) for name in names}
    for whose in ("", "_true") if alone else ():
        places = np.stack([found[f"away{whose}_{axis}"] for axis in "xyz"], axis=-1).swapaxes(1, 2)  # (S, K, R, 3)
        off = np.linalg.norm(places.mean(axis=2), axis=-1).ravel()
        each = np.arange(len(off))
        spreads[f"accuracy{whose}"] = spread(off, each)
        spreads[f"repeatability{whose}"] = spread(position_repeatability(places).ravel(), each)
    cycles = sum(one.cycles for one in driven)
    reasons = sum((Counter(one.reasons) for one in driven), Counter[str]())
    modelled = mean_modelled(np.array([found[name] for name in MODELLED]))
    tried = np.isfinite(found["crossed"])
    times = np.where(tried, found["crossing_time"], 0.0).sum(axis=-1)
    times = tried.shape[-1] * times / np.where(tried.any(axis=-1), tried.sum(axis=-1), np.nan)  # (S, R) [s] of all
    sets = labels.reshape(found["crossed"].shape)[..., 0].ravel()
    return ControllerRow(
        controller=controller,
        success=clustered_share(crossed, labels) if np.isfinite(crossed).any() else None,
        **spreads,
        cycle_time=spread(times.ravel(), sets),
        settled_modelled=None if modelled.value is None else modelled,
        stays=tuple(stays),
        held=int(np.isfinite(found["settled"]).sum()),
        guard={name: count / cycles for name, count in reasons.most_common()},
        ended=tuple(end for one in driven for end in one.ended),
        out=out,
        source=next((one.source for one in driven if one.source), ""),
    )


def collect(driven: Iterable[Driven], shape: tuple[int, int, int], protocol: Protocol) -> Columns:
    """All columns (S, R, K) of one controller's trials."""
    columns = {name: np.full(shape, np.nan) for name in (*METRICS, *protocol.stay_names)}
    for one in driven:
        for name, values in one.columns.items():
            for (s, r), row in zip(one.key.places, values, strict=True):
                columns.setdefault(name, np.full(shape, np.nan))[s, r, one.key.first :][: len(row)] = row
    return columns


def position_repeatability(places: Array) -> Array:
    """RP (...) [m] of ``places`` (..., R, 3): mean distance from their mean, plus 3 sigma; NaN for R < 2."""
    if places.shape[-2] < 2:
        return np.full(places.shape[:-2], np.nan)
    distance = np.linalg.norm(places - places.mean(axis=-2, keepdims=True), axis=-1)
    return distance.mean(axis=-1) + 3.0 * distance.std(axis=-1, ddof=1)


def comparison_of(parts: Mapping[str, Columns], targets: Array, **facts: Any) -> Comparison:  # noqa: ANN401
    """Put controllers' results (S, R, K) together; ``targets`` (S, K, 3) [m], ``facts``: the other fields."""
    names = next(iter(parts.values()))
    together = {name: np.stack([one[name] for one in parts.values()]) for name in names}
    return Comparison(
        repetitions=together["crossed"].shape[2],
        targets=tuple(tuple(map(tuple, points)) for points in targets.tolist()),
        results={
            name: tuple(float(value) if np.isfinite(value) else None for value in array.ravel())
            for name, array in together.items()
            if np.isfinite(array).any()
        },
        **facts,
    )


def _mean(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None
