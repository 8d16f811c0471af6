"""What a repair came to: both errors, before and after, side by side and never mixed."""

from __future__ import annotations

from dataclasses import dataclass

from rejoint.control.accuracy import NOT_KNOWN, TrueError
from rejoint.control.comparison.result import Comparison
from rejoint.control.default import DefaultController
from rejoint.diagnosis.open_loop import modelled_errors
from rejoint.logs.runlog import read_log
from rejoint.pages.report.contents import Contents


@dataclass(frozen=True, kw_only=True)
class MeanErrors:
    """Mean distance from the targets."""

    encoders: float | None
    """[m] where the encoders see the tool"""
    tool: TrueError
    """where the tool itself is"""


@dataclass(frozen=True, kw_only=True)
class BeforeAfter:
    """An arm as it was found, and with a controller."""

    controller: str
    before: MeanErrors
    after: MeanErrors

    @property
    def sentence(self) -> str:
        """Both in one line for the owner; empty where one of them was not tried."""
        before, after = self.before, self.after
        if before.encoders is None or after.encoders is None:
            return ""
        start = f"Before: {1e3 * before.encoders:.1f} mm off (encoders)"
        end = f"After, with '{self.controller}': {1e3 * after.encoders:.2f} mm (encoders)"
        if before.tool.value is None and after.tool.value is None:
            return f"{start}. {end}. The tool itself: {after.tool}."
        return f"{start}, {_tool(before.tool, 'the tool itself')}. {end}, {_tool(after.tool, 'tool')}."


def _tool(error: TrueError, what: str) -> str:
    """Say a true error; one that is known needs no other word."""
    if error.value is None:
        return f"{what} {error}"
    ends = f", 95 %: {error.range}" if error.range and error.how != "known" else ""
    return f"{error.millimetres} mm ({what}{'' if error.how == 'known' else f', {error.how}'}{ends})"


def before_after(contents: Contents, controller: str) -> BeforeAfter | None:
    """Compare the arm as it was found with what ``controller`` does; None where none was compared."""
    if contents.comparison is None:
        return None
    return BeforeAfter(
        controller=controller, before=found(contents), after=_errors(contents.comparison, controller)
    )  # fmt: skip


def found(contents: Contents) -> MeanErrors:
    """Return the errors of the arm as it was found.

    With its own controller on the very targets of the comparison; where those were aimed by a calibration, open loop
    in the diagnosis, which was not.
    """
    own, comparison = DefaultController.name, contents.comparison
    if comparison is not None and own in comparison.controllers and not comparison.calibration:
        return _errors(comparison, own)
    if contents.diagnosis is None or contents.diagnosis.open_loop is None:
        return MeanErrors(encoders=None, tool=NOT_KNOWN)
    open_loop = contents.diagnosis.open_loop
    return MeanErrors(encoders=1e-3 * open_loop.error_mm.value, tool=_open_loop(contents))


def _open_loop(contents: Contents) -> TrueError:
    """Mean true error of the diagnosis: told then, or modelled by what the calibration found out later."""
    assert contents.diagnosis is not None and contents.diagnosis.open_loop is not None  # noqa: S101, PT018
    told = contents.diagnosis.open_loop.true_error
    log = contents.folder.log("targets")
    if told.value is not None or contents.calibration is None or not log.exists():
        return told
    return modelled_errors(read_log(log), contents.calibration)


def _errors(comparison: Comparison, controller: str) -> MeanErrors:
    hold = comparison.row(controller).hold
    return MeanErrors(encoders=None if hold.settled is None else hold.settled.mean.value, tool=hold.true_error)
