"""Gains of the rivals by CMA-ES, on randomised twins.

CMA-ES (Hansen, arXiv:1604.00772, package ``cmaes``) searches log gains. The cost is the time to stay within 2 mm plus
the settled error.
"""

from __future__ import annotations

import numpy as np
from cmaes import CMA  # type: ignore[import-untyped,unused-ignore]

from rejoint.arms import Arm, Array
from rejoint.control.comparison.protocols import metrics_of, schedule
from rejoint.control.comparison.result import Columns, Protocol
from rejoint.control.loop import run
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress
from rejoint.training.ranges import Ranges
from rejoint.twin.simulation import TwinRobot
from rejoint_lab.research.rivals.laws import Gains, Rival

CANDIDATES = 12
"""per generation"""
ARMS, TARGETS = 24, 2
"""twins per candidate, and targets of each"""
PROTOCOL = Protocol(hold=3.0, within=(0.002,))
"""chosen"""
SIGMA = 0.2
"""initial, relative to a gain's interval"""
WEIGHT = 2.0
"""[s/mm] of the settled error; chosen"""
FARTHEST = 0.010
"""[m] cap of settled errors"""


def tune(
    arm: Arm, ranges: Ranges, rival: Rival, on_progress: Progress, *, generations: int, seed: int = 0
) -> dict[str, float]:
    """Search gains; returns the last generation's centre. InputError for a law without any."""
    names = list(rival.intervals)
    if not names:
        raise InputError("tune: this rival has the paper's gains, none are searched")
    low, high = np.log(np.array(list(rival.intervals.values()))).T
    middle, bounds = np.full(len(names), 0.5), np.tile([0.0, 1.0], (len(names), 1))
    search = CMA(mean=middle, sigma=SIGMA, bounds=bounds, population_size=CANDIDATES, seed=seed)

    def gains(point: Array) -> dict[str, Array]:
        return dict(zip(names, np.moveaxis(np.exp(low + point * (high - low)), -1, 0), strict=True))

    for generation in range(generations):
        points = np.array([search.ask() for _ in range(CANDIDATES)])
        costs = candidate_costs(arm, ranges, rival, gains(points), (seed, generation))
        search.tell([(point, float(cost)) for point, cost in zip(points, costs, strict=True)])
        on_progress((generation + 1) / generations, f"cost {costs.min():.2f} s")
    return {name: float(value) for name, value in gains(np.clip(search.mean, 0.0, 1.0)).items()}


def candidate_costs(arm: Arm, ranges: Ranges, rival: Rival, gains: Gains, draw: tuple[int, int]) -> Array:
    """Cost (P,) of ``gains`` (P,) on the same arms and targets, of seed and generation ``draw``."""
    count = len(np.atleast_1d(next(iter(gains.values()))))
    rng = np.random.default_rng(draw)
    drawn = ranges.draw(rng, ARMS).rows(np.tile(np.arange(ARMS), count))
    targets = np.tile(arm.targets.sample(rng, (ARMS, TARGETS)), (count, 1, 1))
    robot = TwinRobot(arm, drawn, seed=draw[1], copies=count)
    controller = rival.make(arm, {name: np.repeat(value, ARMS)[:, None] for name, value in gains.items()})
    recording = run(robot, controller, targets, schedule("hold", PROTOCOL, keep_going=True))
    return cost(metrics_of(arm, recording, targets, PROTOCOL)).reshape(count, -1).mean(axis=1)


def cost(holds: Columns) -> Array:
    """Cost (B, K) [s] of holds."""
    late = np.nan_to_num(holds["stay_2mm"], nan=PROTOCOL.hold)
    error = np.minimum(np.nan_to_num(holds["settled"], nan=np.inf), FARTHEST)
    return late + WEIGHT * 1e3 * error
