"""From measurements to a calibration: fit under several beliefs, the likeliest one, tried on points left out."""

from __future__ import annotations

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.framing import align
from rejoint.diagnosis.calibration.gate import leave_out, merge_repeats
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.model import floor_of
from rejoint.diagnosis.calibration.parameters import (
    ASKEW,
    LEVEL,
    OFFSET,
    PLAY_SIGMA,
    Belief,
    DisplacementLayout,
    PriorCase,
    belief,
    displacement_of,
    vector_of,
)
from rejoint.diagnosis.calibration.solver import CalibrationProblem, Fitted, search, solve
from rejoint.system.errors import InputError

CASES = (
    PriorCase(),
    PriorCase(play=np.radians(0.15), play_sigma=np.radians(0.15), compliance=0.003),
    PriorCase(tilt=ASKEW, odds=-0.5),
    PriorCase(twist=1.0, odds=-1.0),
)
"""A worn arm, a healthy one, a worn one whose base stands askew, and one whose links differ from their description"""
AGE = 0.3
"""Share of the standard deviations of beliefs by which an arm may have changed since it was calibrated (chosen: 30 %
more wear is 0.3 of the play of a worn arm)"""

LINKS_FROM = 5
"""Postures from which errors of links are fitted (chosen: of 3, one emulated arm in 40 became 18 mm worse)"""


def fit(
    arm: Arm, measurements: Measurements, *, prior: Calibration | None = None, date: str = ""
) -> Calibration:  # fmt: skip
    """Fit a displacement to ``measurements`` of ``arm`` and try it on points left out.

    ``prior`` is an earlier calibration of the same arm (ContractError for another). InputError where the measurements
    cannot be used.
    """
    if measurements.position.shape[1] != arm.joints:
        raise InputError(
            f"measurements of {measurements.position.shape[1]} joints, the arm {arm.name} has {arm.joints}; take those "
            "of this arm"
        )
    if not np.isfinite(measurements.point).any():
        raise InputError("measurements: no coordinate was measured; expected at least one")
    measurements = merge_repeats(measurements)
    foreign = measurements.frame != "base"
    layout = DisplacementLayout(joints=arm.joints, frame=foreign)
    frame = align(arm, measurements) if foreign else np.eye(4)
    beliefs = beliefs_of(arm, layout, prior, len(np.unique(measurements.posture)))
    solved = [_solved(arm, measurements, layout, frame, one) for one, _ in beliefs]
    best = int(np.argmax([fitted.evidence + odds for (_, fitted), (_, odds) in zip(solved, beliefs, strict=True)]))
    return _judged(*solved[best], date)


def beliefs_of(
    arm: Arm, layout: DisplacementLayout, prior: Calibration | None, postures: int
) -> list[tuple[Belief, float]]:
    """Return what may be believed before so many ``postures`` are fitted, each with the logarithm of its odds."""
    if prior is not None:
        prior.require(arm)
        return [(earlier(arm, layout, prior), 0.0)]
    cases = [case for case in CASES if not (case.twist and postures < LINKS_FROM)]
    return [(belief(arm, layout, case), case.odds) for case in cases]


def earlier(arm: Arm, layout: DisplacementLayout, prior: Calibration) -> Belief:
    """Return what an earlier calibration lets one believe: the same, but for what may have changed since."""
    base = belief(arm, layout, PriorCase())
    drift = AGE * np.sqrt(1.0 / np.diag(base.precision))
    for name, sigma in (("offset", OFFSET), ("play", PLAY_SIGMA)):
        drift[layout.at(name)] = AGE * sigma
    drift[layout.at("tilt")] = AGE * LEVEL
    body, mean = slice(0, layout.body), base.mean.copy()
    mean[body] = vector_of(DisplacementLayout(joints=arm.joints), prior.displacement)
    lower, upper, links = base.lower.copy(), base.upper.copy(), layout.at("twist")
    if prior.displacement.twist.any():
        lower[links], upper[links] = -np.inf, np.inf
    precision = base.precision.copy()
    precision[body, body] = np.linalg.inv(prior.covariance + np.diag(drift[body] ** 2))
    return Belief(mean=mean, precision=precision, lower=lower, upper=upper)


def _solved(
    arm: Arm, measurements: Measurements, layout: DisplacementLayout, frame: Array, one: Belief
) -> tuple[CalibrationProblem, Fitted]:
    problem = CalibrationProblem(arm=arm, layout=layout, belief=one, measurements=measurements, frame=frame)
    tilt = layout.at("tilt").start
    askew = one.precision[tilt, tilt] < LEVEL**-2.0 / 2
    return problem, search(problem) if askew else solve(problem, one.mean)


def _judged(problem: CalibrationProblem, fitted: Fitted, date: str) -> Calibration:
    m, body = problem.measurements, slice(0, problem.layout.body)
    tried = leave_out(problem, fitted)
    return Calibration(
        arm=problem.arm, displacement=displacement_of(problem.layout, fitted.vector),
        covariance=fitted.covariance[body, body], frame=fitted.frame, frame_name=m.frame, source=m.source, date=date,
        points=len(m), before=float(tried.before.mean()), after=float(tried.after.mean()),
        used=tried.helps(problem.arm, m),
        floor=floor_of(problem.arm), suspects=tried.suspects(np.isfinite(m.point)),
        left_out=np.stack([tried.before, tried.after], axis=-1),
    )  # fmt: skip
