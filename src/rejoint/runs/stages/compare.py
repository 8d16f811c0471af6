"""Comparison: every controller on the same arm, with the same targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rejoint.arms import Arm, Array
from rejoint.control.comparison.compare import Settings, Trial
from rejoint.control.comparison.compare import compare as compare_controllers
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison, Protocol
from rejoint.control.robot import Robot
from rejoint.logs.runlog import RunLog, write_log
from rejoint.robots import open_robot
from rejoint.runs.given import (
    ArmLike,
    CalibrationLike,
    Period,
    RobotLike,
    RunLike,
    Targets,
    TwinLike,
    address_of,
    arm_of,
    as_run,
    as_targets,
    as_twin,
    borrowed,
    is_batchable,
    period_of,
)
from rejoint.runs.history.summary import summarise
from rejoint.runs.run import Run, exclusive
from rejoint.runs.stages.driving import (
    Controllers,
    Factory,
    calibration_of,
    correction_of,
    guard_limits,
    make_factories,
    stance_of,
)
from rejoint.system.files import digest, require_space, saving, set_aside, write_json
from rejoint.system.progress import Progress, no_progress, paced
from rejoint.system.stopping import noted
from rejoint.system.version import __version__

if TYPE_CHECKING:
    from rejoint.control.correction import Modelled
    from rejoint.diagnosis.calibration.calibration import Calibration
    from rejoint.twin.twin import Twin

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


@paced
def compare(
    robot: RobotLike,
    controllers: Controllers = (),
    targets: Targets | None = None,
    *,
    run: RunLike | None = None,
    arm: ArmLike | None = None,
    twin: TwinLike | None = None,
    calibration: CalibrationLike | None = None,
    sets: int = 10,
    repetitions: int = 6,
    protocol: Protocol | None = None,
    period: Period | None = None,
    seed: int | None = None,
    on_progress: Progress = no_progress,
) -> Compared:
    """Try controllers on the same arm, with the same targets, from the same start, and recommend one.

    Emulated arms are tried side by side; on a real one the trials take turns, and a controller that misses three
    targets in a row is out. While an arm moves, Ctrl-C and SIGTERM first bring it to a hold; then `Interrupted` is
    raised, which is a KeyboardInterrupt. In a run, the same call then goes on after the last finished trial.

    Parameters
    ----------
    robot
        robot or its address
    controllers
        names of baselines (``default``, ``pid-sum``, ``pid-literal``, ``integrator``, ``feedforward``), policies, their
        files, or controllers of your own; a mapping names them. None given: all baselines, and the policy of the run
    targets
        (K, 3) or (S, K, 3) [m], or a CSV file in mm with the header ``x,y,z``; by default drawn, ten in a set
    run
        run, or its folder, with the policy and the twin, into which results are written; without one nothing is
    arm
        arm, name or file; needed only without a run, where the address does not tell
    twin
        twin whose stiffness the feed-forward controller believes, and as
        which a real arm must stand; by default that of the run
    calibration
        what lies behind the encoders, or its file: all controllers are aimed by it; ``none`` for no correction. By
        default that of ``run``
    sets
        number of target sets that are drawn
    repetitions
        number of times that each set is driven to by each controller
    protocol
        thresholds [m] and times [s] of a trial; by default those of Park et al. 2024, and holds of eight seconds
    period
        [s] interval of the control periods; by default what the robot suits
    seed
        of targets and an emulated arm's noise; by default that of the run, else 0
    on_progress
        called with the share that is done and what is being tried

    Returns
    -------
    Compared
        ``recommendation``, the whole ``comparison``, and one log of each controller

    Raises
    ------
    InputError, ContractError
        if a controller, its control period or the targets do not fit; nothing has moved
    GuardTripError, RobotError
        if the motion of a real arm had to be ended
    UnsavedError
        if the result could not be written; it is in the error

    Examples
    --------
    >>> found = rejoint.compare("emulated:worn", ["integrator", policy], sets=1, repetitions=2)
    >>> print(found.recommendation.controller, *found.recommendation.why)
    >>> print(found.comparison.row("integrator").hold.settled.mean.value)  # metres
    """
    about = None if run is None else as_run(run).seeded(seed)
    chosen = arm_of(robot, arm) if about is None else about.arm
    seed = seed or 0 if about is None else about.seed
    with exclusive(about):
        points = as_targets(targets, chosen, sets=sets, seed=seed)
        known = as_twin(twin) if twin is not None else None if about is None else about.twin
        factories = make_factories(controllers, chosen, period_of(robot, period), run=about, twin=known)
        settings = Settings(
            repetitions=repetitions, seed=seed, batched=is_batchable(robot), protocol=protocol or Protocol(),
            leave_out=not controllers,
        )  # fmt: skip
        job = _Job(
            robot=robot, arm=chosen, run=about, factories=factories, targets=points, settings=settings, period=period,
            twin=known, correct=correction_of(calibration, about, chosen, address_of(robot)),
            model=calibration_of(calibration, about, chosen, address_of(robot)),
            file=str(targets) if isinstance(targets, Path | str) else "",
        )  # fmt: skip
        return job.drive(on_progress)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Job:
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

    def drive(self, on_progress: Progress) -> Compared:
        """Compare; in a run, go on after the trials that are done there, and write what comes out."""
        run = self.run
        if run is None:
            return self._drive(Ledger.nowhere(), [], on_progress)
        require_space(run.path)
        ledger = Ledger.begin(run.folder.trials, self._digest(run))
        try:
            found = self._drive(ledger, [] if ledger.done else list(run.folder.trial_logs()), on_progress)
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

    def _drive(self, ledger: Ledger, earlier: list[Path], on_progress: Progress) -> Compared:
        """Drive all trials; logs of an ``earlier`` comparison make room for the first of this one."""
        logs: dict[str, RunLog] = {}

        def keep(trial: Trial) -> None:
            while earlier:
                set_aside(earlier.pop())
            if (trial.target_set, trial.repetition) == (0, 0):  # one of each suffices for the figures
                logs[trial.label] = trial.log()
                if self.run is not None:
                    write_log(self.run.folder.log(trial.label), logs[trial.label])

        with noted():
            result = compare_controllers(
                self._open, self.factories, self.targets, self.settings, on_progress=on_progress, on_trial=keep,
                ledger=ledger, limits=guard_limits(self.run, self.arm, address_of(self.robot)),
                stance=stance_of(self.twin), correction=self.correct, model=self.model,
            )  # fmt: skip
        by = "" if self.model is None else self.model.date
        result = replace(result, targets_file=self.file, period=self.period, calibration=by)
        return Compared(comparison=result, recommendation=recommend(result), logs=logs)

    def _open(self, count: int, seed: int) -> Robot:
        if not isinstance(self.robot, str):
            return borrowed(self.robot)
        return open_robot(self.robot, arm=self.arm, seed=seed, count=count, period=self.period, threads=THREADS)

    def _digest(self, run: Run) -> str:
        """Digest of all that decides what a comparison finds."""
        files = [digest(path.read_bytes()).decode() for path in (run.folder.policy, run.folder.twin) if path.exists()]
        about = (
            __version__, address_of(self.robot), repr(self.arm), repr(self.settings), tuple(self.factories),
            self.period, files, self.targets.tolist(), repr(self.correct),
        )  # fmt: skip
        return digest(repr(about).encode()).decode()
