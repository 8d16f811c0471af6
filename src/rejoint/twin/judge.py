"""How well twins predict new logs: open loop, motion by motion, free and in contact.

A twin is trusted only where joints moved, readings come often, on the commands' clock, and it is better than the
commands with any delay.

Candidates may be published parameter sets (docs/published): TOML with stiffness, damping, coulomb and armature, one
value or one per joint; the rest is optional.
"""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.logs.consistency import PLAUSIBLE, find_lag
from rejoint.logs.exclusions import Exclusions, find_exclusions, table_height
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import TOML_MOST, read_bounded
from rejoint.twin.judgement import (
    NO_TWIN,
    Errors,
    Judgement,
    MotionErrors,
    PredictionError,
    Trace,
    prediction_error,
    smaller,
)
from rejoint.twin.parameters import PARAMETERS, STICTION, Parameter, TwinParameters, unknown_prior, unpack
from rejoint.twin.replay import Replay, Window
from rejoint.twin.table import TablePlane
from rejoint.twin.twin import Twin

TIMESTEP = 0.010
"""[s]; measured: as good as a quarter of it"""

TRACE_ROWS = 2000
"""Rows of the residual for a figure; chosen"""


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A twin to judge."""

    name: str
    parameters: TwinParameters
    stiction: float = STICTION
    """friction at rest over friction in motion"""
    table: TablePlane | None = None
    """for contacts"""
    acceleration: float = np.inf
    """[rad/s^2] of references, while commands change"""

    @staticmethod
    def of(name: str, twin: Twin) -> Candidate:
        """Take all fields from a fitted twin."""
        return Candidate(
            name=name,
            parameters=twin.parameters,
            stiction=twin.stiction,
            table=twin.table,
            acceleration=twin.acceleration,
        )


def judge(
    arm: Arm,
    candidates: Sequence[Candidate],
    logs: Sequence[RunLog],
    *,
    table: float | None = None,
    timestep: float = TIMESTEP,
    threads: int = 1,
) -> Judgement:
    """Compare candidates, and no twin, on whole logs; ``table`` [m] is its height, default: found.

    InputError without a log or candidate, for equal names or another arm.
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
    """Predicted positions (T, n) [rad] in each log, no twin first."""
    for log in logs:
        log.require(arm.name, arm.joint_names)
    return {NO_TWIN: _no_twin(logs)} | {c.name: _paths(arm, c, logs, timestep, threads) for c in candidates}


def judge_paths(
    arm: Arm, paths: dict[str, list[Array]], logs: Sequence[RunLog], *, table: float | None = None
) -> Judgement:
    """Compare the result of `predict_logs` with the measurement."""
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
        doubts=tuple(doubts(arm, logs, rows, paths)),
        worst=_trace(arm, logs[worst], rows[worst], {name: path[worst] for name, path in paths.items()}),
    )


def _no_twin(logs: Sequence[RunLog]) -> list[Array]:
    return [log.command[np.maximum(np.arange(len(log)) - 1, 0)] for log in logs]  # row k is sent after its answer


def _paths(arm: Arm, candidate: Candidate, logs: Sequence[RunLog], timestep: float, threads: int) -> list[Array]:
    windows = [Window(log=i, first=0, last=len(log)) for i, log in enumerate(logs)]
    tables = [] if candidate.table is None else [candidate.table]
    paths: dict[int, Array] = {}
    # Motions of similar length together: a batch takes as long as its longest.
    order = sorted(range(len(logs)), key=lambda i: logs[i].time[-1] - logs[i].time[0])
    for start in range(0, len(order), 2 * threads):
        part = order[start : start + 2 * threads]
        chosen = [windows[i] for i in part]
        replay = Replay(arm, logs, chosen, timestep, threads, candidate.stiction, candidate.acceleration)
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
            name: Errors(
                **{
                    part: prediction_error(arm, path[rows], log.position[rows]) if rows.any() else None
                    for part, rows in parts.items()
                }
            )
            for name, path in paths.items()
        },
    )


def _mean(errors: Sequence[Errors]) -> Errors:
    def mean(parts: list[PredictionError | None]) -> PredictionError | None:
        known = [part for part in parts if part is not None]
        if not known:
            return None
        joints = np.mean([part.joints for part in known], axis=0)
        return PredictionError(
            joint=float(np.mean([part.joint for part in known])),
            joints=tuple(joints.tolist()),
            tcp=float(np.mean([part.tcp for part in known])),
        )

    return Errors(
        free=mean([e.free for e in errors]),
        contact=mean([e.contact for e in errors]),
        all=mean([e.all for e in errors]),
    )


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


MOVED = np.radians(2.0)
"""[rad] least travel of a moving joint; chosen"""
COARSEST = 0.1
"""[s] between readings up to which friction and lag show; chosen"""


def doubts(arm: Arm, logs: Sequence[RunLog], rows: Sequence[Exclusions], paths: dict[str, list[Array]]) -> list[str]:
    """Why no prediction is trusted; empty if one is."""
    found = []
    travel = max(float(np.ptp(log.position, axis=0).max()) for log in logs)
    if travel < MOVED:
        return [f"no joint moved by more than {np.degrees(travel):.2g} deg, expected at least {np.degrees(MOVED):g}"]
    period = float(np.median(np.concatenate([np.diff(log.time) for log in logs])))
    if period > COARSEST:
        found.append(f"readings are {period:.2g} s apart, expected at most {COARSEST:g} s")
    lags = [one for log in logs if (one := find_lag(log.time, log.position, log.command))]
    lag = float(np.median([one.best for one in lags])) if lags else 0.0
    sure = [one.plausible for one in lags if one.sure]
    if sure and not any(sure):
        found.append(
            f"the readings follow the commands by {lag:.2f} s, expected 0 to {PLAUSIBLE[1]:g} s: clocks differ"
        )
    twins = [paths[name] for name in list(paths)[1:]]
    delayed = [_delayed(log, lag) for log in logs]
    for name, without in (("the command", next(iter(paths.values()))), (f"the command {lag:.2f} s later", delayed)):
        if not any(_better(arm, logs, rows, twin, without) for twin in twins):
            found.append(f"no twin predicts measurably better than {name} does")
            break
    return found


def _delayed(log: RunLog, lag: float) -> Array:
    """Commands (T, n) [rad] in force ``lag`` [s] before each reading."""
    return np.asarray(
        log.command[np.clip(np.searchsorted(log.time, log.time - lag, side="right") - 1, 0, len(log) - 1)]
    )


def _better(
    arm: Arm, logs: Sequence[RunLog], rows: Sequence[Exclusions], twin: Sequence[Array], without: Sequence[Array]
) -> bool:

    def error(log: RunLog, path: Array, own: Exclusions) -> float:
        gap = tcp_position(arm, path[own.free]) - tcp_position(arm, log.position[own.free])
        return float(np.sqrt(np.mean(np.sum(gap**2, axis=-1))))

    known = [i for i, own in enumerate(rows) if own.free.any()]
    ours, theirs = (np.array([error(logs[i], path[i], rows[i]) for i in known]) for path in (twin, without))
    return smaller(ours, theirs)


def read_published(path: Path, arm: Arm) -> Candidate:
    """Read a published parameter set; FileError if wrong."""
    remedy, reached = "docs/published holds examples", unpack(unknown_prior(arm).upper, arm.joints)
    try:
        data = tomllib.loads(read_bounded(path, TOML_MOST, remedy).decode())
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "check the path") from error
    except (OSError, UnicodeDecodeError, RecursionError, tomllib.TOMLDecodeError) as error:
        raise FileError(path, f"not a readable TOML file ({error})", remedy) from error
    # Where the wide ranges end, a limit is out of reach.
    known = {
        "name": path.stem,
        "source": "",
        "stiction": 1.0,
        "offset": 0.0,
        "compensation": 0.0,
        "delay": 0.0,
        "torque_limit": reached.torque_limit[0],
        "ramp_speed": float(reached.ramp_speed),
    } | data
    names = [p.name for p in PARAMETERS]
    missing, unknown = sorted(set(names) - set(known)), sorted(set(known) - {*names, "name", "source", "stiction"})
    if missing or unknown:
        what = f"no {', '.join(missing)}" if missing else f"unknown {', '.join(unknown)}"
        raise FileError(path, f"{what}; known: {', '.join(names)}", remedy)
    values = {p.name: _value(path, known[p.name], p, arm.joints) for p in PARAMETERS}
    stiction = float(_value(path, known["stiction"], PARAMETERS[-1], arm.joints))
    if not stiction >= 1.0:
        raise FileError(path, f"stiction is {stiction!r}, expected a number of at least 1", remedy)
    return Candidate(name=str(known["name"]), parameters=TwinParameters(**values), stiction=stiction)


def _value(path: Path, given: object, parameter: Parameter, joints: int) -> Array:
    shape, named = ((joints,), f"a list of {joints}") if parameter.per_joint else ((), "a number")
    try:
        found = np.array(np.broadcast_to(np.asarray(given, dtype=float), shape))
    except (TypeError, ValueError):
        found = np.full(shape, np.nan)
    if not np.isfinite(found).all() or (parameter.log and not (found > 0).all()):
        above = " above zero" if parameter.log else ""
        raise FileError(path, f"{parameter.name} is {given!r}, expected {named}{above}", "look at docs/published")
    return found
