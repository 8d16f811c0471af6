"""The section about the digital twin: how well it predicts, its parameters, and what stays unknown."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Array
from rejoint.pages.report import palette
from rejoint.pages.report.figures import Series, by_joint, ranked_bars
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.numerals import interval, number
from rejoint.pages.report.prediction import correlations
from rejoint.pages.report.view import Cell, Part, Picture, Row, Section, Table
from rejoint.pages.report.words import listed, plural, sentence
from rejoint.system.statistics import NORMAL95
from rejoint.twin.parameters import (
    ARM_PARAMETERS,
    JOINT_PARAMETERS,
    PARAMETERS,
    Parameter,
    Prior,
    TwinParameters,
    unpack,
)
from rejoint.twin.twin import Twin

KEY, SHORT, HEADING = "twin", "Digital twin", "The digital twin"

SHOWN: dict[str, tuple[str, float]] = {
    "offset": ("deg", float(np.degrees(1))),
    "delay": ("ms", 1e3),
    "ramp_speed": ("deg/s", float(np.degrees(1))),
}
"""Parameters shown in another unit than their own, and the factor to it"""

LEAST_RELATED = 3
"""Identified parameters below which their correlations need no figure (chosen)"""

NAMES = {
    "stiffness": "stiffness",
    "damping": "damping",
    "coulomb": "dry friction",
    "armature": "armature",
    "torque_limit": "torque limit",
    "offset": "offset",
    "delay": "delay",
    "ramp_speed": "ramp speed",
}


def twin_section(twin: Twin, belief: Prior, gallery: Gallery, *, kept: str = "") -> Section:
    """Build the section from a twin, what was believed of its arm before, and why it was ``kept``, if it was."""
    known = (_prediction(twin, gallery, kept), _parameters(twin, belief, gallery))
    return Section(key=KEY, short=SHORT, heading=HEADING, parts=(*known, *_together(twin, gallery), _doubts(twin)))


def _prediction(twin: Twin, gallery: Gallery, kept: str) -> Part:
    held = twin.held_out
    errors = np.array([held.no_twin.tcp, held.healthy_twin.tcp, held.twin.tcp]) * 1e3
    labels = ("no twin (measured = command)", "twin of a healthy arm", "twin of this arm")
    figure = ranked_bars(
        labels, errors, (palette.GREY, palette.GREEN, palette.BLUE), "TCP prediction error, root mean square [mm]"
    )
    words = "; ".join(f"{label}: {number(e, 3, 'mm')}" for label, e in zip(labels, errors, strict=True))
    picture = gallery.show(
        "held-out", figure, alt=f"Bars: TCP prediction error on motion that the fit has not seen. {words}.",
        caption="The error of predicting the arm's motion from the commands alone; shorter is better.",
    )  # fmt: skip
    joint = number(np.degrees(held.twin.joint), 2, "deg")
    text = (
        f"A copy of the arm in a physics simulator was fitted to {number(twin.fit_seconds, 2, 's')} of its recorded "
        f"motion and judged on {number(held.seconds, 2, 's')} that the fit had not seen. There its joints are within "
        f"{joint} (root mean square) of the measured ones."
    )
    notes = tuple(sentence(note) for note in (kept, *twin.notes) if note)
    return Part(texts=(text,), lines=notes, figures=(picture,), columns=2)


def _parameters(twin: Twin, belief: Prior, gallery: Gallery) -> Part:
    joints = list(twin.joint_names)
    pictures = tuple(_picture(p, twin, belief, gallery) for p in JOINT_PARAMETERS)
    text = (
        "Filled: identified, with its 95 % interval. Hollow: the motion says no more than was believed before. "
        "Pale: 95 % of what was believed before any motion was seen."
    )
    return Part(
        heading="Identified parameters", texts=(text,), figures=pictures, columns=3, tables=(_table(twin, joints),)
    )


def _picture(p: Parameter, twin: Twin, belief: Prior, gallery: Gallery) -> Picture:
    unit, factor = _unit(p)
    low, high = twin.interval
    known = _known(twin, p)
    joints = list(twin.joint_names)
    n = len(joints)

    def of(parameters: TwinParameters) -> Array:
        return np.asarray(getattr(parameters, p.name) * factor)

    measured = Series(
        label="this arm", look=palette.BLUE, value=of(twin.parameters), low=of(low), high=of(high), hollow=~known
    )
    before = Series(
        label="before any data", look=palette.GREY, value=np.full(n, np.nan),
        low=of(unpack(np.maximum(belief.mean - NORMAL95 * belief.sigma, belief.lower), n)),
        high=of(unpack(np.minimum(belief.mean + NORMAL95 * belief.sigma, belief.upper), n)),
    )  # fmt: skip
    values = ", ".join(f"{joint} {number(v, 2)}" for joint, v in zip(joints, measured.value, strict=True))
    return gallery.show(
        f"twin-{p.name.replace('_', '-')}",
        by_joint(f"{NAMES[p.name]} [{unit}]", joints, measured, before, log=p.log),
        alt=f"Identified {NAMES[p.name]} in {unit} per joint: {values}. Intervals are in the table below.",
    )


def _unit(p: Parameter) -> tuple[str, float]:
    """Return the unit in which a parameter is shown, and the factor to it."""
    return SHOWN.get(p.name, (p.unit.replace("^2", "²"), 1.0))


def _known(twin: Twin, p: Parameter) -> np.typing.NDArray[np.bool_]:
    return np.array([twin.identified[i] for i, name in enumerate(twin.names) if name.split(".")[0] == p.name])


def _table(twin: Twin, joints: list[str]) -> Table:
    low, high = twin.interval
    rows = []
    for p in PARAMETERS:
        unit, factor = _unit(p)
        values, lows, highs = (
            np.atleast_1d(getattr(x, p.name)) * factor for x in (twin.parameters, low, high)
        )  # fmt: skip
        cells = [
            Cell(number(v, 3), interval(a, b, 3) if known else "not identified")
            for v, a, b, known in zip(values, lows, highs, _known(twin, p), strict=True)
        ]
        if not p.per_joint:
            cells += [Cell("")] * (len(joints) - 1)
        rows.append(Row(cells=(Cell(f"{NAMES[p.name]} [{unit}]", p.meaning), *cells)))
    notes = (
        "Small print: 95 % intervals. A value that is not identified keeps the range believed before, and training "
        "draws it from that range.",
        sentence(f"{listed([NAMES[p.name] for p in ARM_PARAMETERS], 'and')} are common to all joints"),
    )
    return Table(caption="Parameters of the twin", headers=("parameter", *joints), rows=tuple(rows), notes=notes)


def _together(twin: Twin, gallery: Gallery) -> tuple[Part, ...]:
    """Show the correlations of what was identified, joint by joint."""
    rank = {name: place for place, name in enumerate(twin.joint_names)}
    parts = [(i, *name.partition(".")[::2]) for i, name in enumerate(twin.names) if twin.identified[i]]
    if len(parts) < LEAST_RELATED:
        return ()
    parts.sort(key=lambda part: rank.get(part[2], len(rank)))  # stable: the kinds keep their order
    chosen = [i for i, _, _ in parts]
    sigma = np.sqrt(np.diag(twin.covariance))[chosen]
    matrix = twin.covariance[np.ix_(chosen, chosen)] / np.outer(sigma, sigma)
    strong = ", ".join(f"{_name(a)} and {_name(b)} {value:+.2f}" for a, b, value in twin.correlations[:5])
    kinds, joints = [NAMES[kind] for _, kind, _ in parts], [j or "arm" for *_, j in parts]
    picture = gallery.show(
        "twin-correlations", correlations(kinds, joints, matrix),
        alt=f"Correlations of the {len(parts)} identified parameters; strongest: {strong or 'none above 0.9'}.",
        caption="The larger a square, the less the motion tells two parameters apart: filled where both grow together, "
        "hollow where one makes up for the other. Training draws its twins with these correlations.",
    )  # fmt: skip
    return (Part(heading="What hangs together", figures=(picture,)),)


def _doubts(twin: Twin) -> Part:
    lines = list(_unknown(twin))
    if twin.unknown_scale:
        where = listed(twin.unknown_scale, "and")
        lines.append(f"Torques and inertia of {where} are known up to a common factor only: gravity loads them little.")
    for one, other, value in twin.correlations:
        lines.append(sentence(f"{_name(one)} and {_name(other)} cannot be told apart (correlation {value:+.2f})"))
    lines.append("Play and flex behind the encoders are invisible in these motions; the twin does not have them.")
    return Part(heading="What could not be identified", lines=tuple(lines))


def _unknown(twin: Twin) -> list[str]:
    lines = []
    for p in PARAMETERS:
        missing = [name.split(".")[-1] for name in twin.unknown if name.split(".")[0] == p.name]
        if not p.per_joint and missing:
            lines.append(sentence(f"{NAMES[p.name]} of the arm"))
        elif missing:
            whole = len(missing) == len(twin.joint_names)
            where = "any joint" if whole else listed(missing, "and")
            lines.append(sentence(f"{NAMES[p.name]} of {where}"))
    if not lines:
        lines.append(f"Every one of the {plural(len(twin.names), 'parameter')} was narrowed by the data.")
    return lines


def _name(element: str) -> str:
    name, _, joint = element.partition(".")
    return f"{NAMES[name]} of {joint}" if joint else NAMES[name]
