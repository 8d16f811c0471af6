"""The servos' own gains: searched for, and kept if their owner says so."""

from __future__ import annotations

from typing import Annotated

import typer

import rejoint
from rejoint.cli import options as opt
from rejoint.cli import show
from rejoint.cli.console import Terminal
from rejoint.control.servogains import in_words
from rejoint.runs.run import Run
from rejoint.runs.stages.gains import gains_to_keep, keep_gains
from rejoint.system.errors import InputError
from rejoint.system.shell import command


def gains(
    robot: opt.Robot,
    run: opt.Run,
    keep: Annotated[
        bool, typer.Option("--keep", help="Write the gains that RUN recommends into the servos' memory, for good.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before --keep.")] = False,
    period: opt.Period = None,
    json: opt.Json = False,
) -> None:
    """Search for better gains of an SO-101's own servos, on the arm; what is found takes part in `rejoint compare`.

    Nothing is kept over a loss of power, and the gains before are put back, also after Ctrl-C. --keep alone writes the
    servos' memory, and says before what.

    Example: `rejoint gains feetech:///dev/ttyACM0 runs/mine`, and after `rejoint compare`
    `rejoint gains feetech:///dev/ttyACM0 runs/mine --keep`
    """
    terminal = Terminal(json=json)
    if not keep:
        with terminal.progress("tuning") as update:
            found = rejoint.gains(robot, run, period=opt.period_seconds(period), on_progress=update)
        show.stage(terminal, "gains", found)
        terminal.result(f"Next: {command('compare', robot, run)} --sets 1 --repetitions 1")
        terminal.finish({"run": str(run), "gains": found})
        return
    job = Run.open(run)
    wanted = gains_to_keep(job)
    terminal.say(
        f"This writes {in_words(wanted)} into the memory of the {job.arm.joints} servos of {robot}: they keep that "
        "without power, until something else is written. LeRobot writes its own P, I and D whenever it connects. "
        "Policies that were trained under other gains are refused from then on, and the twin of this run is that of "
        "the gains before."
    )
    if not yes and not typer.confirm("Write it?", err=True):
        raise InputError("nothing was written; say --yes to be asked no more")
    before = keep_gains(robot, job, wanted)
    terminal.result(f"Kept: {in_words(wanted)}. Before: {in_words(before)}.")
    terminal.result(f"Next: {command('repair', robot)}, for a twin and a policy under these gains")
    terminal.finish({"run": str(run), "kept": wanted, "before": before})
