"""`kill -9` at random moments of every stage of a repair and of deployments over TCP; what is lost, and what goes on.

    python -m benchmarks kills
    python -m benchmarks kills 20 --stages train,deploy

A repair is killed ten times in a folder and then let come to its end: its files must be those of one that nobody
disturbed, to the bit. Excitation, identification and training are cut down, so that the kills meet every stage and
not the longest alone. Every process is forked from this one, which has imported everything and started no thread.
"""

import mmap
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pyarrow.parquet as pq
import typer

import rejoint.diagnosis.diagnosis
import rejoint.pages.report.page
import rejoint.training.task
import rejoint.training.train
import rejoint.twin.identify
from benchmarks.frame import process
from rejoint.arms import mycobot280
from rejoint.cli import main as command_line
from rejoint.logs.journal import Journal
from rejoint.logs.runfolder import RunFolder, locked
from rejoint.logs.runlog import RunLog
from rejoint.runs.run import Run

STAGES = {
    "diagnose": ("diagnosis.json", "logs/targets.parquet", "logs/excitation.parquet"),
    "calibrate": ("calibration.toml", "measurements.json"),
    "identify": ("twin.toml",),
    "train": ("policy.onnx", "training/curves.parquet"),
    "compare": (
        "comparison.json",
        *(f"logs/{kind}-{name}-0-0.parquet" for kind in ("crossing", "hold") for name in ("integrator", "policy")),
    ),
    "report": ("report.html", "finished.json"),
}
"""What each stage leaves; the first file is the one by which it counts as done. The last stage's hold dates."""

TARGETS = "x,y,z\n170,0,200\n180,30,210\n"
KILLS, KILLS_EACH = 120, 10
DWELL = 1.5
"""[s] per target of a deployment"""


class WrongError(AssertionError):
    """Something was lost that should not be."""


def small() -> None:
    """Cut the stages of this process down."""
    rejoint.twin.identify.ITERATIONS = 3
    preset = rejoint.training.task.DEFAULT
    ppo = replace(preset.ppo, agents=8, iterations=25, rollout=8, epochs=1, mini_batches=2)
    rejoint.training.task.PRESETS["default"] = replace(preset, ppo=ppo)


def start(words: list[str], out: Path, prepare: Callable[[], object]) -> int:
    """Run the command line with ``words`` in a process of its own; returns its id."""
    child = os.fork()
    if child:
        return child
    try:
        handle = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        sys.stdout = sys.stderr = open(1, "w", closefd=False, buffering=1)  # noqa: SIM115
        prepare()
        sys.argv = ["rejoint", *words]
        command_line()
    except SystemExit as done:
        os._exit(int(done.code or 0))
    finally:
        os._exit(70)


def wait(child: int) -> int:
    """Return the exit code of a process; minus the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def finish(child: int, out: Path) -> None:
    """Wait for a process; WrongError unless it ends well."""
    if wait(child) != 0 or "Traceback" in out.read_text():
        raise WrongError(out.read_text())


def kill(child: int, after: float) -> bool:
    """Kill a process ``after`` [s]; returns whether it was still running."""
    time.sleep(after)
    os.kill(child, signal.SIGKILL)
    return wait(child) == -signal.SIGKILL


def repair(folder: Path, out: Path) -> int:
    """Begin or resume a repair."""
    few = ["--sets", "1", "--repetitions", "1", "--controllers", "integrator,policy"]
    points = ["--targets", str(folder.parent / "points.csv")]
    return start(["repair", "emulated:worn", "--run", str(folder), *few, *points], out, small)


def stage_of(folder: Path) -> str:
    """Name the stage that a repair is in."""
    return next((name for name, files in STAGES.items() if not (folder / files[0]).exists()), "report")


def leftovers(folder: Path) -> list[str]:
    """Name what a killed process left behind and nobody put right."""
    return [str(path.relative_to(folder)) for path in folder.rglob(".*") if path.name != ".lock"]


def undated(path: Path) -> list[str]:
    """Lines of a file without those that tell when the arm was calibrated, or what digest the whole has with them."""
    dated = ("# digest", "date =", '  "calibration":', '  "digest":')
    return [line for line in path.read_text().splitlines() if not line.startswith(dated)]


def check_same(folder: Path, good: Path) -> None:
    """Raise WrongError unless a repair ended as the undisturbed one."""
    for name in [name for stage in list(STAGES)[:-1] for name in STAGES[stage]]:
        if name.endswith("curves.parquet"):
            tables = [pq.read_table(where / name).drop_columns("wall_s") for where in (folder, good)]
            same = tables[0].equals(tables[1])
        elif name in ("calibration.toml", "comparison.json"):
            same = undated(folder / name) == undated(good / name)
        else:
            same = (folder / name).read_bytes() == (good / name).read_bytes()
        if not same:
            raise WrongError(f"{name} is another than that of the undisturbed repair")
    if "</html>" not in (folder / "report.html").read_text()[-20:]:
        raise WrongError("half a report")
    if not (folder / "finished.json").exists() or leftovers(folder):
        raise WrongError(f"not put right: {leftovers(folder)}")


def kill_repairs(work: Path, stage: str, kills: int, seconds: float, rng: np.random.Generator) -> Counter[str]:
    """Kill repairs that begin with ``stage``, which takes ``seconds``; returns how many kills met which stage."""
    met: Counter[str] = Counter()
    earlier = [name for before in list(STAGES)[: list(STAGES).index(stage)] for name in STAGES[before]]
    folder, good, out = work / "run", work / "good", work / "out.txt"
    while met.total() < kills:
        shutil.rmtree(folder, ignore_errors=True)
        for name in ["run.json", *earlier]:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(good / name, folder / name)
        out.unlink(missing_ok=True)
        for _ in range(min(KILLS_EACH, kills - met.total())):
            if kill(repair(folder, out), rng.uniform(0.0, 1.1 * seconds)):
                met[stage_of(folder)] += 1
            else:  # the machine has become faster
                seconds *= 0.8
        finish(repair(folder, out), out)
        check_same(folder, good)
    return met


def kill_trainings(work: Path, kills: int, rng: np.random.Generator) -> None:
    """Kill trainings without a twin: the quick part of what `kill_repairs` does, for `make test`."""
    good, folder, out = work / "good", work / "run", work / "out.txt"
    began = time.monotonic()
    for path, times in ((good, 0), (folder, kills)):
        words = ["train", str(path), "--generic"]
        took = time.monotonic() - began
        for _ in range(times):
            kill(start(words, out, small), rng.uniform(0.2, 1.0) * took)
            (path / "policy.onnx").unlink(missing_ok=True)  # begun again after its end, the kill came too late
        finish(start(words, out, small), out)
    if (folder / "policy.onnx").read_bytes() != (good / "policy.onnx").read_bytes() or leftovers(folder):
        raise WrongError(f"another policy than that of the undisturbed training, or left behind: {leftovers(folder)}")


def kill_deployments(work: Path, kills: int, rng: np.random.Generator) -> list[float]:
    """Kill deployments over TCP; returns for each that had begun what the log lacks [s]."""
    lost, counter = [], np.frombuffer(mmap.mmap(-1, 24))  # shared: rows so far, times of the first and the last [s]
    counter.flags.writeable = True
    append = Journal.append

    def count(self: Journal, time: float, *columns: object) -> None:
        append(self, time, *columns)  # type: ignore[arg-type]
        counter[:] = counter[0] + 1, counter[1] or time, time

    def counting() -> None:
        Journal.append = count  # type: ignore[method-assign,assignment]

    with process("emulate", "--port", "0") as address:
        folder, out = RunFolder(work / "deploy"), work / "deploy.txt"
        Run.create(folder.path, "emulated:worn", mycobot280(), 0)
        words = ["deploy", address, str(folder.path), "--controller", "integrator", "--dwell", str(DWELL)]
        words += ["--targets", str(work / "points.csv")]
        began = time.monotonic()
        finish(start(words, out, counting), out)
        took, motion = time.monotonic() - began, 2 * DWELL
        for _ in range(kills):
            shutil.rmtree(folder.path / "logs", ignore_errors=True)
            counter[:] = 0.0
            child, early = start(words, out, counting), rng.random() < 0.2
            deadline = time.monotonic() + 60.0
            while not (early or counter[0]) and time.monotonic() < deadline:
                time.sleep(0.005)
            kill(child, rng.uniform(0.0, took - motion if early else 1.05 * motion))
            rows, first, last = counter
            with locked(folder):  # so does the next command: nobody holds it any more, and it puts things right
                logs = [RunLog.load(path) for path in folder.logs().values()]
            if leftovers(folder.path):
                raise WrongError(f"not put right: {leftovers(folder.path)}")
            if rows:
                lost.append(last - (float(logs[0].time[-1]) if logs else first))
    return lost


def main(
    kills: Annotated[int, typer.Argument()] = KILLS, stages: str = ",".join((*STAGES, "deploy")), seed: int = 0
) -> None:
    """Kill so many times, the same number in each of the stages."""
    rng, chosen = np.random.default_rng(seed), stages.split(",")
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        (work / "points.csv").write_text(TARGETS)
        met: Counter[str] = Counter()
        if set(chosen) & set(STAGES):
            began = time.time()
            finish(repair(work / "good", work / "good.txt"), work / "good.txt")
            ends = [(work / "good" / files[0]).stat().st_mtime for files in STAGES.values()]
            took = dict(zip(STAGES, np.diff([began, *ends]), strict=True))
            print("undisturbed: " + ", ".join(f"{stage} {seconds:.1f} s" for stage, seconds in took.items()))
            for stage in [stage for stage in STAGES if stage in chosen]:
                met += kill_repairs(work, stage, round(kills / len(chosen)), took[stage], rng)
            told = ", ".join(f"{met[stage]} in {stage}" for stage in STAGES)
            print(f"repairs: {met.total()} kills ({told}); each came to the end of the undisturbed one, nothing left")
        if "broad" in chosen:
            kill_trainings(work, round(kills / len(chosen)), rng)
        if "deploy" in chosen:
            lost = kill_deployments(work, round(kills / len(chosen)), rng)
            print(
                f"deployments over TCP: {round(kills / len(chosen))} kills, {len(lost)} of them while it moved; "
                f"the log lacks {np.median(lost):.2f} s in the middle, {np.max(lost):.2f} s at most"
            )
