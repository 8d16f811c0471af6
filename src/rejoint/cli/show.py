"""How results look at the terminal."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from rejoint.cli.console import Terminal
from rejoint.control.comparison.recommend import Recommendation, failure
from rejoint.control.comparison.result import Comparison
from rejoint.control.servogains import in_words
from rejoint.diagnosis.calibration.fit import DISTURBED, astray, disturbed
from rejoint.logs.runfolder import Effort, cost
from rejoint.system.statistics import Spread

_NAMED = 8  # pictures whose faults are printed line by line

if TYPE_CHECKING:
    from rejoint.camera.fit import Filmed
    from rejoint.control.deployment import Deployed
    from rejoint.control.moving.drive import Followed
    from rejoint.control.servogains import GainsFound
    from rejoint.diagnosis.calibration.calibration import Preload
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.pages.report.contents import BeforeAfter
    from rejoint.runs.stages.calibrate import Calibrated
    from rejoint.training.train import TrainingResult
    from rejoint.twin.twin import Twin


def stage(terminal: Terminal, name: str, result: Any) -> None:  # noqa: ANN401 - of each stage another
    """Print what the function ``name`` of the front door returned; nothing for None, a result that was kept."""
    if result is not None and name in STAGES:
        show, *parts = STAGES[name]
        show(terminal, *(getattr(result, part) for part in parts) if parts else (result,))


def diagnosis(terminal: Terminal, result: Diagnosis) -> None:
    """Print the verdict in words."""
    terminal.say(result.verdict)
    for finding in result.findings:
        terminal.say(f"  - {finding.sentence}")
    for limit in result.unseen:
        terminal.say(f"  ? {limit}")
    if result.open_loop is not None:
        terminal.say(
            f"Open loop: {result.open_loop.error_mm.value:.1f} mm off by the encoders; the tool itself: "
            f"{result.open_loop.true_error}."
        )


def twin(terminal: Terminal, result: Twin) -> None:
    """Print how well the twin predicts motion it has not seen."""
    errors = result.held_out
    terminal.say(
        f"On {errors.seconds:.0f} s of motion that the fit has not seen, the twin predicts the joints within "
        f"{np.degrees(errors.twin.joint):.2f} deg and the tool within {1e3 * errors.twin.tcp:.1f} mm rms "
        f"(no twin: {1e3 * errors.no_twin.tcp:.1f} mm"
        f"{f', a healthy twin: {1e3 * errors.healthy_twin.tcp:.1f} mm' if errors.healthy_twin else ''})."
    )
    if result.unknown:
        terminal.say(f"The data cannot tell: {', '.join(result.unknown)}; they keep their prior range.")
    for note in result.notes:
        terminal.say(f"  ! {note}")


def calibration(terminal: Terminal, found: Calibrated) -> None:
    """Print where the tool is behind the encoders, and whether correcting for it helps."""
    own, measured = found.calibration, found.measurements
    if found.filmed is not None:
        show_filmed(terminal, found.filmed)
    for row in own.suspects if found.filmed is None else ():
        place = ", ".join("-" if np.isnan(value) else f"{1e3 * value:.1f}" for value in measured.point[row])
        terminal.result(
            f"  ! Measurement {row + 1} ({place} mm) does not fit to the others: read wrong, or touched hard? Measure "
            "it again."
        )
    if disturbed(own.suspects, own.points):
        terminal.result(f"  ! {DISTURBED}")
    if found.reversal:
        terminal.say(
            f"Reversal value at the tool (ISO 230-2, from {len(found.reversal)} postures): mean "
            f"{1e3 * float(np.mean(found.reversal)):.1f} mm, largest {1e3 * max(found.reversal):.1f} mm."
        )
    before, after = 1e3 * found.before, 1e3 * found.after
    terminal.result(
        f"At {own.points} measurements, each predicted without its own posture, the tool was {before:.2f} mm from "
        f"where the encoders see it, and {after:.2f} mm from where the calibration does."
    )
    if own.frame_name != "base":
        terminal.say(
            f"The place of the {own.frame_name} was fitted along: what all postures share is not in these numbers."
        )
    if astray(own.arm, own.missed):
        terminal.result(
            "  ! No arm is that far from a description of itself: are units, columns, joint positions and the frame of "
            "the points right, and is it this arm?"
        )
    if own.used:
        terminal.result("The correction clearly helps and will be used.")
        _say_wedge(terminal, found.preload)
    else:
        terminal.result("The correction does not clearly help and will not be used.")


def _say_wedge(terminal: Terminal, what: Preload) -> None:
    from rejoint.diagnosis.calibration.calibration import RISE, WEDGE

    if what.wedge_helps:
        slope = f"{np.degrees(WEDGE):g} degrees ({RISE:.1f} mm on 10 cm)"
        terminal.say(
            f"Chance decides {1e3 * what.chance:.1f} mm at the tool: no weight presses {' or '.join(what.joints)} to a "
            f"side. With the {what.side} side of the base raised by {slope} "
            f"{1e3 * what.wedge:.1f} mm of it would be left; calibrate again then, with --fresh."
        )


def gains(terminal: Terminal, found: GainsFound) -> None:
    """Print what the servos' own gains were, and what better ones leave of the errors."""
    for what, values, seen in (
        ("as they are", found.found, found.before),
        ("under a controller", found.under, found.with_under),
        ("alone", found.alone, found.with_alone),
    ):
        joints = f"{np.degrees(np.max(seen.error)):.2f} deg at the worst joint"
        terminal.say(f"  {what}: {in_words(values)}: {1e3 * seen.tool:.1f} mm by the encoders, {joints}")


def training(terminal: Terminal, result: TrainingResult) -> None:
    """Print what the training reached."""
    terminal.say(
        f"{result.steps / 1e6:.2f} million transitions in {result.wall_s:.0f} s; on randomised twins "
        f"{100 * result.success_rate:.0f} % of the targets reached, median error {result.error_mm:.2f} mm. "
        f"Policy: {result.policy}"
    )


def comparison(terminal: Terminal, result: Comparison, advice: Recommendation) -> None:
    """Print the table of all controllers and the one to use."""
    from rejoint.pages.report.tables import columns, directions, plain_table
    from rejoint.pages.words import plural

    headers, rows = plain_table(columns(result), result.rows)
    sets, count = len(result.targets), len(result.targets[0])
    trials = f"{plural(sets, 'set')} of {plural(count, 'target')}, {plural(result.repetitions, 'repetition')}"
    title = f"{result.robot}: {trials}{f', in blocks of {result.block}' if result.block else ''}"
    terminal.table(title, headers, rows, bold=result.controllers.index(advice.controller))
    for line in filter(None, map(failure, result.rows)):
        if not any(line in reason for reason in advice.why):
            terminal.result(f"  ! {line}")
    best = result.row(advice.controller)
    ends = (
        ("by the encoders", best.accuracy, best.repeatability),
        ("of the tool", best.accuracy_true, best.repeatability_true),
    )
    shown = [_poses(what, ap, rp) for what, ap, rp in ends if ap]
    if shown:
        cycles = plural(result.repetitions, "cycle")
        terminal.result(f"ISO 9283 with {advice.controller}, {cycles} (the norm asks for 30): {'; '.join(shown)}.")
    for line in directions(result):
        terminal.result(line)
    tie = f" (a tie with {', '.join(advice.tied)})" if advice.tied else ""
    terminal.result(f"Recommended: {advice.controller}{tie}")
    for reason in advice.why:
        terminal.result(f"  - {reason}")


def _poses(what: str, accuracy: Spread, repeatability: Spread | None) -> str:
    again = "not known" if repeatability is None else f"{1e3 * repeatability.mean.value:.2f} mm"
    return f"{what} AP {1e3 * accuracy.mean.value:.2f} mm, RP {again}"


def verdict(terminal: Terminal, result: BeforeAfter | None) -> None:
    """Print what the whole repair came to."""
    if result is not None and result.sentence:
        terminal.result(result.sentence)


def effort(terminal: Terminal, spent: Effort | None) -> None:
    """Print what a repair cost, stage by stage."""
    for stage in () if spent is None else spent.stages:
        terminal.say(f"  {stage.name}: {cost(stage)}")
    if spent is not None and spent.stages:
        terminal.result(f"In all: {cost(spent.total)}.")


def followed(terminal: Terminal, done: Followed) -> None:
    """Print how well a path was followed, each time."""
    posed = any(one.turned is not None for one in done.passes)
    rows = [
        [
            str(number),
            *(f"{1e3 * value:.2f}" for value in (one.encoder.rms, one.encoder.largest)),
            f"{1e3 * one.encoder.lag:.0f}",
            *(f"{1e3 * value:.2f}" for value in (one.encoder.rms_after, one.encoder.largest_after)),
            *([_degrees(one.turned)] if posed else []),
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
        *(["rms deg"] if posed else []),
        "rms of the tool",
    ]
    terminal.table(f"{done.path}, {done.controller}: errors along the way by the encoders", headers, rows)
    if not done.followed:
        terminal.result(f"Not followed: {1e3 * done.within:g} mm root mean square after the lag were expected.")
    if done.gaps:
        terminal.result(f"The answers stayed away {len(done.gaps)} times, for up to {max(done.gaps):.1f} s.")


def _degrees(angle: float | None) -> str:
    return "-" if angle is None else f"{np.degrees(angle):.2f}"


def deployment(terminal: Terminal, within: float, done: Deployed) -> None:
    """Print what became of each target; ``within`` [m] one counts as reached."""
    posed = any(visit.orientation for visit in done.visits)
    rows = [
        [
            str(number),
            *(f"{1e3 * value:.1f}" for value in visit.target),
            *([visit.orientation] if posed else []),
            "-" if visit.error is None else f"{1e3 * visit.error:.2f}",
            *([_degrees(visit.turned)] if posed else []),
            "-" if visit.error is None else str(visit.true_error),
            "yes" if visit.reached else "no",
            visit.remark,
        ]
        for number, visit in enumerate(done.visits, start=1)
    ]
    title = (
        f"Errors of {done.controller} at the end of each target (reached: within {1e3 * within:g} mm by the encoders)"
    )
    headers = [
        "target",
        "x mm",
        "y mm",
        "z mm",
        *(["orientation"] if posed else []),
        "encoder error mm",
        *(["deg"] if posed else []),
        "true error of the tool",
        "reached",
        "remark",
    ]
    width = len(headers) - (not any(visit.remark for visit in done.visits))
    terminal.table(title, headers[:width], [row[:width] for row in rows])
    if done.missed:
        terminal.result(f"Not reached: {len(done.missed)} of {len(done.visits)} targets.")
    seen = [visit.seen_error for visit in done.visits if visit.seen_error is not None]
    if seen:
        terminal.result(
            f"Seen by the camera: {1e3 * sum(seen) / len(seen):.2f} mm off on average at the end of {len(seen)} of "
            f"{len(done.visits)} targets, {1e3 * max(seen):.2f} mm at most."
        )
    if done.gaps:
        terminal.result(
            f"The answers stayed away {len(done.gaps)} times, for up to {max(done.gaps):.1f} s; each time the arm held "
            "and then went on slowly."
        )


def show_filmed(terminal: Terminal, found: Filmed) -> None:
    """Print which pictures were not used and why, and what was found of lens, camera and board."""
    for one in found.left_out[:_NAMED]:
        terminal.result(f"  ! {one.name} is not used: {one.why}")
    if len(found.left_out) > _NAMED:
        terminal.result(f"  ! ... and {len(found.left_out) - _NAMED} more pictures.")
    for row in found.calibration.suspects:
        terminal.result(
            f"  ? {found.residuals[row].name} was used, but fits badly: did the arm still move, or was it pushed?"
        )
    rig, mm = found.rig, partial(_with_sigma, scale=1e3, digits=1)
    sigma = found.rig_sigma
    standing, mounted = ("camera", "board") if rig.carried == "board" else ("board", "camera")
    terminal.say(
        f"{len(found.residuals)} pictures, corners within {found.rms:.2f} px. Focal length "
        f"{_with_sigma([rig.lens.f], sigma[:1], 1.0, 0)} px; {standing} in the base at "
        f"{mm(rig.standing[:3, 3], sigma[7:10])} mm; {mounted} on the tool at "
        f"{mm(rig.mounted[:3, 3], sigma[13:16])} mm (standard deviations)."
    )


def _with_sigma(values: object, sigma: object, scale: float, digits: int) -> str:
    pairs = zip(np.atleast_1d(np.asarray(values)), np.atleast_1d(np.asarray(sigma)), strict=True)
    return ", ".join(f"{scale * value:.{digits}f} +- {scale * spread:.{digits}f}" for value, spread in pairs)


STAGES: dict[str, tuple[Any, ...]] = {
    "diagnose": (diagnosis, "diagnosis"),
    "identify": (twin,),
    "train": (training, "training"),
    "gains": (gains,),
    "calibrate": (calibration,),
    "compare": (comparison, "comparison", "recommendation"),
}
"""What prints the result of a stage, and the parts of the result that it takes"""
