"""How well twins predict logs that they were not fitted to: open loop, motion by motion, free and in contact apart.

Every motion is replayed whole, from its first measured pose. Joints at stops and dead readings count
nowhere. The tool's error is that of forward kinematics of the encoders: what lies behind them no log shows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.logs.exclusions import Exclusions, Rows, find_exclusions, table_height
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.twin.doubts import doubts
from rejoint.twin.judgement import NO_TWIN, Error, Errors, Judgement, MotionErrors, Trace
from rejoint.twin.parameters import STICTION, TwinParameters
from rejoint.twin.prediction import prediction_error
from rejoint.twin.repeatability import repeatability
from rejoint.twin.replay import Replay, Window
from rejoint.twin.table import TablePlane
from rejoint.twin.twin import Twin

TIMESTEP = 0.010
"""[s] as good as a quarter of it on a real low-cost arm (measured)"""

TRACE_ROWS = 2000
"""Rows of the residual over time that a figure needs (chosen)"""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A twin that is to be judged."""

    name: str
    parameters: TwinParameters
    stiction: float = STICTION
    """friction at rest over friction in motion"""
    table: TablePlane | None = None
    """where contacts are to be predicted too"""
    acceleration: float = np.inf
    """[rad/s^2] of the servos' references, while commands keep changing"""

    @staticmethod
    def of(name: str, twin: Twin) -> Candidate:
        """Take everything from a fitted twin."""
        return Candidate(
            name=name, parameters=twin.parameters, stiction=twin.stiction, table=twin.table,
            acceleration=twin.acceleration,
        )  # fmt: skip


def judge(
    arm: Arm,
    candidates: Sequence[Candidate],
    logs: Sequence[RunLog],
    *,
    table: float | None = None,
    timestep: float = TIMESTEP,
    threads: int = 1,
) -> Judgement:
    """Compare candidates, and no twin at all, on whole logs; ``table`` [m] is its height, found if not given.

    InputError where there is no log or no candidate, names are not unique, or a log is of another arm.
    """
    names = [NO_TWIN, *(c.name for c in candidates)]
    if not logs or not candidates or len(set(names)) != len(names):
        raise InputError(
            f"replay: {len(logs)} logs and twins called {', '.join(names[1:])}; needs one of each at least"
        )
    return judge_paths(arm, predict_logs(arm, candidates, logs, timestep, threads), logs, table=table)


def predict_logs(
    arm: Arm, candidates: Sequence[Candidate], logs: Sequence[RunLog], timestep: float = TIMESTEP, threads: int = 1
) -> dict[str, list[Array]]:
    """Positions (T, n) [rad] in each log by the name of what predicts them, no twin first."""
    for log in logs:
        log.require(arm.name, arm.joint_names)
    return {NO_TWIN: _no_twin(logs)} | {c.name: _paths(arm, c, logs, timestep, threads) for c in candidates}


def judge_paths(
    arm: Arm, paths: dict[str, list[Array]], logs: Sequence[RunLog], *, table: float | None = None
) -> Judgement:
    """Compare what `predict_logs` returned with what was measured; ``table`` as for `judge`."""
    table = table_height(arm, logs) if table is None else table
    rows = find_exclusions(arm, logs, table)
    names = list(paths)
    found = tuple(
        _motion(arm, log, excluded, {name: path[i] for name, path in paths.items()})
        for i, (log, excluded) in enumerate(zip(logs, rows, strict=True))
    )
    worst = int(np.argmax([_tcp(motion.errors[names[1]]) for motion in found]))
    return Judgement(
        arm=arm.name,
        joint_names=arm.joint_names,
        table_height=table,
        motions=found,
        mean={name: _mean([motion.errors[name] for motion in found]) for name in names},
        repeatability=repeatability(arm, logs, [r.free for r in rows]),
        doubts=tuple(doubts(arm, logs, rows, paths)),
        worst=_trace(arm, logs[worst], rows[worst], {name: path[worst] for name, path in paths.items()}),
    )


def _no_twin(logs: Sequence[RunLog]) -> list[Array]:
    return [log.command[np.maximum(np.arange(len(log)) - 1, 0)] for log in logs]  # row k is sent after its answer


def _paths(arm: Arm, candidate: Candidate, logs: Sequence[RunLog], timestep: float, threads: int) -> list[Array]:
    """Positions (T, n) [rad] of one candidate in each log."""
    windows = [Window(log=i, first=0, last=len(log)) for i, log in enumerate(logs)]
    on_table, tables = candidate.table is not None, [] if candidate.table is None else [candidate.table]
    paths: dict[int, Array] = {}
    # Motions of similar length together: a batch takes as long as its longest.
    order = sorted(range(len(logs)), key=lambda i: logs[i].time[-1] - logs[i].time[0])
    for start in range(0, len(order), 2 * threads):
        part = order[start : start + 2 * threads]
        chosen = [windows[i] for i in part]
        replay = Replay(arm, logs, chosen, timestep, threads, candidate.stiction, on_table=on_table,
                        acceleration=candidate.acceleration)  # fmt: skip
        found = replay.predict(candidate.parameters.repeat(1), tables)
        paths |= {i: path[0] for i, path in zip(part, found, strict=True)}
    return [paths[i] for i in range(len(logs))]


def _motion(arm: Arm, log: RunLog, rows: Exclusions, paths: dict[str, Array]) -> MotionErrors:
    period = float(log.time[-1] - log.time[0]) / max(len(log) - 1, 1)
    parts = {"free": rows.free, "contact": rows.contact & rows.readable, "all": rows.readable}
    return MotionErrors(
        motion=log.label,
        seconds=float(log.time[-1] - log.time[0]),
        contact_seconds=float(parts["contact"].sum()) * period,
        left_out_seconds=float((~rows.readable).sum()) * period,
        errors={
            name: Errors(**{part: _error(arm, path, log.position, where) for part, where in parts.items()})
            for name, path in paths.items()
        },
    )


def _error(arm: Arm, predicted: Array, measured: Array, rows: Rows) -> Error | None:
    if not rows.any():
        return None
    found = prediction_error(arm, predicted[rows], measured[rows])
    return Error(joint=found.joint, joints=tuple(found.joints.tolist()), tcp=found.tcp)


def _mean(errors: Sequence[Errors]) -> Errors:
    def mean(parts: list[Error | None]) -> Error | None:
        known = [part for part in parts if part is not None]
        if not known:
            return None
        joints = np.mean([part.joints for part in known], axis=0)
        return Error(
            joint=float(np.mean([part.joint for part in known])),
            joints=tuple(joints.tolist()),
            tcp=float(np.mean([part.tcp for part in known])),
        )

    return Errors(free=mean([e.free for e in errors]), contact=mean([e.contact for e in errors]),
                  all=mean([e.all for e in errors]))  # fmt: skip


def _tcp(errors: Errors) -> float:
    known = errors.free or errors.all
    return 0.0 if known is None else known.tcp


def _trace(arm: Arm, log: RunLog, rows: Exclusions, paths: dict[str, Array]) -> Trace:
    shown = np.unique(np.linspace(0, len(log) - 1, min(TRACE_ROWS, len(log))).astype(int))
    measured = tcp_position(arm, log.position[shown])
    gaps = {n: np.linalg.norm(tcp_position(arm, path[shown]) - measured, axis=1) for n, path in paths.items()}
    first = list(paths)[1]
    return Trace(
        motion=log.label,
        time=tuple((log.time[shown] - log.time[0]).tolist()),
        contact=tuple(rows.contact[shown].tolist()),
        tcp={name: tuple(gap.tolist()) for name, gap in gaps.items()},
        joints=tuple(tuple(row) for row in (paths[first] - log.position)[shown].T.tolist()),
    )
