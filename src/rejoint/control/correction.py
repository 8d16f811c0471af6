"""True errors, and corrected targets: targets shifted by known tool errors.

Encoder errors count from the corrected target, true errors from the target.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
from numpy.linalg import norm

from rejoint.arms import (
    Arm,
    Array,
    Displacement,
    Mask,
    clip_norm,
    dls,
    frames,
    jacobian,
    tcp_position,
)
from rejoint.arms.kinematics import REST_GAIN
from rejoint.arms.postures import find_postures
from rejoint.arms.rotations import Orientation
from rejoint.arms.workspace import length_size
from rejoint.control.robot import JointState
from rejoint.system.errors import InputError
from rejoint.system.records import value_type
from rejoint.system.statistics import Estimate

How = Literal["known", "measured", "modelled", "not known"]

REMEDY = "not known: calibrate"


class ToolModel(Protocol):
    """Estimates tool errors, as a `Calibration` does."""

    def distance(self, position: Array, target: Array) -> Array:
        """Mean and 95 % interval (3, ...) [m] of the distance from ``target`` (..., 3) [m] at ``position`` (..., n)."""


@value_type
class TrueError:
    """True distance from the target."""

    how: How = "not known"
    """``known``: emulated; ``measured``: external; ``modelled``: calibration"""
    value: float | None = None
    """[m]"""
    low: float | None = None
    """[m] 95 % interval"""
    high: float | None = None
    """[m]"""

    @classmethod
    def of(cls, how: How, estimate: Estimate) -> TrueError:
        """Estimate [m]."""
        return cls(how=how, **vars(estimate))

    def __str__(self) -> str:
        """In millimetres, with its source."""
        if self.value is None:
            return REMEDY
        return f"{self.millimetres} mm, {self.how}{f' ({self.range})' if self.range else ''}"

    @property
    def millimetres(self) -> str:
        """Millimetres; empty: unknown."""
        return "" if self.value is None else f"{1e3 * self.value:.{2 if self.value < 1e-3 else 1}f}"

    @property
    def range(self) -> str:
        """95 % interval in millimetres: ``0.4 to 2.6``, or empty."""
        if self.low is None or self.high is None or self.low == self.high:
            return ""
        return f"{1e3 * self.low:.1f} to {1e3 * self.high:.1f}"


NOT_KNOWN = TrueError()


def modelled(model: ToolModel, position: Array, target: Array) -> Array:
    """Value, lower and upper end (3, ...) [m]; NaN for positions of NaN."""
    found = np.full((3, *np.shape(position)[:-1]), np.nan)
    there = np.isfinite(position).all(axis=-1) & np.isfinite(target).all(axis=-1)
    if there.any():
        found[:, there] = model.distance(position[there], target[there])
    return found


def tool_error(arm: Arm, position: Array, target: Array) -> Array:
    """Distances (...) [m] of the encoder TCP at ``position`` (..., n) [rad] from ``target`` (..., 3) [m]."""
    return norm(tcp_position(arm, position) - target, axis=-1)


def rms(values: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt((values**2).mean()))


def mean_modelled(found: Array, mean: Callable[[Array], float] = np.mean) -> TrueError:
    """``mean`` of ``found`` (3, ...) [m]; ends too, since errors are alike."""
    known = np.isfinite(found[0])
    if not known.any():
        return NOT_KNOWN
    value, low, high = (float(mean(part[known])) for part in found)
    return TrueError(how="modelled", value=value, low=low, high=high)


def true_error(
    errors: Array,
    model: ToolModel | None,
    position: Array,
    target: Array,
    mean: Callable[[Array], float] = np.mean,
) -> TrueError:
    """``mean`` of known ``errors`` (T,) [m], else by the ``model`` at ``position`` (T', n) for ``target`` (T', 3)."""
    if len(errors) and np.isfinite(errors).all():
        return TrueError(how="known", value=float(mean(errors)))
    return NOT_KNOWN if model is None else mean_modelled(modelled(model, position, target), mean)


ROUNDS = 4
"""Fixed-point steps (measured)"""
MOST = 0.05
"""[m] largest shift, for a myCobot 280 and smaller arms (chosen)"""
DAMPING = 0.01
"""[m] of the inverse kinematics (chosen: a fifth of the controllers')"""
THERE = 1e-5
"""[m] (chosen)"""
SHOWN = np.radians(15.0)
"""[rad] largest shift of a shown joint (chosen: what 5 cm take at the wrist)"""


@dataclass(eq=False)
class Modelled:
    """Corrects targets by known displacements.

    It also maps postures of the arm to those of a perfect arm with its tool at the same true place, and back.
    """

    arm: Arm
    displacement: Displacement

    def __post_init__(self) -> None:
        self._moved = self.displacement.moved(self.arm)

    def shift(self, position: Array) -> Array:
        """Shifts (..., 3) [m] from encoder TCP to tool at ``position`` (..., n) [rad]."""
        links = self.displacement.joints(self.arm, position)
        return tcp_position(self._moved, links) - tcp_position(self.arm, position)

    def untwisted(self, turn: Orientation, position: Array) -> Orientation:
        """Return encoder orientations (...) of tools turned as in ``turn``."""
        links = self.displacement.joints(self.arm, position)
        seen, own = frames(self.arm, position).tcp_rotation, frames(self._moved, links).tcp_rotation
        return replace(turn, rotation=seen @ own.mT @ turn.rotation)

    def aim(
        self, target: Array, start: Array, where: Mask, near: Array | None = None, turn: Orientation | None = None
    ) -> tuple[Array, Orientation | None]:
        """Corrected targets (B, 3) [m] and orientations (B,) of arms in ``where`` (B,); the others as they are.

        The postures are near ``near`` (B, n) [rad]; None: found from ``start`` (B, n) [rad].
        """
        aims, turn = np.array(target, dtype=float), turn and replace(turn, rotation=turn.rotation.copy())
        aimed = where & np.isfinite(target).all(axis=-1)
        if aimed.any():
            goal, rest_gain = target[aimed], REST_GAIN if near is None else 0.0
            place, before, posture = goal, goal, (start if near is None else near)[aimed]
            wanted = own = turn and turn[aimed]
            for _ in range(ROUNDS):
                posture = find_postures(self.arm, place, posture, own, rest_gain=rest_gain)
                before, place = place, goal - self.shift(posture)
                own = wanted and self.untwisted(wanted, posture)
            # they alternate where the play of a balanced joint changes its side
            aims[aimed] = checked(self.arm, goal, 0.5 * (before + place))
            if turn is not None and own is not None:
                turn.rotation[aimed] = own.rotation
        self.began(target, aims)
        return aims, turn

    def began(self, target: Array, aim: Array) -> None:
        """Take new targets and corrected ones, (B, 3) [m]."""

    def again(self, state: JointState) -> Array | None:  # noqa: ARG002 - a model has no news
        """Corrected targets (B, 3) [m] of arms at ``state``; None: as before."""
        return None

    def shown(self, position: Array) -> Array:
        """Posture (n,) [rad] of a perfect arm shown at ``position`` (n,)."""
        place = self.tool(position)
        return self._solved(position, lambda q: place - tcp_position(self.arm, q))

    def measured(self, posture: Array) -> Array:
        """Position (n,) [rad], within the limits, that shows ``posture`` (n,) of a perfect arm."""
        place = tcp_position(self.arm, posture)
        return np.clip(self._solved(posture, lambda q: place - self.tool(q)), self.arm.lower, self.arm.upper)

    def tool(self, position: Array) -> Array:
        """Return the true place (3,) [m] at ``position`` (n,) [rad]."""
        return tcp_position(self.arm, position) + self.shift(position)

    def _solved(self, start: Array, missing: Callable[[Array], Array]) -> Array:
        """Joint positions (n,) [rad] near ``start`` where nothing (3,) [m] is missing."""
        q, way, share = start, missing(start), 1.0
        for _ in range(4 * ROUNDS):
            if norm(way) < THERE:
                break
            both = jacobian(self.arm, q)
            both[3:] *= DAMPING  # if possible without turning the tool
            turn = dls(both, np.append(way, np.zeros(3)), 0.1 * DAMPING + float(norm(way)))
            tried = start + clip_norm(q + share * turn - start, SHOWN)
            left = missing(tried)
            if norm(left) < norm(way):
                q, way, share = tried, left, 1.0
            else:  # the shift jumps where a joint's load changes its side
                share *= 0.5
        return q


def most_shift(arm: Arm) -> float:
    """[m] largest shift of targets."""
    return MOST * max(length_size(arm), 1.0)


def checked(arm: Arm, target: Array, aim: Array) -> Array:
    """``aim`` (..., 3) [m]; InputError if too far."""
    far, most = norm(aim - target, axis=-1).max(initial=0.0), most_shift(arm)
    if not far <= most:
        raise InputError(
            f"calibration: it shifts a target by {1e3 * far:.0f} mm, expected at most {1e3 * most:.0f}; set wrong "
            "zeros of joints again, and calibrate again"
        )
    return aim
