"""The fitted twin: values, intervals, unknowns, prediction error."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array
from rejoint.system.errors import ContractError, InputError
from rejoint.system.statistics import NORMAL95
from rejoint.twin.judgement import Judgement, PredictionError
from rejoint.twin.parameters import (
    PARAMETERS,
    STICTION,
    Layout,
    TwinParameters,
    pack,
    unpack,
    vector_names,
)

LEAST_SPREAD = 0.05
"""Extra sigma of the logarithms of drawn twins; chosen"""

SCALE_KNOWN = 2.0
"""Information on a known common scale over the prior's; chosen"""


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOut:
    """Errors on held-out motion."""

    seconds: float
    """[s]"""
    no_twin: PredictionError
    """the command as prediction"""
    twin: PredictionError
    healthy_twin: PredictionError | None = None
    """None where the arm's servos are unknown"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Twin:
    """Parameters of one arm with their covariance, over a vector of length k.

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
    """(k, k) of the vector of `pack`"""
    lower: Array
    """(k,) physical bounds"""
    upper: Array
    narrowing: Array
    """(k,) sigma by the data over that of the prior"""
    identified: NDArray[np.bool_]
    """(k,) whether the data outweigh the prior"""
    held_out: HeldOut
    fit_seconds: float
    """[s] of motion in the fit"""
    notes: tuple[str, ...] = field(default=())
    """for the user"""
    stiction: float = STICTION
    """static over kinetic friction"""
    acceleration: float = np.inf
    """[rad/s^2] of references while commands change (`rejoint.twin.reference`)"""
    judgement: Judgement | None = None
    """on held-out motions; not on file"""
    fitted: tuple[str, ...] = ()
    """labels of motions; not on file"""

    @classmethod
    def load(cls, path: Path | str) -> Twin:
        """Read a TOML file; FileError if missing or damaged."""
        from rejoint.twin.file import read_twin

        return read_twin(Path(path))

    def save(self, path: Path | str) -> None:
        """Write a TOML file, atomically; FileError if that fails."""
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
        values, symmetric = np.linalg.eigvalsh(self.covariance), np.allclose(self.covariance, self.covariance.T)
        if not symmetric or values.max() <= 0.0 or values.min() < -1e-6 * values.max():
            raise InputError("twin: the covariance must be symmetric, without negative eigenvalues")
        if (self.narrowing <= 0).any() or (self.lower >= self.upper).any():
            raise InputError("twin: every narrowing must be positive, and every lower bound below the upper one")
        if not (1.0 <= self.stiction < np.inf and self.acceleration > 0.0):
            raise InputError(f"twin: stiction {self.stiction} below 1 or acceleration {self.acceleration} not above 0")

    @property
    def names(self) -> tuple[str, ...]:
        """Names (k,) of the parameters."""
        return vector_names(self.joint_names)

    @property
    def interval(self) -> tuple[TwinParameters, TwinParameters]:
        """Ends of the 95 % intervals, within the bounds."""
        mean, sigma = pack(self.parameters), np.sqrt(np.diag(self.covariance))
        n = len(self.joint_names)
        low, high = np.maximum(mean - NORMAL95 * sigma, self.lower), np.minimum(mean + NORMAL95 * sigma, self.upper)
        return unpack(low, n), unpack(high, n)

    @property
    def unknown_scale(self) -> tuple[str, ...]:
        """Joints with torques and inertia known up to a factor."""
        layout, sigma = Layout(len(self.joint_names)), np.sqrt(np.diag(self.covariance)) / self.narrowing
        unknown = []
        for joint, name in enumerate(self.joint_names):
            scaled = np.flatnonzero((layout.owner == joint) & layout.is_log)
            information = np.linalg.pinv(self.covariance[np.ix_(scaled, scaled)]).sum()
            if information < SCALE_KNOWN * (sigma[scaled] ** -2).sum():
                unknown.append(name)
        return tuple(unknown)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Parameters that keep their prior range."""
        known = self.identified | ~Layout(len(self.joint_names)).is_fitted
        return tuple(name for name, told in zip(self.names, known, strict=True) if not told)

    def sample(self, rng: np.random.Generator, count: int, least_spread: float = LEAST_SPREAD) -> TwinParameters:
        """Draw ``count`` twins from the covariance, within the physical bounds.

        ``least_spread`` widens logarithms. Delays are not negative.
        """
        root = _root(self, least_spread)
        drawn = pack(self.parameters) + rng.standard_normal((count, len(self.names))) @ root.T
        lower = np.where(np.array(self.names) == "delay", np.maximum(self.lower, 0.0), self.lower)
        return unpack(np.clip(drawn, lower, self.upper), len(self.joint_names))

    def require(self, arm: Arm) -> None:
        """Raise ContractError if this twin is of another arm."""
        if self.arm != arm.name or self.joint_names != arm.joint_names:
            raise ContractError(
                f"twin of arm {self.arm!r} with joints {', '.join(self.joint_names)}; expected {arm.name!r} with "
                f"{', '.join(arm.joint_names)}; identify this arm"
            )

    def digest(self) -> str:
        """Fingerprint of what decides the twins drawn from this one."""
        h = hashlib.sha256("\n".join([self.arm, *self.names]).encode())
        values = [getattr(self.parameters, p.name) for p in PARAMETERS]
        for array in (*values, self.covariance, self.lower, self.upper, self.identified.astype(float)):
            h.update(np.ascontiguousarray(array, dtype="<f8").tobytes())
        if self.stiction != STICTION:
            h.update(np.array(self.stiction, dtype="<f8").tobytes())
        if self.acceleration != np.inf:
            h.update(b"acceleration" + np.array(self.acceleration, dtype="<f8").tobytes())
        return h.hexdigest()[:16]


@lru_cache(maxsize=8)
def _root(twin: Twin, least_spread: float) -> Array:
    """Matrix square root (k, k) of the covariance of `Twin.sample`, cached."""
    covariance = twin.covariance + np.diag(np.where(Layout(len(twin.joint_names)).is_log, least_spread**2, 0.0))
    values, vectors = np.linalg.eigh(covariance)
    root: Array = vectors * np.sqrt(np.maximum(values, 0.0))
    return root
