"""Commands that work from logs alone, without a robot."""

from __future__ import annotations

from dataclasses import replace as changed
from pathlib import Path
from typing import TYPE_CHECKING, Any

import rejoint
from rejoint.arms import Arm
from rejoint.cli.console import results_of
from rejoint.cli.options import Call, listed, takes
from rejoint.logs import ImportOptions, export_log, import_logs, read_map
from rejoint.logs.consistency import forced_remarks
from rejoint.logs.runlog import read_log
from rejoint.session.inputs import arm_of_twin
from rejoint.system.errors import InputError
from rejoint.system.extras import require

if TYPE_CHECKING:
    from rejoint.twin.judge import Candidate
    from rejoint.twin.judgement import Errors, Judgement


@takes("arm", "part")
def replay(
    call: Call,
    twin: Path,
    logs: Path,
    published: list[str] | None = None,
    out: Path = Path("replay"),
) -> object:
    """Predict every motion open loop with a twin and show how far off it is, free space and contact apart."""
    require("rejoint replay", "train", "report")
    chosen = arm_of_twin(twin) if call.pick.arm is None else call.arm()
    replayed = rejoint.replay(twin, logs, arm=chosen, beside=read_sets(published, chosen), out=out)
    for remark in forced_remarks(replayed.logs):
        call.say(f"  ! {remark}")
    value = show_errors(call, replayed.judgement, out / "replay.json")
    call.result(f"Page: {replayed.page}")
    return value | {"page": replayed.page}


def read_sets(published: list[str] | None, arm: Arm) -> list[Candidate]:
    """Read published parameter sets given as FILE or NAME=FILE."""
    from rejoint.twin.judge import read_published

    found = []
    for given in published or []:
        name, named, path = given.rpartition("=")
        one = read_published(Path(path), arm)
        found.append(changed(one, name=name.strip()) if named and name.strip() else one)
    return found


def by_motion(given: list[str] | None) -> dict[str, str]:
    """Read MOTION=VALUE; InputError for anything else."""
    found: dict[str, str] = {}
    for one in given or []:
        name, named, value = one.rpartition("=")
        if not named or not name or not value:
            raise InputError(f"{one!r}: expected MOTION=VALUE")
        found[name] = f"{found[name]} {value}" if name in found else value
    return found


def show_errors(call: Call, judgement: Judgement, file: Path) -> dict[str, Any]:
    """Print the errors of every motion, and what to trust; return them without the traces that are in ``file``."""
    from rejoint.pages.report.tables import answer

    names = list(judgement.mean)
    headers = ["motion", "s", *names]
    rows = [
        [motion.motion, f"{motion.seconds:.0f}", *(_cell(motion.errors[name]) for name in names)]
        for motion in judgement.motions
    ]
    rows.append(["mean over motions", "", *(_cell(judgement.mean[name]) for name in names)])
    title = "Open-loop error of the tool, rms by encoders: free / contact / all [mm]"
    call.table(title, headers, rows, len(rows) - 1)
    for line in answer(judgement):
        call.result(line)
    return results_of(judgement) | {"worst": {"motion": judgement.worst.motion, "traces": str(file)}}


def _cell(errors: Errors) -> str:
    parts = (errors.free, errors.contact, errors.all)
    return " / ".join("-" if part is None else f"{1e3 * part.tcp:.2f}" for part in parts)


@takes("arm", "part")
def import_(
    call: Call,
    source: Path,
    out: Path,
    kind: str | None = None,
    angle_unit: str | None = None,
    time_unit: str | None = None,
    rate: float | None = None,
    columns: list[str] | None = None,
    order: str | None = None,
    torque_off: str | None = None,
    state_topic: str | None = None,
    command_topic: str | None = None,
    stamp: str | None = None,
    calibration: Path | None = None,
    force: bool = False,
) -> object:
    """Turn logs of other programs into run logs; units, joint order and clock are checked, never guessed."""
    options = ImportOptions(
        angle_unit=angle_unit,
        time_unit=time_unit,
        rate=rate,
        columns=read_map(columns) if columns else None,
        names=listed(order or "") or None,
        state_topic=state_topic,
        command_topic=command_topic,
        stamp=stamp,
        calibration=calibration,
        torque_off=listed(torque_off or "") or None,
        force=force,
    )
    chosen = call.arm()
    with call.progress("import") as update:
        imported = import_logs(source, chosen, out=out, format=kind, options=options, on_progress=update)
    for note in (*imported.notes, *imported.skipped):
        call.say(note)
    seconds, count = sum(float(log.time[-1] - log.time[0]) for log in imported.logs), len(imported.logs)
    skipped = f"; {len(imported.skipped)} skipped" * bool(imported.skipped)
    call.result(f"{count} run log{'s' * (count != 1)}, {seconds:.0f} s of motion, in {out}{skipped}")
    return {"out": out, "logs": count, "seconds": seconds, "notes": imported.notes, "skipped": imported.skipped}


@takes()
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
        from rejoint.runs.exporting.exports import export_run

        kind = kind or ("lerobot" if lerobot else "onnx")
        out, told = export_run(source, kind, out, lerobot=lerobot, controller=controller)
        call.say(told)
    elif out is None:
        raise InputError(
            "export takes a run log (.parquet) and a file to write (.csv or .mcap), or a run folder and --format: "
            "urdf, mjcf, isaaclab, lerobot, datasheet, onnx or ros2"
        )
    else:
        export_log(read_log(source), out)
    call.result(str(out))
    return {"out": out}
