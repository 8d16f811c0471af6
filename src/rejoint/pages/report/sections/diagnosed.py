"""The section of the diagnosis: ten targets open loop, findings, every joint in numbers."""

from __future__ import annotations

import numpy as np

from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.diagnosis.open_loop import OpenLoop
from rejoint.diagnosis.verdict import Finding
from rejoint.pages.report.figures import Series, error_per_target
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.numerals import interval, number
from rejoint.pages.report.palette import BROWN, GREEN, GREY
from rejoint.pages.report.sections.joints import QUANTITIES, joint_pictures, joint_table, quantities
from rejoint.pages.report.tables import PAPER_ARM
from rejoint.pages.report.view import Cell, Part, Picture, Row, Section, Table
from rejoint.pages.report.words import listed
from rejoint.system.statistics import Estimate

KEY, SHORT, HEADING = "diagnosis", "Diagnosis", "What is wrong, joint by joint"

KINDS = {
    "weak_gain": "soft",
    "friction": "stiff to turn",
    "hysteresis": "stops short",
    "play_in_loop": "hunts",
    "torque_limit": "out of torque",
    "low_damping": "rings",
    "lag": "late",
    "offset": "offset",
    "noise": "restless readings",
}
"""Short name of every kind of finding"""


def diagnosis_section(diagnosis: Diagnosis, gallery: Gallery, *, twin: bool) -> Section:
    """Build the section; what a ``twin`` knows as well is left to the section of that."""
    healthy = None if diagnosis.healthy is None else diagnosis.healthy.joints
    joints = diagnosis.measurement.joints
    source = (
        "" if diagnosis.healthy is None else f" Blue: this arm. Green: mean and range of {diagnosis.healthy.source}."
    )
    shown = quantities(twin=twin)
    elsewhere = listed([quantity.name for quantity in QUANTITIES if quantity not in shown], "and")
    elsewhere = f" {elsewhere.capitalize()} are those of the digital twin, further down." if elsewhere else ""
    parts = (
        _seen(diagnosis, gallery),
        _findings(diagnosis),
        Part(
            heading="Every joint in numbers",
            texts=(f"{_how(diagnosis)}; with 95 % intervals.{source}{elsewhere}",),
            figures=joint_pictures(shown, joints, healthy, gallery), columns=3,
            tables=(joint_table(shown, joints, healthy),),
        ),
        Part(heading="What the encoders cannot tell", lines=diagnosis.unseen),
    )  # fmt: skip
    return Section(key=KEY, short=SHORT, heading=HEADING, parts=parts)


def healthy_error(diagnosis: Diagnosis) -> Series | None:
    """Return mean and range [mm] of what healthy arms miss their targets by, open loop."""
    if diagnosis.healthy is None:
        return None
    error = diagnosis.healthy.error_mm
    low, high = (None if end is None else np.array([max(end, 0.0)]) for end in (error.low, error.high))
    return Series(label="healthy arm, mean and range", look=GREEN, value=np.array([error.value]), low=low, high=high)


def _how(diagnosis: Diagnosis) -> str:
    if diagnosis.evidence is None:
        return "Measured with slow sweeps, steps, holds and a mixed motion"
    return "Measured on slow motion, steps and rest in logs of other motion"


def _seen(diagnosis: Diagnosis, gallery: Gallery) -> Part:
    """Show what the diagnosis rests on: ten targets, or logs."""
    if diagnosis.open_loop is not None:
        return Part(texts=(diagnosis.verdict,), figures=(_open_loop(diagnosis, diagnosis.open_loop, gallery),))
    evidence = diagnosis.evidence
    if evidence is None:
        return Part(texts=(diagnosis.verdict,))
    seconds = (
        ("in free space", evidence.free_seconds),
        ("with the tool on a table, and just after", evidence.contact_seconds),
        ("at a stop, and just after", evidence.stop_seconds), ("with dead readings", evidence.dead_seconds),
    )  # fmt: skip
    facts = [("recorded motions", f"{evidence.motions}, {evidence.seconds:.0f} s in all")]
    facts += [(what, f"{value:.0f} s") for what, value in seconds]
    if evidence.table_height_m is not None:
        side = "above" if evidence.table_height_m >= 0 else "below"
        height = number(abs(evidence.table_height_m) * 1e3, 3, "mm")
        facts.append(("tool on the table at", f"{height} {side} the origin of the base"))
    if evidence.rest_error_mm is not None:
        facts.append(("tool at rest, from where it was sent", _with_interval(evidence.rest_error_mm)))
    return Part(texts=(diagnosis.verdict,), facts=tuple(facts))


def _with_interval(estimate: Estimate) -> str:
    likely = interval(estimate.low, estimate.high, 3)
    return number(estimate.value, 3, "mm") + (f" ({likely})" if likely else "")


def _open_loop(diagnosis: Diagnosis, found: OpenLoop, gallery: Gallery) -> Picture:
    targets = found.targets
    series = [
        Series(label="this arm, by its encoders", look=GREY, value=np.array([target.error_mm for target in targets]))
    ]
    true = np.array([np.nan if t.true_error_mm is None else t.true_error_mm for t in targets])
    if np.isfinite(true).any():
        series.append(Series(label="this arm, true error of the tool", look=BROWN, value=true))
    values = ", ".join(f"target {i} {number(t.error_mm, 2)}" for i, t in enumerate(targets, start=1))
    published = " Compare Park et al. 2024, Figs. 8 and 9: 22.7 mm worn, 3.09 mm healthy."
    published = published if diagnosis.arm == PAPER_ARM else ""
    return gallery.show(
        "open-loop", error_per_target(series, healthy_error(diagnosis)),
        alt=f"Bars: encoder error in mm at each of {len(targets)} targets, open loop: {values}.",
        caption="Where the arm comes to rest when it is told once where to go." + published,
    )  # fmt: skip


def _findings(diagnosis: Diagnosis) -> Part:
    if not diagnosis.findings:
        return Part(heading="Findings", texts=("No joint shows wear that its encoder can see.",))
    rows = tuple(_finding(finding) for finding in diagnosis.findings if finding.felt)
    unfelt = [f"{finding.joint} ({_kind(finding)})" for finding in diagnosis.findings if not finding.felt]
    lines = (f"Worn, but the tip of the tool does not feel it: {listed(unfelt, 'and')}.",) if unfelt else ()
    if not rows:
        return Part(heading="Findings", lines=lines)
    headers = ("joint", "finding", "at the tool [mm]", "in words")
    table = Table(caption="Findings, the worst at the tool first", headers=headers, rows=rows, words=True)
    return Part(heading="Findings", lines=lines, tables=(table,))


def _kind(finding: Finding) -> str:
    return KINDS.get(finding.kind, finding.kind.replace("_", " "))


def _finding(finding: Finding) -> Row:
    return Row(
        cells=(
            Cell(finding.joint), Cell(_kind(finding), finding.severity), Cell(number(finding.tcp_mm, 2)),
            Cell(finding.sentence),
        )
    )  # fmt: skip


def error_range(diagnosis: Diagnosis) -> str:
    """Return the 95 % interval [mm] of `mean_error`; empty where it is not known."""
    error = mean_error(diagnosis)
    return "" if error is None else interval(error.low, error.high, 3)


def mean_error(diagnosis: Diagnosis) -> Estimate | None:
    """Return the mean error [mm] as the arm was found: at ten targets, or at rest in logs of other motion."""
    if diagnosis.open_loop is not None:
        return diagnosis.open_loop.error_mm
    return None if diagnosis.evidence is None else diagnosis.evidence.rest_error_mm
