"""How much faster than reality the worn arm is simulated."""

import os
from functools import partial
from timeit import repeat

import numpy as np

from rejoint.arms import mycobot280
from rejoint_lab.plant.plant import Plant
from rejoint_lab.plant.wear import load_wear


def main() -> None:
    arm = mycobot280()
    print(f"{'arms':>6} {'threads':>8} {'times real time':>16} {'per core':>9}")
    for count, threads in ((1, 1), (64, 1), (512, 1), (512, os.cpu_count() or 1)):
        os.environ["OMP_NUM_THREADS"] = str(threads)
        plant = Plant(arm, [load_wear(f"worn?seed={i}", arm) for i in range(count)], seed=0)
        plant.reset(np.tile(arm.rest, (count, 1)))
        duration = 5.0 if count == 1 else 0.5
        wall = min(repeat(partial(plant.advance, np.full(count, duration)), number=1, repeat=4)[1:])
        speed = count * duration / wall
        print(f"{count:>6} {threads:>8} {speed:>15.0f}x {speed / threads:>8.0f}x")
