"""Ten targets open loop: tool errors at rest (Park et al. 2024, Figs. 8 and 9)."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array, Index, tcp_position
from rejoint.control.correction import NOT_KNOWN, ToolModel, TrueError, mean_modelled, modelled
from rejoint.diagnosis.regression import mean_of
from rejoint.logs.exclusions import Exclusions, joint_speed
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.records import value_type
from rejoint.system.statistics import Estimate

TARGETS = 10
"""Park et al. 2024, section IV-A"""

DWELL = 4.5
"""[s] per target; chosen: a worn arm rests after 3 s"""

SETTLED = 1.0
"""[s] at the end of each target for its error; chosen"""


@value_type
class TargetError:
    """One target."""

    target_mm: tuple[float, float, float]
    error_mm: float
    """settled, by encoders"""
    sag_mm: float
    """downward part; negative: too high"""
    true_error_mm: float | None
    """of the tool itself"""


@value_type
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


def settled_rows(log: RunLog) -> list[Index]:
    """Rows of the last second of every target; InputError without targets."""
    known = np.asarray(np.isfinite(log.target).all(axis=1))
    if not known.any():
        raise InputError(f"run log {log.label} holds no targets; record one with `rejoint diagnose`")
    visits = (visit for visit in log.visits() if known[visit[0]])
    return [visit[log.time[visit] >= log.time[visit[-1]] - SETTLED] for visit in visits]


def open_loop_errors(arm: Arm, log: RunLog) -> OpenLoop:
    """Judge the log of an open-loop run."""
    rows, tcp = settled_rows(log), tcp_position(arm, log.position)

    def apart(one: Array, other: Array) -> Array:
        """Mean distances [mm] at the targets."""
        return 1e3 * np.array([np.linalg.norm(one[part] - other[part], axis=1).mean() for part in rows])

    errors, truth = apart(log.target, tcp), apart(log.target, log.true_tcp)
    known = np.isfinite(truth).all()
    found = [
        TargetError(
            target_mm=tuple((1e3 * log.target[part[0]]).tolist()),
            error_mm=float(error),
            sag_mm=1e3 * float((log.target[part] - tcp[part])[:, 2].mean()),
            true_error_mm=float(true) if known else None,
        )
        for part, error, true in zip(rows, errors, truth, strict=True)
    ]
    return OpenLoop(
        targets=tuple(found),
        error_mm=mean_of(errors),
        spread_mm=float(errors.std(ddof=1)) if len(errors) > 1 else 0.0,
        true_error_mm=mean_of(truth) if known else None,
        hidden_mm=float(apart(tcp, log.true_tcp).mean()) if known else None,
    )


def modelled_errors(log: RunLog, model: ToolModel) -> TrueError:
    """Mean true error by a later model of the arm."""
    target = np.stack([log.target[part[0]] for part in settled_rows(log)])
    return mean_modelled(modelled(model, settled_postures(log)[0], target))


AT_REST = 0.05
"""[rad/s] of the fastest joint and command at rest; chosen"""

PER_LOG = 20
"""Postures taken from each log; chosen"""


Postures = Array
"""(2, K, n) [rad] K postures of rest: measured, and commanded"""


def settled_postures(targets: RunLog) -> Postures:
    """Means over each target's settled end; InputError without targets."""
    rows = settled_rows(targets)
    return np.array([[joints[part].mean(axis=0) for part in rows] for joints in (targets.position, targets.command)])


def resting_postures(log: RunLog, excluded: Exclusions, *, stops: bool = False) -> Postures:
    """Evenly spread rows of the free arm at rest; with ``stops`` also blocked ones."""
    quiet = (joint_speed(log.time, log.command) < AT_REST) & (joint_speed(log.time, log.position) < AT_REST)
    usable = ~(excluded.contact | excluded.stale) if stops else excluded.free
    rows = np.flatnonzero(quiet & usable)
    rows = rows[np.linspace(0, len(rows) - 1, min(PER_LOG, len(rows))).astype(int)]
    return np.array([log.position[rows], log.command[rows]])
