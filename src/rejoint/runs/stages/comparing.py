"""A comparison as it is driven: trials kept one by one, gone on with where it was, written whole."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.arms import Arm, Array
from rejoint.control.comparison.compare import Settings, Trial
from rejoint.control.comparison.compare import compare as compare_controllers
from rejoint.control.comparison.holding import Holding, found_errors, vary_directions
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison
from rejoint.control.comparison.sharing import Helper
from rejoint.control.robot import Robot
from rejoint.logs.runlog import RunLog, write_log
from rejoint.robots import open_robot
from rejoint.runs.given import (
    Live,
    Period,
    RobotLike,
    address_of,
    borrowed,
    shown,
)
from rejoint.runs.history.summary import summarise
from rejoint.runs.metering import metered
from rejoint.runs.openloop import DEFAULT, OpenLoopTrials
from rejoint.runs.run import Run
from rejoint.runs.stages.controllers import Factory
from rejoint.runs.stages.early import EarlyTrials
from rejoint.runs.stages.helper import LEAST, HelperProcess, Job, core_to_spare
from rejoint.runs.stages.keeping import kept_if_stopped
from rejoint.runs.stages.known import guard_limits, stance_of
from rejoint.system.errors import GuardTripError
from rejoint.system.files import digest, require_space, saving, set_aside, write_json
from rejoint.system.progress import Progress
from rejoint.system.stopping import noted
from rejoint.system.version import __version__

if TYPE_CHECKING:
    from rejoint.arms.orientation import Orientation
    from rejoint.control.correction import Modelled
    from rejoint.diagnosis.calibration.calibration import Calibration
    from rejoint.twin.twin import Twin

SOURCE = "the diagnosis"
"""Whence the first row of a race is"""

THREADS = 2
"""of emulated arms that move side by side (chosen: results do not depend on it)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """What a comparison found, and which controller to use."""

    comparison: Comparison
    """a row of numbers for each controller, with intervals"""
    recommendation: Recommendation
    """the controller to use, and why"""
    logs: dict[str, RunLog] = field(default_factory=dict)
    """one run log of each controller and protocol that was driven, by its label, such as ``hold/policy/0/0``"""


@dataclass(frozen=True, kw_only=True, eq=False)
class ComparisonJob:
    """What a comparison is to do."""

    robot: RobotLike
    arm: Arm
    run: Run | None
    factories: dict[str, Factory]
    targets: Array
    settings: Settings
    period: Period | None
    twin: Twin | None
    correct: Callable[[Arm], Modelled] | None
    model: Calibration | None
    file: str
    """of the targets; empty where there is none"""
    before: OpenLoopTrials | None
    """what the diagnosis measured at the first set; None where that is not known, or not wanted"""
    directions: bool
    turns: Orientation | None = None
    """(S, K) how the tools are to be turned at the targets; None where that does not matter"""
    live: Live | None = None
    by_name: bool = False
    """whether another process can make the controllers, from their names"""

    def drive(self, on_progress: Progress, ahead: EarlyTrials | None = None) -> Compared:
        """Compare; in a run, go on after the trials that are done there, and write what comes out.

        What ``ahead`` has driven is taken over.
        """
        run = self.run
        if run is None:
            return self._drive(Ledger.nowhere(), [], on_progress, ahead)
        require_space(run.path)
        ledger = Ledger.begin(run.folder.trials, self._digest(run))
        try:
            found = self._drive(ledger, [] if ledger.done else list(run.folder.trial_logs()), on_progress, ahead)
        except BaseException as error:
            if ledger.done:
                kept = f"What was tried until then is kept ({len(ledger.done)} runs): the same command goes on."
                error.add_note(kept)
            else:
                ledger.close()
            raise
        with saving(found):
            set_aside(run.folder.comparison)
            write_json(run.folder.comparison, found.comparison)
            ledger.close()
            summarise(run)
        return found

    def _drive(self, ledger: Ledger, earlier: list[Path], on_progress: Progress, ahead: EarlyTrials | None) -> Compared:
        """Drive all trials; logs of an ``earlier`` comparison make room for the first of this one."""
        logs: dict[str, RunLog] = {}
        before = self.before if DEFAULT in self.factories else None

        def keep(trial: Trial) -> None:
            while earlier:
                set_aside(earlier.pop())
            if (trial.target_set, trial.repetition, trial.first) == (0, 0, 0):  # one of each suffices for the figures
                logs[trial.label] = trial.log()
                if self.run is not None:
                    write_log(self.run.folder.log(trial.label), logs[trial.label])

        with (
            noted(), metered(self.run.folder if self.run else None, "compare") as meter, self._helped(ahead) as helper,
            kept_if_stopped(None if self.settings.batched else self.run, "compare"),
        ):  # fmt: skip

            def watched(count: int, seed: int) -> Robot:
                return meter.watch(self._open(count, seed))

            result = compare_controllers(
                watched, self.factories, self.targets, self.settings, on_progress=on_progress, on_trial=keep,
                ledger=ledger, limits=guard_limits(self.run, self.arm, address_of(self.robot)),
                stance=stance_of(self.twin, self.run), correction=self.correct, model=self.model,
                measured=() if before is None else (before.driven,), source=SOURCE, turns=self.turns,
                helper=helper,
            )  # fmt: skip
            result = self._beside(result, before, self._open if self.settings.batched else watched)
        if before is not None and self.run is not None:
            logs[before.log.label] = before.log
            write_log(self.run.folder.log(before.log.label), before.log)
        by = "" if self.model is None else self.model.date
        result = replace(result, targets_file=self.file, period=self.period, calibration=by)
        return Compared(comparison=result, recommendation=recommend(result), logs=logs)

    def _beside(
        self, result: Comparison, before: OpenLoopTrials | None, opened: Callable[[int, int], Robot]
    ) -> Comparison:
        """Add what stands beside the controllers: the arm as it was found, and poses from several directions."""
        how = Holding(
            open_robot=opened, batched=self.settings.batched, seed=self.settings.seed,
            stance=stance_of(self.twin, self.run),
            limits=guard_limits(self.run, self.arm, address_of(self.robot)), correction=self.correct, model=self.model,
        )  # fmt: skip
        protocol, own = self.settings.protocol, self.factories.get(DEFAULT)
        try:
            if self.correct is not None and before is not None:
                result = replace(result, as_found=before.errors())
            elif self.correct is not None and own is not None and self.turns is None:
                result = replace(result, as_found=found_errors(how, own, self.targets[0], protocol))
            if self.directions:
                best = recommend(result).controller
                found = vary_directions(how, best, self.factories[best], self.arm, self.settings.repetitions, protocol)
                result = replace(result, directions=found)
        except GuardTripError as error:  # neither is worth a comparison that is decided
            told = f"What is driven beside a comparison was ended early, and the rest of it left out: {error}."
            result = replace(result, left_out=(*result.left_out, told))
        return result

    def begin_ahead(self) -> EarlyTrials | None:
        """Begin the trials in a second process, for a later job that has more controllers; close it then."""
        return EarlyTrials(self._work()) if self._shareable() else None

    @contextmanager
    def _helped(self, ahead: EarlyTrials | None) -> Iterator[Helper | None]:
        """Have a second process beside this one, where it can drive the same trials and there is enough to do."""
        if not self._shareable():
            yield None
        elif ahead is not None:
            ahead.settle()
            yield ahead
        else:
            with closing(HelperProcess(self._work())) as helper:
                yield helper

    def _shareable(self) -> bool:
        settings = self.settings
        size = 2 * self.targets.shape[0] * self.targets.shape[1] * settings.repetitions * len(self.factories)
        plain = self.by_name and isinstance(self.robot, str) and self.live is None
        return plain and settings.batched and size >= LEAST and core_to_spare()

    def _work(self) -> Job:
        """Return what a second process must know."""
        return Job(
            robot=str(self.robot), arm=self.arm, run=None if self.run is None else self.run.path, twin=self.twin,
            period=self.period, names=tuple(self.factories), targets=self.targets, turns=self.turns,
            settings=self.settings, limits=guard_limits(self.run, self.arm, address_of(self.robot)),
            correct=self.correct,
        )  # fmt: skip

    def _open(self, count: int, seed: int) -> Robot:
        if not isinstance(self.robot, str):
            robot = borrowed(self.robot)
        else:
            robot = open_robot(self.robot, arm=self.arm, seed=seed, count=count, period=self.period, threads=THREADS)
        return shown(self.live, robot, twin=self.twin, within=self.settings.protocol.threshold)

    def _digest(self, run: Run) -> str:
        """Digest of all that decides what a comparison finds."""
        used = run.folder.policy, run.folder.twin, run.folder.gains
        files = [digest(path.read_bytes()).decode() for path in used if path.exists()]
        about = (
            __version__, address_of(self.robot), repr(self.arm), repr(self.settings), tuple(self.factories),
            self.period, files, self.targets.tolist(), repr(self.correct), self.before is None,
        )  # fmt: skip
        if self.turns is not None:
            asked = self.turns.rotation, self.turns.whole, self.turns.weight
            about = (*about, *(part.tolist() for part in asked))
        return digest(repr(about).encode()).decode()
