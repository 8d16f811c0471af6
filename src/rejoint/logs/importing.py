"""Import foreign logs: detect, read, split, check, write all or none."""

import re
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rejoint.arms import Arm, Array, Mask
from rejoint.logs.columns import FEWEST, PAUSE, RecordedMotion, read_motion
from rejoint.logs.consistency import (
    BETWEEN,
    FORCED,
    Remark,
    check_agreement,
    check_states,
    check_units,
    clean,
    copies,
    kept_remarks,
    unwrapped,
    without_spikes,
)
from rejoint.logs.exclusions import UNPOWERED, unpowered_joints
from rejoint.logs.joints import ImportOptions, Watched
from rejoint.logs.readers import READERS
from rejoint.logs.readers import Format as Format
from rejoint.logs.runlog import TWO_TURNS, RunLog, describe
from rejoint.system.errors import FileError, InputError
from rejoint.system.files import reading
from rejoint.system.progress import Progress, no_progress
from rejoint.system.records import value_type
from rejoint.system.textfile import DAMAGED

PAUSE_PERIODS = 5.0
"""median periods in a pause at least, and around scattered corrupt rows (chosen)"""


def parted(motion: RecordedMotion, arm: Arm) -> Iterator[RecordedMotion]:
    """Split at pauses, corrupt numbers, and where the clock was set back; FileError beyond `DAMAGED`."""
    notes, bad = list(motion.notes), ~np.isfinite(motion.time)
    for what, values in motion.angles.items():
        bad |= _corrupt(motion, what, values, arm)
    good = np.flatnonzero(~bad)
    steps = np.diff(motion.time[good])
    back = np.flatnonzero(steps < 0) + 1
    period = np.median(np.abs(steps)) if len(steps) else 0.0
    if not len(steps) or (len(back) and min(map(len, np.split(good, back))) * period < PAUSE):
        yield motion.take(good) if len(good) else motion  # what `clean` will say
        return
    far, holes = steps > PAUSE_PERIODS * period, np.diff(good) > 1
    paused = far & (steps > PAUSE)
    paused |= steps < 0
    pieces = np.split(good, np.flatnonzero(paused | holes) + 1)
    if min(map(len, pieces)) * period < PAUSE:  # holes so close would leave no motion
        pieces = np.split(good, np.flatnonzero(paused | far & holes) + 1)
    kept = [piece for piece in pieces if len(piece) >= FEWEST] or [good]
    cut = f"cut there into {len(kept)} log(s)" if len(kept) > 1 else "left out"
    if len(back):
        notes.append(f"state: the clock goes back {len(back)} time(s), first at {motion.where(good[back[0]])}; {cut}")
    elif paused.any():
        worst = np.argmax(steps)
        notes.append(
            f"state: {paused.sum()} pause(s) longer than {PAUSE:g} s, the longest {steps[worst]:.3g} s before "
            f"{motion.where(good[worst + 1])}; {cut}"
        )
    if bad.any():
        notes.append(f"{bad.sum()} row(s) with corrupt numbers, first at {motion.where(int(np.argmax(bad)))}; {cut}")
    for index, piece in enumerate(kept, start=1):
        name = f"{motion.name}-{index}of{len(kept)}" if len(kept) > 1 else motion.name
        yield replace(motion.take(piece), name=name, notes=notes)


def _corrupt(motion: RecordedMotion, what: str, values: Array, arm: Arm) -> Mask:
    """Return rows (T,) with a corrupt number."""
    unknown = ~np.isfinite(values)
    missing = unknown.any(axis=1)
    if missing.mean() > DAMAGED:
        row, joint = np.argwhere(unknown)[0].tolist()
        raise FileError(
            motion.path,
            f"{what}, {motion.where(row)}: joint {joint + 1} is {values[row, joint]}, one of {missing.sum()} rows with "
            "values that are not finite",
            "mend the values or cut the rows",
        )
    huge = missing | ((np.abs(values) > TWO_TURNS) & ~arm.endless).any(axis=1)
    return np.asarray(huge if huge.mean() <= DAMAGED else missing)


_EPOCH = 1e8
"""[s] larger clocks count from 1970 (chosen)"""

NO_COMMANDS = (
    "holds no commands: `diagnose` tells friction where the log has torques or currents; stiffness, lag and zeros, "
    "and so a twin, cannot be told"
)


def to_log(motion: RecordedMotion, arm: Arm, options: ImportOptions | None = None) -> tuple[RunLog, list[str]]:
    """Check a motion; FileError for a doubt, unless it is imported by force."""
    options, notes, reasons = options or ImportOptions(), list(motion.notes), []

    def take(remarks: Iterable[Remark]) -> None:
        for said, remedy in remarks:
            if not remedy:
                notes.append(said)
            elif not options.force:
                remedy += "; or go on with --force, which keeps this reason in the log"
                raise FileError(motion.path, said, remedy)
            elif said not in reasons:
                reasons.append(said)

    motion, remarks = clean(motion)
    take(remarks)
    if motion.time[0] >= _EPOCH:
        motion = replace(motion, time=motion.time - np.floor(motion.time[0]))
    take(check_units(motion, arm, options))
    motion, remarks = unwrapped(motion, arm)
    take(remarks)
    motion, remarks = without_spikes(motion)
    take(remarks)
    take(check_states(motion, arm))
    command = motion.command
    if command is None:
        notes.append(NO_COMMANDS)
        command = np.full_like(motion.position, np.nan)
    else:
        powered = (motion.more.get("gain", np.ones_like(command)) != 0).any(axis=-1)
        off = [joint for joint, name in enumerate(arm.joint_names) if name in options.torque_off]
        take(check_agreement(motion.take(powered), off))
        if not powered.all():
            notes.append(f"state: {(~powered).sum()} rows without torque")
    told = {FORCED: BETWEEN.join(reasons), UNPOWERED: ",".join(options.torque_off)}
    log = replace(
        RunLog.of(motion.time, command, motion.position, arm=arm, label=motion.name),
        robot=f"{motion.extra['format']}:{Path(motion.extra['source']).stem}",
        extra={**motion.extra, **{key: text for key, text in told.items() if text}},
        units=dict(motion.units),
        **dict[str, Any](motion.more),
    )
    notes.extend(
        f"state: {one} never answers its command: unpowered, too weak or stuck (--torque-off {one})"
        for one in unpowered_joints(log)
        if one not in options.torque_off
    )
    return log, [*notes, *kept_remarks(log)]


@value_type
class Imported:
    """Result of an import."""

    logs: tuple[RunLog, ...]
    notes: tuple[str, ...]
    """omissions and oddities"""
    skipped: tuple[str, ...]
    """failed logs with reasons"""


_NAMED = 8  # reasons for which logs are refused
_EXPECTED = (
    "a folder with SAGE's state_motor.csv, text with columns such as time_s, position.JOINT_rad and command.JOINT_rad, "
    "an MCAP file, a bag of ROS, or a folder with LeRobot's meta/info.json"
)


def import_logs(
    source: Path,
    arm: Arm,
    *,
    out: Path,
    format: Format | None = None,  # noqa: A002
    options: ImportOptions | None = None,
    on_progress: Progress = no_progress,
) -> Imported:
    """Import the logs at ``source`` as run logs of ``arm`` into the new folder ``out``.

    Parameters
    ----------
    source
        a file, or a folder of one or several motions
    out
        new or empty folder of ``MOTION.parquet``
    format
        a key of `READERS`; None detects it
    options
        units, joint names, topics
    on_progress
        receives the progress

    Raises
    ------
    FileError
        for a damaged or doubted file; among several it is skipped
    InputError
        for wrong or unread options

    An error leaves nothing behind.
    """
    watched: Any = Watched(options or ImportOptions())
    if unknown := [joint for joint in watched.torque_off if joint not in arm.joint_names]:
        raise InputError(f"--torque-off {unknown[0]!r}: {arm.name} has the joints {', '.join(arm.joint_names)}")
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} exists already; name a new folder for the imported logs")
    chosen = detect(source) if format is None else format
    if chosen not in READERS:
        raise InputError(f"--format {chosen!r}: expected {', '.join(READERS)}")
    paths = READERS[chosen].found(source) or [source] * source.is_file()
    if not paths:
        raise FileError(source, f"no log of format {chosen} here", "check the path or the format")
    logs = {}
    notes: dict[str, list[str]] = {}
    refused = []

    @contextmanager
    def refusing(name: str) -> Iterator[None]:
        """Note a FileError and go on."""
        try:
            yield
        except FileError as error:
            refused.append((_file_name(name), error))

    for done, path in enumerate(paths, start=1):
        with refusing(path.stem):
            for motion in READERS[chosen].read(path, watched):
                with refusing(motion.name):
                    for part in parted(read_motion(motion, arm, watched, source=path.resolve(), kind=chosen), arm):
                        name = _file_name(part.name)
                        with refusing(name):
                            log, remarks = to_log(part, arm, watched)
                            if name in logs:
                                raise FileError(
                                    source, f"a second log with the name {name}", "import it into another folder"
                                )
                            logs[name] = log
                            for remark in dict.fromkeys(remarks):
                                notes.setdefault(remark, []).append(name)
        on_progress(done / len(paths), _file_name(path.stem))
    count = len(logs)
    for name, original in copies(logs.items()).items():
        del logs[name]
        notes.setdefault(f"left out, for it holds the same readings as {original}", []).append(name)
    if not logs:
        if not refused:
            raise FileError(source, "holds no log", "take another one")
        why = {error.problem: error for _, error in reversed(refused)}
        if len(why) == 1:
            raise refused[0][1]
        said = "".join(f"\n  {error}" for error in [*reversed(why.values())][:_NAMED])
        raise FileError(source, "no log here can be imported", f"the first reasons:{said}")
    if unread := watched.unread():
        raise InputError(f"{', '.join(unread)}: nothing in {source} needs it; leave it out, or see --map")
    _write_whole(out, logs)
    return Imported(
        logs=tuple(logs.values()),
        notes=tuple(
            f"{names[0] if len(names) == 1 else f'{len(names)} of {count} logs ({names[0]}, ...)'}: {remark}"
            for remark, names in notes.items()
        ),
        skipped=tuple(f"{name} skipped: {error.problem}; {error.remedy}" for name, error in refused),
    )


def detect(source: Path) -> Format:
    """Format of the logs at a path; FileError unless exactly one fits."""
    if not source.exists():
        raise FileError(source, "no such file or folder", "check the path")
    with reading(source, "not readable", "check its permissions"):
        places = {name: paths for name, reader in READERS.items() if (paths := reader.found(source))}
        # parts of a bag are none of their own, and first bytes are surer than that it is text
        sure = {path for name, paths in places.items() if name != "table" for path in paths}
        fitting = [
            name
            for name, paths in places.items()
            if any(sure.isdisjoint([path, *path.parents][name != "table" :]) for path in paths)
        ]
        found = "" if fitting else describe(source)
    if not fitting:
        raise FileError(source, f"no log: {found}; expected {_EXPECTED}", "convert it to one of these")
    if len(fitting) > 1:
        said = f"holds logs of the formats {' and '.join(fitting)}"
        raise FileError(source, said, "say with --format which to import")
    return fitting[0]


def _file_name(motion: str) -> str:
    return re.sub(r"[^\w.+-]+", "-", motion).strip(".")[:100] or "log"


def _write_whole(out: Path, logs: dict[str, RunLog]) -> None:
    out = out.absolute()
    out.parent.mkdir(parents=True, exist_ok=True)
    # it is renamed whole, so that nothing is left to clean up
    with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        for name, log in logs.items():
            log.save(folder / f"{name}.parquet")
        folder.chmod(0o755)
        if out.exists():
            out.rmdir()
        folder.rename(out)
