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

import rejoint
from rejoint.cli import options as opt
from rejoint.cli.options import Call, Result, argument, option, takes
from rejoint.control.observer import StageObserver
from rejoint.runs.run import RUNS
from rejoint.runs.stages.check import BETWEEN
from rejoint.system.errors import FileError, MissingExtraError
from rejoint.system.extras import require

if TYPE_CHECKING:
    from rejoint.runs.fleet.call import FleetResult
    from rejoint.runs.fleet.campaign import Campaign
    from rejoint.runs.fleet.drive import Event, Executor
    from rejoint.runs.fleet.file import FleetArm

DRIFTS, ALARM = 6, 7
"""Exit codes of a check after which the arm is to be watched, and is to be repaired"""


@takes("arm", "part", "live", "period", "dry_run")
def check(
    call: Call,
    robot: opt.Robot,
    history: Annotated[Path, option("Folder below which all runs and checks are.", "--history")] = RUNS,
    name: Annotated[str | None, option("Name of the arm in the history; by default made of its address.")] = None,
    tolerance: Annotated[
        float | None, option("Tool error in mm that you can bear; by default that of the last check.", min=0)
    ] = None,
    used: Annotated[float | None, option("Hours for which the arm has been used so far.", min=0)] = None,
    date: Annotated[
        datetime | None, option("Date of the check in UTC, by default now; for trying years in minutes.")
    ] = None,
    moved: Annotated[
        bool, option("The arm was moved, or its zeros were set: begin a new baseline.", "--moved")
    ] = False,
    repeat: Annotated[int, option("Checks in a row; 5 after a repair are a norm.", min=1)] = 1,
    prometheus: Annotated[
        Path | None, option("Write the result for Prometheus here, as its node exporter reads text files.")
    ] = None,
    seed: Annotated[
        int | None, option("Seed of everything random; by default the number of earlier checks.", min=0)
    ] = None,
) -> Result:
    """See in two and a half minutes whether an arm has become worse, and how long it will still do.

    It is compared with its own first checks since its last repair. Exit code 0: nothing to do; 6: it drifts; 7: alarm,
    or the tolerance is reached. Example, for a weekly cron job:
    `rejoint check tcp://192.168.1.20:9000 --name bench-3 --tolerance 3 --json`
    """
    chosen = call.arm(robot)
    with call.watched("check", lambda found: call.result(found.line)) as observer:
        for number in range(repeat):
            when = None if date is None else date + number * BETWEEN
            found = rejoint.check(
                robot,
                history=history,
                name=name,
                arm=chosen,
                tolerance_mm=tolerance,
                notes=rejoint.CheckNotes(used_h=used, when=when, moved=moved and not number),
                settings=replace(call.settings, seed=seed),
                observer=StageObserver(observer, number / repeat, (number + 1) / repeat),
            )
    if call.settings.dry_run:
        return Result({"arm": found.arm, "robot": found.robot})
    for problem in found.unread:
        call.say(f"left out: {problem}")
    call.result(f"{found.arm}: {found.line}")
    outlook = found.outlook
    if prometheus is not None:
        from rejoint.runs.history import write_prometheus

        write_prometheus(prometheus, found.arm, outlook, found.measures)
    value = {name: getattr(found, name) for name in ("arm", "robot", "line", "outlook", "measures", "folder")}
    alarm = outlook.state == "alarm" or outlook.over
    return Result(value | {"over": outlook.over}, ALARM if alarm else DRIFTS if outlook.state == "drifting" else 0)


@takes()
def history(
    call: Call,
    folder: Annotated[Path, argument("Folder below which runs and checks are.", "FOLDER")] = RUNS,
    page: Annotated[Path | None, option("Page to write; by default history.html in FOLDER.")] = None,
) -> object:
    """Show all arms of a folder, the worst first, as a table and as a page.

    Example: `rejoint history runs`
    """
    from rejoint.logs.history.index import find_rows
    from rejoint.runs.history import HEADERS, arms_of, cells, write_history

    if page is not None:
        require("rejoint history --page", "report")
    if not folder.is_dir():
        raise FileError(folder, "no such folder", "check an arm first: rejoint check ROBOT")
    rows, unread = find_rows(folder)
    for problem in unread:
        call.say(f"left out: {problem}")
    arms = arms_of(rows)
    if arms:
        call.table("All arms, the worst first", HEADERS, [cells(one) for one in arms])
    else:
        call.result(f"There are no checks and no runs below {folder}; begin with: rejoint check ROBOT")
    path = page or folder / "history.html"
    value = {"arms": [one.newest for one in arms], "left_out": unread}
    try:
        require("the page of the history", "report")
    except MissingExtraError as error:
        call.say(f"No page: {error}")
        return value | {"page": None}
    write_history(path, arms)
    call.result(f"Page: {path}")
    return value | {"page": path}


@takes("dry_run")
def fleet(
    call: Call,
    verb: Annotated[Literal["check", "repair"], argument("What is to be done with each arm.")],
    file: Annotated[Path, argument("File with the arms, see docs/monitoring.md.", "FLEET.toml")],
    only: Annotated[str, option("Comma-separated names of arms; by default all of the file.")] = "",
    somebody: Annotated[
        bool, option("Somebody is there who can stop the arms that need that.", "--somebody-is-there")
    ] = False,
    wait: Annotated[bool, option("Stay until the hours of all arms have come.", "--wait")] = False,
    fresh: Annotated[
        bool, option("Begin with all arms again, though an earlier call was cut short.", "--fresh")
    ] = False,
    needed: Annotated[
        bool, option("Check each arm first, and repair only those that the check says to.", "--needed")
    ] = False,
    address: Annotated[str | None, option("Ray cluster HOST:PORT, or auto; by default this machine alone.")] = None,
    cpus: Annotated[int | None, option("Processors of this machine to use; by default all.", min=1)] = None,
    training_cpus: Annotated[
        float, option("Processors that a training counts for; it runs two threads.", min=0.1)
    ] = 1.0,
    preset: opt.Preset = "default",
    controllers: opt.Controllers = "all",
    sets: opt.Sets = None,
    repetitions: opt.Repetitions = None,
    seed: Annotated[
        int | None, option("Seed of the repairs; by default that of the run that goes on, or 0.", min=0)
    ] = None,
    quick: opt.Quick = False,
) -> Result:
    """Check or repair many arms, each within its hours and with its permissions, and show them, the worst first.

    Interrupted or killed, the same command goes on: one step of each arm is lost at most, and no real arm moves again
    by itself. Exit code 0: nothing to do; 6 and 7: as for `check`, of the worst arm; 5: not all was done; others: an
    arm failed.

    Example: `rejoint fleet check FLEET.toml --somebody-is-there`
    """
    require(f"rejoint fleet {verb}", "fleet", "report", *(["train"] if verb == "repair" and address is None else []))
    from rejoint.cli.chain import rehearse
    from rejoint.runs.fleet.call import run_fleet
    from rejoint.runs.fleet.campaign import RepairOptions
    from rejoint.runs.fleet.drive import Rules
    from rejoint.runs.fleet.file import read_fleet
    from rejoint.runs.fleet.rayexecutor import RayExecutor, has_token

    found, names = read_fleet(file), opt.controller_names(only) if only else ()
    if call.settings.dry_run:
        for arm in found.only(names):
            call.say(f"{arm.name}:")
            with call.watched(verb) as observer:
                if verb == "check":
                    rejoint.check(arm.address, arm=arm.description, settings=call.settings, observer=observer)
                else:
                    rehearse(arm.address, arm.description, None, call.settings, observer, quick=quick)
        return Result({"fleet": file})
    if address is not None and not has_token():
        call.say(
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
    with call.unsaved(partial(_show_rows, call)):
        result = run_fleet(
            found,
            verb,
            make_executor,
            rules,
            only=names,
            options=options,
            tell=partial(_say_event, call),
            begins=partial(_say_begun, call),
        )
    _show_rows(call, result)
    if quick:
        call.say("A quick try: little of everything was done, so none of this is a result.")
    call.result(f"Page: {os.path.relpath(result.page)}")
    value = {name: getattr(result, name) for name in ("rows", "seconds", "page", "finished")}
    return Result({"verb": verb} | value, result.code)


def _say_begun(call: Call, campaign: Campaign) -> None:
    before = f", begun {campaign.info.begun:%Y-%m-%d %H:%M} UTC" if campaign.resumed else ""
    start = "Going on with the" if campaign.resumed else "Starting the"
    call.say(f"{start} {campaign.verb} of {len(campaign.info.runs)} arms in {campaign.fleet.folder}{before}")


def _say_event(call: Call, event: Event) -> None:
    took = f" in {event.seconds:.0f} s" if event.kind == "done" else ""
    call.say(f"{event.arm.name}: {event.step} {event.kind}{took}{f': {event.text}' if event.text else ''}")


def _show_rows(call: Call, result: FleetResult) -> None:
    from rejoint.runs.fleet.call import HEADERS

    call.table("All arms, the worst first", HEADERS, [row.cells for row in result.rows])
    for row in result.rows:
        call.result(f"{row.name}: {row.found}")
