"""How steep a wedge must be for gravity to press the base joint of an emulated worn arm to one side of its play.

    python -m benchmarks.wedge --arms 30 --family 3

Arms whose base is raised on one side are calibrated from ten touch points and sent to four fresh targets each. Printed
per slope: true error, mean / 95th percentile [mm], and the share of the targets that the interval held.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from rejoint.arms import Arm, mycobot280
from rejoint.control.catalogue import make_controller
from rejoint.control.comparison.targets import draw_targets
from rejoint.control.controller import Controller
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.postures import suggest
from rejoint.research.evaluation.calibrating import SIGMA, find_condition, measure, open_condition, try_found
from rejoint.research.evaluation.family import ArmFamily

POINTS, TARGETS = 10, 4


def controller(arm: Arm) -> Controller:
    """Return that of the family evaluation."""
    return make_controller("feedforward", arm)


def main() -> None:
    """Print a row for each slope."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.wedge", description="The least wedge that does.")
    parser.add_argument("--arms", type=int, default=30)
    parser.add_argument("--family", type=int, default=3)
    parser.add_argument("--condition", default="worn")
    parser.add_argument("--slopes", type=float, nargs="+", default=[0.0, 0.5, 1.0, 2.0], help="degrees")
    options, _ = parser.parse_known_args()
    arm, family = mycobot280(), ArmFamily(arms=options.arms, targets=TARGETS, seed=options.family)
    plan = suggest(arm, POINTS, visits=2, sigma=SIGMA)
    targets = draw_targets(arm, sets=options.arms, count=TARGETS, seed=90 + options.family)
    for slope in options.slopes:
        condition = replace(find_condition(options.condition), tilt=np.radians(slope))
        measured = measure(open_condition(arm, condition, family, 1), plan, family.seed)
        found = [fit(arm, measured.first(i, POINTS)) for i in range(options.arms)]
        tried = try_found(open_condition(arm, condition, family, 1), found, controller, targets, POINTS)
        error, inside = 1e3 * tried.error, tried.inside[np.isfinite(tried.error)]
        print(
            f"{slope:4g} degrees: {np.nanmean(error):.2f} / {np.nanquantile(error, 0.95):.2f}   inside "
            f"{inside.mean():.0%}   used {tried.used.mean():.0%}",
            flush=True,
        )


if __name__ == "__main__":
    main()
