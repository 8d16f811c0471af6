"""Contents of a run folder, read once; None: stage not run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array, load_arm
from rejoint.control.comparison.recommend import recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.controllers.policy import Policy
from rejoint.control.correction import NOT_KNOWN, TrueError
from rejoint.diagnosis.calibration.calibration import Calibration, read_calibration
from rejoint.diagnosis.calibration.measurements import Measurements, read_measurements
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.diagnosis.open_loop import modelled_errors
from rejoint.logs.runfolder import LOGS, Effort, RunFolder, RunInfo, read_info
from rejoint.logs.runlog import RunLog, read_log, read_parquet
from rejoint.pages.words import number
from rejoint.robots import DEFAULT_ARM, is_virtual
from rejoint.system.errors import FileError
from rejoint.system.files import read_json, reading
from rejoint.system.shell import command
from rejoint.twin.twin import Judgement, Twin, read_twin

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
    info: RunInfo
    arm: Arm
    diagnosis: Diagnosis | None = None
    twin: Twin | None = None
    judgement: Judgement | None = None
    """of twins fitted to logs alone"""
    curves: Curves | None = None
    policy: Policy | None = None
    comparison: Comparison | None = None
    calibration: Calibration | None = None
    measurements: Measurements | None = None
    """external, of the tool"""
    effort: Effort | None = None

    @cached_property
    def hold(self) -> dict[str, RunLog]:
        """One hold trial per controller."""
        tried = () if self.comparison is None else self.comparison.controllers
        files = {name: self.folder.log(f"hold/{name}/0/0") for name in tried}
        return {name: read_log(file) for name, file in files.items() if file.exists()}


def read_contents(path: Path) -> Contents:
    """Read a run folder; FileError."""
    folder = RunFolder(path)
    info = read_info(folder.info)
    arm = load_arm(folder.arm(info.arm))
    readers: dict[str, Callable[[Path], Any]] = {
        "diagnosis": partial(read_json, kind=Diagnosis),
        "twin": read_twin,
        "judgement": partial(read_json, kind=Judgement),
        "curves": read_curves,
        "policy": Policy.load,
        "comparison": partial(read_json, kind=Comparison),
        "calibration": partial(read_calibration, arm=arm),
        "measurements": partial(read_measurements, arm=arm),
        "effort": partial(read_json, kind=Effort),
    }
    found = {name: read(file) for name, read in readers.items() if (file := getattr(folder, name)).exists()}
    return Contents(folder=folder, info=info, arm=arm, **found)


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
    """Errors of the uncorrected arm: in the diagnosis, else under its own controller in the comparison."""
    own, comparison, known = DefaultController.name, contents.comparison, contents.calibration
    open_loop = None if contents.diagnosis is None else contents.diagnosis.open_loop
    if open_loop is None:
        if comparison is not None and own in comparison.controllers and not comparison.calibration:
            return _errors(comparison, own)
        return MeanErrors(encoders=None, tool=NOT_KNOWN)
    tool, log = open_loop.true_error, contents.folder.log("targets")
    if tool.value is None and known is not None and log.exists():
        tool = modelled_errors(read_log(log), known)
    return MeanErrors(encoders=1e-3 * open_loop.error_mm.value, tool=tool)


def _errors(comparison: Comparison, controller: str) -> MeanErrors:
    row = comparison.row(controller)
    return MeanErrors(encoders=None if row.settled is None else row.settled.mean.value, tool=row.true_error)


def next_steps(contents: Contents) -> dict[str, str]:
    """Commands for a repaired arm by what they are for; none before a comparison on a robot."""
    run, info, targets = contents.folder.path, contents.info, contents.arm.targets
    if contents.comparison is None or info is None or info.robot.startswith(LOGS):
        return {}
    robot, middle = info.robot, (f"{value:.0f}" for value in 500.0 * (targets.lower + targets.upper))
    steps = {
        "go to a point (mm)": command("goto", robot, *middle, "--run", run),
        "go to the points of a file": command("deploy", robot, run, "--targets", "points.csv"),
    }
    if not is_virtual(robot):
        steps["let your own programs drive it"] = command("serve", robot, run)
    if contents.calibration is None:
        steps["measure where the tool really is"] = commands(contents)["calibrate"]
    steps["see later whether it has become worse"] = command("check", robot, "--repeat", 5)
    return steps


def commands(contents: Contents) -> dict[str, str]:
    """Command lines of every stage."""
    run, robot, built = contents.folder.path, contents.info.robot, contents.folder.arm(contents.info.arm)
    arm = [] if contents.info.arm == DEFAULT_ARM else ["--arm", built]
    seen = contents.calibration is not None and contents.calibration.source == "camera"
    gauge = ["--measure", "camera" if seen else "touch"] if seen or not is_virtual(robot) else []
    repair: list[object] = [robot, *arm, "--seed", contents.info.seed]
    diagnose: list[object] = [robot, "--run", run, *repair[1:]]
    identify: list[object] = [run]
    if robot.startswith(LOGS):
        identify = diagnose = ["--logs", robot.removeprefix(LOGS), "--arm", built, "--run", run]
        robot = repair[0] = "ROBOT"
    lines: dict[str, list[object]] = {
        "repair": repair,
        "diagnose": diagnose,
        "identify": identify,
        "train": [run],
        "calibrate": [robot, run, *gauge],
        "compare": [robot, run],
        "report": [run],
    }
    return {name: command(name, *words) for name, words in lines.items()}
