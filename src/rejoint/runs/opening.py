"""Opening run folders: what a run is about, which folder a command works in, and that no other one does meanwhile."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from functools import wraps
from pathlib import Path
from typing import Concatenate, ParamSpec, TypeVar

from rejoint import __version__
from rejoint.arms import CATALOGUE, Arm, load_arm, write_arm_toml
from rejoint.runs.folder import FORMAT, LOGS, RunFolder, RunInfo, locked, read_info
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import TOML_MOST, UNFINISHED, digest, read_bounded, write_json

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
            write_arm_toml(run.folder.description, arm)
            run = replace(run, info=replace(run.info, arm_file=_digest(run.folder)))
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
    if path.is_dir() and not _empty(path):
        raise InputError(f"{path} is not a run folder and not empty; give another --run")
    created = datetime.now().isoformat(timespec="seconds")
    info = RunInfo(robot=robot, arm=arm.name, seed=seed, version=__version__, created=created, format=FORMAT)
    return Run(folder=folder, info=info, arm=arm)


def open_run(path: Path) -> Run:
    """Open an existing run folder; FileError if it is none, or damaged, or of a later version."""
    folder = RunFolder(path)
    if not folder.info.exists():
        within = sorted(p.parent.name for p in path.glob("*/run.json"))
        begin = "start with: rejoint diagnose ROBOT --run FOLDER"
        hint = f"it holds runs, name one of: {', '.join(within)}" if within else begin
        raise FileError(path, "no run folder (it holds no run.json)", hint)
    info = read_info(folder.info)
    if info.arm_file and _digest(folder) != info.arm_file:
        remedy = "bring back the description that this run was begun with, or begin another run"
        raise FileError(folder.description, "damaged or changed since the run was begun", remedy)
    return Run(folder=folder, info=info, arm=load_arm(folder.arm(info.arm)))


def newest_or_new(robot: str, arm: Arm, seed: int) -> tuple[Path, bool]:
    """Default run folder of a robot: the newest one if it was interrupted, else a new one.

    Returns the path and whether it is to be resumed.
    """
    home = RUNS / re.sub(r"[^\w.-]+", "-", f"{arm.name}-{robot}-seed{seed}").strip("-")
    numbers = sorted(int(p.name) for p in home.glob("*") if p.name.isdecimal()) if home.is_dir() else []
    if numbers and not is_finished(RunFolder(home / f"{numbers[-1]:03}")):
        return home / f"{numbers[-1]:03}", True
    return home / f"{(numbers[-1] if numbers else 0) + 1:03}", False


def is_finished(folder: RunFolder) -> bool:
    """Tell whether a run has come to its end: `repair` said so, or every stage and a report of them are there.

    A report alone is no end: it can be written at any time. Folders of before `repair` said so need no newer report.
    """
    if folder.finished.exists():
        return True
    if not folder.info.exists():
        return False
    info = read_info(folder.info)
    driven = (folder.diagnosis, folder.twin, folder.policy, folder.comparison)
    stages = (folder.twin, folder.judgement) if info.robot.startswith(LOGS) else driven
    if not all(path.exists() for path in (*stages, folder.report)):
        return False
    return info.format == 1 or all(path.stat().st_mtime <= folder.report.stat().st_mtime for path in stages)


def finish(run: Run) -> None:
    """Note that all of a run is done: the next repair of that robot begins another one."""
    write_json(run.folder.finished, {"finished": datetime.now().isoformat(timespec="seconds")})


def forget(run: Run) -> None:
    """Remove the folder of a run in which nothing has been done yet, such as one whose robot did not answer."""
    path = run.folder.path
    if _empty(path):
        for entry in path.iterdir():
            entry.unlink()
        path.rmdir()
        if RUNS in path.parents:  # what was made for it goes with it
            for parent in (path.parent, RUNS):
                with suppress(OSError):  # other runs are there
                    parent.rmdir()


def _empty(path: Path) -> bool:
    """Tell whether a folder holds at most what a run begins with."""
    begun = {"run.json", "arm.toml", ".lock"}
    return all(entry.name in begun or entry.name.endswith(UNFINISHED) for entry in path.iterdir())


def _digest(folder: RunFolder) -> str:
    """Fingerprint of the arm's own description."""
    try:
        data = read_bounded(folder.description, TOML_MOST, "take the arm's own description")
    except FileNotFoundError as error:
        raise FileError(folder.description, "no such file", "bring it back, or begin another run") from error
    except OSError as error:
        raise FileError(folder.description, f"cannot be read ({error.strerror})", "allow reading it") from error
    return digest(data).decode()


def alone(stage: Callable[Concatenate[Run, Given], Result]) -> Callable[Concatenate[Run, Given], Result]:
    """Let no other process work in the run folder during a stage; one that fails leaves no folder it has not begun."""

    @wraps(stage)
    def working(run: Run, /, *arguments: Given.args, **options: Given.kwargs) -> Result:
        with locked(run.folder):
            try:
                return stage(run, *arguments, **options)
            except BaseException:
                if run.folder.path.is_dir() and not run.folder.info.exists():
                    forget(run)
                raise

    return working
