"""True errors of emulated arms before and after `rejoint calibrate --measure camera=emulated`, with rendered pictures.

    python -m benchmarks filming --arms 8 --first 700

Every arm is filmed from its own start, fitted, and sent to fresh targets by the integrator, by its encoders alone and
corrected (where the gate allows it), 8 s at each: mean and 95th percentile of the true error at the end [mm].
"""

import time
from contextlib import nullcontext

import numpy as np

import rejoint
from benchmarks.frame import cell
from rejoint.arms import mycobot280
from rejoint.camera.board import ON_TABLE, ON_TOOL
from rejoint.camera.filming import CHOSEN, CameraGauge
from rejoint.control.seeing import simulated

DWELL = 8.0


def main(
    arms: int = 4,
    first: int = 700,
    targets: int = 4,
    carried: str = "board",
) -> None:
    """Print a row for each arm; the tool carries the board or the camera."""
    arm, board = mycobot280(), ON_TOOL if carried == "board" else ON_TABLE
    before, after, inside, used, left, pictures = [], [], [], 0, 0, 0
    began = time.perf_counter()
    for seed in range(first, first + arms):
        address = f"emulated:worn?seed={seed}"
        gauge = CameraGauge(
            camera=lambda robot, seed=seed: nullcontext(simulated(robot).camera(board, carried, seed)),
            board=board,
            carried=carried,
        )
        found = rejoint.calibrate(address, gauge=gauge, count=CHOSEN, settings=rejoint.Settings(seed=seed))
        goals = arm.targets.sample(np.random.default_rng(seed), (targets,))
        for errors, calibration in ((before, "none"), (after, found.calibration)):
            done = rejoint.deploy(
                address,
                goals,
                settings=rejoint.Settings(controller="integrator", calibration=calibration, dwell=DWELL, seed=seed + 1),
            )
            errors.append([1e3 * visit.true_error.value for visit in done.visits])
            if calibration != "none":
                position, truth = done.log.position, done.log.true_tcp
                ends = np.searchsorted(done.log.time - done.log.time[0], DWELL * np.arange(1, targets + 1)) - 1
                low = found.calibration.distance(position[ends], truth[ends])[1]
                inside += [low == 0.0]
        used, left = used + found.calibration.used, left + len(found.filmed.left_out)
        pictures += len(found.filmed.residuals) + len(found.filmed.left_out)
        print(
            f"{address}: {np.mean(before[-1]):.2f} -> {np.mean(after[-1]):.2f}, used {found.calibration.used}",
            flush=True,
        )
    print(f"{arms} arms, {time.perf_counter() - began:.0f} s; {used} corrected; {left} of {pictures} left out")
    for name, errors in (("not calibrated", before), ("by film", after)):
        print(f"{name:16} {cell(errors)}")
    worse = np.mean(after, axis=1) - np.mean(before, axis=1)
    print(f"arms that became worse: {int((worse > 0.2).sum())}; the tool within the interval: {np.mean(inside):.0%}")
