"""Try every controller on one arm, with the same targets and start.

Emulated arms run all trials of a controller as one batch with equal noise. A real arm runs them in random order: drift
favours none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import KW_ONLY, dataclass, field, replace
from itertools import product

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.rotations import Orientation
from rejoint.arms.workspace import length_size
from rejoint.control.comparison.elimination import MISSES, Elimination, Watched, missed_in_a_row, worse
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.protocols import (
    RISING_AHEAD,
    direction_variation,
    iso_poses,
    measure,
    metrics_of,
    schedule,
)
from rejoint.control.comparison.result import (
    KINDS,
    Columns,
    Comparison,
    DirectionVariation,
    Driven,
    Kind,
    Place,
    Places,
    Protocol,
    collect,
    comparison_of,
    row_of,
)
from rejoint.control.controllers.contract import check_controller_period
from rejoint.control.correction import Modelled, ToolModel
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import Cycle, OnCycle, Recording
from rejoint.control.reference import TargetSequence
from rejoint.control.robot import Controller, Robot
from rejoint.control.servogains import limits_under, require_gains, under_gains
from rejoint.control.start import Stance, begin, move
from rejoint.control.targets import beyond_reach, in_words
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import ContractError, InputError
from rejoint.system.progress import Progress, no_progress
from rejoint.system.statistics import Spread, spread
from rejoint.system.stopping import pause

PROGRESS_CYCLES = 40
"""(chosen)"""


def count_targets(report: Callable[[int], object]) -> OnCycle:
    """Report the number of finished targets every `PROGRESS_CYCLES` cycles."""
    cycles = 0

    def see(cycle: Cycle) -> None:
        nonlocal cycles
        if cycles % PROGRESS_CYCLES == 0:
            report(int(cycle.target_index.sum()))
        cycles += 1

    return see


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
        self.targets, self.shape = targets, (sets, settings.repetitions, count)
        self._trials: dict[str, list[Driven]] = {name: [] for name in self.controllers}
        self._out: dict[str, str] = {}  # why a controller is not driven any further
        self._left_out: dict[str, str] = {}  # why it never took part
        kinds = len(KINDS) if settings.elimination is None else 1
        self._done, self._total, self._text = 0, len(self.controllers) * kinds * int(np.prod(self.shape)), ""
        self._sent: Array | None = None
        self._ledger = self.ledger or Ledger.nowhere()
        self._rng = np.random.default_rng(settings.seed)

    def compare(self) -> Comparison:
        """Drive all trials; NotReadyError if not in its stance."""
        settings, turns, rules = self.settings, self.turns, self.settings.elimination
        robot = self._side_by_side() if settings.batched else self._in_turns()
        parts = {name: self._columns(name) for name in self.controllers if name not in self._left_out}
        rows = tuple(
            replace(
                row_of(name, found, settings.protocol, self._trials[name]),
                out=self._out.get(name, ""),
                source=self.source if any(one.controller == name for one in self.measured) else "",
            )
            for name, found in parts.items()
        )
        words = (
            ()
            if turns is None
            else [[in_words(turns[s, k]) for k in range(self.shape[2])] for s in range(self.shape[0])]
        )
        return comparison_of(
            parts,
            self.targets,
            robot=robot.address,
            arm=robot.arm.name,
            seed=settings.seed,
            batched=settings.batched,
            protocol=settings.protocol,
            rows=rows,
            left_out=tuple(self._left_out.values()),
            block=0 if rules is None else rules.block,
            orientations=tuple(map(tuple, words)),
        )

    # --- side by side -------------------------------------------------------------------------

    def _side_by_side(self) -> Robot:
        places = tuple(product(range(self.shape[0]), range(self.shape[1])))
        tasks = [task for task in product(self.controllers, KINDS) if not self._known(*task, places)]
        beside = {task: self.helper(task, places) for task in tasks[::-1]} if self.helper and len(tasks) > 1 else {}
        robot, waiting = None, []
        for task in tasks:
            if task in beside and not beside[task].cancel():
                waiting.append(task)
            else:
                robot = self._drive_here(task, places)
        for task in waiting:
            if not self._take_over(beside[task]):
                robot = self._drive_here(task, places)
        if robot is None:
            robot = self.open_batch(places)
            robot.close()
        return robot

    def open_batch(self, places: Places) -> Robot:
        """Open a robot with an arm per trial."""
        return self.open_robot(len(places), self.settings.seed)

    def drive_batch(self, robot: Robot, name: str, kind: Kind, places: Places) -> Result:
        """Drive a controller's trials side by side, and close ``robot``."""
        try:
            return self._drive(robot, self.controllers[name](robot.arm), (name, kind), places)
        finally:
            robot.close()

    def _drive_here(self, task: Task, places: Places) -> Robot:
        robot = self.open_batch(places)
        self._take(self.drive_batch(robot, *task, places)[0])
        return robot

    def _take_over(self, future: Future[Result]) -> bool:
        """Take what a helper drove; False if it was lost."""
        while not future.done():
            pause(_LOOK)
        if future.exception() is not None:
            return False
        driven, recording = future.result()
        self._hand_on(driven.controller, driven.kind, driven.places[: recording.time.shape[1]], recording)
        self._take(driven)
        return True

    # --- in turns on one arm --------------------------------------------------------------------

    def _in_turns(self) -> Robot:
        robot, sets, repetitions, count = self.open_robot(1, self.settings.seed), *self.shape
        places = [(s, r) for r in range(repetitions) for s in range(sets)]
        try:
            if self.settings.elimination is not None:
                self._eliminate(robot, self.settings.elimination, places)
                return robot
            for place in places:
                for name in map(str, self._rng.permutation(list(self.controllers))):
                    for kind in KINDS:
                        self._try(robot, name, kind, place, slice(0, count))
        finally:
            robot.close()
        return robot

    def _eliminate(self, robot: Robot, rules: Elimination, places: Sequence[Place]) -> None:
        firsts = range(0, self.shape[2], rules.block)
        tests = max(len(firsts) * len(places) * (len(self._left()) - 1), 1)
        for driven in self.measured:
            self._trials[driven.controller].append(driven)
            self._judge(driven)
        for place, first in product(places, firsts):
            left = self._left()
            if not left or (len(left) == 1 and np.isfinite(self._in_order("crossed", left[0])).any()):
                break
            for name in map(str, self._rng.permutation(left)):
                self._try(robot, name, "hold", place, slice(first, min(first + rules.block, self.shape[2])))
            self._out |= worse({name: self._in_order("settled", name) for name in self._left()}, rules, tests)
        if self._done < self._total:
            self._advance(self._total - self._done)

    def _left(self) -> list[str]:
        return [name for name in self.controllers if name not in self._out and name not in self._left_out]

    def _columns(self, name: str) -> Columns:
        return collect(self._trials[name], self.shape, self.settings.protocol)

    def _in_order(self, metric: str, name: str) -> Array:
        """Results (N,) in the order of driving."""
        return np.swapaxes(self._columns(name)[metric], 0, 1).ravel()

    def _try(self, robot: Robot, name: str, kind: Kind, place: Place, part: slice) -> None:
        size, metric = part.stop - part.start, "held" if kind == "hold" else "crossed"
        if name not in self._left() or np.isfinite(self._columns(name)[metric][place][part]).all():
            self._advance(size)  # the diagnosis measured it
            return
        driven = self._known(name, kind, (place,), part.start)
        if driven is None:
            self._to_rest(robot)
            if name in self._left_out:  # its period does not suit, as the first motion has shown
                self._advance(size)
                return
            driven = self._insist(robot, (name, kind), place, part)
            self._take(driven)
        self._judge(driven)

    def _judge(self, driven: Driven) -> None:
        name, (s, r) = driven.controller, driven.places[0]
        where = f"set {s + 1}, repetition {r + 1}"
        if driven.failed:
            self._out[name] = f"gave a command that is not a number ({driven.kind} protocol, {where})"
        elif missed_in_a_row(self._in_order("crossed", name)):
            self._out[name] = f"missed {MISSES} targets in a row ({where})"

    def _insist(self, robot: Robot, task: Task, place: Place, part: slice) -> Driven:
        for repeat in range(REPEATS + 1):
            controller = Watched(self.controllers[task[0]](robot.arm))
            driven, recording = self._drive(robot, controller, task, (place,), part)
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
        for name in self._left():
            try:
                controller = self.controllers[name](robot.arm)
                check_controller_period(controller, period)
                require_gains(robot, controller)
            except ContractError as error:
                if not self.settings.leave_out or len(self._left_out) == len(self.controllers) - 1:
                    raise
                self._left_out[name] = f"{name} did not take part: {error}."

    # --- a trial ------------------------------------------------------------------------------

    def _known(self, name: str, kind: Kind, places: Places, first: int = 0) -> Driven | None:
        driven = self._ledger.done.get((name, kind, places, first))
        if driven is not None:
            self._take(driven)
        return driven

    def _take(self, driven: Driven) -> None:
        self._trials[driven.controller].append(driven)
        if driven.key not in self._ledger.done:
            self._ledger.add(driven)
        self._advance(len(driven.places) * driven.targets)

    def _advance(self, size: int) -> None:
        self._done += size
        self.on_progress(self._done / self._total, self._text)

    def _drive(
        self, robot: Robot, controller: Controller, task: Task, places: Places, part: slice = slice(None)
    ) -> Result:
        (name, kind), settings, sets, first = task, self.settings, [s for s, _ in places], part.start or 0
        turns, targets = None if self.turns is None else self.turns[sets][:, part], self.targets[sets][:, part]
        plan = schedule(kind, settings.protocol, keep_going=settings.batched, sent=self._sent, wait=settings.wait)
        watched = controller if isinstance(controller, Watched) else None
        if watched is not None:
            plan = replace(plan, give_up=watched.give_up)
        self._text = f"{name}: {kind} protocol"
        see = count_targets(lambda done: self.on_progress((self._done + done) / self._total, self._text))
        reference = TargetSequence(robot.arm, targets, turns=turns, correction=self._aiming(robot))
        recording = self._run(robot, controller, reference, plan, see)
        if watched is not None:
            recording = watched.mark(recording)
        self._hand_on(name, kind, places, recording, first)
        driven = measure(
            robot.arm,
            recording,
            targets,
            settings.protocol,
            (name, kind, places, first),
            failed=watched is not None and watched.failed,
            model=self.model,
            both=settings.elimination is not None,
        )
        return driven, recording

    def _aiming(self, robot: Robot) -> Modelled | None:
        return None if self.correction is None else self.correction(robot.arm)

    def _run(
        self,
        robot: Robot,
        controller: Controller,
        reference: TargetSequence,
        plan: Schedule,
        on_cycle: OnCycle | None = None,
    ) -> Recording:
        limits = limits_under(self.limits, robot, controller)
        with under_gains(robot, controller):
            return run(robot, controller, reference, plan, limits=limits, on_cycle=on_cycle)

    def _hand_on(self, name: str, kind: Kind, places: Places, recording: Recording, first: int = 0) -> None:
        if self.on_trial is None:
            return
        for b, (s, r) in enumerate(places):
            trial = Trial(controller=name, kind=kind, target_set=s, repetition=r, recording=recording, arm_index=b)
            self.on_trial(replace(trial, first=first))

    # --- beside the trials --------------------------------------------------------------------

    def hold(self, controller: ControllerFactory, targets: Array, *, corrected: bool = True) -> Columns:
        """Drive to ``targets`` (R, K, 3) [m], R cycles; raises as `run`."""
        batched, protocol = self.settings.batched, self.settings.protocol
        parts = [targets] if batched else np.split(targets, len(targets))
        robot, found = self.open_robot(len(parts[0]), self.settings.seed), []
        try:
            for part in parts:
                sent = None if batched else begin(robot, self.limits, self.stance).command[-1]
                plan = schedule("hold", protocol, keep_going=batched, sent=sent)
                reference = TargetSequence(robot.arm, part, correction=self._aiming(robot) if corrected else None)
                recording = self._run(robot, controller(robot.arm), reference, plan)
                found.append(metrics_of(robot.arm, recording, part, protocol, model=self.model))
        finally:
            robot.close()
        return {name: np.concatenate([one[name] for one in found]) for name in found[0]}


AWAY = 0.03
"""[m] start of an approach, for a myCobot 280 (chosen)"""


def vary_directions(runner: TrialRunner, name: str, arm: Arm) -> DirectionVariation | None:
    """Approach each reachable ISO 9283 pose along the base axes, once per repetition."""
    cycles, poses = runner.settings.repetitions, iso_poses(arm, RISING_AHEAD)
    poses = poses[beyond_reach(arm, poses) == 0.0]
    middle = 0.5 * (arm.targets.upper + arm.targets.lower)
    side = np.where(poses > middle, -1.0, 1.0)
    starts = poses[None] + AWAY * length_size(arm) * np.eye(3)[:, None] * side[None]  # (3, P, 3)
    way = np.stack([starts, np.broadcast_to(poses, starts.shape)], axis=2)  # (3, P, 2, 3)
    ways = way.reshape(3 * len(poses) if runner.settings.batched else 1, -1, 3)
    held = runner.hold(runner.controllers[name], np.tile(ways, (cycles, 1, 1)))
    away = (np.stack([held[f"{name}_{axis}"] for axis in "xyz"], axis=-1) for name in ("away", "away_true"))
    encoders, tool = (_variation(one[:, 1::2].reshape(cycles, 3, len(poses), 3)) for one in away)
    if encoders is None:
        return None
    return DirectionVariation(controller=name, poses=len(poses), cycles=cycles, encoders=encoders, tool=tool)


def _variation(away: Array) -> Spread | None:
    """VAP over poses, from errors (R, D, P, 3) [m]."""
    means = np.moveaxis(away.mean(axis=0), 0, 1)  # (P, D, 3)
    known = means[np.isfinite(means).all(axis=(1, 2))]
    return spread(np.array([direction_variation(one) for one in known]), np.arange(len(known)))
