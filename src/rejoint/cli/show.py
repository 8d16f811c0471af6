"""How results look at the terminal: lines and tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

import rejoint
from rejoint.arms import Array
from rejoint.arms.rotations import REACHED_TURN
from rejoint.cli.console import Shown
from rejoint.control.comparison.recommend import failure
from rejoint.control.servogains import in_words
from rejoint.diagnosis.calibration.fit import DISTURBED, disturbed, fitting
from rejoint.logs.runfolder import Effort, cost
from rejoint.pages.words import grouped, plural

if TYPE_CHECKING:
    from rejoint.control.servogains import GainsFound
    from rejoint.runs.fleet.campaign import FleetResult


def stage(name: str, result: Any) -> Shown:  # noqa: ANN401 - of each stage another
    """Yield what the function ``name`` of the front door returned; nothing for None, a result that was kept."""
    if result is not None and name in STAGES:
        yield from STAGES[name](result)


def diagnose(done: rejoint.Diagnosed) -> Shown:
    """Yield the verdict in words."""
    yield done.verdict
    for finding in done.findings:
        yield f"  - {finding.sentence}"
    for limit in done.diagnosis.unseen:
        yield f"  ? {limit}"
    if (errors := done.diagnosis.open_loop) is not None:
        yield f"Open loop: {errors.error_mm.value:.1f} mm off by the encoders; the tool itself: {errors.true_error}."


def identify(result: rejoint.Twin) -> Shown:
    """Yield how well the twin predicts motion it has not seen."""
    errors = result.held_out
    yield (
        f"On {errors.seconds:.0f} s of motion that the fit has not seen, the twin predicts the joints within "
        f"{np.degrees(errors.twin.joint):.2f} deg and the tool within {1e3 * errors.twin.tcp:.1f} mm rms "
        f"(no twin: {1e3 * errors.no_twin.tcp:.1f} mm)."
    )
    if result.unknown:
        yield f"The data cannot tell for sure: {grouped(result.unknown)}."
    for note in result.notes:
        yield f"  ! {note}"


def calibrate(found: rejoint.Calibrated) -> Shown:
    """Yield where the tool is behind the encoders, and whether correcting for it helps."""
    own, filmed = found.calibration, found.filmed
    for name, why in () if filmed is None else filmed.left_out:
        yield f"  ! {name} is not used: {why}"
    for row in own.suspects:
        name = (
            f"Measurement {row + 1} ({_place(found.measurements.point[row])} mm)"
            if filmed is None
            else filmed.residuals[row].name
        )
        yield f"  ! {name} does not fit to the others: read wrong, or pushed? Measure it again."
    for joint, offset in own.wrong_zeros.items():
        yield f"  ! The zero of {joint} is {np.degrees(offset):.1f} deg off. Set it again, then calibrate again."
    if disturbed(own.suspects, own.points):
        yield f"  ! {DISTURBED}"
    if filmed is not None:
        rig = filmed.rig
        standing, mounted = ("camera", "board") if rig.carried == "board" else ("board", "camera")
        yield (
            f"{len(filmed.residuals)} pictures, corners within {filmed.rms:.2f} px. Focal length {rig.lens.f:.0f} px; "
            f"{standing} in the base at {_place(rig.standing[:3, 3])} mm; {mounted} on the tool at "
            f"{_place(rig.mounted[:3, 3])} mm."
        )
    count = fitting(own.suspects, own.points).sum()
    yield (
        f"At {count} measurements, each predicted without its own posture, the tool was {1e3 * found.before:.2f} mm "
        f"from where the encoders see it, and {1e3 * found.after:.2f} mm from where the calibration does, in the "
        "coordinates that were measured."
    )
    if own.frame_name != "base":
        yield f"The place of the {own.frame_name} was fitted along: what all postures share is not in these numbers."
    helps = "clearly helps and will be used" if own.used else "does not clearly help and will not be used"
    yield f"The correction {helps}."


def gains(found: GainsFound) -> Shown:
    """Yield what the servos' own gains were, and what better ones leave of the errors."""
    for what, values, seen in (
        ("as they are", found.found, found.before),
        ("under a controller", found.under, found.with_under),
        ("alone", found.alone, found.with_alone),
    ):
        yield (
            f"  {what}: {in_words(values)}: {1e3 * seen.tool:.1f} mm by the encoders, "
            f"{np.degrees(np.max(seen.error)):.2f} deg at the worst joint"
        )


def train(done: rejoint.TrainedPolicy) -> Shown:
    """Yield what the training reached."""
    result = done.training
    yield (
        f"{result.steps:,} transitions in {result.wall_s:.0f} s; on randomised twins "
        f"{100 * result.success_rate:.0f} % of the targets reached, median error {result.error_mm:.2f} mm. "
        f"Policy: {result.policy}"
    )


def compare(done: rejoint.Compared) -> Shown:
    """Yield the table of all controllers and the one to use."""
    from rejoint.pages.report.tables import columns, plain_table

    result, advice = done.comparison, done.recommendation
    headers, rows = plain_table(columns(result), result.rows)
    sets = f"{plural(len(result.targets), 'set')} of {plural(len(result.targets[0]), 'target')}"
    trials = f"{plural(result.repetitions, 'repetition')}{f', in blocks of {result.block}' if result.block else ''}"
    yield f"{result.robot}: {sets}, {trials}", headers, rows, result.controllers.index(advice.controller)
    for line in filter(None, map(failure, result.rows)):
        if not any(line in reason for reason in advice.why):
            yield f"  ! {line}"
    tie = f" (a tie with {', '.join(advice.tied)})" if advice.tied else ""
    yield f"Recommended: {advice.controller}{tie}"
    for reason in advice.why:
        yield f"  - {reason}"


def effort(spent: Effort | None) -> Shown:
    """Yield what a repair cost, stage by stage."""
    if spent is not None:
        for stage in spent.stages:
            yield f"  {stage.name}: {cost(stage)}"
        yield f"In all: {cost(spent.total)}."


def follow(done: rejoint.Followed) -> Shown:
    """Yield how well a path was followed, each time."""
    rows = [
        [
            str(number),
            _mm(one.encoder.rms, 2),
            _mm(one.encoder.largest, 2),
            f"{1e3 * one.encoder.lag:.0f}",
            _mm(one.encoder.rms_after, 2),
            _mm(one.encoder.largest_after, 2),
            _degrees(one.turned),
            str(one.true_error),
        ]
        for number, one in enumerate(done.passes, start=1)
    ]
    headers = [
        "time",
        "rms mm",
        "largest mm",
        "lag ms",
        "rms after lag mm",
        "largest after lag mm",
        "rms deg",
        "rms of the tool",
    ]
    yield f"{done.path}, {done.controller}: errors along the way by the encoders", headers, rows
    if not done.followed:
        turned = f" and {np.degrees(REACHED_TURN):g} deg" * (done.passes[-1].turned is not None)
        yield f"Not followed: at most {1e3 * done.within:g} mm{turned} root mean square after the lag were expected."
    yield from _gaps(done.gaps)


def deploy(done: rejoint.Deployed) -> Shown:
    """Yield what became of each target."""
    rows = [
        [
            str(number),
            *(_mm(value, 1) for value in visit.target),
            visit.orientation,
            _mm(visit.error, 2),
            _degrees(visit.turned if visit.orientation else None),
            "" if visit.error is None else str(visit.true_error),
            "yes" if visit.reached else "no",
            visit.remark,
        ]
        for number, visit in enumerate(done.visits, start=1)
    ]
    headers = [
        "target",
        "x mm",
        "y mm",
        "z mm",
        "orientation",
        "encoder error mm",
        "deg",
        "true error of the tool",
        "reached",
        "remark",
    ]
    reached = f"reached: within {1e3 * done.within:g} mm by the encoders"
    yield f"Errors of {done.controller} at the end of each target ({reached})", headers, rows
    if done.missed:
        yield f"Not reached: {len(done.missed)} of {len(done.visits)} targets."
    seen = [visit.seen_error for visit in done.visits if visit.seen_error is not None]
    if seen:
        yield (
            f"Seen by the camera: {_mm(sum(seen) / len(seen), 2)} mm off on average at the end of {len(seen)} of "
            f"{len(done.visits)} targets, {_mm(max(seen), 2)} mm at most."
        )
    yield from _gaps(done.gaps)


def check(found: rejoint.Checked) -> Shown:
    """Yield the line of a check."""
    yield found.line


def fleet(found: FleetResult) -> Shown:
    """Yield the table of all arms, and what was found of each."""
    from rejoint.runs.fleet.campaign import HEADERS

    yield "All arms, the worst first", HEADERS, [row.cells for row in found.rows]
    yield from (f"{row.name}: {row.found}" for row in found.rows if row.found)


def _mm(metres: float | None, digits: int) -> str:
    return "" if metres is None else f"{1e3 * metres:.{digits}f}"


def _place(point: Array) -> str:
    return ", ".join("-" if np.isnan(value) else _mm(value, 1) for value in point)


def _degrees(angle: float | None) -> str:
    return "" if angle is None else f"{np.degrees(angle):.2f}"


def _gaps(gaps: Sequence[float]) -> Shown:
    if gaps:
        yield f"The answers stayed away {len(gaps)} times, for up to {max(gaps):.1f} s; the arm held meanwhile."


STAGES: dict[str, Callable[[Any], Shown]] = {
    one.__name__: one for one in (diagnose, calibrate, identify, gains, train, compare, deploy, follow, check, fleet)
}
"""What yields the result of a stage, by its name"""
