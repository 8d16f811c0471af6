"""How results look at the terminal."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rejoint.cli.console import Terminal
from rejoint.control.comparison.failure import failure
from rejoint.control.comparison.recommend import Recommendation
from rejoint.control.comparison.result import Comparison
from rejoint.control.default import DefaultController

if TYPE_CHECKING:
    from rejoint.control.deployment import Deployed
    from rejoint.diagnosis.diagnosis import Diagnosis
    from rejoint.runs.stages.calibrate import Calibrated
    from rejoint.training.train import TrainingResult
    from rejoint.twin.twin import Twin


def stage(terminal: Terminal, name: str, result: Any) -> None:  # noqa: ANN401 - of each stage another
    """Print what the function ``name`` of the front door returned; nothing for None, a result that was kept."""
    if result is None or name == "report":
        return
    if name == "diagnose":
        diagnosis(terminal, result.diagnosis)
    elif name == "identify":
        twin(terminal, result)
    elif name == "train":
        training(terminal, result.training)
    elif name == "calibrate":
        calibration(terminal, result)
    elif name == "compare":
        comparison(terminal, result.comparison, result.recommendation)


def diagnosis(terminal: Terminal, result: Diagnosis) -> None:
    """Print the verdict in words."""
    terminal.say(result.verdict)
    for finding in result.findings:
        terminal.say(f"  - {finding.sentence}")
    for limit in result.unseen:
        terminal.say(f"  ? {limit}")


def twin(terminal: Terminal, result: Twin) -> None:
    """Print how well the twin predicts motion it has not seen."""
    errors = result.held_out
    terminal.say(
        f"On {errors.seconds:.0f} s of motion that the fit has not seen, the twin predicts the joints within "
        f"{np.degrees(errors.twin.joint):.2f} deg and the tool within {1e3 * errors.twin.tcp:.1f} mm rms "
        f"(no twin: {1e3 * errors.no_twin.tcp:.1f} mm, a healthy arm's twin: "
        f"{1e3 * errors.healthy_twin.tcp:.1f} mm)."
    )
    if result.unknown:
        terminal.say(f"The data cannot tell: {', '.join(result.unknown)}; they keep their prior range.")


def calibration(terminal: Terminal, found: Calibrated) -> None:
    """Print where the tool is behind the encoders, and whether correcting for it helps."""
    own, measured = found.calibration, found.measurements
    for row in own.suspects:
        place = ", ".join(f"{1e3 * value:.1f}" for value in measured.point[row])
        terminal.result(
            f"  ! Measurement {row + 1} ({place} mm) does not fit to the others: read wrong, or touched hard? Measure "
            "it again."
        )
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
    if own.used:
        terminal.result("The correction clearly helps and will be used.")
    else:
        terminal.result("The correction does not clearly help and will not be used.")


def training(terminal: Terminal, result: TrainingResult) -> None:
    """Print what the training reached."""
    terminal.say(
        f"{result.steps / 1e6:.2f} million transitions in {result.wall_s:.0f} s; on randomised twins "
        f"{100 * result.success_rate:.0f} % of the targets reached, median error {result.error_mm:.2f} mm. "
        f"Policy: {result.policy}"
    )


def comparison(terminal: Terminal, result: Comparison, advice: Recommendation) -> None:
    """Print the table of all controllers and the one to use."""
    from rejoint.runs.report.tables import comparison_table
    from rejoint.runs.report.words import plural

    headers, rows = comparison_table(result)
    sets, count = len(result.targets), len(result.targets[0])
    trials = f"{plural(sets, 'set')} of {plural(count, 'target')}, {plural(result.repetitions, 'repetition')}"
    title = f"{result.robot}: {trials}"
    terminal.table(title, headers, rows, bold=result.controllers.index(advice.controller))
    for line in filter(None, map(failure, result.rows)):
        if not any(line in reason for reason in advice.why):
            terminal.result(f"  ! {line}")
    terminal.result(f"Recommended: {advice.controller}")
    for reason in advice.why:
        terminal.result(f"  - {reason}")


def verdict(terminal: Terminal, before: Diagnosis, result: Comparison, advice: Recommendation) -> None:
    """Print what the whole repair came to."""
    settled = result.row(advice.controller).hold.settled
    own = result.row(DefaultController.name).hold.settled if DefaultController.name in result.controllers else None
    if own is not None:  # on the very targets of the comparison
        earlier = 1e3 * own.mean.value
    elif before.open_loop is not None:
        earlier = before.open_loop.error_mm.value
    else:
        return
    if settled is not None:
        terminal.result(
            f"Before: {earlier:.1f} mm off. After, with '{advice.controller}': {1e3 * settled.mean.value:.2f} mm "
            "(both by the arm's own encoders)."
        )


def deployment(terminal: Terminal, within: float, done: Deployed) -> None:
    """Print what became of each target; ``within`` [m] one counts as reached."""
    rows = [
        [
            str(number), *(f"{1e3 * value:.1f}" for value in visit.target),
            "-" if visit.error is None else f"{1e3 * visit.error:.2f}", "yes" if visit.reached else "no", visit.remark,
        ]
        for number, visit in enumerate(done.visits, start=1)
    ]  # fmt: skip
    title = f"Error at the end of each target (by the encoders; reached: within {1e3 * within:g} mm)"
    terminal.table(title, ["target", "x mm", "y mm", "z mm", "error mm", "reached", ""], rows)
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
