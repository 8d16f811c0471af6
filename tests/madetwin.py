"""Twins, displacements and calibrations as they would be found."""

from dataclasses import replace

import numpy as np

from rejoint.arms import Displacement
from rejoint.diagnosis.calibration.calibration import Calibration, DisplacementLayout
from rejoint.twin.parameters import prior
from rejoint.twin.twin import HeldOut, PredictionError, Twin


def made_twin(arm, parameters, **facts):
    """A twin whose parameters are known to a tenth of what was known before."""
    belief = prior(arm)
    error = PredictionError(joint=0.01, tcp=1e-3)
    found = {
        "covariance": np.diag((0.1 * belief.sigma) ** 2),
        "narrowing": np.full(len(belief.mean), 0.1),
        "identified": np.ones(len(belief.mean), dtype=bool),
        "held_out": HeldOut(seconds=30.0, no_twin=error, healthy_twin=error, twin=error),
        "fit_seconds": 1.0,
        "lower": belief.lower,
        "upper": belief.upper,
    }
    return Twin(arm=arm.name, joint_names=arm.joint_names, parameters=parameters, **found | facts)


def made_calibration(arm, displacement, **facts):
    found = {
        "covariance": 1e-12 * np.eye(DisplacementLayout(arm).body),
        "frame": np.eye(4),
        "frame_name": "base",
        "source": "touch",
        "date": "",
        "points": 4,
        "before": 2e-3,
        "after": 1e-3,
        "used": True,
        "floor": 1e-6,
    }
    return Calibration(arm=arm, displacement=displacement, **found | facts)


def displaced(arm, seed, offset):
    """A displacement of everything; ``offset`` [rad] of its zeros."""
    rng, n = np.random.default_rng(seed), arm.joints
    return replace(
        Displacement.none(arm),
        offset=rng.normal(0.0, offset, n),
        compliance=rng.uniform(0.0, 0.03, n),
        play=rng.uniform(0.0, 0.03, n),
        twist=rng.normal(0.0, 1.0, (n + 1, 6)) * ([1e-3] * 3 + [5e-3] * 3),
    )
