"""Opening run folders: what a run is about, which folder a command works in, and that no other one does meanwhile."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from functools import wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

from rejoint import __version__
from rejoint.arms import CATALOGUE, Arm, load_arm, write_arm_toml
from rejoint.errors import FileError, InputError
from rejoint.runs import RunFolder, RunInfo, locked, read_json, write_json

Given = ParamSpec("Given")
Result = TypeVar("Result")

RUNS = Path("runs")
"""Where run folders are made, in the folder one stands in."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Run:
    """One repair: where its files are and what it is about."""

    folder: RunFolder
    info: RunInfo
    arm: Arm


def begin(path: Path, robot: str, arm: Arm, seed: int) -> Run:
    """Open the run folder at ``path``, or make it; InputError if it belongs to another robot."""
    run = prepare(path, robot, arm, seed)
    if not run.folder.info.exists():
        if arm.name not in CATALOGUE:
            write_arm_toml(path / "arm.toml", arm)
        write_json(run.folder.info, run.info)
    return run


def prepare(path: Path, robot: str, arm: Arm, seed: int) -> Run:
    """Open the run folder at ``path``, or say what `begin` will make of it, without writing; errors as there."""
    folder = RunFolder(path)
    if folder.info.exists():
        run = open_run(path)
        if (run.info.robot, run.arm.name, run.info.seed) != (robot, arm.name, seed):
            raise InputError(
                f"{path} is a run of {run.info.robot} ({run.arm.name}, seed {run.info.seed}), "
                f"expected {robot} ({arm.name}, seed {seed}); give another --run"
            )
        return run
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path} is not a run folder and not empty; give another --run")
    created = datetime.now().isoformat(timespec="seconds")
    info = RunInfo(robot=robot, arm=arm.name, seed=seed, version=__version__, created=created)
    return Run(folder=folder, info=info, arm=arm)


def open_run(path: Path) -> Run:
    """Open an existing run folder; FileError if it is none."""
    folder = RunFolder(path)
    if not folder.info.exists():
        within = sorted(p.parent.name for p in path.glob("*/run.json"))
        begin = "start with: rejoint diagnose ROBOT --run FOLDER"
        hint = f"it holds runs, name one of: {', '.join(within)}" if within else begin
        raise FileError(path, "no run folder (it holds no run.json)", hint)
    info = read_json(folder.info, RunInfo)
    return Run(folder=folder, info=info, arm=load_arm(folder.arm(info.arm)))


def newest_or_new(robot: str, arm: Arm, seed: int) -> tuple[Path, bool]:
    """Default run folder of a robot: the newest one if it was interrupted, else a new one.

    Returns the path and whether it is to be resumed.
    """
    home = RUNS / re.sub(r"[^\w.-]+", "-", f"{arm.name}-{robot}-seed{seed}").strip("-")
    numbers = sorted(int(p.name) for p in home.glob("*") if p.name.isdecimal()) if home.is_dir() else []
    if numbers and not RunFolder(home / f"{numbers[-1]:03}").report.exists():
        return home / f"{numbers[-1]:03}", True
    return home / f"{(numbers[-1] if numbers else 0) + 1:03}", False


def forget(run: Run) -> None:
    """Remove the folder of a run in which nothing has been done yet, such as one whose robot did not answer."""
    path = run.folder.path
    if {entry.name for entry in path.iterdir()} <= {"run.json", "arm.toml", ".lock"}:
        for entry in path.iterdir():
            entry.unlink()
        path.rmdir()


def alone(stage: Callable[Concatenate[Run, Given], Result]) -> Callable[Concatenate[Run, Given], Result]:
    """Let no other process work in the run folder during a stage."""

    @wraps(stage)
    def working(run: Run, /, *arguments: Given.args, **options: Given.kwargs) -> Result:
        with locked(run.folder):
            return stage(run, *arguments, **options)

    return working
