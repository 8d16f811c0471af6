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
from typing import TYPE_CHECKING, Literal

import rejoint
from rejoint.cli import options as opt
from rejoint.cli.console import picked
from rejoint.cli.options import Call, Result, takes
from rejoint.control.recording import StageObserver
from rejoint.runs.run import RUNS
from rejoint.runs.stages.check import BETWEEN
from rejoint.system.errors import FileError, MissingExtraError
from rejoint.system.extras import require
from rejoint.system.files import write_text

if TYPE_CHECKING:
    from rejoint.runs.fleet.campaign import Executor, FleetResult
    from rejoint.runs.fleet.file import FleetArm

DRIFTS, ALARM = 6, 7
"""Exit codes of a check: watch the arm, repair it"""


@takes("arm", "part", "live", "period", "dry_run")
def check(
    call: Call,
    robot: str,
    history: Path = RUNS,
    name: str | None = None,
    tolerance: float | None = None,
    used: float | None = None,
    date: datetime | None = None,
    moved: bool = False,
    repeat: int = 1,
    prometheus: Path | None = None,
    seed: int | None = None,
) -> Result:
    """See in two and a half minutes whether an arm has become worse, and how long it will still do."""
    chosen = call.arm(robot)
    if call.named is not None:
        name, tolerance = name or call.named.name, tolerance or call.named.tolerance_mm
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
        return Result(picked(found, "arm", "robot"))
    for problem in found.unread:
        call.say(f"left out: {problem}")
    call.result(f"{found.arm}: {found.line}")
    outlook = found.outlook
    if prometheus is not None:
        from rejoint.runs.history import prometheus_text

        write_text(prometheus, prometheus_text(found.arm, outlook, found.measures))
    value = picked(found, "arm", "robot", "line", "outlook", "measures", "folder")
    alarm = outlook.state == "alarm" or outlook.over
    return Result(value | {"over": outlook.over}, ALARM if alarm else DRIFTS if outlook.state == "drifting" else 0)


@takes()
def history(
    call: Call,
    folder: Path = RUNS,
    page: Path | None = None,
) -> object:
    """Show all arms of a folder, the worst first, as a table and as a page."""
    from rejoint.logs.history import find_rows
    from rejoint.runs.history import HEADERS, arms_of, cells, write_history

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
        if page is not None:
            raise
        call.say(f"No page: {error}")
        return value | {"page": None}
    write_history(path, arms)
    call.result(f"Page: {path}")
    return value | {"page": path}


@takes("dry_run")
def fleet(
    call: Call,
    verb: Literal["check", "repair"],
    file: Path,
    only: str = "",
    somebody: bool = False,
    fresh: bool = False,
    needed: bool = False,
    address: str | None = None,
    cpus: int | None = None,
    training_cpus: float = 1.0,
    preset: str = "default",
    controllers: str = "all",
    sets: int | None = None,
    repetitions: int | None = None,
    seed: int | None = None,
    quick: bool = False,
) -> Result:
    """Check or repair many arms, each within its hours and with its permissions, and show them, the worst first."""
    require(f"rejoint fleet {verb}", "fleet", "report", *(["train"] if verb == "repair" and address is None else []))
    from rejoint.cli.stages import rehearse
    from rejoint.runs.fleet.campaign import FleetRules, run_fleet
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

    trials = rejoint.TrialPlan(sets=sets, repetitions=repetitions)
    rules = FleetRules(
        somebody=somebody,
        fresh=fresh,
        needed=needed,
        plan=rejoint.RepairPlan(preset=preset, controllers=opt.controller_names(controllers), trials=trials),
        seed=seed,
        quick=quick,
    )
    if address is None:  # all control loops run here
        rules = replace(rules, at_once=cpus or os.cpu_count() or 1)
    with call.unsaved(partial(_show_rows, call)):
        result = run_fleet(found, verb, make_executor, rules, only=names, tell=call.say)
    _show_rows(call, result)
    if quick:
        call.say("A quick try: little of everything was done, so none of this is a result.")
    call.result(f"Page: {os.path.relpath(result.page)}")
    return Result({"verb": verb, **picked(result, "rows", "seconds", "page", "finished")}, result.code)


def _show_rows(call: Call, result: FleetResult) -> None:
    from rejoint.runs.fleet.campaign import HEADERS

    call.table("All arms, the worst first", HEADERS, [row.cells for row in result.rows])
    for row in result.rows:
        call.result(f"{row.name}: {row.found}")
