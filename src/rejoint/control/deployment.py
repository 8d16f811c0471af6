"""Driving an arm to targets, and saying of each whether it was reached, and if not, why.

A target counts as reached where the encoders say so at the end of its time. Pauses in the answers on the way are told
beside it; where it was missed, so are the limits of the guard that kept the arm back. The target at which a run was
ended early does not count, and those after it were not tried.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.arms.orientation import REACHED_TURN, Orientation
from rejoint.control.accuracy import NOT_KNOWN, ToolModel, TrueError, mean_modelled, modelled
from rejoint.control.comparison.result import Protocol
from rejoint.control.contract import check_controller_period
from rejoint.control.controller import Controller
from rejoint.control.correction import Correction
from rejoint.control.guard import GuardLimits, Reason, Reasons, reason_names
from rejoint.control.loop import Schedule, run
from rejoint.control.poses import in_words
from rejoint.control.recording import OnCycle, Recording, recording_of
from rejoint.control.robot import Robot
from rejoint.control.start import Stance, begin
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.numbers import as_within

Rows = NDArray[np.intp]

REACHED = Protocol.threshold
"""[m] within which a target counts as reached"""

_OFTEN = 0.5  # share of its cycles from which the guard's part in a missed target is told (chosen)


@dataclass(frozen=True, kw_only=True, eq=False)
class Deployment:
    """What an arm is to do."""

    controller: str
    targets: Array
    """(K, 3) [m]"""
    dwell: float
    """[s] per target"""
    within: float = REACHED
    """[m] of encoder error at the end within which a target counts as reached"""
    turns: Orientation | None = None
    """(K,) how the tool is to be turned there; None where that does not matter"""

    def __post_init__(self) -> None:
        if not 0.0 < self.dwell < np.inf:
            raise InputError(f"deployment: a target has a positive, finite time in seconds, got {self.dwell}")
        as_within("deployment", self.within)


@dataclass(frozen=True, kw_only=True)
class Visit:
    """What became of one target."""

    target: tuple[float, float, float]
    """[m]"""
    error: float | None
    """[m] encoder error at the end; None where the arm was not sent there"""
    true_error: TrueError
    """error of the tool itself at the end, and how it is known"""
    reached: bool
    remark: str
    """why it was not reached, and what else is worth knowing; empty where there is nothing"""
    sightings: int = 0
    """of the tool near this target that were believed, where a camera watched"""
    seen_error: float | None = None
    """[m] error of the tool by the last of them, averaged; None where it was not seen"""
    orientation: str = ""
    """how the tool was to be turned, in words; empty where that did not matter"""
    turned: float | None = None
    """[rad] orientation error by the encoders at the end; None where none was asked for, or the arm was not sent"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Deployed:
    """What became of a deployment."""

    controller: str
    """what drove"""
    visits: tuple[Visit, ...]
    period: float | None
    """[s] middle of the measured control periods; None before there are any"""
    gaps: tuple[float, ...]
    """[s] lengths of the pauses in the answers after which the arm began slowly again"""
    log: RunLog | None = None
    """what the arm was told and what it did at the targets; None where the deployment ended early"""

    @property
    def missed(self) -> tuple[int, ...]:
        """Numbers of the targets, from 1, that were not reached."""
        return tuple(number for number, visit in enumerate(self.visits, start=1) if not visit.reached)


def deploy(
    robot: Robot, controller: Controller, job: Deployment, *, limits: GuardLimits | None = None,
    stance: Stance | None = None, correction: Correction | None = None, model: ToolModel | None = None,
    on_cycle: OnCycle | None = None,
) -> tuple[Recording, Deployed]:  # fmt: skip
    """Bring one arm to its rest posture, slowly, and then to the targets of ``job``.

    Raises what `run` raises, with what was done until then on the error, see `deployed_of`; ContractError where the
    measured control period does not suit a policy; NotReadyError where the arm had better not be driven, as where it
    does not stand at rest as its ``stance`` says. Where nobody knows where the tool is, a ``model`` says how far it is
    from its targets.
    """
    start = begin(robot, limits, stance)
    check_controller_period(controller, start.usual_period())
    schedule = Schedule(dwell=job.dwell, sent=start.command[-1])
    recording = run(
        robot, controller, job.targets[None], schedule, limits=limits, correction=correction, on_cycle=on_cycle,
        turns=job.turns and job.turns[None],
    )  # fmt: skip
    return recording, judge(robot.arm, recording, job, model)


def deployed_of(error: BaseException, arm: Arm, job: Deployment, model: ToolModel | None = None) -> Deployed | None:
    """Return what a deployment that ``error`` ended has done; None if it ended before the first target."""
    partial = recording_of(error)
    if partial is None or not len(partial.time) or not np.isfinite(partial.target).any():
        return None
    return judge(arm, partial, job, model, ended=error)


def judge(
    arm: Arm, recording: Recording, job: Deployment, model: ToolModel | None = None, *,
    ended: BaseException | None = None,
) -> Deployed:  # fmt: skip
    """Say what became of each target; ``ended`` is what ended the recording early."""
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
    target: Array, job: Deployment, rows: Rows, recording: Recording, error: Array, gap: Array,
    model: ToolModel | None, *, ended: bool,
) -> Visit:  # fmt: skip
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
        target=(x, y, z), error=end, true_error=_true_error(recording, int(rows[-1]), target, model), reached=reached,
        remark="; ".join(remarks),
    )  # fmt: skip


def _posed(visit: Visit, turn: Orientation, rows: Rows, recording: Recording) -> Visit:
    """Add how the tool was turned at the end."""
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
    """Tell how far the tool is from ``target`` (3,) [m] in a row."""
    true = float(np.linalg.norm(target - recording.true_tcp[row, 0]))
    if np.isfinite(true):
        return TrueError(how="known", value=true)
    return NOT_KNOWN if model is None else mean_modelled(modelled(model, recording.position[row], target[None]))


def _held_back(reasons: Reasons) -> str:
    """Name the limits of the guard that a target mostly met."""
    often = [
        reason_names(reason)[0]
        for reason in Reason
        if reason != Reason.GAP and np.mean((reasons & np.uint16(reason.value)) != 0) > _OFTEN
    ]
    return f", held back by its limits of {' and '.join(often)}" if often else ""
