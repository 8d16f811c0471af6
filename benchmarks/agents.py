"""Time per transition and memory of a training by its number of agents, each in a process of its own."""

import re
import subprocess
import sys
import time
from pathlib import Path

from benchmarks.learners import ROLLOUT, begin

AGENTS = (64, 256, 1024, 4096, 8192)


def measure(agents: int) -> None:
    rounds = max(2, 2048 // agents)
    learner = begin(agents)
    start = time.perf_counter()
    for _ in range(rounds):
        learner.iterate()
    taken = time.perf_counter() - start
    print(f"{agents:>6} {1e6 * taken / rounds / agents / ROLLOUT:>14.1f} {memory():>12.0f}")


def memory() -> float:
    """Peak [MiB] of this process; `getrusage` would count that of the process it was started from."""
    found = re.search(r"^VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(), re.MULTILINE)
    return int(found[1]) / 1024


def main() -> None:
    print(f"{'agents':>6} {'us/transition':>14} {'memory [MiB]':>12}", flush=True)
    for agents in AGENTS:
        subprocess.run([sys.executable, "-m", "benchmarks.agents", str(agents)], check=True)


if __name__ == "__main__":
    measure(int(sys.argv[1]))
