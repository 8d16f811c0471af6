"""Moving targets on fresh arms: each is diagnosed and identified, then follows paths.

Blocks of arms move side by side; finished blocks are kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path as FilePath

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.classical import DefaultController
from rejoint.control.controller import Controller
from rejoint.control.loop import Schedule, run
from rejoint.control.moving.drive import Along, Repetition, judge, missed
from rejoint.control.moving.posture import PathPostures, Servos, home_of
from rejoint.control.moving.reference import (
    LAG,
    LEAD_IN,
    STANDARD,
    Ahead,
    Guide,
    Path,
    PathReference,
    played,
    standard_path,
)
from rejoint.control.moving.tracker import Tracker
from rejoint.control.recording import Recording
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.research.evaluation.family import ArmFamily
from rejoint.research.evaluation.trials import own_twin
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.plant.wear import Wear, load_wear
from rejoint.system.files import read_json, write_json
from rejoint.system.progress import Progress, part

RATE = 30.0
"""[Hz] of a path's setpoints where it is not known ahead"""
REPETITIONS = 10
BLOCK = 5
"""Arms that move side by side (chosen)"""
SENT, HEALTHY, KNOWN, STREAM = "worn, sent as it comes", "healthy, sent as it comes", "known ahead", "as it goes, 30 Hz"
REPEATED = f"time {REPETITIONS} of one path"
CASES = (HEALTHY, SENT, KNOWN, STREAM, REPEATED)


@dataclass(frozen=True, kw_only=True)
class MovingLine:
    """One arm on one path in one case."""

    wear_seed: int
    case: str
    path: str
    errors: Along
    stopped: bool
    """whether the guard ended it"""


@dataclass(frozen=True, kw_only=True)
class MovingRow:
    """One case on one path, over the arms: rms errors."""

    case: str
    path: str
    arms: int
    mean: float
    """[m] after the best single lag for online paths"""
    middle: float
    """[m] median"""
    high: float
    """[m] 95th percentile"""
    largest: float
    """[m] largest error of any arm at any time"""
    lag: float
    """[s] median"""
    stopped: int


@dataclass(frozen=True, kw_only=True)
class MovingEvaluation:
    """All of it."""

    arm: str
    family: int
    arms: int
    rows: list[MovingRow]


def evaluate_moving(
    arm: Arm, family: ArmFamily, out: FilePath, threads: int, on_progress: Progress
) -> MovingEvaluation:
    """Let every arm follow the standard paths in all cases; resumes in ``out``."""
    seeds = [family.wear_seed(i) for i in range(family.arms)]
    lines: list[MovingLine] = []
    for first in range(0, len(seeds), BLOCK):
        block = seeds[first : first + BLOCK]
        ahead = part(on_progress, first / len(seeds), (first + len(block)) / len(seeds))
        file = out / "moving" / f"{block[0]}-{block[-1]}.json"
        if not file.exists():
            write_json(file, _block(arm, block, family.seed, out, threads, ahead))
        lines += read_json(file, list[MovingLine])
    rows = [_row(case, path, lines) for case in CASES for path in STANDARD]
    return MovingEvaluation(arm=arm.name, family=family.seed, arms=family.arms, rows=rows)


def _block(
    arm: Arm, seeds: Sequence[int], family: int, out: FilePath, threads: int, on_progress: Progress
) -> list[MovingLine]:
    twins = []
    for i, seed in enumerate(seeds):
        # The same plan of excitation for all of them: a few are not safe and are refused.
        share = part(on_progress, 0.5 * i / len(seeds), 0.5 * (i + 1) / len(seeds))
        twins.append(own_twin(arm, seed, RunFolder(out / "arms" / str(seed)), family, share).parameters)
    known = {f.name: np.stack([getattr(twin, f.name) for twin in twins for _ in STANDARD]) for f in fields(Servos)}
    servos = Servos(**known)
    bench = _Block(arm=arm, seeds=seeds, threads=threads, home=home_of(arm, servos))
    ahead, repetitions = [Ahead(path=path) for path in bench.paths], [Repetition(path) for path in bench.paths]
    worn = [load_wear(f"worn?seed={seed}", arm) for seed in seeds for _ in STANDARD]

    def tracker() -> Controller:
        return Tracker(arm, servos)

    on_progress(0.5, "paths sent")
    lines = bench.run(SENT, worn, DefaultController(arm), ahead)[0]
    lines += bench.run(HEALTHY, [load_wear("healthy", arm)] * len(worn), DefaultController(arm), ahead)[0]
    on_progress(0.55, "paths that arrive as they go")
    lines += bench.run(STREAM, worn, tracker(), [played(path, RATE) for path in bench.paths])[0]
    for time in range(REPETITIONS):
        on_progress(0.6 + 0.4 * time / REPETITIONS, f"time {time + 1}")
        case = {0: KNOWN, REPETITIONS - 1: REPEATED}.get(time, "")
        found, recording = bench.run(case, worn, tracker(), ahead, time)
        lines += found if case else []
        ahead = [
            Ahead(path=one.path, aim=lessons.learn(one.aim or one.path, *missed(arm, recording, one, one.path, b)))
            for b, (one, lessons) in enumerate(zip(ahead, repetitions, strict=True))
        ]
    return lines


@dataclass(frozen=True, kw_only=True, eq=False)
class _Block:
    """Arms of a block, each as often as there are paths."""

    arm: Arm
    seeds: Sequence[int]
    threads: int
    home: Array
    """(B, n) [rad] postures that trackers keep near to"""

    @property
    def paths(self) -> list[Path]:
        """Path of each; random ones differ from arm to arm."""
        return [standard_path(name, self.arm, seed) for seed in self.seeds for name in STANDARD]

    def run(
        self, case: str, wears: list[Wear], controller: Controller, guides: Sequence[Guide], time: int = 0
    ) -> tuple[list[MovingLine], Recording]:
        """Return the lines of a case, and its recording; ``time`` is another noise."""
        paths = self.paths
        home = self.home if isinstance(controller, Tracker) else None
        start = PathPostures(self.arm, np.stack([path.place[0] for path in paths]), home=home).last
        robot = EmulatedRobot(self.arm, wears, seed=self.seeds[0] + time, start=start, threads=self.threads)
        dwell = LEAD_IN + LAG + max(path.duration for path in paths)
        reference = PathReference(self.arm, guides, home)
        recording = run(robot, controller, reference, Schedule(dwell=dwell, sent=start, keep_going=True))
        lines = [
            MovingLine(
                wear_seed=self.seeds[b // len(STANDARD)],
                case=case,
                path=path.name,
                errors=judge(self.arm, recording, Ahead(path=path), b).encoder,
                stopped=bool(recording.tripped[b]),
            )
            for b, path in enumerate(paths)
        ]
        return lines, recording


def _row(case: str, path: str, lines: Sequence[MovingLine]) -> MovingRow:
    own = [line for line in lines if (line.case, line.path) == (case, path)]
    late = case == STREAM
    rms = np.array([line.errors.rms_after if late else line.errors.rms for line in own])
    largest = max(line.errors.largest_after if late else line.errors.largest for line in own)
    return MovingRow(
        case=case,
        path=path,
        arms=len(own),
        mean=float(rms.mean()),
        middle=float(np.median(rms)),
        high=float(np.percentile(rms, 95)),
        largest=largest,
        lag=float(np.median([line.errors.lag for line in own])),
        stopped=sum(line.stopped for line in own),
    )


def moving_table(result: MovingEvaluation) -> tuple[str, list[str], list[list[str]]]:
    """Title, headers and rows: mean (95th percentile) over the arms in mm."""
    title = (
        f"{result.arms} arms of family {result.family}: root mean square encoder error along the way in mm, mean over "
        "the arms (95th percentile); as it goes: after the best single lag"
    )
    rows = [
        [case, *(f"{1e3 * row.mean:.2f} ({1e3 * row.high:.2f})" for row in result.rows if row.case == case)]
        for case in CASES
    ]
    return title, ["case", *STANDARD], rows
