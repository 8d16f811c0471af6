"""One command per stage."""

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
from rejoint.cli.console import Terminal, results_of
from rejoint.cli.live import live_view, shared
from rejoint.control.deployment import REACHED
from rejoint.logs.runfolder.effort import read_effort
from rejoint.logs.runfolder.folder import LOGS, RunFolder, locked
from rejoint.runs.run import Run, newest_or_new
from rejoint.runs.stages.pathdrive import TRACKER, WITHIN
from rejoint.system.errors import InputError
from rejoint.system.extras import EXTRAS, installed, require
from rejoint.system.shell import command

if TYPE_CHECKING:
    from rejoint.training.train import Trainer

MISSED = 5
"""Exit code of a deployment that did not reach all of its targets, and of a path that was not followed"""


def diagnose(
    robot: opt.OptionalRobot = None,
    logs: opt.LogsOption = None,
    run: opt.RunOption = None,
    arm: opt.ArmOption = None,
    base: opt.Base = None,
    tip: opt.Tip = None,
    hold: opt.Hold = None,
    period: opt.Period = None,
    healthy: Annotated[
        Path | None, typer.Option(help="Run folder of an arm known to be good, instead of an emulated healthy one.")
    ] = None,
    seed: opt.Seed = 0,
    quick: opt.Quick = False,
    json: opt.Json = False,
) -> None:
    """Find out what is wrong with an arm: ten targets open loop and an excitation, or from logs of any motion alone.

    Example: `rejoint diagnose tcp://192.168.1.20:9000 --run runs/mine`, or
    `rejoint diagnose --logs logs/so101 --arm so101 --run runs/mine`
    """
    terminal = Terminal(json=json)
    if logs is not None:
        if robot is not None or period is not None:
            raise InputError("diagnose takes either a robot or --logs FOLDER, and --logs no --period")
        job = opt.run_of_logs(terminal, logs, run, seed, arm, base, tip, hold)
        offline.diagnose_from_logs(terminal, job, logs, healthy)
        return
    robot = robot or "emulated:worn"
    chosen = opt.choose_arm(terminal, arm, base, tip, robot, hold)
    path = run or newest_or_new(robot, chosen, seed)[0]
    job = Run.plan(path, robot, chosen, seed)
    with terminal.unsaved(partial(show.stage, terminal, "diagnose")), terminal.progress("diagnosing") as update:
        found = rejoint.diagnose(
            robot, run=job, period=opt.period_seconds(period), healthy=healthy, quick=quick, on_progress=update
        )
    show.stage(terminal, "diagnose", found)
    terminal.result(f"Next: {command('identify', path)}")
    open_loop = found.diagnosis.open_loop
    told = None if open_loop is None else open_loop.true_error
    terminal.finish({
        "run": str(path), "diagnosis": found.diagnosis, "true_error": told, "effort": read_effort(RunFolder(path)),
    })  # fmt: skip


def identify(
    run: Annotated[Path | None, typer.Argument(help="Run folder.", metavar="RUN")] = None,
    logs: opt.LogsOption = None,
    folder: opt.RunOption = None,
    published: offline.Published = None,
    hold_out: offline.HeldOut = None,
    gain: offline.Gain = None,
    torque_off: offline.TorqueOff = None,
    arm: opt.ArmOption = None,
    base: opt.Base = None,
    tip: opt.Tip = None,
    hold: opt.Hold = None,
    seed: opt.RunSeed = None,
    quick: opt.Quick = False,
    json: opt.Json = False,
) -> None:
    """Fit a digital twin to the excitation log of a run, or to logs of any motion alone, and then write the report.

    Example: `rejoint identify runs/mine`, or `rejoint identify --logs logs/so101 --arm so101 --run runs/so101`
    """
    terminal = Terminal(json=json)
    if (run is None) == (logs is None):
        raise InputError("identify takes either a run folder or --logs FOLDER")
    require("rejoint identify", "train", *(() if logs is None else ("report",)))  # logs end in a report at once
    if logs is not None:
        job = opt.run_of_logs(terminal, logs, folder, seed or 0, arm, base, tip, hold)
        offline.identify_from_logs(terminal, job, logs, published, hold_out, gain, torque_off)
        return
    if folder is not None or published or hold_out or gain or torque_off:
        raise InputError(
            "--run, --published, --hold-out, --gain and --torque-off go with --logs; without it, name the run folder "
            "alone"
        )
    assert run is not None  # noqa: S101 - for the type checker; one of the two is given
    job = Run.open(run)
    with terminal.progress("identifying") as update:
        twin = rejoint.identify(run=job, seed=seed, quick=quick, on_progress=update)
    show.twin(terminal, twin)
    terminal.result(f"Next: {command('train', run)}")
    terminal.finish({"run": str(run), "twin": str(job.folder.twin), "held_out": twin.held_out,
                     "notes": twin.notes})  # fmt: skip


def train(
    run: opt.Run,
    preset: opt.Preset = "default",
    learner: Annotated[str, typer.Option(help="ppo; or its rivals sac, td3 and ddpg, on the default preset.")] = "ppo",
    broad: Annotated[
        bool, typer.Option("--broad", help="Begin RUN here: a policy for any worn myCobot 280, without a twin.")
    ] = False,
    restart: Annotated[bool, typer.Option("--restart", help="Forget an interrupted training.")] = False,
    seed: opt.RunSeed = None,
    quick: opt.Quick = False,
    device: opt.Device = "cpu",
    json: opt.Json = False,
) -> None:
    """Train a policy on randomised copies of the run's twin.

    Example: `rejoint train runs/mine`
    """
    require("rejoint train", "train", "report")
    terminal = Terminal(json=json)
    if broad:
        if RunFolder(run).twin.exists():
            raise InputError(f"{run} has a twin.toml, and --broad trains without one: choose another folder")
        Run.create(run, "emulated:worn", load_arm("mycobot280"), seed or 0)
    job = Run.open(run).seeded(seed)
    if learner != "ppo" and device != "cpu":
        raise InputError(f"--device {device} goes with --learner ppo; {learner} trains on the processors")
    trainer = None if learner == "ppo" else _off_policy(learner, preset, job.seed)
    from rejoint.pages.report.sections.training import draw_training

    if not job.folder.twin.exists():
        terminal.say(f"{run} has no twin.toml: training on broad ranges instead of on this arm.")
    with terminal.progress("training") as update:
        result = rejoint.train(
            run=job,
            preset=preset,
            resume=not restart,
            quick=quick,
            trainer=trainer,
            device=device,
            on_progress=update,
        ).training
    with locked(job.folder):
        terminal.say(f"Curves: {draw_training(job.folder)}")
    show.training(terminal, result)
    robot = "ROBOT" if job.robot.startswith(LOGS) else job.robot  # logs cannot be driven
    terminal.result(f"Next: {command('compare', robot, run)}")
    terminal.finish(result)


def _off_policy(learner: str, preset: str, seed: int) -> Trainer:
    if preset != "default":
        raise InputError(f"--preset {preset} is a recipe of PPO; {learner} trains on the default one: leave it out")
    from rejoint.research.offpolicy import trainer

    return trainer(learner, seed)


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
    calibration: opt.Calibration = None,
    payload: opt.Payload = None,
    tool: opt.Tool = None,
    period: opt.Period = None,
    directions: Annotated[
        bool, typer.Option("--directions", help="Also come to five poses from three directions: vAP (ISO 9283).")
    ] = False,
    seed: opt.RunSeed = None,
    json: opt.Json = False,
) -> None:
    """Try every controller on the same arm with the same targets; on a real arm they race: who is beaten is out.

    Example: `rejoint compare emulated:worn runs/mine --sets 10 --repetitions 6`
    """
    terminal = Terminal(json=json)
    with terminal.unsaved(partial(show.stage, terminal, "compare")), terminal.progress("comparing") as update:
        found = rejoint.compare(
            robot, opt.controller_names(controllers), targets, run=run, sets=sets, repetitions=repetitions,
            full=full, calibration=calibration, payload=opt.payload_of(payload), tool=opt.tool_of(tool),
            period=opt.period_seconds(period), directions=directions, seed=seed, on_progress=update, say=terminal.say,
        )  # fmt: skip
    show.stage(terminal, "compare", found)
    terminal.result(f"Next: {command('report', run)}")
    terminal.finish({
        "run": str(run), "recommended": found.recommendation, "comparison": results_of(found.comparison, "outcomes"),
        "true_error": {row.controller: row.hold.true_error for row in found.comparison.rows},
        "effort": read_effort(RunFolder(run)),
    })  # fmt: skip


def deploy(
    robot: opt.Robot,
    run: Annotated[Path | None, typer.Argument(help="Run folder, if there is one.", metavar="RUN")] = None,
    targets: opt.Targets = None,
    controller: Annotated[
        str | None,
        typer.Option(
            help="policy, shelf, predictive, or one of the baselines; by default the policy of RUN, and without one "
            "that which comes with rejoint for any worn arm of this build (shelf)."
        ),
    ] = None,
    arm: opt.ArmOption = None,
    base: opt.Base = None,
    tip: opt.Tip = None,
    hold: opt.Hold = None,
    dwell: Annotated[float, typer.Option(help="Time per target in seconds.", min=0.1)] = 4.0,
    within: Annotated[
        float, typer.Option(help="Distance in mm at which a target counts as reached.", min=0.01, max=100.0)
    ] = (1e3 * REACHED),
    calibration: opt.Calibration = None,
    payload: opt.Payload = None,
    tool: opt.Tool = None,
    camera: opt.Camera = None,
    period: opt.Period = None,
    seed: opt.RunSeed = None,
    live: opt.Live = None,
    json: opt.Json = False,
) -> None:
    """Drive an arm to targets with the trained policy (or another controller); ten random ones by default.

    The arm is looked at first and goes slowly to its rest posture. Exit code 5: not all targets were reached.

    Example: `rejoint deploy tcp://192.168.1.20:9000 runs/mine --targets points.csv`; before any repair
    `rejoint deploy tcp://192.168.1.20:9000`
    """
    if run is not None and any((arm, base, tip, hold)):
        raise InputError("deploy takes the arm from RUN; leave out --arm, --base, --tip and --hold")
    terminal = Terminal(json=json)
    chosen = None if run is not None else opt.choose_arm(terminal, arm, base, tip, robot, hold)
    tell = partial(show.deployment, terminal, 1e-3 * within)
    with (
        terminal.unsaved(tell),
        live_view(terminal, live, "deploy") as view,
        terminal.progress("deploying") as update,
    ):
        done = rejoint.deploy(
            robot, controller, targets, run=run, arm=chosen, dwell=dwell, within=1e-3 * within,
            payload=opt.payload_of(payload), tool=opt.tool_of(tool), say=terminal.say,
            calibration=calibration, eye=camera, period=opt.period_seconds(period), seed=seed,
            on_progress=shared(update, view), on_end=tell, live=view,
        )  # fmt: skip
    tell(done)
    errors = [None if visit.error is None else 1e3 * visit.error for visit in done.visits]
    turned = [None if visit.turned is None else math.degrees(visit.turned) for visit in done.visits]
    posed = any(visit.orientation for visit in done.visits)
    terminal.finish({
        "run": run and str(run), "controller": done.controller, "error_mm": errors, "missed": done.missed,
        **({"turned_deg": turned} if posed else {}), "visits": results_of(done.visits),
        "period": done.period, "gaps": done.gaps,
    })  # fmt: skip
    if done.missed:
        raise typer.Exit(MISSED)


def follow(
    robot: opt.Robot,
    run: opt.Run,
    path: Annotated[
        str,
        typer.Argument(
            help="CSV file time,x,y,z in s and mm, perhaps an orientation; or circle-8s, random-0.2hz and the like."
        ),
    ],
    controller: Annotated[
        str, typer.Option(help="tracker, by the run's twin; or default: sent as it comes.")
    ] = TRACKER,
    repeat: Annotated[int, typer.Option(help="How often; each time it learns from the last.", min=1)] = 1,
    rate: Annotated[
        float | None, typer.Option(help="Tell the path as it goes, so many times a second, instead of ahead.")
    ] = None,
    within: Annotated[
        float,
        typer.Option(help="Root mean square in mm within which the path counts as followed.", min=0.01, max=100.0),
    ] = 1e3 * WITHIN,
    calibration: opt.Calibration = None,
    payload: opt.Payload = None,
    tool: opt.Tool = None,
    period: opt.Period = None,
    seed: opt.RunSeed = None,
    live: opt.Live = None,
    json: opt.Json = False,
) -> None:
    """Drive an arm along a path, and say how well it followed.

    The arm is looked at first, goes slowly to its rest posture and to the start of the path. Exit code 5: not followed.

    Example: `rejoint follow tcp://192.168.1.20:9000 runs/mine drawing.csv`, or
    `rejoint follow emulated:worn runs/mine circle-8s --repeat 5`
    """
    terminal = Terminal(json=json)
    with live_view(terminal, live, "follow") as view, terminal.progress("following") as update:
        done = rejoint.follow(
            robot, path, run=run, controller=controller, repeat=repeat, rate=rate, within=1e-3 * within,
            payload=opt.payload_of(payload), tool=opt.tool_of(tool), say=terminal.say,
            calibration=calibration, period=opt.period_seconds(period), seed=seed,
            on_progress=shared(update, view), live=view,
        )  # fmt: skip
    show.followed(terminal, done)
    if all(map(installed, EXTRAS["report"])):
        from rejoint.pages.report.followed import draw_followed

        job = Run.open(run)
        with locked(job.folder):
            terminal.say(f"Path: {draw_followed(job.folder, job.arm, done)}")
    terminal.finish({
        "run": str(run), "path": done.path, "controller": done.controller, "followed": done.followed,
        "passes": results_of(
            [{"encoder": one.encoder, "true_error": one.true_error, "turned": one.turned} for one in done.passes]
        ),
        "period": done.period, "gaps": done.gaps,
    })  # fmt: skip
    if not done.followed:
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
