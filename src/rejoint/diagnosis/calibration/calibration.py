"""A calibration: where the tool of one arm is behind its encoders, how sure that is, and where to aim because of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rejoint.arms import Arm, Array, Displacement, solve_position, tcp_position
from rejoint.arms.loaded import bare
from rejoint.control.contract import law_digests
from rejoint.diagnosis.calibration.model import linearised, link_loads, scatter, torque_slopes
from rejoint.diagnosis.calibration.parameters import DisplacementLayout, vector_of
from rejoint.system.errors import ContractError
from rejoint.system.statistics import CONFIDENCE

GEOMETRY = ("offset", "axis", "tip", "mass", "com")
"""Fields of an arm that a calibration was computed with"""
AIMING = 4
"""Fixed-point steps of `Calibration.aim` (chosen: each divides what is left by about twenty)"""
_NEAR = 7.81  # squared distance by its covariance that 95 % of draws of three coordinates keep (chi-squared)
_DRAWS = 256  # of the tool for an interval (chosen: ends repeat within a tenth of the width; the same draws each time)


@dataclass(frozen=True, kw_only=True, eq=False)
class Calibration:
    """What was found out about one arm from outside, in the base frame of that arm.

    Examples
    --------
    >>> found = calibrate(arm, measurements)
    >>> command = found.aim(target, arm.rest)
    """

    arm: Arm
    displacement: Displacement
    covariance: Array
    """(k, k) of the parameters of the displacement, see `parameters.DisplacementLayout`"""
    frame: Array
    """(4, 4) pose of the measuring frame in the base"""
    frame_name: str
    """``base``, or the name of the frame whose pose was fitted along"""
    source: str
    """what measured: ``touch``, ``camera``, ``tracker``, or ``emulated``: an emulator told"""
    date: str
    """when, as the caller says it"""
    points: int
    """number of measurements that the fit has seen"""
    before: float
    """[m] mean true error of what the encoders say, over measured points"""
    after: float
    """[m] the same of this calibration, over the same points, each predicted from the others"""
    used: bool
    """whether the correction clearly helped at points that were left out; if not, nothing is to be corrected"""
    floor: float
    """[m] standard deviation of what this model does not explain, on each coordinate"""
    suspects: tuple[int, ...] = ()
    """rows of the measurements, from 0, that do not fit to the others"""
    left_out: Array = field(default_factory=lambda: np.zeros((0, 2)))
    """(M, 2) [m] errors ``before`` and ``after`` of each measured point; (0, 2) in files of earlier versions"""

    def __post_init__(self) -> None:
        for name in ("covariance", "frame", "left_out"):
            value = np.array(getattr(self, name), dtype=float)
            value.setflags(write=False)
            object.__setattr__(self, name, value)

    @property
    def missed(self) -> Array:
        """(M,) [m] by how much this calibration misses each measured point that it has not seen."""
        return self.left_out[:, 1] if len(self.left_out) else np.array([self.after])

    @property
    def layout(self) -> DisplacementLayout:
        """Places of the parameters in the covariance."""
        return DisplacementLayout(joints=self.arm.joints)

    def require(self, arm: Arm) -> None:
        """Refuse with a ContractError if this calibration is of another arm."""
        check_arm(self.arm.name, geometry_of(self.arm), arm)

    def tool(self, position: Array, approach: Array | None = None) -> Array:
        """Where the tool (..., 3) [m] is by this calibration while the encoders say ``position`` (..., n) [rad].

        ``approach`` (..., n) [rad] is where they were before the last motion, as far as that is known.
        """
        return self.displacement.tool(self.arm, position, approach)

    def shift(self, position: Array, approach: Array | None = None) -> Array:
        """Return how far (..., 3) [m] the tool is from where the encoders at ``position`` (..., n) [rad] say it is."""
        return self.tool(position, approach) - tcp_position(self.arm, position)

    def spread(self, position: Array) -> Array:
        """Covariance (..., 3, 3) [m^2] of the tool around `tool`: parameters, floating joints, and what remains.

        On which flank of its play a joint lies is no slope: where its torque may have either sign, each is counted.
        """
        flat = np.reshape(position, (-1, self.arm.joints))
        vector = vector_of(self.layout, self.displacement)
        _, slope = linearised(self.arm, self.layout, vector, flat, flanks=False)
        known = slope @ self.covariance @ np.swapaxes(slope, -1, -2)
        torque = torque_slopes(self.layout, vector, link_loads(self.arm, flat))
        doubt = np.sqrt(np.einsum("mnk,kl,mnl->mn", torque, self.covariance, torque))
        total = known + scatter(self.arm, self.displacement, flat, doubt) + self.floor**2 * np.eye(3)
        return np.asarray(total.reshape(*np.shape(position)[:-1], 3, 3))

    def interval(
        self, position: Array, target: Array | None = None, approach: Array | None = None
    ) -> tuple[Array, Array]:
        """95 % interval (...), (...) [m] of the distance of the tool from ``target`` (..., 3) [m] at ``position``.

        Without a target: from where the encoders say that the tool is. It begins at zero where the tool may be there.
        """
        place = tcp_position(self.arm, position) if target is None else target
        ends = [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2]
        low, high = np.quantile(self._distances(position, place, approach), ends, axis=-1)
        middle = (self.tool(position, approach) - place)[..., None]
        there = (np.linalg.solve(np.linalg.cholesky(self.spread(position)), middle) ** 2).sum(axis=(-2, -1)) < _NEAR
        return np.where(there, 0.0, low), high

    def expected(self, position: Array, target: Array | None = None) -> Array:
        """Mean (...) [m] of the distance whose interval `interval` tells."""
        return np.asarray(self._distances(position, target, None).mean(axis=-1))

    def _distances(self, position: Array, target: Array | None, approach: Array | None) -> Array:
        """Draws (..., d) [m] of that distance."""
        target = tcp_position(self.arm, position) if target is None else target
        root = np.linalg.cholesky(self.spread(position))
        draws = np.random.default_rng(0).standard_normal((_DRAWS, 3))
        away = (self.tool(position, approach) - target)[..., None, :] + draws @ np.swapaxes(root, -1, -2)
        return np.linalg.norm(away, axis=-1)

    def sigma(self, position: Array) -> Array:
        """Root mean square (...) [m] of the distance of the tool from where this calibration says it is."""
        return np.sqrt(np.trace(self.spread(position), axis1=-2, axis2=-1))

    def aim(self, target: Array, start: Array) -> Array:
        """Where the encoders are to say that the tool is (..., 3) [m], for it to be at ``target`` (..., 3) [m].

        ``start`` (..., n) [rad] is the posture that the arm comes from: that of the target is looked for from there,
        and joints that float lie as they do after this motion. A target comes back as it is where the correction is
        not used.
        """
        target = np.asarray(target, dtype=float)
        if not self.used:
            return target.copy()
        start = np.asarray(start, dtype=float)
        command, posture = target, start
        for _ in range(AIMING):
            posture = solve_position(self.arm, command, posture).q
            command = target - self.shift(posture, start)
        return command

    def aim_again(self, target: Array, position: Array, approach: Array | None = None) -> Array:
        """Return the same as `aim`, now that the arm has settled near ``target`` at ``position`` (..., n) [rad]."""
        return target - self.shift(position, approach) if self.used else np.array(target, dtype=float)


def geometry_of(arm: Arm) -> dict[str, str]:
    """Digest what of an arm a calibration was computed with, field by field: of its hand as described, not as told."""
    digests = law_digests(bare(arm))
    return {name: digests[name] for name in GEOMETRY}


def check_arm(name: str, digests: dict[str, str], arm: Arm) -> None:
    """Refuse with a ContractError if a calibration of arm ``name`` with these digests is not of ``arm``."""
    own = geometry_of(arm)
    other = [field for field in GEOMETRY if digests.get(field) != own[field]]
    if name == arm.name and not other:
        return
    differs = f"; they differ in {', '.join(other)}" if name == arm.name else ""
    raise ContractError(f"calibration of arm {name!r}, expected one of {arm.name!r}{differs}; calibrate this arm")
