"""What is kept of motions as they come, and of those that end early."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

from rejoint.control.playback import Playback
from rejoint.control.recording import recording_of
from rejoint.control.robot import Robot
from rejoint.logs.journal import Journal
from rejoint.logs.runlog import write_log
from rejoint.runs.run import Run
from rejoint.system.errors import FileError
from rejoint.system.files import unused


def start_journal(run: Run, name: str, robot: Robot, label: str, rows: int = 0) -> Journal:
    """Start the journal of a run log whose name ends with the time."""
    return Journal.begin(
        _dated(run, name),
        arm=run.arm.name,
        joint_names=run.arm.joint_names,
        robot=robot.address,
        label=label,
        rows=rows,
    )


@contextmanager
def kept_if_stopped(run: Run | None, name: str) -> Iterator[None]:
    """Keep what an arm did in a motion that ends early, and that no journal keeps, as a log that the error names."""
    try:
        yield
    except BaseException as error:
        partial = recording_of(error)
        if run is not None and partial is not None and len(partial.time):
            part = "begin" if partial.controller == Playback.name else partial.controller
            path = _dated(run, name)
            try:
                write_log(path, partial.log(0, f"{name}/{part}/stopped"))
            except FileError as full:  # the first error is the one to report
                error.add_note(f"What was recorded until then is lost: {full}")
            else:
                error.add_note(f"What was recorded until then: {path}")
        raise


def _dated(run: Run, name: str) -> Path:
    """Return where a log whose name ends with the time goes; none takes the place of another."""
    return unused(run.folder.log(f"{name}-{datetime.now():%Y%m%d-%H%M%S}"))
