"""The report: one page of everything that a run has found."""

from __future__ import annotations

from pathlib import Path

from rejoint.runs.given import RunLike, as_run
from rejoint.runs.run import exclusive


def report(run: RunLike) -> Path:
    """Write the report of a run: one self-contained page that opens in a browser, and its figures as PNG files.

    Parameters
    ----------
    run
        run, or its folder; stages that have not been run are named on the page

    Returns
    -------
    Path
        of the page, ``report.html`` in the folder

    Raises
    ------
    FileError
        if a file of the run is damaged, or nothing has been run

    Examples
    --------
    >>> page = rejoint.report("runs/mine")
    >>> webbrowser.open(page.resolve().as_uri())
    """
    from rejoint.pages.report.page import write_report

    found = as_run(run)
    with exclusive(found):
        return write_report(found.path)
