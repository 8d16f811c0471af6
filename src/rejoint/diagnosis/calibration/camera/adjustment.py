"""The residuals of the bundle adjustment and their derivatives, in standard deviations.

Unknown are the lens, the pose of what stands and of what the tool carries, the arm's displacement, and the pose of the
board in each view. Corners tie the lens to the poses in the views; the arm's kinematics tie these poses to each other.
The second tie is loose: by how far joints that float in their play, and all that no displacement explains, let the
tool be elsewhere. Without that looseness hundreds of exact corners would bend the lens to explain the play.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rejoint.arms import Arm, Array, Displacement, jacobian
from rejoint.arms.camera.board import BoardView
from rejoint.arms.camera.lens import TERMS, Lens, projected
from rejoint.arms.camera.poses import inverse, moved, rotation_vector, skew, turning
from rejoint.arms.camera.rig import Rig, tool_of
from rejoint.arms.camera.sighting import CORNER
from rejoint.arms.displacement import FLOATING
from rejoint.arms.size import length_size
from rejoint.diagnosis.calibration.model import SCATTER
from rejoint.diagnosis.calibration.parameters import Belief, DisplacementLayout, displacement_of

LENS = {"f": 0.3, "cx": 0.03, "cy": 0.03, "k1": 0.3, "k2": 0.3, "p1": 0.005, "p2": 0.005}
"""Standard deviations of the lens around that of a usual web camera; the first three by the picture's width (chosen)"""
NOWHERE = 10.0
"""[m] and [rad] standard deviation of poses of which nothing is known"""
LOOSE, ASKEW = 0.5e-3, np.radians(0.15)
"""[m] over the reach of a myCobot 280, and [rad]: standard deviation of the tool's place and turn by what no
displacement explains (chosen on emulated worn arms: ripple, stiction, and the simplified law of play)"""
JOINT = np.radians(0.1)
"""[rad] the same of each joint (chosen on emulated worn arms)"""
_STEP = 1e-6  # [m] and [rad] of numerical derivatives


@dataclass(frozen=True, kw_only=True, eq=False)
class Tip:
    """Where the tip of the tool is on the board that it carries, as somebody measured it."""

    place: Array
    """(3,) [m] in the frame of the board"""
    sigma: float = 1e-3
    """[m] (chosen: a ruler)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Adjustment:
    """Views of one arm, and an estimate around which their unknowns are small."""

    arm: Arm
    layout: DisplacementLayout
    belief: Belief
    rig: Rig
    """the estimate"""
    lens: Lens
    """what is believed of the lens before"""
    sights: Array
    """(V, 4, 4) the estimate of the board's pose in the frame of the camera"""
    views: Sequence[BoardView]
    position: Array
    """(V, n) [rad] what the encoders said"""
    approach: Array
    """(V, n) [rad] where they came from last; NaN where nobody knows"""
    whitener: Array
    """(V, 6, 6) what makes the tool's difference from the arm's kinematics a number of unit variance"""
    tip: Tip | None = None

    @property
    def shared(self) -> int:
        """Number of the unknowns that all views share: lens, two poses, arm; six of each view follow."""
        return len(TERMS) + 12 + self.layout.body

    @property
    def size(self) -> int:
        """Number of all unknowns."""
        return self.shared + 6 * len(self.views)

    @property
    def body(self) -> slice:
        """Where the arm's parameters stand."""
        return slice(len(TERMS) + 12, self.shared)

    def start(self, vector: Array) -> Array:
        """Unknowns (p,) of the estimate, with the arm's parameters ``vector`` (k,)."""
        return np.concatenate([self.rig.lens.numbers, np.zeros(12), vector, np.zeros(6 * len(self.views))])

    def rig_of(self, x: Array) -> Rig:
        """Return the rig for unknowns (p,)."""
        n = len(TERMS)
        return Rig(
            lens=self.lens.with_numbers(x[:n]), board=self.rig.board, carried=self.rig.carried,
            standing=moved(self.rig.standing, x[n : n + 6]), mounted=moved(self.rig.mounted, x[n + 6 : n + 12]),
        )  # fmt: skip

    def sights_of(self, x: Array) -> Array:
        """Poses (V, 4, 4) of the board in the views for unknowns (p,)."""
        return moved(self.sights, x[self.shared :].reshape(-1, 6))

    def displacement_of(self, x: Array) -> Displacement:
        """Return the arm's displacement for unknowns (p,)."""
        return displacement_of(self.layout, x[self.body])

    def residual(self, x: Array) -> Array:
        """All residuals (m,): corners, ties to the arm, beliefs."""
        return np.concatenate([self.corners(x).ravel(), self.ties(x).ravel(), self._beliefs(x)])

    def corners(self, x: Array) -> Array:
        """Residuals (C, 2) of the corners of all views, one view after the other."""
        point = self._points(self.sights_of(x))[0]
        return (projected(x[: len(TERMS)], point)[0] - self._pixel) / CORNER

    def ties(self, x: Array) -> Array:
        """Residuals (V, 6) of the tool: seen less as the arm's kinematics say, whitened."""
        off = difference(self._seen(x, self.sights_of(x)), self._reported(x))
        return (self.whitener @ off[..., None])[..., 0]

    def derivative(self, x: Array) -> Array:
        """Return the derivative (m, p) of the residuals."""
        corners = self._corner_derivative(x)
        ties = self._tie_derivative(x).reshape(-1, self.size)
        return np.concatenate([corners, ties, self._belief_derivative(x)])

    @property
    def _pixel(self) -> Array:
        return np.concatenate([view.pixel for view in self.views])

    @property
    def _owner(self) -> Array:
        """(C,) which view each corner belongs to."""
        return np.repeat(np.arange(len(self.views)), [len(view.number) for view in self.views])

    def _points(self, sights: Array) -> tuple[Array, Array]:
        """Corners (C, 3) [m] in the frame of the camera, and from the board's origin to them."""
        flat = np.concatenate([self.rig.board.corners[view.number] for view in self.views])
        owner = self._owner
        lever = np.einsum("cij,cj->ci", sights[owner, :3, :3], flat)
        point = lever + sights[owner, :3, 3]
        point[:, 2] = np.maximum(point[:, 2], 1e-3)  # a board behind the camera is a bad estimate, not a wrong number
        return point, lever

    def _corner_derivative(self, x: Array) -> Array:
        point, lever = self._points(self.sights_of(x))
        owner = self._owner
        _, by_point, by_terms = projected(x[: len(TERMS)], point)
        turn = turning(x[self.shared :].reshape(-1, 6)[:, 3:])[owner]
        by_pose = np.concatenate([by_point, -by_point @ skew(lever) @ turn], axis=-1)
        whole = np.zeros((len(owner), 2, self.size))
        whole[..., : len(TERMS)] = by_terms
        place = self.shared + 6 * owner[:, None, None] + np.arange(6)
        np.put_along_axis(whole, np.broadcast_to(place, by_pose.shape), by_pose, axis=2)
        return whole.reshape(-1, self.size) / CORNER

    def shared_ties(self, x: Array) -> Array:
        """Return the derivative (V, 6, shared) of `ties` by the unknowns that all views share."""
        n, sights = len(TERMS), self.sights_of(x)
        seen, told = self._seen(x, sights), self._reported(x)
        base = difference(seen, told)
        raw = np.zeros((len(self.views), 6, self.shared))
        for i in range(n, n + 12):
            raw[..., i] = (difference(self._seen(_stepped(x, i), sights), told) - base) / _STEP
        for i in range(self.body.start, self.body.stop):
            other = self._reported(_stepped(x, i))
            raw[..., i] = (difference(seen, other) - base) / _STEP
        return np.asarray(self.whitener @ raw)

    def _tie_derivative(self, x: Array) -> Array:
        sights, told, every = self.sights_of(x), self._reported(x), np.arange(len(self.views))
        base = difference(self._seen(x, sights), told)
        whole = np.zeros((len(self.views), 6, self.size))
        whole[..., : self.shared] = self.shared_ties(x)
        small = x[self.shared :].reshape(-1, 6)
        for i in range(6):
            step = _STEP * np.eye(6)[i]
            own = (difference(self._seen(x, moved(self.sights, small + step)), told) - base) / _STEP
            whole[every, :, self.shared + 6 * every + i] = (self.whitener @ own[..., None])[..., 0]
        return whole

    def _reported(self, x: Array) -> Array:
        """Poses (V, 4, 4) of the tool by the arm's kinematics."""
        return self.displacement_of(x).tool_pose(self.arm, self.position, self.approach)

    def _seen(self, x: Array, sights: Array) -> Array:
        n = len(TERMS)
        standing, mounted = moved(self.rig.standing, x[n : n + 6]), moved(self.rig.mounted, x[n + 6 : n + 12])
        return tool_of(self.rig.carried, standing, mounted, sights)

    def _beliefs(self, x: Array) -> Array:
        n = len(TERMS)
        scale = np.array([LENS[name] for name in TERMS]) * ([self.lens.width] * 3 + [1.0] * 4)
        parts = [
            (x[:n] - self.lens.numbers) / scale,
            x[n : n + 12] / NOWHERE,
            self._root @ (x[self.body] - self.belief.mean),
        ]
        if self.tip is not None:
            parts.append(self._tip_off(x))
        return np.concatenate(parts)

    def _belief_derivative(self, x: Array) -> Array:
        base = self._beliefs(x)
        whole = np.zeros((len(base), self.size))
        for i in range(self.body.start):
            whole[:, i] = (self._beliefs(_stepped(x, i)) - base) / _STEP
        whole[self.body.start : self.body.stop, self.body] = self._root
        return whole

    def _tip_off(self, x: Array) -> Array:
        """Where the tip is on the board, less what was measured, (3,) in standard deviations."""
        assert self.tip is not None  # noqa: S101 - only then is it called
        n = len(TERMS)
        return (inverse(moved(self.rig.mounted, x[n + 6 : n + 12]))[:3, 3] - self.tip.place) / self.tip.sigma

    @property
    def _root(self) -> Array:
        """(k, k) square root of the precision of what is believed of the arm."""
        body = slice(0, self.layout.body)
        return np.asarray(np.linalg.cholesky(self.belief.precision[body, body]).T)


def difference(seen: Array, told: Array) -> Array:
    """Shift [m] and turn [rad] (..., 6), base axes, from poses ``told`` to ``seen`` (..., 4, 4)."""
    turn = rotation_vector(seen[..., :3, :3] @ np.swapaxes(told[..., :3, :3], -1, -2))
    return np.concatenate([seen[..., :3, 3] - told[..., :3, 3], turn], axis=-1)


def looseness(arm: Arm, displacement: Displacement, position: Array) -> Array:
    """Covariance (V, 6, 6) of the tool's pose around what ``displacement`` says, at ``position`` (V, n) [rad]."""
    free = 1.0 - np.tanh(displacement.torque(arm, position) / FLOATING) ** 2
    variance = SCATTER * (0.5 * displacement.play) ** 2 * free + JOINT**2
    lever = jacobian(arm, position)
    rest = np.diag([(LOOSE * length_size(arm)) ** 2] * 3 + [ASKEW**2] * 3)
    return np.asarray((lever * variance[:, None, :]) @ np.swapaxes(lever, -1, -2) + rest)


def _stepped(x: Array, place: int) -> Array:
    other = x.copy()
    other[place] += _STEP
    return other
