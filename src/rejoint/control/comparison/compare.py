"""Try every controller on the same arm, with the same targets, from the same start.

On emulated arms all trials of a controller run side by side as one batch of equal arms with
different noise, the same for every controller. On a real arm the trials run one after the other, the
controllers interleaved in random order, so that a warming or loosening arm favours none of them; one that fails is
driven no further (`rejoint.control.comparison.elimination`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.accuracy import ToolModel
from rejoint.control.comparison.driven import Driven, Places, measure
from rejoint.control.comparison.elimination import Elimination, Watched
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.protocols import KINDS, Kind, schedule
from rejoint.control.comparison.result import Comparison, Protocol
from rejoint.control.comparison.summary import Tally, summarise
from rejoint.control.contract import check_controller_period
from rejoint.control.controller import Controller
from rejoint.control.correction import Correction
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import move, run
from rejoint.control.recording import Cycle, Recording
from rejoint.control.robot import Robot
from rejoint.control.servogains import limits_under, require_gains, under_gains
from rejoint.control.start import Stance, begin
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import ContractError, InputError
from rejoint.system.progress import Progress, no_progress

OpenRobot = Callable[[int, int], Robot]
"""Opens a robot of ``count`` arms with a noise ``seed``."""
ControllerFactory = Callable[[Arm], Controller]
MakeCorrection = Callable[[Arm], Correction]

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

LONG_GAP = 2.0
"""[s] without an answer from which a trial on one arm is driven again (chosen: a quarter of a hold)"""
REPEATS = 2
"""Times that a trial is driven again at most; the last one counts, and the guard's column says that there were gaps"""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """How a comparison is done."""

    repetitions: int = 1
    seed: int = 0
    batched: bool
    """True: side by side on emulated arms; False: one after the other on one arm"""
    protocol: Protocol = field(default_factory=Protocol)
    leave_out: bool = False
    """whether a policy that does not suit the measured control period is left out instead of refused"""

    def __post_init__(self) -> None:
        if self.repetitions < 1:
            raise InputError(f"comparison: repetitions must be at least 1, got {self.repetitions}")


def compare(
    open_robot: OpenRobot,
    controllers: Mapping[str, ControllerFactory],
    targets: Array,
    settings: Settings,
    *,
    on_progress: Progress = no_progress,
    on_trial: OnTrial | None = None,
    ledger: Ledger | None = None,
    limits: GuardLimits | None = None,
    stance: Stance | None = None,
    correction: MakeCorrection | None = None,
    model: ToolModel | None = None,
) -> Comparison:
    """Compare ``controllers`` by name on ``targets`` (S, K, 3) [m].

    Trials of a batch that the guard ends count as failures; on a single arm the trip ends the
    comparison, as does an error of the robot. A command that is not a number costs its controller the trial in both.
    What is done already by the ``ledger`` is not driven again. ``limits`` are the guard's, by default those of the arm.
    A single arm that does not stand at rest as its ``stance`` says is not driven: NotReadyError.
    A ``correction`` aims for all controllers alike. Where nobody knows where the tool is, a ``model`` says how far it
    is from its targets.
    """
    targets = np.asarray(targets, dtype=float)
    if targets.ndim != 3 or targets.shape[2] != 3 or 0 in targets.shape or not np.isfinite(targets).all():
        raise InputError(f"comparison: targets have shape {targets.shape}, expected finite (sets, targets, 3)")
    if not controllers:
        raise InputError("comparison: no controllers given")
    shape = (targets.shape[0], settings.repetitions, targets.shape[1])
    session = _TrialRunner(
        open_robot=open_robot, controllers=dict(controllers), targets=targets, settings=settings, shape=shape,
        tallies={name: Tally(shape, settings.protocol) for name in controllers},
        ledger=ledger or Ledger.nowhere(), limits=limits, stance=stance, correction=correction, model=model,
        progress=_Targets(on_progress, len(controllers) * len(KINDS) * int(np.prod(shape))), on_trial=on_trial,
    )  # fmt: skip
    robot = session.run_batched() if settings.batched else session.run_interleaved()
    tallies = {name: session.tallies[name] for name in session.controllers}
    result = summarise(robot, settings.seed, settings.batched, targets, tallies)
    return replace(result, left_out=tuple(session.left_out))


@dataclass(frozen=True, kw_only=True, eq=False)
class _TrialRunner:
    open_robot: OpenRobot
    controllers: dict[str, ControllerFactory]
    targets: Array
    settings: Settings
    shape: tuple[int, int, int]
    tallies: dict[str, Tally]
    ledger: Ledger
    limits: GuardLimits | None
    stance: Stance | None
    correction: MakeCorrection | None
    model: ToolModel | None
    progress: _Targets
    on_trial: OnTrial | None
    left_out: list[str] = field(default_factory=list)

    def run_batched(self) -> Robot:
        """Run every controller's trials as one batch; returns the last robot, closed."""
        sets, repetitions, _ = self.shape
        places = tuple((s, r) for s in range(sets) for r in range(repetitions))
        for name, factory in self.controllers.items():
            for kind in KINDS:
                robot = self.open_robot(len(places), self.settings.seed)
                try:
                    if self._known(name, kind, places) is None:
                        self._take(self._drive(robot, factory(robot.arm), name, kind, places)[0])
                finally:
                    robot.close()
        return robot

    def run_interleaved(self) -> Robot:
        """Run the trials one after the other on one arm; returns it, closed."""
        rng = np.random.default_rng(self.settings.seed)
        sets, repetitions, _ = self.shape
        robot = self.open_robot(1, self.settings.seed)
        try:
            trials = _OneByOne(self, robot)
            for r in range(repetitions):
                for s in range(sets):
                    for name in map(str, rng.permutation(list(self.tallies))):
                        for kind in KINDS:
                            trials.drive(name, kind, ((s, r),))
        finally:
            robot.close()
        return robot

    def _known(self, name: str, kind: Kind, places: Places) -> Driven | None:
        """Take over what is done already."""
        driven = self.ledger.done.get((name, kind, places))
        if driven is not None:
            self.tallies[name].add(driven)
            self.progress.skip(len(places) * self.shape[2])
        return driven

    def _take(self, driven: Driven) -> None:
        self.tallies[driven.controller].add(driven)
        self.ledger.add(driven)
        self.progress.finish()

    def _drive(
        self, robot: Robot, controller: Controller, name: str, kind: Kind, places: Places, sent: Array | None = None,
    ) -> tuple[Driven, Recording]:  # fmt: skip
        """Run one protocol for the trials (set, repetition) in ``places``."""
        targets = self.targets[[s for s, _ in places]]
        plan = schedule(kind, self.settings.protocol, keep_going=self.settings.batched, sent=sent)
        on_cycle = self.progress.watch(f"{name}: {kind} protocol", targets.shape[0] * targets.shape[1])
        failed = False
        if isinstance(controller, Watched):
            plan = replace(plan, give_up=controller.give_up)
        aiming = None if self.correction is None else self.correction(robot.arm)
        limits = limits_under(self.limits, robot, controller)
        with under_gains(robot, controller):
            recording = run(robot, controller, targets, plan, limits=limits, correction=aiming, on_cycle=on_cycle)
        if isinstance(controller, Watched):
            recording, failed = controller.mark(recording), controller.failed
        if self.on_trial is not None:
            for b, (s, r) in enumerate(places):
                trial = Trial(controller=name, kind=kind, target_set=s, repetition=r, recording=recording, arm_index=b)
                self.on_trial(trial)
        driven = measure(
            robot.arm, recording, targets, self.settings.protocol, controller=name, kind=kind, places=places,
            failed=failed, model=self.model,
        )  # fmt: skip
        return driven, recording


class _OneByOne:
    """Trials on one arm, each from the rest posture."""

    def __init__(self, session: _TrialRunner, robot: Robot) -> None:
        self._session, self._robot = session, robot
        self._left = Elimination(session.settings.protocol)
        self._sent: Array | None = None

    def drive(self, name: str, kind: Kind, places: Places) -> None:
        """Drive a trial, unless it is done or its controller out of the comparison."""
        session = self._session
        if name not in session.controllers or self._left.out(name):
            session.progress.skip(session.shape[2])
            return
        driven = session._known(name, kind, places)
        if driven is None:
            start = self._start()
            if name not in session.controllers:  # its period does not suit, as the first motion has shown
                session.progress.skip(session.shape[2])
                return
            driven = self._insist(name, kind, places, start)
            session._take(driven)
        crossed = session.tallies[name].crossed[places[0]]
        self._left.note(name, kind, places[0], crossed, driven.failed)
        session.tallies[name].out = self._left.out(name)

    def _insist(self, name: str, kind: Kind, places: Places, start: Array) -> Driven:
        """Drive a trial, and again where the answers stayed away for long."""
        session, robot = self._session, self._robot
        for repeat in range(REPEATS + 1):
            controller = self._left.watch(name, session.controllers[name](robot.arm), robot.arm, kind)
            driven, recording = session._drive(robot, controller, name, kind, places, start)
            self._sent = recording.command[-1]
            if recording.gaps().max(initial=0.0) < LONG_GAP or repeat == REPEATS:
                break
            start = self._start()
        return driven

    def _start(self) -> Array:
        """Bring the arm to its rest posture; returns the command there (1, n) [rad]."""
        if self._sent is None:
            motion = begin(self._robot, self._session.limits, self._session.stance)
            self._check_period(motion.usual_period())
        else:
            motion = move(self._robot, self._robot.arm.rest, sent=self._sent, limits=self._session.limits)
        self._sent = motion.command[-1]
        return self._sent

    def _check_period(self, period: float) -> None:
        session = self._session
        for name, factory in list(session.controllers.items()):
            try:
                controller = factory(self._robot.arm)
                check_controller_period(controller, period)
                require_gains(self._robot, controller)
            except ContractError as error:
                if not session.settings.leave_out or len(session.controllers) == 1:
                    raise
                session.left_out.append(f"{name} did not take part: {error}.")
                del session.controllers[name]


class _Targets:
    """Counts the targets that are finished, and reports their share."""

    def __init__(self, report: Progress, total: int) -> None:
        self._report, self._total = report, total
        self._done = self._size = self._cycles = 0
        self._text = ""

    def watch(self, text: str, size: int) -> Callable[[Cycle], None]:
        self._text, self._size, self._cycles = text, size, 0
        return self._see

    def finish(self) -> None:
        self._done += self._size
        self._report(self._done / self._total, self._text)

    def skip(self, size: int) -> None:
        self._size = size
        self.finish()

    def _see(self, cycle: Cycle) -> None:
        if self._cycles % _PROGRESS_CYCLES == 0:
            self._report((self._done + int(cycle.target_index.sum())) / self._total, self._text)
        self._cycles += 1
