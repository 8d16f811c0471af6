"""The fitted twin: values, intervals, unknowns, prediction error; its judgement on logs; its file ``twin.toml``."""

from __future__ import annotations

from functools import cached_property
from itertools import compress
from operator import methodcaller
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from rejoint.arms import Arm, Array, Mask
from rejoint.system.errors import ContractError, InputError
from rejoint.system.files import Number, Positive, array_of, digest, read_sealed, toml_of, write_sealed
from rejoint.system.records import Readable, entity, value_type
from rejoint.system.statistics import FEWEST_CLUSTERS, NORMAL95, above_zero, bootstrap_mean
from rejoint.twin.parameters import (
    PARAMETERS,
    Layout,
    TwinParameters,
    flat,
    pack,
    shaped,
    unpack,
    vector_names,
)

LEAST_SPREAD = 0.05
"""Extra sigma of the logarithms of drawn twins; chosen"""
CLEARLY = 0.8
"""Relative error that is clearly smaller in fewer motions; chosen"""
ROUNDING = 1e-6
"""Of values at their bounds and of eigenvalues, relative to the largest; chosen"""
NO_TWIN = "no twin"
"""The prediction that the arm is at its command"""


@value_type
class PredictionError:
    """Root mean square error of a prediction, by encoders."""

    joint: float
    """[rad] over all joints"""
    tcp: float
    """[m] of the TCP by encoders"""


@value_type
class Errors:
    """Errors of one motion, or their mean; None without rows."""

    free: PredictionError | None
    contact: PredictionError | None
    all: PredictionError | None


@value_type
class MotionErrors:
    """All predictions of one motion."""

    motion: str
    seconds: float
    contact_seconds: float
    """with the table, recovery included"""
    left_out_seconds: float
    """at stops or with dead readings, recovery included"""
    errors: dict[str, Errors]


@value_type
class Judgement(Readable):
    """Result of a replay of logs."""

    arm: str
    motions: tuple[MotionErrors, ...]
    mean: dict[str, Errors]
    """over motions with equal weight, by prediction"""
    doubts: tuple[str, ...] = ()
    """why no prediction is trusted (`rejoint.twin.judge`)"""


def smaller(ours: Array, theirs: Array) -> bool:
    """Whether errors (K,) are measurably smaller in the same motions."""
    if len(ours) < FEWEST_CLUSTERS:
        return bool(len(ours) and (ours < CLEARLY * theirs).all())
    return above_zero(bootstrap_mean(theirs - ours, np.arange(len(ours))))


HALVED = 2.0
"""Distance of motion from commands over the error of a trusted twin; chosen"""


@entity
class HeldOut:
    """Errors on held-out motion."""

    seconds: float
    """[s]"""
    no_twin: PredictionError
    """the command as prediction"""
    twin: PredictionError
    healthy_twin: PredictionError | None = None
    """None where the arm's servos are unknown"""

    @property
    def trusted(self) -> bool:
        """Whether the twin halves the error of the command, and is no worse than a healthy one."""
        healthy = np.inf if self.healthy_twin is None else self.healthy_twin.tcp
        return self.twin.tcp <= min(self.no_twin.tcp / HALVED, healthy)


@value_type
class TablePlane:
    """A plane under the tip."""

    height: Number
    """[m] of the TCP in contact, below the base's origin"""
    slope_x: Number
    """along the base's x"""
    slope_y: Number
    stiffness: Positive
    """[N/m] of tip, links and table together, vertical"""
    friction: Positive
    """Coulomb coefficient of the tip"""


@entity
class Twin(Readable):
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
    identified: Mask
    """(k,) whether the data outweigh the prior"""
    held_out: HeldOut
    fit_seconds: float
    """[s] of motion in the fit"""
    notes: tuple[str, ...] = ()
    """for the user"""
    acceleration: float = np.inf
    """[rad/s^2] of references while commands change (`rejoint.control.servoreference`)"""
    gain: Array | None = None
    """(n,) P gain of the servos at which they have this stiffness, where logs record it"""
    table: TablePlane | None = None
    """contact in the logs; not part of the arm"""
    judgement: Judgement | None = None
    """on held-out motions; not on file"""
    fitted: tuple[str, ...] = ()
    """labels of motions; not on file"""

    @classmethod
    def load(cls, path: Path | str) -> Twin:
        """Read a TOML file; FileError if missing or damaged."""
        return read_twin(Path(path))

    def save(self, path: Path | str) -> None:
        """Write a TOML file, atomically; FileError if that fails."""
        told: dict[str, Any] = {"format": FORMAT, **{name: getattr(self, name) for name in _WHOLE}, "order": self.names}
        columns = dict(zip(("value", "low95", "high95"), map(flat, (self.parameters, *self.interval)), strict=True))
        columns |= {name: getattr(self, name) for name in _COLUMNS}
        for p in PARAMETERS:
            told[p.name] = {name: column[self.layout.at(p.name)] for name, column in columns.items()}
        write_sealed(Path(path), toml_of(told), _ABOUT)

    @cached_property
    def layout(self) -> Layout:
        """Of the vectors."""
        return Layout(len(self.joint_names))

    @property
    def names(self) -> tuple[str, ...]:
        """Names (k,) of the parameters."""
        return vector_names(self.joint_names)

    @property
    def interval(self) -> tuple[TwinParameters, TwinParameters]:
        """Ends of the 95 % intervals, within the bounds."""
        mean, sigma = pack(self.parameters), np.sqrt(np.diag(self.covariance))
        low, high = np.maximum(mean - NORMAL95 * sigma, self.lower), np.minimum(mean + NORMAL95 * sigma, self.upper)
        return unpack(low), unpack(high)

    @property
    def unknown_scale(self) -> tuple[str, ...]:
        """Joints with torques and inertia known up to a factor."""
        return tuple(compress(self.joint_names, ~self.identified[self.layout.at("stiffness")]))

    @property
    def unknown(self) -> dict[str, list[str]]:
        """Joints, or the arm, by the parameter that keeps its prior range."""
        layout, sigma = self.layout, np.sqrt(np.diag(self.covariance)) / self.narrowing
        settled = np.maximum(layout.has("difference"), layout.has("beside"))  # by the prior, or no data could
        found = dict[str, list[str]]()
        for name in compress(self.names, (sigma > 1.001 * settled) & ~self.identified):
            parameter, _, joint = name.partition(".")
            found.setdefault(parameter, []).append(joint or "arm")
        return found

    def sample(self, rng: np.random.Generator, count: int) -> TwinParameters:
        """Draw ``count`` twins from the covariance, within the physical bounds.

        `LEAST_SPREAD` widens logarithms. Delays are not negative.
        """
        drawn = pack(self.parameters) + rng.standard_normal((count, len(self.names))) @ self._root.T
        lower = np.where(np.array(self.names) == "delay", 0.0, self.lower)
        return unpack(np.clip(drawn, lower, self.upper))

    @cached_property
    def _root(self) -> Array:
        """Matrix square root (k, k) of the covariance of `sample`."""
        covariance = self.covariance + np.diag(np.where(self.layout.is_log, LEAST_SPREAD**2, 0.0))
        values, vectors = np.linalg.eigh(covariance)
        return vectors * np.sqrt(np.maximum(values, 0.0))

    def require(self, arm: Arm) -> None:
        """Raise ContractError if this twin is of another arm."""
        if self.arm != arm.name or self.joint_names != arm.joint_names:
            raise ContractError(
                f"twin of arm {self.arm!r} with joints {', '.join(self.joint_names)}; expected {arm.name!r} with "
                f"{', '.join(arm.joint_names)}; identify this arm"
            )

    def digest(self) -> str:
        """Fingerprint of what decides the twins drawn from this one."""
        decided = [flat(self.parameters), *(getattr(self, name) for name in _DECIDING)]
        return digest(msgspec.json.encode(decided, enc_hook=methodcaller("tolist")))


_DECIDING = ("arm", "joint_names", "covariance", "lower", "upper", "identified", "acceleration", "gain", "table")

FORMAT = 3

_ABOUT = "".join(
    (
        "Digital twin of one robot arm, fitted to its own motion. SI units; errors are root mean squares.\n",
        *(f"{p.name}: {p.unit}, {p.meaning}{'; lower and upper are logarithms' * p.log}\n" for p in PARAMETERS),
        "covariance: of the parameters in this order, logarithms of those whose bounds are logarithms",
    )
)
_WHOLE = ("arm", "joint_names", "fit_seconds", "notes", "acceleration", "gain", "held_out", "table", "covariance")
_COLUMNS = ("lower", "upper", "narrowing", "identified")  # of each parameter


def read_twin(path: Path, arm: Arm | None = None) -> Twin:
    """Read a twin; FileError if missing or damaged, ContractError for another arm."""

    def build(data: dict[str, Any]) -> Twin:
        columns = {name: [one for p in PARAMETERS for one in data[p.name][name]] for name in ("value", *_COLUMNS)}
        parameters = vars(shaped(np.array(columns["value"])))
        twin = msgspec.convert(data | columns | {"parameters": parameters}, Twin, dec_hook=array_of)
        with np.errstate(all="ignore"):  # logarithms of what is wrong
            values = pack(twin.parameters)
        good = (twin.lower - ROUNDING <= values) & (values <= twin.upper + ROUNDING) & (twin.narrowing > 0.0)
        variances = np.linalg.eigvalsh(twin.covariance)
        sound = dict(
            zip(twin.names, good, strict=True),
            covariance=np.allclose(twin.covariance, twin.covariance.T) and variances[0] >= -ROUNDING * variances[-1],
            acceleration=twin.acceleration > 0.0,
        )
        if wrong := [name for name, fine in sound.items() if not fine]:
            raise InputError(
                f"wrong are {', '.join(wrong)}; expected values between lower and upper, narrowing and acceleration "
                "above 0, and a symmetric covariance without negative eigenvalues"
            )
        return twin

    twin = read_sealed(path, build, name="twin", version=FORMAT, again="identify the arm")
    if arm is not None:
        twin.require(arm)
    return twin
