"""What training costs beyond the simulation that it cannot do without: the very same physics steps, simulated alone."""

import time

import numpy as np

from benchmarks.learners import ROLLOUT, begin
from rejoint.arms import mycobot280
from rejoint.training.task import ReachTask
from rejoint.twin.batch import TwinBatch
from rejoint.twin.simulation import SUBSTEPS

ROUNDS, UPDATES = 6, 3

DRIVEN = ("ctrl", "dof_frictionloss", "opt.timestep", "dof_solref")
"""What a training changes before every step"""


class Tape:
    """Records every physics step of some agents: everything where arms are exchanged, else what drives them."""

    def __init__(self, task: ReachTask) -> None:
        twins = task.simulation.twins
        self._step, self._arms = twins.step, None
        self._live = {**twins.state(), "ctrl": twins.ctrl}
        self.steps: list[dict[str, np.ndarray]] = []
        twins.step = self._record  # type: ignore[method-assign]

    def _record(self, substeps: int = 1, ids: None = None) -> None:
        arms = self._live["dof_armature"].copy()
        known = self._arms is not None and np.array_equal(arms, self._arms)
        self._arms = arms
        self.steps.append({name: self._live[name].copy() for name in (DRIVEN if known else self._live)})
        self._step(substeps, ids)


def replay(twins: TwinBatch, tapes: list[Tape]) -> float:
    """Simulate what was recorded, all agents in one batch; returns the time [s] of the steps alone."""
    live, taken = {**twins.state(), "ctrl": twins.ctrl}, 0.0
    for parts in zip(*(tape.steps for tape in tapes), strict=True):
        first = 0
        for part in parts:
            after = first + len(part["ctrl"])
            for name, value in part.items():
                live[name][first:after] = value
            first = after
        start = time.perf_counter()
        twins.step()
        taken += time.perf_counter() - start
    return taken


def main() -> None:
    learner = begin()
    twins = TwinBatch(mycobot280(), learner.agents, threads=2)
    whole, raw = [], []
    for _ in range(ROUNDS):  # in turns, so that other load hits both alike
        start = time.perf_counter()
        for _ in range(UPDATES):
            learner.iterate()
        whole.append((time.perf_counter() - start) / UPDATES)
        tapes = [Tape(worker.task) for worker in learner.workers]
        learner.iterate()
        raw.append(replay(twins, tapes))
        for worker in learner.workers:
            del worker.task.simulation.twins.step
    steps = learner.agents * ROLLOUT
    alone, training = float(np.median(raw)), float(np.median(whole))
    print(
        f"simulation of the same steps alone: {1e6 * alone / steps / SUBSTEPS:.2f} us per physics step on two threads"
    )
    print(f"training: {steps / training:.0f} transitions per second, {training / alone:.2f} x that simulation")


if __name__ == "__main__":
    main()
