"""Commands that work from logs alone, without a robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from rejoint.arms import Arm
from rejoint.cli import show
from rejoint.cli.console import Terminal
from rejoint.cli.options import ArmOption, Base, Json, Tip, choose_arm
from rejoint.errors import FileError
from rejoint.runs import RunLog, read_log

if TYPE_CHECKING:
    from rejoint.twin.judge import Errors, Judgement

Logs = Annotated[Path, typer.Option(help="Folder of run logs (.parquet), such as `rejoint import` writes.")]


def identify_from_logs(terminal: Terminal, arm: Arm, logs: Path, out: Path) -> None:
    """Fit a twin to the run logs in a folder and write it to ``out``."""
    from rejoint.twin.file import write_twin
    from rejoint.twin.fromlogs import identify_logs

    motions = read_folder(logs)
    with terminal.progress("identifying") as update:
        found = identify_logs(arm, motions, on_progress=lambda what, share: update(share, 1.0, what))
    write_twin(out, found.twin)
    show.twin(terminal, found.twin)
    _show_errors(terminal, found.judgement)
    terminal.result(str(out))
    terminal.finish({"twin": str(out), "fitted": found.fitted, "judgement": found.judgement})


def replay(
    twin: Annotated[Path, typer.Argument(help="Twin (.toml) to judge.")],
    logs: Logs,
    arm: ArmOption = None,
    base: Base = None,
    tip: Tip = None,
    published: Annotated[
        list[Path] | None, typer.Option(help="TOML file of a published parameter set to judge beside it; repeatable.")
    ] = None,
    json: Json = False,
) -> None:
    """Predict every motion open loop with a twin and show how far off it is, free space and contact apart.

    Example: `rejoint replay so101.toml --logs logs/so101 --arm so101`
    """
    from rejoint.twin.file import read_twin
    from rejoint.twin.judge import Candidate, judge
    from rejoint.twin.published import read_published

    terminal = Terminal(json=json)
    chosen = choose_arm(terminal, arm, base, tip)
    candidates = [Candidate.of("twin", read_twin(twin, chosen))]
    candidates += [read_published(path, chosen) for path in published or []]
    judgement = judge(chosen, candidates, read_folder(logs), threads=2)
    _show_errors(terminal, judgement)
    terminal.finish(judgement)


def read_folder(path: Path) -> list[RunLog]:
    """Read every run log of a folder, by name; FileError if there is none."""
    files = sorted(path.glob("*.parquet")) if path.is_dir() else []
    if not files:
        raise FileError(path, "no folder with run logs (.parquet)", "make one with: rejoint import SOURCE FOLDER")
    return [read_log(file) for file in files]


def _show_errors(terminal: Terminal, judgement: Judgement) -> None:
    names = list(judgement.mean)
    headers = ["motion", "s", *(f"{name}: free / contact / all mm" for name in names)]
    rows = [
        [motion.motion, f"{motion.seconds:.0f}", *(_cell(motion.errors[name]) for name in names)]
        for motion in judgement.motions
    ]
    rows.append(["mean over motions", "", *(_cell(judgement.mean[name]) for name in names)])
    terminal.table("Open-loop prediction error of the tool, rms, by encoder kinematics", headers, rows, len(rows) - 1)
    for name in names:
        free = judgement.mean[name].free
        if free is not None:
            terminal.result(f"{name}: {np.degrees(free.joint):.2f} deg per joint in free space")
    if judgement.repeatability is not None:
        terminal.result(f"The arm repeats itself within {1e3 * judgement.repeatability.tcp:.2f} mm.")


def _cell(errors: Errors) -> str:
    parts = (errors.free, errors.contact, errors.all)
    return " / ".join("-" if part is None else f"{1e3 * part.tcp:.2f}" for part in parts)
