"""The whole chain as one command."""

from __future__ import annotations

import os
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import rejoint
from rejoint.arms import Arm
from rejoint.cli import options as opt
from rejoint.cli import show
from rejoint.cli.console import Terminal, live_view, watched
from rejoint.cli.measuring import gauge_by_word
from rejoint.control.observer import Observer
from rejoint.control.robot import Robot
from rejoint.diagnosis.calibration.procedure import TouchGauge
from rejoint.logs.runfolder.effort import read_effort
from rejoint.runs.run import Run, newest_or_new
from rejoint.session.settings import Settings
from rejoint.system.errors import UnsavedError
from rejoint.system.extras import require
from rejoint.system.progress import Progress, no_progress

if TYPE_CHECKING:
    from rejoint.pages.live.view import LiveView

TITLES = {
    "diagnose": ("Diagnosis: ten targets open loop, then an excitation of every joint", "diagnosing"),
    "calibrate": ("Calibration: where the tool really is, measured from outside", "calibrating"),
    "identify": ("Twin: fitting a simulation to this arm", "identifying"),
    "train": ("Training: a policy on randomised copies of the twin", "training"),
    "gains": ("Gains: what the servos' own loops can do", "tuning"),
    "compare": ("Comparison: every controller on this arm, with the same targets", "comparing"),
    "report": ("Report", "reporting"),
}
"""Heading of each stage, and what is being done meanwhile"""


@opt.with_arm
@opt.with_settings("payload", "tool", "period", "dry_run")
def repair(
    robot: opt.Robot = "emulated:worn",
    run: opt.RunOption = None,
    preset: opt.Preset = "default",
    targets: opt.Targets = None,
    controllers: opt.Controllers = "all",
    measure: opt.Measure = None,
    sets: opt.RepairSets = None,
    repetitions: opt.RepairRepetitions = None,
    full: opt.Full = False,
    seed: opt.Seed = 0,
    live: opt.Live = None,
    quick: opt.Quick = False,
    fresh: Annotated[
        bool,
        typer.Option("--fresh", help="Keep no twin and policy of this arm's last repair, even if they still hold."),
    ] = False,
    json: opt.Json = False,
    *,
    pick: opt.ArmPick,
    settings: Settings,
) -> None:
    """Diagnose an arm, fit its twin, train a policy, compare every controller on the arm, and write the report.

    Interrupted, the same command goes on where it stopped. Nothing is changed on the arm itself.

    Example: `rejoint repair serial:///dev/ttyAMA0`
    """
    require("rejoint repair", "train", "report")
    terminal = Terminal(json=json, dry=settings.dry_run)
    chosen = opt.choose_arm(terminal, pick, robot)
    if settings.dry_run:
        with watched(terminal, "repair", "simulating", live) as observer:
            rehearse(robot, chosen, targets, settings, observer, quick=quick)
        terminal.finish({"robot": robot})
        return
    path, resumed = (run, run.exists()) if run else newest_or_new(robot, chosen, seed)
    job = Run.plan(path, robot, chosen, seed)
    terminal.say(f"{'Going on with' if resumed else 'Starting'} the repair of {robot} in {path}")
    gauge = gauge_by_word(terminal, robot, measure, seed)
    plan = rejoint.RepairPlan(
        preset=preset,
        controllers=opt.controller_names(controllers),
        targets=targets,
        gauge=gauge,
        fresh=fresh or None,
        trials=rejoint.TrialPlan(sets=sets, repetitions=repetitions, full=full),
    )
    with (
        live_view(terminal, live, "repair") as view,
        _Narrator(terminal, view, asking=isinstance(gauge, TouchGauge)) as narrator,
    ):
        found = rejoint.repair(robot, run=job, quick=quick, plan=plan, settings=settings, observer=narrator)
    page = Path(os.path.relpath(found.page))
    if quick:
        terminal.say("A quick try: little of everything was done, so none of this is a result.")
    from rejoint.pages.report.contents import before_after, read_contents

    errors = before_after(read_contents(path), found.recommendation.controller)
    spent = read_effort(job.folder)
    show.effort(terminal, spent)
    show.verdict(terminal, errors)
    terminal.result(str(page))
    terminal.finish(
        {
            "run": str(path),
            "recommended": found.recommendation,
            "policy": str(job.folder.policy),
            "report": str(page),
            "errors": errors,
            "effort": spent,
        }
    )


def rehearse(
    robot: str,
    arm: Arm | str | None,
    targets: Path | None,
    settings: Settings,
    observer: Observer,
    *,
    quick: bool = False,
) -> None:
    """Do the motions of a repair in a simulation."""
    rejoint.diagnose(robot, arm=arm, quick=quick, settings=settings, observer=observer)
    trials = rejoint.TrialPlan(sets=1, repetitions=1)
    rejoint.compare(robot, ["default"], targets, arm=arm, plan=trials, settings=settings, observer=observer)
    observer.message("The first is the diagnosis, the second the comparison of one controller with ten targets.")


class _Narrator(Observer):
    def __init__(self, terminal: Terminal, view: LiveView | None, *, asking: bool) -> None:
        self._terminal, self._view, self._bar, self._asking = terminal, view, ExitStack(), asking
        self.shows = view is not None
        self._stage: rejoint.Stage | None = None
        self._update: Progress = no_progress

    def __enter__(self) -> _Narrator:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._bar.close()
        if isinstance(error, UnsavedError) and self._stage is not None:
            show.stage(self._terminal, self._stage.name, error.result)

    def message(self, line: str) -> None:
        """Print a sentence."""
        self._terminal.say(line)

    def stage(self, stage: object) -> None:
        """Show how a stage stands."""
        assert isinstance(stage, rejoint.Stage)  # noqa: S101 - for the type checker
        self._bar.close()
        heading, doing = TITLES[stage.name]
        if stage.state != "done":
            self._terminal.stage(f"{stage.number}/{stage.total}  {heading}")
            if self._view is not None:
                self._view.begin(f"{stage.number}/{stage.total}  {heading}")
        if stage.state == "kept":
            self._terminal.say(stage.why or f"already done, as it was asked for then: {stage.file}")
        if stage.state == "started":
            asking = self._asking and stage.name == "calibrate"  # a bar would write over the questions
            bar = nullcontext(no_progress) if asking else self._terminal.progress(doing)
            self._stage, self._update = stage, self._bar.enter_context(bar)
        else:
            show.stage(self._terminal, stage.name, stage.result)

    def watch(
        self, robot: Robot, *, twin: object = None, within: float | None = None, paced: bool | None = None
    ) -> Robot:
        """Show the arm on the page, where there is one."""
        return robot if self._view is None else self._view.watch(robot, twin=twin, within=within, paced=paced)

    def progress(self, share: float, what: str) -> None:
        """Show how far the stage is, given how far all of them are."""
        if self._stage is not None:
            share = self._stage.total * share - (self._stage.number - 1)
            self._update(share, what)
            if self._view is not None:
                self._view.progress(share, what)
