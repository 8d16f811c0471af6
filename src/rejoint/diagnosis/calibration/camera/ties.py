"""The arm and the camera setup from the board's poses, once the lens is known.

Unknown are the poses of camera and board, the displacement, and small changes of the lens. Floating joints and
unexplained displacement add noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from rejoint.arms import Arm, Array, Displacement, jacobian
from rejoint.arms.camera.board import BoardView
from rejoint.arms.camera.lens import CORNER, TERMS, place
from rejoint.arms.camera.rig import Rig
from rejoint.arms.camera.views import Detector, Unusable
from rejoint.arms.rotations import difference, inverse, moved
from rejoint.control.seeing import Sighting
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.parameters import Belief, floor_of, play_variance
from rejoint.diagnosis.calibration.solver import Fittable

HUBER = 3.55
"""Residual [sigma] from which the loss is linear: 95 % of six normal numbers"""
POSES = 12
"""Unknowns after the arm's, shift [m] and turn [rad] of `Rig.standing` and `Rig.mounted`; the lens follows"""
NOWHERE = 10.0
"""[m] and [rad] sigma of unknown poses"""
ASKEW = np.radians(0.15)
"""[rad] unexplained turn; chosen"""
JOINT = np.radians(0.1)
"""[rad] the same of each joint; chosen"""
_ANY = np.array([1e3] * 3 + [1.0] * 4)  # standard deviations of a lens of which nothing is known
_STEP = 1e-6  # [m] and [rad] of numerical derivatives


@dataclass(frozen=True, kw_only=True, eq=False)
class TieProblem(Fittable):
    """Poses of the board in views, and beliefs."""

    rig: Rig
    sights: Array
    """(V, 4, 4) of the board in the camera frame"""
    by_lens: Array
    """(V, 6, 7) derivative of shift [m] and turn [rad] by the lens's `TERMS`"""
    spread: Array
    """(V, 6, 6) covariance of the tool's pose by corners, base axes"""
    position: Array
    """(V, n) [rad]"""
    approach: Array
    """(V, n) [rad]; NaN where unknown"""
    posture: NDArray[np.int64]
    """(V,)"""
    huber: float = HUBER

    @property
    def lens_precision(self) -> Array:
        """(7, 7) from the boards, see `lens_ties`."""
        return self.belief.precision[-len(TERMS) :, -len(TERMS) :]

    @property
    def postures(self) -> NDArray[np.int64]:
        """(V,)."""
        return self.posture

    @property
    def known(self) -> NDArray[np.bool_]:
        """(V, 6), all true."""
        return np.ones((len(self.posture), 6), dtype=bool)

    def rows(self, where: NDArray[np.bool_]) -> TieProblem:
        """Problem of some views."""
        names = ("sights", "by_lens", "spread", "position", "approach", "posture")
        return replace(self, **{name: getattr(self, name)[where] for name in names})

    def rig_of(self, vector: Array) -> Rig:
        """Rig for the unknowns (k,)."""
        small, lens = vector[self.layout.body : self.layout.body + POSES], self.rig.lens
        return replace(
            self.rig,
            standing=moved(self.rig.standing, small[:6]),
            mounted=moved(self.rig.mounted, small[6:]),
            lens=lens.with_numbers(lens.numbers + vector[self.layout.body + POSES :]),
        )

    def pose(self, vector: Array) -> Array:
        """Pose (4, 4) in the base of the measuring frame."""
        return self.rig_of(vector).standing

    def misfit(self, vector: Array) -> Array:
        """Residual (V, 6) without derivative."""
        return difference(self.tool(vector), self.reported(vector))

    def residual(self, vector: Array) -> tuple[Array, Array]:
        """Shift [m] and turn [rad] (V, 6) of the tool, seen less predicted; derivative (V, 6, k)."""
        seen, told = self.tool(vector), self.reported(vector)
        base, body = difference(seen, told), self.layout.body
        slope = np.zeros((*base.shape, len(vector)))
        free = self.belief.upper > self.belief.lower
        for i in np.flatnonzero(free).tolist():
            other = vector.copy()
            other[i] += _STEP
            ends = (seen, self.reported(other)) if i < body else (self.tool(other), told)
            slope[..., i] = (difference(*ends) - base) / _STEP
        return base, slope

    def noise(self, vector: Array) -> Array:
        """Covariance (V, 6, 6) of a residual."""
        return looseness(self.arm, self.displacement(vector), self.position) + self.spread

    def measurements(self, vector: Array) -> Measurements:
        """Tool in the measuring frame."""
        rig = self.rig_of(vector)
        point = (inverse(rig.standing) @ self.tool(vector))[:, :3, 3]
        sigma = np.sqrt(np.trace(self.spread[:, :3, :3], axis1=1, axis2=2) / 3.0)
        return Measurements(
            position=self.position,
            approach=self.approach,
            point=point,
            sigma=sigma,
            posture=self.posture,
            frame="camera" if rig.carried == "board" else "board",
            source="camera",
        )

    def tool(self, vector: Array, sights: Array | None = None) -> Array:
        """Tool (V, 4, 4) in the base by the camera."""
        moves = self.by_lens @ vector[self.layout.body + POSES :]
        return self.rig_of(vector).tool(moved(self.sights if sights is None else sights, moves))

    def reported(self, vector: Array) -> Array:
        """Tool (V, 4, 4) in the base by corrected kinematics."""
        return self.displacement(vector).tool_pose(self.arm, self.position)


def looseness(arm: Arm, displacement: Displacement, position: Array) -> Array:
    """Covariance (V, 6, 6) of the tool's pose beyond ``displacement``, at ``position`` (V, n) [rad]."""
    variance = play_variance(displacement, displacement.torque(arm, position)) + JOINT**2
    lever = jacobian(arm, position)
    rest = np.diag([floor_of(arm) ** 2] * 3 + [ASKEW**2] * 3)
    return np.asarray((lever * variance[:, None, :]) @ np.swapaxes(lever, -1, -2) + rest)


def with_poses(own: Belief, lens: Array) -> Belief:
    """Append unknown `POSES` and the ``lens`` (7, 7) to a belief."""
    anywhere = np.full(POSES + len(lens), np.inf)
    return Belief(
        mean=np.concatenate([own.mean, np.zeros_like(anywhere)]),
        precision=block_diag(own.precision, NOWHERE**-2.0 * np.eye(POSES), lens),
        lower=np.concatenate([own.lower, -anywhere]),
        upper=np.concatenate([own.upper, anywhere]),
    )


def lens_ties(rig: Rig, views: Sequence[BoardView], sights: Array) -> tuple[Array, Array]:
    """Boards' derivative (V, 6, 7) by the lens, and its precision (7, 7)."""
    ties, told = [], np.diag(_ANY**-2.0)
    for view, pose in zip(views, sights, strict=True):
        _, by_pose, by_terms = rig.lens.slopes(rig.board.corners[view.number] @ pose[:3, :3].T, pose[:3, 3])
        by_pose, by_terms = by_pose.reshape(-1, 6), by_terms.reshape(-1, len(TERMS))
        ties.append(-np.linalg.lstsq(by_pose, by_terms, rcond=None)[0])
        left = (by_terms + by_pose @ ties[-1]) / CORNER
        told = told + left.T @ left
    return np.array(ties), told


def tool_spread(rig: Rig, sights: Array, covariance: Array) -> Array:
    """Covariance (V, 6, 6) of the tool's pose, base axes, from the board's."""
    base = rig.tool(sights)
    rows = [difference(rig.tool(moved(sights, _STEP * row)), base) / _STEP for row in np.eye(6)]
    slope = np.stack(rows, axis=-1)
    return np.asarray(slope @ covariance @ np.swapaxes(slope, -1, -2))


def point_sigma(rig: Rig, sights: Array, covariance: Array) -> Array:
    """Sigma (V,) [m] of the tool's coordinates from board ``covariance`` (V, 6, 6)."""
    return np.asarray(np.sqrt(np.trace(tool_spread(rig, sights, covariance)[:, :3, :3], axis1=1, axis2=2) / 3.0))


CROOKED = 1.0
"""[px] corner residual of an untrusted picture; chosen"""


class ToolTracker:
    """Locates the tool in pictures, without encoders."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.why = ""
        """why the last picture was unusable, or empty"""
        self._detector = Detector(rig.board)

    def see(self, picture: NDArray[np.uint8], time: float = 0.0) -> Sighting | None:
        """Locate the tool in a grey or BGR picture; None without a good view."""
        found = self._detector.find("picture", picture)
        self.why = found.why if isinstance(found, Unusable) else ""
        return None if isinstance(found, Unusable) else self.sighting(found, time)

    def sighting(self, view: BoardView, time: float = 0.0) -> Sighting | None:
        """Return the same for a ``view`` with known corners."""
        placed = place(self.rig.lens, self.rig.board.corners[view.number], view.pixel)
        if placed.rms > CROOKED:
            self.why = f"its corners lie {placed.rms:.1f} px beside those of a flat board"
            return None
        sights, spread = placed.pose[None], placed.covariance[None]
        sigma = float(point_sigma(self.rig, sights, spread)[0])
        return Sighting(place=self.rig.tool(sights)[0, :3, 3], sigma=sigma, time=time)
