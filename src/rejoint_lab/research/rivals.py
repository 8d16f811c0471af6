"""Rivals of the policy: the paper's PID, and a classical law with tuned gains.

PID of Park et al. 2024, equations 26 and 27: ``theta_{t+1} = theta_t + Kp e_t + Ki sum(e) [dt] + Kd (e_t - e_{t-1}) /
dt``.

Gain-scheduled integral control with gravity feed-forward: a rate by distance (Rugh and Shamma, Automatica 36,
2000), and conditional integration (Astrom and Rundqwist, ACC 1989).

CMA-ES (Hansen, arXiv:1604.00772) searches logarithms of gains (``rivals.toml``) on randomised
twins, by the time to stay within 2 mm plus the settled error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rejoint.arms import Arm, Array, Mask, clip_norm, gravity_torque, position_kinematics
from rejoint.arms.workspace import torque_size
from rejoint.control.comparison.protocols import metrics_of, schedule
from rejoint.control.comparison.result import Protocol
from rejoint.control.controllers.classical import Pace, dls_step, limit_position, null_space
from rejoint.control.controllers.feedforward import NOMINAL_STIFFNESS
from rejoint.control.loop import run
from rejoint.control.robot import ControlInput, Controller
from rejoint.system.errors import InputError
from rejoint.system.files import read_shipped
from rejoint.system.progress import Progress

if TYPE_CHECKING:
    from rejoint.training.ranges import Ranges

Gains = Mapping[str, float | Array]


class PidController:
    """Adds a PID correction to the measured position; gains of Park et al. 2024, below equation 27."""

    heeds_turn = True
    proportional, integral, derivative, period = 0.40, 0.01, 5e-3, 0.02
    """[1], [1] per cycle or [1/s], [s], and dt of the equation [s]"""
    _sum = _last = np.zeros(())  # until the first target

    def __init__(self, *, literal: bool) -> None:
        """``literal``: the sum is multiplied by dt, as printed; else a plain sum."""
        self.name, self._weight = "pid-literal" if literal else "pid-sum", self.period if literal else 1.0

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Clear the integral of ``where`` (B,)."""
        self._sum = np.where(where[:, None], 0.0, self._sum)
        # The change of the error at a new target is the target's jump, not a motion of the arm.
        self._last = np.where(where[:, None], inputs.goal - inputs.state.position, self._last)

    def command(self, inputs: ControlInput) -> Array:
        """See `Controller`."""
        measured = inputs.state.position
        error = inputs.goal - measured
        self._sum = self._sum + error * self._weight
        change = (error - self._last) / self.period
        self._last = error
        return measured + self.proportional * error + self.integral * self._sum + self.derivative * change


class ScheduledController:
    """The law, around a ramp to the goal posture raised against gravity of nominal servos."""

    name = "tuned-feedforward"
    _start = _raised = _integral = np.zeros(())  # until the first target
    _position = _speed = np.zeros((0, 1))  # until the first reading

    def __init__(self, arm: Arm, gains: Gains) -> None:
        self._arm, self._gains, self._pace = arm, SimpleNamespace(**gains), Pace()
        self._stiffness = NOMINAL_STIFFNESS * torque_size(arm)

    def reset(self, inputs: ControlInput, where: Mask) -> None:
        """Take new targets of the arms in ``where`` (B,)."""
        gains, goal, sent, new = self._gains, inputs.goal, inputs.sent, where[:, None]
        learned = np.broadcast_to(self._integral, sent.shape)
        # What was learned in the null space moves no tool, but adds up from target to target until the arm folds.
        idle = null_space(position_kinematics(self._arm, goal)[1], learned)
        self._integral = np.where(new, gains.carry * (learned - idle), learned)
        self._start = np.where(new, sent - self._integral, self._start)
        raised = goal + gains.feedforward * gravity_torque(self._arm, goal) / self._stiffness
        self._raised = np.where(new, raised, self._raised)

    def command(self, inputs: ControlInput) -> Array:
        """Command (B, n) [rad]."""
        arm, gains, measured = self._arm, self._gains, inputs.state.position
        elapsed, position = self._pace.tick(inputs.state.time)[:, None], measured.copy()
        if len(self._position) != len(position):
            self._position, self._speed = position, np.zeros_like(position)
        newest = (position - self._position) / np.where(elapsed > 0.0, elapsed, 1.0)
        # [rad/s] smoothed over about two cycles
        self._speed = speed = np.where(elapsed > 0.0, 0.5 * newest + 0.5 * self._speed, self._speed)
        self._position = position
        seen = dls_step(arm, measured + gains.prediction * speed, inputs.target)
        distance = np.linalg.norm(seen.error, axis=-1, keepdims=True)
        rate = gains.near_rate + (gains.far_rate - gains.near_rate) * distance / (distance + gains.schedule)
        step = seen.step * np.maximum(distance - gains.deadband, 0.0) / np.maximum(distance, 1e-9)
        push = elapsed * clip_norm(rate * step, gains.speed)
        on_its_way = (np.abs(speed) > gains.moving) & (speed * push > 0.0)
        passing = gains.proportional * step - gains.damping * speed
        self._integral = np.clip(self._integral + np.where(on_its_way, 0.0, push), -gains.lead, gains.lead)
        way, reach = self._raised - self._start, gains.ramp * inputs.since_target[:, None]
        return limit_position(arm, self._start + np.clip(way, -reach, reach) + self._integral + passing)


class Gain(NamedTuple):
    """One gain of a rival."""

    low: float
    """of the search"""
    high: float
    tuned: float


class Rival(NamedTuple):
    """A law, and its gains."""

    make: Callable[[Arm, Gains], Controller]
    gains: Mapping[str, Gain]

    @property
    def tuned(self) -> dict[str, float]:
        """By the search."""
        return {name: gain.tuned for name, gain in self.gains.items()}


_TABLE = read_shipped(__file__, "rivals.toml", dict[str, dict[str, Gain]])
RIVALS = {
    "pid-sum": Rival(lambda *_: PidController(literal=False), {}),
    "pid-literal": Rival(lambda *_: PidController(literal=True), {}),
    "tuned-feedforward": Rival(ScheduledController, _TABLE["tuned-feedforward"]),
}


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
    from cmaes import CMA  # type: ignore[import-untyped,unused-ignore]

    names = list(rival.gains)
    if not names:
        raise InputError("tune: this rival has the paper's gains, none are searched")
    low, high, _ = np.log(np.array(list(rival.gains.values()))).T
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
    """Cost (P,) [s] of ``gains`` (P,) on the same arms and targets, of seed and generation ``draw``."""
    from rejoint.twin.simulation import TwinRobot

    count = len(np.atleast_1d(next(iter(gains.values()))))
    rng = np.random.default_rng(draw)
    drawn = ranges.draw(rng, ARMS).rows(np.tile(np.arange(ARMS), count))
    targets = np.tile(arm.targets.sample(rng, (ARMS, TARGETS)), (count, 1, 1))
    robot = TwinRobot(arm, drawn, seed=draw[1], copies=count)
    controller = rival.make(arm, {name: np.repeat(value, ARMS)[:, None] for name, value in gains.items()})
    recording = run(robot, controller, targets, schedule("hold", PROTOCOL, keep_going=True))
    holds = metrics_of(arm, recording, targets, PROTOCOL)
    late = np.nan_to_num(holds["stay_2mm"], nan=PROTOCOL.hold)
    error = np.minimum(np.nan_to_num(holds["settled"], nan=np.inf), FARTHEST)
    return (late + WEIGHT * 1e3 * error).reshape(count, -1).mean(axis=1)
