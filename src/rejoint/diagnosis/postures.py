"""The postures in which a finding is turned into millimetres at the tool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.diagnosis.open_loop import settled_rows
from rejoint.logs.exclusions import Exclusions, joint_speed
from rejoint.logs.runlog import RunLog

AT_REST = 0.05
"""[rad/s] of the fastest joint and of the fastest command below which a row of a log counts as rest (chosen)"""

PER_LOG = 20
"""Postures of a log that are looked at, evenly over its rest (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Postures:
    """K postures in which an arm was asked to be still."""

    position: Array
    """(K, n) [rad] measured"""
    command: Array
    """(K, n) [rad]"""


def settled_postures(targets: RunLog) -> Postures:
    """Means over the settled end of every target; InputError if the log has no targets."""
    rows = settled_rows(targets)
    return Postures(
        position=np.array([targets.position[part].mean(axis=0) for part in rows]),
        command=np.array([targets.command[part].mean(axis=0) for part in rows]),
    )


def resting_postures(log: RunLog, excluded: Exclusions, *, stops: bool = False) -> Postures:
    """Rows of a log in which the free arm rests, evenly spread; none if it never does.

    With ``stops`` those at which something blocks a joint count too: a joint that is stuck everywhere
    looks as if it stood at a stop.
    """
    quiet = (joint_speed(log.time, log.command) < AT_REST) & (joint_speed(log.time, log.position) < AT_REST)
    usable = ~(excluded.contact | excluded.stale) if stops else excluded.free
    rows = np.flatnonzero(quiet & usable)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(PER_LOG, len(rows))).astype(int))] if len(rows) else rows
    return Postures(position=log.position[rows], command=log.command[rows])


def joined(parts: Sequence[Postures]) -> Postures:
    """Put the postures of several logs together."""
    return Postures(
        position=np.concatenate([part.position for part in parts]),
        command=np.concatenate([part.command for part in parts]),
    )
