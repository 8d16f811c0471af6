"""What training costs beyond the simulation that it cannot do without: the very same physics steps, simulated alone."""

import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from benchmarks.learners import ROLLOUT, begin
from rejoint.arms import mycobot280
from rejoint.training.task import ReachTask
from rejoint.twin.simulation import SUBSTEPS, Simulation

ROUNDS, UPDATES = 6, 3


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


def main() -> None:
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


if __name__ == "__main__":
    main()
