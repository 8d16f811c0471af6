"""What an earlier calibration is worth as the prior of a later one from few points.

    python -m benchmarks prior --arms 20

Emulated worn arms are calibrated from ten touch points. Then something changes: 30 % more play and flex, or the base is
bumped by two degrees. They are measured again at a few points, and calibrated from these with the first calibration as
the prior, and without it; and the first one is used as it is. True error at fresh targets, mean / 95th percentile [mm],
and the share of targets whose error lies in the interval of the calibration with the prior.
"""

from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.frame import corrected
from rejoint.arms import mycobot280
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.procedure import suggest
from rejoint_lab.emulated import EmulatedRobot
from rejoint_lab.research.evaluation.evaluate import SIGMA, measure
from rejoint_lab.research.evaluation.family import WORN, ArmFamily, open_family, try_on

FIRST, TARGETS = 10, 4
WORN_ON, BUMPED = 1.3, 2.0
CHANGES = ("nothing", "worn on", "bumped")


def changed(change: str, family: ArmFamily) -> EmulatedRobot:
    """Open all arms as they are after a change."""
    condition = replace(WORN, tilt_deg=BUMPED) if change == "bumped" else WORN
    robot = open_family(mycobot280(), condition, family)
    if change == "worn on":
        robot.plant.joints["play"] *= WORN_ON
        robot.plant.joints["link_stiffness"] /= WORN_ON
    return robot


def main(arms: int = 20, count: int = 3) -> None:
    """Print a table for each change; ``count`` points of the second calibration."""
    arm, family = mycobot280(), ArmFamily(arms=arms, targets=TARGETS, crossings=0)
    begun = measure(changed("nothing", family), suggest(arm, FIRST, visits=2, sigma=SIGMA), family.seed)
    first = [fit(arm, one.rows(np.arange(FIRST))) for one in begun]
    targets = draw_targets(arm, sets=arms, count=TARGETS, seed=11)
    for change in CHANGES:
        measured = measure(changed(change, family), suggest(arm, count, visits=1, sigma=SIGMA), 1)
        pairs = list(zip(measured, first, strict=True))
        found = {
            "first calibration as it is": first,
            f"{count} points alone": [fit(arm, part) for part in measured],
            f"{count} points after the first": [fit(arm, part, prior=one) for part, one in pairs],
        }
        print(f"{change}, {arms} arms")
        for name, calibrations in found.items():
            drive = partial(make_controller, "feedforward")
            opened = partial(changed, change, family)
            corrected(
                name, try_on(arm, opened, drive, family, (targets, None), lambda own=calibrations: own), calibrations
            )
