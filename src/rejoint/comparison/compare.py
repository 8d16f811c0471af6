"""Try every controller on the same arm, with the same targets, from the same start.

On emulated arms all trials of a controller run side by side as one batch of equal arms with
different noise, the same for every controller. On a real arm the trials run one after the other, the
controllers interleaved in random order, so that a warming or loosening arm favours none of them; one that fails is
driven no further (`rejoint.comparison.elimination`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.comparison.elimination import Elimination, Watched
from rejoint.comparison.protocols import KINDS, Kind, measure_crossings, measure_holds, schedule
from rejoint.comparison.result import Comparison, Protocol
from rejoint.comparison.summary import Tally, summarise
from rejoint.control.controller import Controller
from rejoint.control.loop import move, run
from rejoint.control.recording import Cycle, Recording
from rejoint.control.robot import Robot
from rejoint.errors import InputError
from rejoint.runlog import RunLog

OpenRobot = Callable[[int, int], Robot]
"""Opens a robot of ``count`` arms with a noise ``seed``."""
ControllerFactory = Callable[[Arm], Controller]
OnProgress = Callable[[int, int, str], object]
"""Called with finished and total numbers of targets, and what is going on."""

_PROGRESS_CYCLES = 40
"""Cycles between two reports of progress (chosen: about a second of a real arm)."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One set of targets, once, with one controller."""

    controller: str
    kind: Kind
    target_set: int
    repetition: int
    recording: Recording
    arm_index: int
    """which arm of the recording"""

    @property
    def label(self) -> str:
        """Such as ``hold/policy/0/2``: protocol, controller, target set, repetition."""
        return f"{self.kind}/{self.controller}/{self.target_set}/{self.repetition}"

    def log(self) -> RunLog:
        """Run log of this trial."""
        return self.recording.log(self.arm_index, self.label)


OnTrial = Callable[[Trial], object]
"""Called after every trial, so that its log can be kept."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a comparison is done."""

    repetitions: int = 1
    seed: int = 0
    batched: bool
    """True: side by side on emulated arms; False: one after the other on one arm"""
    protocol: Protocol = field(default_factory=Protocol)

    def __post_init__(self) -> None:
        if self.repetitions < 1:
            raise InputError(f"comparison: repetitions must be at least 1, got {self.repetitions}")


def compare(
    open_robot: OpenRobot,
    controllers: Mapping[str, ControllerFactory],
    targets: Array,
    settings: Settings,
    *,
    on_progress: OnProgress | None = None,
    on_trial: OnTrial | None = None,
) -> Comparison:
    """Compare ``controllers`` by name on ``targets`` (S, K, 3) [m].

    Trials of a batch that the guard ends count as failures; on a single arm the trip ends the
    comparison, as does an error of the robot. A command that is not a number costs its controller the trial in both.
    """
    targets = np.asarray(targets, dtype=float)
    if targets.ndim != 3 or targets.shape[2] != 3 or 0 in targets.shape or not np.isfinite(targets).all():
        raise InputError(f"comparison: targets have shape {targets.shape}, expected finite (sets, targets, 3)")
    if not controllers:
        raise InputError("comparison: no controllers given")
    shape = (targets.shape[0], settings.repetitions, targets.shape[1])
    session = _Session(
        open_robot=open_robot, controllers=controllers, targets=targets, settings=settings, shape=shape,
        tallies={name: Tally(shape, settings.protocol) for name in controllers},
        progress=_Progress(on_progress, len(controllers) * len(KINDS) * int(np.prod(shape))), on_trial=on_trial,
    )  # fmt: skip
    robot = session.run_batched() if settings.batched else session.run_interleaved()
    return summarise(robot, settings.seed, settings.batched, targets, session.tallies)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Session:
    open_robot: OpenRobot
    controllers: Mapping[str, ControllerFactory]
    targets: Array
    settings: Settings
    shape: tuple[int, int, int]
    tallies: dict[str, Tally]
    progress: _Progress
    on_trial: OnTrial | None

    def run_batched(self) -> Robot:
        """Run every controller's trials as one batch; returns the last robot, closed."""
        sets, repetitions, _ = self.shape
        places = [(s, r) for s in range(sets) for r in range(repetitions)]
        for name, factory in self.controllers.items():
            for kind in KINDS:
                robot = self.open_robot(len(places), self.settings.seed)
                try:
                    self._drive(robot, factory(robot.arm), name, kind, places)
                finally:
                    robot.close()
        return robot

    def run_interleaved(self) -> Robot:
        """Run the trials one after the other on one arm; returns it, closed."""
        rng = np.random.default_rng(self.settings.seed)
        sets, repetitions, _ = self.shape
        left = Elimination(self.settings.protocol)
        robot = self.open_robot(1, self.settings.seed)
        try:
            sent = None
            for r in range(repetitions):
                for s in range(sets):
                    for name in map(str, rng.permutation(list(self.controllers))):
                        for kind in KINDS:
                            if left.out(name):
                                self.progress.skip(self.shape[2])
                                continue
                            start = move(robot, robot.arm.rest, sent=sent).command[-1]
                            controller = left.watch(name, self.controllers[name](robot.arm), robot.arm, kind)
                            sent = self._drive(robot, controller, name, kind, [(s, r)], start)
                            left.note(name, kind, (s, r), self.tallies[name].crossed[s, r], controller.failed)
                            self.tallies[name].out = left.out(name)
        finally:
            robot.close()
        return robot

    def _drive(
        self, robot: Robot, controller: Controller, name: str, kind: Kind, places: list[tuple[int, int]],
        sent: Array | None = None,
    ) -> Array:  # fmt: skip
        """Run one protocol for the trials (set, repetition) in ``places``; returns the last commands."""
        targets = self.targets[[s for s, _ in places]]
        plan = schedule(kind, self.settings.protocol, keep_going=self.settings.batched, sent=sent)
        on_cycle = self.progress.watch(f"{name}: {kind} protocol", targets.shape[0] * targets.shape[1])
        if isinstance(controller, Watched):
            plan = replace(plan, give_up=controller.give_up)
        recording = run(robot, controller, targets, plan, on_cycle=on_cycle)
        if isinstance(controller, Watched):
            recording = controller.mark(recording)
        tally, protocol = self.tallies[name], self.settings.protocol
        if kind == "crossing":
            tally.add_crossings(places, measure_crossings(robot.arm, recording, targets, protocol))
        else:
            tally.add_holds(places, measure_holds(robot.arm, recording, targets, protocol))
        tally.add_guard(kind, places, recording)
        for b, (s, r) in enumerate(places):
            if self.on_trial is not None:
                trial = Trial(controller=name, kind=kind, target_set=s, repetition=r, recording=recording, arm_index=b)
                self.on_trial(trial)
        self.progress.finish()
        return recording.command[-1]


class _Progress:
    """Turns cycles into numbers of finished targets."""

    def __init__(self, report: OnProgress | None, total: int) -> None:
        self._report, self._total = report, total
        self._done = self._size = self._cycles = 0
        self._text = ""

    def watch(self, text: str, size: int) -> Callable[[Cycle], None] | None:
        self._text, self._size, self._cycles = text, size, 0
        return None if self._report is None else self._see

    def finish(self) -> None:
        self._done += self._size
        if self._report is not None:
            self._report(self._done, self._total, self._text)

    def skip(self, size: int) -> None:
        self._size = size
        self.finish()

    def _see(self, cycle: Cycle) -> None:
        if self._cycles % _PROGRESS_CYCLES == 0 and self._report is not None:
            self._report(self._done + int(cycle.target_index.sum()), self._total, self._text)
        self._cycles += 1
