"""Diagnosis: what is wrong with an arm, from its motion or from logs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

from rejoint.arms import Arm
from rejoint.control.robot import Robot
from rejoint.control.servogains import gains_in_force
from rejoint.logs.runfolder.folder import RunFolder
from rejoint.logs.runlog import RunLog, write_log
from rejoint.runs.given import (
    FIRST_ROBOT,
    ArmLike,
    Live,
    LogsLike,
    Period,
    RobotLike,
    RunLike,
    address_of,
    arm_of,
    as_logs,
    is_robot,
    opened,
    run_about,
    run_of_logs,
    shown,
    source_of,
)
from rejoint.runs.history.summary import summarise
from rejoint.runs.metering import metered
from rejoint.runs.run import Run, exclusive, mark_quick, remove_if_empty
from rejoint.runs.stages.keeping import start_journal
from rejoint.system.errors import InputError
from rejoint.system.files import read_json, require_space, saving, set_aside, write_json
from rejoint.system.numbers import as_seed
from rejoint.system.progress import Progress, no_progress, paced
from rejoint.system.stopping import noted

if TYPE_CHECKING:  # these need the simulator, which a Raspberry Pi does not have
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.diagnosis.healthy import HealthyReference
    from rejoint.diagnosis.record import DiagnosisLogs
    from rejoint.diagnosis.verdict import Finding


@dataclass(frozen=True, kw_only=True, eq=False)
class Diagnosed:
    """What a diagnosis found, and the motion that it was found in."""

    diagnosis: Diagnosis
    """every joint in numbers, and what it was compared with"""
    targets: RunLog | None = None
    """ten targets, each commanded once; None for a diagnosis from logs"""
    excitation: RunLog | None = None
    """a motion that shows every joint's wear, as `identify` needs it; None for a diagnosis from logs"""

    @property
    def verdict(self) -> str:
        """What is wrong, in sentences for the owner."""
        return self.diagnosis.verdict

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong joint by joint, the worst at the tool first; ``tcp_mm`` is what it costs there."""
        return self.diagnosis.findings


@paced
def diagnose(
    source: RobotLike | LogsLike = FIRST_ROBOT,
    *,
    arm: ArmLike | None = None,
    run: RunLike | None = None,
    healthy: RunLike | Diagnosis | None = None,
    period: Period | None = None,
    seed: int | None = None,
    quick: bool = False,
    on_progress: Progress = no_progress,
    live: Live | None = None,
) -> Diagnosed:
    """Find out what is wrong with an arm: by driving it, or from logs of any motion.

    A robot is driven to ten targets, open loop, and through an excitation of every joint (three minutes). While it
    moves, Ctrl-C and SIGTERM first bring it to a hold; then `Interrupted` is raised, which is a KeyboardInterrupt.

    Parameters
    ----------
    source
        robot or its address; or run logs, a file of one, or a folder of them. A text with a colon is an address.
    arm
        arm, name or file; needed for logs in memory or on file, for a robot only where its address does not tell
    run
        run, or its folder, into which logs and diagnosis are written; without one nothing is written
    healthy
        run or diagnosis of an arm known to be good, to compare with; by default an emulated healthy one of its kind
    period
        [s] interval of the control periods; by default what the robot suits
    seed
        of targets, excitation and an emulated arm's noise; by default that of the run, else 0
    quick
        excite for 90 s instead of 140 s, for a first try: wear shows less surely
    on_progress
        called with the share that is done and what is being done
    live
        shows the arm meanwhile: a `LiveView`

    Returns
    -------
    Diagnosed
        ``verdict`` in words, ``findings`` per joint, and the logs of the motion

    Raises
    ------
    InputError
        if logs are of another arm or hold too little free motion, or the run is of another robot
    AddressError
        if no robot answers
    GuardTripError, RobotError
        if the motion had to be ended; the arm holds, and the notes of the error say where its log is
    UnsavedError
        if the result could not be written; it is in the error

    Examples
    --------
    >>> found = rejoint.diagnose("emulated:worn")
    >>> print(found.verdict)
    >>> log = rejoint.RunLog.of(time, command, position, arm="so101")
    >>> rejoint.diagnose(log, arm="so101").findings[0].sentence
    """
    if not is_robot(source):
        if period is not None:
            raise InputError("diagnosis: logs have the control period that they have; leave it out")
        return Diagnosed(diagnosis=_from_logs(cast(LogsLike, source), arm, run, healthy, on_progress))
    robot = cast(RobotLike, source)
    chosen = run.arm if isinstance(run, Run) else arm_of(robot, arm)
    about = run_about(run, address_of(robot), chosen, seed)
    about = None if about is None else about.begin()
    seed = as_seed(seed) if about is None else about.seed
    with exclusive(about):
        try:
            reference = _reference(chosen, healthy)
            with (
                noted(),
                metered(about.folder if about else None, "diagnose") as meter,
                opened(robot, chosen, seed, period) as connection,
            ):
                connection = shown(live, meter.watch(connection))
                if healthy is None:
                    reference = _as_set(connection, reference)
                return _drive(connection, about, reference, seed, quick=quick, on_progress=on_progress)
        except BaseException:
            if about is not None:  # a robot that does not answer, or is not ready, leaves no folder behind
                remove_if_empty(about)
            raise


def _drive(
    robot: Robot, run: Run | None, healthy: HealthyReference | None, seed: int, *, quick: bool, on_progress: Progress
) -> Diagnosed:
    """Excite the robot and judge it; what it did until an error is kept in the run."""
    from rejoint.diagnosis.diagnosis import diagnose as drive_and_judge
    from rejoint.diagnosis.excitation import FULL, SHORT

    journal = None
    if run is not None:
        require_space(run.path)
        journal = start_journal(run, "diagnosis", robot, "diagnosis")
    try:
        found, logs = drive_and_judge(
            robot, healthy, seed=seed, plan=SHORT if quick else FULL, on_cycle=None if journal is None else journal.see,
            on_progress=on_progress,
        )  # fmt: skip
    except BaseException as error:
        if journal is not None:
            error.add_note(journal.rescue())
        raise
    gains = gains_in_force(robot)
    found = replace(found, servo_gains=None if gains is None else dict(gains))
    result = Diagnosed(diagnosis=found, targets=logs.targets, excitation=logs.excitation)
    if run is not None and journal is not None:
        journal.close()
        with saving(result):
            run.begin()
            mark_quick(run, quick=quick)
            _write(run.folder, found, logs)
            summarise(run)
        journal.discard()
    return result


def _as_set(robot: Robot, reference: HealthyReference | None) -> HealthyReference | None:
    """Take the ``reference`` for the gains and the supply that the servos of ``robot`` have."""
    from rejoint.diagnosis.healthy import as_set

    voltage = robot.read().voltage
    return as_set(robot.arm, reference, gains_in_force(robot), None if voltage is None else voltage[0])


def _write(folder: RunFolder, found: Diagnosis, logs: DiagnosisLogs) -> None:
    """Write logs and diagnosis; earlier ones are set aside."""
    targets, excitation = folder.log("targets"), folder.log("excitation")
    for earlier in (targets, excitation, folder.diagnosis):
        set_aside(earlier)
    write_log(targets, logs.targets)
    write_log(excitation, logs.excitation)
    write_json(folder.diagnosis, found)


def _from_logs(
    source: LogsLike, arm: ArmLike | None, given: RunLike | None, healthy: RunLike | Diagnosis | None,
    on_progress: Progress,
) -> Diagnosis:  # fmt: skip
    """Judge an arm by logs of any motion."""
    from rejoint.diagnosis.fromlogs import diagnose_logs

    run, chosen = run_of_logs(given, source, arm)
    with exclusive(run):
        name = source_of(source) if run is None else run.robot
        found = diagnose_logs(
            chosen, as_logs(source), _reference(chosen, healthy), source=name, on_progress=on_progress
        )
        if run is not None:
            write_json(run.begin().folder.diagnosis, found)
            summarise(run)
    return found


def _reference(arm: Arm, healthy: RunLike | Diagnosis | None) -> HealthyReference | None:
    """Take the reference of an arm from one known to be good, else the emulated one of its kind."""
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.diagnosis.healthy import healthy_reference
    from rejoint.diagnosis.knowngood import reference_by

    if healthy is None:
        return healthy_reference(arm)
    if isinstance(healthy, Run):
        healthy = healthy.path
    if not isinstance(healthy, Diagnosis):
        healthy = read_json(RunFolder(Path(healthy)).diagnosis, Diagnosis)
    return reference_by(arm, healthy)
