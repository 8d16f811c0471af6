"""Contents of a run folder, read once; None: stage not run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array, load_arm
from rejoint.control.comparison.recommend import recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.controllers.contract import PolicyContract
from rejoint.control.controllers.policy import load_policy
from rejoint.control.correction import NOT_KNOWN, TrueError
from rejoint.diagnosis.calibration.calibration import Calibration, read_calibration
from rejoint.diagnosis.calibration.measurements import Measurements, read_measurements
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.diagnosis.open_loop import modelled_errors
from rejoint.logs.runfolder import LOGS, Effort, RunFolder, RunInfo, read_info
from rejoint.logs.runlog import RunLog, read_log, read_parquet
from rejoint.pages.words import number
from rejoint.robots import DEFAULT_ARM, is_virtual
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import read_json, reading
from rejoint.system.shell import command
from rejoint.twin.judgement import Judgement
from rejoint.twin.twin import Twin, read_twin

_LAST = 5  # updates that are averaged for "at the end"


@dataclass(frozen=True, kw_only=True, eq=False)
class Curves:
    """Training curves, K updates."""

    step: Array
    """(K,) transitions"""
    reward: Array
    """(K,) mean per cycle"""
    success_rate: Array
    """(K,)"""
    error_mm: Array
    """(K,) median at the end of a target"""
    wall_s: Array
    """(K,) [s]"""

    @property
    def outcome(self) -> str:
        """Result of the last updates, in words."""
        success, error = (float(np.mean(values[-_LAST:])) for values in (self.success_rate, self.error_mm))
        return f"{number(100 * success, 3, '%')} success and a median error of {number(error, 2, 'mm')}"


def read_curves(path: Path) -> Curves:
    """Read ``training/curves.parquet``; FileError."""
    remedy = "delete it and train again"
    with reading(path, "not readable as training curves", remedy):
        names = [one.name for one in fields(Curves)]
        table = read_parquet(path, remedy, names)
        columns = {name: table[name].to_numpy().astype(float) for name in names}
    if not len(columns["step"]):
        raise FileError(path, "no update in the training curves", remedy)
    return Curves(**columns)


@dataclass(frozen=True, kw_only=True, eq=False)
class Contents:
    """Results of a run."""

    folder: RunFolder
    arm: Arm
    info: RunInfo | None
    diagnosis: Diagnosis | None
    twin: Twin | None
    judgement: Judgement | None
    """of twins fitted to logs alone"""
    curves: Curves | None
    contract: PolicyContract | None
    comparison: Comparison | None
    calibration: Calibration | None
    measurements: Measurements | None
    """external, of the tool"""
    hold: Mapping[str, RunLog]
    """one hold trial per controller"""
    effort: Effort | None


_READ: dict[str, Callable[[Path], Any]] = {
    "info": read_info,
    "diagnosis": partial(read_json, kind=Diagnosis),
    "twin": read_twin,
    "judgement": partial(read_json, kind=Judgement),
    "comparison": partial(read_json, kind=Comparison),
    "effort": partial(read_json, kind=Effort),
}
_READ_FOR: dict[str, Callable[[Path, Arm], Any]] = {
    "policy": load_policy,
    "calibration": read_calibration,
    "measurements": read_measurements,
}


def read_contents(path: Path) -> Contents:
    """Read a run folder; FileError, also for an empty one."""
    folder = RunFolder(path)
    if not path.is_dir():
        raise FileError(path, "no such run folder", "check the path, or make one with `rejoint repair`")

    def read(readers: dict[str, Callable[..., Any]], *about: Arm) -> dict[str, Any]:
        places = {name: getattr(folder, name) for name in readers}
        return {name: readers[name](file, *about) if file.exists() else None for name, file in places.items()}

    found = read(_READ)
    info, curves = found["info"], folder.curves
    results = ("comparison", "diagnosis", "twin", "judgement")
    names = [found[name].arm for name in results if found[name] is not None]
    arm = _arm(path, names if info is None else [folder.arm(info.arm)], names)
    found |= read(_READ_FOR, arm) | {"curves": read_curves(curves) if curves.exists() else None}
    if all(found[name] is None for name in (*results, "curves", "policy", "calibration")):
        raise FileError(path, "nothing to report: no stage has been run here", "run `rejoint diagnose` first")
    policy, comparison = found.pop("policy"), found["comparison"]
    tried = () if comparison is None else comparison.controllers
    hold = {name: read_log(log) for name in tried if (log := folder.log(f"hold/{name}/0/0")).exists()}
    return Contents(folder=folder, arm=arm, contract=policy and policy.contract, hold=hold, **found)


def _arm(path: Path, sources: list[str], names: list[str]) -> Arm:
    try:
        arm = load_arm(sources[0] if sources else DEFAULT_ARM)
    except InputError as error:
        raise FileError(path, f"the arm of this run cannot be built ({error})", "bring its description back") from error
    others = sorted({name for name in names if name != arm.name})
    if others:
        found = ", ".join([arm.name, *others])
        raise FileError(path, f"its files are about different arms ({found})", "keep every arm in a folder of its own")
    return arm


@dataclass(frozen=True, kw_only=True)
class MeanErrors:
    """Mean distance from the targets."""

    encoders: float | None
    """[m]"""
    tool: TrueError


@dataclass(frozen=True, kw_only=True)
class BeforeAfter:
    """An uncorrected arm, and one with a controller."""

    controller: str
    before: MeanErrors
    after: MeanErrors

    @property
    def sentence(self) -> str:
        """Both in one line, or empty."""
        before, after = self.before, self.after
        if before.encoders is None or after.encoders is None:
            return ""
        start = f"Before: {1e3 * before.encoders:.1f} mm off (encoders)"
        end = f"After, with '{self.controller}': {1e3 * after.encoders:.2f} mm (encoders)"
        if before.tool.value is None and after.tool.value is None:
            return f"{start}. {end}. The tool itself: {after.tool}."
        return f"{start}, {_tool(before.tool, 'the tool itself')}. {end}, {_tool(after.tool, 'tool')}."


def _tool(error: TrueError, what: str) -> str:
    if error.value is None:
        return f"{what} {error}"
    ends = f", 95 %: {error.range}" if error.range and error.how != "known" else ""
    return f"{error.millimetres} mm ({what}{'' if error.how == 'known' else f', {error.how}'}{ends})"


def before_after(contents: Contents) -> BeforeAfter | None:
    """Compare the uncorrected arm with the recommended controller; None: not compared."""
    if contents.comparison is None:
        return None
    controller = recommend(contents.comparison).controller
    return BeforeAfter(controller=controller, before=found(contents), after=_errors(contents.comparison, controller))


def found(contents: Contents) -> MeanErrors:
    """Errors of the uncorrected arm: under its own controller, else open loop in the diagnosis."""
    own, comparison, known = DefaultController.name, contents.comparison, contents.calibration
    if comparison is not None and own in comparison.controllers and not comparison.calibration:
        return _errors(comparison, own)
    open_loop = None if contents.diagnosis is None else contents.diagnosis.open_loop
    if open_loop is None:
        return MeanErrors(encoders=None, tool=NOT_KNOWN)
    tool, log = open_loop.true_error, contents.folder.log("targets")
    if tool.value is None and known is not None and log.exists():
        tool = modelled_errors(read_log(log), known)
    return MeanErrors(encoders=1e-3 * open_loop.error_mm.value, tool=tool)


def _errors(comparison: Comparison, controller: str) -> MeanErrors:
    row = comparison.row(controller)
    return MeanErrors(encoders=None if row.settled is None else row.settled.mean.value, tool=row.true_error)


def commands(contents: Contents) -> dict[str, str]:
    """Command lines of every stage."""
    run, info = contents.folder.path, contents.info
    robot, seed = ("ROBOT", 0) if info is None else (info.robot, info.seed)
    built = contents.folder.arm(contents.arm.name)
    arm = [] if info is None or info.arm == DEFAULT_ARM else ["--arm", built]
    seen = contents.calibration is not None and contents.calibration.source == "camera"
    gauge = ["--measure", "camera" if seen else "touch"] if seen or not is_virtual(robot) else []
    diagnose: list[object] = [robot, "--run", run, *arm, "--seed", seed]
    identify: list[object] = [run]
    if robot.startswith(LOGS):
        identify = diagnose = ["--logs", robot.removeprefix(LOGS), "--arm", built, "--run", run]
        robot = "ROBOT"
    lines: dict[str, list[object]] = {
        "repair": [robot, *arm, "--seed", seed],
        "diagnose": diagnose,
        "identify": identify,
        "train": [run],
        "calibrate": [robot, run, *gauge],
        "compare": [robot, run],
        "report": [run],
    }
    return {name: command(name, *words) for name, words in lines.items()}
