"""How much faster than reality the worn arm is simulated."""

from functools import partial
from timeit import repeat

import numpy as np

from rejoint.arms import mycobot280
from rejoint_lab.plant.plant import Plant
from rejoint_lab.plant.wear import load_wear


def main() -> None:
    arm = mycobot280()
    print(f"{'arms':>6} {'times real time':>16}")
    for count in (1, 64, 512):
        plant = Plant(arm, [load_wear(f"worn?seed={i}", arm) for i in range(count)], seed=0)
        plant.reset(np.tile(arm.rest, (count, 1)))
        duration = 5.0 if count == 1 else 0.5
        wall = repeat(partial(plant.advance, np.full(count, duration)), number=1, repeat=4)[1:]
        print(f"{count:>6} {count * duration / min(wall):>15.0f}x")
