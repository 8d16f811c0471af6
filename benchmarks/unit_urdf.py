"""How near a URDF of one unit comes to the true tool of emulated worn arms, on postures that no fit has seen.

Run with: python benchmarks/unit_urdf.py (half a minute)
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import rejoint
from rejoint.arms import Arm, Displacement, solve_position
from rejoint.arms.urdf import at_targets
from rejoint.diagnosis.calibration.gauges import EmulatedGauge
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.procedure import measure
from rejoint.robots import open_robot

ROBOTS = ("emulated:worn", "emulated:worn?seed=3", "emulated:worn?seed=8")


def elsewhere(robot: str, arm: Arm) -> Measurements:
    """Measure the tool without noise at targets that were drawn for this alone."""
    solution = solve_position(arm, arm.targets.sample(np.random.default_rng(99), (12,)), arm.rest)
    return measure(open_robot(robot, seed=99), EmulatedGauge(sigma=1e-9), solution.q[solution.converged])


def main() -> None:
    """Print the mean distance [mm] of the tool from where encoders, URDFs and the calibration say it is."""
    for robot in ROBOTS:
        own = rejoint.calibrate(robot).calibration
        other = elsewhere(robot, own.arm)
        zero = np.zeros(own.arm.joints)
        cases = {
            "encoders": Displacement.none(own.arm),
            "zeros and links alone": replace(own.displacement, compliance=zero, play=zero),
            "exported URDF": own.displacement.rigid(own.arm, at_targets(own.arm)),
            "calibration": own.displacement,
        }
        off = {
            name: 1e3 * float(np.linalg.norm(case.tool(own.arm, other.position) - other.point, axis=1).mean())
            for name, case in cases.items()
        }
        print(robot, ", ".join(f"{name} {value:.2f} mm" for name, value in off.items()))


if __name__ == "__main__":
    main()
