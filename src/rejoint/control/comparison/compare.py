"""Try every controller on one arm, with the same targets and start.

Emulated arms run all trials of a controller as one batch with equal noise. A real arm runs them in random order: drift
favours none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import KW_ONLY, dataclass, field, replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.rotations import Orientation
from rejoint.control.comparison.elimination import MISSES, Elimination, Watched, missed_in_a_row, worse
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.protocols import (
    KINDS,
    Driven,
    Kind,
    Place,
    Places,
    Tally,
    comparison_of,
    measure,
    schedule,
)
from rejoint.control.comparison.result import Comparison, Protocol
from rejoint.control.contract import check_controller_period
from rejoint.control.controller import Controller
from rejoint.control.correction import Modelled, ToolModel
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import run
from rejoint.control.recording import Cycle, Recording
from rejoint.control.reference import TargetSequence
from rejoint.control.robot import Robot
from rejoint.control.servogains import limits_under, require_gains, under_gains
from rejoint.control.start import Stance, begin, move
from rejoint.control.targets import in_words
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import ContractError, InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.system.stopping import pause

PROGRESS_CYCLES = 40
"""(chosen)"""


class Targets:
    """Progress over targets."""

    def __init__(self, report: Progress, total: int) -> None:
        self._report, self._total = report, total
        self._done = self._size = self._cycles = 0
        self._text = ""

    def watch(self, text: str, size: int) -> Callable[[Cycle], None]:
        """Begin ``size`` targets labelled ``text``; the result receives every cycle."""
        self._text, self._size, self._cycles = text, size, 0
        return self._see

    def finish(self) -> None:
        """Count them as done."""
        self._done += self._size
        self._report(self._done / self._total, self._text)

    def skip(self, size: int) -> None:
        """Count ``size`` targets as done."""
        self._size = size
        self.finish()

    def skip_rest(self) -> None:
        """Count all others as done."""
        if self._done < self._total:
            self.skip(self._total - self._done)

    def _see(self, cycle: Cycle) -> None:
        if self._cycles % PROGRESS_CYCLES == 0:
            self._report((self._done + int(cycle.target_index.sum())) / self._total, self._text)
        self._cycles += 1


OpenRobot = Callable[[int, int], Robot]
"""(arms, noise seed) to a robot"""
ControllerFactory = Callable[[Arm], Controller]
MakeCorrection = Callable[[Arm], Modelled]


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One target set with one controller."""

    controller: str
    kind: Kind
    target_set: int
    repetition: int
    recording: Recording
    arm_index: int
    first: int = 0

    @property
    def label(self) -> str:
        """Such as ``hold/policy/0/2``: protocol, controller, target set, repetition."""
        return f"{self.kind}/{self.controller}/{self.target_set}/{self.repetition}"

    def log(self) -> RunLog:
        """Run log."""
        return self.recording.log(self.arm_index, self.label)


OnTrial = Callable[[Trial], object]
Task = tuple[str, Kind]
Result = tuple[Driven, Recording]
Helper = Callable[[Task, Places], Future[Result]]
"""Drives the trials of a task elsewhere"""

_LOOK = 0.02  # [s]

MOST = 10_000
"""Target sets times repetitions (chosen)"""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of a comparison."""

    repetitions: int = 1
    seed: int = 0
    batched: bool
    """side by side on emulated arms"""
    protocol: Protocol = field(default_factory=Protocol)
    leave_out: bool = False
    """a policy of another period"""
    elimination: Elimination | None = None
    wait: bool = False
    """wait for uncrossed targets of a stationary arm, as in the paper"""

    def __post_init__(self) -> None:
        if self.repetitions < 1:
            raise InputError(f"comparison: repetitions must be at least 1, got {self.repetitions}")
        if self.batched and self.elimination is not None:
            raise InputError("comparison: arms side by side are all driven to the end, none is eliminated")


LONG_GAP = 2.0
"""[s] that repeats a trial (chosen)"""
REPEATS = 2
"""of such a trial (chosen)"""


@dataclass(eq=False)
class TrialRunner:
    """Compares controllers.

    A guard trip fails a trial of a batch. On one arm it ends the comparison, as a robot's error does. A command that is
    not a number fails the trial.
    """

    open_robot: OpenRobot
    controllers: Mapping[str, ControllerFactory]
    targets: Array
    """(S, K, 3) [m]"""
    settings: Settings
    _: KW_ONLY
    turns: Orientation | None = None
    """(S, K); None: any"""
    limits: GuardLimits | None = None
    stance: Stance | None = None
    correction: MakeCorrection | None = None
    model: ToolModel | None = None
    """estimates unknown tool errors"""
    ledger: Ledger | None = None
    on_progress: Progress = no_progress
    on_trial: OnTrial | None = None
    measured: Sequence[Driven] = ()
    source: str = ""
    helper: Helper | None = None

    def __post_init__(self) -> None:
        targets, settings = np.asarray(self.targets, dtype=float), self.settings
        if targets.ndim != 3 or targets.shape[2] != 3 or 0 in targets.shape or not np.isfinite(targets).all():
            raise InputError(f"comparison: targets have shape {targets.shape}, expected finite (sets, targets, 3)")
        if not self.controllers:
            raise InputError("comparison: no controllers given")
        sets, count = targets.shape[:2]
        if sets * settings.repetitions > MOST:
            raise InputError(
                f"comparison: {sets} sets times {settings.repetitions} repetitions, at most {MOST} were expected"
            )
        self.targets, self.shape, self.left_out = targets, (sets, settings.repetitions, count), list[str]()
        self._taking_part = dict(self.controllers)
        self.blocks, protocol = settings.elimination is not None, settings.protocol
        self.tallies = {name: Tally(self.shape, protocol) for name in self.controllers}
        runs = len(self.controllers) * (1 if self.blocks else len(KINDS))
        self._progress = Targets(self.on_progress, runs * int(np.prod(self.shape)))
        self._sent: Array | None = None
        self._ledger = self.ledger or Ledger.nowhere()
        self._rng = np.random.default_rng(settings.seed)

    def compare(self) -> Comparison:
        """Drive all trials; NotReadyError if not in its stance."""
        settings, turns = self.settings, self.turns
        robot = self._side_by_side() if settings.batched else self._in_turns()
        tallies = {name: self.tallies[name] for name in self._taking_part}
        sets, _, count = self.shape
        words = () if turns is None else (tuple(in_words(turns[s, k]) for k in range(count)) for s in range(sets))
        result = comparison_of(robot, settings.seed, settings.batched, self.targets, tallies, words)
        block = 0 if settings.elimination is None else settings.elimination.block
        return replace(result, left_out=tuple(self.left_out), block=block)

    # --- side by side -------------------------------------------------------------------------

    def _side_by_side(self) -> Robot:
        places = tuple((s, r) for s in range(self.shape[0]) for r in range(self.shape[1]))
        tasks = [(name, kind) for name in self.controllers for kind in KINDS if self._known(name, kind, places) is None]
        beside = {task: self.helper(task, places) for task in tasks[::-1]} if self.helper and len(tasks) > 1 else {}
        robot, begun = None, []

        def drive(task: Task) -> Robot:
            robot = self.open_batch(places)
            self._take(self.drive_batch(robot, *task, places)[0])
            return robot

        for task in tasks:
            if task in beside and not beside[task].cancel():
                begun.append(task)
            else:
                robot = drive(task)
        for task in begun:
            if not self._take_over(beside[task]):
                robot = drive(task)
        if robot is None:
            robot = self.open_batch(places)
            robot.close()
        return robot

    def open_batch(self, places: Places) -> Robot:
        """Open a robot with an arm per trial."""
        return self.open_robot(len(places), self.settings.seed)

    def drive_batch(self, robot: Robot, name: str, kind: Kind, places: Places) -> tuple[Driven, Recording]:
        """Drive a controller's trials side by side, and close ``robot``."""
        try:
            return self._drive(robot, self.controllers[name](robot.arm), name, kind, places)
        finally:
            robot.close()

    def _take_over(self, future: Future[Result]) -> bool:
        """Take what a helper drove; False if it was lost."""
        while not future.done():
            pause(_LOOK)
        if future.exception() is not None:
            return False
        driven, recording = future.result()
        self._hand_on(driven.controller, driven.kind, driven.places[: recording.time.shape[1]], recording)
        self._progress.skip(len(driven.places) * driven.targets)
        self.tallies[driven.controller].add(driven)
        self._ledger.add(driven)
        return True

    # --- in turns on one arm --------------------------------------------------------------------

    def _in_turns(self) -> Robot:
        robot = self.open_robot(1, self.settings.seed)
        try:
            if self.settings.elimination is None:
                for place in self._places():
                    for name in map(str, self._rng.permutation(list(self.tallies))):
                        for kind in KINDS:
                            self._try(robot, name, kind, place, slice(0, self.shape[2]))
            else:
                self._eliminate(robot, self.settings.elimination)
        finally:
            robot.close()
        return robot

    def _eliminate(self, robot: Robot, rules: Elimination) -> None:
        sets, repetitions, count = self.shape
        firsts = range(0, count, rules.block)
        tests = max(len(firsts) * sets * repetitions * (len(self._left()) - 1), 1)
        for driven in self.measured:
            tally = self.tallies[driven.controller]
            tally.add(driven)
            tally.source = self.source
            self._judge(driven)
        for place in self._places():
            for first in firsts:
                left = self._left()
                if not left or (len(left) == 1 and np.isfinite(self._results(left[0])["crossed"]).any()):
                    break
                for name in map(str, self._rng.permutation(left)):
                    self._try(robot, name, "hold", place, slice(first, min(first + rules.block, count)))
                results = {name: self._results(name) for name in self._left()}
                for name, why in worse(results, rules, tests).items():
                    self.tallies[name].out = why
        self._progress.skip_rest()

    def _left(self) -> list[str]:
        return [name for name in self._taking_part if not self.tallies[name].out]

    def _places(self) -> list[Place]:
        return [(s, r) for r in range(self.shape[1]) for s in range(self.shape[0])]

    def _results(self, name: str) -> dict[str, Array]:
        columns = self.tallies[name].columns  # in the order of driving
        return {key: np.swapaxes(columns[key], 0, 1).ravel() for key in ("crossed", "settled")}

    def _try(self, robot: Robot, name: str, kind: Kind, place: Place, part: slice) -> None:
        size, column = part.stop - part.start, self.tallies[name].columns["held" if kind == "hold" else "crossed"]
        if name not in self._left() or np.isfinite(column[place][part]).all():  # the diagnosis measured it
            self._progress.skip(size)
            return
        driven = self._known(name, kind, (place,), part.start)
        if driven is None:
            self._to_rest(robot)
            if name not in self._taking_part:  # its period does not suit, as the first motion has shown
                self._progress.skip(size)
                return
            driven = self._insist(robot, name, kind, place, part)
            self._take(driven)
        self._judge(driven)

    def _judge(self, driven: Driven) -> None:
        tally, (s, r) = self.tallies[driven.controller], driven.places[0]
        where = f"set {s + 1}, repetition {r + 1}"
        if driven.failed:
            tally.out = f"gave a command that is not a number ({driven.kind} protocol, {where})"
        elif missed_in_a_row(self._results(driven.controller)["crossed"]):
            tally.out = f"missed {MISSES} targets in a row ({where})"

    def _insist(self, robot: Robot, name: str, kind: Kind, place: Place, part: slice) -> Driven:
        for repeat in range(REPEATS + 1):
            controller = Watched(self.controllers[name](robot.arm))
            driven, recording = self._drive(robot, controller, name, kind, (place,), part)
            self._sent = recording.command[-1]
            if recording.gaps().max(initial=0.0) < LONG_GAP or repeat == REPEATS:
                break
            self._to_rest(robot)
        return driven

    def _to_rest(self, robot: Robot) -> None:
        if self._sent is None:
            motion = begin(robot, self.limits, self.stance)
            self._check_period(robot, motion.usual_period())
        else:
            motion = move(robot, robot.arm.rest, sent=self._sent, limits=self.limits)
        self._sent = motion.command[-1]

    def _check_period(self, robot: Robot, period: float) -> None:
        for name in list(self._taking_part):
            try:
                controller = self.controllers[name](robot.arm)
                check_controller_period(controller, period)
                require_gains(robot, controller)
            except ContractError as error:
                if not self.settings.leave_out or len(self._taking_part) == 1:
                    raise
                self.left_out.append(f"{name} did not take part: {error}.")
                del self._taking_part[name]

    # --- a trial ------------------------------------------------------------------------------

    def _known(self, name: str, kind: Kind, places: Places, first: int = 0) -> Driven | None:
        driven = self._ledger.done.get((name, kind, places, first))
        if driven is not None:
            self.tallies[name].add(driven)
            self._progress.skip(len(places) * driven.targets)
        return driven

    def _take(self, driven: Driven) -> None:
        self.tallies[driven.controller].add(driven)
        self._ledger.add(driven)
        self._progress.finish()

    def _drive(
        self, robot: Robot, controller: Controller, name: str, kind: Kind, places: Places, part: slice = slice(None)
    ) -> tuple[Driven, Recording]:
        settings, sets, first = self.settings, [s for s, _ in places], part.start or 0
        targets = self.targets[sets][:, part]
        turns = None if self.turns is None else self.turns[sets][:, part]
        plan = schedule(kind, settings.protocol, keep_going=settings.batched, sent=self._sent, wait=settings.wait)
        on_cycle = self._progress.watch(f"{name}: {kind} protocol", targets.shape[0] * targets.shape[1])
        if isinstance(controller, Watched):
            plan = replace(plan, give_up=controller.give_up)
        aiming = None if self.correction is None else self.correction(robot.arm)
        limits = limits_under(self.limits, robot, controller)
        with under_gains(robot, controller):
            reference = TargetSequence(robot.arm, targets, turns=turns, correction=aiming)
            recording = run(robot, controller, reference, plan, limits=limits, on_cycle=on_cycle)
        failed = isinstance(controller, Watched) and controller.failed
        if isinstance(controller, Watched):
            recording = controller.mark(recording)
        self._hand_on(name, kind, places, recording, first)
        driven = measure(
            robot.arm,
            recording,
            targets,
            settings.protocol,
            (name, kind, places, first),
            failed=failed,
            model=self.model,
            both=self.blocks,
        )
        return driven, recording

    def _hand_on(self, name: str, kind: Kind, places: Places, recording: Recording, first: int = 0) -> None:
        if self.on_trial is None:
            return
        for b, (s, r) in enumerate(places):
            trial = Trial(controller=name, kind=kind, target_set=s, repetition=r, recording=recording, arm_index=b)
            self.on_trial(replace(trial, first=first))
