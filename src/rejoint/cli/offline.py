"""Commands that work from logs alone, without a robot."""

from __future__ import annotations

from dataclasses import replace as changed
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
import typer

from rejoint.arms import Arm
from rejoint.cli import show
from rejoint.cli.console import Terminal
from rejoint.cli.options import ArmOption, Base, Json, Tip, choose_arm
from rejoint.logs.runlog import RunLog, read_log
from rejoint.runs import opening
from rejoint.runs import stages as work
from rejoint.runs.folder import RunFolder, locked
from rejoint.system.errors import FileError
from rejoint.system.extras import require

if TYPE_CHECKING:
    from rejoint.twin.judge import Candidate
    from rejoint.twin.judgement import Errors, Judgement

Logs = Annotated[Path, typer.Option(help="Folder of run logs (.parquet), such as `rejoint import` writes.")]
Published = Annotated[
    list[str] | None,
    typer.Option(help="FILE or NAME=FILE: a published parameter set (TOML) to judge beside the twin; repeatable."),
]


def diagnose_from_logs(terminal: Terminal, job: opening.Run, logs: Path, good: Path | None) -> None:
    """Judge an arm by the run logs in a folder and write the diagnosis into the run folder of ``job``."""
    motions = read_folder(logs)
    with terminal.progress("diagnosing") as update:
        diagnosis = work.diagnose_logs_stage(job, motions, good=good, on_progress=update)
    show.diagnosis(terminal, diagnosis)
    terminal.result(f"Next: rejoint identify --logs {logs} --arm {job.arm.name} --run {job.folder.path}")
    terminal.finish({"run": str(job.folder.path), "diagnosis": diagnosis})


def identify_from_logs(terminal: Terminal, job: opening.Run, logs: Path, published: list[str] | None) -> None:
    """Fit a twin to the run logs in a folder, judge it, and write both and the report into a run folder."""
    beside = read_sets(published, job.arm)
    motions = read_folder(logs)
    with terminal.progress("identifying") as update:
        found = work.identify_logs_stage(job, motions, beside, on_progress=update)
    show.twin(terminal, found.twin)
    show_errors(terminal, found.judgement)
    path = work.report_stage(job)
    terminal.result(f"Twin: {job.folder.twin}")
    terminal.result(f"Report: {path}")
    terminal.finish({
        "run": str(job.folder.path), "twin": str(job.folder.twin), "report": str(path), "fitted": found.fitted,
        "judgement": found.judgement,
    })  # fmt: skip


def replay(
    twin: Annotated[Path, typer.Argument(help="Twin (.toml) to judge.")],
    logs: Logs,
    arm: ArmOption = None,
    base: Base = None,
    tip: Tip = None,
    published: Published = None,
    out: Annotated[Path, typer.Option(help="Folder for the page and its figures.")] = Path("replay"),
    json: Json = False,
) -> None:
    """Predict every motion open loop with a twin and show how far off it is, free space and contact apart.

    Example: `rejoint replay runs/so101/twin.toml --logs logs/so101 --published maker.toml --out replay`
    """
    require("rejoint replay", "train", "report")
    from rejoint.runs.report.replay import write_replay
    from rejoint.twin.file import read_twin
    from rejoint.twin.judge import Candidate, judge

    terminal = Terminal(json=json)
    found = read_twin(twin)
    chosen = choose_arm(terminal, arm or found.arm, base, tip)
    found.require(chosen)
    candidates = [Candidate.of("twin", found), *read_sets(published, chosen)]
    with locked(RunFolder(out)):
        judgement = judge(chosen, candidates, read_folder(logs), threads=2)
        show_errors(terminal, judgement)
        page = write_replay(out, judgement, twin=str(twin), logs=str(logs))
    terminal.result(f"Page: {page}")
    terminal.finish({**msgspec.to_builtins(judgement), "page": str(page)})


def read_sets(published: list[str] | None, arm: Arm) -> list[Candidate]:
    """Read published parameter sets given as FILE or NAME=FILE."""
    from rejoint.twin.published import read_published

    found = []
    for given in published or []:
        name, named, path = given.rpartition("=")
        one = read_published(Path(path), arm)
        found.append(changed(one, name=name.strip()) if named and name.strip() else one)
    return found


def read_folder(path: Path) -> list[RunLog]:
    """Read every run log of a folder, by name; FileError if there is none."""
    files = sorted(path.glob("*.parquet")) if path.is_dir() else []
    if not files:
        raise FileError(path, "no folder with run logs (.parquet)", "make one with: rejoint import SOURCE FOLDER")
    return [read_log(file) for file in files]


def show_errors(terminal: Terminal, judgement: Judgement) -> None:
    """Print the errors of every motion, and which prediction to trust."""
    from rejoint.runs.report.trust import answer

    names = list(judgement.mean)
    headers = ["motion", "s", *(f"{name}: free / contact / all mm" for name in names)]
    rows = [
        [motion.motion, f"{motion.seconds:.0f}", *(_cell(motion.errors[name]) for name in names)]
        for motion in judgement.motions
    ]
    rows.append(["mean over motions", "", *(_cell(judgement.mean[name]) for name in names)])
    terminal.table("Open-loop prediction error of the tool, rms, by encoder kinematics", headers, rows, len(rows) - 1)
    for line in answer(judgement):
        terminal.result(line)


def _cell(errors: Errors) -> str:
    parts = (errors.free, errors.contact, errors.all)
    return " / ".join("-" if part is None else f"{1e3 * part.tcp:.2f}" for part in parts)
