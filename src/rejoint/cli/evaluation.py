"""Commands about the controllers themselves rather than about one arm."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rejoint.arms import load_arm
from rejoint.cli.console import Terminal
from rejoint.cli.options import Json, OnRay, RayAddress, Seed, controller_names, require_ray
from rejoint.runs.run import Run
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.files import read_json, write_json
from rejoint.system.progress import Progress, part

if TYPE_CHECKING:
    from rejoint.arms import Arm
    from rejoint.research.evaluation.evaluate import TrialCell
    from rejoint.research.evaluation.family import ArmFamily
    from rejoint.research.evaluation.result import Evaluation

OUT = Path("runs") / "family"


FAMILY_ONLY = ("controllers", "variants", "arms", "gains", "calibrate", "follow", "on", "address")
"""Options of `evaluate` that go with --family"""


def evaluate(
    context: typer.Context,
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
    ] = "integrator,feedforward,tuned-integrator,tuned-feedforward,adaptive",
    variants: Annotated[str, typer.Option(help="Comma-separated conditions, or 'all'.")] = "all",
    arms: Annotated[int, typer.Option(help="Number of arms.", min=1)] = 100,
    targets: Annotated[int, typer.Option(help="Targets at which each arm is held.", min=1)] = 5,
    gains: Annotated[
        Path | None, typer.Option(help="Gains of rivals instead of their own, from `rejoint tune`.")
    ] = None,
    crossing: Annotated[bool, typer.Option(help="Also run the protocol of Park et al. 2024 (ten targets).")] = True,
    out: Annotated[Path, typer.Option(help="Folder for results; the same command resumes there.")] = OUT,
    seed: Seed = 0,
    threads: Annotated[int, typer.Option(help="Threads of the simulation.", min=1)] = 2,
    on: OnRay = None,
    address: RayAddress = None,
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
    idle = ("iterations",) if family else FAMILY_ONLY
    for name in idle:
        source = context.get_parameter_source(name)
        if source is not None and source.name != "DEFAULT":
            raise InputError(f"--{name} does not go with {'--family' if family else '--identification'}; leave it out")
    terminal = Terminal(json=json)
    arm = load_arm("mycobot280")
    if identification is not None:
        few = ArmFamily(arms=identification, targets=targets, seed=seed)
        settings = TrialSettings(family=few, protocol=Protocol(), crossing=crossing, threads=threads)
        with terminal.progress("evaluating") as update:
            found = evaluate_identification(arm, policy or [], settings, out, iterations, update)
        _show(terminal, found, out)
        return
    if (follow or calibrate) and on is not None:
        raise InputError("--on ray goes with --family alone, without --follow and --calibrate; leave it out")
    require_ray(on, address)
    if follow:
        _follow(terminal, arm, context, ArmFamily(arms=arms, seed=seed), out, threads)
        return
    if calibrate:
        few = ArmFamily(arms=arms, targets=targets, seed=seed)
        _calibrate(terminal, arm, context, policy or [], controllers, variants, few, out, threads)
        return
    names = {"all": known_names(), "none": ()}.get(controllers, controller_names(controllers))
    tuned = {} if gains is None else read_json(gains, dict[str, dict[str, float]])
    contestants = [classical(name, tuned) for name in names] + [learned(path, arm) for path in policy or []]
    if not contestants:
        raise InputError("evaluate: nobody takes part; name --controllers or give a --policy")
    chosen = VARIANTS if variants == "all" else [find_variant(name) for name in controller_names(variants)]
    settings = TrialSettings(
        family=ArmFamily(arms=arms, targets=targets, seed=seed), protocol=Protocol(), crossing=crossing, threads=threads
    )
    with terminal.progress("evaluating") as update:
        elsewhere = None if on is None else _on_ray(update, address, threads)
        result = run(arm, contestants, chosen, settings, out.resolve(), update, elsewhere)
    _show(terminal, result, out)


def _on_ray(update: Progress, address: str | None, threads: int) -> Callable[[Sequence[TrialCell]], None]:
    """Return what has cells tried by Ray."""
    from rejoint.research.evaluation.evaluate import TrialCell
    from rejoint.runs.fleet.rayexecutor import RayTasks

    def tried(cells: Sequence[TrialCell]) -> None:
        def done(count: int) -> None:
            update(count / len(cells), f"{count} of {len(cells)} tried")

        with RayTasks(address) as tasks:
            tasks.each(TrialCell.leave_outcome, cells, done, cpus_each=threads)

    return tried


def tune(
    rivals: Annotated[
        list[str], typer.Argument(help="tuned-integrator, tuned-feedforward, adaptive.", metavar="RIVAL...")
    ],
    run: Annotated[Path | None, typer.Option(help="Run whose twin is tuned on; without one, broad ranges.")] = None,
    generations: Annotated[int, typer.Option(help="Generations of CMA-ES.", min=1)] = 40,
    out: Annotated[Path, typer.Option(help="File of gains; those of other rivals in it stay.")] = Path("gains.json"),
    seed: Seed = 0,
    on: OnRay = None,
    address: RayAddress = None,
    json: Json = False,
) -> None:
    """Tune classical rivals by CMA-ES on the randomised twins that policies are trained on.

    Example: `rejoint tune tuned-feedforward --out gains.json`, then `rejoint evaluate --family --gains gains.json`
    """
    require("rejoint tune", "train")
    require_ray(on, address)
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
    work = partial(tune_rival, arm, ranges, TuningSettings(generations=generations, seed=seed))
    count = len(names)
    with terminal.progress(f"tuning {', '.join(names)}") as update:
        if on is not None:
            from rejoint.runs.fleet.rayexecutor import RayTasks

            with RayTasks(address) as tasks:
                found = tasks.each(work, names, lambda done: update(done / count, f"{done} of {count} tuned"))
        else:
            found = [work(name, _shown_by(part(update, k / count, (k + 1) / count), generations))
                     for k, name in enumerate(names)]  # fmt: skip
    tuned = dict(zip(names, found, strict=True))
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
    terminal: Terminal, arm: Arm, context: typer.Context, policy: list[Path], controllers: str, variants: str,
    family: ArmFamily, out: Path, threads: int,
) -> None:  # fmt: skip
    from rejoint.research.evaluation.calibrated import conclude, tables
    from rejoint.research.evaluation.calibrating import CONDITIONS, find_condition, try_condition
    from rejoint.research.evaluation.contestants import classical, learned
    from rejoint.system.version import __version__

    source = context.get_parameter_source("controllers")
    chosen = source is not None and source.name != "DEFAULT" and controllers != "none"
    contestants = [learned(path, arm) for path in policy]
    contestants += [classical(name) for name in controller_names(controllers)] if chosen else []
    contestants = contestants or [classical("shelf")]  # what drives an arm before it is trained for
    if len(contestants) > 1:
        raise InputError(
            "evaluate --calibrate drives one controller: name one with --controllers, or give one --policy"
        )
    conditions = CONDITIONS if variants == "all" else [find_condition(name) for name in controller_names(variants)]
    with terminal.progress("evaluating") as update:
        trials = [
            try_condition(
                arm, one, contestants[0].make, family, threads,
                part(update, i / len(conditions), (i + 1) / len(conditions)),
            )
            for i, one in enumerate(conditions)
        ]  # fmt: skip
    result = conclude(arm.name, __version__, contestants[0].name, family, trials)
    write_json(out / "calibrated.json", result)
    for title, headers, rows in tables(result):
        terminal.table(title, headers, rows)
    terminal.result(f"All of it: {(out / 'calibrated.json').resolve()}")
    terminal.finish({"out": str(out), "rows": result.rows, "named": result.named, "accused": result.accused})


def _follow(terminal: Terminal, arm: Arm, context: typer.Context, family: ArmFamily, out: Path, threads: int) -> None:
    from rejoint.research.evaluation.moving import evaluate_moving, moving_table

    for name in ("controllers", "variants", "targets", "gains", "policy", "calibrate"):
        source = context.get_parameter_source(name)
        if source is not None and source.name != "DEFAULT":
            raise InputError(f"--{name} does not go with --follow, which tries its own cases; leave it out")
    with terminal.progress("evaluating") as update:
        result = evaluate_moving(arm, family, out, threads, update)
    write_json(out / "moving.json", result)
    terminal.table(*moving_table(result))
    terminal.result(f"All of it: {(out / 'moving.json').resolve()}")
    terminal.finish({"out": str(out), "rows": result.rows})


def _show(terminal: Terminal, result: Evaluation, out: Path) -> None:
    from rejoint.research.evaluation.tables import terminal_tables

    for title, headers, rows in terminal_tables(result):
        terminal.table(title, headers, rows)
    counted = f"{len(result.failures)} holds failed; they are listed one by one on the page"
    terminal.result(f"{counted}: {(out / 'evaluation.html').resolve()}")
    terminal.finish({"out": str(out), "best": result.best, "rows": result.rows, "pairs": result.pairs})
