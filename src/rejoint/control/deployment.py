"""Result per target of a deployment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.rotations import REACHED_TURN, Orientation
from rejoint.control.comparison.result import Protocol
from rejoint.control.correction import NOT_KNOWN, ToolModel, TrueError, mean_modelled, modelled
from rejoint.control.guard import Reason, Reasons, reason_names
from rejoint.control.recording import Recording, recording_of
from rejoint.control.targets import in_words
from rejoint.logs.runlog import RunLog

Rows = NDArray[np.intp]

REACHED = Protocol.threshold
"""[m]"""

_OFTEN = 0.5  # share of its cycles from which a remark names the guard (chosen)


@dataclass(frozen=True, kw_only=True, eq=False)
class Deployment:
    """Targets of a deployment."""

    controller: str
    targets: Array
    """(K, 3) [m]"""
    dwell: float
    """[s]"""
    within: float = REACHED
    """[m] accepted encoder error"""
    turns: Orientation | None = None
    """(K,); None: any"""


@dataclass(frozen=True, kw_only=True)
class Visit:
    """Result at one target."""

    target: tuple[float, float, float]
    """[m]"""
    error: float | None
    """[m] by the encoders; None: not tried"""
    true_error: TrueError
    reached: bool
    remark: str
    """why missed"""
    sightings: int = 0
    """accepted camera detections"""
    seen_error: float | None = None
    """[m] tool error by the camera; None: not seen"""
    orientation: str = ""
    """wanted, in words, or empty"""
    turned: float | None = None
    """[rad]"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Deployed:
    """Result of a deployment."""

    controller: str
    visits: tuple[Visit, ...]
    period: float | None
    """[s] median"""
    gaps: tuple[float, ...]
    """[s]"""
    log: RunLog | None = None
    """None: it ended early"""

    @property
    def missed(self) -> tuple[int, ...]:
        """Numbers of missed targets, from 1."""
        return tuple(number for number, visit in enumerate(self.visits, start=1) if not visit.reached)


def deployed_of(error: BaseException, arm: Arm, job: Deployment, model: ToolModel | None = None) -> Deployed | None:
    """Return result up to ``error``, or None."""
    partial = recording_of(error)
    if partial is None or not len(partial.time) or not np.isfinite(partial.target).any():
        return None
    return judge(arm, partial, job, model, ended=error)


def judge(
    arm: Arm,
    recording: Recording,
    job: Deployment,
    model: ToolModel | None = None,
    *,
    ended: BaseException | None = None,
) -> Deployed:
    """Judge each target; ``ended``: final error."""
    rows = np.flatnonzero(recording.active[:, 0])
    error = np.linalg.norm(recording.aim[:, 0] - tcp_position(arm, recording.position[:, 0]), axis=-1)
    gap = recording.gaps()
    visits = []
    for k, target in enumerate(job.targets):
        own = rows[recording.target_index[rows, 0] == k]
        last = ended is not None and k == int(recording.target_index[rows[-1], 0])
        visit = _visit(target, job, own, recording, error, gap, model, ended=last)
        visits.append(visit if job.turns is None else _posed(visit, job.turns[k], own, recording))
    lengths = tuple(float(value) for value in gap[gap > 0.0])
    period = recording.usual_period()
    usual = period if np.isfinite(period) else None
    return Deployed(controller=job.controller, visits=tuple(visits), period=usual, gaps=lengths)


def _visit(
    target: Array,
    job: Deployment,
    rows: Rows,
    recording: Recording,
    error: Array,
    gap: Array,
    model: ToolModel | None,
    *,
    ended: bool,
) -> Visit:
    x, y, z = (float(value) for value in target)
    if not len(rows):
        return Visit(target=(x, y, z), error=None, true_error=NOT_KNOWN, reached=False, remark="not tried")
    end = float(error[rows[-1]])
    reached = end < job.within and not ended
    remarks = ["ended early"] if ended else []
    if not reached and not ended:
        remarks.append(f"still {1e3 * end:.0f} mm off after {job.dwell:g} s{_held_back(recording.reasons[rows, 0])}")
    paused = float(gap[rows].max(initial=0.0))
    if paused > 0.0:
        remarks.append(f"no answers for {paused:.1f} s")
    return Visit(
        target=(x, y, z),
        error=end,
        true_error=_true_error(recording, int(rows[-1]), target, model),
        reached=reached,
        remark="; ".join(remarks),
    )


def _posed(visit: Visit, turn: Orientation, rows: Rows, recording: Recording) -> Visit:
    visit = replace(visit, orientation=in_words(turn))
    turned = float(recording.turned[rows[-1], 0]) if len(rows) else float("nan")
    if not np.isfinite(turned):
        return visit
    visit = replace(visit, turned=turned)
    if turned <= REACHED_TURN:
        return visit
    askew = f"still turned {np.degrees(turned):.0f} deg off"
    return replace(visit, reached=False, remark="; ".join(filter(None, (visit.remark, askew))))


def _true_error(recording: Recording, row: int, target: Array, model: ToolModel | None) -> TrueError:
    true = float(np.linalg.norm(target - recording.true_tcp[row, 0]))
    if np.isfinite(true):
        return TrueError(how="known", value=true)
    return NOT_KNOWN if model is None else mean_modelled(modelled(model, recording.position[row], target[None]))


def _held_back(reasons: Reasons) -> str:
    often = [
        reason_names(reason)[0]
        for reason in Reason
        if reason != Reason.GAP and np.mean((reasons & np.uint16(reason.value)) != 0) > _OFTEN
    ]
    return f", held back by its limits of {' and '.join(often)}" if often else ""
