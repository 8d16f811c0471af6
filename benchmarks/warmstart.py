"""What it buys to begin a training on an arm's own twin at the policy from the shelf instead of at random weights.

`python -m benchmarks warmstart --arms 16 --twins FOLDER` identifies each arm, a few seconds, trains for it from both
beginnings with the same number of updates, and holds eight copies of the arm with other noise at three targets each,
the same for every policy. Twins and policies are kept in FOLDER. ``--updates 12,24,150`` trains with several numbers
of them, ``--starts random`` from one beginning.
"""

import tempfile
import time
from dataclasses import replace
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from benchmarks.frame import held_columns, holds
from benchmarks.predictive import ARM, TARGETS, know
from rejoint.control.controllers.catalogue import shelf_path
from rejoint.control.controllers.policy import load_policy
from rejoint.control.targets import draw_targets
from rejoint.training.task import DEFAULT, load_preset
from rejoint.training.train import TrainingOptions, train
from rejoint.twin.twin import Twin
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.wear import load_wear
from rejoint_lab.research.evaluation.family import ArmFamily, try_on

COPIES = 8
"""Trials of one arm side by side (chosen)"""
PRESETS = {"shelf": DEFAULT, "random": load_preset("scratch")}


def trained(twin: Twin, start: str, updates: int, seed: int, file: Path) -> float | None:
    """Train for the arm of ``twin`` into ``file``, if it is not there yet; returns the processor time [s] of it."""
    if file.exists():
        return None
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        preset = replace(PRESETS[start], name=f"{start}-{updates}")
        options = TrainingOptions(preset=preset, seed=seed, iterations=updates)
        result = train(ARM, twin, out=Path(folder), options=options)
        file.write_bytes(result.policy.read_bytes())
    return time.process_time() - begun


def held(file: Path, wear_seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Settled errors [m] and times [s] to come and stay within 2 mm of all holds of one arm."""
    family = ArmFamily(arms=1, targets=TARGETS, crossings=0)
    wear = load_wear(f"worn?seed={wear_seed}", ARM)
    opened = partial(EmulatedRobot, ARM, [wear] * COPIES, seed=wear_seed)
    targets = draw_targets(ARM, sets=COPIES, count=TARGETS, seed=wear_seed)
    return held_columns(try_on(ARM, opened, lambda arm: load_policy(file, arm), family, (targets, None)), arms=1)


def main(
    arms: int = 16,
    family: int = 0,
    twins: Path = Path("runs/twins"),
    updates: str = "",
    starts: str = "shelf,random",
    seed: int = 0,
) -> None:
    """Print a row for each beginning and number of updates; ``twins`` keeps twins and policies."""
    drawn = ArmFamily(arms=arms, targets=TARGETS, seed=family)
    own, seeds = know(drawn, twins), drawn.wear_seeds
    usual = (DEFAULT.warm or DEFAULT.ppo).iterations
    shelf = together([held(shelf_path(ARM.name), one) for one in seeds])
    holds("shelf, as it comes", *shelf, None)
    for start, count in product(starts.split(","), map(int, (updates or str(usual)).split(","))):
        files = [twins / str(one) / f"{start}-{count}-{seed}.onnx" for one in seeds]
        times = [trained(twin, start, count, seed, file) for twin, file in zip(own, files, strict=True)]
        recipe = PRESETS[start].warm or PRESETS[start].ppo
        size = count * recipe.agents * recipe.rollout / 1e6
        found = together([held(file, one) for file, one in zip(files, seeds, strict=True)])
        holds(f"{start}, {count} updates, {size:.2f} million", *found, shelf)
        if spent := [one for one in times if one is not None]:
            print(f"  trained in {np.median(spent):.0f} s of processor time")


def together(found: list[tuple[np.ndarray, np.ndarray]]) -> list[np.ndarray]:
    """Put together what was found of each arm."""
    return [np.concatenate(one) for one in zip(*found, strict=True)]
