"""Many emulated arms in one call: processes killed at random, the call itself killed once, beside two plain processes.

    python -m benchmarks fleet
    python -m benchmarks.fleet --checks 300 --repairs 30 --kills 2 --disturbed
    python -m benchmarks.fleet --checks 0 --repairs 0 --memory 12,300

Every check and every repair must end as one by one, to the bit, with nothing left and nothing done twice. Training is
cut down (`--quick` of `rejoint repair`), so that what Ray adds counts for more than it does in a real repair. Beside
the time by the clock stands that of the processors, which others on the machine do not lengthen, and the share of time
in which a call had work for both. `--disturbed` leaves the undisturbed call out.
"""

import argparse
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rejoint.logs.history.rows import SUMMARY, read_rows
from rejoint.logs.runlog import RunLog

CHECKS, REPAIRS, KILLS = 12, 3, 2
PROCESSES = 2
LOOK = 75.0
"""[s] for which a call is looked at that is not waited for"""
REJOINT = [sys.executable, "-m", "rejoint"]
FEW = ["--quick", "--sets", "1", "--repetitions", "1", "--controllers", "integrator,policy"]
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
    spent: float
    """[s] of processor"""


def processes() -> dict[int, Process]:
    """All processes of this machine."""
    found = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            name = (entry / "cmdline").read_bytes().split(b"\0")[0].decode()
        except OSError:  # it has ended
            continue
        spent = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
        found[int(entry.name)] = Process(int(fields[1]), name, spent)
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
    """Looks at a call twice a second: memory, processor, who is at work, and processes to kill at random moments."""

    def __init__(self, process: subprocess.Popen[str], kills: list[float]) -> None:
        super().__init__(daemon=True)
        self.process, self.kills, self.over = process, sorted(kills), threading.Event()
        self.most, self.work, self.killed = 0.0, [0.0], 0
        self.spent: dict[int, float] = {}
        self.at_work: list[int] = []

    def run(self) -> None:
        """Look until it is over."""
        began = time.monotonic()
        while not self.over.wait(0.5):
            tree = below(self.process.pid)
            at_work = [one for one, process in tree.items() if re.match(r"ray::arm-\d+:", process.name)]
            self.at_work.append(len(at_work))
            self.spent |= {one: process.spent for one, process in tree.items()}
            sizes = {one: memory(one) for one in tree}
            self.most = max(self.most, sum(sizes.values()))
            self.work += [sizes[one] for one in at_work]
            if self.kills and at_work and time.monotonic() - began > self.kills[0]:
                self.kills.pop(0)
                os.kill(at_work[self.killed % len(at_work)], signal.SIGKILL)
                self.killed += 1

    @property
    def processor(self) -> float:
        """[s] of processor that the call and all that it has started took."""
        return sum(self.spent.values())

    @property
    def filled(self) -> float:
        """[%] of the time for which as many were at work as can be."""
        return 100.0 * float(np.mean(np.minimum(self.at_work, PROCESSES))) / PROCESSES


def call(words: list[str], kills: list[float], killed_after: float | None = None) -> tuple[float, Watch, str]:
    """Run the command, kill what works at ``kills`` [s], and the command itself; returns its time [s] and output."""
    began = time.monotonic()
    with subprocess.Popen([*REJOINT, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        watch = Watch(process, kills)
        watch.start()
        if killed_after is not None:
            try:
                process.wait(killed_after)
            except subprocess.TimeoutExpired:
                process.kill()
        text = process.stdout.read() if process.stdout else ""
    watch.over.set()
    watch.join()
    if killed_after is None and process.returncode not in (0, 5, 6, 7):
        raise WrongError(text)
    return time.monotonic() - began, watch, text


def plain(folder: Path, verb: str, count: int) -> tuple[float, float]:
    """Do the same in two processes, one arm after the other in each; returns the time [s], and that of processors."""
    code = "import sys, rejoint\nfor words in sys.argv[1:]:\n name, robot = words.split('=', 1)\n"
    code += {
        "check": f" rejoint.check(robot, history={str(folder)!r}, name=name)\n",
        "repair": f" rejoint.repair(robot, run={str(folder)!r} + '/' + name, quick=True, sets=1, repetitions=1, "
        "controllers=('integrator', 'policy'))\n",
    }[verb]
    given = [f"{name}={address(number)}" for number, name in enumerate(names(count))]
    began, before = time.monotonic(), _children()
    running = [subprocess.Popen([sys.executable, "-c", code, *given[k::PROCESSES]]) for k in range(PROCESSES)]
    codes = [process.wait() for process in running]
    if any(codes):
        raise WrongError("a plain process failed")
    return time.monotonic() - began, _children() - before


def _children() -> float:
    """[s] of processor that processes took which were started from here and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def check_same(verb: str, fleet: Path, alone: Path, count: int) -> None:
    """Raise WrongError unless each arm was done once, and as one by one."""
    for name in names(count):
        if verb == "check":
            done = list((fleet / "runs" / "checks" / name).glob(f"*/{SUMMARY}"))
            (other,) = (alone / "checks" / name).glob(f"*/{SUMMARY}")
            if len(done) != 1:
                raise WrongError(f"{name} was checked {len(done)} times")
            same = read_rows(done[0])[0].true_error_mm == read_rows(other)[0].true_error_mm
            logs = [RunLog.load(path.parent / "check.parquet").position for path in (done[0], other)]
            if not same or not np.array_equal(*logs):
                raise WrongError(f"the check of {name} is another than alone")
            continue
        folders = sorted((fleet / "runs" / "repairs" / name).iterdir())
        if len(folders) != 1 or not (folders[0] / "finished.json").exists():
            raise WrongError(f"{name}: {[folder.name for folder in folders]}, or not finished")
        for file in FILES:
            if (folders[0] / file).read_bytes() != (alone / name / file).read_bytes():
                raise WrongError(f"{file} of {name} is another than alone")


def bench(verb: str, count: int, kills: int, work: Path, rng: np.random.Generator, *, disturbed: bool) -> None:
    """Do it plainly, undisturbed, then with kills; print what that took."""
    few = FEW if verb == "repair" else []
    alone, spent = plain(work / f"plain-{verb}", verb, count)
    print(f"{verb} of {count} arms: {PROCESSES} plain processes {alone:.0f} s, {spent:.0f} s of processor", flush=True)
    took = alone
    if not disturbed:
        quiet = write_fleet(work / f"quiet-{verb}", count)
        took, watch, _ = call(["fleet", verb, str(quiet), *few], [])
        check_same(verb, quiet.parent, work / f"plain-{verb}", count)
        print(
            f"  one fleet {took:.0f} s ({100 * alone / took:.0f} % of their throughput), {watch.processor:.0f} s of "
            f"processor ({100 * spent / watch.processor:.0f} %), work for all {watch.filled:.0f} % of the time; "
            f"memory {watch.most:.0f} MB in all, {np.max(watch.work):.0f} MB for a process that works on an arm",
            flush=True,
        )
    killed = write_fleet(work / f"killed-{verb}", count)
    words = ["fleet", verb, str(killed), *few]
    began = time.monotonic()
    _, first, _ = call(words, list(rng.uniform(0.2, 0.5, kills - kills // 2) * took), killed_after=0.6 * took)
    _, second, text = call(words, list(rng.uniform(0.1, 0.3, kills // 2) * took))
    check_same(verb, killed.parent, work / f"plain-{verb}", count)
    lost = Counter(re.findall(r"^arm-\d+: (\w+) lost", text, re.MULTILINE))
    print(
        f"  with {first.killed + second.killed} processes killed, and the command itself after {0.6 * took:.0f} s: "
        f"{time.monotonic() - began:.0f} s, {first.processor + second.processor:.0f} s of processor, work for all "
        f"{first.filled:.0f} and {second.filled:.0f} % of the time; nothing lost, nothing twice, all as alone; the "
        f"second call saw {dict(lost)} killed"
    )


def look(count: int, work: Path) -> None:
    """Print what memory a call for so many arms takes while it checks the first of them."""
    _, watch, text = call(["fleet", "check", str(write_fleet(work / f"look-{count}", count))], [], killed_after=LOOK)
    done = len(re.findall(r"^arm-\d+: check done", text, re.MULTILINE))
    print(f"a call for {count} arms: {watch.most:.0f} MB in all in its first {LOOK:.0f} s, in which it checked {done}")


def main(
    checks: int = CHECKS, repairs: int = REPAIRS, kills: int = KILLS, seed: int = 0, memory_of: tuple[int, ...] = (),
    *, disturbed: bool = False,
) -> None:  # fmt: skip
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        if checks:
            bench("check", checks, kills, Path(name), rng, disturbed=disturbed)
        if repairs:
            bench("repair", repairs, kills, Path(name), rng, disturbed=disturbed)
        for count in memory_of:
            look(count, Path(name))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet")
    parser.add_argument("--checks", type=int, default=CHECKS)
    parser.add_argument("--repairs", type=int, default=REPAIRS)
    parser.add_argument("--kills", type=int, default=KILLS)
    parser.add_argument("--memory", default="", help="numbers of arms whose calls are only looked at: 12,300")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--disturbed", action="store_true", help="leave out the call in which nothing is killed")
    options = parser.parse_args()
    sizes = tuple(int(one) for one in options.memory.split(",") if one)
    main(options.checks, options.repairs, options.kills, options.seed, sizes, disturbed=options.disturbed)
