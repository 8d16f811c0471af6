"""From a film to a calibration and the rig that goes with it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.arms.camera.lens import TERMS
from rejoint.arms.camera.rig import Rig
from rejoint.arms.camera.sighting import place
from rejoint.arms.camera.views import Unusable
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.camera.adjustment import Tip
from rejoint.diagnosis.calibration.camera.bundle import FEWEST, Bundle, Residual, bundle
from rejoint.diagnosis.calibration.camera.film import Film, positions
from rejoint.diagnosis.calibration.camera.flatness import require_flat
from rejoint.diagnosis.calibration.camera.refit import TieProblem, leave_views_out, tool_spread, with_poses
from rejoint.diagnosis.calibration.fit import beliefs_of, earlier
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.model import floor_of
from rejoint.diagnosis.calibration.parameters import LEVEL, Belief, DisplacementLayout
from rejoint.diagnosis.calibration.solver import Fitted, search, solve
from rejoint.system.errors import InputError

_CAUSES = 3  # that a line about unusable pictures names


@dataclass(frozen=True, kw_only=True, eq=False)
class Filmed:
    """What a film told."""

    calibration: Calibration
    measurements: Measurements
    """where the tool was seen in each view that was used"""
    rig: Rig
    rig_sigma: Array
    """(19,) standard deviations of the lens's `TERMS`, and of shift [m] and turn [rad] of `Rig.standing` and
    `Rig.mounted`"""
    residuals: tuple[Residual, ...]
    """how well each view that was used fits"""
    left_out: tuple[Unusable, ...]
    """pictures that were not used, and why"""

    @property
    def rms(self) -> float:
        """[px] over all corners, per coordinate."""
        return float(np.sqrt(np.mean([one.rms**2 for one in self.residuals])))


def fit_film(
    arm: Arm, film: Film, *, prior: Calibration | None = None, tip: Tip | None = None, date: str = ""
) -> Filmed:  # fmt: skip
    """Fit lens, camera, board and displacement to a film of ``arm``, and try the displacement on views left out.

    ``prior`` is an earlier calibration of the same arm, ``tip`` where the tool's tip is on the board that it carries.
    InputError where the film does not suffice, or the board is bent.
    """
    shots = film.usable
    if film.size is None or len(shots) < FEWEST:
        raise InputError(f"camera: {_too_few(film)}")
    position, approach = positions(shots, arm)
    layout = DisplacementLayout(joints=arm.joints)
    found = bundle(
        arm, film.board, film.views, position, approach=approach, size=film.size, carried=film.carried, tip=tip,
        prior=None if prior is None else earlier(arm, layout, prior),
    )  # fmt: skip
    require_flat(found)
    number = {shot.name: shot.posture for shot in shots}
    posture = np.array([number[view.name] for view in found.views], dtype=np.int64)
    solved = [
        _solved(found, posture, own, tip, odds) for own, odds in beliefs_of(arm, layout, prior, len(np.unique(posture)))
    ]
    problem, fitted, _ = max(solved, key=lambda one: one[1].evidence + one[2])
    return _judged(film, found, problem, fitted, date)


def _too_few(film: Film) -> str:
    usable, total = len(film.usable), len(film)
    causes = Counter(_cause(one.why) for one in film.unusable).most_common(_CAUSES)
    why = "; ".join(f"{count} times: {cause}" for cause, count in causes)
    return f"the board is seen well in {usable} of {total} pictures, expected at least {FEWEST}" + (why and f" ({why})")


def _cause(why: str) -> str:
    """Shorten why a picture is of no use to what several have in common."""
    return "too few corners of the board are seen" if "corners of the board are seen" in why else why.partition(":")[0]


def _solved(
    found: Bundle, posture: NDArray[np.int64], own: Belief, tip: Tip | None, odds: float
) -> tuple[TieProblem, Fitted, float]:  # fmt: skip
    arm, rig = found.arm, found.rig
    corners = np.array([
        place(rig.lens, rig.board.corners[view.number], view.pixel, pose).covariance
        for view, pose in zip(found.views, found.sights, strict=True)
    ])  # fmt: skip
    problem = TieProblem(
        arm=arm, layout=DisplacementLayout(joints=arm.joints), belief=with_poses(own, rig, tip), rig=rig,
        sights=found.sights, spread=tool_spread(rig, found.sights, corners), position=found.position,
        approach=found.approach, posture=posture, tip=tip,
    )  # fmt: skip
    tilt = problem.layout.at("tilt").start
    askew = own.precision[tilt, tilt] < LEVEL**-2.0 / 2
    return problem, search(problem) if askew else solve(problem, problem.belief.mean), odds


def _judged(film: Film, found: Bundle, problem: TieProblem, fitted: Fitted, date: str) -> Filmed:
    tried, body = leave_views_out(problem, fitted), slice(0, problem.layout.body)
    measured = problem.measurements(fitted.vector)
    calibration = Calibration(
        arm=problem.arm, displacement=problem.displacement(fitted.vector), covariance=fitted.covariance[body, body],
        frame=fitted.frame, frame_name=measured.frame, source=measured.source, date=date, points=len(measured),
        before=float(tried.before.mean()), after=float(tried.after.mean()), used=tried.helps(problem.arm, measured),
        floor=floor_of(problem.arm), suspects=tried.suspects(problem.known[:, :3]),
        left_out=np.stack([tried.before, tried.after], axis=-1),
    )  # fmt: skip
    lens = np.diag(found.rig_covariance)[: len(TERMS)]
    return Filmed(
        calibration=calibration, measurements=measured, rig=problem.rig_of(fitted.vector),
        rig_sigma=np.sqrt(np.concatenate([lens, np.diag(fitted.covariance)[body.stop :]])),
        residuals=found.residuals, left_out=(*film.unusable, *found.left_out),
    )  # fmt: skip
