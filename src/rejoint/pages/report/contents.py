"""Everything that a run folder holds, read once; each stage's part is None where it has not been run."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from rejoint.arms import Arm, load_arm
from rejoint.control.comparison.result import Comparison
from rejoint.control.contract import PolicyContract
from rejoint.control.policy import load_policy
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.file import read_calibration
from rejoint.diagnosis.calibration.measurementfile import read_measurements
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.logs.runfolder.effort import Effort, read_effort
from rejoint.logs.runfolder.folder import RunFolder, RunInfo, read_info
from rejoint.logs.runfolder.kept import Kept
from rejoint.logs.runlog import RunLog, read_log
from rejoint.pages.report.sections.training import Curves, read_curves
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import read_json
from rejoint.twin.file import read_twin
from rejoint.twin.judgement import Judgement
from rejoint.twin.twin import Twin

T = TypeVar("T")

_TRIAL = re.compile(r"(crossing|hold)-(.+)-(\d+)-(\d+)")
"""Names of the trials' run logs: protocol, controller, target set, repetition"""

DEFAULT_ARM = "mycobot280"
"""Arm of a folder with a policy or training curves alone, which do not name it before it is known"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Contents:
    """What is known of a run."""

    folder: RunFolder
    arm: Arm
    info: RunInfo | None
    diagnosis: Diagnosis | None
    twin: Twin | None
    judgement: Judgement | None
    """of the twin and others, where it was fitted to logs alone"""
    curves: Curves | None
    contract: PolicyContract | None
    comparison: Comparison | None
    calibration: Calibration | None
    """what lies behind the encoders"""
    measurements: Measurements | None
    """where the tool was seen from outside"""
    crossing: Mapping[str, RunLog]
    """one trial of the paper's protocol per controller"""
    hold: Mapping[str, RunLog]
    """one trial of the hold protocol per controller"""
    effort: Effort | None = None
    """what the stages cost"""
    kept: Kept | None = None
    """from which earlier repair twin and policy are"""


def read_contents(path: Path) -> Contents:
    """Read a run folder; FileError names a damaged file, or the folder if nothing in it can be reported."""
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
        folder=folder, arm=arm, info=info, diagnosis=diagnosis, twin=twin, judgement=judgement, curves=curves,
        contract=contract, comparison=comparison, calibration=calibration, measurements=measurements,
        crossing=_trials(folder, "crossing", known),
        hold=_trials(folder, "hold", known), effort=read_effort(folder),
        kept=_optional(folder.kept, lambda file: read_json(file, Kept)),
    )  # fmt: skip


def _optional(path: Path, read: Callable[[Path], T]) -> T | None:
    return read(path) if path.exists() else None


def _arm(path: Path, sources: list[str], names: list[str]) -> Arm:
    """Build the arm of the first of ``sources`` (a name or a file); all ``names`` must be its name."""
    try:
        arm = load_arm(sources[0] if sources else DEFAULT_ARM)
    except InputError as error:
        raise FileError(path, f"the arm of this run cannot be built ({error})", "bring its description back") from error
    others = sorted({name for name in names if name != arm.name})
    if others:
        found = ", ".join([arm.name, *others])
        raise FileError(path, f"its files are about different arms ({found})", "keep every arm in a folder of its own")
    return arm


def _trials(folder: RunFolder, protocol: str, controllers: tuple[str, ...]) -> dict[str, RunLog]:
    """Read the first trial of each controller, in the order of ``controllers``."""
    found: dict[str, tuple[int, int, Path]] = {}
    for name, path in folder.logs().items():
        match = _TRIAL.fullmatch(name)
        if match and match[1] == protocol and match[2] in controllers:
            trial = (int(match[3]), int(match[4]), path)
            found[match[2]] = min(found.get(match[2], trial), trial)
    return {name: read_log(found[name][2]) for name in controllers if name in found}
