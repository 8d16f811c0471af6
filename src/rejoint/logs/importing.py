"""Foreign logs in, run logs out: recognise the format, read, check, write all of them or none."""

from __future__ import annotations

import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rejoint.arms import Arm
from rejoint.logs import lerobot, mcapfile, rosbag, sage, table
from rejoint.logs.copies import copies
from rejoint.logs.found import describe
from rejoint.logs.joining import to_log
from rejoint.logs.options import ImportOptions
from rejoint.logs.parting import FEWEST, parted
from rejoint.logs.runlog import RunLog, write_log
from rejoint.logs.track import RecordedMotion
from rejoint.system.errors import FileError, InputError, first_line
from rejoint.system.progress import Progress, no_progress


@dataclass(frozen=True, kw_only=True)
class Imported:
    """What came out of an import."""

    logs: tuple[RunLog, ...]
    notes: tuple[str, ...]
    """what was left out or looks odd; empty where there is nothing to say"""


class _Reader(Protocol):
    def fits(self, source: Path, options: ImportOptions) -> bool: ...

    def motions(self, source: Path, arm: Arm, options: ImportOptions) -> tuple[int, Iterator[RecordedMotion]]: ...


_READERS: dict[str, _Reader] = {
    "sage": sage, "csv": table, "mcap": mcapfile, "rosbag": rosbag, "lerobot": lerobot,
}  # fmt: skip
FORMATS = tuple(_READERS)
"""Names of the formats that can be imported."""

_EXPECTED = (
    "a folder with SAGE's state_motor.csv, text with columns such as time_s, position.JOINT_rad and command.JOINT_rad, "
    "an MCAP file, a bag of ROS 2, or a folder with LeRobot's meta/info.json"
)


def import_logs(
    source: Path, arm: Arm, *, out: Path, format: str | None = None,  # noqa: A002
    options: ImportOptions | None = None, on_progress: Progress = no_progress,
) -> Imported:  # fmt: skip
    """Import the logs at ``source`` as run logs of ``arm`` into the new folder ``out``.

    Parameters
    ----------
    source
        a file, a motion's folder, or a folder of several of one format
    out
        folder to make; each log becomes ``MOTION.parquet`` in it. It must not exist or be empty.
    format
        one of `FORMATS`; None recognises it by content, and refuses where two fit
    options
        units, joint names, topics; what a format does not say and nobody declares is an error
    on_progress
        called after each log with the share of the logs that is done, and its name

    Raises
    ------
    FileError
        for a file that is damaged or contradicts the declarations; it names line, message or column
    InputError
        for declarations that cannot be

    Nothing is left behind where an error is raised.
    """
    options = options or ImportOptions()
    options.check_joints(arm)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} exists already; name a new folder for the imported logs")
    reader = _READERS[detect(source, options) if format is None else _known(format)]
    total, motions = reader.motions(source, arm, options)
    logs, notes = _checked(motions, total, arm, options, lambda done, name: on_progress(done / total, name))
    if not logs:
        raise FileError(source, "holds no log", "take another one")
    _write_whole(out, logs)
    return Imported(logs=tuple(logs.values()), notes=_remarks(notes, len(logs)))


def _checked(
    motions: Iterator[RecordedMotion],
    total: int,
    arm: Arm,
    options: ImportOptions,
    on_log: Callable[[int, str], object],
) -> tuple[dict[str, RunLog], dict[str, list[str]]]:
    """Turn motions into logs by file name; returns them and, by note, the logs that it is about."""
    logs: dict[str, RunLog] = {}
    notes: dict[str, list[str]] = {}
    for done, motion in enumerate(motions, start=1):
        if len(motion.state) < FEWEST and total > 1:  # begun and given up: no reason to refuse all the others
            short = f"left out, with {len(motion.state)} sample(s), where a log needs at least {FEWEST}"
            notes.setdefault(short, []).append(_file_name(motion.name))
            continue
        for part in parted(motion):
            log, remarks = to_log(part, arm, options)
            name = _file_name(part.name)
            if name in logs:
                raise FileError(
                    motion.state.path, f"a second log with the name {name}", "import it into another folder"
                )
            logs[name] = log
            for remark in remarks:
                notes.setdefault(remark, []).append(name)
            on_log(done, name)
    for name, original in copies(logs.items()).items():
        del logs[name]
        notes.setdefault(f"left out, for it holds the same readings as {original}", []).append(name)
    return logs, notes


def detect(source: Path, options: ImportOptions | None = None) -> str:
    """Name the format of the logs at a path by what they hold; FileError where none or more than one fits."""
    options = options or ImportOptions()
    if not source.exists():
        raise FileError(source, "no such file or folder", "check the path")
    try:
        fitting = [name for name, reader in _READERS.items() if reader.fits(source, options)]
    except OSError as error:
        raise FileError(source, f"not readable ({error})", "check its permissions") from error
    if source.is_file() and len(fitting) > 1:  # what a file is known by at its first byte is surer than that it is text
        fitting = [name for name in fitting if name != "csv"]
    if len(fitting) > 1:
        raise FileError(
            source, f"holds logs of the formats {' and '.join(fitting)}", "say with --format which to import"
        )
    if not fitting:
        try:
            found = describe(source)
        except OSError as error:
            raise FileError(source, f"not readable ({first_line(error)})", "check its permissions") from error
        raise FileError(source, f"no log: {found}; expected {_EXPECTED}", "convert it to one of these")
    return fitting[0]


def _known(name: str) -> str:
    if name not in _READERS:
        raise InputError(f"--format {name!r} is unknown; choose from {', '.join(_READERS)}")
    return name


def _file_name(motion: str) -> str:
    """Name of a motion as a file name: letters, digits, dots, dashes and underlines."""
    return re.sub(r"[^\w.+-]+", "-", motion).strip(".")[:100] or "log"


def _write_whole(out: Path, logs: dict[str, RunLog]) -> None:
    """Write the logs into a folder beside ``out`` and move it there when it is complete."""
    out = out.absolute()
    out.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}."))
    try:
        for name, log in logs.items():
            write_log(temporary / f"{name}.parquet", log)
        temporary.chmod(0o755)
        if out.exists():
            out.rmdir()
        temporary.rename(out)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _remarks(notes: dict[str, list[str]], total: int) -> tuple[str, ...]:
    """Put each note's logs in front of it; a note that many share is said once."""
    remarks = []
    for remark, names in notes.items():
        who = names[0] if len(names) == 1 else f"{len(names)} of {max(total, len(names))} logs ({names[0]}, ...)"
        remarks.append(f"{who}: {remark}")
    return tuple(remarks)
