"""Commands that drive no robot: on logs, and those that find ports, arms by name, runs and their reports."""

from __future__ import annotations

import webbrowser
from dataclasses import replace as changed
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal
from urllib.parse import quote

import rejoint
from rejoint.arms import CATALOGUE, Arm
from rejoint.cli.options import Call, listed, takes
from rejoint.logs.consistency import remarks_on
from rejoint.logs.exporting import export_log
from rejoint.logs.importing import Format, import_logs
from rejoint.logs.joints import ImportOptions, read_map
from rejoint.logs.runfolder import RUNS, files_below, runs_below
from rejoint.logs.runlog import RunLog
from rejoint.robots import place_of
from rejoint.robots import ports as lines
from rejoint.runs.fleet.file import known_arms, name_arm, names_file, remove_name
from rejoint.runs.run import Run
from rejoint.session.inputs import arm_of_twin, run_of_twin, settled
from rejoint.system.errors import FileError, InputError
from rejoint.system.extras import require
from rejoint.system.shell import command

if TYPE_CHECKING:
    from rejoint.twin.judge import Candidate
    from rejoint.twin.twin import Errors, Judgement


@takes
def replay(
    call: Call, twin: Path, logs: Path, published: list[str] | None = None, out: Path = Path("replay")
) -> object:
    """Predict every motion open loop with a twin and show how far off it is, free space and contact apart."""
    require("rejoint replay", "train", "report")
    chosen = arm_of_twin(twin, None if call.pick.arm is None else call.arm())
    if said := settled(None, run_of_twin(twin), None)[1]:
        call.message(said)
    replayed = rejoint.replay(twin, logs, arm=chosen, beside=read_sets(published, chosen), out=out)
    for remark in remarks_on(replayed.logs):
        call.message(f"  ! {remark}")
    value = show_errors(call, replayed.judgement)
    call.result(f"Page: {replayed.page}")
    return value | {"page": replayed.page}


def read_sets(published: list[str] | None, arm: Arm) -> list[Candidate]:
    """Read published parameter sets given as FILE or NAME=FILE."""
    from rejoint.twin.judge import read_published

    found = []
    for given in published or []:
        name, _, path = given.rpartition("=")
        one = read_published(Path(path), arm)
        found.append(changed(one, name=name.strip()) if name.strip() else one)
    return found


def by_motion(given: list[str] | None) -> dict[str, float]:
    """Read MOTION=NUMBER; InputError for anything else."""
    found = {}
    for one in given or []:
        name, _, value = one.rpartition("=")
        try:
            found[name] = float(value)
        except ValueError as error:
            raise InputError(f"{one!r}: expected MOTION=NUMBER") from error
    return found


def show_errors(call: Call, judgement: Judgement) -> dict[str, Any]:
    """Print the errors of every motion, and what to trust; return them."""
    from rejoint.pages.report.tables import answer

    names = list(judgement.mean)
    rows = [
        [motion.motion, f"{motion.seconds:.0f}", *(_cell(motion.errors[name]) for name in names)]
        for motion in judgement.motions
    ]
    rows.append(["mean over motions", "", *(_cell(judgement.mean[name]) for name in names)])
    title = "Open-loop error of the tool, rms by encoders: free / contact / all [mm]"
    call.table(title, ["motion", "s", *names], rows, len(rows) - 1)
    for line in answer(judgement):
        call.result(line)
    return vars(judgement)


def _cell(errors: Errors) -> str:
    return " / ".join(
        "-" if part is None else f"{1e3 * part.tcp:.2f}" for part in (errors.free, errors.contact, errors.all)
    )


@takes
def import_(
    call: Call,
    source: Path,
    out: Path,
    kind: Format | None = None,
    *,
    options: ImportOptions,
    columns: list[str] | None = None,
    order: str = "",
    torque_off: str = "",
) -> object:
    """Turn logs of other programs into run logs; units, joint order and clock are checked, never guessed."""
    options = changed(options, columns=read_map(columns or ()), names=listed(order), torque_off=listed(torque_off))
    if call.pick.arm is None:
        raise InputError("import: whose motion is it? Name the arm with --arm, or give its URDF, MJCF or TOML file")
    chosen = call.arm()
    with call.bar("import") as update:
        imported = import_logs(source, chosen, out=out, format=kind, options=options, on_progress=update)
    for note in (*imported.notes, *imported.skipped):
        call.message(note)
    seconds, count = sum(log.duration for log in imported.logs), len(imported.logs)
    skipped = f"; {len(imported.skipped)} skipped" * bool(imported.skipped)
    call.result(f"{count} run log{'s' * (count != 1)}, {seconds:.0f} s of motion, in {out}{skipped}")
    return {"out": out, "logs": count, "seconds": seconds, "notes": imported.notes, "skipped": imported.skipped}


@takes
def export(
    call: Call,
    source: Path,
    out: Path | None = None,
    kind: str | None = None,
    lerobot: Path | None = None,
    controller: str | None = None,
) -> object:
    """Write a run log as CSV or MCAP."""
    if kind is not None or lerobot is not None or controller is not None:
        from rejoint.runs.exports import export_run

        kind = kind or ("lerobot" if lerobot else "onnx")
        out, told = export_run(source, kind, out, lerobot=lerobot, controller=controller)
        call.message(told)
    elif out is None:
        raise InputError(
            "export takes a run log (.parquet) and a file to write (.csv or .mcap), or a run folder and --format: "
            "urdf, mjcf, isaaclab, lerobot, datasheet, onnx or ros2"
        )
    else:
        export_log(RunLog.load(source), out)
    call.result(str(out))
    return {"out": out}


@takes
def ports(call: Call) -> object:
    """List the serial ports of this computer, each with the arm that answers there; nothing moves."""
    found = []
    for device, what in lines.ports().items():
        why, address = lines.refused(device), lines.arm_at(device)
        found.append({"port": device, "what": what, "address": address, "problem": why})
        call.result(f"{device}  {what}: {address or why or 'no arm answers'}")
    if not found:
        call.result("No serial port; is the cable in, and the arm switched on?")
    return {"ports": found}


@takes
def arms(
    call: Call,
    verb: Literal["add", "list", "remove"] = "list",
    name: str | None = None,
    address: str | None = None,
    calibration: Path | None = None,
    arm: str | None = None,
    tolerance: float | None = None,
) -> object:
    """Give arms names, which every command takes for their addresses."""
    if verb == "list":
        path, known = names_file(), known_arms()
        rows = [[one.name, one.address, one.description or "", f"{one.tolerance_mm or ''}"] for one in known]
        if rows:
            call.table(f"Arms of {path}", ["name", "address", "arm", "tolerance mm"], rows)
        else:
            call.result("No arm has a name; give one: rejoint arms add NAME ADDRESS")
        return {"file": path, "arms": {one.name: one.address for one in known}}
    if name is None or (address is None) == (verb == "add"):
        raise InputError("expected: rejoint arms add NAME ADDRESS, rejoint arms remove NAME, or rejoint arms list")
    if address is None:
        call.result(f"{name} is no name any more, in {remove_name(name)}")
        return {"removed": name}
    if calibration is not None:
        if not hasattr(place_of(address).detail, "calibration"):
            raise InputError(f"--calibration is LeRobot's, of a bus of servos, and {address} is none: leave it out")
        if not calibration.is_file():
            raise FileError(calibration, "no such file", "give LeRobot's calibration of this arm (.json)")
        address += f"{'&' if '?' in address else '?'}calibration={quote(str(calibration.resolve()))}"
    if arm is not None and arm.lower() not in CATALOGUE:
        arm = str(Path(arm).resolve())
    more = {"description": arm, "tolerance_mm": tolerance}
    path = name_arm(name, address=address, **{key: value for key, value in more.items() if value is not None})
    call.result(f"{name} is {address}, in {path}")
    call.next(command("doctor", name))
    return {"file": path, "name": name, "address": address}


@takes
def runs(call: Call, folder: Path = RUNS) -> object:
    """List the runs of a folder, the newest first."""
    if not folder.is_dir():
        raise FileError(folder, "no such folder", "begin a run: rejoint repair ROBOT")
    rows, found = [], []
    for files, info in runs_below(folder).items():
        stages = ("diagnosis", "calibration", "twin", "policy", "comparison", "report")
        done = [name for name in stages if getattr(files, name).exists()]
        state = "finished" if files.finished.exists() else f"{done[-1]} done" if done else "begun"
        state += " (a quick try)" * files.quick.exists()
        rows.append([str(files.path), info.robot, info.arm, info.created.replace("T", " "), state])
        found.append({"run": files.path, "robot": info.robot, "arm": info.arm, "created": info.created, "done": done})
    if rows:
        call.table(f"Runs below {folder}, the newest first", ["run", "robot", "arm", "begun", "state"], rows)
    else:
        call.result(f"There is no run below {folder}; begin one: rejoint repair ROBOT")
    return {"runs": found}


@takes
def open_(call: Call, run: Path | None = None) -> object:
    """Open the report of a run in the browser."""
    if run is None:
        reports = sorted(files_below(RUNS, "report.html"), key=lambda one: one.stat().st_mtime)
        if not reports:
            raise FileError(RUNS, "no run with a report is below it", "make one: rejoint repair ROBOT")
        run = reports[-1].parent
    page = Run.open(run).page.resolve()
    if not page.exists():
        raise FileError(page, "no report", f"write it: {command('report', run)}")
    call.result(str(page))
    if not webbrowser.open(page.as_uri()):
        call.message("No browser was found here: open that file in one.")
    return {"report": page}
