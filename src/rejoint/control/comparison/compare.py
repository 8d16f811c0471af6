"""Try every controller on the same arm, with the same targets, from the same start.

On emulated arms all trials of a controller run side by side as one batch of equal arms with
different noise, the same for every controller. On a real arm the trials run one after the other, the
controllers interleaved in random order, so that a warming or loosening arm favours none of them; one that fails is
driven no further (`rejoint.control.comparison.elimination`), and in a race one that is beaten neither
(`rejoint.control.comparison.racing`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.orientation import Orientation
from rejoint.control.accuracy import ToolModel
from rejoint.control.comparison.counting import Targets
from rejoint.control.comparison.driven import Driven, Places, measure
from rejoint.control.comparison.elimination import Watched
from rejoint.control.comparison.ledger import Ledger
from rejoint.control.comparison.onearm import OneArm
from rejoint.control.comparison.protocols import KINDS, Kind, schedule
from rejoint.control.comparison.racing import Race
from rejoint.control.comparison.result import Comparison, Protocol
from rejoint.control.comparison.sharing import Helper, Shared
from rejoint.control.comparison.summary import Tally, cut_to_driven, summarise
from rejoint.control.controller import Controller
from rejoint.control.correction import Correction
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import run
from rejoint.control.poses import in_words
from rejoint.control.recording import Recording
from rejoint.control.robot import Robot
from rejoint.control.servogains import limits_under, under_gains
from rejoint.control.start import Stance
from rejoint.logs.runlog import RunLog
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, no_progress

OpenRobot = Callable[[int, int], Robot]
"""Opens a robot of ``count`` arms with a noise ``seed``."""
ControllerFactory = Callable[[Arm], Controller]
MakeCorrection = Callable[[Arm], Correction]


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
    first: int = 0
    """index of its first target in the set: in a race, a set is held in parts"""

    @property
    def label(self) -> str:
        """Such as ``hold/policy/0/2``: protocol, controller, target set, repetition."""
        return f"{self.kind}/{self.controller}/{self.target_set}/{self.repetition}"

    def log(self) -> RunLog:
        """Run log of this trial."""
        return self.recording.log(self.arm_index, self.label)


OnTrial = Callable[[Trial], object]
"""Called after every trial, so that its log can be kept."""

MOST = 10_000
"""Target sets times repetitions of a comparison at most (chosen: a month of processor time, and memory for all)"""


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
    race: Race | None = None
    """when a comparison on one arm is decided; None: every controller is driven to all targets"""
    wait: bool = False
    """whether a target that is not crossed is waited for to the end, also by an arm that stands: as the paper did, to
    the letter. Either way it counts as waited for"""

    def __post_init__(self) -> None:
        if self.repetitions < 1:
            raise InputError(f"comparison: repetitions must be at least 1, got {self.repetitions}")
        if self.batched and self.race is not None:
            raise InputError("comparison: arms side by side do not race, all of them are driven to the end")


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
    measured: Sequence[Driven] = (),
    source: str = "",
    turns: Orientation | None = None,
    helper: Helper | None = None,
) -> Comparison:
    """Compare ``controllers`` by name on ``targets`` (S, K, 3) [m], with the tools turned as in ``turns`` (S, K).

    Trials of a batch that the guard ends count as failures; on a single arm the trip ends the
    comparison, as does an error of the robot. A command that is not a number costs its controller the trial in both.
    What is done already by the ``ledger`` is not driven again. ``limits`` are the guard's, by default those of the arm.
    A single arm that does not stand at rest as its ``stance`` says is not driven: NotReadyError.
    In a race, what is ``measured`` already is not driven either; ``source`` says in a few words where.
    A ``correction`` aims for all controllers alike. Where nobody knows where the tool is, a ``model`` says how far it
    is from its targets. Of a batch, a ``helper`` drives a part of the trials in another process; ``on_trial`` is called
    for those whose recording it hands over.
    """
    targets = np.asarray(targets, dtype=float)
    if targets.ndim != 3 or targets.shape[2] != 3 or 0 in targets.shape or not np.isfinite(targets).all():
        raise InputError(f"comparison: targets have shape {targets.shape}, expected finite (sets, targets, 3)")
    if not controllers:
        raise InputError("comparison: no controllers given")
    shape = (targets.shape[0], settings.repetitions, targets.shape[1])
    if shape[0] * shape[1] > MOST:
        raise InputError(f"comparison: {shape[0]} sets times {shape[1]} repetitions, at most {MOST} were expected")
    trips = len(KINDS) if settings.race is None else 1
    session = TrialRunner(
        open_robot=open_robot, controllers=dict(controllers), targets=targets, settings=settings, shape=shape,
        tallies={name: Tally(shape, settings.protocol, raced=settings.race is not None) for name in controllers},
        ledger=ledger or Ledger.nowhere(), limits=limits, stance=stance, correction=correction, model=model,
        progress=Targets(on_progress, len(controllers) * trips * int(np.prod(shape))), on_trial=on_trial,
        measured=tuple(measured), source=source, turns=turns, helper=helper,
    )  # fmt: skip
    robot = session.run_batched() if settings.batched else session.run_interleaved()
    tallies = {name: session.tallies[name] for name in session.controllers}
    most = None
    if settings.race is not None:
        most = shape[:2]
        targets = targets[: cut_to_driven(tallies)]
    result = summarise(robot, settings.seed, settings.batched, targets, tallies)
    if turns is not None:
        shape = targets.shape[:2]
        words = tuple(tuple(in_words(turns[s, k]) for k in range(shape[1])) for s in range(shape[0]))
        result = replace(result, orientations=words)
    return replace(result, left_out=tuple(session.left_out), race=settings.race, most=most)


@dataclass(frozen=True, kw_only=True, eq=False)
class TrialRunner:
    """What is to be driven, and what came out so far."""

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
    progress: Targets
    on_trial: OnTrial | None
    measured: tuple[Driven, ...]
    source: str
    turns: Orientation | None = None
    helper: Helper | None = None
    left_out: list[str] = field(default_factory=list)

    def run_batched(self) -> Robot:
        """Run every controller's trials as one batch; returns a robot, closed."""
        sets, repetitions, _ = self.shape
        places = tuple((s, r) for s in range(sets) for r in range(repetitions))
        tasks = [(name, kind) for name in self.controllers for kind in KINDS if self.known(name, kind, places) is None]
        shared, robot = Shared(tasks, self.helper, places), None
        for name, kind in shared.here():
            robot = self.open_batch(places)
            self.take(self.drive_batch(robot, name, kind, places)[0])
            for found in shared.arrived():
                self._take_over(*found)
        for found in shared.arrived():
            self._take_over(*found)
        if robot is None:
            robot = self.open_batch(places)
            robot.close()
        return robot

    def open_batch(self, places: Places) -> Robot:
        """Open a robot with an arm for each trial, as every controller and protocol gets it anew."""
        return self.open_robot(len(places), self.settings.seed)

    def drive_batch(self, robot: Robot, name: str, kind: Kind, places: Places) -> tuple[Driven, Recording]:
        """Run one protocol for all trials of a controller, side by side, and close their ``robot``."""
        try:
            return self.drive(robot, self.controllers[name](robot.arm), name, kind, places)
        finally:
            robot.close()

    def _take_over(self, driven: Driven, recording: Recording) -> None:
        """Take over what a helper has driven."""
        self._tell(driven.controller, driven.kind, driven.places[: recording.time.shape[1]], recording)
        self.tallies[driven.controller].add(driven)
        self.ledger.add(driven)
        self.progress.skip(len(driven.places) * driven.targets)

    def run_interleaved(self) -> Robot:
        """Run the trials one after the other on one arm; returns it, closed."""
        robot = self.open_robot(1, self.settings.seed)
        try:
            trials = OneArm(self, robot)
            if self.settings.race is None:
                trials.drive_all()
            else:
                trials.race(self.settings.race)
        finally:
            robot.close()
        return robot

    def known(self, name: str, kind: Kind, places: Places, first: int = 0) -> Driven | None:
        """Take over what is done already."""
        driven = self.ledger.done.get((name, kind, places, first))
        if driven is not None:
            self.tallies[name].add(driven)
            self.progress.skip(len(places) * driven.targets)
        return driven

    def take(self, driven: Driven) -> None:
        """Take over what was just driven."""
        self.tallies[driven.controller].add(driven)
        self.ledger.add(driven)
        self.progress.finish()

    def drive(
        self, robot: Robot, controller: Controller, name: str, kind: Kind, places: Places, sent: Array | None = None,
        part: slice = slice(None), *, both: bool = False,
    ) -> tuple[Driven, Recording]:  # fmt: skip
        """Run one protocol for the trials (set, repetition) in ``places``, with a ``part`` of the targets of a set.

        With ``both``, holds tell as well when their targets were crossed.
        """
        targets, first = self.targets[[s for s, _ in places]][:, part], part.start or 0
        turns = None if self.turns is None else self.turns[[s for s, _ in places]][:, part]
        plan = schedule(
            kind, self.settings.protocol, keep_going=self.settings.batched, sent=sent, wait=self.settings.wait
        )
        on_cycle = self.progress.watch(f"{name}: {kind} protocol", targets.shape[0] * targets.shape[1])
        failed = False
        if isinstance(controller, Watched):
            plan = replace(plan, give_up=controller.give_up)
        aiming = None if self.correction is None else self.correction(robot.arm)
        limits = limits_under(self.limits, robot, controller)
        with under_gains(robot, controller):
            recording = run(
                robot, controller, targets, plan, limits=limits, correction=aiming, on_cycle=on_cycle, turns=turns
            )
        if isinstance(controller, Watched):
            recording, failed = controller.mark(recording), controller.failed
        self._tell(name, kind, places, recording, first)
        driven = measure(
            robot.arm, recording, targets, self.settings.protocol, controller=name, kind=kind, places=places,
            failed=failed, model=self.model, first=first, both=both,
        )  # fmt: skip
        return driven, recording

    def _tell(self, name: str, kind: Kind, places: Places, recording: Recording, first: int = 0) -> None:
        """Hand every trial of a recording to who keeps their logs."""
        if self.on_trial is None:
            return
        for b, (s, r) in enumerate(places):
            trial = Trial(controller=name, kind=kind, target_set=s, repetition=r, recording=recording, arm_index=b)
            self.on_trial(replace(trial, first=first))
