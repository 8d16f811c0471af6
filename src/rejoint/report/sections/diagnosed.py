"""The section of the diagnosis: ten targets open loop, findings, every joint in numbers."""

from __future__ import annotations

import numpy as np

from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.diagnosis.verdict import Finding
from rejoint.report.figures import Series, error_per_target
from rejoint.report.gallery import Gallery
from rejoint.report.numerals import interval, number
from rejoint.report.palette import BROWN, GREEN, GREY
from rejoint.report.sections.joints import joint_pictures, joint_table
from rejoint.report.view import Cell, Part, Picture, Row, Section, Table

KEY, SHORT, HEADING = "diagnosis", "Diagnosis", "What is wrong, joint by joint"

KINDS = {
    "weak_gain": "soft",
    "friction": "stiff to turn",
    "play_in_loop": "hunts",
    "torque_limit": "out of torque",
    "low_damping": "rings",
    "lag": "late",
    "noise": "restless readings",
}
"""Short name of every kind of finding"""


def diagnosis_section(diagnosis: Diagnosis, gallery: Gallery) -> Section:
    """Build the section."""
    healthy = None if diagnosis.healthy is None else diagnosis.healthy.joints
    joints = diagnosis.measurement.joints
    source = (
        "" if diagnosis.healthy is None else f" Blue: this arm. Green: mean and range of {diagnosis.healthy.source}."
    )
    parts = (
        Part(texts=(diagnosis.verdict,), figures=(_open_loop(diagnosis, gallery),)),
        _findings(diagnosis),
        Part(
            heading="Every joint in numbers",
            texts=(f"Measured with slow sweeps, steps, holds and a mixed motion; with 95 % intervals.{source}",),
            figures=joint_pictures(joints, healthy, gallery), columns=3, tables=(joint_table(joints, healthy),),
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


def _open_loop(diagnosis: Diagnosis, gallery: Gallery) -> Picture:
    targets = diagnosis.open_loop.targets
    series = [
        Series(label="this arm, by its encoders", look=GREY, value=np.array([target.error_mm for target in targets]))
    ]
    true = np.array([np.nan if t.true_error_mm is None else t.true_error_mm for t in targets])
    if np.isfinite(true).any():
        series.append(Series(label="this arm, true error of the tool", look=BROWN, value=true))
    values = ", ".join(f"target {i} {number(t.error_mm, 2)}" for i, t in enumerate(targets, start=1))
    return gallery.show(
        "open-loop", error_per_target(series, healthy_error(diagnosis)),
        alt=f"Bars: encoder error in mm at each of {len(targets)} targets, open loop: {values}.",
        caption="Where the arm comes to rest when it is told once where to go. Compare Park et al. 2024, Figs. 8 and "
        "9: 22.7 mm worn, 3.09 mm healthy.",
    )  # fmt: skip


def _findings(diagnosis: Diagnosis) -> Part:
    if not diagnosis.findings:
        return Part(heading="Findings", texts=("No joint shows wear that its encoder can see.",))
    rows = tuple(_finding(finding) for finding in diagnosis.findings)
    headers = ("joint", "finding", "at the tool [mm]", "in words")
    table = Table(caption="Findings, the worst at the tool first", headers=headers, rows=rows, words=True)
    return Part(heading="Findings", tables=(table,))


def _finding(finding: Finding) -> Row:
    kind = KINDS.get(finding.kind, finding.kind.replace("_", " "))
    return Row(
        cells=(
            Cell(finding.joint), Cell(kind, finding.severity), Cell(number(finding.tcp_mm, 2)),
            Cell(finding.sentence),
        )
    )  # fmt: skip


def error_range(diagnosis: Diagnosis) -> str:
    """Return the 95 % interval [mm] of the mean error open loop; empty where it is not known."""
    error = diagnosis.open_loop.error_mm
    return interval(error.low, error.high, 3)
