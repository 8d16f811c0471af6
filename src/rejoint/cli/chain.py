"""The whole chain as one command."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from rejoint.cli import options as opt
from rejoint.cli import show
from rejoint.cli.console import Terminal
from rejoint.diagnosis.diagnosis import Diagnosis
from rejoint.robots import place_of
from rejoint.runs import opening
from rejoint.runs import stages as work
from rejoint.runs.comparison.recommend import Recommendation, recommend
from rejoint.runs.comparison.result import Comparison
from rejoint.system.extras import require
from rejoint.system.files import read_json


def repair(
    robot: opt.Robot = "emulated:worn",
    run: opt.RunOption = None,
    arm: opt.ArmOption = None,
    base: opt.Base = None,
    tip: opt.Tip = None,
    preset: opt.Preset = "default",
    targets: opt.Targets = None,
    controllers: opt.Controllers = "all",
    sets: Annotated[int | None, typer.Option(help="Target sets to compare on (3 emulated, 1 real).", min=1)] = None,
    repetitions: Annotated[int | None, typer.Option(help="Repetitions of each (2 emulated, 1 real).", min=1)] = None,
    period: opt.Period = None,
    seed: opt.Seed = 0,
    json: opt.Json = False,
) -> None:
    """Diagnose an arm, fit its twin, train a policy, compare every controller on the arm, and write the report.

    Interrupted, the same command goes on where it stopped. Nothing is changed on the arm itself.

    Example: `rejoint repair serial:///dev/ttyAMA0`
    """
    require("rejoint repair", "train", "report")
    terminal = Terminal(json=json)
    virtual = place_of(robot).virtual
    trials = work.Trials(
        controllers=opt.controller_names(controllers), file=targets,
        sets=sets or (3 if virtual else 1), repetitions=repetitions or (2 if virtual else 1),
    )  # fmt: skip
    chosen = opt.choose_arm(terminal, arm, base, tip, robot)
    path, resumed = (run, run.exists()) if run else opening.newest_or_new(robot, chosen, seed)
    job = opening.begin(path, robot, chosen, seed)
    terminal.say(f"{'Going on with' if resumed else 'Starting'} the repair of {robot} in {path}")
    chain = _Chain(terminal, job, opt.period_seconds(period))
    diagnosis = chain.diagnose()
    chain.identify()
    chain.train(preset)
    comparison, advice = chain.compare(robot, trials)
    report = chain.report()
    opening.finish(job)
    show.verdict(terminal, diagnosis, comparison, advice)
    terminal.result(str(report))
    terminal.finish({"run": str(path), "recommended": advice, "policy": str(job.folder.policy), "report": str(report)})


class _Chain:
    """Stages that are done only where their file is not there yet."""

    def __init__(self, terminal: Terminal, job: opening.Run, period: work.Period | None) -> None:
        self.terminal, self.job, self.period = terminal, job, period

    def diagnose(self) -> Diagnosis:
        self.terminal.stage("1/5  Diagnosis: ten targets open loop, then an excitation of every joint")
        if self._done(self.job.folder.diagnosis):
            result = read_json(self.job.folder.diagnosis, Diagnosis)
        else:
            told = self.terminal.unsaved(lambda unsaved: show.diagnosis(self.terminal, unsaved))
            with told, self.terminal.progress("diagnosing") as update:
                result = work.diagnose_stage(self.job, period=self.period, on_progress=update)
        show.diagnosis(self.terminal, result)
        return result

    def identify(self) -> None:
        self.terminal.stage("2/5  Twin: fitting a simulation to this arm")
        if self._done(self.job.folder.twin):
            return
        with self.terminal.progress("identifying") as update:
            twin = work.identify_stage(self.job, on_progress=update)
        show.twin(self.terminal, twin)

    def train(self, preset: str) -> None:
        self.terminal.stage("3/5  Training: a policy on randomised copies of the twin")
        if self._done(self.job.folder.policy):
            return
        with self.terminal.progress("training") as update:
            result = work.train_stage(self.job, preset=preset, on_progress=update)
        show.training(self.terminal, result)

    def compare(self, robot: str, trials: work.Trials) -> tuple[Comparison, Recommendation]:
        self.terminal.stage("4/5  Comparison: every controller on this arm, with the same targets")
        if self._done(self.job.folder.comparison):
            result = read_json(self.job.folder.comparison, Comparison)
            found = (result, recommend(result))
        else:
            told = self.terminal.unsaved(lambda unsaved: show.comparison(self.terminal, *unsaved))
            with told, self.terminal.progress("comparing") as update:
                found = work.compare_stage(self.job, robot, trials, period=self.period, on_progress=update)
        show.comparison(self.terminal, *found)
        return found

    def report(self) -> Path:
        self.terminal.stage("5/5  Report")
        return Path(os.path.relpath(work.report_stage(self.job)))

    def _done(self, path: Path) -> bool:
        if path.exists():
            self.terminal.say(f"already done, as it was asked for then: {path}")
        return path.exists()
