"""Commands about the controllers themselves rather than about one arm.

The paper's experiments as one command.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rejoint.arms import load_arm, mycobot280
from rejoint.cli.console import Terminal
from rejoint.cli.options import ArmOption, Json, Seed, controller_names
from rejoint.runs.run import Run
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.files import read_json, write_json
from rejoint.system.progress import Progress, part

if TYPE_CHECKING:
    from rejoint.arms import Arm
    from rejoint.research.evaluation.family import ArmFamily
    from rejoint.research.evaluation.summary import Evaluation
    from rejoint.research.reproduction.experiment import Experiment, Finished

OUT = Path("runs") / "family"
CLASSICAL = "integrator,feedforward,tuned-integrator,tuned-feedforward,adaptive"
"""Controllers that take part by default"""


def evaluate(
    family: Annotated[
        bool, typer.Option("--family", help="On arms of the worn family that nothing was chosen on.")
    ] = False,
    identification: Annotated[
        int | None, typer.Option(help="On so many arms, each diagnosed, identified and trained for.", min=1)
    ] = None,
    calibrate: Annotated[
        bool, typer.Option("--calibrate", help="With --family: true errors before and after outside measurements.")
    ] = False,
    follow: Annotated[
        bool, typer.Option("--follow", help="With --family: paths that move, each arm with a twin of its own.")
    ] = False,
    iterations: Annotated[int | None, typer.Option(help="Updates of those trainings instead of the preset's.")] = None,
    policy: Annotated[list[Path] | None, typer.Option(help="Policy file; repeatable, such as one per seed.")] = None,
    controllers: Annotated[
        str,
        typer.Option(help="Comma-separated baselines and rivals, 'all' or 'none'; with --calibrate one, else 'shelf'."),
    ] = CLASSICAL,
    variants: Annotated[str, typer.Option(help="Comma-separated conditions, or 'all'.")] = "all",
    model: ArmOption = None,
    arms: Annotated[int, typer.Option(help="Number of arms.", min=1)] = 100,
    targets: Annotated[int, typer.Option(help="Targets at which each arm is held.", min=1)] = 5,
    gains: Annotated[
        Path | None, typer.Option(help="Gains of rivals instead of their own, from `rejoint tune`.")
    ] = None,
    crossing: Annotated[bool, typer.Option(help="Also run the protocol of Park et al. 2024 (ten targets).")] = True,
    out: Annotated[Path, typer.Option(help="Folder for results; the same command resumes there.")] = OUT,
    seed: Seed = 0,
    threads: Annotated[int, typer.Option(help="Threads of the simulation.", min=1)] = 2,
    json: Json = False,
) -> None:
    """Try controllers on a hundred arms on which nothing was chosen, and on the same under harder conditions.

    Example: `rejoint evaluate --family --policy runs/a/policy.onnx --policy runs/b/policy.onnx`, or what a twin of
    one's own buys: `rejoint evaluate --identification 6 --policy runs/broad/policy.onnx --out runs/identified`
    """
    require("rejoint evaluate", "train", "report")
    from rejoint.control.comparison.result import Protocol
    from rejoint.research.evaluation.contestants import classical, known_names, learned
    from rejoint.research.evaluation.evaluate import evaluate as run
    from rejoint.research.evaluation.family import VARIANTS, ArmFamily, find_variant
    from rejoint.research.evaluation.identification import evaluate_identification
    from rejoint.research.evaluation.trials import TrialSettings

    if family == (identification is not None):
        raise InputError("evaluate needs either --family or --identification N: the arms that controllers are tried on")
    terminal = Terminal(json=json)
    arm = load_arm(model or "mycobot280")
    if identification is not None:
        few = ArmFamily(arms=identification, targets=targets, seed=seed)
        settings = TrialSettings(family=few, protocol=Protocol(), crossing=crossing, threads=threads)
        with terminal.progress("evaluating") as update:
            found = evaluate_identification(arm, policy or [], settings, out, iterations, update)
        _show(terminal, found, out)
        return
    if follow:
        _follow(terminal, arm, ArmFamily(arms=arms, seed=seed), out, threads)
        return
    if calibrate:
        few = ArmFamily(arms=arms, targets=targets, seed=seed)
        _calibrate(terminal, arm, policy or [], controllers, variants, few, out, threads)
        return
    names = {"all": known_names(), "none": ()}.get(controllers, controller_names(controllers))
    tuned = {} if gains is None else read_json(gains, dict[str, dict[str, float]])
    contestants = [classical(name, tuned) for name in names] + [learned(path, arm) for path in policy or []]
    if not contestants:
        raise InputError("evaluate: no controller takes part; name --controllers or give a --policy")
    chosen = VARIANTS if variants == "all" else [find_variant(name) for name in controller_names(variants)]
    settings = TrialSettings(
        family=ArmFamily(arms=arms, targets=targets, seed=seed), protocol=Protocol(), crossing=crossing, threads=threads
    )
    with terminal.progress("evaluating") as update:
        result = run(arm, contestants, chosen, settings, out.resolve(), update)
    _show(terminal, result, out)


def tune(
    rivals: Annotated[
        list[str], typer.Argument(help="tuned-integrator, tuned-feedforward, adaptive.", metavar="RIVAL...")
    ],
    run: Annotated[Path | None, typer.Option(help="Run whose twin is tuned on; without one, broad ranges.")] = None,
    generations: Annotated[int, typer.Option(help="Generations of CMA-ES.", min=1)] = 40,
    out: Annotated[Path, typer.Option(help="File of gains; those of other rivals in it stay.")] = Path("gains.json"),
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Tune classical rivals by CMA-ES on the randomised twins that policies are trained on.

    Example: `rejoint tune tuned-feedforward --out gains.json`, then `rejoint evaluate --family --gains gains.json`
    """
    require("rejoint tune", "train")
    from rejoint.research.rivals.catalogue import find_rival
    from rejoint.research.rivals.tuning import TuningSettings, tune_rival
    from rejoint.training.ranges import BroadRanges, Ranges, identified_ranges
    from rejoint.twin.file import read_twin

    terminal, names = Terminal(json=json), list(dict.fromkeys(rivals))
    for name in names:
        find_rival(name)
    job = None if run is None else Run.open(run)
    arm = load_arm("mycobot280") if job is None else job.arm
    ranges: Ranges = BroadRanges(arm=arm)
    if job is not None:
        ranges = identified_ranges(arm, read_twin(job.folder.twin, arm))
    known = read_json(out, dict[str, dict[str, float]]) if out.exists() else {}
    how = TuningSettings(generations=generations, seed=seed)
    count = len(names)
    with terminal.progress(f"tuning {', '.join(names)}") as update:
        tuned = {
            name: tune_rival(arm, ranges, how, name, _shown_by(part(update, k / count, (k + 1) / count), generations))
            for k, name in enumerate(names)
        }
    write_json(out, known | tuned)
    for name, gains in tuned.items():
        terminal.table(name, ["gain", "value"], [[gain, f"{value:.3g}"] for gain, value in gains.items()])
    terminal.result(f"Next: rejoint evaluate --family --controllers {','.join(names)} --gains {out}")
    rows = [{"rival": name, "gains": gains, "out": str(out)} for name, gains in tuned.items()]
    terminal.finish(rows[0] if count == 1 else rows)


def _shown_by(update: Progress, generations: int) -> Callable[[int, float, Mapping[str, float]], None]:
    def report(done: int, cost: float, centre: Mapping[str, float]) -> None:  # noqa: ARG001 - too much for a line
        update(done / generations, f"cost {cost:.2f} s")

    return report


def _calibrate(
    terminal: Terminal,
    arm: Arm,
    policy: list[Path],
    controllers: str,
    variants: str,
    family: ArmFamily,
    out: Path,
    threads: int,
) -> None:
    from rejoint.research.evaluation.calibrating import CONDITIONS, evaluate_calibrations, find_condition, tables
    from rejoint.research.evaluation.contestants import classical, learned

    named = () if controllers in (CLASSICAL, "none") else controller_names(controllers)
    contestants = [learned(path, arm) for path in policy] + [classical(name) for name in named]
    contestants = contestants or [classical("shelf")]  # what drives an arm before it is trained for
    if len(contestants) > 1:
        raise InputError(
            "evaluate --calibrate drives one controller: name one with --controllers, or give one --policy"
        )
    conditions = CONDITIONS if variants == "all" else [find_condition(name) for name in controller_names(variants)]
    with terminal.progress("evaluating") as update:
        result = evaluate_calibrations(arm, conditions, contestants[0], family, out.resolve(), threads, update)
    write_json(out / "calibrated.json", result)
    for title, headers, rows in tables(result):
        terminal.table(title, headers, rows)
    terminal.result(f"All of it: {(out / 'calibrated.json').resolve()}")
    terminal.finish({"out": str(out), "rows": result.rows, "named": result.named, "accused": result.accused})


def _follow(terminal: Terminal, arm: Arm, family: ArmFamily, out: Path, threads: int) -> None:
    from rejoint.research.evaluation.moving import evaluate_moving, moving_table

    with terminal.progress("evaluating") as update:
        result = evaluate_moving(arm, family, out, threads, update)
    write_json(out / "moving.json", result)
    terminal.table(*moving_table(result))
    terminal.result(f"All of it: {(out / 'moving.json').resolve()}")
    terminal.finish({"out": str(out), "rows": result.rows})


def _show(terminal: Terminal, result: Evaluation, out: Path) -> None:
    from rejoint.research.evaluation.page import terminal_tables

    for title, headers, rows in terminal_tables(result):
        terminal.table(title, headers, rows)
    counted = f"{len(result.failures)} holds failed; they are listed one by one on the page"
    terminal.result(f"{counted}: {(out / 'evaluation.html').resolve()}")
    terminal.finish({"out": str(out), "best": result.best, "rows": result.rows, "pairs": result.pairs})


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
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Write finished experiments again from what they keep.")
    ] = False,
    threads: Annotated[int, typer.Option(help="Cores to use.", min=1)] = 2,
    seed: Seed = 0,
    json: Json = False,
) -> None:
    """Run the experiments of Park et al. 2024 and write a page with their numbers beside ours.

    Interrupted, the same command goes on where it stopped; what is finished is kept.

    Example: `rejoint reproduce table-1 fig-9 fig-10`
    """
    require("rejoint reproduce", "train", "report")
    from rejoint.research.reproduction.campaign import EXPERIMENTS, choose, run_experiments, write_page
    from rejoint.research.reproduction.experiment import FULL, QUICK, Bench

    terminal = Terminal(json=json)
    if list_:
        _list_experiments(terminal, EXPERIMENTS)
        return
    chosen = choose(experiments or ())
    folder = run or Path("runs") / f"reproduction{'-quick' if quick else ''}-seed{seed}"
    page = out or folder / PAGE
    with terminal.progress("reproducing") as update:
        bench = Bench(
            folder=folder.resolve(),
            arm=mycobot280(),
            seed=seed,
            scale=QUICK if quick else FULL,
            threads=threads,
            on_progress=update,
        )

        def announce(experiment: Experiment, finished: bool) -> None:
            terminal.say(f"{experiment.title}{' (already done)' if finished else ''}")

        found = run_experiments(bench, chosen, again=fresh, on_experiment=announce)
    for one, finished in zip(chosen, found, strict=True):
        _show_numbers(terminal, one, finished)
    terminal.result(str(write_page(bench, page)))
    terminal.finish({"page": str(page), "run": str(folder), "experiments": found})


def _list_experiments(terminal: Terminal, experiments: tuple[Experiment, ...]) -> None:
    rows = [(", ".join((one.name, *one.also)), one.about) for one in experiments]
    terminal.table("Experiments of Park et al. 2024", ["name", "what is run"], rows)
    terminal.finish([{"name": one.name, "also": one.also, "about": one.about} for one in experiments])


def _show_numbers(terminal: Terminal, experiment: Experiment, finished: Finished) -> None:
    rows = [(number.what, number.ours, number.paper or "-") for number in finished.findings.numbers]
    terminal.table(experiment.title, ["", "ours", "paper"], rows)
