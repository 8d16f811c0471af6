"""One piece of work on one arm, done in whichever process: a check, or a stage of a repair, files in, files out."""

from __future__ import annotations

import time
import traceback
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, TypeAlias

from rejoint.runs.chain import MOVING, StageName
from rejoint.runs.fleet.file import FleetArm
from rejoint.system.errors import RejointError, first_line
from rejoint.system.extras import explain
from rejoint.system.progress import Progress, no_progress
from rejoint.system.stopping import Interrupted

Step: TypeAlias = Literal["check"] | StageName


@dataclass(frozen=True, kw_only=True)
class RepairOptions:
    """What a repair of every arm is asked for, as `rejoint.repair` takes it."""

    preset: str = "default"
    controllers: tuple[str, ...] = ()
    sets: int | None = None
    repetitions: int | None = None
    seed: int | None = None
    quick: bool = False
    needed: bool = False
    """whether each arm is checked first, and repaired only where the check says so"""


@dataclass(frozen=True, kw_only=True)
class Work:
    """One step of one arm."""

    arm: FleetArm
    step: Step
    folder: Path
    """of a check: below which all runs and checks are; of a stage: the run"""
    options: RepairOptions = field(default_factory=RepairOptions)

    @property
    def moves(self) -> bool:
        """Whether the arm moves."""
        return self.step == "check" or self.step in MOVING

    @property
    def held(self) -> bool:
        """Whether somebody has to hold a connection for it: the arm moves, and is real."""
        return self.moves and not self.arm.virtual


@dataclass(frozen=True, kw_only=True)
class WorkOutcome:
    """How a piece of work ended; what it found is in its files."""

    seconds: float
    """[s] that it took"""
    problem: str = ""
    """why it failed, in one line; empty where it did not"""
    kind: str = ""
    """name of the error"""
    code: int = 0
    """exit code of the command line for that error"""
    trace: str = ""
    """where a bug is; empty for everything expected"""


@dataclass(frozen=True, kw_only=True)
class Lost:
    """What was at work is gone: a process that was killed, a node that does not answer."""

    why: str


def do_work(work: Work, on_progress: Progress = no_progress) -> WorkOutcome:
    """Do one piece of work; whatever goes wrong is in the outcome, so that it reaches who leads."""
    begun = time.monotonic()
    try:
        _do(work, on_progress)
    except Interrupted as error:
        return _failed(begun, "held, as it was asked to stop", error, error.exit_code)
    except RejointError as error:
        notes = "".join(f"; {note}" for note in getattr(error, "__notes__", ()))
        return _failed(begun, f"{error}{notes}", error, error.exit_code)
    except Exception as error:  # noqa: BLE001 - a bug in one arm's work is no end of the others'
        missing = explain(error) if isinstance(error, ImportError) else None
        if missing is not None:
            return _failed(begun, missing, error, 2)
        trace = "".join(traceback.format_exception(error))
        return _failed(begun, f"a bug: {type(error).__name__}: {first_line(error)}", error, 1, trace)
    return WorkOutcome(seconds=time.monotonic() - begun)


def _do(work: Work, on_progress: Progress) -> None:
    arm, options = work.arm, work.options
    if work.step == "check":
        from rejoint.runs.stages.check import check

        check(
            arm.address, history=work.folder, name=arm.name, arm=arm.description, tolerance_mm=arm.tolerance_mm,
            on_progress=on_progress,
        )  # fmt: skip
        return
    from rejoint.runs.repair import repair  # late: a process that only checks arms needs none of its stages

    repair(
        arm.address, run=work.folder, arm=arm.description, preset=options.preset, controllers=options.controllers,
        sets=options.sets, repetitions=options.repetitions, seed=options.seed, quick=options.quick,
        on_progress=on_progress, only=work.step,
    )  # fmt: skip


def _failed(begun: float, problem: str, error: BaseException, code: int, trace: str = "") -> WorkOutcome:
    return WorkOutcome(
        seconds=time.monotonic() - begun, problem=problem, kind=type(error).__name__, code=code, trace=trace
    )  # fmt: skip
