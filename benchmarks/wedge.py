"""How steep a wedge must be for gravity to press the base joint of an emulated worn arm to one side of its play.

    python -m benchmarks wedge --arms 30 --family 3

Arms whose base is raised on one side are calibrated from ten touch points and sent to four fresh targets each. Printed
per slope: true error, mean / 95th percentile [mm], and the share of the targets that the interval held.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.frame import corrected
from rejoint.arms import mycobot280
from rejoint.control.controllers.catalogue import make_controller
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.calibration.postures import suggest
from rejoint_lab.research.evaluation.calibrating import SIGMA, fitted, measure
from rejoint_lab.research.evaluation.family import WORN, ArmFamily, TrialArms, open_family, try_on

POINTS, TARGETS = 10, 4


def main(arms: int = 30, family: int = 3, slopes: str = "0,0.5,1,2") -> None:
    """Print a row for each slope [deg]."""
    arm, drawn = mycobot280(), ArmFamily(arms=arms, targets=TARGETS, crossings=0, seed=family)
    plan = suggest(arm, POINTS, visits=2, sigma=SIGMA)
    targets = draw_targets(arm, sets=arms, count=TARGETS, seed=90 + family)
    for slope in map(float, slopes.split(",")):
        opened = partial(open_family, arm, replace(WORN, tilt=np.radians(slope)), drawn)
        found = fitted(arm, measure(opened(), plan, family), POINTS)
        fresh = TrialArms(open=opened, targets=targets, wear_seeds=drawn.wear_seeds, calibrations=found)
        tried = try_on(arm, fresh, partial(make_controller, "feedforward"), drawn)
        corrected(f"{slope:g} degrees", tried, found)
