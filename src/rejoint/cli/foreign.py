"""Commands for logs that something else recorded, and for tools that read ours."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rejoint.cli.console import Terminal
from rejoint.cli.options import ArmOption, Base, Hold, Json, Tip, choose_arm
from rejoint.logs import ANGLE_UNITS, FORMATS, STAMPS, TIME_UNITS, ImportOptions, export_log, import_logs
from rejoint.logs.runlog import read_log
from rejoint.system.errors import InputError


def import_(
    source: Annotated[Path, typer.Argument(help="File or folder: SAGE, CSV, MCAP or LeRobot dataset (v3).")],
    out: Annotated[Path, typer.Argument(help="New folder for the run logs.")],
    arm: ArmOption = None,
    base: Base = None,
    tip: Tip = None,
    hold: Hold = None,
    kind: Annotated[
        str | None, typer.Option("--format", help=f"One of {', '.join(FORMATS)}; by default found from the content.")
    ] = None,
    angle_unit: Annotated[
        str | None, typer.Option(help=f"Unit of angles, where the source is silent: {', '.join(ANGLE_UNITS)}.")
    ] = None,
    time_unit: Annotated[
        str | None, typer.Option(help=f"Unit of times, where the source is silent: {', '.join(TIME_UNITS)}.")
    ] = None,
    joints: Annotated[
        str | None, typer.Option(help="Names in the source and in the arm: theirs=ours,theirs=ours.")
    ] = None,
    order: Annotated[str | None, typer.Option(help="Joint names of unnamed columns, comma-separated.")] = None,
    state_topic: Annotated[str | None, typer.Option(help="MCAP topic of the measured state.")] = None,
    command_topic: Annotated[str | None, typer.Option(help="MCAP topic of the commands.")] = None,
    stamp: Annotated[str | None, typer.Option(help=f"MCAP clock: {' or '.join(STAMPS)}.")] = None,
    calibration: Annotated[Path | None, typer.Option(help="LeRobot calibration file for normalised angles.")] = None,
    columns: Annotated[
        str | None, typer.Option("--map", help="CSV columns by other names: time=t,JOINT=q1,command.JOINT=u1.")
    ] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Go on where a log is doubted; the reasons stay in it.")
    ] = False,
    json: Json = False,
) -> None:
    """Turn logs of other programs into run logs; units, joint order and clock are checked, never guessed.

    Example: `rejoint import recordings/so101 logs/so101 --arm so101`
    """
    terminal = Terminal(json=json)
    options = ImportOptions(
        angle_unit=angle_unit, time_unit=time_unit, joint_map=_pairs(joints, "--joints"), joint_order=_names(order),
        state_topic=state_topic, command_topic=command_topic, stamp=stamp, calibration=calibration,
        columns=_pairs(columns, "--map"), force=force,
    )  # fmt: skip
    chosen = choose_arm(terminal, arm, base, tip, hold=hold)
    with terminal.progress("importing") as update:
        imported = import_logs(source, chosen, out=out, format=kind, options=options, on_progress=update)
    for note in imported.notes:
        terminal.say(note)
    seconds = sum(float(log.time[-1] - log.time[0]) for log in imported.logs)
    count = len(imported.logs)
    terminal.result(f"{count} run log{'s' * (count != 1)}, {seconds:.0f} s of motion, in {out}")
    terminal.finish({"out": str(out), "logs": len(imported.logs), "seconds": seconds, "notes": imported.notes})


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
    json: Json = False,
) -> None:
    """Write a run log as CSV or MCAP, or what a run has found out: URDF, LeRobot's calibration, data sheet, controller.

    Example: `rejoint export runs/mine/logs/excitation.parquet excitation.mcap`, or
    `rejoint export runs/mine --format urdf`
    """
    terminal = Terminal(json=json)
    if kind is not None or lerobot is not None:
        from rejoint.runs.exports import export_run

        out, told = export_run(source, kind or "lerobot", out, lerobot=lerobot)
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


def _pairs(text: str | None, option: str) -> dict[str, str] | None:
    if text is None:
        return None
    pairs = [part.split("=") for part in text.split(",")]
    if any(len(pair) != 2 or not all(side.strip() for side in pair) for pair in pairs):
        sides = "theirs=ours" if option == "--joints" else "ours=theirs"
        raise InputError(f"{option} {text!r}: expected {sides},{sides}")
    found = {left.strip(): right.strip() for left, right in pairs}
    if len(found) != len(pairs):
        raise InputError(f"{option} {text!r}: says the same name twice")
    return found


def _names(text: str | None) -> tuple[str, ...] | None:
    return None if text is None else tuple(name.strip() for name in text.split(",") if name.strip())
