"""Moving targets on fresh arms: each is diagnosed and identified, then follows paths; finished blocks are kept."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path as FilePath

import numpy as np

from rejoint.arms import Arm
from rejoint.control.comparison.result import Columns
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.loop import Schedule, run
from rejoint.control.moving.drive import Along, Repetition, judge, missed
from rejoint.control.moving.posture import PathPostures, Servos, home_of
from rejoint.control.moving.reference import (
    LAG,
    LEAD_IN,
    STANDARD,
    Guide,
    Path,
    PathReference,
    Stream,
    standard_path,
)
from rejoint.control.moving.tracker import Tracker
from rejoint.control.recording import Recording
from rejoint.system.progress import Progress, part
from rejoint.system.statistics import Spread, spread
from rejoint.twin.twin import Twin
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from rejoint_lab.research.evaluation.family import ArmFamily, keep, own_twins

RATE = 30.0
"""[Hz] of a path's setpoints where it is not known ahead"""
REPETITIONS = 10
BLOCK = 5
"""Arms that move side by side (chosen)"""
SENT, HEALTHY, KNOWN, STREAM = "worn, sent as it comes", "healthy, sent as it comes", "known ahead", "as it goes, 30 Hz"
REPEATED = f"time {REPETITIONS} of one path"
CASES = (HEALTHY, SENT, KNOWN, REPEATED, STREAM)


@dataclass(frozen=True, kw_only=True)
class MovingRow:
    """One case on one path, over the arms: rms errors."""

    case: str
    path: str
    error: Spread
    """[m] after the best single lag for online paths"""
    largest: float
    """[m] largest error of any arm at any time"""
    lag: float
    """[s] median"""
    stopped: int


def evaluate_moving(arm: Arm, family: ArmFamily, out: FilePath, on_progress: Progress) -> list[MovingRow]:
    """Let every arm follow the standard paths in all cases; resumes in ``out``."""
    parts = []
    for first in range(0, family.arms, BLOCK):
        seeds = family.wear_seeds[first : first + BLOCK]
        ahead = part(on_progress, first / family.arms, (first + len(seeds)) / family.arms)
        twins = partial(own_twins, arm, seeds, out, family.seed, part(ahead, 0.0, 0.5))
        identity = repr((arm.name, seeds, CASES))
        file = out / "moving" / f"{seeds[0]}-{seeds[-1]}.parquet"
        parts.append(keep(file, identity, partial(_follow, arm, seeds, twins, family.threads, part(ahead, 0.5, 1.0))))
    found = {name: np.concatenate([one[name] for one in parts]) for name in parts[0]}
    return [_row(case, path, found) for case in CASES for path in STANDARD]


def _follow(
    arm: Arm, seeds: Sequence[int], twins: Callable[[], list[Twin]], threads: int, on_progress: Progress
) -> Columns:
    """Follow all paths with each arm in all cases; returns errors (A P, C)."""
    pairs = [(twin.parameters, seed, name) for twin, seed in zip(twins(), seeds, strict=True) for name in STANDARD]
    servos = Servos(**{f.name: np.stack([getattr(twin, f.name) for twin, *_ in pairs]) for f in fields(Servos)})
    paths = [standard_path(name, arm, seed) for _, seed, name in pairs]  # random ones differ from arm to arm
    home, driven = home_of(arm, servos), dict[str, Recording]()

    def drive(case: str, profile: str, guides: Sequence[Guide], *, tracks: bool = True, noise: int = 0) -> Recording:
        on_progress(len(driven) / len(CASES), case)
        near = home if tracks else None
        start = PathPostures(arm, np.stack([path.place[0] for path in paths]), home=near).last
        wears = [load_wear(profile.format(seed), arm) for _, seed, _ in pairs]
        robot = EmulatedRobot(arm, wears, seed=seeds[0] + noise, start=start, threads=threads)
        plan = Schedule(dwell=LEAD_IN + LAG + max(path.duration for path in paths), sent=start, keep_going=True)
        controller = Tracker(arm, servos) if tracks else DefaultController(arm)
        driven[case] = run(robot, controller, PathReference(arm, guides, near), plan)
        return driven[case]

    worn = "worn?seed={}"
    drive(HEALTHY, "healthy", paths, tracks=False)
    drive(SENT, worn, paths, tracks=False)
    known, lessons = paths, [Repetition(path) for path in paths]
    for time in range(REPETITIONS):
        recording = drive(REPEATED if time else KNOWN, worn, known, noise=time)  # the last time counts
        known = [
            replace(path, aim=lesson.learn(one.aimed, *missed(arm, recording, path, b)))
            for b, (path, one, lesson) in enumerate(zip(paths, known, lessons, strict=True))
        ]
    drive(STREAM, worn, [played(path, RATE) for path in paths])
    found = [[judge(arm, driven[case], path, b).encoder for case in CASES] for b, path in enumerate(paths)]
    errors = {f.name: np.array([[getattr(one, f.name) for one in row] for row in found]) for f in fields(Along)}
    return errors | {"stopped": np.array([driven[case].tripped > 0 for case in CASES], dtype=float).T}


def played(path: Path, rate: float) -> Stream:
    """Play the places of a path as a stream of ``rate`` [Hz], after a rest."""
    times = np.concatenate([[0.0], np.arange(LEAD_IN, LEAD_IN + path.duration + 1.0 / rate, 1.0 / rate)])
    return Stream(time=times.tolist(), rows=list(path.at(times - LEAD_IN)))


def _row(case: str, path: str, found: Columns) -> MovingRow:
    own = {name: values[STANDARD.index(path) :: len(STANDARD), CASES.index(case)] for name, values in found.items()}
    after = "_after" * (case == STREAM)
    error = spread(own[f"rms{after}"], np.arange(len(own["lag"])))
    assert error is not None  # noqa: S101 - every arm has an error along the way
    largest, lag, stopped = own[f"largest{after}"].max(), np.median(own["lag"]), own["stopped"].sum()
    return MovingRow(case=case, path=path, error=error, largest=float(largest), lag=float(lag), stopped=int(stopped))


def moving_table(rows: Sequence[MovingRow]) -> tuple[str, list[str], list[list[str]]]:
    """Title, headers and rows: mean (95th percentile) over the arms in mm."""
    title = (
        f"{rows[0].error.count} arms: root mean square encoder error along the way in mm, mean over the arms (95th "
        "percentile); as it goes: after the best single lag"
    )
    cells = [
        [case, *(f"{1e3 * row.error.mean.value:.2f} ({1e3 * row.error.p95:.2f})" for row in rows if row.case == case)]
        for case in CASES
    ]
    return title, ["case", *STANDARD], cells
