"""The whole chain as one command."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import rejoint
from rejoint.arms import Arm
from rejoint.cli import options as opt
from rejoint.cli import show
from rejoint.cli.console import ConsoleObserver, Terminal, live_view
from rejoint.cli.measuring import gauge_by_word
from rejoint.cli.options import Call, takes
from rejoint.control.observer import Observer, Observers
from rejoint.diagnosis.calibration.procedure import TouchGauge
from rejoint.logs.runfolder.effort import read_effort
from rejoint.runs.run import Run, newest_or_new
from rejoint.session.settings import Settings
from rejoint.system.errors import UnsavedError
from rejoint.system.extras import require

if TYPE_CHECKING:
    from rejoint.pages.live.view import LiveView

TITLES = {
    "diagnose": "Diagnosis: ten targets open loop, then an excitation of every joint",
    "calibrate": "Calibration: where the tool really is, measured from outside",
    "identify": "Twin: fitting a simulation to this arm",
    "train": "Training: a policy on randomised copies of the twin",
    "gains": "Gains: what the servos' own loops can do",
    "compare": "Comparison: every controller on this arm, with the same targets",
    "report": "Report",
}
"""Heading of each stage"""


@takes("arm", "part", "live", "payload", "tool", "period", "dry_run")
def repair(
    call: Call,
    robot: str = "emulated:worn",
    run: Path | None = None,
    preset: str = "default",
    targets: Path | None = None,
    controllers: str = "all",
    measure: str | None = None,
    sets: int | None = None,
    repetitions: int | None = None,
    full: bool = False,
    seed: int = 0,
    quick: bool = False,
    fresh: bool = False,
) -> object:
    """Diagnose an arm, fit its twin, train a policy, compare every controller on the arm, and write the report."""
    require("rejoint repair", "train", "report")
    chosen = call.arm(robot)
    if call.settings.dry_run:
        with call.watched("repair") as observer:
            rehearse(robot, chosen, targets, call.settings, observer, quick=quick)
        return {"robot": robot}
    path, resumed = (run, run.exists()) if run else newest_or_new(robot, chosen, seed)
    job = Run.plan(path, robot, chosen, seed)
    call.say(f"{'Going on with' if resumed else 'Starting'} the repair of {robot} in {path}")
    gauge = gauge_by_word(call, robot, measure, seed)
    plan = rejoint.RepairPlan(
        preset=preset,
        controllers=opt.controller_names(controllers),
        targets=targets,
        gauge=gauge,
        fresh=fresh or None,
        trials=rejoint.TrialPlan(sets=sets, repetitions=repetitions, full=full),
    )
    with (
        live_view(call, call.live, "repair") as view,
        _Narrator(call, view, asking=isinstance(gauge, TouchGauge)) as narrator,
    ):
        observer = narrator if view is None else Observers(narrator, view)
        found = rejoint.repair(robot, run=job, quick=quick, plan=plan, settings=call.settings, observer=observer)
    page = Path(os.path.relpath(found.page))
    if quick:
        call.say("A quick try: little of everything was done, so none of this is a result.")
    from rejoint.pages.report.contents import before_after, read_contents

    errors = before_after(read_contents(path), found.recommendation.controller)
    spent = read_effort(job.folder)
    show.effort(call, spent)
    show.verdict(call, errors)
    call.result(str(page))
    return {
        "run": path,
        "recommended": found.recommendation,
        "policy": job.folder.policy,
        "report": page,
        "errors": errors,
        "effort": spent,
    }


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


class _Narrator(ConsoleObserver):
    """Shows the stages of a repair; none has a bar where it is ``asking`` at the terminal."""

    def __init__(self, terminal: Terminal, view: LiveView | None, *, asking: bool) -> None:
        super().__init__(terminal)
        self._view, self._asking, self._bar = view, asking, ExitStack()
        self._stage: rejoint.Stage | None = None

    def __enter__(self) -> _Narrator:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._bar.close()
        if isinstance(error, UnsavedError) and self._stage is not None:
            show.stage(self._terminal, self._stage.name, error.result)

    def stage(self, stage: object) -> None:
        """Show how a stage stands."""
        assert isinstance(stage, rejoint.Stage)  # noqa: S101 - for the type checker
        self._bar.close()
        if stage.state != "done":
            heading = f"{stage.number}/{stage.total}  {TITLES[stage.name]}"
            self._terminal.stage(heading)
            if self._view is not None:
                self._view.begin(heading)
        if stage.state == "kept":
            self._terminal.say(stage.why or f"already done, as it was asked for then: {stage.file}")
        if stage.state != "started":
            show.stage(self._terminal, stage.name, stage.result)
            return
        self._stage, self._progress = stage, None
        if not (self._asking and stage.name == "calibrate"):  # a bar would write over the questions
            self._progress = self._bar.enter_context(self._terminal.progress(stage.name))

    def progress(self, share: float, what: str) -> None:
        """Show how far the stage is, given how far all of them are."""
        if self._stage is not None:
            super().progress(self._stage.total * share - (self._stage.number - 1), what)
