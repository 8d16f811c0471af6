"""Drives beside the comparison of controllers: the arm as it was found, and poses come to from three directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.size import length_size
from rejoint.control.accuracy import NOT_KNOWN, ToolModel, TrueError, mean_modelled
from rejoint.control.comparison import iso
from rejoint.control.comparison.protocols import Holds, measure_holds, schedule
from rejoint.control.comparison.result import DirectionVariation, Protocol, TargetErrors
from rejoint.control.comparison.targets import beyond_reach
from rejoint.control.controller import Controller
from rejoint.control.correction import Correction
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import run
from rejoint.control.robot import Robot
from rejoint.control.servogains import limits_under, under_gains
from rejoint.control.start import Stance, begin
from rejoint.system.statistics import Spread, spread

AWAY = 0.03
"""[m] along an axis of the base from which a pose is come to, on an arm of the reach of a myCobot 280 (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Holding:
    """How an arm is driven to places that are held one after the other."""

    open_robot: Callable[[int, int], Robot]
    """opens a robot of so many arms with a noise seed"""
    batched: bool
    """whether cycles are driven side by side on equal emulated arms, rather than one after the other on one arm"""
    seed: int
    limits: GuardLimits | None = None
    stance: Stance | None = None
    correction: Callable[[Arm], Correction] | None = None
    model: ToolModel | None = None
    """says how far the tool is from its targets, where nobody knows"""

    def hold(self, controller: Callable[[Arm], Controller], targets: Array, protocol: Protocol) -> Holds:
        """Drive to ``targets`` (R, K, 3) [m] in R cycles; raises what `run` raises on one arm."""
        parts = [targets] if self.batched else np.split(targets, len(targets))
        found = []
        robot = self.open_robot(len(parts[0]), self.seed)
        try:
            for part in parts:
                sent = None if self.batched else begin(robot, self.limits, self.stance).command[-1]
                plan = schedule("hold", protocol, keep_going=self.batched, sent=sent)
                aiming = None if self.correction is None else self.correction(robot.arm)
                own = controller(robot.arm)
                with under_gains(robot, own):
                    limits = limits_under(self.limits, robot, own)
                    driven = run(robot, own, part, plan, limits=limits, correction=aiming)
                found.append(measure_holds(robot.arm, driven, part, protocol, self.model))
        finally:
            robot.close()
        return replace(
            found[0],
            **{name: np.concatenate([getattr(one, name) for one in found])
               for name in ("settled", "settled_true", "away", "away_true")},
            modelled=np.concatenate([one.modelled for one in found], axis=1),
        )  # fmt: skip


def found_errors(
    how: Holding, controller: Callable[[Arm], Controller], targets: Array, protocol: Protocol
) -> TargetErrors:
    """Return the errors of an arm that is not corrected, at each of ``targets`` (K, 3) [m]."""
    held = replace(how, correction=None).hold(controller, targets[None], protocol)
    return errors_of(held.settled, held.settled_true, held.modelled)


def errors_of(encoders: Array, true: Array, modelled: Array) -> TargetErrors:
    """Sum up R cycles at each of K targets: encoder error and true error (R, K) [m], and what is modelled (3, R, K)."""
    return TargetErrors(
        encoders=tuple(_mean(column) for column in encoders.T),
        true=tuple(_true(true[:, k], modelled[:, :, k]) for k in range(true.shape[1])),
    )


def _mean(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(known.mean()) if len(known) else None


def _true(true: Array, modelled: Array) -> TrueError:
    known = _mean(true)
    if known is not None:
        return TrueError(how="known", value=known)
    return mean_modelled(modelled) if np.isfinite(modelled).any() else NOT_KNOWN


def vary_directions(
    how: Holding, name: str, controller: Callable[[Arm], Controller], arm: Arm, cycles: int, protocol: Protocol
) -> DirectionVariation | None:
    """Come to each pose of ISO 9283 along each axis of the base, from the side of the centre, ``cycles`` times.

    Poses that are out of reach are left out. Where arms stand side by side, each takes one axis: it is done in a third
    of the cycles.
    """
    poses = iso.iso_poses(arm, iso.RISING_AHEAD)
    poses = poses[beyond_reach(arm, poses) == 0.0]
    middle = 0.5 * (arm.targets.upper + arm.targets.lower)
    side = np.where(poses > middle, -1.0, 1.0)
    starts = poses[None] + AWAY * length_size(arm) * np.eye(3)[:, None] * side[None]  # (3, P, 3)
    way = np.stack([starts, np.broadcast_to(poses, starts.shape)], axis=2)  # (3, P, 2, 3)
    ways = way.reshape(3 if how.batched else 1, -1, 3)
    held = how.hold(controller, np.tile(ways, (cycles, 1, 1)), protocol)
    encoders, tool = (_variation(one[:, 1::2].reshape(cycles, 3, len(poses), 3)) for one in (held.away, held.away_true))
    if encoders is None:
        return None
    return DirectionVariation(controller=name, poses=len(poses), cycles=cycles, encoders=encoders, tool=tool)


def _variation(away: Array) -> Spread | None:
    """VAP over the poses of ``away`` (R, D, P, 3) [m], how far from the pose the tool stood."""
    means = np.moveaxis(away.mean(axis=0), 0, 1)  # (P, D, 3)
    known = means[np.isfinite(means).all(axis=(1, 2))]
    return spread(np.array([iso.direction_variation(one) for one in known]), np.arange(len(known)))
