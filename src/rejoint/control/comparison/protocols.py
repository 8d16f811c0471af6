"""The two protocols, their metrics, and the table of a comparison.

``crossing`` (Park et al. 2024, section IV-F): a target ends at the first crossing of the threshold or after the dwell.
``hold``: every target lasts the same time. Accuracy: ISO 9283:1998 (30 cycles) and ISO 230-2:2014.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.rotations import REACHED_TURN
from rejoint.control.comparison.result import METRICS, Comparison, ControllerRow, Ended, Protocol, Stay, Values
from rejoint.control.correction import ToolModel, mean_modelled, modelled
from rejoint.control.guard import Reason, reason_names
from rejoint.control.loop import Schedule
from rejoint.control.recording import Recording
from rejoint.control.robot import Robot
from rejoint.system.statistics import Labels, cluster, clustered_share, spread

Kind = Literal["crossing", "hold"]
KINDS: tuple[Kind, ...] = ("crossing", "hold")

STANDS_FOR = 3.0
"""[s] stationary before a dwell ends (chosen)"""

_CHUNK = 8192  # postures per call of the kinematics: enough to be fast, few enough for little memory


Columns = dict[str, Array]
"""Metrics (B, K) by name; NaN: none"""


def schedule(
    kind: Kind, protocol: Protocol, *, keep_going: bool, sent: Array | None = None, wait: bool = True
) -> Schedule:
    """Schedule after the last commands ``sent`` (B, n) [rad]."""
    if kind == "crossing":
        return Schedule(
            dwell=protocol.dwell,
            stop_below=protocol.threshold,
            stands_for=None if wait else STANDS_FOR,
            keep_going=keep_going,
            sent=sent,
        )
    return Schedule(dwell=protocol.hold, keep_going=keep_going, sent=sent)


def encoder_tcp(arm: Arm, recording: Recording) -> Array:
    """TCP (T, B, 3) [m] by the encoders; NaN without a new reading."""
    tcp = np.full((*recording.active.shape, 3), np.nan)
    t, b = np.nonzero(recording.active)
    for start in range(0, len(t), _CHUNK):
        rows = t[start : start + _CHUNK], b[start : start + _CHUNK]
        tcp[rows] = tcp_position(arm, recording.position[rows])
    return tcp


def measure_crossings(arm: Arm, recording: Recording, targets: Array, protocol: Protocol) -> Columns:
    """Metrics of crossing; ``targets`` (B, K, 3) [m].

    Targets cut short by a trip are missed; later ones are NaN.
    """
    error, true_error = _errors(arm, recording)
    shape = targets.shape[:2]
    last = np.where(recording.active, recording.target_index, -1).max(axis=0, initial=-1)
    spared = (np.arange(shape[1]) > last[:, None]) & (recording.tripped == 0)[:, None]
    result = _columns(shape, "crossing_error", "crossing_true", "crossing_time")
    result["crossed"] = np.where(spared, np.nan, 0.0)
    for b, k, rows in _segments(recording, targets):
        off = error[rows, b]
        askew = recording.turned[rows, b] > REACHED_TURN  # a pose is reached where the orientation is as well
        seen = np.where(askew, np.maximum(off, protocol.threshold), off)
        end = crossing(recording.since_target[rows, b], seen, protocol.threshold)
        if end.reached or end.time >= protocol.dwell:
            result["crossed"][b, k], result["crossing_error"][b, k] = end.reached, off[end.row]
            result["crossing_time"][b, k], result["crossing_true"][b, k] = end.time, true_error[rows[end.row], b]
    return result


def measure_holds(
    arm: Arm, recording: Recording, targets: Array, protocol: Protocol, model: ToolModel | None = None
) -> Columns:
    """Metrics of holding; ``targets`` (B, K, 3) [m]; NaN where a trip ended a hold."""
    tcp = encoder_tcp(arm, recording)
    error, true_error = _errors(arm, recording, tcp)
    shape = targets.shape[:2]
    result = _columns(shape, "settled", "settled_true", "oscillation", "turned", *protocol.stay_names)
    result["held"] = np.ones(shape)
    away, away_true = np.full((2, *shape, 3), np.nan)
    posture = np.full((*shape, arm.joints), np.nan)
    for b, k, rows in _segments(recording, targets):
        since = recording.since_target[rows, b]
        if since[-1] < protocol.hold:
            continue
        signals = (("settled", error), ("settled_true", true_error), ("turned", recording.turned))
        for name, signal in signals:
            result[name][b, k] = settled(since, signal[rows, b], protocol.window)
        last = rows[since > since[-1] - protocol.window]
        away[b, k] = (tcp[last, b] - recording.aim[last, b]).mean(axis=0)
        away_true[b, k] = (recording.true_tcp[last, b] - recording.target[last, b]).mean(axis=0)
        if np.isnan(away_true[b, k]).any():
            posture[b, k] = recording.position[last, b].mean(axis=0)
        result["oscillation"][b, k] = oscillation(since, tcp[rows, b], protocol.window)
        for name, within in zip(protocol.stay_names, protocol.within, strict=True):
            result[name][b, k] = min(stay_time(since, error[rows, b], within), protocol.hold)
    for i, axis in enumerate("xyz"):
        result[f"away_{axis}"], result[f"away_true_{axis}"] = away[..., i], away_true[..., i]
    if model is not None:
        found = modelled(model, posture, targets)
        result |= dict(zip(("modelled", "modelled_low", "modelled_high"), found, strict=True))
    return result


def _columns(shape: tuple[int, ...], *names: str) -> Columns:
    return {name: np.full(shape, np.nan) for name in names}


def _errors(arm: Arm, recording: Recording, tcp: Array | None = None) -> tuple[Array, Array]:
    """Return encoder and true errors (T, B) [m]."""
    tcp = encoder_tcp(arm, recording) if tcp is None else tcp
    return (
        np.linalg.norm(tcp - recording.aim, axis=-1),
        np.linalg.norm(recording.true_tcp - recording.target, axis=-1),
    )


def _segments(recording: Recording, targets: Array) -> list[tuple[int, int, NDArray[np.intp]]]:
    count, length = targets.shape[:2]
    found = []
    for b in range(count):
        rows = np.flatnonzero(recording.active[:, b])
        edges = np.searchsorted(recording.target_index[rows, b], np.arange(length + 1))
        found += [(b, k, rows[edges[k] : edges[k + 1]]) for k in range(length) if edges[k + 1] > edges[k]]
    return found


class Crossing(NamedTuple):
    """End of a target."""

    reached: bool
    error: float
    time: float
    """[s]"""
    row: int


def crossing(since: Array, error: Array, threshold: float) -> Crossing:
    """First time at which ``error`` (T,) [m] is below ``threshold`` [m], or the end."""
    below = np.flatnonzero(error < threshold)
    row = int(below[0]) if len(below) else len(error) - 1
    return Crossing(bool(len(below)), float(error[row]), float(since[row]), row)


def stay_time(since: Array, error: Array, within: float) -> float:
    """Time [s] from which ``error`` (T,) [m] stays below ``within`` [m]; inf: never."""
    outside = np.flatnonzero(~(error < within))
    if len(outside) == 0:
        return float(since[0])
    last = int(outside[-1])
    return float(since[last + 1]) if last + 1 < len(since) else float("inf")


def settled(since: Array, signal: Array, window: float) -> float:
    """Time mean of ``signal`` (T,) over the last ``window`` [s]."""
    rows = since >= since[-1] - window
    t, x = since[rows], signal[rows]
    if len(t) < 2:
        return float(x[-1])
    return float(np.trapezoid(x, t) / (t[-1] - t[0]))


def oscillation(since: Array, tcp: Array, window: float) -> float:
    """Rms distance [m] of ``tcp`` (T, 3) from its mean over the last ``window`` [s]."""
    last = tcp[since >= since[-1] - window]
    return float(np.sqrt(((last - last.mean(axis=0)) ** 2).sum(axis=-1).mean()))


Place = tuple[int, int]
Places = tuple[Place, ...]
Key = tuple[str, Kind, Places, int]
"""Controller, protocol, trials, first target"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Driven:
    """A trial, or those of a batch."""

    controller: str
    kind: Kind
    places: Places
    columns: Columns
    """(B, K)"""
    cycles: int
    reasons: dict[str, int]
    ended: tuple[Ended, ...]
    failed: bool = False
    first: int = 0
    """index"""

    @property
    def key(self) -> Key:
        """Identity."""
        return self.controller, self.kind, self.places, self.first

    @property
    def targets(self) -> int:
        """Number."""
        return int(next(iter(self.columns.values())).shape[1])


def measure(
    arm: Arm,
    recording: Recording,
    targets: Array,
    protocol: Protocol,
    key: Key,
    *,
    failed: bool = False,
    model: ToolModel | None = None,
    both: bool = False,
) -> Driven:
    """Metrics of a recording; ``targets`` (B, K, 3) [m].

    ``both``: a hold also gives the crossing.
    """
    controller, kind, places, first = key
    columns: Columns = {}
    if kind == "hold":
        columns = measure_holds(arm, recording, targets, protocol, model)
        protocol = replace(protocol, dwell=min(protocol.dwell, protocol.hold))
    if kind == "crossing" or both:
        columns |= measure_crossings(arm, recording, targets, protocol)
    if kind == "hold" and both:
        columns["crossing_time"][columns["crossed"] == 0.0] = np.nan
    counts = {reason: int(np.count_nonzero(recording.reasons & np.uint16(reason.value))) for reason in Reason}
    ended = tuple(
        Ended(
            protocol=kind,
            target_set=places[b][0],
            repetition=places[b][1],
            target=int(recording.target_index[-1, b]),
            why=", ".join(reason_names(int(recording.tripped[b]))),
        )
        for b in np.flatnonzero(recording.tripped)
    )
    return Driven(
        controller=controller,
        kind=kind,
        places=places,
        failed=failed,
        first=first,
        columns=columns,
        cycles=int(recording.active.sum()),
        ended=ended,
        reasons={reason_names(reason)[0]: count for reason, count in counts.items() if count},
    )


INSET = 0.1
"""of P2 to P5 over the diagonal (ISO 9283)"""
RISING_AHEAD = np.array([[0, 0, 0], [-1, -1, -1], [-1, 1, -1], [1, 1, 1], [1, -1, 1]], dtype=float)
"""P1 to P5 in the diagonal plane rising away from the base, in half diagonals"""
RISING_LEFT = np.array([[0, 0, 0], [1, 1, 1], [-1, 1, 1], [-1, -1, -1], [1, -1, -1]], dtype=float)
"""The same, rising to the left"""


def iso_poses(arm: Arm, plane: Array, size: float = 1.0) -> Array:
    """P1 to P5 (5, 3) [m] of ISO 9283 in a ``plane`` of the region."""
    low, high = arm.targets.lower, arm.targets.upper
    return np.asarray(0.5 * (low + high) + 0.5 * size * (1.0 - 2.0 * INSET) * (high - low) * plane)


def position_accuracy(places: Array, target: Array) -> Array:
    """AP (...) [m]: from the mean of ``places`` (..., R, 3) to ``target`` (..., 3)."""
    return np.asarray(np.linalg.norm(places.mean(axis=-2) - target, axis=-1))


def position_repeatability(places: Array) -> Array:
    """RP (...) [m] of ``places`` (..., R, 3): mean distance from their mean, plus 3 sigma; NaN for R < 2."""
    if places.shape[-2] < 2:
        return np.full(places.shape[:-2], np.nan)
    distance = np.linalg.norm(places - places.mean(axis=-2, keepdims=True), axis=-1)
    return np.asarray(distance.mean(axis=-1) + 3.0 * distance.std(axis=-1, ddof=1))


def direction_variation(means: Array) -> float:
    """VAP [m]: largest distance between ``means`` (D, 3) from D directions."""
    apart = np.linalg.norm(means[:, None] - means[None], axis=-1)
    return float(apart.max())


def reversal(forwards: Array, backwards: Array) -> Array:
    """B (...) [m]: distance between the means of (..., R, 3) from the two sides."""
    return np.asarray(np.linalg.norm(forwards.mean(axis=-2) - backwards.mean(axis=-2), axis=-1))


MODELLED = ("modelled", "modelled_low", "modelled_high")


class Tally:
    """Collects a controller's metrics."""

    def __init__(self, shape: tuple[int, int, int], protocol: Protocol) -> None:
        """``shape``: sets, repetitions, targets."""
        self.protocol = protocol
        self.columns: Columns = {name: np.full(shape, np.nan) for name in (*METRICS, *protocol.stay_names)}
        self.cycles, self.out, self.source = 0, "", ""
        self.ended: list[Ended] = []
        self.reasons: dict[str, int] = {}

    def add(self, driven: Driven) -> None:
        """Add trials."""
        sets, repetitions = np.array(driven.places).T
        at = sets[:, None], repetitions[:, None], np.arange(driven.first, driven.first + driven.targets)[None]
        for name, values in driven.columns.items():
            self.columns[name][at] = values
        self.cycles += driven.cycles
        self.ended += driven.ended
        for reason, cycles in driven.reasons.items():
            self.reasons[reason] = self.reasons.get(reason, 0) + cycles

    def row(self, controller: str) -> ControllerRow:
        """Statistics so far."""
        guard = sorted(self.reasons.items(), key=lambda item: -item[1])
        return replace(
            summarise(controller, self.columns, cluster(self.columns["crossed"].shape)[1], self.protocol),
            **_pose_accuracy(self.columns, ""),
            **_pose_accuracy(self.columns, "_true"),
            guard={name: n / self.cycles for name, n in guard},
            ended=tuple(self.ended),
            out=self.out,
            source=self.source,
        )


def summarise(controller: str, found: Columns, labels: Labels, protocol: Protocol) -> ControllerRow:
    """Statistics of results (S, R, K) with 95 % intervals over the clusters ``labels``, flat."""
    driven, held = np.isfinite(found["crossed"]), found["held"].ravel() == 1.0
    stays = []
    for within, name in zip(protocol.within, protocol.stay_names, strict=True) if held.any() else ():
        stayed = found[name].ravel()[held] < protocol.hold  # not where a hold was cut short
        median = float(np.median(np.where(stayed, found[name].ravel()[held], np.inf)))
        share = clustered_share(stayed.astype(float), labels[held])
        stays.append(Stay(within=within, share=share, median=median if np.isfinite(median) else None))
    names = ("crossing_error", "crossing_true", "settled", "settled_true", "oscillation", "turned")
    spreads: dict[str, Any] = {name: spread(found[name].ravel(), labels) for name in names}
    modelled = np.array([found.get(name, np.full(driven.shape, np.nan)) for name in MODELLED])
    return ControllerRow(
        controller=controller,
        success=clustered_share(found["crossed"].ravel(), labels) if driven.any() else None,
        **spreads,
        cycle_time=spread(cycle_times(found).ravel(), labels.reshape(driven.shape)[..., 0].ravel()),
        settled_modelled=mean_modelled(modelled) if np.isfinite(modelled).any() else None,
        stays=tuple(stays),
        held=int(np.isfinite(found["settled"]).sum()),
    )


def cycle_times(found: Columns) -> Array:
    """Time (S, R) [s] for all targets, extrapolated from those driven; NaN where a trip ended the trial."""
    driven = np.isfinite(found["crossed"])
    time = np.where(driven, found["crossing_time"], 0.0).sum(axis=-1)
    return np.asarray(driven.shape[-1] * time / np.where(driven.any(axis=-1), driven.sum(axis=-1), np.nan))


def comparison_of(
    robot: Robot,
    seed: int,
    batched: bool,
    targets: Array,
    tallies: dict[str, Tally],
    orientations: Iterable[tuple[str, ...]] = (),
) -> Comparison:
    """Comparison from the tallies; ``targets`` (S, K, 3) [m]."""
    first = next(iter(tallies.values()))
    sets, repetitions, count = first.columns["crossed"].shape
    together = {name: np.stack([one.columns[name] for one in tallies.values()]) for name in first.columns}
    return Comparison(
        robot=robot.address,
        arm=robot.arm.name,
        seed=seed,
        batched=batched,
        repetitions=repetitions,
        targets=tuple(tuple((float(x), float(y), float(z)) for x, y, z in points) for points in targets),
        protocol=first.protocol,
        clusters=cluster((sets, repetitions, count))[0],
        rows=tuple(tally.row(name) for name, tally in tallies.items()),
        results={name: _values(array) for name, array in together.items() if np.isfinite(array).any()},
        orientations=tuple(orientations),
    )


def _pose_accuracy(found: Columns, whose: str) -> dict[str, Any]:
    away = np.stack([found[f"away{whose}_{axis}"] for axis in "xyz"], axis=-1)
    places = np.moveaxis(away, 1, 2)  # (S, K, R, 3)
    each = np.arange(places.shape[0] * places.shape[1])
    accuracy = spread(position_accuracy(places, np.zeros(3)).ravel(), each)
    repeatability = None if accuracy is None else spread(position_repeatability(places).ravel(), each)
    return {f"accuracy{whose}": accuracy, f"repeatability{whose}": repeatability}


def _values(array: Array) -> Values:
    return tuple(float(value) if np.isfinite(value) else None for value in array.ravel())
