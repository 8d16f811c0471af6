"""The report: one self-contained HTML page, and figures as PNG files; and a replay's page."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.workspace import reach
from rejoint.control.comparison import protocols
from rejoint.control.comparison import recommend as advising
from rejoint.control.comparison.result import MODELLED, Comparison, TargetErrors
from rejoint.control.servogains import own_policy
from rejoint.diagnosis.calibration import calibration, fit
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.procedure import reversals
from rejoint.diagnosis.diagnosis import ringing_most
from rejoint.logs.runfolder import LOGS, cost
from rejoint.pages.html import colour_number, render, write_page
from rejoint.pages.report import tables
from rejoint.pages.report.contents import Contents, before_after, commands, found, next_steps, read_contents
from rejoint.pages.report.figures import Gallery, in_base
from rejoint.pages.words import plural
from rejoint.system.files import write_json, write_text
from rejoint.system.shell import __version__
from rejoint.system.statistics import above_zero, spread
from rejoint.twin import parameters
from rejoint.twin.parameters import Parameter
from rejoint.twin.twin import Judgement, Twin

CAVEAT = "A motion that a twin was fitted to flatters it; which those are, neither the twin nor the logs tell."


def write_report(folder: Path) -> Path:
    """Write ``report.html`` and ``figures/*.png`` into a run folder; FileError if damaged or empty."""
    contents, gallery = read_contents(folder), Gallery()
    html = report_html(contents, gallery)
    gallery.save(contents.folder.figures)
    write_text(contents.folder.report, html)
    return contents.folder.report


def write_replay(folder: Path, judgement: Judgement, *, twin: str, logs: str) -> Path:
    """Write ``replay.html`` and ``replay.json``; returns the page."""
    write_json(folder / "replay.json", judgement)
    return write_page(
        folder / "replay.html",
        "replay.html",
        title=f"Replay: {judgement.arm}",
        parts=(),
        subtitle=f"{twin} on {plural(len(judgement.motions), 'motion')} of {logs}",
        verdict=(*tables.answer(judgement)[:2], CAVEAT),
        it={"judgement": judgement},
        tables=tables,
        footer=f"Made by rejoint {__version__}.",
    )


def report_html(contents: Contents, gallery: Gallery) -> str:
    """Fill page and gallery."""
    return render("report.html", it=contents, draw=gallery, logs=LOGS, version=__version__, **_NAMES)


def target_errors(comparison: Comparison, controller: str) -> TargetErrors:
    """Errors of a controller at the first set's targets, means over repetitions."""
    names = ("settled", "settled_true", *MODELLED)
    return TargetErrors.of({name: comparison.array(name, controller)[0] for name in names})


def tilt(found: Calibration) -> float:
    """[deg] tilt of the base."""
    return float(np.degrees(np.arccos(np.clip(found.displacement.gravity @ GRAVITY / (GRAVITY @ GRAVITY), -1.0, 1.0))))


def unidentified(twin: Twin, parameter: Parameter) -> list[str]:
    """Joints, or the arm, whose ``parameter`` the data leave open."""
    return [name.split(".")[-1] for name in twin.unknown if name.split(".")[0] == parameter.name]


_FUNCTIONS = (
    *(before_after, commands, found, next_steps, target_errors, tilt, unidentified),
    *(above_zero, colour_number, cost, in_base, own_policy, reach, reversals, ringing_most),
)
_MODULES = (advising, calibration, fit, parameters, protocols, tables)
_NAMES = {one.__name__.rpartition(".")[2]: one for one in (*_FUNCTIONS, *_MODULES)}
"""What the templates of report and data sheet call"""


def write_datasheet(folder: Path, out: Path) -> Path:
    """Write the data sheet of a run's arm; FileError."""
    it = read_contents(folder)
    measured, back = it.measurements, np.zeros(0)
    if it.calibration is not None and measured is not None:
        back = np.array(reversals(it.arm, measured, it.calibration.frame))
    return write_page(
        out,
        "datasheet.html",
        it=it,
        version=__version__,
        reversal=spread(back, np.arange(len(back))) if len(back) else None,
        **_NAMES,
    )
