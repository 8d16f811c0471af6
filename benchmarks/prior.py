"""What an earlier calibration is worth as the prior of a later one from few points.

    python -m benchmarks.prior --arms 20

Emulated worn arms are calibrated from ten touch points. Then something changes: 30 % more play and flex, or the base is
bumped by two degrees. They are measured again at a few points, and calibrated from these with the first calibration as
the prior, and without it; and the first one is used as it is. True error at fresh targets, mean / 95th percentile [mm],
and the share of targets whose error lies in the interval of the calibration with the prior.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from rejoint.arms import Arm, Array, mycobot280
from rejoint.control.catalogue import make_controller
from rejoint.control.comparison.targets import draw_targets
from rejoint.control.controller import Controller
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.postures import suggest
from rejoint.research.evaluation.calibrating import CONDITIONS, SIGMA, measure, open_condition, try_found
from rejoint.research.evaluation.family import ArmFamily
from rejoint.robots.emulated import EmulatedRobot

FIRST, TARGETS = 10, 4
WORN_ON, BUMPED = 1.3, np.radians(2.0)
CHANGES = ("nothing", "worn on", "bumped")


def changed(change: str, family: ArmFamily) -> EmulatedRobot:
    """Open all arms as they are after a change."""
    condition = CONDITIONS[0]
    if change == "bumped":
        condition = replace(condition, tilt=BUMPED)
    robot = open_condition(mycobot280(), condition, family, 1)
    if change == "worn on":
        robot.plant.joints["play"] *= WORN_ON
        robot.plant.joints["link_stiffness"] /= WORN_ON
    return robot


def main() -> None:
    """Print a table for each change."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.prior", description="Calibrating for a second time.")
    parser.add_argument("--arms", type=int, default=20)
    parser.add_argument("--points", type=int, nargs="+", default=[3], help="of the second calibration")
    parser.add_argument("--changes", nargs="+", default=list(CHANGES), choices=CHANGES)
    options, _ = parser.parse_known_args()
    arm, family = mycobot280(), ArmFamily(arms=options.arms, targets=TARGETS, seed=0)
    plan = suggest(arm, FIRST, visits=2, sigma=SIGMA)
    begun = measure(changed("nothing", family), plan, family.seed)
    first = [fit(arm, begun.first(i, FIRST)) for i in range(options.arms)]
    targets = draw_targets(arm, sets=options.arms, count=TARGETS, seed=11)
    for change in options.changes:
        measured = measure(changed(change, family), suggest(arm, max(options.points), visits=1, sigma=SIGMA, seed=1), 1)
        print(f"{change}, {options.arms} arms")
        say("first calibration as it is", change, first, family, targets)
        for count in options.points:
            alone = [fit(arm, measured.first(i, count)) for i in range(options.arms)]
            after = [fit(arm, measured.first(i, count), prior=first[i]) for i in range(options.arms)]
            say(f"{count} points alone", change, alone, family, targets)
            say(f"{count} points after the first", change, after, family, targets)


def say(name: str, change: str, found: list[Calibration], family: ArmFamily, targets: Array) -> None:
    """Drive all arms to their targets, and print the errors."""
    tried = try_found(changed(change, family), found, controller, targets, 0)
    error, inside = 1e3 * tried.error, tried.inside[np.isfinite(tried.error)]
    print(
        f"{name:28} {np.nanmean(error):5.2f} / {np.nanquantile(error, 0.95):.2f}   inside {inside.mean():.0%}"
        f"   used {tried.used.mean():.0%}",
        flush=True,
    )


def controller(arm: Arm) -> Controller:
    """Return that of the family evaluation."""
    return make_controller("feedforward", arm)


if __name__ == "__main__":
    main()
