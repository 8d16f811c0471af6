"""What one time step of a twin costs: the compiled step as training uses it, and MuJoCo's of the same twins."""

import time
from dataclasses import replace

import numpy as np

from rejoint.arms import mycobot280
from rejoint.twin.parameters import nominal_parameters
from rejoint.twin.simulation import SUBSTEPS, ChainBatch, Draw
from rejoint.twin.table import TableBatch

ROUNDS, CYCLES = 9, 8


def main(arms: int = 1024) -> None:
    arm, rng = mycobot280(), np.random.default_rng(0)
    twins = nominal_parameters(arm).repeat(arms)
    twins = replace(
        twins,
        stiction=np.full_like(twins.stiffness, 1.5),
        stiffness=twins.stiffness * rng.uniform(0.5, 2.0, twins.stiffness.shape),
    )
    chain, judge = ChainBatch(arm, arms), TableBatch(arm, twins)
    start = np.tile(arm.rest, (arms, 1))
    chain.write(Draw.of(twins))
    for batch in (chain, judge):
        batch.restart(start)
    goals = start[:, None] + rng.normal(0.0, 0.2, (CYCLES, arms, 1, arm.joints)).repeat(SUBSTEPS, axis=2)
    took: dict[str, list[float]] = {}
    for k in range(ROUNDS + 1):  # in turns, so that other load hits all alike; the first compiles
        for name, roll in {
            "compiled": chain.rollout,
            "MuJoCo": judge.rollout,
        }.items():
            begun = time.process_time()
            for goal in goals:
                roll(goal)
            if k:
                took.setdefault(name, []).append(1e6 * (time.process_time() - begun) / arms / CYCLES / SUBSTEPS)
    for name, times in took.items():
        print(f"{name:>28}: {np.median(times):.2f} us per arm and step of one core ({min(times):.2f} at best)")
    print(f"ratio {np.median(np.divide(took['MuJoCo'], took['compiled'])):.1f}")
