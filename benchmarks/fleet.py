"""Many emulated arms in one call: processes killed at random, the call itself killed once, beside two plain processes.

    python -m benchmarks fleet
    python -m benchmarks.fleet --checks 300 --repairs 0 --kills 0 --alone 6

Every check and every repair must end as one by one, to the bit, with nothing left and nothing done twice. Training is
cut down (`--quick` of `rejoint repair`), so that what Ray adds counts for more than it does in a real repair.
`--alone 6` does six arms plainly instead of all.
"""

import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import typer

from rejoint.logs.history.rows import SUMMARY, read_rows
from rejoint.logs.runlog import RunLog

CHECKS, REPAIRS, KILLS = 12, 3, 2
PROCESSES = 2
REJOINT = [sys.executable, "-m", "rejoint"]
CODES = (0, 5, 6, 7)
"""Exit codes of calls in which nothing failed"""
FEW = {"quick": True, "sets": 1, "repetitions": 1, "controllers": ("integrator", "policy")}
"""Arguments of repairs that are cut down"""
WORDS = ["--quick", "--sets", "1", "--repetitions", "1", "--controllers", "integrator,policy"]
"""The same on the command line"""
STEPS = ("diagnosis.json", "twin.toml", "policy.onnx", "comparison.json", "finished.json")
"""Files that the steps of a repair leave"""
FILES = ("diagnosis.json", "twin.toml", "policy.onnx", "logs/excitation.parquet", "logs/targets.parquet")
"""of a repair that hold neither dates nor times"""


class WrongError(AssertionError):
    """Something was lost, done twice, or is another than one by one."""


def address(number: int) -> str:
    return f"emulated:worn?seed={number}"


def names(count: int) -> list[str]:
    return [f"arm-{number:03}" for number in range(count)]


def write_fleet(folder: Path, count: int) -> Path:
    """Write the file of so many emulated arms."""
    text = "may_move = true\nmay_repair = true\nneeds_somebody = false\n"
    for number, name in enumerate(names(count)):
        text += f'[[arm]]\nname = "{name}"\naddress = "{address(number)}"\n'
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "FLEET.toml"
    path.write_text(text)
    return path


@dataclass(frozen=True)
class Process:
    """One process of this machine."""

    parent: int
    name: str


def processes() -> dict[int, Process]:
    """All processes of this machine."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            name = (entry / "cmdline").read_bytes().split(b"\0")[0].decode()
        except OSError:  # it has ended
            continue
        found[int(entry.name)] = Process(int(fields[1]), name)
    return found


def below(root: int) -> dict[int, Process]:
    """Return a process and all that it has started."""
    known = processes()
    found = {root}
    while more := {child for child, one in known.items() if one.parent in found} - found:
        found |= more
    return {one: known[one] for one in found if one in known}


def memory(process: int) -> float:
    """[MB] that a process has for itself: shared libraries count by their share."""
    try:
        text = (Path("/proc") / str(process) / "smaps_rollup").read_text()
    except OSError:
        return 0.0
    return int(re.search(r"^Pss:\s+(\d+) kB", text, re.MULTILINE)[1]) / 1e3  # type: ignore[index]


class Watch(threading.Thread):
    """Looks at a call twice a second: memory, processor, who is at work, and whom to kill.

    ``kills`` are the shares of all steps that are done when a process at work is killed, ``end`` that when the call is.
    """

    def __init__(
        self, process: subprocess.Popen[str], done: Callable[[], float], kills: list[float], end: float | None
    ) -> None:
        super().__init__(daemon=True)
        self.process, self.done, self.kills, self.end = process, done, sorted(kills), end
        self.over = threading.Event()
        self.most, self.killed = 0.0, 0

    def run(self) -> None:
        """Look until it is over."""
        while not self.over.wait(0.5):
            tree = below(self.process.pid)
            at_work = [one for one, process in tree.items() if re.match(r"ray::arm-\d+:", process.name)]
            self.most = max(self.most, sum(map(memory, tree)))
            share = self.done()
            if self.end is not None and share >= self.end:
                self.process.kill()
            elif self.kills and at_work and share >= self.kills[0]:
                self.kills.pop(0)
                os.kill(at_work[self.killed % len(at_work)], signal.SIGKILL)
                self.killed += 1


def call(verb: str, file: Path, kills: list[float], end: float | None = None) -> tuple[float, Watch, str]:
    """Run the command and kill as `Watch` says; returns its time [s] and output."""
    words = [*REJOINT, "fleet", verb, str(file), *(WORDS if verb == "repair" else [])]
    arms = file.read_text().count("[[arm]]")
    steps = [f"checks/*/*/{SUMMARY}"] if verb == "check" else [f"repairs/*/*/{file}" for file in STEPS]
    began = time.monotonic()
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        runs = file.parent / "runs"

        def share() -> float:
            return sum(len(list(runs.glob(step))) for step in steps) / len(steps) / arms

        watch = Watch(process, share, kills, end)
        watch.start()
        text = process.stdout.read() if process.stdout else ""
    watch.over.set()
    watch.join()
    if process.returncode not in (CODES if end is None else (-signal.SIGKILL,)):
        raise WrongError(f"it ended with {process.returncode}: {text}")
    return time.monotonic() - began, watch, text


def plain(folder: Path, verb: str, count: int, of: int) -> float:
    """Do ``count`` arms in two processes, one after the other in each; returns the time [s] that ``of`` arms take.

    Where fewer than all arms are done, the first of each process has its start in it, and those left out count as the
    others do.
    """
    code = "import sys, time, rejoint\nfor words in sys.argv[1:]:\n name, robot = words.split('=', 1)\n"
    code += {
        "check": f" rejoint.check(robot, history={str(folder)!r}, name=name)\n",
        "repair": f" rejoint.repair(robot, run={str(folder)!r} + '/' + name, **{FEW!r})\n",
    }[verb]
    code += " print(time.monotonic())\n"
    given = [f"{name}={address(number)}" for number, name in enumerate(names(count))]
    began = time.monotonic()
    running = [
        subprocess.Popen([sys.executable, "-c", code, *given[k::PROCESSES]], stdout=subprocess.PIPE, text=True)
        for k in range(PROCESSES)
    ]
    told = [process.communicate()[0] for process in running]
    if any(process.returncode for process in running):
        raise WrongError("a plain process failed")
    took = []
    for k, text in enumerate(told):
        clock = np.array(text.split(), dtype=float) - began
        more = len(range(k, of, PROCESSES)) - len(clock)
        took.append(clock[-1] + more * (clock[-1] - clock[0]) / max(len(clock) - 1, 1))
    return max(took)


def check_same(verb: str, fleet: Path, alone: Path, count: int, same: int) -> None:
    """Raise WrongError unless each of ``count`` arms was done once, and the first ``same`` as one by one."""
    for number, name in enumerate(names(count)):
        if verb == "check":
            done = list((fleet / "runs" / "checks" / name).glob(f"*/{SUMMARY}"))
            if len(done) != 1:
                raise WrongError(f"{name} was checked {len(done)} times")
            if number >= same:
                continue
            (other,) = (alone / "checks" / name).glob(f"*/{SUMMARY}")
            errors = [read_rows(path)[0].true_error_mm for path in (done[0], other)]
            logs = [RunLog.load(path.parent / "check.parquet").position for path in (done[0], other)]
            if errors[0] != errors[1] or not np.array_equal(*logs):
                raise WrongError(f"the check of {name} is another than alone")
            continue
        folders = sorted((fleet / "runs" / "repairs" / name).iterdir())
        if len(folders) != 1 or not (folders[0] / "finished.json").exists():
            raise WrongError(f"{name}: {[folder.name for folder in folders]}, or not finished")
        for file in FILES if number < same else ():
            if (folders[0] / file).read_bytes() != (alone / name / file).read_bytes():
                raise WrongError(f"{file} of {name} is another than alone")


def bench(verb: str, count: int, same: int, kills: int, work: Path, rng: np.random.Generator) -> None:
    """Do ``same`` arms plainly, all undisturbed, then with kills; print what that took."""
    alone = plain(work / f"plain-{verb}", verb, same, count)
    print(f"{verb} of {count} arms: {PROCESSES} plain processes {alone:.0f} s (by {same} of the arms)", flush=True)

    def tell(what: str, took: float, most: float) -> None:
        check_same(verb, file.parent, work / f"plain-{verb}", count, same)
        share = 100 * alone / took
        print(f"  {what}: {took:.0f} s ({share:.0f} % of their throughput); memory {most:.0f} MB in all", flush=True)

    file = write_fleet(work / f"quiet-{verb}", count)
    took, watch, _ = call(verb, file, [])
    tell("one fleet", took, watch.most)
    if not kills:
        return
    file, began = write_fleet(work / f"killed-{verb}", count), time.monotonic()
    _, first, before = call(verb, file, list(rng.uniform(0.0, 0.5, kills - kills // 2)), end=0.6)
    _, second, text = call(verb, file, list(rng.uniform(0.6, 0.9, kills // 2)))
    done = Counter(re.findall(r"^(arm-\d+: \w+) done", before + text, re.MULTILINE))
    if twice := [step for step, times in done.items() if times > 1]:
        raise WrongError(f"done twice: {', '.join(twice)}")
    what = f"{first.killed + second.killed} processes killed, and the command with 60 % done; nothing lost or twice"
    tell(what, time.monotonic() - began, max(first.most, second.most))


def main(
    checks: int = CHECKS, repairs: int = REPAIRS, kills: int = KILLS, seed: int = 0, alone: int | None = None
) -> None:
    """Check and repair so many arms; ``alone`` are done plainly as well, by default all."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        for verb, count in (("check", checks), ("repair", repairs)):
            if count:
                bench(verb, count, min(alone or count, count), kills, Path(name), rng)


if __name__ == "__main__":
    typer.run(main)
