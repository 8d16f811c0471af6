"""Following: an arm driven behind a target that moves, and how well it followed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.controller import Controller
from rejoint.control.guard import GuardLimits
from rejoint.control.moving.drive import (
    Followed,
    Pass,
    approach,
    corrected_path,
    corrector,
    follow_guide,
    judge,
    missed,
)
from rejoint.control.moving.path import Path, read_path
from rejoint.control.moving.repeating import learned
from rejoint.control.moving.routes import LAG, LEAD_IN, Ahead, Stream, played
from rejoint.control.moving.sender import Sender
from rejoint.control.moving.servos import Servos
from rejoint.control.moving.standard import is_standard, standard_path
from rejoint.control.moving.tracker import Tracker
from rejoint.control.recording import Cycle, Recording, recording_of
from rejoint.control.robot import Robot
from rejoint.control.start import begin
from rejoint.runs.given import (
    ArmLike,
    CalibrationLike,
    Period,
    RobotLike,
    RunLike,
    TwinLike,
    address_of,
    arm_of,
    as_run,
    as_twin,
    opened,
    period_of,
)
from rejoint.runs.run import Run, exclusive
from rejoint.runs.stages.driving import (
    ControllerLike,
    correction_of,
    guard_limits,
    make_factories,
    stance_of,
    start_journal,
)
from rejoint.system.errors import InputError
from rejoint.system.files import require_space, saving
from rejoint.system.progress import Progress, no_progress, paced
from rejoint.system.stopping import noted

if TYPE_CHECKING:
    from rejoint.control.correction import Modelled
    from rejoint.twin.twin import Twin

PathLike: TypeAlias = "Path | FilePath | str | Array"
"""A path, its CSV file, the name of a standard one, or (T, 4) times [s] and places [m]"""

TRACKER, SENT = "tracker", "default"
"""Names of the controller that follows by the twin, and of the path sent as it comes"""

Factory = Callable[[Arm, float], Controller]
"""Makes a controller for an arm and the usual length [s] of its control periods"""

WITHIN = 5e-3
"""[m] root mean square, after the best single lag, within which a path counts as followed (chosen: as for targets)"""


@paced
def follow(
    robot: RobotLike,
    path: PathLike | Stream,
    *,
    run: RunLike | None = None,
    controller: ControllerLike = TRACKER,
    arm: ArmLike | None = None,
    twin: TwinLike | None = None,
    calibration: CalibrationLike | None = None,
    repeat: int = 1,
    rate: float | None = None,
    duration: float | None = None,
    within: float = WITHIN,
    period: Period | None = None,
    seed: int | None = None,
    on_progress: Progress = no_progress,
) -> Followed:
    """Drive an arm along a path, under the guard, and say how well it followed.

    The arm is looked at first, goes slowly to its rest posture and to the start of the path, stands there for two
    seconds, and then moves. While it moves, Ctrl-C and SIGTERM bring it to a hold; then `Interrupted` is raised.

    Parameters
    ----------
    robot
        robot or its address
    path
        `Path`, CSV file with the header ``time,x,y,z`` in seconds and millimetres, (T, 4) numbers in seconds and
        metres, or a standard path: ``circle-8s``, ``random-0.2hz`` and the like; or a `Stream`, which needs a
        ``duration``, and a first target before it begins
    run
        run, or its folder, with the twin; the run log is written there, without one nothing is
    controller
        ``tracker``, which needs a twin; ``default`` for the path sent as it comes; or a controller of your own
    arm
        arm, name or file; needed only without a run, where the address does not tell
    twin
        twin that the arm is driven by; by default that of the run
    calibration
        what lies behind the encoders, or its file; ``none`` for no correction. By default that of ``run``
    repeat
        how often; from the second time on the path is aimed at by what was missed before
    rate
        [Hz] at which the path is given to the arm as it goes, instead of being known ahead; then it goes 0.08 s behind
    duration
        [s] for which a stream is followed
    within
        [m] root mean square within which the path counts as followed
    period
        [s] interval of the control periods; by default what the robot suits
    seed
        of an emulated arm's noise, and of a random standard path; by default that of the run, else 0
    on_progress
        called with the share that is done

    Returns
    -------
    Followed
        ``passes``, one for each time: errors along the way by the encoders [m], as they are and after the best single
        lag, the true error and how it is known, the run log; ``followed``

    Raises
    ------
    InputError, FileError
        if the path is out of reach, or too fast, and where; or no twin is known; nothing has moved
    NotReadyError
        if the arm had better not be moved
    GuardTripError, RobotError
        if the motion had to be ended; the arm holds

    Examples
    --------
    >>> done = rejoint.follow("emulated:worn", "circle-8s", run="runs/mine")
    >>> print(done.passes[-1].encoder.rms)
    """
    about = None if run is None else as_run(run).seeded(seed)
    chosen = arm_of(robot, arm) if about is None else about.arm
    seed = seed or 0 if about is None else about.seed
    if repeat < 1 or (repeat > 1 and (rate is not None or isinstance(path, Stream))):
        raise InputError("follow: to be repeated at least once, and more often only where the path is known ahead")
    with exclusive(about):
        given = path if isinstance(path, Stream) else as_path(path, chosen, seed)
        if isinstance(given, Path):
            given.require_followable(chosen)
        elif duration is None or not duration > 0.0:
            raise InputError("follow: a stream needs a duration in seconds for which it is followed")
        known = as_twin(twin) if twin is not None else None if about is None else about.twin
        correct = correction_of(calibration, about, chosen, address_of(robot))
        usual = period_of(robot, period)
        name, make = _controller(controller, chosen, usual, about, known)
        if about is not None:
            require_space(about.path)
        with noted(), opened(robot, chosen, seed, period) as connection:
            drive = _PathDrive(
                robot=connection, name=name, make=make, run=about, twin=known,
                correction=None if correct is None else correct(chosen), within=within, on_progress=on_progress,
                period=0.02 if usual is None else min(usual),
            )  # fmt: skip
            if isinstance(given, Stream):
                return drive.behind(given, duration or 0.0)
            return drive.along(given, repeat, rate)


def as_path(given: PathLike, arm: Arm, seed: int) -> Path:
    """Return the path itself, of its file or numbers, or the standard one of that name."""
    if isinstance(given, Path):
        return given
    if isinstance(given, str) and is_standard(given):
        return standard_path(given, arm, seed)
    if isinstance(given, str | FilePath):
        return read_path(FilePath(given))
    numbers = np.asarray(given, dtype=float)
    if numbers.ndim != 2 or numbers.shape[-1] != 4:
        raise InputError(f"path: an array of shape {numbers.shape}, expected (points, 4): time [s] and x, y, z [m]")
    return Path(time=numbers[:, 0], place=numbers[:, 1:])


def servos_of(twin: Twin, count: int = 1) -> Servos:
    """Return what a tracker of ``count`` arms takes from a twin."""
    own = twin.parameters.repeat(count)
    return Servos(
        stiffness=own.stiffness, damping=own.damping, coulomb=own.coulomb, armature=own.armature,
        torque_limit=own.torque_limit, offset=own.offset, delay=own.delay,
    )  # fmt: skip


def _controller(
    given: ControllerLike, arm: Arm, usual: Period | None, run: Run | None, twin: Twin | None
) -> tuple[str, Factory]:
    """Return the name of a controller and what makes it, for each time along the path."""
    if given == SENT:
        return SENT, lambda arm, period: Sender(arm)  # noqa: ARG005 - it knows no time
    if given == TRACKER:
        if twin is None:
            raise InputError(
                "follow: the tracker needs a twin; run `rejoint identify` first, or take --controller default"
            )
        return TRACKER, lambda arm, period: Tracker(arm, servos_of(twin), period=period)
    if isinstance(given, str) and not given.endswith(".onnx"):
        raise InputError(f"no controller called {given!r} follows paths; known: {TRACKER}, {SENT}")
    ((name, make),) = make_factories([given], arm, usual, run=run, twin=twin).items()
    return name, lambda arm, period: make(arm)  # noqa: ARG005 - its own affair


@dataclass(frozen=True, kw_only=True, eq=False)
class _PathDrive:
    """Paths on an open robot."""

    robot: Robot
    name: str
    make: Factory
    run: Run | None
    twin: Twin | None
    correction: Modelled | None
    within: float
    on_progress: Progress
    period: float

    def along(self, path: Path, repeat: int, rate: float | None) -> Followed:
        """Go along a path, ``repeat`` times; at a ``rate`` [Hz] it is told as it goes."""
        arm = self.robot.arm
        wanted = path if self.correction is None else corrected_path(arm, path, self.correction)
        (sent, usual), aim, passes = self._begin(), wanted, list[Pass]()
        last: Recording | None = None
        for number in range(repeat):
            sent = approach(self.robot, wanted.at(0.0), sent, self._limits()).command[-1]
            guide = Ahead(path=path, aim=aim)
            told = guide if rate is None else played(wanted, rate)
            duration = LEAD_IN + path.duration + (0.0 if rate is None else LAG)
            last = self._pass(told, self.make(arm, usual), path.name, duration, sent, number, repeat)
            done = replace(judge(arm, last, Ahead(path=path, aim=wanted)), log=last.log(0, self._label(path.name)))
            passes.append(done)
            aim, sent = learned(wanted, aim, *missed(arm, last, guide, wanted), number), last.command[-1]
        return self._followed(path.name, passes, last)

    def behind(self, stream: Stream, duration: float) -> Followed:
        """Go behind a stream for ``duration`` [s]."""
        arm, start = self.robot.arm, stream.place(0.0)
        if self.correction is not None and stream.corrected is None:
            stream.corrected = corrector(arm, self.correction, start)
        sent, usual = self._begin()
        sent = approach(self.robot, start, sent, self._limits()).command[-1]
        last = self._pass(stream, self.make(arm, usual), "stream", duration, sent, 0, 1)
        done = replace(judge(arm, last, stream), log=last.log(0, self._label("stream")))
        return self._followed("stream", [done], last)

    def _begin(self) -> tuple[Array, float]:
        """Look at the arm and bring it to rest; return the command (1, n) [rad] in force, and the usual period [s]."""
        start = begin(self.robot, self._limits(), stance_of(self.twin))
        return start.command[-1], start.usual_period()

    def _limits(self) -> GuardLimits:
        return guard_limits(self.run, self.robot.arm, self.robot.address)

    def _label(self, path: str) -> str:
        return f"follow/{self.name}/{path}"

    def _pass(
        self, guide: Ahead | Stream, controller: Controller, path: str, duration: float, sent: Array, number: int,
        total: int,
    ) -> Recording:  # fmt: skip
        """Drive; in a run, what is recorded is kept as it comes, also where ``kill -9`` ends it."""
        label, rows = self._label(path), int(duration / self.period)
        name = "follow" if total == 1 else f"follow-{number + 1:02d}"
        journal = None if self.run is None else start_journal(self.run, name, self.robot, label, rows)

        def watch(cycle: Cycle) -> None:
            if journal is not None:
                journal.see(cycle)
            share = min(float(cycle.since_target[0]) / duration, 1.0)
            self.on_progress((number + share) / total, f"time {number + 1} of {total}" if total > 1 else "")

        try:
            recording = follow_guide(
                self.robot, controller, guide, duration, sent, limits=self._limits(), on_cycle=watch
            )
        except BaseException as error:
            partial = recording_of(error)
            if journal is not None and partial is not None and len(partial.time):
                error.add_note(journal.keep(partial.log(0, f"{label}/stopped")))
            elif journal is not None:
                journal.discard()
            raise
        if journal is not None:
            with saving(recording):
                journal.finish(recording.log(0, label))
        return recording

    def _followed(self, path: str, passes: list[Pass], last: Recording | None) -> Followed:
        period = float("nan") if last is None else last.usual_period()
        gaps = () if last is None else tuple(float(gap) for gap in last.gaps() if gap > 0.0)
        return Followed(
            path=path, controller=self.name, within=self.within, passes=tuple(passes),
            period=period if np.isfinite(period) else None, gaps=gaps,
        )  # fmt: skip
