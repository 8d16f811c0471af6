"""Diagnosis of an arm, from its motion or from logs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.control.recording import Observer, pacing
from rejoint.control.servogains import gains_in_force
from rejoint.diagnosis.diagnosis import Diagnosis, diagnose_logs, judge
from rejoint.diagnosis.excitation import DiagnosisLogs, record
from rejoint.diagnosis.healthy import MEASURED, HealthyReference, healthy_reference, reference_by
from rejoint.diagnosis.verdict import Finding
from rejoint.logs.exclusions import recorded_gain
from rejoint.logs.runfolder import RunFolder
from rejoint.logs.runlog import RunLog
from rejoint.runs.history import summarise
from rejoint.runs.run import Run, exclusive, mark, staged
from rejoint.session.inputs import (
    FIRST_ROBOT,
    ArmLike,
    LogsLike,
    RobotLike,
    RunLike,
    Settings,
    address_of,
    arm_of,
    as_logs,
    is_robot,
    keep,
    opened,
    run_of_logs,
    settled,
    source_of,
    to_keep,
)
from rejoint.session.session import Session
from rejoint.system.files import read_json, saving, set_aside, write_json
from rejoint.system.records import Readable, entity
from rejoint.system.stopping import noted


@entity
class Diagnosed(Readable):
    """Result of a diagnosis, with its motion."""

    diagnosis: Diagnosis
    targets: RunLog | None = None
    """ten targets, each commanded once; None for logs"""
    excitation: RunLog | None = None
    """input of `identify`; None for logs"""

    @property
    def verdict(self) -> str:
        """What is wrong, in sentences."""
        return self.diagnosis.verdict

    @property
    def findings(self) -> tuple[Finding, ...]:
        """What is wrong by joint, the largest tool error ``tcp_mm`` first."""
        return self.diagnosis.findings


def diagnose(
    source: RobotLike | LogsLike = FIRST_ROBOT,
    *,
    arm: ArmLike | None = None,
    run: RunLike | None = None,
    healthy: RunLike | Diagnosis | None = None,
    quick: bool = False,
    settings: Settings | None = None,
    observer: Observer | None = None,
) -> Diagnosed:
    """Find out what is wrong with an arm: by moving it, or from logs of any motion.

    A robot moves to ten targets, open loop, and through an excitation of every joint (two minutes).

    Parameters
    ----------
    source
        robot or its address; or run logs, their file or folder
    arm
        arm, name or file, if the address does not tell
    run
        run, or its folder, for logs and diagnosis; default: nothing is written
    healthy
        run or diagnosis of a good arm; default: an emulated one
    quick
        mark the run: the next stages do little
    settings
        payload, tool, control period, seed; the run keeps them
    observer
        receives progress

    Returns
    -------
    Diagnosed
        ``verdict``, ``findings`` per joint, and logs

    Raises
    ------
    InputError
        for another arm's logs or run, or too little free motion
    AddressError
        if no robot answers
    GuardTripError, RobotError
        if the motion was ended; the notes name the log
    UnsavedError
        if writing failed; the error holds the result

    Examples
    --------
    >>> found = rejoint.diagnose("emulated:worn")
    >>> print(found.verdict)
    >>> rejoint.diagnose("logs", arm="so101").findings[0].sentence
    """
    if not is_robot(source):
        given = cast(LogsLike, source)
        kept, known = run_of_logs(run, given, arm)
        chosen = settled(settings, kept, None)[0]
        with pacing(observer) as update, exclusive(kept), staged(kept, "diagnose"):
            name, own = source_of(given) if kept is None else kept.robot, to_keep(chosen).laden(known)
            motions = as_logs(given)
            reference = _known_good(known, healthy) or _reference(own, recorded_gain(motions))
            told = diagnose_logs(own, motions, reference, source=name, on_progress=update)
            if kept is not None:
                write_json(kept.begin().folder.diagnosis, told)
                keep(kept, chosen)
                summarise(kept)
        return Diagnosed(diagnosis=told)
    robot, chosen = cast(RobotLike, source), settled(settings, None, None)[0]
    built = opened(run, arm).arm if isinstance(run, Run) else arm_of(robot, arm)
    about = None if run is None or chosen.dry_run else Run.plan(run, address_of(robot), built, chosen.seed)
    with (
        pacing(observer) as update,
        noted(),
        Session(robot, run=about, arm=built, settings=chosen, observer=observer) as session,
    ):
        reference = _known_good(built, healthy)
        with session.metered("diagnose") as driven:
            gains = gains_in_force(driven)
            (logs,) = record(driven, seed=session.seed, on_progress=update)
            if gains is not None:
                logs = DiagnosisLogs(
                    **{
                        name: replace(log, gain=np.full_like(log.position, gains["p"]))
                        for name, log in vars(logs).items()
                    }
                )
            if reference is None:
                volts = driven.read().voltage
                reference = healthy_reference(driven.arm, address_of(robot), gains, None if volts is None else volts[0])
            found = replace(judge(driven.arm, logs, reference), servo_gains=None if gains is None else dict(gains))
            result = Diagnosed(diagnosis=found, targets=logs.targets, excitation=logs.excitation)
            if session.run is not None:
                with saving(result):
                    session.run.begin()
                    if quick:
                        mark(session.run.folder.quick)
                    for name, log in (("targets", logs.targets), ("excitation", logs.excitation)):
                        log.save(set_aside(session.run.folder.log(name)))
                    write_json(set_aside(session.run.folder.diagnosis), found)
                    summarise(session.run)
                keep(session.run, session.settings)
        return result


def _reference(arm: Arm, p: Array | None) -> HealthyReference | None:
    """Healthy arm with the ``p`` (n,) that logs record, else with LeRobot's: nothing is soft that would not be then."""
    if p is not None and (p >= MEASURED[0] / 2).all() and (p <= MEASURED[-1]).all():
        return healthy_reference(arm, gains={"p": tuple(p.tolist())})
    found = healthy_reference(arm, gains={"p": (MEASURED[0],) * arm.joints})
    return found and replace(found, setting=found.setting.replace("P =", "an assumed P ="))


def _known_good(arm: Arm, healthy: RunLike | Diagnosis | None) -> HealthyReference | None:
    if healthy is None:
        return None
    if not isinstance(healthy, Diagnosis):
        folder = healthy.folder if isinstance(healthy, Run) else RunFolder(Path(healthy))
        healthy = read_json(folder.diagnosis, Diagnosis)
    return reference_by(arm, healthy)
