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
from rejoint.cli import show
from rejoint.cli.console import Terminal, results_of
from rejoint.cli.options import ArmOption, Base, Hold, Json, Tip, choose_arm
from rejoint.logs.bare import states_alone
from rejoint.logs.doubts import forced_remarks
from rejoint.logs.runlog import RunLog
from rejoint.runs.given import arm_of_twin, as_logs
from rejoint.runs.run import Run
from rejoint.system.errors import InputError
from rejoint.system.extras import require
from rejoint.system.shell import command

if TYPE_CHECKING:
    from rejoint.runs.stages.replay import Replayed
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
    with terminal.progress("diagnosing") as update:
        found = rejoint.diagnose(logs, run=job, healthy=good, on_progress=update).diagnosis
    show.diagnosis(terminal, found)
    if states_alone(as_logs(logs), "diagnosis"):
        terminal.result(f"Next: record commands as well; this diagnosis is in {job.path}")
    else:
        terminal.result(f"Next: {command('identify', '--logs', logs, '--run', job.path)}")
    terminal.finish({"run": str(job.path), "diagnosis": found})


def identify_from_logs(
    terminal: Terminal, job: Run, logs: Path, published: list[str] | None, hold_out: list[str] | None,
    gain: list[str] | None, torque_off: list[str] | None,
) -> None:  # fmt: skip
    """Fit a twin to the run logs in a folder, judge it, and write both and the report into a run folder."""
    beside = read_sets(published, job.arm)
    with terminal.progress("identifying") as update:
        kept = None if not hold_out else [name for name in hold_out if name != "none"]
        twin = rejoint.identify(
            logs, run=job, beside=beside, hold_out=kept, gain=_by_motion(gain), torque_off=_by_motion(torque_off),
            on_progress=update,
        )  # fmt: skip
    show.twin(terminal, twin)
    say_forced(terminal, as_logs(logs))
    if twin.judgement is not None:
        show_errors(terminal, twin.judgement)
    path = rejoint.report(job)
    terminal.result(f"Twin: {job.folder.twin}")
    terminal.result(f"Report: {path}")
    terminal.finish({
        "run": str(job.path), "twin": str(job.folder.twin), "report": str(path), "fitted": twin.fitted,
        "judgement": None if twin.judgement is None else _without_trace(twin.judgement, job.folder.judgement),
        "notes": twin.notes,
    })  # fmt: skip


def replay(
    twin: Annotated[Path, typer.Argument(help="Twin (.toml) to judge.")],
    logs: Logs,
    arm: ArmOption = None,
    base: Base = None,
    tip: Tip = None,
    hold: Hold = None,
    published: Published = None,
    out: Annotated[Path, typer.Option(help="Folder for the page and its figures.")] = Path("replay"),
    json: Json = False,
) -> None:
    """Predict every motion open loop with a twin and show how far off it is, free space and contact apart.

    Example: `rejoint replay runs/so101/twin.toml --logs logs/so101 --published maker.toml --out replay`
    """
    require("rejoint replay", "train", "report")
    terminal = Terminal(json=json)
    chosen = arm_of_twin(twin) if arm is None else choose_arm(terminal, arm, base, tip, hold=hold)
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
    """Return a judgement as plain data; of the motion predicted worst, its name and the file with its traces."""
    return results_of(judgement) | {"worst": {"motion": judgement.worst.motion, "traces": str(file)}}


def read_sets(published: list[str] | None, arm: Arm) -> list[Candidate]:
    """Read published parameter sets given as FILE or NAME=FILE."""
    from rejoint.twin.published import read_published

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
    """Collect what is given as MOTION=VALUE; values of one motion are put one after the other."""
    found: dict[str, str] = {}
    for one in given or []:
        name, named, value = one.rpartition("=")
        if not named or not name or not value:
            raise InputError(f"{one!r}: expected MOTION=VALUE")
        found[name] = f"{found[name]} {value}" if name in found else value
    return found


def show_errors(terminal: Terminal, judgement: Judgement) -> None:
    """Print the errors of every motion, and which prediction to trust."""
    from rejoint.pages.report.trust import answer

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
