"""The section that says which fit to trust: predictions of motion that no fit has seen."""

from __future__ import annotations

from itertools import cycle

import numpy as np

from rejoint.arms import Array
from rejoint.pages.report import palette, prediction
from rejoint.pages.report.figures import Series
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.numerals import number
from rejoint.pages.report.palette import Look
from rejoint.pages.report.trust import MM, Score, answer, scores
from rejoint.pages.report.view import Cell, Part, Picture, Row, Section, Table
from rejoint.twin.judgement import NO_TWIN, Error, Judgement

KEY, SHORT, HEADING = "trust", "Which fit to trust", "Which fit to trust"

WHERE = {"free": "in free space", "contact": "on the table"}


def trust_section(judgement: Judgement, gallery: Gallery) -> Section:
    """Build the section from a judgement of several predictions."""
    looks, found = _looks(judgement), scores(judgement)
    where = [kind for kind in WHERE if any(np.isfinite(getattr(one, f"{kind}_mm")).any() for one in found)]
    parts = (
        Part(lines=answer(judgement), figures=tuple(_means(kind, found, looks, gallery) for kind in where), columns=2),
        Part(
            heading="Motion by motion",
            figures=tuple(_motions(kind, judgement, found, looks, gallery) for kind in where),
            tables=(_table(judgement),),
        ),
        _over_time(judgement, looks, gallery),
    )
    return Section(key=KEY, short=SHORT, heading=HEADING, parts=parts)


def _looks(judgement: Judgement) -> dict[str, Look]:
    """Give every prediction a look: grey without a twin, blue for the first twin, green for the second."""
    order = cycle((palette.BLUE, palette.GREEN, palette.ORANGE, palette.PURPLE, palette.BROWN, palette.RED))
    return {name: palette.GREY if name == NO_TWIN else next(order) for name in judgement.mean}


def _means(kind: str, found: tuple[Score, ...], looks: dict[str, Look], gallery: Gallery) -> Picture:
    series, words = [], []
    for score in found:
        mean = score.mean(kind)
        if mean is None:
            continue
        low, high = (None if end is None else np.array([end]) for end in (mean.low, mean.high))
        value = np.array([mean.value])
        series.append(Series(label=score.name, look=looks[score.name], value=value, low=low, high=high))
        words.append(f"{score.name} {number(mean.value, 3)}")
    return gallery.show(
        f"prediction-{kind}", prediction.means(series, f"error of the tool {WHERE[kind]} [mm]"),
        alt=f"Bars: mean prediction error of the tool {WHERE[kind]} in mm: {', '.join(words)}.",
        caption=f"Open loop from the first measured posture, {WHERE[kind]}: mean over the motions, each counting the "
        "same, with its 95 % interval over motions.",
    )  # fmt: skip


def _motions(
    kind: str, judgement: Judgement, found: tuple[Score, ...], looks: dict[str, Look], gallery: Gallery
) -> Picture:
    first = getattr(found[1], f"{kind}_mm")
    order = np.argsort(np.where(np.isfinite(first), first, np.inf))
    order = order[np.isfinite(first[order])]
    names = [judgement.motions[i].motion for i in order]
    series = [Series(label=one.name, look=looks[one.name], value=getattr(one, f"{kind}_mm")[order]) for one in found]
    own = judgement.repeatability
    itself = None
    if own is not None and kind == "free":
        low, mean, high = (np.array([max(end * MM, prediction.FLOOR_MM)]) for end in (own.lowest, own.tcp, own.highest))
        itself = Series(label="the arm's own repeatability", look=palette.GREY, value=mean, low=low, high=high)
    return gallery.show(
        f"motions-{kind}", prediction.per_motion(names, series, itself, f"error of the tool {WHERE[kind]} [mm]"),
        heading=f"{WHERE[kind][:1].upper()}{WHERE[kind][1:]}",
        alt=f"Marks: prediction error of the tool {WHERE[kind]} in each of {len(names)} motions; numbers in the table "
        "below.",
    )  # fmt: skip


def _table(judgement: Judgement) -> Table:
    names = list(judgement.mean)
    rows = [
        Row(
            cells=(
                Cell(motion.motion, _seconds(motion.seconds, motion.contact_seconds, motion.left_out_seconds)),
                *(_cell(motion.errors[name].free, motion.errors[name].contact) for name in names),
            )
        )
        for motion in judgement.motions
    ]
    cells = (Cell("mean over the motions"), *(_cell(judgement.mean[n].free, judgement.mean[n].contact) for n in names))
    rows.append(Row(cells=cells, emphasis=True))
    return Table(
        caption="Prediction error of the tool in free space [mm]", headers=("motion", *names), rows=tuple(rows),
        notes=(
            "Small print: joints in free space, root mean square in degrees; the tool on the table in mm. At stops and "
            "with dead readings nothing is judged.",
        ),
    )  # fmt: skip


def _seconds(whole: float, contact: float, left_out: float) -> str:
    parts = [f"{whole:.0f} s"]
    if contact >= 0.5:
        parts.append(f"{contact:.0f} s on the table")
    if left_out >= 0.5:
        parts.append(f"{left_out:.0f} s left out")
    return ", ".join(parts)


def _cell(free: Error | None, contact: Error | None) -> Cell:
    notes = []
    if free is not None:
        notes.append(f"{number(float(np.degrees(free.joint)), 2)} deg")
    if contact is not None:
        notes.append(f"table {number(contact.tcp * MM, 3)}")
    return Cell("none" if free is None else number(free.tcp * MM, 3), "\n".join(notes))


def _over_time(judgement: Judgement, looks: dict[str, Look], gallery: Gallery) -> Part:
    trace, first = judgement.worst, list(judgement.mean)[1]
    time, shaded = np.array(trace.time), np.array(trace.contact, dtype=bool)
    series = [Series(label=name, look=looks[name], value=np.array(gap) * MM) for name, gap in trace.tcp.items()]
    residual: Array = np.degrees(np.array(trace.joints))
    joints = list(judgement.joint_names)
    worst = ", ".join(
        f"{name} {number(float(np.abs(row).max()), 2)}" for name, row in zip(joints, residual, strict=True)
    )
    figures = (
        gallery.show(
            "worst-tool", prediction.tool_over_time(time, series, shaded),
            alt=f"Lines: prediction error of the tool in mm over {time[-1]:.0f} s, per prediction.",
            caption=f"The motion that “{first}” predicts worst in free space: {trace.motion}.",
        ),
        gallery.show(
            "worst-joints", prediction.joints_over_time(time, joints, residual, looks[first], shaded),
            alt=f"Lines: predicted minus measured position of every joint in degrees over {trace.motion}; largest: "
            f"{worst}.",
            caption=f"What “{first}” predicts less what the encoders read, joint by joint, in the same motion.",
        ),
    )  # fmt: skip
    return Part(heading=f"Over time: {trace.motion}", figures=figures)
