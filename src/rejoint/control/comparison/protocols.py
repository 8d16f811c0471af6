"""The two protocols, and the results per target that their recordings hold.

* ``crossing``: Park et al. 2024, section IV-F. The next target comes at the first crossing of the
  threshold or after the dwell; the error is read at that moment.
* ``hold``: every target lasts the same time. What remains is what an owner cares about: the settled
  error, how soon it comes and stays, and whether the arm trembles.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.orientation import REACHED_TURN
from rejoint.control.accuracy import ToolModel, modelled
from rejoint.control.comparison.metrics import crossing, oscillation, settled, stay_time
from rejoint.control.comparison.result import Protocol
from rejoint.control.loop import Schedule
from rejoint.control.recording import Recording

Kind = Literal["crossing", "hold"]
KINDS: tuple[Kind, ...] = ("crossing", "hold")

STANDS_FOR = 3.0
"""[s] under one command after which an arm that has not crossed will not: the rest of the dwell is left out and counts
as waited for (chosen: worn arms creep by single encoder steps after half a second, and what pulls against stiction has
set off or not)"""

_CHUNK = 8192  # postures per call of the kinematics: enough to be fast, few enough for little memory


@dataclass(frozen=True, kw_only=True, eq=False)
class Crossings:
    """Results of the crossing protocol, each (B, K)."""

    crossed: Array
    """1 or 0; a target that a trip cut short or prevented is not crossed. NaN for one that was not driven although no
    trip prevented it: that says nothing about the controller"""
    error: Array
    """[m] encoder error at the crossing or the time-out; NaN where a trip came first"""
    true_error: Array
    """[m] true error at that moment; NaN where nobody knows"""
    time: Array
    """[s] in force; NaN where a trip came first"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Holds:
    """Results of the hold protocol, each (B, K); NaN where a trip cut the hold short."""

    settled: Array
    """[m] encoder error, mean of the last part"""
    settled_true: Array
    """[m] true error over the same time"""
    oscillation: Array
    """[m] root mean square distance of the encoder TCP from its mean, last part"""
    stay: Array
    """(W, B, K) [s] after which the error stays below each distance; infinite where it does not"""
    away: Array
    """(B, K, 3) [m] mean place of the tool by the encoders less the aim, over the same time"""
    away_true: Array
    """(B, K, 3) [m] mean place of the tool itself less the target"""
    modelled: Array
    """(3, B, K) [m] true error by a model at the mean posture of the last part, and the ends of its interval; NaN where
    there is none, or the true error is known"""
    turned: Array
    """(B, K) [rad] orientation error by the encoders, mean of the last part; NaN where none is asked for"""


def schedule(
    kind: Kind, protocol: Protocol, *, keep_going: bool, sent: Array | None = None, wait: bool = True
) -> Schedule:
    """Schedule of a protocol for arms whose last commands were ``sent`` (B, n) [rad].

    Where it need not ``wait``, an arm that stands does not keep its target for the rest of the dwell.
    """
    if kind == "crossing":
        return Schedule(
            dwell=protocol.dwell, stop_below=protocol.threshold, stands_for=None if wait else STANDS_FOR,
            keep_going=keep_going, sent=sent,
        )  # fmt: skip
    return Schedule(dwell=protocol.hold, keep_going=keep_going, sent=sent)


def encoder_tcp(arm: Arm, recording: Recording) -> Array:
    """TCP (T, B, 3) [m] by the encoders; NaN where a row has no news."""
    tcp = np.full((*recording.active.shape, 3), np.nan)
    t, b = np.nonzero(recording.active)
    for start in range(0, len(t), _CHUNK):
        rows = t[start : start + _CHUNK], b[start : start + _CHUNK]
        tcp[rows] = tcp_position(arm, recording.position[rows])
    return tcp


def measure_crossings(arm: Arm, recording: Recording, targets: Array, protocol: Protocol) -> Crossings:
    """Results of a recording of the crossing protocol with ``targets`` (B, K, 3) [m]."""
    error, true_error = _errors(arm, recording)
    shape = targets.shape[:2]
    last = np.where(recording.active, recording.target_index, -1).max(axis=0, initial=-1)
    spared = (np.arange(shape[1]) > last[:, None]) & (recording.tripped == 0)[:, None]
    result = Crossings(
        crossed=np.where(spared, np.nan, 0.0), error=_unknown(shape), true_error=_unknown(shape), time=_unknown(shape)
    )
    for b, k, rows in _segments(recording, targets):
        off = error[rows, b]
        askew = recording.turned[rows, b] > REACHED_TURN  # a pose is reached where the orientation is as well
        seen = np.where(askew, np.maximum(off, protocol.threshold), off)
        end = crossing(recording.since_target[rows, b], seen, protocol.threshold)
        if end.reached or end.time >= protocol.dwell:
            result.crossed[b, k], result.error[b, k], result.time[b, k] = end.reached, off[end.row], end.time
            result.true_error[b, k] = true_error[rows[end.row], b]
    return result


def measure_holds(
    arm: Arm, recording: Recording, targets: Array, protocol: Protocol, model: ToolModel | None = None
) -> Holds:
    """Results of a recording of the hold protocol with ``targets`` (B, K, 3) [m].

    Where nobody knows where the tool is, a ``model`` says how far it is from them.
    """
    tcp = encoder_tcp(arm, recording)
    error, true_error = _errors(arm, recording, tcp)
    shape = targets.shape[:2]
    result = Holds(
        settled=_unknown(shape), settled_true=_unknown(shape), oscillation=_unknown(shape),
        stay=_unknown((len(protocol.within), *shape)), away=_unknown((*shape, 3)), away_true=_unknown((*shape, 3)),
        modelled=_unknown((3, *shape)), turned=_unknown(shape),
    )  # fmt: skip
    posture = _unknown((*shape, arm.joints))
    for b, k, rows in _segments(recording, targets):
        since = recording.since_target[rows, b]
        if since[-1] < protocol.hold:
            continue
        result.settled[b, k] = settled(since, error[rows, b], protocol.window)
        result.settled_true[b, k] = settled(since, true_error[rows, b], protocol.window)
        result.turned[b, k] = settled(since, recording.turned[rows, b], protocol.window)
        last = rows[since > since[-1] - protocol.window]
        result.away[b, k] = (tcp[last, b] - recording.aim[last, b]).mean(axis=0)
        result.away_true[b, k] = (recording.true_tcp[last, b] - recording.target[last, b]).mean(axis=0)
        if np.isnan(result.away_true[b, k]).any():
            posture[b, k] = recording.position[last, b].mean(axis=0)
        result.oscillation[b, k] = oscillation(since, tcp[rows, b], protocol.window)
        for w, within in enumerate(protocol.within):
            result.stay[w, b, k] = stay_time(since, error[rows, b], within)
    if model is not None:
        result.modelled[:] = modelled(model, posture, targets)
    return result


def _errors(arm: Arm, recording: Recording, tcp: Array | None = None) -> tuple[Array, Array]:
    """Compute encoder error, from the aim, and true error, from the target, each (T, B) [m]."""
    tcp = encoder_tcp(arm, recording) if tcp is None else tcp
    return (
        np.linalg.norm(tcp - recording.aim, axis=-1),
        np.linalg.norm(recording.true_tcp - recording.target, axis=-1),
    )


def _segments(recording: Recording, targets: Array) -> list[tuple[int, int, NDArray[np.intp]]]:
    """Arm, target and rows of every target that was ever in force."""
    count, length = targets.shape[:2]
    found = []
    for b in range(count):
        rows = np.flatnonzero(recording.active[:, b])
        edges = np.searchsorted(recording.target_index[rows, b], np.arange(length + 1))
        found += [(b, k, rows[edges[k] : edges[k + 1]]) for k in range(length) if edges[k + 1] > edges[k]]
    return found


def _unknown(shape: tuple[int, ...]) -> Array:
    return np.full(shape, np.nan)
