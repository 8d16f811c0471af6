"""The last section: versions, seeds, targets, files, and the commands that repeat each part."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Sequence
from importlib import metadata

from rejoint.control.comparison.result import Comparison
from rejoint.logs.runfolder.effort import Effort, cost
from rejoint.logs.runfolder.folder import LOGS
from rejoint.pages.report.contents import Contents
from rejoint.pages.report.numerals import UNKNOWN
from rejoint.pages.report.view import Cell, Command, Part, Row, Section, Table
from rejoint.pages.report.words import day_and_time, is_virtual
from rejoint.robots import DEFAULT_ARM
from rejoint.system.version import __version__

KEY, SHORT, HEADING = "details", "Details", "Details"

_PACKAGES = ("numpy", "mujoco", "torch", "skrl", "onnxruntime", "pymycobot", "matplotlib")

LEARNERS = ("sac", "td3", "ddpg")
"""Values of `--learner` besides that of the presets"""

_FILES = (
    ("run.json", "robot, arm, seed"),
    ("diagnosis.json", "what is wrong with the arm, per joint"),
    ("measurements.parquet", "where the tool was seen from outside"),
    ("calibration.toml", "what lies behind the encoders, and where to aim because of it"),
    ("twin.toml", "the identified twin with its intervals"),
    ("judgement.json", "that twin and others judged on motion that no fit has seen"),
    ("policy.onnx", "the trained policy with its contract"),
    ("training/curves.parquet", "training curves, one row per update"),
    ("comparison.json", "every controller: results per target, statistics"),
    ("effort.json", "the arm's time and its joints' travel, stage by stage"),
    ("logs/*.parquet", "run logs: time, positions, commands, targets"),
    ("figures/*.png", "the figures of this page"),
)


def details_section(contents: Contents) -> Section:
    """Build the section."""
    parts = [
        Part(facts=_facts(contents)),
        Part(heading="Files of this run", tables=(_files(contents),)),
        Part(heading="To repeat it", commands=tuple(commands(contents).values())),
    ]
    if contents.comparison is not None:
        parts.insert(1, Part(heading="Targets", tables=(_targets(contents.comparison),)))
    return Section(key=KEY, short=SHORT, heading=HEADING, parts=tuple(parts))


def _arm(contents: Contents) -> str:
    """Return what builds the arm: its name in the catalogue, or its description in the run folder."""
    return contents.folder.arm(contents.arm.name)


def _facts(contents: Contents) -> tuple[tuple[str, str], ...]:
    info, comparison = contents.info, contents.comparison
    facts = []
    if info is not None:
        facts += [("robot", info.robot), ("arm", info.arm), ("seed", str(info.seed))]
        facts += [("begun", day_and_time(info.created)), ("made with", f"rejoint {info.version}")]
    else:
        facts += [("robot", UNKNOWN), ("arm", contents.arm.name)]
    if comparison is not None:
        if info is None or comparison.robot != info.robot:
            facts.append(("robot of the comparison", comparison.robot))
        facts.append(("seed of the comparison", str(comparison.seed)))
    facts += [
        (f"cost of {stage.name}", cost(stage))
        for stage in (contents.effort or Effort()).stages
        if stage.wall or stage.moving
    ]
    facts += [("report made with", f"rejoint {__version__}"), ("Python", platform.python_version())]
    return (*facts, ("packages on the machine of this report", _versions(_PACKAGES)))


def _versions(packages: Sequence[str]) -> str:
    found = []
    for name in packages:
        try:
            found.append(f"{name} {metadata.version(name)}")
        except metadata.PackageNotFoundError:
            continue
    return ", ".join(found)


def _targets(comparison: Comparison) -> Table:
    rows = [
        Row(cells=(Cell(f"set {s + 1}, target {k + 1}"), *(Cell(f"{value * 1e3:.1f}") for value in point)))
        for s, points in enumerate(comparison.targets[:1])
        for k, point in enumerate(points)
    ]
    more = len(comparison.targets) - 1
    notes = (f"{more} more set{'s' * (more > 1)} in comparison.json.",) if more else ()
    headers = ("target", "x [mm]", "y [mm]", "z [mm]")
    return Table(caption="Targets in the base frame", headers=headers, rows=tuple(rows), notes=notes)


def _files(contents: Contents) -> Table:
    folder = contents.folder.path
    rows = []
    for name, meaning in _FILES:
        there = name.startswith("figures") or any(folder.glob(name))
        rows.append(Row(cells=(Cell(name), Cell(meaning), Cell("yes" if there else "not yet"))))
    return Table(caption="Files", headers=("file", "what it holds", "there"), rows=tuple(rows), words=True)


def commands(contents: Contents) -> dict[str, Command]:
    """Return the command line of every stage, with all that it takes to repeat what was done."""
    run = shlex.quote(str(contents.folder.path))
    info = contents.info
    address, seed = ("ROBOT", 0) if info is None else (info.robot, info.seed)
    robot = shlex.quote(address)
    arm = "" if info is None or info.arm == DEFAULT_ARM else f" --arm {shlex.quote(_arm(contents))}"
    diagnose = f"rejoint diagnose {robot} --run {run}{arm} --seed {seed}"
    paper = recipe if (recipe := _recipe(contents)).startswith(" --preset") else ""
    repair = f"rejoint repair {robot}{arm}{paper}{_asked(contents)} --seed {seed}"
    identify = f"rejoint identify {run}"
    if info is not None and info.robot.startswith(LOGS):
        given = f"--logs {shlex.quote(info.robot.removeprefix(LOGS))} --arm {shlex.quote(_arm(contents))} --run {run}"
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
    """Return the command of the comparison that was made, or of the one that is to be made."""
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
    """Return the option by which the tool is measured; an arm in virtual time tells by itself."""
    if contents.calibration is not None and contents.calibration.source == "camera":
        return " --camera emulated" if is_virtual(robot) else " --camera 0"
    return "" if is_virtual(robot) else " --touch"


def _asked(contents: Contents) -> str:
    """Return the options of `rejoint repair` that lead to the comparison at hand, if it is one of this robot."""
    info, comparison = contents.info, contents.comparison
    if info is None or comparison is None or comparison.robot != info.robot or comparison.seed != info.seed:
        return ""
    return f"{_options(comparison)}{_measured(contents, info.robot)}"


def _measured(contents: Contents, robot: str) -> str:
    """Return the option of `rejoint repair` that says what measured the tool, where it is not what it does anyway."""
    found, virtual = contents.calibration, is_virtual(robot)
    if found is None:
        return " --calibrate none" if virtual else ""
    return (
        ""
        if virtual and found.source != "camera"
        else f" --calibrate {'tracker=FILE' if found.source == 'tracker' else found.source}"
    )


def _options(comparison: Comparison) -> str:
    """Return everything that a comparison was asked for, since what is left out is another comparison."""
    sets, repetitions = comparison.most or (len(comparison.targets), comparison.repetitions)
    drawn = f" --sets {sets}"
    targets = f" --targets {shlex.quote(comparison.targets_file)}" if comparison.targets_file else drawn
    names = shlex.quote(",".join(comparison.controllers))
    period = "" if comparison.period is None else f" --period {_milliseconds(comparison.period)}"
    whole = "" if comparison.batched or comparison.race is not None else " --full"
    return f"{targets} --repetitions {repetitions} --controllers {names}{period}{whole}"


def _milliseconds(period: tuple[float, float]) -> str:
    """Write a period [s] as `--period` reads it."""
    return "-".join(f"{1e3 * end:.9g}" for end in dict.fromkeys(period))


def _recipe(contents: Contents) -> str:
    """Return the options of `rejoint train` that name the recipe of the policy at hand, where it is not the default."""
    name = "" if contents.contract is None else contents.contract.preset
    return f" --preset {name}" if name in ("paper", "scratch") else f" --learner {name}" if name in LEARNERS else ""
