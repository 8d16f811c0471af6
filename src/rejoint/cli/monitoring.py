"""Commands over months: the check of an arm, and the history of all of them."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import rejoint
from rejoint.cli import options as opt
from rejoint.cli.console import Terminal
from rejoint.cli.live import live_view, shared
from rejoint.runs.run import RUNS
from rejoint.system.errors import FileError, MissingExtraError
from rejoint.system.extras import require

if TYPE_CHECKING:
    from rejoint.runs.history.table import ArmHistory

DRIFTS, ALARM = 6, 7
"""Exit codes of a check after which the arm is to be watched, and is to be repaired"""

Folder = Annotated[Path, typer.Option("--history", help="Folder below which all runs and checks are.")]


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
        bool, typer.Option("--moved", help="The arm was moved, or its zeros set anew: begin a new norm.")
    ] = False,
    repeat: Annotated[int, typer.Option(help="Checks in a row; 5 after a repair are a norm.", min=1)] = 1,
    prometheus: Annotated[
        Path | None, typer.Option(help="Write the result for Prometheus here, as its node exporter reads text files.")
    ] = None,
    arm: opt.ArmOption = None,
    base: opt.Base = None,
    tip: opt.Tip = None,
    hold: opt.Hold = None,
    period: opt.Period = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of everything random; by default the number of earlier checks.", min=0)
    ] = None,
    live: opt.Live = None,
    json: opt.Json = False,
) -> None:
    """See in two and a half minutes whether an arm has become worse, and how long it will still do.

    It is compared with its own first checks since its last repair. Exit code 0: nothing to do; 6: it drifts; 7: alarm,
    or the tolerance is reached. Example, for a weekly cron job:
    `rejoint check tcp://192.168.1.20:9000 --name bench-3 --tolerance 3 --json`
    """
    terminal = Terminal(json=json)
    chosen = opt.choose_arm(terminal, arm, base, tip, robot, hold)
    with (
        terminal.unsaved(lambda found: terminal.result(found.line)),
        live_view(terminal, live, "check") as view,
        terminal.progress("checking") as update,
    ):
        found = rejoint.check(
            robot, history=history, name=name, arm=chosen, tolerance_mm=tolerance, used_h=used, when=date, moved=moved,
            repeat=repeat, period=opt.period_seconds(period), seed=seed,
            on_progress=shared(update, view), live=view,
        )  # fmt: skip
    for problem in found.unread:
        terminal.say(f"left out: {problem}")
    terminal.result(f"{found.arm}: {found.line}")
    if prometheus is not None:
        from rejoint.runs.history.prometheus import write_prometheus

        write_prometheus(prometheus, found.arm, found.outlook, found.measures)
    terminal.finish(
        {"arm": found.arm, "robot": found.robot, "line": found.line, "outlook": found.outlook,
         "over": found.outlook.over, "measures": found.measures, "folder": found.folder}
    )  # fmt: skip
    if found.outlook.state == "alarm" or found.outlook.over:
        raise typer.Exit(ALARM)
    if found.outlook.state == "drifting":
        raise typer.Exit(DRIFTS)


def history(
    folder: Annotated[Path, typer.Argument(help="Folder below which runs and checks are.", metavar="FOLDER")] = RUNS,
    page: Annotated[Path | None, typer.Option(help="Page to write; by default history.html in FOLDER.")] = None,
    sql: Annotated[str | None, typer.Option(help="Ask DuckDB instead: the rows are the table `history`.")] = None,
    json: opt.Json = False,
) -> None:
    """Show all arms of a folder, the worst first, as a table and as a page; or ask its rows in SQL.

    Example: `rejoint history runs --sql "select arm, max(error_mm) from history where joint = '' group by arm"`
    """
    from rejoint.logs.history.index import find_rows
    from rejoint.runs.history.table import HEADERS, arms_of, cells

    terminal = Terminal(json=json)
    if page is not None:
        require("rejoint history --page", "report")
    if not folder.is_dir():
        raise FileError(folder, "no such folder", "check an arm first: rejoint check ROBOT")
    if sql is not None:
        from rejoint.logs.history.sql import ask

        names, answer = ask(folder, sql, lambda problem: terminal.say(f"left out: {problem}"))
        terminal.table(
            f"{len(answer)} rows", names, [["" if one is None else str(one) for one in row] for row in answer]
        )
        terminal.finish([dict(zip(names, row, strict=True)) for row in answer])
        return
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
    """Write the page; where its extra is not installed, as beside the arm, the table is all, and a line says why."""
    try:
        require("the page of the history", "report")
    except MissingExtraError as error:
        terminal.say(f"No page: {error}")
        return False
    from rejoint.runs.history.page import write_history

    write_history(path, arms)
    terminal.result(f"Page: {path}")
    return True
