"""Try every controller on one arm, with the same targets and start.

Emulated arms run all trials of a controller as one batch with equal noise, a real arm in random order. There,
controllers leave after three misses in a row, or by a paired t-test after each block (Maron and Moore, Hoeffding races,
NIPS 1993; Bonferroni's level).
"""

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import KW_ONLY, dataclass, field, replace
from itertools import product
from pathlib import Path

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.rotations import Orientation
from rejoint.control.comparison.protocols import measure, schedule
from rejoint.control.comparison.result import (
    WAS_WORSE,
    Columns,
    Comparison,
    Driven,
    Key,
    Protocol,
    TargetErrors,
    collect,
    comparison_of,
    row_of,
)
from rejoint.control.controllers.classical import DefaultController
from rejoint.control.controllers.policy import check_controller_period
from rejoint.control.correction import Modelled, ToolModel
from rejoint.control.guard import GuardLimits, Reason
from rejoint.control.loop import run
from rejoint.control.recording import Cycle, Recording, recording_of
from rejoint.control.reference import TargetSequence, Ways
from rejoint.control.robot import Controller, Robot
from rejoint.control.servogains import OverloadedError, limits_under, require_gains, under_gains
from rejoint.control.start import Stance, begin, move
from rejoint.control.targets import in_words
from rejoint.system.errors import ContractError, GuardTripError
from rejoint.system.files import read_json, set_aside, write_json
from rejoint.system.numbers import as_whole
from rejoint.system.progress import Progress, no_progress


class Ledger:
    """Finished trials of the comparison ``name``; without a path in memory. Those of another one are set aside."""

    def __init__(self, path: Path | None = None, name: str = "") -> None:
        self.path, self._name, self.done = path, name, dict[Key, Driven]()
        if path is None or not path.exists():
            return
        found = read_json(path, dict[str, list[Driven]])
        if name in found:
            self.done = {driven.key: driven for driven in found[name]}
        else:
            set_aside(path)

    def add(self, driven: Driven) -> None:
        """Store a trial; FileError."""
        self.done[driven.key] = driven
        if self.path is not None:
            write_json(self.path, {self._name: list(self.done.values())})

    def close(self) -> None:
        """Remove the file."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)


OpenRobot = Callable[[int, int], Robot]
"""(arms, noise seed) to a robot"""
Result = tuple[Driven, Recording]

BLOCK = 5
"""targets between eliminations (chosen)"""
MISSES = 3
"""in a row (chosen)"""
LEVEL = 0.1
"""of all tests together (chosen)"""
NEAREST = 5e-5
"""[m] least settled error of a test (chosen)"""
LONG_GAP = 2.0
"""[s] that repeats a trial (chosen)"""
REPEATS = 2
"""of such a trial (chosen)"""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of a comparison."""

    repetitions: int = 1
    seed: int = 0
    batched: bool
    """side by side on emulated arms, all driven to the end"""
    protocol: Protocol = field(default_factory=Protocol)
    leave_out: bool = False
    """a policy of another period"""
    block: int = 0
    """targets between eliminations on one arm; 0: only failing controllers leave"""
    ways: float | None = None
    """[s] of holds and dwells for planned ways, see `Schedule`"""

    def __post_init__(self) -> None:
        as_whole("repetitions", self.repetitions, 1)


@dataclass(eq=False)
class TrialRunner:
    """Compares controllers.

    A guard trip fails a trial of a batch. On one arm it ends the comparison, as a robot's error does.
    """

    open_robot: OpenRobot
    controllers: Mapping[str, Callable[[Arm], Controller]]
    targets: Array
    """(S, K, 3) [m]"""
    settings: Settings
    _: KW_ONLY
    turns: Orientation | None = None
    """(S, K); None: any"""
    limits: GuardLimits | None = None
    stance: Stance | None = None
    correction: Modelled | None = None
    model: ToolModel | None = None
    """estimates unknown tool errors"""
    ways: Ways | None = None
    """of the sets; None: to the nearest postures at once"""
    ledger: Ledger = field(default_factory=Ledger)
    measured: Driven | None = None
    """trials of one arm, driven before"""
    on_progress: Progress = no_progress
    on_trial: Callable[[Driven, Recording], object] = field(default=lambda *_: None)

    def __post_init__(self) -> None:
        settings, (sets, count) = self.settings, self.targets.shape[:2]
        self.shape = sets, settings.repetitions, count
        self._step = settings.block or count
        self._trials: dict[str, list[Driven]] = {name: [] for name in self.controllers}
        self._out: dict[str, str] = {}  # why a controller is not driven any further, or never took part
        self._total = len(self.controllers) * len(settings.protocol.kinds) * int(np.prod(self.shape))
        self._done, self._text = 0, ""
        self._sent: Array | None = None
        self._rng = np.random.default_rng(settings.seed)

    def compare(self) -> Comparison:
        """Drive all trials; NotReadyError if not in its stance."""
        settings, turns, (sets, _, count) = self.settings, self.turns, self.shape
        if settings.batched:
            self._side_by_side()
        else:
            self._in_turns()
        left_out = [name for name in self._out if not self._trials[name]]
        parts = {name: self._columns(name) for name in self.controllers if name not in left_out}
        rows = tuple(
            row_of(name, found, settings.protocol, self._trials[name], out=self._out.get(name, ""))
            for name, found in parts.items()
        )
        words = () if turns is None else (tuple(in_words(turns[s, k]) for k in range(count)) for s in range(sets))
        return comparison_of(
            parts,
            self.targets,
            seed=settings.seed,
            batched=settings.batched,
            protocol=settings.protocol,
            rows=rows,
            left_out=tuple(f"{name} {self._out[name]}." for name in left_out),
            block=settings.block,
            orientations=tuple(words),
        )

    # --- side by side -------------------------------------------------------------------------

    def _side_by_side(self) -> None:
        places = tuple(product(range(self.shape[0]), range(self.shape[1])))
        for name, kind in product(self.controllers, self.settings.protocol.kinds):
            key = Key(name, kind, places)
            self._take(self.ledger.done.get(key) or self.drive_batch(key)[0])

    def drive_batch(self, key: Key) -> Result:
        """Drive a controller's trials side by side, each on an arm."""
        with closing(self.open_robot(len(key.places), self.settings.seed)) as robot:
            return self._drive(robot, key)

    # --- in turns on one arm --------------------------------------------------------------------

    def _in_turns(self) -> None:
        (sets, repetitions, count), block = self.shape, self.settings.block
        places, firsts = [(s, r) for r in range(repetitions) for s in range(sets)], range(0, count, self._step)
        tests = max(len(firsts) * len(places) * (len(self.controllers) - 1), 1)
        with closing(self.open_robot(1, self.settings.seed)) as robot:
            if self.measured is not None:
                self._trials[self.measured.key.controller].append(self.measured)
                self._judge(self.measured)
            for place, first in product(places, firsts):
                left = self._left()
                if not left or (block and len(left) == 1 and np.isfinite(self._in_order("crossed", left[0])).any()):
                    break
                for name, kind in product(map(str, self._rng.permutation(left)), self.settings.protocol.kinds):
                    self._try(robot, Key(name, kind, (place,), first))
                if block:
                    self._out |= worse({name: self._in_order("settled", name) for name in self._left()}, tests)
        self._advance(self._total - self._done)

    def _left(self) -> list[str]:
        return [name for name in self.controllers if name not in self._out]

    def _columns(self, name: str) -> Columns:
        return collect(self._trials[name], self.shape, self.settings.protocol)

    def _in_order(self, metric: str, name: str) -> Array:
        """Results (N,) in the order of driving."""
        return np.swapaxes(self._columns(name)[metric], 0, 1).ravel()

    def _try(self, robot: Robot, key: Key) -> None:
        name, kind, (place,), first = key
        if name in self._out:
            return
        known = self._columns(name)["held" if kind == "hold" else "crossed"][place][first : first + self._step]
        if np.isfinite(known).all():
            self._advance(len(known))
            return
        driven = self.ledger.done.get(key)
        for _ in range(0 if driven else 1 + REPEATS):
            self._to_rest(robot)
            if name in self._out:  # its period does not suit, as the first motion has shown
                return
            try:
                driven, recording = self._drive(robot, key)
            except OverloadedError as heavy:  # a servo does not bear its gains, and has those from before
                if len(self._left()) == 1:
                    raise
                self._out[name] = f"was left out, because {heavy}"
                return
            if recording.gaps().max(initial=0.0) < LONG_GAP:
                break
        if driven:
            self._take(driven)
            self._judge(driven)

    def _judge(self, driven: Driven) -> None:
        name, kind, ((s, r),), _ = driven.key
        where, crossed = f"set {s + 1}, repetition {r + 1}", self._in_order("crossed", name)
        missed = crossed[np.isfinite(crossed)] == 0.0  # NaN: not driven
        if driven.ended:  # by its command: whatever else trips the guard ends the comparison
            self._out[name] = f"gave a command that is not a number ({kind} protocol, {where})"
        elif (np.convolve(missed, np.ones(MISSES)) == MISSES).any():
            self._out[name] = f"missed {MISSES} targets in a row ({where})"

    def _to_rest(self, robot: Robot) -> None:
        if self._sent is None:
            motion = begin(robot, self.limits, self.stance)
            for name in self._left():
                try:
                    controller = self.controllers[name](robot.arm)
                    check_controller_period(controller, motion.usual_period())
                    require_gains(robot, controller)
                except ContractError as error:
                    if not self.settings.leave_out or len(self._left()) == 1:
                        raise
                    self._out[name] = f"did not take part: {error}"
        else:
            motion = move(robot, robot.arm.rest, sent=self._sent, limits=self.limits)
        self._sent = motion.command[-1]

    # --- a trial ------------------------------------------------------------------------------

    def _take(self, driven: Driven) -> None:
        self._trials[driven.key.controller].append(driven)
        if driven.key not in self.ledger.done:
            self.ledger.add(driven)
        self._advance(next(iter(driven.columns.values())).size)

    def _advance(self, size: int) -> None:
        self._done += size
        self.on_progress(self._done / self._total, self._text)

    def _drive(self, robot: Robot, key: Key) -> Result:
        name, kind, places, first = key
        sets, part = [s for s, _ in places], slice(first, first + self._step)
        targets, settings, self._text = self.targets[sets, part], self.settings, f"{name}: {kind} protocol"

        def see(cycle: Cycle) -> None:
            self.on_progress((self._done + int(cycle.target_index.sum())) / self._total, self._text)

        controller = self.controllers[name](robot.arm)
        reference = TargetSequence(
            robot.arm,
            targets,
            ways=self.ways and [self.ways[s][part] for s in sets],
            turns=self.turns and self.turns[sets][:, part],
            correction=self.correction,
        )
        limits = limits_under(self.limits, robot, controller)
        plan = schedule(
            kind,
            settings.protocol,
            keep_going=settings.batched,
            sent=self._sent,
            ways=settings.ways,
        )
        try:
            with under_gains(robot, controller):
                recording = run(robot, controller, reference, plan, limits=limits, on_cycle=see)
        except GuardTripError as error:
            stopped = recording_of(error)
            if stopped is None or (stopped.tripped != Reason.NOT_FINITE.value).any():
                raise
            if not np.isfinite(stopped.position[-1]).all():  # not the command alone was no number
                raise
            recording = stopped
        if not settings.batched:
            self._sent = recording.command[-1]
        driven = measure(robot.arm, recording, targets, settings.protocol, key, model=self.model)
        self.on_trial(driven, recording)
        return driven, recording

    # --- beside the trials --------------------------------------------------------------------

    def as_found(self) -> TargetErrors:
        """Errors of the default controller at the first target set, not corrected; raises as `run`."""
        settings = replace(self.settings, block=0)
        plain = replace(self, settings=settings, correction=None, on_progress=no_progress, on_trial=lambda *_: None)
        with closing(self.open_robot(1, settings.seed)) as robot:
            if not settings.batched:
                plain._to_rest(robot)
            return TargetErrors.of(plain._drive(robot, Key(DefaultController.name, "hold", ((0, 0),)))[0].columns)


def worse(settled: Mapping[str, Array], tests: int) -> dict[str, str]:
    """Significantly worse controllers with reasons, by settled errors (N,) [m]."""
    from scipy import stats  # here, since it takes a second to load

    logs = {name: np.log(np.maximum(errors, NEAREST)) for name, errors in settled.items()}
    together = np.isfinite(list(logs.values())).all(axis=0)
    if together.sum() < 2:
        return {}
    best = min(logs, key=lambda name: logs[name][together].mean())
    out = {}
    for name, values in logs.items():
        both = np.isfinite(values) & np.isfinite(logs[best])
        difference = values[both] - logs[best][both]
        if name == best or not difference.any():
            continue
        if stats.ttest_1samp(difference, 0.0, alternative="greater").pvalue < LEVEL / tests:
            far = f"settles {np.exp(difference.mean()):.1f} times as far off at {len(difference)} targets"
            out[name] = f"{WAS_WORSE}{best} ({far})"
    return out
