"""The top of the page: what was wrong, what was done, what to use, what is not known."""

from __future__ import annotations

from collections.abc import Sequence

from rejoint.control.comparison.failure import failure
from rejoint.control.comparison.recommend import NO_INTERVAL, Recommendation, difference
from rejoint.control.comparison.result import Comparison, ControllerRow
from rejoint.control.geared import own_policy
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.diagnosis import ringing_most
from rejoint.logs.runfolder.folder import LOGS
from rejoint.pages.report.contents import Contents
from rejoint.pages.report.errors import before_after, found
from rejoint.pages.report.numerals import UNKNOWN, interval, number
from rejoint.pages.report.sections.diagnosed import error_range, mean_error
from rejoint.pages.report.trust import answer
from rejoint.pages.report.view import KeyNumber, Page, Section, Summary
from rejoint.pages.report.words import cycles, day_and_time, listed, measured_with, plural, sentence
from rejoint.system.statistics import Spread, above_zero

MM, PERCENT = 1e3, 1e2
BEFORE = "default"
"""The arm as it was: its own controller"""

QUICK = "A quick try: little of everything was done, so nothing on this page is a result."

HOW = {"known": "emulator only", "measured": "measured", "modelled": "modelled by the calibration"}
"""Where a true error comes from"""

STAGES = ("diagnose", "calibrate", "identify", "train", "compare")
"""In the order in which they are run"""


def page_of(contents: Contents, advice: Recommendation | None, sections: tuple[Section, ...], *, footer: str) -> Page:
    """Put the verdict on top of the sections."""
    robot = UNKNOWN if contents.info is None else contents.info.robot
    begun = "" if contents.info is None else f", {day_and_time(contents.info.created)}"
    return Page(
        title=f"Repair report: {contents.arm.name}",
        subtitle=f"{_source(robot)}{begun}",
        verdict=(*((QUICK,) if contents.folder.quick.exists() else ()), *_verdict(contents, advice)),
        keys=_keys(contents, advice),
        summaries=_summaries(contents, advice, sections),
        sections=sections,
        footer=footer,
    )


def _source(robot: str) -> str:
    return f"From logs in {robot.removeprefix(LOGS)}" if robot.startswith(LOGS) else f"Robot {robot}"


def _verdict(contents: Contents, advice: Recommendation | None) -> tuple[str, ...]:
    wrong = () if contents.diagnosis is None else (contents.diagnosis.verdict,)
    if contents.judgement is not None:
        wrong = (*wrong, " ".join(answer(contents.judgement)[:2]))
    if advice is None or contents.comparison is None:
        untried = "No controller has been tried on this arm yet, so none is recommended."
        return (*wrong, untried) if wrong else (untried,)
    errors = before_after(contents, advice.controller)
    told = () if errors is None or not errors.sentence else (errors.sentence,)
    return (_headline(advice, contents, contents.comparison), *told, *wrong, *_policy(advice, contents.comparison))


def _headline(advice: Recommendation, contents: Contents, comparison: Comparison) -> str:
    """Say what to use, and on which arm that was found if not on the one of this run."""
    best, name, info = comparison.row(advice.controller), advice.controller, contents.info
    here = info is None or comparison.robot == info.robot
    arm = "this arm" if here else f"the arm at {comparison.robot}, which is not the one of this run,"
    after = _millimetres(best.hold.settled)
    if advice.controller == BEFORE:
        return f"Leave {arm} as it is: no controller that was tried does measurably better than its own ({after})."
    before = comparison.row(BEFORE).hold.settled if BEFORE in comparison.controllers else None
    gain = "" if before is None else f"; its own controller leaves {_millimetres(before)}{_gain(before, best)}"
    if before is None and here and contents.diagnosis is not None and contents.diagnosis.open_loop is not None:
        found = number(contents.diagnosis.open_loop.error_mm.value, 3, "mm")
        gain = f"; its own controller left {found} at the targets of the diagnosis"
    return (
        f"Use the controller “{name}”: it brings {arm} to {after} of its targets by its encoders{gain}.{_tie(advice)}"
    )


def _tie(advice: Recommendation) -> str:
    names = listed([f"“{name}”" for name in advice.tied], "and")
    return f" It is a tie with {names}, and the simplest of them." if advice.tied else ""


def _gain(before: Spread, best: ControllerRow) -> str:
    if best.hold.settled is None:
        return ""
    return f", so that {number((before.mean.value - best.hold.settled.mean.value) * MM, 3, 'mm')} are gained"


def _policy(advice: Recommendation, comparison: Comparison) -> tuple[str, ...]:
    """Say plainly how the learned policy did where it is not the one to use."""
    own, name = own_policy(comparison.controllers), advice.controller
    if own is None or own == name:
        return ()
    row = comparison.row(own)
    if row.needless:
        return (f"The learned policy was tried and gains too little here. {sentence(failure(row))}",)
    if row.beaten:
        return (f"The learned policy was tried and is not the best here. {sentence(failure(row))}",)
    if row.out or row.failures:
        return (f"The learned policy was tried and failed. {sentence(failure(row))}",)
    gap = difference(comparison, own, name)
    if gap is None:
        return (f"The learned policy was tried and gave no result to compare with “{name}”.",)
    if above_zero(gap):
        by = f"settles {number(gap.value * MM, 2, 'mm')} farther from the targets"
        likely = f"95 % interval {interval(gap.low, gap.high, 2, 'mm', factor=MM)}"
        return (f"The learned policy was tried and is not the best here: it {by} ({likely}) than “{name}”.",)
    return (f"The learned policy was tried and is not measurably better than the simpler “{name}”.",)


def _millimetres(spread: Spread | None) -> str:
    return UNKNOWN if spread is None else number(spread.mean.value * MM, 2 if spread.mean.value < 1e-3 else 3, "mm")


def _keys(contents: Contents, advice: Recommendation | None) -> tuple[KeyNumber, ...]:
    keys = []
    error = None if contents.diagnosis is None else mean_error(contents.diagnosis)
    if contents.diagnosis is not None and error is not None:
        healthy = contents.diagnosis.healthy
        at_targets = contents.diagnosis.open_loop is not None
        what = "missed its targets by, as found" if at_targets else "rested off its commands by, as found"
        note = "" if healthy is None else f"a healthy arm: {number(healthy.error_mm.value, 2, 'mm')}"
        likely = error_range(contents.diagnosis)
        note = "; ".join(part for part in (f"95 %: {likely}" if likely else "", note) if part)
        keys.append(KeyNumber(what, number(error.value, 3, "mm"), note))
    if advice is None or contents.comparison is None:
        return tuple(keys)
    best = contents.comparison.row(advice.controller)
    before = contents.comparison.row(BEFORE) if BEFORE in contents.comparison.controllers else None
    return (*keys, *_outcomes(best, before, contents.comparison), _tool(best, contents))


def _outcomes(best: ControllerRow, before: ControllerRow | None, comparison: Comparison) -> list[KeyNumber]:
    settled, name = best.hold.settled, best.controller
    likely = "" if settled is None else interval(settled.mean.low, settled.mean.high, 2, factor=MM)
    note = f"95 %: {likely}" if likely else "" if settled is None else NO_INTERVAL
    keys = [KeyNumber(f"settled error with “{name}”", _millimetres(settled), note)]
    success = number(best.crossing.success.value * PERCENT, 3, "%")
    was = "" if before is None else f"before: {number(before.crossing.success.value * PERCENT, 3, '%')}"
    keys.append(KeyNumber("targets reached", success, was))
    if best.crossing.cycle_time is not None:
        cycle = before and before.crossing.cycle_time
        was = f"before: {number(cycle.mean.value, 3, 's')}" if cycle else ""
        what = f"for {plural(len(comparison.targets[0]), 'target')}"
        keys.append(KeyNumber(what, number(best.crossing.cycle_time.mean.value, 3, "s"), was))
    return keys


def _tool(best: ControllerRow, contents: Contents) -> KeyNumber:
    """Give the true error with where it comes from."""
    true, old = best.hold.true_error, found(contents).tool
    if true.value is None:
        return KeyNumber("true error of the tool", UNKNOWN, "calibrate: it needs a measurement from outside")
    was = f"before: {number(old.value * MM, 3, 'mm')}; " if old.value is not None else ""
    how = HOW[true.how] + (f", 95 %: {true.range}" if true.how == "modelled" else "")
    return KeyNumber("true error of the tool", number(true.value * MM, 2, "mm"), f"{was}{how}")


def _summaries(contents: Contents, advice: Recommendation | None, sections: Sequence[Section]) -> tuple[Summary, ...]:
    blocks = [Summary("What was wrong", _wrong(contents)), Summary("What was done", _done(contents))]
    if advice is not None:
        blocks.append(Summary(f"Why “{advice.controller}”", advice.why))
    blocks.append(Summary("What is not known", _unknown(contents)))
    missing = tuple(sorted((section.missing for section in sections if section.missing), key=_turn))
    if missing:
        blocks.append(Summary("What is still to be done", missing))
    return tuple(block for block in blocks if block.lines)


def _turn(missing: str) -> int:
    """Tell when the stage that a section waits for has its turn."""
    return next((turn for turn, stage in enumerate(STAGES) if f"rejoint {stage}" in missing), len(STAGES))


def _wrong(contents: Contents) -> tuple[str, ...]:
    if contents.diagnosis is None:
        return ()
    felt = tuple(finding for finding in contents.diagnosis.findings if finding.felt)
    worst, ringing = felt[:4], ringing_most(felt)
    shown = worst if ringing is None or ringing in worst else (*worst, ringing)
    return tuple(finding.sentence for finding in shown) or ("No joint shows wear that its encoder can see.",)


def _done(contents: Contents) -> tuple[str, ...]:
    lines = []
    if contents.diagnosis is not None and contents.diagnosis.open_loop is not None:
        lines.append(
            f"Every joint was measured, and {plural(len(contents.diagnosis.open_loop.targets), 'target')} tried."
        )
    elif contents.diagnosis is not None and contents.diagnosis.evidence is not None:
        lines.append(f"Every joint was measured in logs of {plural(contents.diagnosis.evidence.motions, 'motion')}.")
    if contents.calibration is not None:
        lines.append(_calibrated(contents.calibration))
    if contents.twin is not None:
        held = contents.twin.held_out
        lines.append(
            "A digital twin was fitted: it predicts motion that it has not seen within "
            f"{number(held.twin.tcp * MM, 2, 'mm')} (without a twin: {number(held.no_twin.tcp * MM, 2, 'mm')})."
        )
    if contents.curves is not None:
        curves = contents.curves
        lines.append(
            f"A policy was trained in simulation: {cycles(curves.step[-1])} in {number(curves.wall_s[-1], 2, 's')}."
        )
    if contents.comparison is not None:
        comparison = contents.comparison
        trials = len(comparison.targets) * comparison.repetitions
        each = (
            "each, twice over: sent on at the first crossing, and held" if comparison.race is None else "at most, held"
        )
        way = "drove the arm" if comparison.race is None else "raced on the arm, until it was decided,"
        lines.append(
            f"{plural(len(comparison.rows), 'controller')} {way} to the same targets, "
            f"{plural(trials, 'trial')} of {plural(len(comparison.targets[0]), 'target')} {each}.{_stopped(comparison)}"
        )
    return tuple(lines)


def _calibrated(found: Calibration) -> str:
    """Say what was measured from outside, and what became of it."""
    errors = f"{number(found.before * MM, 2, 'mm')} from where the encoders see it"
    left = f"{number(found.after * MM, 2, 'mm')} from where the calibration does"
    used = "Targets are aimed at by it." if found.used else "That does not clearly help, so nothing is corrected."
    return (
        f"The tool was measured from outside {plural(found.points, 'time')}, with {measured_with(found.source)}: it "
        f"was {errors}, and {left}, each measurement predicted without its own posture. {used}"
    )


def _stopped(comparison: Comparison) -> str:
    names = [f"“{row.controller}”" for row in comparison.rows if row.out]
    return f" {listed(names, 'and')} {'was' if len(names) == 1 else 'were'} stopped on the way." if names else ""


def _unknown(contents: Contents) -> tuple[str, ...]:
    comparison, diagnosis = contents.comparison, contents.diagnosis
    lines = [
        "Every error marked “encoders” is what the arm believes. Play and flex behind the encoders stay invisible to "
        "it; only a calibration from outside takes part of them out."
    ]
    known = (comparison is not None and comparison.true_known) or (
        diagnosis is not None and diagnosis.open_loop is not None and diagnosis.open_loop.hidden_mm is not None
    )
    calibrated = contents.calibration
    if calibrated is not None and not known:
        lines.append(
            "The true error of the tool is modelled from the measurements of the calibration, and no better than they."
        )
    elif known:
        lines.append(
            "The true error of the tool is shown because this robot is emulated; on a real arm it is not known until "
            "the tool is measured from outside."
        )
    else:
        lines.append("The true error of the tool is not known on this arm: nobody has measured the tool from outside.")
    if contents.twin is not None and contents.twin.unknown:
        count = len(contents.twin.unknown)
        lines.append(
            f"{plural(count, 'parameter')} of the twin's {len(contents.twin.names)} could not be identified; training "
            "covered the range believed before."
        )
    return tuple(lines)
