"""The fitted twin: values, intervals, what is not known, how well it predicts."""

from __future__ import annotations

import hashlib
from dataclasses import astuple, dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.system.errors import ContractError, InputError
from rejoint.system.statistics import NORMAL95
from rejoint.twin.judgement import Judgement
from rejoint.twin.parameters import (
    JOINT_PARAMETERS,
    PARAMETERS,
    STICTION,
    Layout,
    TwinParameters,
    pack,
    unpack,
    vector_names,
)
from rejoint.twin.prediction import PredictionError
from rejoint.twin.table import TablePlane

LEAST_SPREAD = 0.05
"""Extra spread of the logarithms when twins are drawn: no twin has the structure of the real arm (chosen)"""

SCALE_KNOWN = 2.0
"""A joint's common scale is known when the data say as much about it as the prior: twice the prior alone (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOut:
    """Errors on motion that the fit has not seen."""

    seconds: float
    """[s] length of that motion"""
    no_twin: PredictionError
    """the command taken as the prediction"""
    healthy_twin: PredictionError
    """an arm of this build that shows no wear"""
    twin: PredictionError
    """the fitted twin"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Twin:
    """Parameters of one arm with their covariance, over a parameter vector of length k.

    Examples
    --------
    >>> twin = rejoint.Twin.load("runs/mine/twin.toml")
    >>> print(twin.parameters.stiffness)
    >>> low, high = twin.interval
    """

    arm: str
    joint_names: tuple[str, ...]
    parameters: TwinParameters
    covariance: Array
    """(k, k) of the vector that `pack` makes: logarithms of the positive quantities"""
    lower: Array
    """(k,) physical bounds of the vector"""
    upper: Array
    narrowing: Array
    """(k,) standard deviation by the data over that of the prior"""
    identified: NDArray[np.bool_]
    """(k,) whether the data say more than the prior did"""
    held_out: HeldOut
    fit_seconds: float
    """[s] length of the motion that the fit has seen"""
    notes: tuple[str, ...] = field(default=())
    """what a user of the twin should know, in words"""
    stiction: float = STICTION
    """friction at rest over friction in motion"""
    acceleration: float = np.inf
    """[rad/s^2] of the servos' references while commands keep changing (`rejoint.twin.profile`); inf: not limited"""
    table: TablePlane | None = None
    """what the arm leaned on in the logs, if anything; no part of the arm"""
    judgement: Judgement | None = None
    """how it predicts each motion that was kept from the fit, right after a fit to logs of any motion; not on file"""
    fitted: tuple[str, ...] = ()
    """labels of the motions that such a fit has seen; not on file"""

    @classmethod
    def load(cls, path: Path | str) -> Twin:
        """Read a twin file (TOML); FileError if it is missing or damaged."""
        from rejoint.twin.file import read_twin

        return read_twin(Path(path))

    def save(self, path: Path | str) -> None:
        """Write a twin file (TOML), whole or not at all; FileError if that fails."""
        from rejoint.twin.file import write_twin

        write_twin(Path(path), self)

    def __post_init__(self) -> None:
        k = len(self.names)
        if self.parameters.shape or self.parameters.joints != len(self.joint_names):
            expected = (len(self.joint_names),)
            raise InputError(f"twin: parameters of shape {self.parameters.stiffness_shape}, expected {expected}")
        shapes = {"covariance": (k, k), "lower": (k,), "upper": (k,), "narrowing": (k,), "identified": (k,)}
        for name, shape in shapes.items():
            array = np.array(getattr(self, name))
            if array.shape != shape or not np.isfinite(array).all():
                raise InputError(f"twin: {name} must be finite and of shape {shape}, got {array.shape}")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if not np.isfinite(pack(self.parameters)).all():
            raise InputError("twin: parameters must be finite, and positive where a quantity is")
        if (self.narrowing <= 0).any():
            raise InputError("twin: every narrowing must be positive")
        if not np.allclose(self.covariance, self.covariance.T, rtol=1e-6, atol=1e-12):
            raise InputError("twin: the covariance must be symmetric")
        if not (np.diag(self.covariance) > 0).all():
            raise InputError("twin: every variance must be positive")
        values = np.linalg.eigvalsh(self.covariance)
        if values.min() < -1e-6 * max(values.max(), 1e-12):
            raise InputError(f"twin: the covariance must not have negative eigenvalues, found {values.min():.3g}")
        if not 1.0 <= self.stiction < np.inf:
            raise InputError(f"twin: friction at rest over that in motion must be at least 1, got {self.stiction}")
        if not self.acceleration > 0.0:
            raise InputError(f"twin: the acceleration of its references must be above 0, got {self.acceleration}")
        if (self.lower >= self.upper).any():
            raise InputError("twin: every lower bound must be below the upper one")

    @property
    def names(self) -> tuple[str, ...]:
        """Names (k,) of the parameter vector's elements."""
        return vector_names(self.joint_names)

    @property
    def interval(self) -> tuple[TwinParameters, TwinParameters]:
        """Lower and upper ends of the 95 % intervals, within the bounds."""
        mean, sigma = pack(self.parameters), np.sqrt(np.diag(self.covariance))
        n = len(self.joint_names)
        low, high = np.maximum(mean - NORMAL95 * sigma, self.lower), np.minimum(mean + NORMAL95 * sigma, self.upper)
        return unpack(low, n), unpack(high, n)

    @property
    def unknown_scale(self) -> tuple[str, ...]:
        """Joints whose torques and inertia are known up to a common factor only, which the prior decides.

        Only gravity and link inertia fix that factor, and a joint near the flange feels little of either.
        """
        layout, sigma = Layout(len(self.joint_names)), np.sqrt(np.diag(self.covariance)) / self.narrowing
        unknown = []
        for joint, name in enumerate(self.joint_names):
            scaled = np.flatnonzero((layout.owner == joint) & layout.is_log)
            information = np.linalg.pinv(self.covariance[np.ix_(scaled, scaled)]).sum()
            if information < SCALE_KNOWN * (sigma[scaled] ** -2).sum():
                unknown.append(name)
        return tuple(unknown)

    @property
    def correlations(self) -> tuple[tuple[str, str, float], ...]:
        """Pairs of parameters that the data can hardly tell apart, strongest first.

        Without those of one joint that only share its common scale (`unknown_scale`).
        """
        pairs = [(self.names[i], self.names[j], value) for i, j, value in _strong_correlations(self.covariance)]
        return tuple(pair for pair in pairs if not _share_a_scale(*pair))

    @property
    def unknown(self) -> tuple[str, ...]:
        """Names of the parameters that keep their prior range."""
        return tuple(name for name, known in zip(self.names, self.identified, strict=True) if not known)

    def sample(self, rng: np.random.Generator, count: int, least_spread: float = LEAST_SPREAD) -> TwinParameters:
        """Draw ``count`` twins from the correlated covariance, within the physical bounds.

        Logarithms are spread by ``least_spread`` on top. A delay below zero is that of a recorder
        that reads after it stamps; no arm answers before it is told, so drawn ones are not below zero.
        """
        root = _root(self, least_spread)
        drawn = pack(self.parameters) + rng.standard_normal((count, len(self.names))) @ root.T
        lower = np.where(np.array(self.names) == "delay", np.maximum(self.lower, 0.0), self.lower)
        return unpack(np.clip(drawn, lower, self.upper), len(self.joint_names))

    def require(self, arm: Arm) -> None:
        """Refuse with a ContractError if this twin is of another arm."""
        if self.arm != arm.name or self.joint_names != arm.joint_names:
            raise ContractError(
                f"twin of arm {self.arm!r} with joints {', '.join(self.joint_names)}; expected {arm.name!r} with "
                f"{', '.join(arm.joint_names)}; identify this arm"
            )

    def digest(self) -> str:
        """Fingerprint of everything that decides the twins drawn from this one."""
        h = hashlib.sha256("\n".join([self.arm, *self.names]).encode())
        values = [getattr(self.parameters, p.name) for p in PARAMETERS]
        for array in (*values, self.covariance, self.lower, self.upper, self.identified.astype(float)):
            h.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
        if self.stiction != STICTION:
            h.update(np.array(self.stiction, dtype="<f8").tobytes())
        if self.acceleration != np.inf:
            h.update(b"acceleration" + np.array(self.acceleration, dtype="<f8").tobytes())
        if self.table is not None:
            h.update(np.array(astuple(self.table), dtype="<f8").tobytes())
        return h.hexdigest()[:16]


@lru_cache(maxsize=8)
def _root(twin: Twin, least_spread: float) -> Array:
    """Matrix (k, k) whose product with its transpose is the covariance that `Twin.sample` draws from.

    Kept, since a training draws from the same twin all the time.
    """
    covariance = twin.covariance + np.diag(np.where(Layout(len(twin.joint_names)).is_log, least_spread**2, 0.0))
    values, vectors = np.linalg.eigh(covariance)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return root


def _strong_correlations(covariance: Array, threshold: float = 0.9) -> list[tuple[int, int, float]]:
    """Pairs (i, j, correlation) of parameters that the data can hardly tell apart, strongest first."""
    sigma = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(sigma, sigma)
    pairs = [(int(i), int(j), float(correlation[i, j])) for i, j in zip(*np.triu_indices(len(sigma), 1), strict=True)]
    return sorted((pair for pair in pairs if abs(pair[2]) > threshold), key=lambda pair: -abs(pair[2]))


def _share_a_scale(one: str, other: str, correlation: float) -> bool:
    scaled = {p.name for p in JOINT_PARAMETERS if p.log}
    (kind, _, joint), (other_kind, _, other_joint) = one.partition("."), other.partition(".")
    return joint == other_joint and {kind, other_kind} <= scaled and correlation > 0
