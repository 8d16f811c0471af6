"""How well twins predict new logs: open loop, motion by motion, free and in contact.

A twin is trusted where joints moved, readings come often, on the commands' clock, and it beats the commands with any
delay.

Candidates may be published parameters (docs/published): TOML with stiffness, damping, coulomb and armature, one value
or one per joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from rejoint.arms import Arm, Array, tcp_position
from rejoint.control.correction import rms, tool_error
from rejoint.diagnosis.metrics import COARSEST
from rejoint.logs.columns import ZEROS
from rejoint.logs.consistency import PLAUSIBLE, find_lag
from rejoint.logs.exclusions import Exclusions, find_exclusions, table_height
from rejoint.logs.runlog import RunLog, similar_in_length
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import Number, Positive, Table, read_toml
from rejoint.system.records import value_type
from rejoint.twin.parameters import PARAMETERS, TwinParameters, unknown_prior, unpack
from rejoint.twin.replay import MOVED, Replay, Window, in_force
from rejoint.twin.twin import (
    HALVED,
    NO_TWIN,
    Errors,
    Judgement,
    MotionErrors,
    PredictionError,
    TablePlane,
    Twin,
    smaller,
)

TIMESTEP = 0.010
"""[s]; measured: as good as a quarter of it"""


@value_type
class Candidate:
    """A twin to judge."""

    name: str
    parameters: TwinParameters
    table: TablePlane | None = None
    """for contacts"""
    acceleration: float = np.inf
    """[rad/s^2] of references, while commands change"""
    gain: Array | None = None
    """(n,) P gain that the stiffness is for"""

    @staticmethod
    def of(name: str, twin: Twin) -> Candidate:
        """Take all fields from a fitted twin."""
        return Candidate(
            name=name,
            parameters=twin.parameters,
            table=twin.table,
            acceleration=twin.acceleration,
            gain=twin.gain,
        )


def predict_logs(arm: Arm, candidates: Sequence[Candidate], logs: Sequence[RunLog]) -> list[dict[str, Array]]:
    """Predicted positions (T, n) [rad] by name in each log, no twin first.

    InputError for equal names or another arm.
    """
    names = [NO_TWIN, *(c.name for c in candidates)]
    if len(set(names)) != len(names):
        raise InputError(
            f"replay: twins called {', '.join(names[1:])}; give each a name of its own, other than {NO_TWIN!r}"
        )
    found = [{NO_TWIN: in_force(log)} for log in logs]
    for alike in similar_in_length(logs):
        windows = [Window(log=logs[i], first=0, last=len(logs[i])) for i in alike]
        for c in candidates:
            replay = Replay(arm, windows, TIMESTEP, c.acceleration, c.gain)
            path = replay.predict(c.parameters.repeat(1), [c.table] if c.table else [])[0]
            for n, i in enumerate(alike):
                found[i][c.name] = path[replay.window == n]
    return found


def judge(arm: Arm, paths: list[dict[str, Array]], logs: Sequence[RunLog], *, table: float | None = None) -> Judgement:
    """Compare the result of `predict_logs` with whole logs; ``table`` [m] is its height, default: found."""
    table = table_height(arm, logs) if table is None else table
    excluded = find_exclusions(arm, logs, table)
    found = tuple(_motion(arm, *one) for one in zip(excluded, paths, strict=True))
    return Judgement(
        arm=arm.name,
        motions=found,
        mean={name: _mean([motion.errors[name] for motion in found]) for name in paths[0]},
        doubts=tuple(_doubts(arm, excluded, found)),
    )


def _motion(arm: Arm, rows: Exclusions, paths: dict[str, Array]) -> MotionErrors:
    log, period = rows.log, rows.log.duration / max(len(rows.log) - 1, 1)
    parts = {"free": rows.free, "contact": rows.contact & rows.readable, "all": rows.readable}

    measured = tcp_position(arm, log.position)

    def errors(path: Array) -> Errors:
        joint, tcp = path - log.position, tool_error(arm, path, measured)
        return Errors(
            **{
                part: PredictionError(joint=rms(joint[rows]), tcp=rms(tcp[rows])) if rows.any() else None
                for part, rows in parts.items()
            }
        )

    return MotionErrors(
        motion=log.label,
        seconds=log.duration,
        contact_seconds=parts["contact"].sum() * period,
        left_out_seconds=(~rows.readable).sum() * period,
        errors={name: errors(path) for name, path in paths.items()},
    )


def _mean(errors: Sequence[Errors]) -> Errors:
    def mean(part: str) -> PredictionError | None:
        known = [one for e in errors if (one := getattr(e, part)) is not None]
        if not known:
            return None
        return PredictionError(
            **{name: float(np.mean([getattr(one, name) for one in known])) for name in ("joint", "tcp")}
        )

    return Errors(**{part: mean(part) for part in ("free", "contact", "all")})


def _doubts(arm: Arm, excluded: Sequence[Exclusions], motions: Sequence[MotionErrors]) -> list[str]:
    logs = [rows.log for rows in excluded]
    found = sorted({log.extra[ZEROS] for log in logs if ZEROS in log.extra})
    measure = "joint" if found else "tcp"
    travel = max(np.ptp(log.position, axis=0).max() for log in logs)
    if travel < MOVED:
        return [f"no joint moved by more than {np.degrees(travel):.2g} deg, expected at least {np.degrees(MOVED):g}"]
    period = np.median(np.concatenate([np.diff(log.time) for log in logs]))
    if period > COARSEST:
        found.append(f"readings are {period:.3g} s apart, expected at most {COARSEST:g} s")
    lags = [one for log in logs if (one := find_lag(log.time, log.position, log.command))]
    lag = np.median([one.best for one in lags]) if lags else 0.0
    sure = [one.plausible for one in lags if one.sure]
    if sure and not any(sure):
        found.append(
            f"the readings follow the commands by {lag:.2f} s, expected 0 to {PLAUSIBLE[1]:g} s: clocks differ"
        )
    late = []
    for log, rows in zip(logs, excluded, strict=True):
        row = np.searchsorted(log.time, log.time - lag, side="right") - 1
        late.append(_motion(arm, rows, {"": log.command[np.clip(row, 0, len(log) - 1)]}))

    def errors(found: Sequence[MotionErrors], name: str) -> Array:
        return np.array([getattr(own, measure) for motion in found if (own := motion.errors[name].free)])

    command, *twins = (errors(motions, name) for name in motions[0].errors)
    for name, without in (("the command", command), (f"the command {lag:.2f} s later", errors(late, ""))):
        if not any(smaller(twin, without) for twin in twins):
            found.append(f"no twin predicts measurably better than {name} does")
            break
    if not any(smaller(HALVED * twin, command) for twin in twins):
        found.append("no twin measurably halves the distance between commands and motion")
    return found


Values = Positive | list[Positive]
"""Of all joints, or of each"""

AtLeastOne = Annotated[float, msgspec.Meta(ge=1.0)]


class PublishedSet(Table, kw_only=True):
    """A file of published parameters."""

    name: str = ""
    source: str = ""
    stiffness: Values
    damping: Values
    coulomb: Values
    armature: Values
    torque_limit: Values | None = None
    offset: Number | list[Number] = 0.0
    compensation: Number | list[Number] = 0.0
    load_friction: Number | list[Number] = 0.0
    delay: Number = 0.0
    ramp_speed: Positive | None = None
    stiction: AtLeastOne | list[AtLeastOne] = 1.0


def read_published(path: Path, arm: Arm) -> Candidate:
    """Read a published parameter set; FileError if wrong. A limit that is not given is out of reach."""
    found = read_toml(path, PublishedSet, "docs/published holds examples")
    reached, values = unpack(unknown_prior(arm).upper), {}
    for p in PARAMETERS:
        given, shape = getattr(found, p.name), (arm.joints,) if p.per_joint else ()
        try:
            values[p.name] = np.broadcast_to(getattr(reached, p.name) if given is None else given, shape)
        except ValueError as error:
            raise FileError(path, f"{p.name} is {given!r}, expected {shape}", "look at docs/published") from error
    return Candidate(name=found.name or path.stem, parameters=TwinParameters(**values))
