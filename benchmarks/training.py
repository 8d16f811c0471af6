"""What training costs: beyond the simulation that it cannot do without, and by its number of agents.

The very same physics steps are simulated alone. Each number of agents has a process of its own.
"""

import re
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from rejoint.arms import mycobot280
from rejoint.training.learner import Learner
from rejoint.training.presets import DEFAULT
from rejoint.training.task import ReachTask
from rejoint.training.train import TrainingOptions, know_stiffness, make_learner
from rejoint.twin.simulation import SUBSTEPS, Simulation

ROUNDS, UPDATES = 6, 3
AGENTS = (64, 256, 1024, 4096, 8192)
ROLLOUT = DEFAULT.ppo.rollout


def begin(agents: int = DEFAULT.ppo.agents) -> Learner:
    """Start a training on two threads and do its first update."""
    arm, options = mycobot280(), TrainingOptions(agents=agents, threads=2)
    learner = make_learner(arm, None, know_stiffness(options.recipe, arm, None), options)
    learner.iterate()
    return learner


class Tape:
    """Records every control cycle of some agents: their state before it, and the references of their servos."""

    def __init__(self, task: ReachTask) -> None:
        self._simulation, self._rollout = task.simulation, task.simulation.rollout
        self.cycles: list[tuple[dict[str, np.ndarray], np.ndarray]] = []
        task.simulation.rollout = self._record  # type: ignore[method-assign]

    def _record(self, reference: np.ndarray) -> np.ndarray:
        state = {name: value.copy() for name, value in self._simulation.state().items()}
        self.cycles.append((state, reference.copy()))
        return self._rollout(reference)

    def replay(self) -> float:
        """Simulate what was recorded; returns the time [s] of the steps alone."""
        simulation, taken = Simulation(mycobot280(), len(self.cycles[0][1])), 0.0
        for state, reference in self.cycles:
            for name, value in simulation.state().items():
                value[...] = state[name]
            start = time.perf_counter()
            simulation.rollout(reference)
            taken += time.perf_counter() - start
        return taken


def overhead() -> None:
    """Print what training takes beside its physics."""
    learner = begin()
    whole, raw = [], []
    for _ in range(ROUNDS):  # in turns, so that other load hits both alike
        start = time.perf_counter()
        for _ in range(UPDATES):
            learner.iterate()
        whole.append((time.perf_counter() - start) / UPDATES)
        tapes = [Tape(worker.task) for worker in learner.workers]
        learner.iterate()
        with ThreadPoolExecutor(len(tapes)) as pool:
            raw.append(max(pool.map(Tape.replay, tapes)))
        for worker in learner.workers:
            del worker.task.simulation.rollout
    steps = learner.agents * ROLLOUT
    alone, training = float(np.median(raw)), float(np.median(whole))
    print(
        f"simulation of the same steps alone: {1e6 * alone / steps / SUBSTEPS:.2f} us per physics step on two threads"
    )
    print(f"training: {steps / training:.0f} transitions per second, {training / alone:.2f} x that simulation")


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
    overhead()
    print(f"{'agents':>6} {'us/transition':>14} {'memory [MiB]':>12}", flush=True)
    for agents in AGENTS:
        subprocess.run(
            [sys.executable, "-c", f"from benchmarks.training import measure; measure({agents})"], check=True
        )
