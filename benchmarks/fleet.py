"""Many emulated arms in one call: processes killed at random, the call itself killed once, beside two plain processes.

    python -m benchmarks fleet
    python -m benchmarks.fleet --checks 0 --repairs 30 --kills 2 --alone 6 --disturbed
    python -m benchmarks.fleet --checks 300 --repairs 0 --kills 0 --alone 6
    python -m benchmarks.fleet --checks 0 --repairs 0 --memory 12,300

Every check and every repair must end as one by one, to the bit, with nothing left and nothing done twice. Training is
cut down (`--quick` of `rejoint repair`), so that what Ray adds counts for more than it does in a real repair; with
`--whole` repairs are as `rejoint repair` does them by default. Beside
the time by the clock stands that of the processors, which others on the machine do not lengthen, and the share of time
in which a call had work for both. `--disturbed` leaves the undisturbed call out, `--alone 6`
does six arms plainly instead of all.
"""

import argparse
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from benchmarks.processes import below, memory
from rejoint.logs.history.rows import SUMMARY, read_rows
from rejoint.logs.runlog import RunLog

CHECKS, REPAIRS, KILLS = 12, 3, 2
PROCESSES = 2
LOOK = 75.0
"""[s] for which a call is looked at that is not waited for"""
REJOINT = [sys.executable, "-m", "rejoint"]
CODES = (0, 5, 6, 7)
"""Exit codes of calls in which nothing failed"""
FEW = {"quick": True, "sets": 1, "repetitions": 1, "controllers": ("integrator", "policy")}
"""Arguments of repairs that are cut down"""
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
        self.most, self.work, self.killed = 0.0, [0.0], 0
        self.spent: dict[int, float] = {}
        self.at_work: list[int] = []

    def run(self) -> None:
        """Look until it is over."""
        while not self.over.wait(0.5):
            tree = below(self.process.pid)
            at_work = [one for one, process in tree.items() if re.match(r"ray::arm-\d+:", process.name)]
            self.at_work.append(len(at_work))
            self.spent |= {one: process.spent for one, process in tree.items()}
            sizes = {one: memory(one) for one in tree}
            self.most = max(self.most, sum(sizes.values()))
            self.work += [sizes[one] for one in at_work]
            share = self.done()
            if self.end is not None and share >= self.end:
                self.process.kill()
            elif self.kills and at_work and share >= self.kills[0]:
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


def as_words(given: Mapping[str, object]) -> list[str]:
    """Return arguments of a repair as the command line takes them."""
    words = []
    for name, value in given.items():
        words += (
            [f"--{name}"]
            if value is True
            else [f"--{name}", ",".join(value) if isinstance(value, tuple) else str(value)]
        )
    return words


def call(
    verb: str,
    given: Mapping[str, object],
    file: Path,
    kills: list[float],
    end: float | None = None,
    limit: float | None = None,
) -> tuple[float, Watch, str]:
    """Run the command and kill as `Watch` says, or after ``limit`` [s]; returns its time [s] and output."""
    words = [*REJOINT, "fleet", verb, str(file), *as_words(given)]
    arms = file.read_text().count("[[arm]]")
    steps = [f"checks/*/*/{SUMMARY}"] if verb == "check" else [f"repairs/*/*/{file}" for file in STEPS]
    began = time.monotonic()
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        runs = file.parent / "runs"

        def share() -> float:
            return sum(len(list(runs.glob(step))) for step in steps) / len(steps) / arms

        watch = Watch(process, share, kills, end)
        watch.start()
        if limit is not None:
            try:
                process.wait(limit)
            except subprocess.TimeoutExpired:
                process.kill()
        text = process.stdout.read() if process.stdout else ""
    watch.over.set()
    watch.join()
    if process.returncode != -signal.SIGKILL if end is not None else limit is None and process.returncode not in CODES:
        raise WrongError(f"it ended with {process.returncode}: {text}")
    return time.monotonic() - began, watch, text


def plain(folder: Path, verb: str, given: Mapping[str, object], count: int, of: int) -> tuple[float, float]:
    """Do the same in two processes, one arm after the other in each, and what that would be for ``of`` arms.

    Returns the time [s] and that of processors [s]. Where fewer than all arms are done, the first of each process has
    its start in it, and those left out count as the others do.
    """
    code = "import os, sys, time, rejoint\nfor words in sys.argv[1:]:\n name, robot = words.split('=', 1)\n"
    code += {
        "check": f" rejoint.check(robot, history={str(folder)!r}, name=name)\n",
        "repair": f" rejoint.repair(robot, run={str(folder)!r} + '/' + name, **{dict(given)!r})\n",
    }[verb]
    code += " print(time.monotonic(), sum(os.times()[:4]))\n"
    given = [f"{name}={address(number)}" for number, name in enumerate(names(count))]
    began = time.monotonic()
    running = [
        subprocess.Popen([sys.executable, "-c", code, *given[k::PROCESSES]], stdout=subprocess.PIPE, text=True)
        for k in range(PROCESSES)
    ]
    told = [process.communicate()[0] for process in running]
    if any(process.returncode for process in running):
        raise WrongError("a plain process failed")
    took, spent = [], []
    for k, text in enumerate(told):
        clock = np.array([line.split() for line in text.splitlines()], dtype=float) - [began, 0.0]
        more = len(range(k, of, PROCESSES)) - len(clock)
        each = (clock[-1] - clock[0]) / max(len(clock) - 1, 1)
        took.append(clock[-1, 0] + more * each[0])
        spent.append(clock[-1, 1] + more * each[1])
    return max(took), sum(spent)


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


def bench(
    verb: str, given: Mapping[str, object], count: int, same: int, kills: int, work: Path, rng: np.random.Generator, *,
    quiet: bool,
) -> None:  # fmt: skip
    """Do ``same`` arms plainly, all undisturbed, then with kills; print what that took."""
    alone, spent = plain(work / f"plain-{verb}", verb, given, same, count)
    print(
        f"{verb} of {count} arms: {PROCESSES} plain processes {alone:.0f} s, {spent:.0f} s of processor"
        f"{'' if same == count else f' (by {same} of the arms)'}", flush=True,
    )  # fmt: skip
    if quiet:
        file = write_fleet(work / f"quiet-{verb}", count)
        took, watch, _ = call(verb, given, file, [])
        check_same(verb, file.parent, work / f"plain-{verb}", count, same)
        print(
            f"  one fleet {took:.0f} s ({100 * alone / took:.0f} % of their throughput), {watch.processor:.0f} s of "
            f"processor ({100 * spent / watch.processor:.0f} %), work for all {watch.filled:.0f} % of the time; "
            f"memory {watch.most:.0f} MB in all, {np.max(watch.work):.0f} MB for a process that works on an arm",
            flush=True,
        )
    if not kills:
        return
    file, began = write_fleet(work / f"killed-{verb}", count), time.monotonic()
    _, first, before = call(verb, given, file, list(rng.uniform(0.0, 0.5, kills - kills // 2)), end=0.6)
    _, second, text = call(verb, given, file, list(rng.uniform(0.6, 0.9, kills // 2)))
    took = time.monotonic() - began
    check_same(verb, file.parent, work / f"plain-{verb}", count, same)
    twice = [
        step for step, n in Counter(re.findall(r"^(arm-\d+: \w+) done", before + text, re.MULTILINE)).items() if n > 1
    ]
    if twice:
        raise WrongError(f"done twice: {', '.join(twice)}")
    lost = Counter(re.findall(r"^arm-\d+: (\w+) lost", text, re.MULTILINE))
    both = first.processor + second.processor
    print(
        f"  with {first.killed + second.killed} processes killed, and the command itself with 60 % done: {took:.0f} s "
        f"({100 * alone / took:.0f} %), {both:.0f} s of processor ({100 * spent / both:.0f} %), work for all "
        f"{first.filled:.0f} and {second.filled:.0f} % of the time; nothing lost, nothing twice, all as alone; the "
        f"second call saw {dict(lost)} killed; memory {max(first.most, second.most):.0f} MB in all", flush=True,
    )  # fmt: skip


def look(count: int, work: Path) -> None:
    """Print what memory a call for so many arms takes while it checks the first of them."""
    _, watch, text = call("check", {}, write_fleet(work / f"look-{count}", count), [], limit=LOOK)
    done = len(re.findall(r"^arm-\d+: check done", text, re.MULTILINE))
    print(f"a call for {count} arms: {watch.most:.0f} MB in all in its first {LOOK:.0f} s, in which it checked {done}")


def main(
    checks: int = CHECKS, repairs: int = REPAIRS, kills: int = KILLS, seed: int = 0, memory_of: tuple[int, ...] = (),
    *, alone: int | None = None, quiet: bool = True, whole: bool = False,
) -> None:  # fmt: skip
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as name:
        for verb, count in (("check", checks), ("repair", repairs)):
            if count:
                given = {} if whole or verb == "check" else FEW
                bench(verb, given, count, min(alone or count, count), kills, Path(name), rng, quiet=quiet)
        for count in memory_of:
            look(count, Path(name))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet")
    parser.add_argument("--checks", type=int, default=CHECKS)
    parser.add_argument("--repairs", type=int, default=REPAIRS)
    parser.add_argument("--kills", type=int, default=KILLS)
    parser.add_argument("--alone", type=int, help="arms that are done plainly as well; all by default")
    parser.add_argument("--disturbed", action="store_true", help="leave out the call in which nothing is killed")
    parser.add_argument("--whole", action="store_true", help="repair as the command does by default")
    parser.add_argument("--memory", default="", help="numbers of arms whose calls are only looked at: 12,300")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    sizes = tuple(int(one) for one in options.memory.split(",") if one)
    main(
        options.checks, options.repairs, options.kills, options.seed, sizes,
        alone=options.alone, quiet=not options.disturbed, whole=options.whole,
    )  # fmt: skip
