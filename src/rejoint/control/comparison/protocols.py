"""The two protocols and their metrics.

``crossing`` (Park et al. 2024, section IV-F): a target ends at the first crossing of the threshold or after the dwell.
``hold``: every target lasts the same time. Accuracy: ISO 9283:1998 (30 cycles) and ISO 230-2:2014.
"""

from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.linalg import norm

from rejoint.arms import Arm, Array, Mask, tcp_position
from rejoint.arms.rotations import REACHED_TURN
from rejoint.control.comparison.result import (
    CROSSING,
    HOLDING,
    KINDS,
    MODELLED,
    PLACE,
    Columns,
    Driven,
    Key,
    Kind,
    Protocol,
)
from rejoint.control.correction import ToolModel, modelled, tool_error
from rejoint.control.guard import Reason, reason_names
from rejoint.control.loop import Schedule
from rejoint.control.recording import Cycle, Recording


def schedule(kind: Kind, protocol: Protocol, **options: Any) -> Schedule:  # noqa: ANN401 - its fields
    """Schedule of a protocol, with further ``options``."""
    if kind == "hold":
        return Schedule(dwell=protocol.hold, **options)
    return Schedule(dwell=protocol.dwell, stop_below=protocol.threshold, **options)


def metrics_of(
    arm: Arm,
    recording: Recording,
    targets: Array,
    protocol: Protocol,
    kinds: Collection[str] = ("hold",),
    models: Sequence[ToolModel] = (),
) -> Columns:
    """Metrics (B, K) of ``kinds`` at ``targets`` (B, K, 3) [m]; of both kinds: the crossing within each hold.

    ``models`` of each arm estimate true errors that are not known.

    After a trip holds are NaN, and its crossing is missed.
    """
    shape = targets.shape[:2]
    hold, cross = "hold" in kinds, "crossing" in kinds
    names = CROSSING * cross + (HOLDING + protocol.stay_names) * hold
    columns = {name: np.full(shape, np.nan) for name in names}
    if hold:
        columns["held"][:] = 1.0
    if cross:
        last = np.where(recording.active, recording.target_index, -1).max(axis=0, initial=-1)
        spared = (np.arange(shape[1]) > last[:, None]) & (recording.tripped == 0)[:, None]
        columns["crossed"] = np.where(spared, np.nan, 0.0)
    posture = np.full((*shape, arm.joints), np.nan)
    for b, k, visit in visits(recording, shape[1]):
        found = dict[str, float]()
        if cross:
            found |= _crossed(arm, visit, protocol, within_hold=hold)
        if hold and visit.since_target[-1] >= protocol.hold:
            found |= _held(arm, visit, protocol)
            if np.isnan(found["away_true_x"]):
                posture[b, k] = visit.position[_last(visit, protocol)].mean(axis=0)
        for name, value in found.items():
            columns[name][b, k] = value
    if models and hold:
        each = [modelled(*one) for one in zip(models, posture, targets, strict=True)]
        columns |= dict(zip(MODELLED, np.stack(each, axis=1), strict=True))
    return columns


def _crossed(arm: Arm, visit: Cycle, protocol: Protocol, *, within_hold: bool) -> dict[str, float]:
    error = tool_error(arm, visit.position, visit.aim)
    # A pose is reached where the orientation is as well.
    reached, row = crossing(np.where(visit.turned > REACHED_TURN, np.inf, error), protocol.threshold)
    time = visit.since_target[row]
    if not reached and time < (min(protocol.dwell, protocol.hold) if within_hold else protocol.dwell):
        return {}
    until = np.nan if within_hold and not reached else time
    values = float(reached), error[row], norm((visit.true_tcp - visit.target)[row]), until
    return dict(zip(CROSSING, values, strict=True))


def _held(arm: Arm, visit: Cycle, protocol: Protocol) -> dict[str, float]:
    since, window, last = visit.since_target, protocol.window, _last(visit, protocol)
    tcp = tcp_position(arm, visit.position)
    away, away_true = tcp - visit.aim, visit.true_tcp - visit.target
    error = norm(away, axis=-1)
    found = {
        "settled": settled(since, error, window),
        "settled_true": settled(since, norm(away_true, axis=-1), window),
        "turned": settled(since, visit.turned, window),
        "oscillation": oscillation(since, tcp, window),
    }
    for name, within in zip(protocol.stay_names, protocol.within, strict=True):
        found[name] = min(stay_time(since, error, within), protocol.hold)
    places = np.hstack([away, away_true])[last].T
    return found | {name: place.mean() for name, place in zip(PLACE, places, strict=True)}


def _last(visit: Cycle, protocol: Protocol) -> Mask:
    return visit.since_target > visit.since_target[-1] - protocol.window


def visits(recording: Recording, count: int) -> Iterator[tuple[int, int, Cycle]]:
    """Yield arm, target, and the rows (T', ...) of that arm at that target."""
    for b in range(recording.active.shape[1]):
        rows = recording.driven(b)
        edges = np.searchsorted(rows.target_index, np.arange(count + 1)).tolist()
        for k, (first, end) in enumerate(pairwise(edges)):
            if end > first:
                yield b, k, rows.at(slice(first, end))


def crossing(error: Array, threshold: float) -> tuple[bool, int]:
    """Whether ``error`` (T,) [m] gets below ``threshold`` [m], and the first row where it is, or the last."""
    below = np.flatnonzero(error < threshold)
    return bool(len(below)), int(below[0]) if len(below) else len(error) - 1


def stay_time(since: Array, error: Array, within: float) -> float:
    """Time [s] from which ``error`` (T,) [m] stays below ``within`` [m]; inf: never."""
    first = np.flatnonzero(~(error < within)).max(initial=-1) + 1
    return float(since[first]) if first < len(since) else np.inf


def settled(since: Array, signal: Array, window: float) -> float:
    """Time mean of ``signal`` (T,) over the last ``window`` [s]."""
    rows = since >= since[-1] - window
    t, x = since[rows], signal[rows]
    if len(t) < 2:
        return float(x[-1])
    return float(np.trapezoid(x, t) / (t[-1] - t[0]))


def oscillation(since: Array, tcp: Array, window: float) -> float:
    """Rms distance [m] of ``tcp`` (T, 3) from its mean over the last ``window`` [s]."""
    return float(np.sqrt(tcp[since >= since[-1] - window].var(axis=0).sum()))


def measure(
    arm: Arm,
    recording: Recording,
    targets: Array,
    protocol: Protocol,
    key: Key,
    *,
    model: ToolModel | None = None,
) -> Driven:
    """Metrics of a recording; ``targets`` (B, K, 3) [m]."""
    kinds = (key.kind,) if protocol.crossings else KINDS
    return Driven(
        key=key,
        columns=metrics_of(arm, recording, targets, protocol, kinds, [model] * len(targets) if model else ()),
        cycles=int(recording.active.sum()),
        ended=tuple(", ".join(reason_names(int(flags))) for flags in recording.tripped if flags),
        reasons={reason_names(r)[0]: count for r in Reason if (count := int(np.count_nonzero(recording.reasons & r)))},
    )


INSET = 0.1
"""of P2 to P5 over the diagonal (ISO 9283)"""
RISING_LEFT = np.array([[0, 0, 0], [1, 1, 1], [-1, 1, 1], [-1, -1, -1], [1, -1, -1]], dtype=float)
"""P1 to P5 in the diagonal plane rising to the left, in half diagonals"""


def iso_poses(arm: Arm, size: float = 1.0) -> Array:
    """P1 to P5 (5, 3) [m] of ISO 9283 in a diagonal plane of the region."""
    low, high = arm.targets.lower, arm.targets.upper
    return 0.5 * (low + high) + 0.5 * size * (1.0 - 2.0 * INSET) * (high - low) * RISING_LEFT


def reversal(forwards: Array, backwards: Array) -> Array:
    """B (...) [m]: distance between the means of (..., R, 3) from the two sides."""
    return norm(forwards.mean(axis=-2) - backwards.mean(axis=-2), axis=-1)
