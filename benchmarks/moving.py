"""How well worn arms follow where `rejoint research follow` does not look.

Each arm is diagnosed and identified first. Errors are root mean squares by the encoders, in mm, mean over the arms.
"""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np

from rejoint.arms import Motors, mycobot280
from rejoint.control.loop import Schedule, run
from rejoint.control.moving.drive import judge
from rejoint.control.moving.reference import LAG, LEAD_IN, STANDARD, PathReference, standard_path
from rejoint.control.moving.tracker import PathPostures, Tracker
from rejoint.control.recording import Recording
from rejoint.twin.parameters import TwinParameters, healthy_parameters, lifting_torque
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.plant.servo import Channel
from rejoint_lab.plant.wear import load_wear
from rejoint_lab.research.evaluation.evaluate import played
from rejoint_lab.research.evaluation.family import own_twins

ARM = mycobot280()
SEEDS = (30001, 30002, 30003)
"""Worn arms on which the tracker's gains were chosen"""
WEAK = (10007, 10021, 10061, 30018, 40023, 40045, 40069, 40077)
"""Those of five families whose third motor has least to spare, on which the fold was chosen"""
PATHS = [standard_path(name, ARM) for name in STANDARD]


def drive(
    profiles: Sequence[str], twins: Sequence[TwinParameters], period: tuple[float, float], guides, *, fold: bool = True
) -> Recording:
    known = TwinParameters.stacked([twin for twin in twins for _ in PATHS])
    motors = [Motors(one.torque_limit, lifting_torque(one)) if fold else None for one in twins]
    home = np.stack([path.home(ARM, own) for own in motors for path in PATHS])
    start = PathPostures(ARM, np.stack([path.place[0] for _ in profiles for path in PATHS]), home=home).last
    wears = [load_wear(profile, ARM) for profile in profiles for _ in PATHS]
    robot = EmulatedRobot(ARM, wears, start=start, channel=Channel(period=period))
    dwell = LEAD_IN + LAG + max(path.duration for path in PATHS)
    controller = Tracker(ARM, known, period=sum(period) / 2)
    return run(robot, controller, PathReference(ARM, guides, home), Schedule(dwell=dwell, sent=start, keep_going=True))


def show(
    title: str, profiles: Sequence[str], twins: Sequence[TwinParameters], period=(0.02, 0.03), rate=None, *, fold=True
) -> None:
    paths = [path for _ in profiles for path in PATHS]
    guides = paths if rate is None else [played(path, rate) for path in paths]
    begun = perf_counter()
    recording = drive(profiles, twins, period, guides, fold=fold)
    took = perf_counter() - begun
    found = [judge(ARM, recording, path, b).encoder for b, path in enumerate(paths)]
    rms = 1e3 * np.array([one.rms if rate is None else one.rms_after for one in found]).reshape(len(profiles), -1)
    lag = 1e3 * np.mean([one.lag for one in found])
    cells = "  ".join(f"{value:5.2f}" for value in rms.mean(axis=0))
    print(f"{title:34} {cells}   lag {lag:3.0f} ms   {took:4.0f} s   tripped {int((recording.tripped != 0).sum())}")


def main() -> None:
    twins = identified(SEEDS)
    worn = [f"worn?seed={seed}" for seed in SEEDS]
    print(f"{'':34} {'  '.join(name[-5:] for name in STANDARD)}")
    show("known ahead", worn, twins)
    show("known ahead, cycles of 45 to 55 ms", worn, twins, (0.045, 0.055))
    for rate in (10.0, 30.0, 100.0):
        show(f"as it goes, {rate:g} Hz", worn, twins, rate=rate)
    show("healthy arm, its twin", ["healthy"], [healthy_parameters(ARM)])
    weak, known = [f"worn?seed={seed}" for seed in WEAK], identified(WEAK)
    show("weak motors, at rest", weak, known, fold=False)
    show("weak motors, folded", weak, known)


def identified(seeds: Sequence[int]) -> list[TwinParameters]:
    with TemporaryDirectory() as place:
        return [twin.parameters for twin in own_twins(ARM, seeds, Path(place), 0)]
