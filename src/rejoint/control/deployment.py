"""Result per target of a deployment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.rotations import REACHED_TURN, Orientation
from rejoint.control.comparison.result import Protocol
from rejoint.control.correction import NOT_KNOWN, ToolModel, TrueError, true_error
from rejoint.control.guard import Reason, Reasons, reason_names
from rejoint.control.recording import Recording, recording_of
from rejoint.control.targets import in_words
from rejoint.logs.runlog import RunLog
from rejoint.system.results import Readable

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
    error: float | None = None
    """[m] by the encoders; None: not tried"""
    true_error: TrueError = NOT_KNOWN
    reached: bool = False
    remark: str = "not tried"
    """why missed"""
    sightings: int = 0
    """accepted camera detections"""
    seen_error: float | None = None
    """[m] tool error by the camera; None: not seen"""
    orientation: str = ""
    """wanted, in words, or empty"""
    turned: float | None = None
    """[rad]"""


@dataclass(frozen=True, kw_only=True, eq=False, repr=False)
class Deployed(Readable):
    """Result of a deployment."""

    controller: str
    visits: tuple[Visit, ...]
    period: float | None
    """[s] median"""
    gaps: tuple[float, ...]
    """[s]"""
    within: float = REACHED
    """[m] accepted encoder error"""
    log: RunLog | None = None
    """None: it ended early"""

    @property
    def missed(self) -> tuple[int, ...]:
        """Numbers of missed targets, from 1."""
        return tuple(number for number, visit in enumerate(self.visits, start=1) if not visit.reached)

    @property
    def error(self) -> float:
        """[m] mean encoder error of the targets that were tried; NaN: none was."""
        errors = [visit.error for visit in self.visits if visit.error is not None]
        return sum(errors) / len(errors) if errors else np.nan


def deployed_of(error: BaseException, arm: Arm, job: Deployment, model: ToolModel | None = None) -> Deployed | None:
    """Return result up to ``error``, or None."""
    partial = recording_of(error)
    if partial is None or not np.isfinite(partial.target).any():
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
    errors = np.linalg.norm(recording.aim[:, 0] - tcp_position(arm, recording.position[:, 0]), axis=-1)
    gap, index, visits = recording.gaps(), recording.target_index[:, 0], list[Visit]()
    for k, target in enumerate(job.targets):
        words = "" if job.turns is None else in_words(job.turns[k])
        visits.append(Visit(target=tuple(target.tolist()), orientation=words))
        own = rows[index[rows] == k]
        if not len(own):
            continue
        row, early = int(own[-1]), ended is not None and k == index[rows[-1]]
        error, turned, paused = float(errors[row]), float(recording.turned[row, 0]), float(gap[own].max())
        far, askew = not error < job.within, job.turns is not None and turned > REACHED_TURN
        remarks = {
            "ended early": early,
            f"still {1e3 * error:.0f} mm off after {job.dwell:g} s{_held_back(recording.reasons[own, 0])}": far
            and not early,
            f"no answers for {paused:.1f} s": paused > 0.0,
            f"still turned {np.degrees(turned):.0f} deg off": askew,
        }
        true = np.linalg.norm(target - recording.true_tcp[row], axis=-1)
        visits[k] = replace(
            visits[k],
            error=error,
            true_error=true_error(true, model, recording.position[row], target[None]),
            reached=not (far or early or askew),
            remark="; ".join(remark for remark, said in remarks.items() if said),
            turned=None if job.turns is None or np.isnan(turned) else turned,
        )
    period = recording.usual_period()
    return Deployed(
        controller=job.controller,
        visits=tuple(visits),
        period=period if np.isfinite(period) else None,
        gaps=tuple(gap[gap > 0.0].tolist()),
        within=job.within,
    )


def _held_back(reasons: Reasons) -> str:
    often = [
        reason_names(reason)[0]
        for reason in Reason
        if reason != Reason.GAP and np.mean((reasons & reason) != 0) > _OFTEN
    ]
    return f", held back by its limits of {' and '.join(often)}" if often else ""
