"""Commands about the controllers themselves rather than about one arm: `rejoint research`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rejoint.arms import Arm, load_arm, mycobot280
from rejoint.cli import options as opt
from rejoint.cli.options import Call, argument, controller_names, option, takes
from rejoint.runs.run import Run
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.files import read_json, write_json
from rejoint.system.progress import part

if TYPE_CHECKING:
    from rejoint.research.evaluation.contestants import Contestant
    from rejoint.research.evaluation.summary import Evaluation

OUT = Path("runs") / "family"
CLASSICAL = "integrator,feedforward,tuned-integrator,tuned-feedforward,adaptive"
"""Controllers that take part by default"""

Policies = Annotated[list[Path] | None, option("Policy file; repeatable, such as one per seed.", "--policy")]
Variants = Annotated[str, option("Comma-separated conditions, or 'all'.")]
Arms = Annotated[int, option("Number of arms.", min=1)]
TargetCount = Annotated[int, option("Targets at which each arm is held.", "--targets", min=0)]
Crossings = Annotated[int, option("Targets of each arm in the protocol of Park et al. 2024; 0: without it.", min=0)]
Out = Annotated[Path, option("Folder for results; the same command resumes there.")]


@takes("arm")
def evaluate(
    call: Call,
    policy: Policies = None,
    controllers: Annotated[str, option("Comma-separated baselines and rivals, 'all' or 'none'.")] = CLASSICAL,
    variants: Variants = "all",
    arms: Arms = 100,
    targets: TargetCount = 5,
    crossings: Crossings = 10,
    gains: Annotated[Path | None, option("Gains of rivals instead of their own, from `rejoint research tune`.")] = None,
    out: Out = OUT,
    seed: opt.Seed = 0,
    threads: opt.Threads = 2,
) -> object:
    """Try controllers on a hundred arms on which nothing was chosen, and on the same under harder conditions.

    Example: `rejoint research evaluate --policy runs/a/policy.onnx --policy runs/b/policy.onnx`
    """
    arm = _arm(call)
    from rejoint.control.comparison.result import Protocol
    from rejoint.research.evaluation.contestants import known_names
    from rejoint.research.evaluation.evaluate import evaluate as run
    from rejoint.research.evaluation.family import VARIANTS, ArmFamily, find_variant
    from rejoint.research.evaluation.trials import TrialSettings

    names = {"all": known_names(), "none": ()}.get(controllers, controller_names(controllers))
    chosen = VARIANTS if variants == "all" else [find_variant(name) for name in controller_names(variants)]
    family = ArmFamily(arms=arms, targets=targets, crossings=crossings, seed=seed)
    settings = TrialSettings(family=family, protocol=Protocol(), threads=threads)
    with call.progress("evaluate") as update:
        found = run(arm, _contestants(arm, names, policy, gains), chosen, settings, out.resolve(), update)
    return _show(call, found, out)


@takes("arm")
def identification(
    call: Call,
    policy: Policies = None,
    arms: Arms = 6,
    targets: TargetCount = 5,
    crossings: Crossings = 10,
    iterations: Annotated[int | None, option("Updates of the trainings instead of the preset's.")] = None,
    out: Out = Path("runs") / "identified",
    seed: opt.Seed = 0,
    threads: opt.Threads = 2,
) -> object:
    """Find what a twin of its own brings: diagnose, identify and train for each arm, and try it with and without.

    Example: `rejoint research identification --arms 6 --policy runs/broad/policy.onnx`
    """
    arm = _arm(call)
    from rejoint.control.comparison.result import Protocol
    from rejoint.research.evaluation.family import ArmFamily
    from rejoint.research.evaluation.identification import evaluate_identification
    from rejoint.research.evaluation.trials import TrialSettings

    family = ArmFamily(arms=arms, targets=targets, crossings=crossings, seed=seed)
    settings = TrialSettings(family=family, protocol=Protocol(), threads=threads)
    with call.progress("identification") as update:
        found = evaluate_identification(arm, policy or [], settings, out, iterations, update)
    return _show(call, found, out)


@takes("arm")
def calibrate(
    call: Call,
    controller: Annotated[str, option("Baseline, rival or policy file that drives.")] = "shelf",
    variants: Variants = "all",
    arms: Arms = 100,
    targets: TargetCount = 5,
    out: Out = OUT,
    seed: opt.Seed = 0,
    threads: opt.Threads = 2,
) -> object:
    """Find what outside measurements bring: true errors of many arms before and after their calibration.

    Example: `rejoint research calibrate --arms 40 --targets 4`
    """
    arm, is_file = _arm(call), Path(controller).suffix == ".onnx"
    from rejoint.research.evaluation.calibrating import CONDITIONS, evaluate_calibrations, find_condition, tables
    from rejoint.research.evaluation.family import ArmFamily

    (one,) = _contestants(arm, [] if is_file else [controller], [Path(controller)] if is_file else [])
    conditions = CONDITIONS if variants == "all" else [find_condition(name) for name in controller_names(variants)]
    family = ArmFamily(arms=arms, targets=targets, seed=seed)
    with call.progress("calibrate") as update:
        found = evaluate_calibrations(arm, conditions, one, family, out.resolve(), threads, update)
    return _keep(call, found, out / "calibrated.json", tables(found))


@takes("arm")
def follow(call: Call, arms: Arms = 100, out: Out = OUT, seed: opt.Seed = 0, threads: opt.Threads = 2) -> object:
    """Let many arms follow standard paths, each with a twin of its own.

    Example: `rejoint research follow --arms 100 --seed 5`
    """
    arm = _arm(call)
    from rejoint.research.evaluation.family import ArmFamily
    from rejoint.research.evaluation.moving import evaluate_moving, moving_table

    with call.progress("follow") as update:
        found = evaluate_moving(arm, ArmFamily(arms=arms, seed=seed), out, threads, update)
    return _keep(call, found, out / "moving.json", [moving_table(found)])


@takes()
def tune(
    call: Call,
    rivals: Annotated[list[str], argument("tuned-integrator, tuned-feedforward, adaptive.", "RIVAL...")],
    run: Annotated[Path | None, option("Run whose twin is tuned on; without one, broad ranges.")] = None,
    generations: Annotated[int, option("Generations of CMA-ES.", min=1)] = 40,
    out: Annotated[Path, option("File of gains; those of other rivals in it stay.")] = Path("gains.json"),
    seed: opt.Seed = 0,
) -> object:
    """Tune classical rivals by CMA-ES on the randomised twins that policies are trained on.

    Example: `rejoint research tune tuned-feedforward`, then `rejoint research evaluate --gains gains.json`
    """
    require("rejoint research tune", "train")
    from rejoint.research.rivals.catalogue import find_rival
    from rejoint.research.rivals.tuning import TuningSettings, tune_rival
    from rejoint.training.ranges import BroadRanges, Ranges, identified_ranges
    from rejoint.twin.file import read_twin

    names, job = list(dict.fromkeys(rivals)), None if run is None else Run.open(run)
    for name in names:
        find_rival(name)
    arm = load_arm("mycobot280") if job is None else job.arm
    ranges: Ranges = BroadRanges(arm=arm)
    if job is not None:
        ranges = identified_ranges(arm, read_twin(job.folder.twin, arm))
    known = read_json(out, dict[str, dict[str, float]]) if out.exists() else {}
    how, tuned = TuningSettings(generations=generations, seed=seed), dict[str, dict[str, float]]()
    with call.progress("tune") as update:
        for k, name in enumerate(names):
            ahead = part(update, k / len(names), (k + 1) / len(names), f"{name}: ")
            tuned[name] = tune_rival(arm, ranges, how, name, ahead)
    write_json(out, known | tuned)
    rows = [
        {"rival": name, "gain": gain, "value": value} for name, gains in tuned.items() for gain, value in gains.items()
    ]
    call.table("Tuned gains", list(rows[0]), [[*map(str, one.values())] for one in rows])
    call.result(f"Next: rejoint research evaluate --controllers {','.join(names)} --gains {out}")
    return {"out": out, "gains": rows}


@takes()
def reproduce(
    call: Call,
    experiments: Annotated[
        list[str] | None, argument("Experiments, such as table-1 or fig-9; all by default.", "[EXPERIMENT]...")
    ] = None,
    run: Annotated[
        Path | None, option("Folder for the page and everything that is kept; by default below runs/.")
    ] = None,
    quick: opt.Quick = False,
    seed: opt.Seed = 0,
    threads: opt.Threads = 2,
) -> object:
    """Run the experiments of Park et al. 2024 and write a page with their numbers beside ours.

    Interrupted, the same command goes on where it stopped: trainings and trials are kept.

    Example: `rejoint research reproduce table-1 fig-9 fig-10`
    """
    require("rejoint research reproduce", "train", "report")
    from rejoint.research.reproduction.bench import FULL, QUICK, Bench
    from rejoint.research.reproduction.campaign import choose, run_experiments, write_page

    chosen = choose(experiments or ())
    folder = run or Path("runs") / f"reproduction{'-quick' * quick}-seed{seed}"
    scale = QUICK if quick else FULL
    with call.progress("reproduce") as update:
        bench = Bench(
            folder=folder.resolve(), arm=mycobot280(), seed=seed, scale=scale, threads=threads, on_progress=update
        )
        found = run_experiments(bench, chosen, lambda one: call.say(one.title))
    for one, finished in zip(chosen, found, strict=True):
        call.table(
            one.title, ["", "ours", "paper"], [(row.what, row.ours, row.paper or "-") for row in finished.numbers]
        )
    page = write_page(bench)
    call.result(str(page))
    rows = [{"experiment": one.experiment, **row._asdict()} for one in found for row in one.numbers]
    return {"page": page, "run": folder, "numbers": rows}


def _arm(call: Call) -> Arm:
    require("rejoint research", "train", "report")
    return load_arm(call.pick.source or "mycobot280")


def _contestants(
    arm: Arm, names: list[str] | tuple[str, ...], policies: list[Path] | None, gains: Path | None = None
) -> list[Contestant]:
    from rejoint.research.evaluation.contestants import classical, learned

    tuned = {} if gains is None else read_json(gains, dict[str, dict[str, float]])
    found = [classical(name, tuned) for name in names] + [learned(path, arm) for path in policies or []]
    if not found:
        raise InputError("no controller takes part; name --controllers or give a --policy")
    return found


Tables = list[tuple[str, list[str], list[list[str]]]]


def _keep(call: Call, found: object, file: Path, tables: Tables) -> object:
    write_json(file, found)
    for table in tables:
        call.table(*table)
    call.result(f"All of it: {file.resolve()}")
    return found


def _show(call: Call, found: Evaluation, out: Path) -> object:
    from rejoint.research.evaluation.page import terminal_tables

    for table in terminal_tables(found):
        call.table(*table)
    call.result(f"Page: {(out / 'evaluation.html').resolve()}")
    return {"out": out, "best": found.best, "rows": found.rows, "pairs": found.pairs}
