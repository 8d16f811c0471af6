"""What it buys to begin a training on an arm's own twin at the policy from the shelf instead of at random weights.

`python -m benchmarks.warmstart --arms 16 --twins FOLDER` identifies each arm, a few seconds, trains for it from both
beginnings with the same number of updates, and holds eight copies of the arm with other noise at three targets each,
the same for every policy. Twins and policies are kept in FOLDER. ``--updates 12,24,150`` trains with several numbers
of them, ``--starts random`` from one beginning.
"""

import argparse
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.predictive import ARM, TARGETS, know
from rejoint.control.comparison.result import Protocol
from rejoint.control.policy import load_policy
from rejoint.control.shelf import shelf_path
from rejoint.research.evaluation.family import ArmFamily
from rejoint.research.evaluation.identification import bench_of, one_arm
from rejoint.research.evaluation.trials import TrialSettings, try_on
from rejoint.system.statistics import paired_difference
from rejoint.training.presets import DEFAULT, SCRATCH
from rejoint.training.train import TrainingOptions, train
from rejoint.twin.twin import Twin

PRESETS = {"shelf": DEFAULT, "random": SCRATCH}
NARROW = int(np.argmin(Protocol().within))


def trained(twin: Twin, start: str, updates: int, seed: int, file: Path) -> float | None:
    """Train for the arm of ``twin`` into ``file``, if it is not there yet; returns the processor time [s] of it."""
    if file.exists():
        return None
    begun = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        preset = replace(PRESETS[start], name=f"{start}-{updates}")
        options = TrainingOptions(preset=preset, seed=seed, iterations=updates, threads=1)
        result = train(ARM, twin, out=Path(folder), options=options)
        file.write_bytes(result.policy.read_bytes())
    return time.process_time() - begun


def held(file: Path, wear_seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Settled errors [m] and times [s] to come and stay within 2 mm of all holds of one arm."""
    settings = TrialSettings(family=ArmFamily(arms=1, targets=TARGETS), protocol=Protocol(), crossing=False)
    bench = bench_of(ARM, wear_seed, settings)
    found = one_arm(try_on(ARM, bench, lambda arm: load_policy(file, arm), settings, lambda _: None))
    return found.settled[0], found.stay[0]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.warmstart")
    parser.add_argument("--arms", type=int, default=16)
    parser.add_argument("--family", type=int, default=0, help="family of arms; settings were chosen on 1")
    parser.add_argument("--twins", type=Path, default=Path("runs/twins"), help="folder that keeps twins and policies")
    parser.add_argument("--updates", default=str(DEFAULT.warm.iterations if DEFAULT.warm else DEFAULT.ppo.iterations))
    parser.add_argument("--starts", default="shelf,random")
    parser.add_argument("--seed", type=int, default=0, help="of the trainings")
    options = parser.parse_args()
    family = ArmFamily(arms=options.arms, targets=TARGETS, seed=options.family)
    twins, seeds = know(family, options.twins), [family.wear_seed(i) for i in range(family.arms)]
    kinds = [(start, int(n)) for start in options.starts.split(",") for n in options.updates.split(",")]
    untrained = [held(shelf_path(ARM.name), seed) for seed in seeds]
    show("shelf, as it comes", untrained, untrained, [])
    for start, updates in kinds:
        files = [options.twins / str(seed) / f"{start}-{updates}-{options.seed}.onnx" for seed in seeds]
        times = [trained(twin, start, updates, options.seed, file) for twin, file in zip(twins, files, strict=True)]
        found = [held(file, seed) for file, seed in zip(files, seeds, strict=True)]
        size = updates * DEFAULT.ppo.agents * DEFAULT.ppo.rollout
        show(f"{start}, {updates} updates, {size / 1e6:.2f} million", found, untrained, times)


def show(name: str, found: list, against: list, times: list[float | None]) -> None:
    """Print one line; pairs are the same hold of the same arm, and intervals resample arms."""
    settled, other = (np.stack([one[0] for one in some]) for some in (found, against))
    stay, shelf = (np.stack([one[1] for one in some]) for some in (found, against))
    arms = np.repeat(np.arange(len(settled)), settled.shape[1])
    apart = paired_difference(settled.ravel(), other.ravel(), arms)
    nearer = "" if apart is None or apart.low is None else (
        f"; against shelf {1e3 * apart.value:+.2f} mm ({1e3 * apart.low:+.2f} to {1e3 * apart.high:+.2f}), "
        f"{np.median(stay[..., NARROW]) / np.median(shelf[..., NARROW]):.2f} of its time"
    )  # fmt: skip
    known = [one for one in times if one is not None]
    spent = f"; trained in {np.median(known):.0f} s of processor time" if known else ""
    print(
        f"{name:34s} settled {1e3 * np.nanmean(settled):.2f} mm (95 %: {1e3 * np.nanpercentile(settled, 95):.2f}), "
        f"farther than 1 mm {100 * np.mean(~(settled < 1e-3)):.1f} %, stays within "
        f"{' / '.join(f'{np.median(stay[..., w]):.2f}' for w in range(stay.shape[-1]))} s{nearer}{spent}",
        flush=True,
    )


if __name__ == "__main__":
    main()
