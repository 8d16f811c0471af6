"""One call: checks or repairs of all arms of a file, going on where an earlier one was cut short."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TypeAlias

from rejoint.logs.history.rows import utc_now
from rejoint.logs.runfolder.folder import RunFolder, locked
from rejoint.runs.fleet.campaign import Campaign, Verb, state_folder
from rejoint.runs.fleet.drive import Event, Executor, Rules, Standing, drive
from rejoint.runs.fleet.file import Fleet, FleetArm
from rejoint.runs.fleet.result import FleetResult, rows_of
from rejoint.runs.fleet.work import RepairOptions
from rejoint.system.extras import require
from rejoint.system.files import saving, write_whole

MakeExecutor: TypeAlias = Callable[[Sequence[FleetArm]], AbstractContextManager[Executor]]
"""Makes the executor for some arms"""


def run_fleet(
    fleet: Fleet,
    verb: Verb,
    executor: MakeExecutor,
    rules: Rules,
    *,
    only: tuple[str, ...] = (),
    options: RepairOptions | None = None,
    anew: bool = False,
    tell: Callable[[Event], object] = lambda _: None,
    begins: Callable[[Campaign], object] = lambda _: None,
) -> FleetResult:
    """Check or repair the arms of a fleet, and write the page.

    Parameters
    ----------
    fleet
        arms, and the folder that everything is kept in
    verb
        check or repair
    executor
        makes who does the work; closed at the end
    rules
        who may move when
    only
        names of arms; by default all of them
    options
        of the repair
    anew
        begin with all arms again, though an earlier call was cut short
    tell
        called with everything that happens
    begins
        called with what is to be done, before it begins

    Returns
    -------
    FleetResult
        a row for each arm, the worst first, and the page

    Raises
    ------
    FileError, UnsavedError
        if another call works in the folder of the fleet, or nothing can be written there; what became of the arms is in
        the error where there is something
    InputError
        if there is no such arm, or no cluster
    MissingExtraError
        without the extra ``report``, for a repair without ``train``
    """
    require(f"rejoint fleet {verb}", "report")
    arms, begun = fleet.only(only), time.monotonic()
    with locked(RunFolder(state_folder(fleet))):
        campaign = Campaign.open(fleet, verb, options, only=only, anew=anew)
        begins(campaign)
        with executor(arms) as ready:
            standings = drive(arms, campaign.left, campaign.work, ready, rules, tell)
        result = FleetResult(
            verb=verb, rows=rows_of(campaign, standings), ended=utc_now(), seconds=time.monotonic() - begun,
            page=state_folder(fleet) / f"{verb}.html", finished=campaign.through,
        )  # fmt: skip
        with saving(result):
            _save(campaign, result, standings)
    return result


def _save(campaign: Campaign, result: FleetResult, standings: Sequence[Standing]) -> None:
    """Write what the next call goes by, where bugs are, and the page."""
    from rejoint.runs.fleet.page import write_page

    if result.finished:
        campaign.finish()
    for one in standings:
        if one.outcome is not None and one.outcome.trace:
            _keep_trace(result.page.parent / f"bug-{one.arm.name}.txt", one.outcome.trace)
    write_page(result.page, result)


def _keep_trace(path: Path, text: str) -> None:
    write_whole(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))
