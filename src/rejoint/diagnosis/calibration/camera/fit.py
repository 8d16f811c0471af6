"""From an image sequence to a calibration and its camera setup."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.camera.lens import TERMS
from rejoint.arms.camera.rig import Rig
from rejoint.arms.camera.views import Unusable
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.camera.bundle import FEWEST, Residual, bundle, require_flat
from rejoint.diagnosis.calibration.camera.film import Film, positions
from rejoint.diagnosis.calibration.camera.ties import with_poses
from rejoint.diagnosis.calibration.fit import beliefs_of, earlier, judged, likeliest
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.parameters import DisplacementLayout
from rejoint.system.errors import InputError

_CAUSES = 3  # that a line about unusable pictures names


@dataclass(frozen=True, kw_only=True, eq=False)
class Filmed:
    """Result of a fit to an image sequence."""

    calibration: Calibration
    measurements: Measurements
    """the tool in each view used"""
    rig: Rig
    rig_sigma: Array
    """(19,) sigma of the lens's `TERMS`, shift [m] and turn [rad] of camera and board"""
    residuals: tuple[Residual, ...]
    left_out: tuple[Unusable, ...]

    @property
    def rms(self) -> float:
        """[px] over all corners, per coordinate."""
        return float(np.sqrt(np.mean([one.rms**2 for one in self.residuals])))


def fit_film(arm: Arm, film: Film, *, prior: Calibration | None = None, date: str = "") -> Filmed:
    """Fit lens, camera, board and displacement, tested on views left out.

    ``prior``: an earlier calibration. InputError for too few views or a bent board.
    """
    shots = film.usable
    if film.size is None or len(shots) < FEWEST:
        raise InputError(f"camera: {_too_few(film)}")
    position, approach = positions(shots, arm)
    layout = DisplacementLayout(joints=arm.joints)
    found = bundle(
        arm,
        film.board,
        film.views,
        position,
        approach=approach,
        size=film.size,
        carried=film.carried,
        prior=None if prior is None else earlier(arm, layout, prior),
    )
    require_flat(found)
    number = {shot.name: shot.posture for shot in shots}
    posture = np.array([number[view.name] for view in found.views], dtype=np.int64)
    problem, tight = replace(found.problem, posture=posture), found.problem.lens_precision
    problem, fitted = likeliest(
        problem,
        [(with_poses(own, tight), odds) for own, odds in beliefs_of(arm, layout, prior, len(np.unique(posture)))],
    )
    measured = problem.measurements(fitted.vector)
    return Filmed(
        calibration=judged(problem, fitted, measured, date),
        measurements=measured,
        rig=problem.rig_of(fitted.vector),
        rig_sigma=np.roll(np.sqrt(np.diag(fitted.covariance)[problem.layout.body :]), len(TERMS)),
        residuals=found.residuals,
        left_out=(*film.unusable, *found.left_out),
    )


def _too_few(film: Film) -> str:
    why = "; ".join(f"{one.name}: {one.why}" for one in film.unusable[:_CAUSES])
    usable = f"the board is seen well in {len(film.usable)} of {len(film)} pictures, expected at least {FEWEST}"
    return usable + (why and f" ({why})")
