"""Drives beside the comparison: the uncorrected arm, and ISO 9283's directions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rejoint.arms import Arm, Array
from rejoint.arms.workspace import length_size
from rejoint.control.comparison.protocols import (
    MODELLED,
    RISING_AHEAD,
    Columns,
    direction_variation,
    iso_poses,
    measure_holds,
    schedule,
)
from rejoint.control.comparison.result import DirectionVariation, Protocol, TargetErrors
from rejoint.control.controller import Controller
from rejoint.control.correction import NOT_KNOWN, Modelled, ToolModel, TrueError, mean_modelled
from rejoint.control.guard import GuardLimits
from rejoint.control.loop import run
from rejoint.control.reference import TargetSequence
from rejoint.control.robot import Robot
from rejoint.control.servogains import limits_under, under_gains
from rejoint.control.start import Stance, begin
from rejoint.control.targets import beyond_reach
from rejoint.system.statistics import Spread, spread

AWAY = 0.03
"""[m] start of an approach, for a myCobot 280 (chosen)"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Holding:
    """How to drive held places."""

    open_robot: Callable[[int, int], Robot]
    """(arms, noise seed)"""
    batched: bool
    seed: int
    limits: GuardLimits | None = None
    stance: Stance | None = None
    correction: Callable[[Arm], Modelled] | None = None
    model: ToolModel | None = None

    def hold(self, controller: Callable[[Arm], Controller], targets: Array, protocol: Protocol) -> Columns:
        """Drive to ``targets`` (R, K, 3) [m], R cycles; raises as `run`."""
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
                    driven = run(robot, own, TargetSequence(robot.arm, part, correction=aiming), plan, limits=limits)
                found.append(measure_holds(robot.arm, driven, part, protocol, self.model))
        finally:
            robot.close()
        return {name: np.concatenate([one[name] for one in found]) for name in found[0]}


def found_errors(
    how: Holding, controller: Callable[[Arm], Controller], targets: Array, protocol: Protocol
) -> TargetErrors:
    """Errors of an uncorrected arm at ``targets`` (K, 3) [m]."""
    held = replace(how, correction=None).hold(controller, targets[None], protocol)
    return errors_of(held)


def errors_of(held: Columns) -> TargetErrors:
    """Mean errors of columns (R, K)."""
    unknown = np.full_like(held["settled"], np.nan)
    modelled = np.array([held.get(name, unknown) for name in MODELLED])
    return TargetErrors(
        encoders=tuple(_mean(column) for column in held["settled"].T),
        true=tuple(_true(column, modelled[:, :, k]) for k, column in enumerate(held["settled_true"].T)),
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
    """Approach each reachable ISO 9283 pose along the base axes, ``cycles`` times."""
    poses = iso_poses(arm, RISING_AHEAD)
    poses = poses[beyond_reach(arm, poses) == 0.0]
    middle = 0.5 * (arm.targets.upper + arm.targets.lower)
    side = np.where(poses > middle, -1.0, 1.0)
    starts = poses[None] + AWAY * length_size(arm) * np.eye(3)[:, None] * side[None]  # (3, P, 3)
    way = np.stack([starts, np.broadcast_to(poses, starts.shape)], axis=2)  # (3, P, 2, 3)
    ways = way.reshape(3 * len(poses) if how.batched else 1, -1, 3)
    held = how.hold(controller, np.tile(ways, (cycles, 1, 1)), protocol)
    away = (np.stack([held[f"{name}_{axis}"] for axis in "xyz"], axis=-1) for name in ("away", "away_true"))
    encoders, tool = (_variation(one[:, 1::2].reshape(cycles, 3, len(poses), 3)) for one in away)
    if encoders is None:
        return None
    return DirectionVariation(controller=name, poses=len(poses), cycles=cycles, encoders=encoders, tool=tool)


def _variation(away: Array) -> Spread | None:
    """VAP over poses, from errors (R, D, P, 3) [m]."""
    means = np.moveaxis(away.mean(axis=0), 0, 1)  # (P, D, 3)
    known = means[np.isfinite(means).all(axis=(1, 2))]
    return spread(np.array([direction_variation(one) for one in known]), np.arange(len(known)))
