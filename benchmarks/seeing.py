"""How near the tool comes with and without a camera that watches it.

    python -m benchmarks seeing --arms 12 --first 1000 --policy runs/mine/policy.onnx

Every emulated worn arm is calibrated from ten measured points, then goes to targets drawn by its seed. True errors,
mean / 95th percentile over all targets [mm], each the mean of the last 0.2 s before a time since the target was set.
"""

from pathlib import Path

import numpy as np

import rejoint
from benchmarks.frame import cell
from rejoint.arms import Arm, Displacement, mycobot280
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.correction import Modelled
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import Recording
from rejoint.control.reference import TargetSequence
from rejoint.control.robot import Controller
from rejoint.control.seeing import Finishing, Seen
from rejoint.control.start import move
from rejoint_lab.emulated import EmulatedEye

TIMES = (2.0, 3.0, 3.95)
WINDOW = 0.2
CASES = {"model only": False, "camera": True}
"""Whether an emulated eye watches"""


def errors(recording: Recording) -> np.ndarray:
    """Return the true errors (times, targets) [mm]."""
    error = 1e3 * np.linalg.norm(recording.true_tcp - recording.target, axis=-1)[:, 0]
    index, since = recording.target_index[:, 0], recording.since_target[:, 0]
    return np.array(
        [
            [error[(index == k) & (since > at - WINDOW) & (since <= at)].mean() for k in range(index.max() + 1)]
            for at in TIMES
        ]
    )


def driven(arm: Arm, seed: int, controller: Controller, known: Displacement, eye: bool, count: int):
    """Return the true errors (times, targets) [mm] of the arm of one ``seed``."""
    robot = rejoint.open_robot(f"emulated:worn?seed={seed}")
    start = move(robot, arm.rest)
    correction: Modelled = Modelled(arm, known)
    if eye:
        seen = Seen(arm, known, eye=EmulatedEye(robot, seed=seed))
        controller, correction = Finishing(arm, controller, seen), seen
    targets = arm.targets.sample(np.random.default_rng(seed), (1, count))
    schedule = Schedule(dwell=4.0, sent=start.command[-1])
    return errors(run(robot, controller, TargetSequence(robot.arm, targets, correction=correction), schedule))


def main(arms: int = 4, first: int = 1000, targets: int = 8, policy: Path | None = None) -> None:
    """Print one row for each case; the integrator drives where there is no policy file."""
    arm, name = mycobot280(), "integrator" if policy is None else "policy"
    found: dict[str, list[np.ndarray]] = {case: [] for case in CASES}
    for seed in range(first, first + arms):
        fit = rejoint.calibrate(f"emulated:worn?seed={seed}", count=10).calibration
        known = fit.displacement if fit.used else Displacement.none(arm)
        for case, rows in found.items():
            controller = make_controller(name, arm, policy=policy)
            rows.append(driven(arm, seed, controller, known, CASES[case], targets))
    print(f"{arms} arms, {targets} targets each, {name}; after {', '.join(map(str, TIMES))} s")
    for case, rows in found.items():
        table = np.concatenate(rows, axis=1)
        print(f"{case:24} | {' | '.join(map(cell, table))}")
