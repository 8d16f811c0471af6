"""The last section: versions, seeds, targets, files, and the commands that repeat each part."""

from __future__ import annotations

import platform
import shlex
from collections.abc import Sequence
from importlib import metadata

from rejoint import __version__
from rejoint.comparison.result import Comparison
from rejoint.report.contents import Contents
from rejoint.report.numerals import UNKNOWN
from rejoint.report.view import Cell, Command, Part, Row, Section, Table
from rejoint.runs import LOGS

KEY, SHORT, HEADING = "details", "Details", "Details"

_PACKAGES = ("numpy", "mujoco", "torch", "skrl", "onnxruntime", "pymycobot", "matplotlib")

_FILES = (
    ("run.json", "robot, arm, seed"),
    ("diagnosis.json", "what is wrong with the arm, per joint"),
    ("twin.toml", "the identified twin with its intervals"),
    ("judgement.json", "that twin and others judged on motion that no fit has seen"),
    ("policy.onnx", "the trained policy with its contract"),
    ("training/curves.parquet", "training curves, one row per update"),
    ("comparison.json", "every controller: results per target, statistics"),
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
        facts += [("robot", info.robot), ("arm", info.arm), ("seed", str(info.seed)), ("begun", info.created)]
        facts.append(("made with", f"rejoint {info.version}"))
    else:
        facts += [("robot", UNKNOWN), ("arm", contents.arm.name)]
    if comparison is not None:
        if info is None or comparison.robot != info.robot:
            facts.append(("robot of the comparison", comparison.robot))
        facts.append(("seed of the comparison", str(comparison.seed)))
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
    notes = (f"{more} more in comparison.json.",) if more else ()
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
    """Return the command line of every stage."""
    run = shlex.quote(str(contents.folder.path))
    info = contents.info
    robot, seed = ("ROBOT", 0) if info is None else (shlex.quote(info.robot), info.seed)
    diagnose = f"rejoint diagnose {robot} --run {run} --seed {seed}"
    identify = f"rejoint identify {run}"
    if info is not None and info.robot.startswith(LOGS):
        given = f"--logs {shlex.quote(info.robot.removeprefix(LOGS))} --arm {shlex.quote(_arm(contents))} --run {run}"
        robot, diagnose, identify = "ROBOT", f"rejoint diagnose {given}", f"rejoint identify {given}"
    return {
        "repair": Command("Everything, from the beginning:", f"rejoint repair {robot} --seed {seed}"),
        "diagnose": Command("Measure and judge the arm:", diagnose),
        "identify": Command("Fit the twin:", identify),
        "train": Command("Train the policy:", f"rejoint train {run}"),
        "compare": Command("Try every controller on the arm:", f"rejoint compare {robot} {run}"),
        "report": Command("Make this page again:", f"rejoint report {run}"),
    }
