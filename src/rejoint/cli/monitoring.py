"""Commands over months: the check of an arm, and the history of all of them.

Many arms in one command.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import AbstractContextManager, closing
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

import rejoint
from rejoint.cli import options as opt
from rejoint.cli.console import Terminal, watched
from rejoint.control.observer import StageObserver
from rejoint.runs.run import RUNS
from rejoint.runs.stages.check import BETWEEN
from rejoint.session.settings import Settings
from rejoint.system.errors import FileError, MissingExtraError
from rejoint.system.extras import require

if TYPE_CHECKING:
    from rejoint.runs.fleet.call import Event, Executor, FleetResult
    from rejoint.runs.fleet.campaign import Campaign
    from rejoint.runs.fleet.file import FleetArm
    from rejoint.runs.history import ArmHistory

DRIFTS, ALARM = 6, 7
"""Exit codes of a check after which the arm is to be watched, and is to be repaired"""

Folder = Annotated[Path, typer.Option("--history", help="Folder below which all runs and checks are.")]


@opt.with_arm
@opt.with_settings("period", "dry_run")
def check(
    robot: opt.Robot,
    history: Folder = RUNS,
    name: Annotated[
        str | None, typer.Option(help="Name of the arm in the history; by default made of its address.")
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="Tool error in mm that you can bear; by default that of the last check.", min=0)
    ] = None,
    used: Annotated[float | None, typer.Option(help="Hours for which the arm has been used so far.", min=0)] = None,
    date: Annotated[
        datetime | None, typer.Option(help="Date of the check in UTC, by default now; for trying years in minutes.")
    ] = None,
    moved: Annotated[
        bool, typer.Option("--moved", help="The arm was moved, or its zeros were set: begin a new baseline.")
    ] = False,
    repeat: Annotated[int, typer.Option(help="Checks in a row; 5 after a repair are a norm.", min=1)] = 1,
    prometheus: Annotated[
        Path | None, typer.Option(help="Write the result for Prometheus here, as its node exporter reads text files.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of everything random; by default the number of earlier checks.", min=0)
    ] = None,
    live: opt.Live = None,
    json: opt.Json = False,
    *,
    pick: opt.ArmPick,
    settings: Settings,
) -> None:
    """See in two and a half minutes whether an arm has become worse, and how long it will still do.

    It is compared with its own first checks since its last repair. Exit code 0: nothing to do; 6: it drifts; 7: alarm,
    or the tolerance is reached. Example, for a weekly cron job:
    `rejoint check tcp://192.168.1.20:9000 --name bench-3 --tolerance 3 --json`
    """
    terminal = Terminal(json=json, dry=settings.dry_run)
    chosen = opt.choose_arm(terminal, pick, robot)
    with (
        terminal.unsaved(lambda found: terminal.result(found.line)),
        watched(terminal, "check", "checking", live) as observer,
    ):
        for number in range(repeat):
            when = None if date is None else date + number * BETWEEN
            found = rejoint.check(
                robot,
                history=history,
                name=name,
                arm=chosen,
                tolerance_mm=tolerance,
                notes=rejoint.CheckNotes(used_h=used, when=when, moved=moved and not number),
                settings=replace(settings, seed=seed),
                observer=StageObserver(observer, number / repeat, (number + 1) / repeat),
            )
    if settings.dry_run:
        terminal.finish({"arm": found.arm, "robot": found.robot})
        return
    for problem in found.unread:
        terminal.say(f"left out: {problem}")
    terminal.result(f"{found.arm}: {found.line}")
    if prometheus is not None:
        from rejoint.runs.history import write_prometheus

        write_prometheus(prometheus, found.arm, found.outlook, found.measures)
    terminal.finish(
        {
            "arm": found.arm,
            "robot": found.robot,
            "line": found.line,
            "outlook": found.outlook,
            "over": found.outlook.over,
            "measures": found.measures,
            "folder": found.folder,
        }
    )
    if found.outlook.state == "alarm" or found.outlook.over:
        raise typer.Exit(ALARM)
    if found.outlook.state == "drifting":
        raise typer.Exit(DRIFTS)


def history(
    folder: Annotated[Path, typer.Argument(help="Folder below which runs and checks are.", metavar="FOLDER")] = RUNS,
    page: Annotated[Path | None, typer.Option(help="Page to write; by default history.html in FOLDER.")] = None,
    json: opt.Json = False,
) -> None:
    """Show all arms of a folder, the worst first, as a table and as a page.

    Example: `rejoint history runs`
    """
    from rejoint.logs.history.index import find_rows
    from rejoint.runs.history import HEADERS, arms_of, cells

    terminal = Terminal(json=json)
    if page is not None:
        require("rejoint history --page", "report")
    if not folder.is_dir():
        raise FileError(folder, "no such folder", "check an arm first: rejoint check ROBOT")
    rows, unread = find_rows(folder)
    for problem in unread:
        terminal.say(f"left out: {problem}")
    arms = arms_of(rows)
    if arms:
        terminal.table("All arms, the worst first", HEADERS, [cells(one) for one in arms])
    else:
        terminal.result(f"There are no checks and no runs below {folder}; begin with: rejoint check ROBOT")
    path = page or folder / "history.html"
    written = _write_page(terminal, path, arms)
    terminal.finish({"arms": [one.newest for one in arms], "page": path if written else None, "left_out": unread})


def _write_page(terminal: Terminal, path: Path, arms: Sequence[ArmHistory]) -> bool:
    try:
        require("the page of the history", "report")
    except MissingExtraError as error:
        terminal.say(f"No page: {error}")
        return False
    from rejoint.runs.history import write_history

    write_history(path, arms)
    terminal.result(f"Page: {path}")
    return True


@opt.with_settings("dry_run")
def fleet(
    verb: Annotated[Literal["check", "repair"], typer.Argument(help="What is to be done with each arm.")],
    file: Annotated[Path, typer.Argument(help="File with the arms, see docs/monitoring.md.", metavar="FLEET.toml")],
    only: Annotated[str, typer.Option(help="Comma-separated names of arms; by default all of the file.")] = "",
    somebody: Annotated[
        bool, typer.Option("--somebody-is-there", help="Somebody is there who can stop the arms that need that.")
    ] = False,
    wait: Annotated[bool, typer.Option("--wait", help="Stay until the hours of all arms have come.")] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Begin with all arms again, though an earlier call was cut short.")
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
    *,
    settings: Settings,
) -> None:
    """Check or repair many arms, each within its hours and with its permissions, and show them, the worst first.

    Interrupted or killed, the same command goes on: one step of each arm is lost at most, and no real arm moves again
    by itself. Exit code 0: nothing to do; 6 and 7: as for `check`, of the worst arm; 5: not all was done; others: an
    arm failed.

    Example: `rejoint fleet check FLEET.toml --somebody-is-there`
    """
    require(f"rejoint fleet {verb}", "fleet", "report", *(["train"] if verb == "repair" and address is None else []))
    from rejoint.cli.chain import rehearse
    from rejoint.runs.fleet.call import Rules, run_fleet
    from rejoint.runs.fleet.campaign import RepairOptions
    from rejoint.runs.fleet.file import read_fleet
    from rejoint.runs.fleet.rayexecutor import RayExecutor, has_token

    terminal = Terminal(json=json, dry=settings.dry_run)
    found = read_fleet(file)
    names = opt.controller_names(only) if only else ()
    if settings.dry_run:
        for arm in found.only(names):
            terminal.say(f"{arm.name}:")
            with watched(terminal, verb, "simulating", None) as observer:
                if verb == "check":
                    rejoint.check(arm.address, arm=arm.description, settings=settings, observer=observer)
                else:
                    rehearse(arm.address, arm.description, None, settings, observer, quick=quick)
        terminal.finish({"fleet": str(file)})
        return
    if address is not None and not has_token():
        terminal.say(
            f"warning: no token for Ray: anyone who reaches {address} may run programs there; see docs/monitoring.md"
        )

    def make_executor(arms: Sequence[FleetArm]) -> AbstractContextManager[Executor]:
        return closing(RayExecutor(arms, address=address, cpus=cpus, training_cpus=training_cpus))

    options = RepairOptions(
        plan=rejoint.RepairPlan(
            preset=preset,
            controllers=opt.controller_names(controllers),
            trials=rejoint.TrialPlan(sets=sets, repetitions=repetitions),
        ),
        seed=seed,
        quick=quick,
        needed=needed,
    )
    rules = Rules(somebody=somebody, stay=wait, fresh=fresh)
    if address is None:  # all control loops run here
        rules = replace(rules, at_once=cpus or os.cpu_count() or 1)
    with terminal.unsaved(partial(_show_rows, terminal)):
        result = run_fleet(
            found,
            verb,
            make_executor,
            rules,
            only=names,
            options=options,
            tell=partial(_say_event, terminal),
            begins=partial(_say_begun, terminal),
        )
    _show_rows(terminal, result)
    if quick:
        terminal.say("A quick try: little of everything was done, so none of this is a result.")
    terminal.result(f"Page: {os.path.relpath(result.page)}")
    terminal.finish(
        {"verb": verb, "rows": result.rows, "seconds": result.seconds, "page": result.page, "finished": result.finished}
    )
    if result.code:
        raise typer.Exit(result.code)


def _say_begun(terminal: Terminal, campaign: Campaign) -> None:
    before = f", begun {campaign.info.begun:%Y-%m-%d %H:%M} UTC" if campaign.resumed else ""
    start = "Going on with the" if campaign.resumed else "Starting the"
    terminal.say(f"{start} {campaign.verb} of {len(campaign.info.runs)} arms in {campaign.fleet.folder}{before}")


def _say_event(terminal: Terminal, event: Event) -> None:
    took = f" in {event.seconds:.0f} s" if event.kind == "done" else ""
    terminal.say(f"{event.arm.name}: {event.step} {event.kind}{took}{f': {event.text}' if event.text else ''}")


def _show_rows(terminal: Terminal, result: FleetResult) -> None:
    from rejoint.runs.fleet.call import HEADERS

    terminal.table("All arms, the worst first", HEADERS, [row.cells for row in result.rows])
    for row in result.rows:
        terminal.result(f"{row.name}: {row.found}")
