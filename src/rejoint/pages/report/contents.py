"""Contents of a run folder, read once; None: stage not run."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import pyarrow as pa

from rejoint.arms import Arm, Array, load_arm
from rejoint.control.classical import DefaultController
from rejoint.control.comparison.result import Comparison
from rejoint.control.contract import PolicyContract
from rejoint.control.correction import NOT_KNOWN, TrueError
from rejoint.control.policy import load_policy
from rejoint.diagnosis.calibration.calibration import Calibration, read_calibration
from rejoint.diagnosis.calibration.measurementfile import read_measurements
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.diagnosis.open_loop import modelled_errors
from rejoint.logs.runfolder.effort import Effort, read_effort
from rejoint.logs.runfolder.folder import LOGS, Kept, RunFolder, RunInfo, read_info
from rejoint.logs.runlog import RunLog, read_log, read_parquet
from rejoint.pages.words import is_virtual, number
from rejoint.robots import DEFAULT_ARM
from rejoint.system.errors import FileError, InputError, first_line
from rejoint.system.files import read_json
from rejoint.twin.file import read_twin
from rejoint.twin.judgement import Judgement
from rejoint.twin.twin import Twin

T = TypeVar("T")

# Names of the hold trials' run logs: controller, target set, repetition
_TRIAL = re.compile(r"hold-(.+)-(\d+)-(\d+)")


_COLUMNS = ("step", "reward", "success_rate", "error_mm", "wall_s")
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
    try:
        table = read_parquet(path, remedy, list(_COLUMNS))
        columns = {name: table[name].to_numpy().astype(float) for name in _COLUMNS}
    except FileNotFoundError as error:
        raise FileError(path, "no such file", "train a policy first") from error
    except (OSError, pa.ArrowException, KeyError, TypeError, ValueError) as error:
        first = first_line(error)
        raise FileError(path, f"not readable as training curves ({first})", remedy) from error
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
    effort: Effort | None = None
    kept: Kept | None = None
    """earlier repair of twin and policy"""


def read_contents(path: Path) -> Contents:
    """Read a run folder; FileError, also for an empty one."""
    folder = RunFolder(path)
    if not path.is_dir():
        raise FileError(path, "no such run folder", "check the path, or make one with `rejoint repair`")
    info = _optional(folder.info, read_info)
    diagnosis = _optional(folder.diagnosis, lambda file: read_json(file, Diagnosis))
    twin = _optional(folder.twin, read_twin)
    judgement = _optional(folder.judgement, lambda file: read_json(file, Judgement))
    comparison = _optional(folder.comparison, lambda file: read_json(file, Comparison))
    curves = _optional(folder.outputs.curves, read_curves)
    names = [one.arm for one in (comparison, diagnosis, twin, judgement) if one is not None]
    arm = _arm(path, names if info is None else [folder.arm(info.arm)], names)
    contract = _optional(folder.policy, lambda file: load_policy(file, arm).contract)
    calibration = _optional(folder.calibration, lambda file: read_calibration(file, arm))
    measurements = _optional(folder.measurements, lambda file: read_measurements(file, arm))
    if all(part is None for part in (diagnosis, twin, judgement, curves, contract, comparison, calibration)):
        raise FileError(path, "nothing to report: no stage has been run here", "run `rejoint diagnose` first")
    known = () if comparison is None else comparison.controllers
    return Contents(
        folder=folder,
        arm=arm,
        info=info,
        diagnosis=diagnosis,
        twin=twin,
        judgement=judgement,
        curves=curves,
        contract=contract,
        comparison=comparison,
        calibration=calibration,
        measurements=measurements,
        hold=_trials(folder, known),
        effort=read_effort(folder),
        kept=_optional(folder.kept, lambda file: read_json(file, Kept)),
    )


def _optional(path: Path, read: Callable[[Path], T]) -> T | None:
    return read(path) if path.exists() else None


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


def _trials(folder: RunFolder, controllers: tuple[str, ...]) -> dict[str, RunLog]:
    found: dict[str, tuple[int, int, Path]] = {}
    for name, path in folder.logs().items():
        match = _TRIAL.fullmatch(name)
        if match and match[1] in controllers:
            trial = (int(match[2]), int(match[3]), path)
            found[match[1]] = min(found.get(match[1], trial), trial)
    return {name: read_log(found[name][2]) for name in controllers if name in found}


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


def before_after(contents: Contents, controller: str) -> BeforeAfter | None:
    """Compare the uncorrected arm with ``controller``; None: not compared."""
    if contents.comparison is None:
        return None
    return BeforeAfter(controller=controller, before=found(contents), after=_errors(contents.comparison, controller))


def found(contents: Contents) -> MeanErrors:
    """Errors of the uncorrected arm: under its own controller, else open loop in the diagnosis."""
    own, comparison = DefaultController.name, contents.comparison
    if comparison is not None and own in comparison.controllers and not comparison.calibration:
        return _errors(comparison, own)
    if contents.diagnosis is None or contents.diagnosis.open_loop is None:
        return MeanErrors(encoders=None, tool=NOT_KNOWN)
    open_loop = contents.diagnosis.open_loop
    return MeanErrors(encoders=1e-3 * open_loop.error_mm.value, tool=_open_loop(contents))


def _open_loop(contents: Contents) -> TrueError:
    assert contents.diagnosis is not None and contents.diagnosis.open_loop is not None  # noqa: S101, PT018
    told = contents.diagnosis.open_loop.true_error
    log = contents.folder.log("targets")
    if told.value is not None or contents.calibration is None or not log.exists():
        return told
    return modelled_errors(read_log(log), contents.calibration)


def _errors(comparison: Comparison, controller: str) -> MeanErrors:
    row = comparison.row(controller)
    return MeanErrors(encoders=None if row.settled is None else row.settled.mean.value, tool=row.true_error)


LEARNERS = ("sac", "td3", "ddpg")
"""Other values of `--learner`"""


class Command(NamedTuple):
    """A command line and its meaning."""

    what: str
    line: str


def commands(contents: Contents) -> dict[str, Command]:
    """Command lines that repeat every stage."""
    run = shlex.quote(str(contents.folder.path))
    info = contents.info
    built = shlex.quote(contents.folder.arm(contents.arm.name))
    address, seed = ("ROBOT", 0) if info is None else (info.robot, info.seed)
    robot = shlex.quote(address)
    arm = "" if info is None or info.arm == DEFAULT_ARM else f" --arm {built}"
    diagnose = f"rejoint diagnose {robot} --run {run}{arm} --seed {seed}"
    recipe = _recipe(contents)
    repair = f"rejoint repair {robot}{arm} --seed {seed}"
    identify = f"rejoint identify {run}"
    if info is not None and info.robot.startswith(LOGS):
        given = f"--logs {shlex.quote(info.robot.removeprefix(LOGS))} --arm {built} --run {run}"
        robot, diagnose, identify = "ROBOT", f"rejoint diagnose {given}", f"rejoint identify {given}"
        repair = f"rejoint repair ROBOT{arm} --seed {seed}"
    return {
        "repair": Command("Everything, from the beginning:", repair),
        "diagnose": Command("Measure and judge the arm:", diagnose),
        "identify": Command("Fit the twin:", identify),
        "train": Command("Train the policy:", f"rejoint train {run}{recipe}"),
        "calibrate": Command(
            "Measure where the tool is:", f"rejoint calibrate {robot} {run}{_gauge(contents, address)}"
        ),
        "compare": Command("Try every controller on the arm:", _compare(contents, robot, run)),
        "report": Command("Make this page again:", f"rejoint report {run}"),
    }


def _compare(contents: Contents, robot: str, run: str) -> str:
    info, comparison = contents.info, contents.comparison
    if comparison is None:
        return f"rejoint compare {robot} {run}"
    other = info is None or comparison.seed != info.seed
    seed = f" --seed {comparison.seed}" if other else ""
    known = contents.calibration
    directions = " --directions" if comparison.directions is not None else ""
    plain = " --calibration none" if known is not None and known.used and not comparison.calibration else ""
    return f"rejoint compare {shlex.quote(comparison.robot)} {run}{_options(comparison)}{plain}{directions}{seed}"


def _gauge(contents: Contents, robot: str) -> str:
    if contents.calibration is not None and contents.calibration.source == "camera":
        return " --measure camera"
    return "" if is_virtual(robot) else " --measure touch"


def _options(comparison: Comparison) -> str:
    drawn = f" --sets {len(comparison.targets)}"
    targets = f" --targets {shlex.quote(comparison.targets_file)}" if comparison.targets_file else drawn
    names = shlex.quote(",".join(comparison.controllers))
    period = "" if comparison.period is None else f" --period {_milliseconds(comparison.period)}"
    whole = "" if comparison.batched or comparison.block else " --full"
    return f"{targets} --repetitions {comparison.repetitions} --controllers {names}{period}{whole}"


def _milliseconds(period: tuple[float, float]) -> str:
    """Period [s] as for `--period`."""
    return "-".join(f"{1e3 * end:.9g}" for end in dict.fromkeys(period))


def _recipe(contents: Contents) -> str:
    name = "" if contents.contract is None else contents.contract.preset
    return f" --preset {name}" if name in ("paper", "scratch") else f" --learner {name}" if name in LEARNERS else ""
