"""The stages of a repair in their order: each is done where its file is not there yet, and says how it stands."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeVar, get_args

from rejoint.control.comparison.recommend import recommend
from rejoint.logs.runfolder.effort import StageCost, add
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.robots import place_of
from rejoint.runs.given import NO_GAUGE, GaugeLike, RobotLike, is_batchable
from rejoint.runs.run import Run
from rejoint.runs.stages.comparing import Compared
from rejoint.runs.stages.controllers import Controllers, any_geared
from rejoint.runs.stages.diagnose import Diagnosed
from rejoint.system.errors import FileError
from rejoint.system.memory import give_back
from rejoint.system.progress import Progress, part

if TYPE_CHECKING:
    from rejoint.arms import Arm

Found = TypeVar("Found")

StageName = Literal["diagnose", "calibrate", "identify", "gains", "train", "compare", "report"]
STAGES: tuple[StageName, ...] = get_args(StageName)
MOVING: tuple[StageName, ...] = ("diagnose", "calibrate", "gains", "compare")
"""Stages in which the arm moves"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stage:
    """How a stage of a repair stands."""

    name: StageName
    state: Literal["started", "kept", "done"]
    """kept: an earlier call has done it, as it was asked for then"""
    file: Path
    """by which the stage counts as done"""
    number: int
    """its place among the stages of this repair, from 1"""
    total: int
    """number of them"""
    why: str = ""
    """it is kept, where not for being done already"""
    result: object = None
    """what the function of the same name returned; of what is kept, diagnosis and comparison only"""


OnStage = Callable[[Stage], object]
"""Called when a stage starts, when it is done, and instead of both where it is kept."""


def there(found: Found | None) -> Found:
    """Return what a finished run has found; FileError if its file was removed since."""
    if found is None:
        raise FileError("run folder", "a file of a finished repair is missing", "repair again")
    return found


def stages_of(
    robot: RobotLike, arm: Arm, files: RunFolder, *, controllers: Controllers = (), gauge: GaugeLike | None = None,
    quick: bool = False,
) -> dict[StageName, Path]:  # fmt: skip
    """Name the stages of a repair in their order, each with the file by which it counts as done."""
    places = (
        files.diagnosis, files.calibration, files.twin, files.gains, files.policy, files.comparison, files.report,
    )  # fmt: skip
    found: dict[StageName, Path] = dict(zip(STAGES, places, strict=True))
    if gauge == NO_GAUGE or (gauge is None and not is_batchable(robot)):
        del found["calibrate"]
    rivals = not controllers and not quick
    if not (isinstance(robot, str) and place_of(robot).tunable(arm) and (rivals or any_geared(controllers))):
        del found["gains"]
    return found


class Chain:
    """Stages that are done only where their file is not there yet; the report is always written anew."""

    def __init__(
        self, run: Run, files: dict[StageName, Path], on_stage: OnStage | None, on_progress: Progress, *,
        only: StageName | None,
    ) -> None:  # fmt: skip
        self.run, self._files, self._on_stage, self._on_progress = run, files, on_stage, on_progress
        self._only, self.why = only, ""
        """a stage to do alone; why twin and policy are those of an earlier repair"""

    def do(self, name: StageName, work: Callable[[Progress], object]) -> None:
        """Do a stage, or say that it is done already."""
        if name not in self._files or self._only not in (None, name):
            return
        file, number, total = self._files[name], list(self._files).index(name), len(self._files)
        if name != "report" and file.exists():
            self._say(
                Stage(
                    name=name,
                    state="kept",
                    file=file,
                    number=number + 1,
                    total=total,
                    result=self._kept(name),
                    why=self.why if name in ("identify", "gains", "train") else "",
                )
            )
            return
        self._say(Stage(name=name, state="started", file=file, number=number + 1, total=total))
        begun = time.monotonic()
        share = (number / total, (number + 1) / total) if self._only is None else (0.0, 1.0)
        try:
            result = work(part(self._on_progress, *share))
        finally:
            add(self.run.folder, StageCost(name=name, wall=time.monotonic() - begun))
            give_back()
        self._say(Stage(name=name, state="done", file=file, number=number + 1, total=total, result=result))

    def _kept(self, name: StageName) -> object:
        """Return what an earlier call has found, as far as it is on file."""
        if name == "diagnose":
            return Diagnosed(diagnosis=there(self.run.diagnosis))
        if name == "compare":
            comparison = there(self.run.comparison)
            return Compared(comparison=comparison, recommendation=recommend(comparison))
        return None

    def _say(self, stage: Stage) -> None:
        if self._on_stage is not None:
            self._on_stage(stage)
