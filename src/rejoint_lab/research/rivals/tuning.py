"""Gains of the rivals by CMA-ES, on randomised twins.

CMA-ES (Hansen, arXiv:1604.00772, package ``cmaes``) searches log gains. The cost is the time to stay within 2 mm plus
the settled error.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from cmaes import CMA  # type: ignore[import-untyped,unused-ignore]

from rejoint.arms import Arm, Array
from rejoint.control.comparison.protocols import metrics_of, schedule
from rejoint.control.comparison.result import Columns, Protocol
from rejoint.control.loop import run
from rejoint.system.progress import Progress
from rejoint.training.ranges import Ranges
from rejoint.twin.simulation import TwinRobot
from rejoint_lab.research.rivals.laws import Interval, MakeController


@dataclass(frozen=True, kw_only=True)
class TuningSettings:
    """Size of the search."""

    generations: int = 40
    candidates: int = 12
    """per generation"""
    arms: int = 24
    """twins per candidate"""
    targets: int = 2
    hold: float = 3.0
    """[s] per target; chosen"""
    spread: float = 0.2
    """initial sigma relative to a gain's interval"""
    settled_weight: float = 2.0
    """[s/mm] of settled error; chosen"""
    settled_cap: float = 0.010
    """[m] cap of settled errors"""
    seed: int = 0


def tune(
    arm: Arm,
    ranges: Ranges,
    intervals: Mapping[str, Interval],
    make: MakeController,
    settings: TuningSettings,
    on_progress: Progress,
) -> dict[str, float]:
    """Search gains; returns the last generation's centre."""
    names = list(intervals)
    low, high = np.log(np.array(list(intervals.values()))).T
    search = CMA(
        mean=np.full(len(names), 0.5),
        sigma=settings.spread,
        bounds=np.tile([0.0, 1.0], (len(names), 1)),
        population_size=settings.candidates,
        seed=settings.seed,
    )

    def gains(point: Array) -> dict[str, Array]:
        return dict(zip(names, np.moveaxis(np.exp(low + point * (high - low)), -1, 0), strict=True))

    for generation in range(settings.generations):
        points = np.array([search.ask() for _ in range(settings.candidates)])
        costs = candidate_costs(arm, ranges, gains(points), make, settings, generation)
        search.tell([(point, float(cost)) for point, cost in zip(points, costs, strict=True)])
        on_progress((generation + 1) / settings.generations, f"cost {costs.min():.2f} s")
    return {name: float(value) for name, value in gains(np.clip(search.mean, 0.0, 1.0)).items()}


def candidate_costs(
    arm: Arm, ranges: Ranges, gains: Mapping[str, Array], make: MakeController, settings: TuningSettings, draw_seed: int
) -> Array:
    """Cost (P,) of ``gains`` (P,) on the same arms and targets."""
    count = len(next(iter(gains.values())))
    rng = np.random.default_rng([settings.seed, draw_seed])
    drawn = ranges.draw(rng, settings.arms).rows(np.tile(np.arange(settings.arms), count))
    targets = np.tile(arm.targets.sample(rng, (settings.arms, settings.targets)), (count, 1, 1))
    robot = TwinRobot(arm, drawn, seed=draw_seed, copies=count)
    each = {name: np.repeat(value, settings.arms)[:, None] for name, value in gains.items()}
    protocol = Protocol(hold=settings.hold, within=(0.002,))
    recording = run(robot, make(arm, each), targets, schedule("hold", protocol, keep_going=True))
    return cost(metrics_of(arm, recording, targets, protocol), settings).reshape(count, -1).mean(axis=1)


def cost(holds: Columns, settings: TuningSettings) -> Array:
    """Cost (B, K) [s] of holds."""
    late = np.nan_to_num(holds["stay_2mm"], nan=settings.hold)
    error = np.minimum(np.nan_to_num(holds["settled"], nan=np.inf), settings.settled_cap)
    return late + settings.settled_weight * 1e3 * error
