"""Moving targets on fresh arms: each is diagnosed and identified, then follows paths; the twins are kept."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path as FilePath

import numpy as np

from rejoint.arms import Arm
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.loop import Schedule, run
from rejoint.control.moving.drive import Along, Repetition, judge, missed
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
from rejoint.control.moving.tracker import PathPostures, Servos, Tracker, command_for, home_of
from rejoint.control.recording import Recording
from rejoint.system.progress import Progress, part
from rejoint.system.statistics import Spread, spread
from rejoint.twin.twin import Twin
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from rejoint_lab.research.evaluation.family import ArmFamily, own_twins

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
    """Let every arm follow the standard paths in all cases; twins are kept in ``out``."""
    found: dict[str, list[tuple[Along, bool]]] = {case: [] for case in CASES}
    for first in range(0, family.arms, BLOCK):
        seeds = family.wear_seeds[first : first + BLOCK]
        ahead = part(on_progress, first / family.arms, (first + len(seeds)) / family.arms)
        twins = own_twins(arm, seeds, out, family.seed, part(ahead, 0.0, 0.5))
        for case, errors in _follow(arm, seeds, twins, family.threads, part(ahead, 0.5, 1.0)).items():
            found[case] += errors
    each = len(STANDARD)
    return [_row(case, path, found[case][i::each]) for case in CASES for i, path in enumerate(STANDARD)]


def _follow(
    arm: Arm, seeds: Sequence[int], twins: Sequence[Twin], threads: int, on_progress: Progress
) -> dict[str, list[tuple[Along, bool]]]:
    """Follow all paths with each arm; returns errors, and whether the guard stopped it, of each case."""
    pairs = [(twin.parameters, seed, name) for twin, seed in zip(twins, seeds, strict=True) for name in STANDARD]
    servos = Servos(**{f.name: np.stack([getattr(twin, f.name) for twin, *_ in pairs]) for f in fields(Servos)})
    paths = [standard_path(name, arm, seed) for _, seed, name in pairs]  # random ones differ from arm to arm
    home, driven = home_of(arm, servos), dict[str, Recording]()

    def drive(case: str, profile: str, guides: Sequence[Guide], *, tracks: bool = True, noise: int = 0) -> Recording:
        on_progress(len(driven) / len(CASES), case)
        near = home if tracks else None
        start = PathPostures(arm, np.stack([path.place[0] for path in paths]), home=near).last
        wears = [load_wear(profile.format(seed), arm) for _, seed, _ in pairs]
        robot = EmulatedRobot(arm, wears, seed=seeds[0] + noise, start=start, threads=threads)
        sent = command_for(arm, servos, np.repeat(start[None], 3, axis=0)) if tracks else start  # what holds it there
        plan = Schedule(dwell=LEAD_IN + LAG + max(path.duration for path in paths), sent=sent, keep_going=True)
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
    return {
        case: [(judge(arm, one, path, b).encoder, bool(one.tripped[b])) for b, path in enumerate(paths)]
        for case, one in driven.items()
    }


def played(path: Path, rate: float) -> Stream:
    """Play the places of a path as a stream of ``rate`` [Hz], after a rest."""
    times = np.concatenate([[0.0], np.arange(LEAD_IN, LEAD_IN + path.duration + 1.0 / rate, 1.0 / rate)])
    return Stream(time=times.tolist(), rows=list(path.at(times - LEAD_IN)))


def _row(case: str, path: str, found: Sequence[tuple[Along, bool]]) -> MovingRow:
    errors, late = [one for one, _ in found], case == STREAM
    error = spread(np.array([one.rms_after if late else one.rms for one in errors]), np.arange(len(errors)))
    assert error is not None  # noqa: S101 - every arm has an error along the way
    return MovingRow(
        case=case,
        path=path,
        error=error,
        largest=max(one.largest_after if late else one.largest for one in errors),
        lag=float(np.median([one.lag for one in errors])),
        stopped=sum(stopped for _, stopped in found),
    )


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
