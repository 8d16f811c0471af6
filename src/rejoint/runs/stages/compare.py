"""Comparison: every controller on the same arm, with the same targets."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from rejoint.arms import Arm, Array
from rejoint.control.comparison.compare import Settings, Trial
from rejoint.control.comparison.compare import compare as compare_controllers
from rejoint.control.comparison.holding import Holding, found_errors, vary_directions
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.racing import Race
from rejoint.control.comparison.recommend import Recommendation, recommend
from rejoint.control.comparison.result import Comparison, Protocol
from rejoint.control.robot import Robot
from rejoint.diagnosis.open_loop import DWELL
from rejoint.logs.runlog import RunLog, write_log
from rejoint.robots import open_robot
from rejoint.runs.effort import metered
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
from rejoint.runs.openloop import DEFAULT, OpenLoopTrials, open_loop
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
from rejoint.runs.stages.loads import PayloadLike, Say, say_heavy, silent, with_load
from rejoint.system.errors import GuardTripError
from rejoint.system.files import digest, require_space, saving, set_aside, write_json
from rejoint.system.progress import Progress, no_progress, paced
from rejoint.system.stopping import noted
from rejoint.system.version import __version__

if TYPE_CHECKING:
    from rejoint.control.correction import Modelled
    from rejoint.diagnosis.calibration.calibration import Calibration
    from rejoint.twin.twin import Twin

SETS, REPETITIONS = 10, 6
"""Target sets and repetitions where arms are emulated or all is driven (Park et al. 2024: six repetitions)"""

RACE_SETS = 2
"""Target sets of a race at most (chosen: those of the diagnosis, and as many again where it is close)"""

RACE_PROTOCOL = Protocol(hold=DWELL)
"""A race holds each target as long as the diagnosis does, so that both measure the same"""

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
    payload: PayloadLike | None = None,
    tool: ArrayLike | None = None,
    sets: int | None = None,
    repetitions: int | None = None,
    protocol: Protocol | None = None,
    period: Period | None = None,
    directions: bool = False,
    seed: int | None = None,
    full: bool = False,
    on_progress: Progress = no_progress,
    say: Say = silent,
) -> Compared:
    """Try controllers on the same arm, with the same targets, from the same start, and recommend one.

    Emulated arms are tried side by side; on a real one the controllers race: the trials take turns, who misses three
    targets in a row or is beaten beyond doubt is driven no further, and it ends when one is left, or after all sets.
    What the diagnosis of the run measured open loop is not driven again: it is what ``default`` does. While an arm
    moves, Ctrl-C and SIGTERM first bring it to a hold; then `Interrupted` is raised, which is a KeyboardInterrupt. In a
    run, the same call then goes on after the last finished trial.

    Parameters
    ----------
    robot
        robot or its address
    controllers
        names of baselines (``default``, ``pid-sum``, ``pid-literal``, ``integrator``, ``feedforward``), ``shelf``,
        ``predictive``, policies, their files, or controllers of your own; a mapping names them. None given: all
        baselines, on a real arm without the paper's PIDs (``pid-sum``, ``pid-literal``), the policy that comes with the
        package (``shelf``) where it suits, the policy of the run, and predictive control where there is a twin
    targets
        (K, 3) or (S, K, 3) [m], or a CSV file in mm with the header ``x,y,z``; by default drawn, ten in a set; in a
        race the first ten are those of the diagnosis
    run
        run, or its folder, with the policy and the twin, into which results are written; without one nothing is
    arm
        arm, name or file; needed only without a run, where the address does not tell
    twin
        twin whose stiffness the feed-forward controller believes, on which predictive control plans, and as
        which a real arm must stand; by default that of the run
    calibration
        what lies behind the encoders, or its file: all controllers are aimed by it; ``none`` for no correction. By
        default that of ``run``
    payload
        [kg] that the hand carries at its tool centre point, or a `Payload`; everything is computed with it
    tool
        (3,) [m] from the tool centre point of the arm's description to the tip of a tool, in the frame of the former
    sets
        number of target sets that are drawn; by default 10, in a race at most 2
    repetitions
        number of times that each set is driven to by each controller; by default 6, in a race 1
    protocol
        thresholds [m] and times [s] of a trial; by default those of Park et al. 2024, and holds of eight seconds, in a
        race of five, as in the diagnosis
    period
        [s] interval of the control periods; by default what the robot suits
    directions
        whether the recommended controller also comes to five poses from three directions, in as many cycles as there
        are repetitions: vAP after ISO 9283 (on a real arm four minutes a cycle)
    seed
        of targets and an emulated arm's noise; by default that of the run, else 0
    full
        no race: a real arm is driven to all targets with every controller that does not miss three in a row
    on_progress
        called with the share that is done and what is being tried
    say
        told, in lines, which targets are too heavy, before an arm moves

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
    chosen = with_load(arm_of(robot, arm) if about is None else about.arm, robot, payload, tool)
    seed = seed or 0 if about is None else about.seed
    with exclusive(about):
        real = not is_batchable(robot)
        race = Race() if real and not full else None
        points = as_targets(targets, chosen, sets=sets or (SETS if race is None else RACE_SETS), seed=seed)
        known = as_twin(twin) if twin is not None else None if about is None else about.twin
        say_heavy(chosen, known, points, say)
        factories = make_factories(controllers, chosen, period_of(robot, period), run=about, twin=known, real=real)
        settings = Settings(
            repetitions=repetitions or (REPETITIONS if race is None else 1), seed=seed, batched=not real,
            protocol=protocol or (Protocol() if race is None else RACE_PROTOCOL), leave_out=not controllers, race=race,
        )  # fmt: skip
        model = calibration_of(calibration, about, chosen, address_of(robot))
        before = None
        if race is not None and about is not None and payload is None and tool is None:
            before = open_loop(about, address_of(robot), settings.protocol, model)
        if before is not None and targets is None:
            points[0] = before.targets
        job = _Job(
            robot=robot, arm=chosen, run=about, factories=factories, targets=points, settings=settings, period=period,
            twin=known, correct=correction_of(calibration, about, chosen, address_of(robot)),
            model=model,
            file=str(targets) if isinstance(targets, Path | str) else "", directions=directions,
            before=before if before is not None and np.array_equal(points[0], before.targets) else None,
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
    before: OpenLoopTrials | None
    """what the diagnosis measured at the first set; None where that is not known, or not wanted"""
    directions: bool

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
        before = self.before if DEFAULT in self.factories else None

        def keep(trial: Trial) -> None:
            while earlier:
                set_aside(earlier.pop())
            if (trial.target_set, trial.repetition, trial.first) == (0, 0, 0):  # one of each suffices for the figures
                logs[trial.label] = trial.log()
                if self.run is not None:
                    write_log(self.run.folder.log(trial.label), logs[trial.label])

        with noted(), metered(self.run.folder if self.run else None, "compare") as meter:

            def watched(count: int, seed: int) -> Robot:
                return meter.watch(self._open(count, seed))

            result = compare_controllers(
                watched, self.factories, self.targets, self.settings, on_progress=on_progress, on_trial=keep,
                ledger=ledger, limits=guard_limits(self.run, self.arm, address_of(self.robot)),
                stance=stance_of(self.twin), correction=self.correct, model=self.model,
                measured=() if before is None else before.driven, source=SOURCE,
            )  # fmt: skip
            result = self._beside(result, before, watched)
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
            open_robot=opened, batched=self.settings.batched, seed=self.settings.seed, stance=stance_of(self.twin),
            limits=guard_limits(self.run, self.arm, address_of(self.robot)), correction=self.correct, model=self.model,
        )  # fmt: skip
        protocol, own = self.settings.protocol, self.factories.get(DEFAULT)
        with suppress(GuardTripError):  # neither is worth a comparison that is decided
            if self.correct is not None and before is not None:
                result = replace(result, as_found=before.errors())
            elif self.correct is not None and own is not None:
                result = replace(result, as_found=found_errors(how, own, self.targets[0], protocol))
            if self.directions:
                best = recommend(result).controller
                found = vary_directions(how, best, self.factories[best], self.arm, self.settings.repetitions, protocol)
                result = replace(result, directions=found)
        return result

    def _open(self, count: int, seed: int) -> Robot:
        if not isinstance(self.robot, str):
            return borrowed(self.robot)
        return open_robot(self.robot, arm=self.arm, seed=seed, count=count, period=self.period, threads=THREADS)

    def _digest(self, run: Run) -> str:
        """Digest of all that decides what a comparison finds."""
        used = run.folder.policy, run.folder.twin, run.folder.gains
        files = [digest(path.read_bytes()).decode() for path in used if path.exists()]
        about = (
            __version__, address_of(self.robot), repr(self.arm), repr(self.settings), tuple(self.factories),
            self.period, files, self.targets.tolist(), repr(self.correct), self.before is None,
        )  # fmt: skip
        return digest(repr(about).encode()).decode()
