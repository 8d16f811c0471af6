"""Commands that work from logs alone, without a robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace as changed
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer

import rejoint
from rejoint.arms import Arm, tcp_position
from rejoint.cli import options as opt
from rejoint.cli import show
from rejoint.cli.console import Terminal, results_of, watched
from rejoint.cli.options import Json
from rejoint.logs import ANGLE_UNITS, FORMATS, STAMPS, TIME_UNITS, ImportOptions, export_log, import_logs, read_map
from rejoint.logs.consistency import forced_remarks
from rejoint.logs.runlog import RunLog, read_log
from rejoint.runs.run import Run
from rejoint.session.inputs import arm_of_twin, as_logs
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.shell import command

if TYPE_CHECKING:
    from rejoint.runs.stages.report import Replayed
    from rejoint.twin.judge import Candidate
    from rejoint.twin.judgement import Errors, Judgement

Logs = Annotated[Path, typer.Option(help="Folder of run logs (.parquet), such as `rejoint import` writes.")]
Published = Annotated[
    list[str] | None,
    typer.Option(help="FILE or NAME=FILE: a published parameter set (TOML) to judge beside the twin; repeatable."),
]
HeldOut = Annotated[
    list[str] | None,
    typer.Option(
        help="Motion to keep from the fit and judge it by; repeatable. none: judge it on what it has seen. By default "
        "a quarter of the motions is drawn."
    ),
]
Gain = Annotated[
    list[str] | None,
    typer.Option(
        help="MOTION=GAIN: the servos' position gain in a motion over that which the twin is to have, one number or "
        "one for each joint; repeatable."
    ),
]
TorqueOff = Annotated[
    list[str] | None,
    typer.Option(help="MOTION=FROM-TO: seconds of a motion in which the servos give no torque; repeatable."),
]


def diagnose_from_logs(terminal: Terminal, job: Run, logs: Path, good: Path | None) -> None:
    """Judge an arm by the run logs in a folder and write the diagnosis into the run folder of ``job``."""
    with watched(terminal, "diagnose", "diagnosing", None) as observer:
        found = rejoint.diagnose(logs, run=job, healthy=good, observer=observer).diagnosis
    show.diagnosis(terminal, found)
    terminal.next(command("identify", "--logs", logs, "--run", job.path))
    terminal.finish({"run": str(job.path), "diagnosis": found})


def identify_from_logs(
    terminal: Terminal,
    job: Run,
    logs: Path,
    published: list[str] | None,
    hold_out: list[str] | None,
    gain: list[str] | None,
    torque_off: list[str] | None,
) -> None:
    """Fit a twin to the run logs in a folder, judge it, and write both and the report into a run folder."""
    beside = read_sets(published, job.arm)
    with watched(terminal, "identify", "identifying", None) as observer:
        kept = None if not hold_out else [name for name in hold_out if name != "none"]
        twin = rejoint.identify(
            logs,
            run=job,
            observer=observer,
            plan=rejoint.LogPlan(
                beside=beside, hold_out=kept, gain=_by_motion(gain), torque_off=_by_motion(torque_off)
            ),
        )
    show.twin(terminal, twin)
    say_forced(terminal, as_logs(logs))
    if twin.judgement is not None:
        show_errors(terminal, twin.judgement)
    path = rejoint.report(job)
    terminal.result(f"Twin: {job.folder.twin}")
    terminal.result(f"Report: {path}")
    terminal.finish(
        {
            "run": str(job.path),
            "twin": str(job.folder.twin),
            "report": str(path),
            "fitted": twin.fitted,
            "judgement": None if twin.judgement is None else _without_trace(twin.judgement, job.folder.judgement),
            "notes": twin.notes,
        }
    )


@opt.with_arm
def replay(
    twin: Annotated[Path, typer.Argument(help="Twin (.toml) to judge.")],
    logs: Logs,
    published: Published = None,
    out: Annotated[Path, typer.Option(help="Folder for the page and its figures.")] = Path("replay"),
    json: Json = False,
    *,
    pick: opt.ArmPick,
) -> None:
    """Predict every motion open loop with a twin and show how far off it is, free space and contact apart.

    Example: `rejoint replay runs/so101/twin.toml --logs logs/so101 --published maker.toml --out replay`
    """
    require("rejoint replay", "train", "report")
    terminal = Terminal(json=json)
    chosen = arm_of_twin(twin) if pick.source is None else opt.choose_arm(terminal, pick)
    replayed = rejoint.replay(twin, logs, arm=chosen, beside=read_sets(published, chosen), out=out)
    say_forced(terminal, replayed.logs)
    if replayed.judgement is None:
        show_followed(terminal, chosen, replayed)
        return
    show_errors(terminal, replayed.judgement)
    terminal.result(f"Page: {replayed.page}")
    told = _without_trace(replayed.judgement, out / "replay.json")
    terminal.finish({**told, "page": str(replayed.page)})


def _without_trace(judgement: Judgement, file: Path) -> dict[str, Any]:
    return results_of(judgement) | {"worst": {"motion": judgement.worst.motion, "traces": str(file)}}


def read_sets(published: list[str] | None, arm: Arm) -> list[Candidate]:
    """Read published parameter sets given as FILE or NAME=FILE."""
    from rejoint.twin.judge import read_published

    found = []
    for given in published or []:
        name, named, path = given.rpartition("=")
        one = read_published(Path(path), arm)
        found.append(changed(one, name=name.strip()) if named and name.strip() else one)
    return found


def say_forced(terminal: Terminal, logs: Sequence[RunLog]) -> None:
    """Repeat what spoke against logs that were imported by force."""
    for remark in forced_remarks(logs):
        terminal.say(f"  ! {remark}")


def show_followed(terminal: Terminal, arm: Arm, replayed: Replayed) -> None:
    """Print how the twin follows paths of which only states are known."""
    rows, found = [], []
    for log, follows in zip(replayed.logs, replayed.positions, strict=True):
        off = 1e3 * np.linalg.norm(tcp_position(arm, follows) - tcp_position(arm, log.position), axis=1)
        rms, most = float(np.sqrt(np.mean(off**2))), float(off.max())
        seconds = float(log.time[-1] - log.time[0])
        rows.append([log.label, f"{seconds:.0f}", f"{rms:.2f}", f"{most:.2f}"])
        found.append({"motion": log.label, "seconds": seconds, "rms_mm": rms, "most_mm": most})
    terminal.table("The twin, sent along the recorded path", ["motion", "s", "rms mm", "most mm"], rows)
    terminal.result(
        "These logs hold no commands: how well the twin predicts the arm cannot be told, and no page is written."
    )
    terminal.finish({"followed": found, "judgement": None, "page": None})


def _by_motion(given: list[str] | None) -> dict[str, str]:
    found: dict[str, str] = {}
    for one in given or []:
        name, named, value = one.rpartition("=")
        if not named or not name or not value:
            raise InputError(f"{one!r}: expected MOTION=VALUE")
        found[name] = f"{found[name]} {value}" if name in found else value
    return found


def show_errors(terminal: Terminal, judgement: Judgement) -> None:
    """Print the errors of every motion, and which prediction to trust."""
    from rejoint.pages.report.tables import answer

    names = list(judgement.mean)
    headers = ["motion", "s", *names]
    rows = [
        [motion.motion, f"{motion.seconds:.0f}", *(_cell(motion.errors[name]) for name in names)]
        for motion in judgement.motions
    ]
    rows.append(["mean over motions", "", *(_cell(judgement.mean[name]) for name in names)])
    title = "Open-loop error of the tool, rms by encoders: free / contact / all [mm]"
    terminal.table(title, headers, rows, len(rows) - 1)
    for line in answer(judgement):
        terminal.result(line)


def _cell(errors: Errors) -> str:
    parts = (errors.free, errors.contact, errors.all)
    return " / ".join("-" if part is None else f"{1e3 * part.tcp:.2f}" for part in parts)


@opt.with_arm
def import_(
    source: Annotated[
        Path, typer.Argument(help="File or folder: text with columns, JSON, NumPy, bags, MCAP, LeRobot or SAGE.")
    ],
    out: Annotated[Path, typer.Argument(help="New folder for the run logs.")],
    kind: Annotated[
        str | None, typer.Option("--format", help=f"One of {', '.join(FORMATS)}; by default found from the content.")
    ] = None,
    angle_unit: Annotated[
        str | None, typer.Option(help=f"Unit of angles, where the source is silent: {', '.join(ANGLE_UNITS)}.")
    ] = None,
    time_unit: Annotated[
        str | None, typer.Option(help=f"Unit of times, where the source is silent: {', '.join(TIME_UNITS)}.")
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Rows in a second of a file without a time.")] = None,
    columns: Annotated[
        list[str] | None,
        typer.Option(
            "--map",
            help="What is what in the file: time=t, JOINT=q1, command.JOINT=u1, JOINT=m1/6.33-0.6, "
            "command=27..32; several times, by commas, or a TOML file.",
        ),
    ] = None,
    order: Annotated[str | None, typer.Option(help="Names of columns that have none, comma-separated.")] = None,
    torque_off: Annotated[str | None, typer.Option(help="Joints that had no torque, comma-separated.")] = None,
    state_topic: Annotated[str | None, typer.Option(help="Topic of the measured state in a bag.")] = None,
    command_topic: Annotated[str | None, typer.Option(help="Topic of the commands in a bag.")] = None,
    stamp: Annotated[str | None, typer.Option(help=f"Clock of a bag: {' or '.join(STAMPS)}.")] = None,
    calibration: Annotated[Path | None, typer.Option(help="LeRobot calibration file for normalised angles.")] = None,
    force: Annotated[
        bool,
        typer.Option("--force", help="Import despite failed consistency checks; the warnings are stored in the log."),
    ] = False,
    json: Json = False,
    *,
    pick: opt.ArmPick,
) -> None:
    """Turn logs of other programs into run logs; units, joint order and clock are checked, never guessed.

    Example: `rejoint import recordings/so101 logs/so101 --arm so101`
    """
    terminal = Terminal(json=json)
    options = ImportOptions(
        angle_unit=angle_unit,
        time_unit=time_unit,
        rate=rate,
        columns=read_map(columns) if columns else None,
        names=_names(order),
        state_topic=state_topic,
        command_topic=command_topic,
        stamp=stamp,
        calibration=calibration,
        torque_off=_names(torque_off),
        force=force,
    )
    chosen = opt.choose_arm(terminal, pick)
    with terminal.progress("importing") as update:
        imported = import_logs(source, chosen, out=out, format=kind, options=options, on_progress=update)
    for note in (*imported.notes, *imported.skipped):
        terminal.say(note)
    seconds = sum(float(log.time[-1] - log.time[0]) for log in imported.logs)
    count = len(imported.logs)
    skipped = f"; {len(imported.skipped)} skipped" * bool(imported.skipped)
    terminal.result(f"{count} run log{'s' * (count != 1)}, {seconds:.0f} s of motion, in {out}{skipped}")
    terminal.finish(
        {"out": str(out), "logs": count, "seconds": seconds, "notes": imported.notes, "skipped": imported.skipped}
    )


def export(
    source: Annotated[
        Path, typer.Argument(help="Run log (.parquet), or with --format a run folder.", metavar="SOURCE")
    ],
    out: Annotated[
        Path | None,
        typer.Argument(help="File to write: of a log .csv, or .mcap for PlotJuggler, Foxglove and Rerun."),
    ] = None,
    kind: Annotated[
        str | None,
        typer.Option(
            "--format",
            help="Of a run: urdf (this unit), lerobot (its zeros), datasheet (a page), onnx or ros2 (its controller).",
        ),
    ] = None,
    lerobot: Annotated[Path | None, typer.Option(help="Calibration file of LeRobot whose zeros to correct.")] = None,
    controller: Annotated[
        str | None, typer.Option(help="For onnx and ros2: its name; by default what the run recommends.")
    ] = None,
    json: Json = False,
) -> None:
    """Write a run log as CSV or MCAP, or what a run has found out: URDF, LeRobot's calibration, data sheet, controller.

    Example: `rejoint export runs/mine/logs/excitation.parquet excitation.mcap`, or
    `rejoint export runs/mine --format urdf`
    """
    terminal = Terminal(json=json)
    if kind is not None or lerobot is not None or controller is not None:
        from rejoint.runs.exporting.exports import export_run

        out, told = export_run(
            source, kind or ("lerobot" if lerobot else "onnx"), out, lerobot=lerobot, controller=controller
        )
        terminal.say(told)
    elif out is None:
        raise InputError(
            "export takes a run log (.parquet) and a file to write (.csv or .mcap), or a run folder and --format: "
            "urdf, lerobot, datasheet, onnx or ros2"
        )
    else:
        export_log(read_log(source), out)
    terminal.result(str(out))
    terminal.finish({"out": str(out)})


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(name.strip() for name in text.split(",") if name.strip())
