"""How long it takes to learn a policy that is good enough, from nothing, and how good it is on arms never met."""

import tempfile
import time
from pathlib import Path

from benchmarks.shelf import ARMS, TARGETS, figures, tried
from rejoint.arms import mycobot280
from rejoint.training.train import TrainingOptions, train

ITERATIONS = 75
"""Half of the default preset's (chosen: with 50 the tail of some trainings is too long)"""
MEAN, TAIL = 0.5e-3, 1.0e-3
"""[m] settled encoder error on worn arms: mean and 95th percentile"""


def main(updates: int = ITERATIONS, seed: int = 0) -> None:
    arm = mycobot280()
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        result = train(arm, None, out=Path(folder), options=TrainingOptions(iterations=updates, seed=seed))
        taken = time.perf_counter() - start
        mean, tail, _ = figures(tried(arm.name, result.policy))
    met = "both met" if mean <= MEAN and tail <= TAIL else "NOT met"
    print(f"{result.steps / 1e6:.2f} million transitions in {taken:.1f} s, from an empty folder to policy.onnx")
    print(
        f"settled on {ARMS} worn arms, {TARGETS} targets each: mean {1e3 * mean:.2f} mm (bar {1e3 * MEAN:.1f}), "
        f"95 % below {1e3 * tail:.2f} mm (bar {1e3 * TAIL:.1f}): {met}"
    )
