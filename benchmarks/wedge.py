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
from rejoint.control.catalogue import make_controller
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.postures import suggest
from rejoint_lab.research.evaluation.calibrating import (
    SIGMA,
    FreshTargets,
    find_condition,
    measure,
    open_condition,
    try_found,
)
from rejoint_lab.research.evaluation.family import ArmFamily

POINTS, TARGETS = 10, 4


def main(arms: int = 30, family: int = 3, slopes: str = "0,0.5,1,2") -> None:
    """Print a row for each slope [deg]."""
    arm, drawn = mycobot280(), ArmFamily(arms=arms, targets=TARGETS, seed=family)
    plan = suggest(arm, POINTS, visits=2, sigma=SIGMA)
    targets = draw_targets(arm, sets=arms, count=TARGETS, seed=90 + family)
    for slope in map(float, slopes.split(",")):
        tilted = replace(find_condition("worn"), tilt=np.radians(slope))
        measured = measure(open_condition(arm, tilted, drawn, 1), plan, family)
        found = [fit(arm, measured.first(i, POINTS)) for i in range(arms)]
        controller, fresh = partial(make_controller, "feedforward"), FreshTargets(name="target region", targets=targets)
        tried = try_found(open_condition(arm, tilted, drawn, 1), found, controller, fresh, POINTS)
        corrected(f"{slope:g} degrees", tried)
