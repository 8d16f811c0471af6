"""Following: an arm driven behind a target that moves, and how well it followed."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from rejoint.arms import Array
from rejoint.control.controller import Controller
from rejoint.control.guard import GuardLimits
from rejoint.control.moving.drive import Followed, approach, follow_guide
from rejoint.control.moving.path import Path
from rejoint.control.moving.routes import Ahead, Stream
from rejoint.control.recording import Cycle, Recording, recording_of
from rejoint.control.robot import Robot
from rejoint.control.servogains import limits_under
from rejoint.control.start import begin
from rejoint.runs.given import (
    ArmLike,
    CalibrationLike,
    Live,
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
    shown,
)
from rejoint.runs.run import Run, exclusive
from rejoint.runs.stages.controllers import ControllerLike
from rejoint.runs.stages.keeping import kept_if_stopped, start_journal
from rejoint.runs.stages.known import calibration_of, correction_of, guard_limits, stance_of, twin_in_force
from rejoint.runs.stages.loads import PayloadLike, Say, say_folded, say_heavy, say_noticed, silent, with_load
from rejoint.runs.stages.pathdrive import (
    TRACKER,
    WITHIN,
    PathDrive,
    PathLike,
    Piece,
    followable,
    follower_of,
    require_repeatable,
    turned,
)
from rejoint.system.files import require_space, saving
from rejoint.system.numbers import as_seed
from rejoint.system.progress import Progress, no_progress, paced
from rejoint.system.stopping import noted

LOOKED_AT = 50
"""Places of a path that are judged before it is driven (chosen: a wave has a dozen)"""


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
    payload: PayloadLike | None = None,
    tool: ArrayLike | None = None,
    repeat: int = 1,
    rate: float | None = None,
    duration: float | None = None,
    within: float = WITHIN,
    period: Period | None = None,
    seed: int | None = None,
    on_progress: Progress = no_progress,
    say: Say = silent,
    live: Live | None = None,
) -> Followed:
    """Drive an arm along a path, under the guard, and say how well it followed.

    The arm is looked at first, goes slowly to its rest posture and to the start of the path, stands there for two
    seconds, and then moves. While it moves, Ctrl-C and SIGTERM bring it to a hold; then `Interrupted` is raised.

    Parameters
    ----------
    robot
        robot or its address
    path
        `Path`, CSV file with the header ``time,x,y,z`` in seconds and millimetres and perhaps columns of an
        orientation, (T, 4) numbers in seconds and
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
    payload
        [kg] that the hand carries at its tool centre point, or a `Payload`; everything is computed with it
    tool
        (3,) [m] from the tool centre point of the arm's description to the tip of a tool, in the frame of the former
    repeat
        how often; from the second time on the path is aimed at by what was missed before
    rate
        [Hz] at which the path is given to the arm as it goes, instead of being known ahead; then it goes 0.08 s behind
    duration
        [s] for which a stream is followed; of no path
    within
        [m] root mean square within which the path counts as followed, at most 0.1
    period
        [s] interval of the control periods; by default what the robot suits
    seed
        of an emulated arm's noise, and of a random standard path; by default that of the run, else 0
    on_progress
        called with the share that is done
    say
        told, in lines, which places are too heavy, before the arm moves, and of a load that was not given, at the end
    live
        shows the arm meanwhile: a `LiveView`

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
    chosen = with_load(arm_of(robot, arm) if about is None else about.arm, robot, payload, tool)
    seed = as_seed(seed) if about is None else about.seed
    require_repeatable(path, repeat, rate, within)
    with exclusive(about):
        given = followable(path, chosen, seed, duration)
        known = as_twin(twin) if twin is not None else None if about is None else about.twin
        places = None
        if isinstance(given, Path):
            few = slice(None, None, max(1, len(given.place) // LOOKED_AT))
            places = given.place[few]
            say_heavy(chosen, known, places, say, given.turn_at(given.time[few]))
        correct = correction_of(calibration, about, chosen, address_of(robot), places)
        usual = period_of(robot, period)
        if about is not None:
            require_space(about.path)
        with noted(), opened(robot, chosen, seed, period) as connection:
            limits = limits_under(guard_limits(about, chosen, connection.address), connection, None)
            known = twin_in_force(about, connection) if about is not None and twin is None else known
            connection = shown(live, connection, twin=known, within=within)
            follower = follower_of(controller, chosen, usual, about, known)
            if not turned(given):
                say_folded(chosen, follower.home, say)
            with kept_if_stopped(about, "follow"):
                start = begin(connection, limits, stance_of(known, about))
            carrier = _Logged(
                robot=connection, run=about, limits=limits,
                on_progress=on_progress, period=0.02 if usual is None else min(usual),
            )  # fmt: skip
            drive = PathDrive(
                arm=chosen, follower=follower, usual=start.usual_period(), within=within, carrier=carrier,
                correction=None if correct is None else correct(chosen),
                model=calibration_of(calibration, about, chosen, address_of(robot)),
            )  # fmt: skip
            if isinstance(given, Stream):
                done = drive.behind(given, duration or 0.0, start.command[-1])
            else:
                done = drive.along(given, repeat, rate, start.command[-1])
        say_noticed(chosen, known, done.passes[-1].log, say)
        return done


@dataclass(frozen=True, kw_only=True, eq=False)
class _Logged:
    """Carries an open robot; in a run, what is recorded is kept as it comes, also where ``kill -9`` ends it."""

    robot: Robot
    run: Run | None
    limits: GuardLimits | None
    on_progress: Progress
    period: float

    def approach(self, posture: Array, sent: Array) -> Recording:
        with kept_if_stopped(self.run, "follow"):
            return approach(self.robot, posture, sent, self.limits)

    def carry(self, guide: Ahead | Stream, controller: Controller, sent: Array, piece: Piece) -> Recording:
        rows, number, total = int(piece.duration / self.period), piece.number, piece.total
        name = "follow" if total == 1 else f"follow-{number + 1:02d}"
        journal = None if self.run is None else start_journal(self.run, name, self.robot, piece.label, rows)

        def watch(cycle: Cycle) -> None:
            if journal is not None:
                journal.see(cycle)
            share = min(float(cycle.since_target[0]) / piece.duration, 1.0)
            self.on_progress((number + share) / total, f"time {number + 1} of {total}" if total > 1 else "")

        try:
            recording = follow_guide(
                self.robot, controller, guide, piece.duration, sent, limits=self.limits, on_cycle=watch
            )
        except BaseException as error:
            partial = recording_of(error)
            if journal is not None and partial is not None and len(partial.time):
                error.add_note(journal.keep(partial.log(0, f"{piece.label}/stopped")))
            elif journal is not None:
                journal.discard()
            raise
        if journal is not None:
            with saving(recording):
                journal.finish(recording.log(0, piece.label))
        return recording
