"""How bad the simulated arms are: the table that the wear profiles were calibrated with.

    python -m benchmarks.calibration --sets 16 --wear worn --wear healthy

Every arm goes to ten targets in sequence, at most 20 s each, as in section IV of Park et al. 2024.
"hold" stays at every target, and its error is the mean of the last second. "cross" goes on at the
first error below 10 mm as the paper does, and its error is the last one before that.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from rejoint.arms import load_arm, tcp_position
from rejoint.control.catalogue import make_controller
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import Recording
from rejoint.robots.emulated import EmulatedRobot
from rejoint.robots.lab.plant.wear import load_wear, wear_names

DWELL = 20.0
REACHED = 0.010
TARGETS = 10
PROTOCOLS = (("default", False), ("pid-sum", True), ("pid-sum", False), ("integrator", False), ("feedforward", False))
"""Controllers, and whether they go on at the first error below 10 mm."""


def describe(recording: Recording, cross: bool) -> str:
    """One row of the table: rate (lowest and highest of the arms), errors, seconds for ten targets."""
    arm = load_arm(recording.arm)
    encoder = np.linalg.norm(tcp_position(arm, recording.position) - recording.target, axis=-1)
    true = np.linalg.norm(recording.true_tcp - recording.target, axis=-1)
    count = encoder.shape[1]
    reached = np.zeros((count, TARGETS), bool)
    errors = np.zeros((2, count, TARGETS))
    for b in range(count):
        for k in range(TARGETS):
            rows = np.flatnonzero(recording.active[:, b] & (recording.target_index[:, b] == k))
            reached[b, k] = (encoder[rows, b] < REACHED).any()
            since = recording.since_target[rows, b]
            kept = rows[-1:] if cross else rows[since > since[-1] - 1.0]
            errors[:, b, k] = 1e3 * encoder[kept, b].mean(), 1e3 * true[kept, b].mean()
    rate, (settled, off) = 100 * reached.mean(axis=1), errors
    cycle = (recording.time.max(axis=0) - recording.time[0]).mean()
    return (
        f"{rate.mean():5.1f} ({rate.min():3.0f}-{rate.max():3.0f}) | {settled.mean():5.1f} +- {settled.std():4.1f}"
        f" | {settled.mean(axis=1).min():4.1f}-{settled.mean(axis=1).max():4.1f} | {off.mean():5.1f} | {cycle:6.1f}"
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Print how bad the simulated arms are.")
    parser.add_argument("--sets", type=int, default=16, help="target sets, each on an arm of its own")
    parser.add_argument("--seed", type=int, default=0, help="of targets and noise")
    parser.add_argument("--wear", action="append", help="wear profile; may be repeated; with {} for the arm's number")
    parser.add_argument("--controller", action="append", help="may be repeated")
    options = parser.parse_args()
    arm = load_arm("mycobot280")
    targets = arm.targets.sample(np.random.default_rng(options.seed), (options.sets, TARGETS))
    print("profile        controller         | <10 mm % (sets) | error mm      | per set   | true  | cycle s")
    for name in options.wear or wear_names():
        wears = [load_wear(name.format(i), arm) for i in range(options.sets)]
        for controller, cross in PROTOCOLS:
            if options.controller and controller not in options.controller:
                continue
            schedule = Schedule(dwell=DWELL, stop_below=REACHED if cross else None, keep_going=True)
            robot, begun = EmulatedRobot(arm, wears, seed=options.seed), time.perf_counter()
            recording = run(robot, make_controller(controller, arm), targets, schedule)
            speed = robot.plant.time.sum() / (time.perf_counter() - begun)
            label = f"{controller}, {'cross' if cross else 'hold'}"
            row = describe(recording, cross)
            print(f"{name:14} {label:18} | {row} | {speed:.0f} x real time, {recording.tripped.any()}", flush=True)


if __name__ == "__main__":
    main()
