"""Results as cells of words, for a page or the terminal."""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from rejoint.arms import Array
from rejoint.control.comparison.result import Comparison, ControllerRow, Protocol
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.pages.words import MM, NEVER, UNKNOWN, Cell, ends, listed, measured, number, plural
from rejoint.system.statistics import NORMAL95, Estimate, bootstrap_mean
from rejoint.twin.twin import NO_TWIN, Judgement, smaller

DEG = np.degrees(1.0)


ResultColumns = dict[str, Callable[[ControllerRow], Cell]]
"""Columns of a table of controllers by header"""


def columns(comparison: Comparison) -> ResultColumns:
    """Columns of a comparison, without the names."""
    found = result_columns(comparison.protocol, len(comparison.targets[0]), comparison.block)
    if comparison.orientations:
        found["orientation, encoders [deg]"] = lambda row: measured(row.turned, DEG)
    return found | {"guard": _guard}


def result_columns(protocol: Protocol, count: int, block: int = 0) -> ResultColumns:
    """Columns of what controllers reach at ``count`` targets, in blocks of ``block``."""
    within = " / ".join(f"{distance * MM:g}" for distance in protocol.within)
    return {
        "success [%]": _success,
        "error at the crossing [mm]": _crossing,
        f"{plural(count, 'target')} [s]": lambda row: measured(row.cycle_time, 1.0, 3),
        "settled error, encoders [mm]": lambda row: _settled(row, block),
        "settled error, true [mm]": _true,
        f"time to stay within {within} mm [s]": _stays,
        "oscillation [mm]": lambda row: Cell(measured(row.oscillation).text),
    }


def plain_table(
    found: ResultColumns, rows: Iterable[ControllerRow], *, notes: bool = False
) -> tuple[list[str], list[list[str]]]:
    """Headers and rows of plain text, first column the controllers; ``notes``: with the small print."""
    lines = [
        [
            f"{row.controller}{' (by diagnosis)' if row.source else ''}",
            *(str(cell) if notes else cell.text for cell in (cell(row) for cell in found.values())),
        ]
        for row in rows
    ]
    return ["controller", *found], lines


def _success(row: ControllerRow) -> Cell:
    one = row.success
    return Cell(number(100 * row.reached, 3), "" if one is None else ends(one, 2, 100))


def _crossing(row: ControllerRow) -> Cell:
    """Mean and deviation, with three digits of the mean."""
    found = row.crossing_error
    if found is None:
        return Cell(UNKNOWN)
    mean = number(MM * found.mean.value)
    return Cell(f"{mean} ± {MM * found.std:.{len(mean.partition('.')[2])}f}" if found.std else mean)


def _settled(row: ControllerRow, block: int) -> Cell:
    text, note = measured(row.settled, MM, 3)
    held = plural(row.held, "target") if block else ""  # at fewer than all where some are eliminated
    return Cell(text, "\n".join(filter(None, (note, held))))


def _true(row: ControllerRow) -> Cell:
    true = row.true_error
    if true.value is None or true.how == "known":
        return measured(row.settled_true)
    return Cell(f"{number(MM * true.value, 2)}, {true.how}", true.range)


def _stays(row: ControllerRow) -> Cell:
    stays = " / ".join(NEVER if stay.median is None else number(stay.median, 2) for stay in row.stays)
    shares = " / ".join(f"{100 * stay.share.value:.0f}" for stay in row.stays)
    return Cell(stays or UNKNOWN, f"{shares} %" if stays else "")


def _guard(row: ControllerRow) -> Cell:
    what, _, where = row.out.partition(" (")
    out = [f"stopped: {what}", *([where.removesuffix(")")] if where else [])] if row.out else []
    stopped = [f"{plural(row.failures, 'trial')} stopped"] if row.failures else []
    reasons = (f"{number(100 * share, 2)} % {reason}" for reason, share in row.guard.items())
    first, *more = [*out, *stopped, *reasons] or [NEVER]
    return Cell(first, "\n".join(more))


def behind(found: Calibration) -> list[tuple[str, list[Cell]]]:
    """Offset, compliance and play per joint [deg, deg/(N m), deg], with the fit's intervals."""
    by_kind = []
    for kind in ("offset", "compliance", "play"):
        value, half = getattr(found.displacement, kind), NORMAL95 * found.sigma(kind)
        low = value - half if kind == "offset" else np.maximum(value - half, 0.0)
        by_kind.append([measured(Estimate(*ends), DEG) for ends in zip(value, low, value + half, strict=True)])
    return [(name, cells) for name, *cells in zip(found.arm.joint_names, *by_kind, strict=True)]


def ranked(judgement: Judgement, where: str) -> dict[str, tuple[Estimate, Array]]:
    """Mean error [mm] with 95 % interval over motions of every prediction, the best first, ``free`` or in ``contact``.

    Also its errors (K,) by motion; NaN: no such motion.
    """
    found = {}
    for name in judgement.mean:
        each = [getattr(motion.errors[name], where) for motion in judgement.motions]
        errors = np.array([np.nan if one is None else MM * one.tcp for one in each])
        known = errors[np.isfinite(errors)]
        if len(known):
            found[name] = bootstrap_mean(known, np.arange(len(known))), errors
    return dict(sorted(found.items(), key=lambda pair: pair[1][0].value))


def answer(judgement: Judgement) -> tuple[str, ...]:
    """Say which prediction to trust, how far and where; the answer first."""
    last = "All this is by the arm's own encoders: play and flex behind them show in no log."
    return (*_free(judgement), _contact(judgement), last)


def _free(judgement: Judgement) -> Iterator[str]:
    found = ranked(judgement, "free")
    if not found:
        yield "Nothing can be said about free space: no motion shows it."
        return
    (best, (mean, errors)), *others = found.items()
    within = f"{_mean(mean)}, mean of {plural(int(np.isfinite(errors).sum()), 'motion')}"
    if judgement.doubts:
        yield f"Trust none of them: {'; '.join(judgement.doubts)}."
        yield f"“{best}” comes nearest in free space: {within}."
    elif best == NO_TWIN:
        yield f"Trust none of them: the command alone predicts better ({within})."
    else:
        yield f"Trust “{best}” in free space: it predicts the tool within {within}."
    yield f"The others: {listed([f'{name} {_mean(one)}' for name, (one, _) in others])}."
    both = {name: np.isfinite(errors + theirs) for name, (_, theirs) in others}
    close = [f"“{name}”" for name, rows in both.items() if not smaller(errors[rows], found[name][1][rows])]
    if close:
        yield f"Not measurably worse in these motions: {listed(close)}."


def _contact(judgement: Judgement) -> str:
    for best, (mean, _) in ranked(judgement, "contact").items():
        seconds = sum(motion.contact_seconds for motion in judgement.motions)
        return f"On the table ({seconds:.0f} s) “{best}” is closest: {_mean(mean)}."
    return "No contact shows in these motions: how they predict contact is not known."


def _mean(estimate: Estimate) -> str:
    text = ends(estimate, 3)
    return f"{number(estimate.value, 3, 'mm')}{text and f' (95 %: {text})'}"
