"""The report: what is in a run folder, its page and its figures; the page of a replay, and the data sheet.

A stage that was not run has no content: None.
"""

from collections.abc import Callable
from dataclasses import fields
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array, load_arm
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.workspace import reach
from rejoint.control.comparison import recommend
from rejoint.control.comparison.result import MODELLED, Comparison, TargetErrors
from rejoint.control.controllers.catalogue import BASELINES
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.controllers.policy import Policy
from rejoint.control.correction import NOT_KNOWN, TrueError
from rejoint.control.servogains import own_policy
from rejoint.diagnosis.calibration import calibration, fit
from rejoint.diagnosis.calibration.calibration import Calibration, read_calibration
from rejoint.diagnosis.calibration.measurements import Measurements, read_measurements
from rejoint.diagnosis.calibration.procedure import in_base, reversals
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.diagnosis.segments import modelled_errors
from rejoint.logs.history import CHECKS
from rejoint.logs.runfolder import (
    RUNS,
    Effort,
    KeptSettings,
    RunFolder,
    RunInfo,
    cost,
    read_info,
    read_settings,
    runs_below,
)
from rejoint.logs.runlog import RunLog, read_parquet
from rejoint.pages.html import colour_number, render, write_page
from rejoint.pages.report import tables
from rejoint.pages.report.figures import Gallery
from rejoint.pages.words import number
from rejoint.robots import DEFAULT_ARM, is_virtual
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import read_json, reading, write_json, write_text
from rejoint.system.records import entity, value_type
from rejoint.system.shell import command
from rejoint.system.statistics import above_zero, spread
from rejoint.twin import parameters
from rejoint.twin.twin import Judgement, Twin, read_twin

_LAST = 5  # updates that are averaged for "at the end"


@entity
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


@value_type
class MeanErrors:
    """Mean distance from the targets."""

    encoders: float | None
    """[m]"""
    tool: TrueError


@value_type
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
        if self.controller == DefaultController.name:
            return f"{start}. No controller that was tried does measurably better than its own."
        end = f"After, with '{self.controller}': {1e3 * after.encoders:.2f} mm (encoders)"
        if before.tool.value is None and after.tool.value is None:
            return f"{start}. {end}. The tool itself: {after.tool}."
        return f"{start}, {_tool(before.tool, 'the tool itself')}. {end}, {_tool(after.tool, 'tool')}."


def _tool(error: TrueError, what: str) -> str:
    if error.value is None:
        return f"{what} {error}"
    ends = f", 95 %: {error.range}" if error.range and error.how != "known" else ""
    return f"{error.millimetres} mm ({what}{'' if error.how == 'known' else f', {error.how}'}{ends})"


def _errors(comparison: Comparison, controller: str) -> MeanErrors:
    row = comparison.row(controller)
    return MeanErrors(encoders=None if row.settled is None else row.settled.mean.value, tool=row.true_error)


@entity
class Contents:
    """Results of a run."""

    folder: RunFolder
    info: RunInfo
    arm: Arm
    """with payload and tool"""
    settings: KeptSettings
    """what the run keeps of its diagnosis"""
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
        return {name: RunLog.load(file) for name, file in files.items() if file.exists()}

    def before_after(self) -> BeforeAfter | None:
        """Compare the uncorrected arm with the recommended controller; None: not compared."""
        if self.comparison is None:
            return None
        controller = recommend.recommend(self.comparison).controller
        return BeforeAfter(controller=controller, before=self.as_found(), after=_errors(self.comparison, controller))

    def as_found(self) -> MeanErrors:
        """Errors of the uncorrected arm: under its own controller in the comparison, else in the diagnosis."""
        own, comparison = DefaultController.name, self.comparison
        found = MeanErrors(encoders=None, tool=NOT_KNOWN)
        if comparison is not None and own in comparison.controllers and not comparison.calibration:
            found = _errors(comparison, own)
        open_loop = None if self.diagnosis is None else self.diagnosis.open_loop
        if open_loop is None:
            return found
        tool, log = open_loop.true_error, self.folder.log("targets")
        if tool.value is None and self.calibration is not None and log.exists():
            tool = modelled_errors(RunLog.load(log), self.calibration)
        encoders = 1e-3 * open_loop.error_mm.value if found.encoders is None else found.encoders
        return MeanErrors(encoders=encoders, tool=tool if found.tool.value is None else found.tool)

    def next_steps(self) -> dict[str, str]:
        """Commands for a repaired arm by what they are for; none before a robot reached targets in a comparison."""
        run, robot = self.folder.path, self.info.robot
        if self.comparison is None or self.info.from_logs or not any(row.reached for row in self.comparison.rows):
            return {}
        middle = (f"{value:.0f}" for value in 1e3 * self.arm.targets.middle)
        steps = {
            "go to a point (mm)": command("goto", robot, *middle, "--run", run),
            "go to the points of a file": command("deploy", robot, run, "--targets", "points.csv"),
        }
        if not is_virtual(robot):
            by_lines = [] if self.arm.joints == load_arm(DEFAULT_ARM).joints else ["--stdio"]  # else a myCobot's wire
            steps["let your own programs drive it"] = command("serve", robot, run, *by_lines)
        if self.calibration is None:
            steps["measure where the tool really is"] = self.commands()["calibrate"]
        steps["see later whether it has become worse"] = check_again(self.folder, self.info)
        return steps

    def _known(self) -> tuple[object, ...]:
        """Options that begin with the calibration of this arm's newest other run that has one."""
        for other, info in runs_below(_home(self.folder)).items():
            alike = (info.robot, info.name, info.arm) == (self.info.robot, self.info.name, self.info.arm)
            if alike and other.path != self.folder.path and other.calibration.exists():
                return "--calibration", other.calibration, "--count", 3
        return ()

    @property
    def trials(self) -> list[object]:
        """Options that name the size of the comparison, and its controllers where not all of the usual."""
        if self.comparison is None:
            return []
        (sets, repetitions, _), tried = self.comparison.shape, self.comparison.controllers
        few = [] if {*BASELINES} <= {*tried} else ["--controllers", ",".join(tried)]
        return [*few, "--sets", sets, "--repetitions", repetitions]

    def commands(self) -> dict[str, str]:
        """Command lines of every stage."""
        run, robot = self.folder.path, self.info.robot
        quick = ["--quick"] * self.folder.quick.exists()
        known = described(self.folder, self.info)
        options = [*known, *self.settings.options(), "--seed", self.info.seed, *quick]
        seen = self.calibration is not None and self.calibration.source == "camera"
        recipe = ["--preset", self.policy.contract.preset] if self.policy else []
        gauge = ["--measure", "camera" if seen else "touch"] if seen or not is_virtual(robot) else []
        diagnose: tuple[object, ...] = (robot, "--run", run, *options)
        identify: tuple[object, ...] = (run,)
        if logs := self.info.from_logs:
            diagnose = identify = ("--logs", logs, *known, "--run", run)
            robot = "ROBOT"
        return {
            "repair": command("repair", robot, *options, *self.trials),
            "diagnose": command("diagnose", *diagnose),
            "identify": command("identify", *identify),
            "train": command("train", run, *recipe, *quick),
            "calibrate": command("calibrate", robot, run, *gauge, *(self._known() if self.calibration is None else ())),
            "compare": command("compare", robot, run, *self.trials),
            "report": command("report", run),
        }


def _home(folder: RunFolder) -> Path:
    """Folder of an arm's history: the one around the run, where that has checks."""
    return folder.path.parent if (folder.path.parent / CHECKS).is_dir() else RUNS


def described(folder: RunFolder, info: RunInfo) -> tuple[str, ...]:
    """Options that name the arm."""
    arm = folder.arm(info.arm)
    return () if arm == DEFAULT_ARM else ("--arm", arm)


def check_again(folder: RunFolder, info: RunInfo) -> str:
    """Command that checks a repaired arm."""
    if info.fleet:
        return command("fleet", "check", info.fleet, "--only", info.name)
    options, home = read_settings(folder).options("keep_out", "period"), _home(folder)
    seen = () if home == RUNS else ("--history", home)
    return command("check", info.name or info.robot, *described(folder, info), *options, *seen, "--repeat", 5)


def read_contents(path: Path) -> Contents:
    """Read a run folder; FileError."""
    folder = RunFolder(path)
    info = read_info(folder.info)
    settings = read_settings(folder)
    try:
        arm = settings.laden(load_arm(folder.arm(info.arm)))
    except InputError as error:
        raise FileError(folder.settings, str(error), "bring back the settings of this run") from error
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
    return Contents(folder=folder, info=info, arm=arm, settings=settings, **found)


def write_report(folder: Path) -> Path:
    """Write ``report.html`` and ``figures/*.png`` into a run folder; FileError if damaged or empty."""
    contents, gallery = read_contents(folder), Gallery()
    html = report_html(contents, gallery)
    gallery.save(contents.folder.figures)
    write_text(contents.folder.report, html)
    return contents.folder.report


def write_replay(folder: Path, judgement: Judgement, twin: str, logs: str) -> Path:
    """Write ``replay.html`` and ``replay.json``; returns the page."""
    write_json(folder / "replay.json", judgement)
    page = folder / "replay.html"
    return write_page(page, page.name, it={"judgement": judgement}, twin=twin, logs=logs, tables=tables)


def report_html(contents: Contents, gallery: Gallery) -> str:
    """Fill page and gallery."""
    return render("report.html", it=contents, draw=gallery, **_NAMES)


def target_errors(comparison: Comparison, controller: str) -> TargetErrors:
    """Errors of a controller at the first set's targets, means over repetitions."""
    names = ("settled", "settled_true", *MODELLED)
    return TargetErrors.of({name: comparison.array(name, controller)[0] for name in names})


def tilt(found: Calibration) -> float:
    """[deg] tilt of the base."""
    return np.degrees(np.arccos(np.clip(found.displacement.gravity @ GRAVITY / (GRAVITY @ GRAVITY), -1.0, 1.0)))


_CALLED: list[Any] = [target_errors, tilt, above_zero, colour_number, cost, in_base, own_policy, reach]
_CALLED += [reversals, recommend, calibration, fit, parameters, tables]
_NAMES = {one.__name__.rpartition(".")[2]: one for one in _CALLED}
"""What the templates of report and data sheet call"""


def write_datasheet(folder: Path, out: Path) -> Path:
    """Write the data sheet of a run's arm; FileError."""
    it = read_contents(folder)
    measured, back = it.measurements, np.zeros(0)
    if it.calibration is not None and measured is not None:
        back = np.array(reversals(it.calibration, measured))
    return write_page(out, "datasheet.html", it=it, reversal=spread(back, np.arange(len(back))), **_NAMES)
