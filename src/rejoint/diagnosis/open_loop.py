"""Ten targets open loop: tool errors at rest (Park et al. 2024, Figs. 8 and 9)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.correction import NOT_KNOWN, ToolModel, TrueError, mean_modelled, modelled
from rejoint.diagnosis.regression import mean_of
from rejoint.logs.exclusions import Exclusions, joint_speed
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.statistics import Estimate

TARGETS = 10
"""Park et al. 2024, section IV-A"""

DWELL = 5.0
"""[s] per target; chosen: a worn arm rests after 3 s"""

SETTLED = 1.0
"""[s] at the end of each target for its error; chosen"""


@dataclass(frozen=True, kw_only=True)
class TargetError:
    """One target."""

    target_mm: tuple[float, float, float]
    error_mm: float
    """settled, by encoders"""
    sag_mm: float
    """downward part; negative: too high"""
    true_error_mm: float | None
    """of the tool itself"""


@dataclass(frozen=True, kw_only=True)
class OpenLoop:
    """Ten targets."""

    targets: tuple[TargetError, ...]
    error_mm: Estimate
    """mean, 95 % interval"""
    spread_mm: float
    """standard deviation"""
    true_error_mm: Estimate | None
    hidden_mm: float | None
    """between tool and encoders; None: unknown"""

    @property
    def true_error(self) -> TrueError:
        """Mean true error over the targets, and its source."""
        return NOT_KNOWN if self.true_error_mm is None else TrueError.of("known", self.true_error_mm, unit=1e-3)


def settled_rows(log: RunLog) -> list[NDArray[np.intp]]:
    """Rows of the last second of every target; InputError without targets."""
    known = np.asarray(np.isfinite(log.target).all(axis=1))
    if not known.any():
        raise InputError(f"run log {log.label} holds no targets; record one with `rejoint diagnose`")
    change = (log.target[1:] != log.target[:-1]).any(axis=1)
    parts = np.split(np.arange(len(log)), np.flatnonzero(change) + 1)
    return [part[log.time[part] >= log.time[part[-1]] - SETTLED] for part in parts if known[part[0]]]


def open_loop_errors(arm: Arm, log: RunLog) -> OpenLoop:
    """Judge the log of an open-loop run."""
    rows, hidden, found = settled_rows(log), [], []
    for part in rows:
        tcp = tcp_position(arm, log.position[part])
        miss = log.target[part] - tcp
        true = float(np.linalg.norm(log.target[part] - log.true_tcp[part], axis=1).mean()) * 1e3
        hidden.append(float(np.linalg.norm(tcp - log.true_tcp[part], axis=1).mean()) * 1e3)
        x, y, z = (float(value) * 1e3 for value in log.target[part[0]])
        found.append(
            TargetError(
                target_mm=(x, y, z),
                error_mm=float(np.linalg.norm(miss, axis=1).mean()) * 1e3,
                sag_mm=float(miss[:, 2].mean()) * 1e3,
                true_error_mm=true if np.isfinite(true) else None,
            )
        )
    errors = np.array([target.error_mm for target in found])
    truth = [target.true_error_mm for target in found if target.true_error_mm is not None]
    return OpenLoop(
        targets=tuple(found),
        error_mm=mean_of(errors),
        spread_mm=float(errors.std(ddof=1)) if len(errors) > 1 else 0.0,
        true_error_mm=mean_of(np.array(truth)) if truth else None,
        hidden_mm=float(np.mean(hidden)) if truth else None,
    )


def modelled_errors(log: RunLog, model: ToolModel) -> TrueError:
    """Mean true error by a later model of the arm."""
    rows = settled_rows(log)
    position = np.stack([log.position[part].mean(axis=0) for part in rows])
    return mean_modelled(modelled(model, position, np.stack([log.target[part[0]] for part in rows])))


AT_REST = 0.05
"""[rad/s] of the fastest joint and command at rest; chosen"""

PER_LOG = 20
"""Postures taken from each log; chosen"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Postures:
    """K postures of rest."""

    position: Array
    """(K, n) [rad] measured"""
    command: Array
    """(K, n) [rad]"""


def settled_postures(targets: RunLog) -> Postures:
    """Means over each target's settled end; InputError without targets."""
    rows = settled_rows(targets)
    return Postures(
        position=np.array([targets.position[part].mean(axis=0) for part in rows]),
        command=np.array([targets.command[part].mean(axis=0) for part in rows]),
    )


def resting_postures(log: RunLog, excluded: Exclusions, *, stops: bool = False) -> Postures:
    """Evenly spread rows of the free arm at rest; with ``stops`` also blocked ones."""
    quiet = (joint_speed(log.time, log.command) < AT_REST) & (joint_speed(log.time, log.position) < AT_REST)
    usable = ~(excluded.contact | excluded.stale) if stops else excluded.free
    rows = np.flatnonzero(quiet & usable)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(PER_LOG, len(rows))).astype(int))] if len(rows) else rows
    return Postures(position=log.position[rows], command=log.command[rows])


def joined(parts: Sequence[Postures]) -> Postures:
    """Join the postures of several logs."""
    return Postures(
        position=np.concatenate([part.position for part in parts]),
        command=np.concatenate([part.command for part in parts]),
    )
