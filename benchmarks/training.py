"""What training costs beyond the simulation that it cannot do without."""

import tempfile
import time
from pathlib import Path

import numpy as np

from rejoint.arms import mycobot280
from rejoint.training.task import SUBSTEPS
from rejoint.training.train import TrainingOptions, train
from rejoint.twin.batch import TwinBatch

AGENTS, ITERATIONS, ROLLOUT = 512, 8, 32


def main() -> None:
    arm = mycobot280()
    twins = TwinBatch(arm, AGENTS, threads=2)
    twins.restart(np.tile(arm.rest, (AGENTS, 1)))
    twins.step(SUBSTEPS)
    start = time.perf_counter()
    for _ in range(ITERATIONS * ROLLOUT):
        twins.step(SUBSTEPS)
    raw = time.perf_counter() - start
    with tempfile.TemporaryDirectory() as folder:
        options = TrainingOptions(iterations=ITERATIONS, agents=AGENTS, threads=2)
        whole = train(arm, None, out=Path(folder), options=options).wall_s
    steps = AGENTS * ITERATIONS * ROLLOUT
    print(f"raw simulation of the same steps: {raw:.2f} s, {1e6 * raw / steps / SUBSTEPS:.2f} us per physics step")
    print(f"training: {whole:.2f} s, {steps / whole:.0f} transitions per second, {whole / raw:.2f} x raw simulation")
