"""The paper's experiments as one command."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rejoint.arms import mycobot280
from rejoint.cli.console import Terminal
from rejoint.cli.options import Json, OnRay, RayAddress, Seed, require_ray
from rejoint.system.extras import require

if TYPE_CHECKING:
    from rejoint.research.reproduction.experiment import Experiment, Finished

PAGE = "reproduction.md"


def reproduce(
    experiments: Annotated[
        list[str] | None, typer.Argument(help="Experiments, see --list; all by default.", metavar="[EXPERIMENT]...")
    ] = None,
    run: Annotated[
        Path | None, typer.Option("--run", help="Folder for everything that is kept; by default below runs/.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Page to write (.md), its figures beside it; by default reproduction.md in the folder of --run."
        ),
    ] = None,
    list_: Annotated[bool, typer.Option("--list", help="List the experiments and end.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Try every step with very little; no result.")] = False,
    again: Annotated[
        bool, typer.Option("--again", help="Write finished experiments anew from what they keep.")
    ] = False,
    threads: Annotated[int, typer.Option(help="Cores to use.", min=1)] = 2,
    seed: Seed = 0,
    on: OnRay = None,
    address: RayAddress = None,
    json: Json = False,
) -> None:
    """Run the experiments of Park et al. 2024 and write a page with their numbers beside ours.

    Interrupted, the same command goes on where it stopped; what is finished is kept.

    Example: `rejoint reproduce table-1 fig-9 fig-10`
    """
    require("rejoint reproduce", "train", "report")
    require_ray(on, address)
    from rejoint.research.reproduction.campaign import run_experiments
    from rejoint.research.reproduction.experiment import FULL, QUICK, Bench
    from rejoint.research.reproduction.page import write_page
    from rejoint.research.reproduction.registry import EXPERIMENTS, choose

    terminal = Terminal(json=json)
    if list_:
        _list(terminal, EXPERIMENTS)
        return
    chosen = choose(experiments or ())
    folder = run or Path("runs") / f"reproduction{'-quick' if quick else ''}-seed{seed}"
    page = out or folder / PAGE
    with terminal.progress("reproducing") as update, ExitStack() as stack:
        elsewhere = None
        if on is not None:
            from rejoint.runs.fleet.rayexecutor import RayTasks

            elsewhere = stack.enter_context(RayTasks(address))
        bench = Bench(
            folder=folder.resolve(), arm=mycobot280(), seed=seed, scale=QUICK if quick else FULL, threads=threads,
            on_progress=update,
        )  # fmt: skip

        def announce(experiment: Experiment, finished: bool) -> None:
            terminal.say(f"{experiment.title}{' (already done)' if finished else ''}")

        found = run_experiments(bench, chosen, again=again, on_experiment=announce, elsewhere=elsewhere)
    for one, finished in zip(chosen, found, strict=True):
        _show(terminal, one, finished)
    terminal.result(str(write_page(bench, page)))
    terminal.finish({"page": str(page), "run": str(folder), "experiments": found})


def _list(terminal: Terminal, experiments: tuple[Experiment, ...]) -> None:
    rows = [(", ".join((one.name, *one.also)), one.about) for one in experiments]
    terminal.table("Experiments of Park et al. 2024", ["name", "what is run"], rows)
    terminal.finish([{"name": one.name, "also": one.also, "about": one.about} for one in experiments])


def _show(terminal: Terminal, experiment: Experiment, finished: Finished) -> None:
    rows = [(number.what, number.ours, number.paper or "-") for number in finished.findings.numbers]
    terminal.table(experiment.title, ["", "ours", "paper"], rows)
