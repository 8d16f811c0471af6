"""What the diagnosis measured open loop, as trials of the default controller: it is not driven again for a comparison.

An arm that is told once where to go does the same whoever tells it, and the diagnosis holds each target for as long as
a race does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.accuracy import ToolModel
from rejoint.control.comparison.driven import Driven, measure
from rejoint.control.comparison.holding import errors_of
from rejoint.control.comparison.protocols import Holds
from rejoint.control.comparison.result import Protocol, TargetErrors
from rejoint.control.default import DefaultController
from rejoint.control.recording import Recording
from rejoint.logs.runlog import RunLog, read_log
from rejoint.runs.run import Run

DEFAULT = DefaultController.name
"""Name of the controller"""


@dataclass(frozen=True, kw_only=True, eq=False)
class OpenLoopTrials:
    """Ten targets, each sent once."""

    targets: Array
    """(K, 3) [m]"""
    driven: Driven
    """as the holds of a race, at its first set"""
    holds: Holds
    """of them"""
    log: RunLog
    """as that of a trial of the hold protocol"""

    def errors(self) -> TargetErrors:
        """Errors of the arm as it was found."""
        return errors_of(self.holds.settled, self.holds.settled_true, self.holds.modelled)


def open_loop(run: Run, robot: str, protocol: Protocol, model: ToolModel | None = None) -> OpenLoopTrials | None:
    """Return what the diagnosis of a run found; None where it was of another robot, or does not suit the protocol.

    ``model`` says how far the tool was from its targets, where nobody knows.
    """
    path = run.folder.log("targets")
    if robot != run.robot or not path.exists():
        return None
    return trials(run.arm, read_log(path), protocol, model)


def trials(arm: Arm, log: RunLog, protocol: Protocol, model: ToolModel | None = None) -> OpenLoopTrials | None:
    """Judge the log of an open-loop run as the comparison judges its own; None where its holds are too short."""
    recording, targets = _recording(log)
    found = measure(
        arm, recording, targets[None], protocol, controller=DEFAULT, kind="hold", places=((0, 0),), model=model,
        both=True,
    )  # fmt: skip
    if found.holds is None or not np.isfinite(found.holds.settled).all():
        return None
    return OpenLoopTrials(
        targets=targets, driven=found, holds=found.holds, log=replace(log, label=f"hold/{DEFAULT}/0/0")
    )


def _recording(log: RunLog) -> tuple[Recording, Array]:
    """Return a log as what the control loop would have recorded, and its targets (K, 3) [m] in their order."""
    known = np.isfinite(log.target).all(axis=1)
    rows = np.flatnonzero(known)
    target, time = log.target[rows], log.time[rows]
    index = np.concatenate([[0], np.cumsum((target[1:] != target[:-1]).any(axis=1))])
    first = np.searchsorted(index, np.arange(index[-1] + 1))
    begun = time[np.maximum(first - 1, 0)]  # a target comes into force after the last row of the one before
    count = len(rows)
    return Recording(
        arm=log.arm, joint_names=log.joint_names, robot=log.robot, controller=DEFAULT, time=time[:, None],
        position=log.position[rows][:, None], command=log.command[rows][:, None], target=target[:, None],
        aim=target[:, None].copy(), target_index=index[:, None].astype(np.intp),
        since_target=(time - begun[index])[:, None], true_tcp=log.true_tcp[rows][:, None],
        active=np.ones((count, 1), dtype=bool), reasons=np.zeros((count, 1), dtype=np.uint16),
        load=np.full((count, 1, log.position.shape[1]), np.nan), turned=np.full((count, 1), np.nan),
        tripped=np.zeros(1, dtype=np.uint16),
    ), target[first]  # fmt: skip
