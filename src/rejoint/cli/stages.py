"""One command per stage.

The servos' own gains: searched for, and kept if their owner says so.
"""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import rejoint
from rejoint.arms import load_arm
from rejoint.cli import offline, show
from rejoint.cli import options as opt
from rejoint.cli.console import Terminal, results_of, watched
from rejoint.control.deployment import REACHED
from rejoint.control.servogains import in_words
from rejoint.logs.runfolder.effort import read_effort
from rejoint.logs.runfolder.folder import LOGS, RunFolder, locked
from rejoint.runs.run import Run, newest_or_new
from rejoint.runs.stages.gains import gains_to_keep, keep_gains
from rejoint.session.settings import KeptSettings, Settings
from rejoint.system.errors import InputError, NotReachedError
from rejoint.system.extras import EXTRAS, installed, require
from rejoint.system.shell import command

if TYPE_CHECKING:
    from rejoint.training.train import Trainer

MISSED = 5
"""Exit code of a deployment that did not reach all of its targets, and of a path that was not followed"""


@opt.with_arm
@opt.with_settings("payload", "tool", "period", "dry_run")
def diagnose(
    robot: opt.OptionalRobot = None,
    logs: opt.LogsOption = None,
    run: opt.RunOption = None,
    healthy: Annotated[
        Path | None, typer.Option(help="Run folder of an arm known to be good, instead of an emulated healthy one.")
    ] = None,
    seed: opt.Seed = 0,
    quick: opt.Quick = False,
    live: opt.Live = None,
    json: opt.Json = False,
    *,
    pick: opt.ArmPick,
    settings: Settings,
) -> None:
    """Find out what is wrong with an arm: ten targets open loop and an excitation, or from logs of any motion alone.

    Example: `rejoint diagnose tcp://192.168.1.20:9000 --run runs/mine`, or
    `rejoint diagnose --logs logs/so101 --arm so101 --run runs/mine`
    """
    terminal = Terminal(json=json, dry=settings.dry_run)
    if logs is not None:
        if robot is not None or settings.dry_run or KeptSettings.of(settings).given():
            raise InputError("diagnose takes either a robot or --logs FOLDER, and --logs no settings of a motion")
        job = opt.run_of_logs(terminal, logs, run, seed, pick)
        offline.diagnose_from_logs(terminal, job, logs, healthy)
        return
    robot = robot or "emulated:worn"
    chosen = opt.choose_arm(terminal, pick, robot)
    path = run or newest_or_new(robot, chosen, seed)[0]
    job = Run.plan(path, robot, chosen, seed)
    with (
        terminal.unsaved(partial(show.stage, terminal, "diagnose")),
        watched(terminal, "diagnose", "diagnosing", live) as observer,
    ):
        found = rejoint.diagnose(robot, run=job, healthy=healthy, quick=quick, settings=settings, observer=observer)
    if settings.dry_run:
        terminal.finish({"robot": robot})
        return
    show.stage(terminal, "diagnose", found)
    terminal.next(command("identify", path))
    open_loop = found.diagnosis.open_loop
    told = None if open_loop is None else open_loop.true_error
    terminal.finish(
        {
            "run": str(path),
            "diagnosis": found.diagnosis,
            "true_error": told,
            "effort": read_effort(RunFolder(path)),
        }
    )


@opt.with_arm
def identify(
    run: Annotated[Path | None, typer.Argument(help="Run folder.", metavar="RUN")] = None,
    logs: opt.LogsOption = None,
    folder: opt.RunOption = None,
    published: offline.Published = None,
    hold_out: offline.HeldOut = None,
    gain: offline.Gain = None,
    torque_off: offline.TorqueOff = None,
    seed: opt.RunSeed = None,
    quick: opt.Quick = False,
    json: opt.Json = False,
    *,
    pick: opt.ArmPick,
) -> None:
    """Fit a digital twin to the excitation log of a run, or to logs of any motion alone, and then write the report.

    Example: `rejoint identify runs/mine`, or `rejoint identify --logs logs/so101 --arm so101 --run runs/so101`
    """
    terminal = Terminal(json=json)
    if (run is None) == (logs is None):
        raise InputError("identify takes either a run folder or --logs FOLDER")
    require("rejoint identify", "train", *(() if logs is None else ("report",)))  # logs end in a report at once
    if logs is not None:
        job = opt.run_of_logs(terminal, logs, folder, seed or 0, pick)
        offline.identify_from_logs(terminal, job, logs, published, hold_out, gain, torque_off)
        return
    if folder is not None or published or hold_out or gain or torque_off:
        raise InputError(
            "--run, --published, --hold-out, --gain and --torque-off go with --logs; without it, name the run folder "
            "alone"
        )
    assert run is not None  # noqa: S101 - for the type checker; one of the two is given
    job = Run.open(run)
    with watched(terminal, "identify", "identifying", None) as observer:
        twin = rejoint.identify(run=job, seed=seed, quick=quick, observer=observer)
    show.twin(terminal, twin)
    terminal.next(command("train", run))
    terminal.finish({"run": str(run), "twin": str(job.folder.twin), "held_out": twin.held_out, "notes": twin.notes})


def train(
    run: opt.Run,
    preset: opt.Preset = "default",
    learner: Annotated[str, typer.Option(help="ppo; or its rivals sac, td3 and ddpg, on the default preset.")] = "ppo",
    generic: Annotated[
        bool,
        typer.Option("--generic", help="Without a twin: a policy for any worn arm of this kind; RUN may be new."),
    ] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Forget an interrupted training.")] = False,
    seed: opt.RunSeed = None,
    quick: opt.Quick = False,
    json: opt.Json = False,
) -> None:
    """Train a policy on randomised copies of the run's twin.

    Example: `rejoint train runs/mine`
    """
    require("rejoint train", "train", "report")
    terminal = Terminal(json=json)
    if generic and RunFolder(run).twin.exists():
        raise InputError(f"{run} has a twin.toml, and --generic trains without one: choose another folder")
    if generic and not run.exists():
        Run.create(run, "emulated:worn", load_arm("mycobot280"), seed or 0)
    job = Run.open(run).seeded(seed)
    trainer = None if learner == "ppo" else _off_policy(learner, preset, job.seed)
    from rejoint.pages.report.page import draw_training

    how = rejoint.TrainSettings(generic=generic, resume=not fresh, trainer=trainer)
    with watched(terminal, "train", "training", None) as observer:
        result = rejoint.train(run=job, preset=preset, quick=quick, settings=how, observer=observer).training
    with locked(job.folder):
        terminal.say(f"Curves: {draw_training(job.folder)}")
    show.training(terminal, result)
    robot = "ROBOT" if job.robot.startswith(LOGS) else job.robot  # logs cannot be driven
    terminal.next(command("compare", robot, run))
    terminal.finish(result)


def _off_policy(learner: str, preset: str, seed: int) -> Trainer:
    if preset != "default":
        raise InputError(f"--preset {preset} is a recipe of PPO; {learner} trains on the default one: leave it out")
    from rejoint.research.offpolicy import trainer

    return trainer(learner, seed)


@opt.with_settings("calibration", "payload", "tool", "period", "seed", "dry_run")
def compare(
    robot: opt.Robot,
    run: opt.Run,
    targets: opt.Targets = None,
    controllers: opt.Controllers = "all",
    sets: Annotated[
        int | None, typer.Option(help="Target sets of ten targets each; by default 10, on a real arm 1.", min=1)
    ] = None,
    repetitions: Annotated[
        int | None, typer.Option(help="Repetitions of every target set; by default 6, on a real arm 1.", min=1)
    ] = None,
    full: opt.Full = False,
    directions: Annotated[
        bool, typer.Option("--directions", help="Also come to five poses from three directions: vAP (ISO 9283).")
    ] = False,
    live: opt.Live = None,
    json: opt.Json = False,
    *,
    settings: Settings,
) -> None:
    """Try every controller on the same arm with the same targets; on a real arm those clearly worse are eliminated.

    Example: `rejoint compare emulated:worn runs/mine --sets 10 --repetitions 6`
    """
    terminal = Terminal(json=json, dry=settings.dry_run)
    plan = rejoint.TrialPlan(sets=sets, repetitions=repetitions, directions=directions, full=full)
    with (
        terminal.unsaved(partial(show.stage, terminal, "compare")),
        watched(terminal, "compare", "comparing", live) as observer,
    ):
        found = rejoint.compare(
            robot, opt.controller_names(controllers), targets, run=run, plan=plan, settings=settings, observer=observer
        )
    show.stage(terminal, "compare", found)
    terminal.next(command("report", run))
    terminal.finish(
        {
            "run": str(run),
            "recommended": found.recommendation,
            "comparison": results_of(found.comparison, "results"),
            "true_error": {row.controller: row.true_error for row in found.comparison.rows},
            "effort": read_effort(RunFolder(run)),
        }
    )


@opt.with_arm
@opt.with_settings(
    "controller", "dwell", "within", "calibration", "payload", "tool", "camera", "period", "seed", "dry_run"
)
def deploy(
    robot: opt.Robot,
    run: Annotated[Path | None, typer.Argument(help="Run folder, if there is one.", metavar="RUN")] = None,
    targets: opt.Targets = None,
    live: opt.Live = None,
    json: opt.Json = False,
    *,
    pick: opt.ArmPick,
    settings: Settings,
) -> None:
    """Drive an arm to targets with the trained policy (or another controller); ten random ones by default.

    The arm is looked at first and goes slowly to its rest posture. Exit code 5: not all targets were reached.

    Example: `rejoint deploy tcp://192.168.1.20:9000 runs/mine --targets points.csv`; before any repair
    `rejoint deploy tcp://192.168.1.20:9000`
    """
    if run is not None and any(pick):
        raise InputError("deploy takes the arm from RUN; leave out --arm, --base, --tip and --hold")
    terminal = Terminal(json=json, dry=settings.dry_run)
    chosen = None if run is not None else opt.choose_arm(terminal, pick, robot)
    within = REACHED if settings.within is None else settings.within
    tell = partial(show.deployment, terminal, within)
    with (
        terminal.unsaved(tell),
        watched(terminal, "deploy", "deploying", live, tell) as observer,
    ):
        done = rejoint.deploy(robot, targets, run=run, arm=chosen, settings=settings, observer=observer)
    tell(done)
    errors = [None if visit.error is None else 1e3 * visit.error for visit in done.visits]
    turned = [None if visit.turned is None else math.degrees(visit.turned) for visit in done.visits]
    posed = any(visit.orientation for visit in done.visits)
    terminal.finish(
        {
            "run": run and str(run),
            "controller": done.controller,
            "error_mm": errors,
            "missed": done.missed,
            **({"turned_deg": turned} if posed else {}),
            "visits": results_of(done.visits),
            "period": done.period,
            "gaps": done.gaps,
        }
    )
    if done.missed and not settings.dry_run:
        raise typer.Exit(MISSED)


@opt.with_settings("controller", "within", "calibration", "payload", "tool", "period", "seed", "dry_run")
def goto(
    robot: opt.Robot,
    x: Annotated[float, typer.Argument(help="mm in the arm's base frame.", metavar="X")],
    y: Annotated[float, typer.Argument(help="mm in that frame.", metavar="Y")],
    z: Annotated[float, typer.Argument(help="mm in that frame.", metavar="Z")],
    run: opt.RunOption = None,
    arm: opt.ArmOption = None,
    timeout: Annotated[float, typer.Option(help="Time in seconds in which to arrive.", min=0.1)] = 10.0,
    live: opt.Live = None,
    json: opt.Json = False,
    *,
    settings: Settings,
) -> None:
    """Move the tool to one point, and hold it there.

    The arm is looked at first and goes slowly to its rest posture. Exit code 5: the point was not reached.

    Example: `rejoint goto tcp://192.168.1.20:9000 180 30 210 --run runs/mine`
    """
    terminal = Terminal(json=json, dry=settings.dry_run)
    target = opt.point_of(x, y, z)
    with (
        watched(terminal, "goto", "going", live) as observer,
        rejoint.connect(robot, run=run, arm=arm, settings=settings, observer=observer) as session,
    ):
        code = 0
        try:
            found = session.move_to(target, timeout_s=timeout)
        except NotReachedError as error:
            found, code = session.state, 0 if settings.dry_run else MISSED
            terminal.result(f"Not reached: {error}")
    error_mm = None if found is None or found.error_m is None else 1e3 * found.error_m
    if error_mm is not None and found is not None and not code:
        place = ", ".join(f"{1e3 * value:.1f}" for value in found.tool_m)
        terminal.result(f"The tool is at ({place}) mm, {error_mm:.2f} mm off by the encoders.")
    terminal.finish({"target_mm": [x, y, z], "error_mm": error_mm, "reached": not code})
    if code:
        raise typer.Exit(code)


@opt.with_settings("controller", "within", "calibration", "payload", "tool", "period", "seed", "dry_run")
def follow(
    robot: opt.Robot,
    run: opt.Run,
    path: Annotated[
        str,
        typer.Argument(
            help="CSV file time,x,y,z in s and mm, perhaps an orientation; or circle-8s, random-0.2hz and the like."
        ),
    ],
    repeat: Annotated[int, typer.Option(help="How often; each time it learns from the last.", min=1)] = 1,
    rate: Annotated[
        float | None, typer.Option(help="Tell the path as it goes, so many times a second, instead of ahead.")
    ] = None,
    live: opt.Live = None,
    json: opt.Json = False,
    *,
    settings: Settings,
) -> None:
    """Drive an arm along a path, and say how well it followed.

    The arm is looked at first, goes slowly to its rest posture and to the start of the path. Exit code 5: not followed.

    Example: `rejoint follow tcp://192.168.1.20:9000 runs/mine drawing.csv`, or
    `rejoint follow emulated:worn runs/mine circle-8s --repeat 5`
    """
    terminal = Terminal(json=json, dry=settings.dry_run)
    with watched(terminal, "follow", "following", live) as observer:
        done = rejoint.follow(robot, path, run=run, repeat=repeat, rate_hz=rate, settings=settings, observer=observer)
    show.followed(terminal, done)
    if all(map(installed, EXTRAS["report"])) and not settings.dry_run:
        from rejoint.pages.report.figures import draw_followed

        job = Run.open(run)
        with locked(job.folder):
            terminal.say(f"Path: {draw_followed(job.folder, job.arm, done)}")
    terminal.finish(
        {
            "run": str(run),
            "path": done.path,
            "controller": done.controller,
            "followed": done.followed,
            "passes": results_of(
                [{"encoder": one.encoder, "true_error": one.true_error, "turned": one.turned} for one in done.passes]
            ),
            "period": done.period,
            "gaps": done.gaps,
        }
    )
    if not (done.followed or settings.dry_run):
        raise typer.Exit(MISSED)


def report(run: opt.Run, json: opt.Json = False) -> None:
    """Write the report of a run: one self-contained page that opens in a browser.

    Example: `rejoint report runs/mine`
    """
    require("rejoint report", "report")

    terminal = Terminal(json=json)
    path = rejoint.report(run).resolve()
    terminal.result(str(path))
    terminal.finish({"run": str(run), "report": str(path)})


@opt.with_settings("period", "dry_run")
def gains(
    robot: opt.Robot,
    run: opt.Run,
    keep: Annotated[
        bool, typer.Option("--keep", help="Write the gains that RUN recommends into the servos' memory, for good.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before --keep.")] = False,
    json: opt.Json = False,
    *,
    settings: Settings,
) -> None:
    """Search for better gains of an SO-101's own servos, on the arm; what is found takes part in `rejoint compare`.

    Nothing is kept over a loss of power, and the gains before are put back, also after Ctrl-C. --keep alone writes the
    servos' memory, and says before what.

    Example: `rejoint gains feetech:///dev/ttyACM0 runs/mine`, and after `rejoint compare`
    `rejoint gains feetech:///dev/ttyACM0 runs/mine --keep`
    """
    terminal = Terminal(json=json, dry=settings.dry_run)
    if not keep:
        with watched(terminal, "gains", "tuning", None) as observer:
            found = rejoint.gains(robot, run, settings=settings, observer=observer)
        if not settings.dry_run:  # a simulation does not heed gains
            show.stage(terminal, "gains", found)
        terminal.next(f"{command('compare', robot, run)} --sets 1 --repetitions 1")
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
    if settings.dry_run:
        terminal.finish({"run": str(run), "wanted": wanted})
        return
    if not yes and not typer.confirm("Write it?", err=True):
        raise InputError("nothing was written; say --yes to be asked no more")
    before = keep_gains(robot, job, wanted)
    terminal.result(f"Kept: {in_words(wanted)}. Before: {in_words(before)}.")
    terminal.next(f"{command('repair', robot)}, for a twin and a policy under these gains")
    terminal.finish({"run": str(run), "kept": wanted, "before": before})
