"""One command per stage, the whole chain as one command, and commands that open a page."""

import math
import os
import secrets
import sys
import time
import webbrowser
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import msgspec
import typer

import rejoint
from rejoint.arms import load_arm
from rejoint.cli import offline, show
from rejoint.cli import options as opt
from rejoint.cli.console import HERE, picked, typed
from rejoint.cli.options import Call, takes
from rejoint.control.robot import part_of
from rejoint.control.servogains import in_words, tunable
from rejoint.logs.runfolder import RUNS, RunFolder, locked, read_effort
from rejoint.robots import BusRobot, place_of
from rejoint.robots.bus import LOST
from rejoint.robots.knobs import ServoAddress
from rejoint.robots.servobus import Gripper, ServoBus
from rejoint.runs.run import Run
from rejoint.session.inputs import FIRST_ROBOT, Settings, source_of, to_keep
from rejoint.session.session import Session
from rejoint.system.errors import InputError, NotReachedError
from rejoint.system.extras import EXTRAS, installed, require
from rejoint.system.shell import command, host_and_port, is_loopback
from rejoint.system.stopping import noted, pause


@takes
def studio(call: Call, listen: str = HERE, folder: Path = RUNS, quiet: bool = False) -> object:
    """Open the page that guides through a repair."""
    require("rejoint studio", "live")
    from rejoint.studio import jobs
    from rejoint.studio.machine import Studio
    from rejoint.studio.page import studio_view

    host, port = host_and_port("--listen", listen)
    machine = Studio(folder)
    token = "" if is_loopback(host) else secrets.token_urlsafe(16)
    with studio_view(machine, host, port, token) as view:
        call.result(f"Studio: {view.address}  (Ctrl-C ends it; the arm then holds)")
        machine.do("Looking for arms", jobs.look)
        if not quiet:
            webbrowser.open(view.address)
        try:
            machine.left.wait()
        finally:
            machine.leave()
    return {"address": view.address}


POINTS = ((0.17, -0.06, 0.21), (0.20, 0.06, 0.19), (0.18, 0.0, 0.23))
"""[m] of the demonstration, `DWELL` [s] each (chosen)"""
DWELL = 3.0
SHOWN = {"The worn arm, as it is": "default", "The same arm, with the policy that comes with rejoint": "shelf"}
"""Titles and controllers of the demonstration"""


@takes
def demo(call: Call, listen: str = HERE, rounds: int = 10, quiet: bool = False) -> object:
    """Show a worn arm that misses its targets, and the same arm with a policy."""
    require("rejoint demo", "live", *place_of(FIRST_ROBOT).family.needs)
    from rejoint.pages.live.view import LiveView

    with LiveView(*host_and_port("--listen", listen)) as view:
        call.result(f"Demonstration: {view.address}  (Ctrl-C ends it)")
        call.say_compiling()
        if not quiet:
            webbrowser.open(view.address)
        for _ in range(rounds):
            errors = []
            for title, controller in SHOWN.items():
                view.begin(title)
                settings = Settings(controller=controller, dwell=DWELL)
                errors.append(1e3 * rejoint.deploy(FIRST_ROBOT, POINTS, settings=settings, observer=view).error)
            call.result("As it is: {:.1f} mm off. With the policy: {:.2f} mm off.".format(*errors))
    return {"address": view.address}


@takes
def repair(
    call: Call,
    robot: str = FIRST_ROBOT,
    run: Path | None = None,
    preset: str = "default",
    targets: Path | None = None,
    controllers: str = "all",
    measure: str | None = None,
    *,
    trials: rejoint.TrialPlan,
    seed: int = 0,
    quick: bool = False,
) -> object:
    """Diagnose an arm, fit its twin, train a policy, compare every controller on the arm, and write the report."""
    from rejoint.cli.upkeep import gauge_by_word

    dry = call.settings.dry_run
    if not dry:
        require("rejoint repair", "train", "report")  # all at once: an open address would name only a part
    job = call.job(robot, run, seed)
    if not dry:
        call.message(f"{'Going on with' if job.path.exists() else 'Starting'} the repair of {robot} in {job.path}")
    plan = rejoint.RepairPlan(
        preset=preset,
        controllers=opt.controller_names(controllers),
        targets=targets,
        gauge=None if dry else gauge_by_word(call, robot, measure, seed),
        trials=trials,
    )
    with call.watched("repair", bar=dry) as observer:
        found = rejoint.repair(robot, run=job, quick=quick, plan=plan, settings=call.settings, observer=observer)
    if dry:
        return {"robot": robot}
    page = Path(os.path.relpath(found.page))
    if quick:
        call.message("A quick try: little of everything was done, so none of this is a result.")
    from rejoint.pages.report.page import read_contents

    contents = read_contents(job.path)
    errors, steps = contents.before_after(), contents.next_steps()
    spent = read_effort(job.folder)
    call.show(show.effort(spent))
    if errors is not None and errors.sentence:
        call.result(errors.sentence)
    call.result(str(page))
    call.message("Next:")
    for what, line in {"look at the report": command("open", job.path), **steps}.items():
        call.message(f"  {line}  # {what}")
    return {
        "run": job.path,
        "recommended": found.recommendation,
        "policy": job.folder.policy,
        "report": page,
        "errors": errors,
        "effort": spent,
        "next": steps,
    }


MISSED = 5
"""Exit code for targets not reached, and a path not followed"""


@takes
def diagnose(
    call: Call,
    robot: str | None = None,
    logs: Path | None = None,
    run: Path | None = None,
    healthy: Path | None = None,
    seed: int = 0,
    quick: bool = False,
) -> object:
    """Find out what is wrong with an arm: by moving it, or from logs."""
    given = to_keep(call.settings).given().keys() - {"payload", "tool"}
    if logs is not None and (robot is not None or call.settings.dry_run or given):
        raise InputError("diagnose takes either a robot or --logs FOLDER, and --logs no settings of a motion")
    robot = FIRST_ROBOT if robot is None else robot
    job = call.job(robot if logs is None else source_of(logs), run, seed)
    found = call.do(
        rejoint.diagnose, logs or robot, run=job, healthy=healthy, quick=quick, settings=call.settings
    ).diagnosis
    if call.settings.dry_run:
        return {"robot": robot}
    if any(row.sweep_gain is not None for row in found.measurement.joints):  # None: no commands that a twin needs
        then = ["identify", "--logs", logs]
        if logs is None:
            then = ["repair", robot, *[f"--seed={seed}"] * (seed > 0), *["--quick"] * quick]
        call.next(command(*then, "--run", job.path))
    return {
        "run": job.path,
        "diagnosis": found,
        "true_error": found.open_loop and found.open_loop.true_error,
        "effort": read_effort(job.folder),
    }


@takes
def identify(
    call: Call,
    run: Path | None = None,
    logs: Path | None = None,
    folder: Path | None = None,
    published: list[str] | None = None,
    hold_out: list[str] | None = None,
    gain: list[str] | None = None,
    seed: int | None = None,
) -> object:
    """Fit a digital twin to the logs of a run or others; then write the report."""
    require("rejoint identify", "train", *(() if logs is None else ("report",)))  # logs end in a report at once
    if (run is None) == (logs is None) or (run is not None and any((folder, published, hold_out, gain))):
        raise InputError(
            "identify takes either a run folder alone or --logs FOLDER, and with it --run, --published, --hold-out "
            "and --gain"
        )
    job = Run.open(run) if run is not None else call.job(source_of(logs or ""), folder, seed or 0)
    plan = rejoint.LogPlan(
        beside=offline.read_sets(published, job.arm),
        hold_out=None if not hold_out else [name for name in hold_out if name != "none"],
        gain=offline.by_motion(gain),
    )
    twin = call.do(rejoint.identify, logs, run=job, plan=plan, seed=seed)
    value = {"run": job.path, "twin": job.folder.twin, **picked(twin, "held_out", "notes")}
    if logs is not None:
        if twin.judgement is not None:
            value["judgement"] = offline.show_errors(call, twin.judgement)
        value |= {"report": rejoint.report(job), "fitted": twin.fitted}
        call.result(f"Twin: {job.folder.twin}")
        call.result(f"Report: {job.page}")
    if not twin.judgement.doubts if twin.judgement else twin.held_out.trusted:
        call.next(command("train", job.path))
    return value


@takes
def train(
    call: Call,
    run: Path,
    preset: str = "default",
    learner: str = "ppo",
    generic: bool = False,
    seed: int | None = None,
    quick: bool = False,
) -> object:
    """Train a policy on randomised copies of the run's twin."""
    require("rejoint train", "train")
    if generic and not run.exists():
        Run.create(run, "emulated:worn", load_arm("mycobot280"), seed or 0)
    job = Run.open(run).seeded(seed)
    trainer = None
    if learner != "ppo":
        if preset != "default":
            raise InputError(f"--preset {preset} is a recipe of PPO; {learner} trains on the default one: leave it out")
        points = entry_points(group=TRAINERS)
        if learner not in points.names:
            raise InputError(f"--learner {learner!r}: expected one of {', '.join(('ppo', *sorted(points.names)))}")
        point = points[learner]
        trainer = point.load()(learner, job.seed)
    how = rejoint.TrainSettings(generic=generic, trainer=trainer)
    result = call.do(rejoint.train, run=job, preset=preset, quick=quick, settings=how).training
    call.next(command("compare", "ROBOT" if job.info.from_logs else job.robot, run))  # logs cannot be driven
    return result


TRAINERS = "rejoint.trainers"
"""Entry points of functions that make a `Trainer` from its name and a seed"""


@takes
def compare(
    call: Call, robot: str, run: Path, targets: Path | None = None, controllers: str = "all", *, plan: rejoint.TrialPlan
) -> object:
    """Try every controller on the same arm with the same targets; on a real arm those clearly worse are eliminated."""
    names = opt.controller_names(controllers)
    found = call.do(rejoint.compare, robot, names, targets, run=run, plan=plan, settings=call.settings)
    call.next(command("report", run))
    return {
        "run": run,
        "recommended": found.recommendation,
        "comparison": {name: value for name, value in vars(found.comparison).items() if name != "results"},
        "true_error": {row.controller: row.true_error for row in found.comparison.rows},
        "effort": read_effort(RunFolder(run)),
    }


def _arm(call: Call, robot: str, run: Path | None) -> rejoint.Arm | None:
    return call.arm(robot) if run is None or any(call.pick) else None


@takes
def deploy(call: Call, robot: str, run: Path | None = None, targets: Path | None = None) -> object:
    """Drive an arm to targets with the trained policy (or another controller); ten random ones by default."""
    done = call.do(rejoint.deploy, robot, targets, run=run, arm=_arm(call, robot, run), settings=call.settings)
    turned = [visit.turned and math.degrees(visit.turned) for visit in done.visits]
    value = {
        "run": run,
        "error_mm": [visit.error and 1e3 * visit.error for visit in done.visits],
        **({"turned_deg": turned} if any(visit.orientation for visit in done.visits) else {}),
        **picked(done, "controller", "missed", "visits", "period", "gaps"),
    }
    call.code = MISSED if done.missed else 0
    return value


@takes
def goto(
    call: Call, robot: str, x: float, y: float, z: float, run: Path | None = None, timeout: float = 10.0
) -> object:
    """Move the tool to one point, and hold it there."""
    target, arm = opt.point_of("goto", x, y, z), _arm(call, robot, run)
    with (
        call.watched("goto") as observer,
        rejoint.connect(robot, run=run, arm=arm, settings=call.settings, observer=observer) as session,
    ):
        try:
            session.move_to(target, timeout_s=timeout)
        except NotReachedError as error:
            call.code = MISSED
            call.result(f"Not reached: {error}")
        found, by = session.state, "encoders" if session.correction is None else "calibration"
    error_mm = None if found.error_m is None else 1e3 * found.error_m
    if error_mm is not None and not call.code:
        place = ", ".join(f"{1e3 * value:.1f}" for value in found.tool_m)
        call.result(f"By the {by} the tool is at ({place}) mm, {error_mm:.2f} mm off.")
    return {"target_mm": [x, y, z], "error_mm": error_mm, "reached": not call.code}


@takes
def follow(call: Call, robot: str, run: Path, path: str, repeat: int = 1) -> object:
    """Drive an arm along a path, and say how well it followed."""
    done = call.do(rejoint.follow, robot, path, run=run, repeat=repeat, settings=call.settings)
    if all(map(installed, EXTRAS["report"])) and not call.settings.dry_run:
        from rejoint.pages.report.figures import draw_followed

        job = Run.open(run)
        with locked(job.folder):
            call.message(f"Path: {draw_followed(job.folder, job.arm, done)}")
    passes = [picked(one, "encoder", "true_error", "turned") for one in done.passes]
    value = picked(done, "path", "controller", "followed", "period", "gaps")
    call.code = 0 if done.followed else MISSED
    return {"run": run, **value, "passes": passes}


@takes
def report(call: Call, run: Path) -> object:
    """Write the report of a run: one self-contained page that opens in a browser."""
    require("rejoint report", "report")
    path = rejoint.report(run).resolve()
    call.result(str(path))
    return {"run": run, "report": path}


@takes
def gains(call: Call, robot: str, run: Path, keep: bool = False, yes: bool = False) -> object:
    """Search for better gains of the servos themselves, on the arm; what is found takes part in `rejoint compare`."""
    if not keep:
        found = call.do(rejoint.gains, robot, run, settings=call.settings)
        call.next(f"{command('compare', robot, run)} --sets 1 --repetitions 1")
        return {"run": run, "gains": found}
    from rejoint.runs.stages.fitting import gains_to_keep

    job = Run.open(run)
    wanted = gains_to_keep(job)
    call.message(
        f"This writes {in_words(wanted)} into the memory of the {job.arm.joints} servos of {robot}: they keep that "
        "without power, until something else is written. LeRobot writes its own P, I and D whenever it connects. "
        "Policies that were trained under other gains are refused from then on, and the twin of this run is that of "
        "the gains before."
    )
    if call.settings.dry_run:
        return {"run": run, "wanted": wanted}
    if not yes and not typer.confirm("Write it?", err=True):
        raise InputError("nothing was written; say --yes to be asked no more")
    with noted(), Session(robot, run=job) as session:
        servos, before = tunable(session.robot)
        servos.keep(wanted)
    call.result(f"Kept: {in_words(wanted)}. Before: {in_words(before)}.")
    call.next(f"{command('repair', robot)}, for a twin and a policy under these gains")
    return {"run": run, "kept": wanted, "before": before}


@takes
def serve(
    call: Call, robot: str, run: Path, listen: str = "127.0.0.1:9000", pty: bool = False, stdio: bool = False
) -> object:
    """Let programs written for the vendor's client drive a worn arm as if it were a new one, until Ctrl-C."""
    if stdio:
        if pty or call.json or call.settings.controller or call.live:
            raise InputError("--stdio does not go with --pty, --json, --live or --controller")
        serve_lines(robot, run, call)
        return None
    with call.watched("serve", bar=False) as observer:
        done = rejoint.serve(robot, run, listen=listen, pty=pty, settings=call.settings, observer=observer)
    call.message(f"Serving ended after {done.orders} orders; they are in {done.log}")
    return done


class Order(msgspec.Struct, forbid_unknown_fields=True):
    """A line from the other program; an empty object asks for the state alone."""

    goal: list[float] | None = None
    """[rad] of every joint"""
    gripper: float | None = None
    """[%] open"""


def serve_lines(robot: str, run: Path, call: Call) -> None:
    """Drive the arm by the lines of standard input until they end; the arm then holds."""
    if sys.stdin is None:
        raise InputError("--stdio follows standard input, and it is closed; give it a pipe")
    detail = place_of(robot).detail
    with noted(), Session(robot, run=run, settings=call.settings, observer=call) as arm:
        bus = getattr(part_of(arm.robot, BusRobot), "bus", None)
        gripper = Gripper.find(bus) if isinstance(bus, ServoBus) else None
        arm.watching += [] if gripper is None else [lambda _: gripper.serve()]
        arm.hold()
        middle = detail.middle(arm.arm).tolist() if isinstance(detail, ServoAddress) else [0.0] * arm.arm.joints
        _answer({"joints": arm.arm.joint_names, "middle": middle, "gripper": gripper is not None})
        for line in typed(arm.hold):
            _answer(_obey(arm, gripper, line))


def _obey(arm: Session, gripper: Gripper | None, line: bytes) -> dict[str, Any]:
    until = time.monotonic() + LOST
    while time.monotonic() - arm.heard > LOST:  # or this computer was busy, and the answer comes
        if time.monotonic() > until:
            return {"refused": f"the arm has not answered for {LOST:g} s"}
        pause(0.01)
    try:
        order = msgspec.json.decode(line, type=Order)
        taken = None if order.goal is None else arm.send_joints(order.goal).tolist()
    except (msgspec.MsgspecError, InputError) as error:
        return {"refused": str(error)}
    if gripper is not None and order.gripper is not None:
        gripper.goal = order.gripper
    return {"position": arm.shown_joints().tolist(), "goal": taken, "gripper": gripper and gripper.opened}


def _answer(content: dict[str, Any]) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(content) + b"\n")
    sys.stdout.buffer.flush()
