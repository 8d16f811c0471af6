"""Pictures and a table of what was measured per joint, against healthy arms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Array
from rejoint.diagnosis.measurement import JointMetrics
from rejoint.pages.report import palette
from rejoint.pages.report.figures import Series, by_joint
from rejoint.pages.report.gallery import Gallery
from rejoint.pages.report.numerals import UNKNOWN, interval, number
from rejoint.pages.report.view import Cell, Picture, Row, Table
from rejoint.pages.report.words import sentence
from rejoint.system.statistics import Estimate

DEG = float(np.degrees(1.0))


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """One measured quantity of a joint as it is shown."""

    field: str
    """of `JointMetrics`"""
    name: str
    unit: str
    factor: float
    """from SI to ``unit``"""
    meaning: str
    """in words that an owner understands"""
    log: bool = False
    signed: bool = False
    """whether it may be below zero"""
    parameter: str = ""
    """of a twin, where that is the same property: shown there alone"""


QUANTITIES = (
    Quantity(field="stiffness_nm_per_rad", name="stiffness", unit="N m/rad", factor=1.0, log=True,
             parameter="stiffness",
             meaning="how strongly the servo holds its position; soft joints sag"),
    Quantity(field="hysteresis_rad", name="hysteresis", unit="deg", factor=DEG,
             meaning="how far apart the joint stops when it comes from below and from above"),
    Quantity(field="coulomb_nm", name="dry friction", unit="N m", factor=1.0, parameter="coulomb",
             meaning="torque that is lost before anything moves"),
    Quantity(field="lag_s", name="lag", unit="ms", factor=1e3,
             meaning="how far the joint trails behind its command in motion"),
    Quantity(field="damping_ratio", name="damping ratio", unit="1", factor=1.0,
             meaning="1 comes to rest at once, 0.3 rings"),
    Quantity(field="overshoot", name="overshoot", unit="%", factor=1e2,
             meaning="how far it shoots beyond after a step"),
    Quantity(field="offset_rad", name="offset", unit="deg", factor=DEG, parameter="offset",
             meaning="how far the joint rests from its command where nothing loads it", signed=True),
    Quantity(field="hunting_rad", name="unrest", unit="deg", factor=DEG,
             meaning="motion while nothing is asked of the joint"),
    Quantity(field="noise_rad", name="noise", unit="deg", factor=DEG,
             meaning="scatter of single readings at rest"),
)  # fmt: skip


def quantities(*, twin: bool) -> tuple[Quantity, ...]:
    """List what is shown of a diagnosis: where there is a ``twin``, nothing that it knows as well."""
    return tuple(quantity for quantity in QUANTITIES if not (twin and quantity.parameter))


def joint_pictures(
    shown: Sequence[Quantity], joints: Sequence[JointMetrics], healthy: Sequence[JointMetrics] | None, gallery: Gallery
) -> tuple[Picture, ...]:
    """Draw every quantity that was measured for at least one joint."""
    labels = [row.joint for row in joints]
    pictures = []
    for quantity in shown:
        measured = _series(quantity, joints, "this arm", palette.BLUE)
        if not np.isfinite(measured.value).any():
            continue
        reference = None if healthy is None else _series(quantity, healthy, "healthy", palette.GREEN)
        values = ", ".join(f"{label} {number(v, 2)}" for label, v in zip(labels, measured.value, strict=True))
        title = f"{quantity.name} [{quantity.unit}]"
        pictures.append(
            gallery.show(
                f"joint-{quantity.name.replace(' ', '-')}",
                by_joint(title, labels, measured, reference, log=quantity.log),
                alt=f"Measured {quantity.name} in {quantity.unit} per joint: {values}. The table below has the "
                "intervals and the healthy ranges.",
                caption=sentence(quantity.meaning),
            )
        )
    return tuple(pictures)


def joint_table(
    shown: Sequence[Quantity], joints: Sequence[JointMetrics], healthy: Sequence[JointMetrics] | None
) -> Table:
    """List every quantity with its interval and, below, the healthy range."""
    rows = []
    for quantity in shown:
        name = f"{quantity.name} [{quantity.unit}]"
        found = [_estimate(quantity, row) for row in joints]
        cells = [_cell(quantity, one) for one in found]
        rows.append(Row(cells=(Cell(name, "measured"), *cells)))
        if healthy is not None:
            ranges = [_range(quantity, _estimate(quantity, row)) for row in healthy]
            rows.append(Row(cells=(Cell("", "healthy"), *(Cell("", text) for text in ranges))))
    headers = ("quantity", *(row.joint for row in joints))
    notes = ("Small print: 95 % interval of the measurement; range within which an arm counts as healthy.",)
    return Table(caption="Measured values per joint", headers=headers, rows=tuple(rows), notes=notes)


def _estimate(quantity: Quantity, row: JointMetrics) -> Estimate | None:
    found = getattr(row, quantity.field)
    return found if isinstance(found, Estimate) else None


def _series(quantity: Quantity, rows: Sequence[JointMetrics], label: str, look: palette.Look) -> Series:
    ends: Array = np.array([_ends(_estimate(quantity, row)) for row in rows]) * quantity.factor
    low = np.where(np.isfinite(ends[:, 1]), ends[:, 1], ends[:, 0])  # an open bound is not drawn
    high = np.where(np.isfinite(ends[:, 2]), ends[:, 2], ends[:, 0])
    return Series(label=label, look=look, value=ends[:, 0], low=low if quantity.signed else np.maximum(low, 0.0),
                  high=high)  # fmt: skip


def _ends(estimate: Estimate | None) -> tuple[float, float, float]:
    if estimate is None:
        return np.nan, np.nan, np.nan
    low = np.nan if estimate.low is None else estimate.low
    return estimate.value, low, np.nan if estimate.high is None else estimate.high


def _cell(quantity: Quantity, estimate: Estimate | None) -> Cell:
    value, low, high = (end * quantity.factor for end in _ends(estimate))
    return Cell(number(value, 2), interval(low, high, 2))


def _range(quantity: Quantity, estimate: Estimate | None) -> str:
    _, low, high = (end * quantity.factor for end in _ends(estimate))
    return interval(low if quantity.signed else max(low, 0.0), high, 2) or UNKNOWN
