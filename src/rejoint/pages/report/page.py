"""The report: one self-contained HTML page, and figures as PNG files; and a replay's page."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.workspace import reach
from rejoint.control.classical import DefaultController
from rejoint.control.comparison.holding import errors_of
from rejoint.control.comparison.protocols import MODELLED, STANDS_FOR
from rejoint.control.comparison.recommend import NO_INTERVAL, difference, failure, recommend
from rejoint.control.comparison.result import Comparison, TargetErrors
from rejoint.control.servogains import own_policy
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import DISTURBED, astray, disturbed
from rejoint.diagnosis.calibration.preload import RISE, WEDGE, preload
from rejoint.diagnosis.calibration.procedure import reversals
from rejoint.diagnosis.diagnosis import Diagnosis, ringing_most
from rejoint.logs.runfolder.effort import cost
from rejoint.logs.runfolder.folder import LOGS, RunFolder
from rejoint.pages.html import colour_number, render, write_page
from rejoint.pages.report.contents import Contents, before_after, commands, found, read_contents, read_curves
from rejoint.pages.report.figures import Gallery
from rejoint.pages.report.pictures import Pictures, in_base
from rejoint.pages.report.tables import QUANTITIES, answer, behind, columns, directions
from rejoint.pages.words import (
    CONTROLLERS,
    KINDS,
    PARAMETERS_SHOWN,
    UNKNOWN,
    day_and_time,
    interval,
    number,
    parameter_name,
    plural,
)
from rejoint.system.files import write_json, write_whole
from rejoint.system.shell import __version__
from rejoint.system.statistics import Estimate, Spread, above_zero, spread
from rejoint.twin.judgement import Judgement
from rejoint.twin.parameters import ARM_PARAMETERS, PARAMETERS, Parameter, TwinParameters
from rejoint.twin.twin import Twin

STAGES = ("diagnose", "calibrate", "identify", "train", "compare")
"""In order"""

CAVEAT = "A motion that a twin was fitted to flatters it; which those are, neither the twin nor the logs tell."


def write_report(folder: Path) -> Path:
    """Write ``report.html`` and ``figures/*.png`` into a run folder; returns the page.

    FileError if a file is damaged or nothing has been run.
    """
    contents, gallery = read_contents(folder), Gallery()
    html = report_html(contents, gallery)
    gallery.save(contents.folder.figures)
    write_whole(contents.folder.report, lambda temporary: temporary.write_text(html, encoding="utf-8"))
    return contents.folder.report


def write_replay(folder: Path, judgement: Judgement, *, twin: str, logs: str) -> Path:
    """Write ``replay.html``, ``replay.json`` and ``figures/*.png``; returns the page."""
    gallery = Gallery()
    write_json(folder / "replay.json", judgement)
    path = write_page(
        folder / "replay.html",
        "replay.html",
        title=f"Replay: {judgement.arm}",
        parts=(),
        subtitle=f"{twin} on {plural(len(judgement.motions), 'motion')} of {logs}",
        verdict=(*answer(judgement)[:2], CAVEAT),
        judgement=judgement,
        answer=answer,
        draw=Pictures(gallery),
        footer=f"Made by rejoint {__version__}.",
    )
    gallery.save(folder / "figures")
    return path


def draw_training(folder: RunFolder) -> Path:
    """Draw the training curves of a run as PNG; returns its path."""
    gallery = Gallery()
    Pictures(gallery).training(read_curves(folder.outputs.curves))
    return gallery.save(folder.figures)[0]


def report_html(contents: Contents, gallery: Gallery) -> str:
    """Fill page and gallery."""
    it, lines = contents, commands(contents)
    advice = None if it.comparison is None else recommend(it.comparison)
    sections = [
        (key, short, heading, "" if there else f"{missing}. To do it: {lines[stage].line}")
        for key, short, heading, there, missing, stage in _sections(it)
        if there or missing
    ]
    sections.sort(key=lambda section: bool(section[3]))  # stable: what is there comes first
    to_do = [missing for *_, missing in sections if missing]
    to_do.sort(key=lambda text: next(turn for turn, stage in enumerate(STAGES) if f"rejoint {stage}" in text))
    robot = UNKNOWN if it.info is None else it.info.robot
    source = f"From logs in {robot.removeprefix(LOGS)}" if robot.startswith(LOGS) else f"Robot {robot}"
    return render(
        "report.html", title=f"Repair report: {it.arm.name}", parts=[section[:2] for section in sections],
        subtitle=source + ("" if it.info is None else f", {day_and_time(it.info.created)}"),
        footer=f"Made by rejoint {__version__} from {it.folder.path}.", version=__version__,
        quick=it.folder.quick.exists(), it=it, advice=advice,
        errors=None if advice is None else before_after(it, advice.controller), to_do=to_do,
        sections=sections, commands=lines, draw=Pictures(gallery), judgement=it.judgement, answer=answer,
        mean_error=mean_error, own_policy=own_policy, difference=difference, failure=failure, above_zero=above_zero,
        no_interval=NO_INTERVAL, ringing_most=ringing_most, cost=cost,
        # the comparison
        columns=columns, controllers=CONTROLLERS, colour_number=colour_number, stands_for=STANDS_FOR,
        directions=directions, errors_as_found=errors_as_found, target_errors=target_errors,
        failures=lambda comparison: list(filter(None, map(failure, comparison.rows))),
        # the calibration
        astray=astray, disturbed=disturbed, disturbed_words=DISTURBED, reversals=reversals, tilt=_tilt, in_base=in_base,
        behind=behind, preload=preload, wedge_degrees=np.degrees(WEDGE), rise=RISE,
        # diagnosis and twin
        quantities=QUANTITIES, healthy_range=lambda quantity, found: quantity.healthy(found),
        kind=lambda finding: KINDS.get(finding.kind, finding.kind.replace("_", " ")),
        parameters=PARAMETERS, common=[parameter_name(one.name) for one in ARM_PARAMETERS], entry=_entry,
        shown_units=PARAMETERS_SHOWN, parameter_name=parameter_name, unidentified=_unidentified,
    )  # fmt: skip


def _sections(it: Contents) -> tuple[tuple[str, str, str, bool, str, str], ...]:
    return (
        ("comparison", "Comparison", "Every controller on this arm", it.comparison is not None,
         "The controllers have not been compared yet", "compare"),
        ("tool", "Where the tool is", "Where the tool is", it.calibration is not None,
         "The place of the tool has not been measured", "calibrate"),
        ("diagnosis", "Diagnosis", "What is wrong, joint by joint", it.diagnosis is not None,
         "The arm has not been diagnosed yet", "diagnose"),
        # only a twin from logs is judged beside others
        ("trust", "Which fit to trust", "Which fit to trust", it.judgement is not None, "", ""),
        ("twin", "Digital twin", "The digital twin", it.twin is not None,
         "No twin has been identified yet", "identify"),
        ("training", "Training", "Training of the policy", (it.curves or it.contract) is not None,
         "No policy has been trained yet", "train"),
        ("details", "Details", "Details", True, "", ""),
    )  # fmt: skip


def mean_error(diagnosis: Diagnosis) -> Estimate | None:
    """Mean error [mm] of the uncorrected arm: at ten targets, or at rest in logs."""
    if diagnosis.open_loop is not None:
        return diagnosis.open_loop.error_mm
    return None if diagnosis.evidence is None else diagnosis.evidence.rest_error_mm


def target_errors(comparison: Comparison, controller: str) -> TargetErrors:
    """Errors of a controller at the first set's targets, means over repetitions."""
    return errors_of({name: comparison.array(name, controller)[0] for name in ("settled", "settled_true", *MODELLED)})


def errors_as_found(comparison: Comparison) -> TargetErrors | None:
    """Errors of the uncorrected arm, or None."""
    own = DefaultController.name
    if comparison.calibration or own not in comparison.controllers:
        return comparison.as_found
    return target_errors(comparison, own)


def _tilt(found: Calibration) -> float:
    """[deg] tilt of the base."""
    return float(np.degrees(np.arccos(np.clip(found.displacement.gravity @ GRAVITY / (GRAVITY @ GRAVITY), -1.0, 1.0))))


def _entry(parameters: TwinParameters, parameter: Parameter, joint: int) -> float:
    return float(np.atleast_1d(getattr(parameters, parameter.name))[joint])


def _unidentified(twin: Twin, parameter: Parameter) -> list[str]:
    return [name.split(".")[-1] for name in twin.unknown if name.split(".")[0] == parameter.name]


def write_datasheet(folder: Path, out: Path) -> Path:
    """Write the data sheet of a run's arm; FileError."""
    it = read_contents(folder)
    best = None if it.comparison is None else it.comparison.row(recommend(it.comparison).controller)
    back: tuple[float, ...] = ()
    left_out: tuple[Spread | None, ...] = ()
    if it.calibration is not None and it.measurements is not None:
        back = reversals(it.arm, it.measurements, it.calibration.frame)
        if len(it.measurements) == len(it.calibration.left_out):  # each left out; intervals resample postures
            posture = it.measurements.posture.astype(np.intp)
            left_out = tuple(spread(column, posture) for column in it.calibration.left_out.T)
    return write_page(
        out,
        "datasheet.html",
        it=it,
        best=best,
        found=found(it),
        found_of=_found_of(it),
        left_out=left_out,
        period=_period(it),
        reach=reach(it.arm),
        version=__version__,
        reversal=spread(np.array(back), np.arange(len(back))) if back else None,
    )


def _period(contents: Contents) -> str:
    periods = np.concatenate([np.diff(log.time) for log in contents.hold.values()] or [np.zeros(0)])
    if not len(periods):
        return UNKNOWN
    low, middle, high = 1e3 * np.quantile(periods, [0.025, 0.5, 0.975])
    return f"{number(middle, 3, 'ms')} (95 % of {len(periods)}: {interval(low, high, 3)})"


def _found_of(contents: Contents) -> tuple[str, str]:
    made, value = contents.comparison, found(contents).encoders
    open_loop = None if contents.diagnosis is None else contents.diagnosis.open_loop
    if open_loop is not None and value == 1e-3 * open_loop.error_mm.value:
        return interval(open_loop.error_mm.low, open_loop.error_mm.high, 3), str(len(open_loop.targets))
    own: Spread | None = None if made is None or "default" not in made.controllers else made.row("default").settled
    return ("", "") if own is None else (interval(own.mean.low, own.mean.high, 3, factor=1e3), str(own.count))
