"""What training costs by its number of agents; each number has a process of its own."""

import re
import subprocess
import sys
import time
from pathlib import Path

from rejoint.arms import mycobot280
from rejoint.training.task import DEFAULT
from rejoint.training.train import TrainingOptions, know_stiffness, make_learner

AGENTS = (64, 256, 1024, 4096, 8192)
ROLLOUT = DEFAULT.ppo.rollout


def measure(agents: int) -> None:
    """Train, and print what it takes after the first update."""
    rounds, arm, options = max(2, 2048 // agents), mycobot280(), TrainingOptions(agents=agents)
    learner = make_learner(arm, None, know_stiffness(options.recipe, arm, None), options)
    learner.iterate()
    start = time.perf_counter()
    for _ in range(rounds):
        learner.iterate()
    each = (time.perf_counter() - start) / rounds / agents / ROLLOUT
    print(f"{agents:>6} {1e6 * each:>14.1f} {1 / each:>10.0f} {memory():>12.0f}")


def memory() -> float:
    """Peak [MiB] of this process; `getrusage` would count that of the process it was started from."""
    found = re.search(r"^VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(found[1]) / 1024


def main() -> None:
    print(f"{'agents':>6} {'us/transition':>14} {'per second':>10} {'memory [MiB]':>12}", flush=True)
    for agents in AGENTS:
        subprocess.run(
            [sys.executable, "-c", f"from benchmarks.training import measure; measure({agents})"], check=True
        )
