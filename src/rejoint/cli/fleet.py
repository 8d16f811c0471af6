"""Many arms in one command."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich import progress as bars

from rejoint.cli import options as opt
from rejoint.cli.console import Terminal
from rejoint.system.extras import require

if TYPE_CHECKING:
    from rejoint.runs.fleet.campaign import Campaign
    from rejoint.runs.fleet.drive import Event, Executor
    from rejoint.runs.fleet.file import FleetArm
    from rejoint.runs.fleet.rayexecutor import RayExecutor
    from rejoint.runs.fleet.result import FleetResult


def fleet(
    verb: Annotated[Literal["check", "repair"], typer.Argument(help="What is to be done with each arm.")],
    file: Annotated[Path, typer.Argument(help="File with the arms, see docs/fleet.md.", metavar="FLEET.toml")],
    only: Annotated[str, typer.Option(help="Comma-separated names of arms; by default all of the file.")] = "",
    somebody: Annotated[
        bool, typer.Option("--somebody-is-there", help="Somebody is there who can stop the arms that need that.")
    ] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Stay until the hours of all arms have come.")] = False,
    anew: Annotated[
        bool, typer.Option("--anew", help="Begin with all arms again, though an earlier call was cut short.")
    ] = False,
    needed: Annotated[
        bool, typer.Option("--needed", help="Check each arm first, and repair only those that the check says to.")
    ] = False,
    address: Annotated[
        str | None, typer.Option(help="Ray cluster HOST:PORT, or auto; by default this machine alone.")
    ] = None,
    cpus: Annotated[int | None, typer.Option(help="Processors of this machine to use; by default all.", min=1)] = None,
    training_cpus: Annotated[
        float, typer.Option(help="Processors that a training counts for; it runs two threads.", min=0.1)
    ] = 1.0,
    preset: opt.Preset = "default",
    controllers: opt.Controllers = "all",
    sets: opt.RepairSets = None,
    repetitions: opt.RepairRepetitions = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of the repairs; by default that of the run that goes on, or 0.", min=0)
    ] = None,
    quick: opt.Quick = False,
    json: opt.Json = False,
) -> None:
    """Check or repair many arms, each within its hours and with its permissions, and show them, the worst first.

    Interrupted or killed, the same command goes on: one step of each arm is lost at most, and no real arm moves again
    by itself. Exit code 0: nothing to do; 6 and 7: as for `check`, of the worst arm; 5: not all was done; others: an
    arm failed.

    Example: `rejoint fleet check FLEET.toml --somebody-is-there`
    """
    require(f"rejoint fleet {verb}", "fleet", "report", *(["train"] if verb == "repair" and address is None else []))
    from rejoint.runs.fleet.call import run_fleet
    from rejoint.runs.fleet.drive import Rules
    from rejoint.runs.fleet.file import read_fleet
    from rejoint.runs.fleet.rayexecutor import RayExecutor, has_token
    from rejoint.runs.fleet.work import RepairOptions

    terminal = Terminal(json=json)
    found = read_fleet(file)
    view = _FleetView(terminal)
    if address is not None and not has_token():
        terminal.say(
            f"warning: no token for Ray here: whoever reaches {address} may run programs there; see docs/fleet.md"
        )

    @contextmanager
    def make_executor(arms: Sequence[FleetArm]) -> Iterator[Executor]:
        executor = RayExecutor(arms, address=address, cpus=cpus, training_cpus=training_cpus)
        try:
            with view.watching(executor):
                yield executor
        finally:
            executor.close()

    options = RepairOptions(
        preset=preset, controllers=opt.controller_names(controllers), sets=sets, repetitions=repetitions, seed=seed,
        quick=quick, needed=needed,
    )  # fmt: skip
    rules = Rules(somebody=somebody, stay=wait)
    if address is None:  # all control loops run here
        rules = replace(rules, at_once=cpus or os.cpu_count() or 1)
    with terminal.unsaved(view.show_rows):
        result = run_fleet(
            found, verb, make_executor, rules, only=opt.controller_names(only) if only else (), options=options,
            anew=anew, tell=view.tell, begins=view.begins,
        )  # fmt: skip
    view.show_rows(result)
    if quick:
        terminal.say("A quick try: little of everything was done, so none of this is a result.")
    terminal.result(f"Page: {os.path.relpath(result.page)}")
    terminal.finish({"verb": verb, "rows": result.rows, "seconds": result.seconds, "page": result.page,
                     "finished": result.finished})  # fmt: skip
    if result.code:
        raise typer.Exit(result.code)


class _FleetView:
    """Shows all arms: a line for each step that ends, and on a terminal a bar for each arm that is at work."""

    def __init__(self, terminal: Terminal) -> None:
        self._terminal, self._executor = terminal, None  # type: Terminal, RayExecutor | None
        self._bars: bars.Progress | None = None
        self._tasks: dict[str, bars.TaskID] = {}
        self._steps: dict[str, str] = {}

    def begins(self, campaign: Campaign) -> None:
        """Say what is going to be done."""
        before = f", begun {campaign.info.begun:%Y-%m-%d %H:%M} UTC" if campaign.resumed else ""
        start = "Going on with the" if campaign.resumed else "Starting the"
        fleet = campaign.fleet
        self._terminal.say(f"{start} {campaign.verb} of {len(campaign.info.runs)} arms in {fleet.folder}{before}")

    def tell(self, event: Event) -> None:
        """Show something that happened."""
        name = event.arm.name
        if event.kind == "begun":
            self._steps[name] = event.step
            return
        self._steps.pop(name, None)
        if self._bars is not None and name in self._tasks:
            self._bars.remove_task(self._tasks.pop(name))
        took = f" in {event.seconds:.0f} s" if event.kind == "done" else ""
        why = f": {event.text}" if event.text else ""
        self._terminal.say(f"{name}: {event.step} {event.kind}{took}{why}")

    def show_rows(self, result: FleetResult) -> None:
        """Show what became of each arm."""
        from rejoint.runs.fleet.result import HEADERS

        self._terminal.table("All arms, the worst first", HEADERS, [row.cells for row in result.rows])
        for row in result.rows:
            self._terminal.result(f"{row.name}: {row.found}")

    @contextmanager
    def watching(self, executor: RayExecutor) -> Iterator[None]:
        """Show how far each arm is meanwhile, on a terminal."""
        with ExitStack() as stack:
            if self._terminal.notes.is_terminal:
                columns = (
                    bars.TextColumn("{task.description}"),
                    bars.BarColumn(),
                    bars.TextColumn("{task.fields[what]}"),
                )
                self._bars = stack.enter_context(bars.Progress(*columns, console=self._terminal.notes, transient=True))
                executor.watch(self._show)
            yield
        self._bars = None

    def _show(self, shares: dict[str, tuple[float, str]]) -> None:
        for name, (share, what) in shares.items():
            if self._bars is None or name not in self._steps:
                continue
            text = f"{name}: {self._steps[name]}"
            if name not in self._tasks:  # of hundreds of arms that have begun, few are at work
                self._tasks[name] = self._bars.add_task(text, total=1.0, what=what)
            self._bars.update(self._tasks[name], description=text, completed=share, what=what)
