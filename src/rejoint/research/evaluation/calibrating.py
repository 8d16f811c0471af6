"""What outside measurements bring: arms that nothing was chosen on are measured, calibrated, and sent to fresh targets.

All arms of a condition are one batch in virtual time. They visit the suggested postures once; calibrations from the
first 1, 2, ... of these measurements are then tried on the same fresh targets, with the same controller.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Displacement, solve_position
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.rotations import rotation_about
from rejoint.control.comparison.targets import draw_targets
from rejoint.control.controller import Controller
from rejoint.control.loop import Schedule, run
from rejoint.control.playback import play
from rejoint.control.recording import Recording
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.postures import Suggestion, suggest
from rejoint.research.evaluation.family import FAMILY_SIZE, ArmFamily, Variant, family_wears
from rejoint.robots.emulated import EmulatedRobot
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress

POINTS = (1, 3, 5, 10, 20)
"""Numbers of measurements from which arms are calibrated"""
SIGMA = 5e-4
"""[m] noise of each measured coordinate (chosen: a ruler with a vernier, or a touched dimple)"""
WRONG = (5e-3, 10e-3)
"""[m] by how much a wrong point is off (chosen: a swapped dimple, or a slipped pen)"""
WRONG_AMONG = 10
"""Measurements among which one is wrong"""
SPEED, WAIT = 0.5, 1.5
"""[rad/s] and [s]: how fast arms go to a posture, and how long they wait before they are measured (chosen)"""
HOLD, LAST = 8.0, 1.0
"""[s] at each fresh target, and of that at the end over which errors are averaged"""


@dataclass(frozen=True, kw_only=True)
class ArmCondition:
    """What the arms and their base are like."""

    name: str
    meaning: str
    profile: str = "worn"
    tilt: float = 0.0
    """[rad] by which the base stands askew, to the side"""
    mass: float = 0.0
    """share by which the mass of each link is off, up or down"""
    shift: float = 0.0
    """[m] standard deviation of each coordinate of the errors of the links"""
    turn: float = 0.0
    """[rad] the same of the angles"""


CONDITIONS = (
    ArmCondition(name="worn", meaning="worn arms"),
    ArmCondition(name="askew", meaning="worn arms on a base tilted by 8 degrees", tilt=np.radians(8.0)),
    ArmCondition(name="wedge", meaning="worn arms on a base raised by 2 degrees on one side", tilt=np.radians(2.0)),
    ArmCondition(name="misdescribed", meaning="worn arms, masses 15 % off, links off by 1 mm and 0.3 deg", mass=0.15,
              shift=1e-3, turn=np.radians(0.3)),
    ArmCondition(name="healthy", meaning="healthy arms", profile="healthy"),
    ArmCondition(name="play-in-loop", meaning="worn arms whose encoders sit behind the gears' play",
              profile="play-in-loop"),
)  # fmt: skip


def find_condition(name: str) -> ArmCondition:
    """Look up a condition; InputError names the alternatives."""
    for condition in CONDITIONS:
        if condition.name == name:
            return condition
    raise InputError(f"no condition is called {name!r}; known conditions: {', '.join(c.name for c in CONDITIONS)}")


@dataclass(frozen=True, kw_only=True, eq=False)
class Measured:
    """What was measured on A arms at P postures."""

    position: Array
    """(A, P, n) [rad] encoders"""
    approach: Array
    """(A, P, n) [rad] encoders before the last motion"""
    point: Array
    """(A, P, 3) [m] with noise"""
    posture: NDArray[np.int64]
    """(P,) numbers of the postures"""

    def first(self, arm: int, count: int) -> Measurements:
        """Return the first measurements of one arm."""
        return Measurements(
            position=self.position[arm, :count], approach=self.approach[arm, :count], point=self.point[arm, :count],
            sigma=np.full(count, SIGMA), posture=self.posture[:count],
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class Tried:
    """Calibrations from so many points on fresh targets."""

    points: int
    error: Array
    """(A, K) [m] true error at rest"""
    inside: Array
    """(A, K) whether the interval of the calibration held it"""
    expected: Array
    """(A, K) [m] root mean square error by the calibration"""
    left_out: Array
    """(A,) [m] mean error at measured points, each predicted from the others"""
    used: NDArray[np.bool_]
    """(A,) whether the gate let the correction through"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Trials:
    """All of one condition."""

    condition: ArmCondition
    wear_seed: Array
    """(A,)"""
    before: Array
    """(A, K) [m] true error without calibration"""
    tried: tuple[Tried, ...]
    named: NDArray[np.bool_]
    """(A,) whether the wrong point among ten was named"""
    accused: NDArray[np.int64]
    """(A,) right points that were named among ten without a wrong one"""


def open_condition(arm: Arm, condition: ArmCondition, family: ArmFamily, threads: int) -> EmulatedRobot:
    """All arms of a condition as one batch."""
    variant = Variant(name=condition.name, meaning=condition.meaning, profile=condition.profile)
    gravity = rotation_about(np.array([1.0, 0.0, 0.0]), condition.tilt) @ GRAVITY
    bodies = None
    if condition.mass or condition.shift or condition.turn:
        bodies = [misdescribed(arm, condition, family.wear_seed(i)) for i in range(family.arms)]
    return EmulatedRobot(
        arm, family_wears(arm, variant, family), address=f"emulated:{condition.name}", seed=family.seed,
        threads=threads, bodies=bodies, gravity=gravity,
    )  # fmt: skip


def misdescribed(arm: Arm, condition: ArmCondition, seed: int) -> Arm:
    """Draw an arm that differs from its description ``arm``; each mass is off, up or down."""
    rng = np.random.default_rng([seed, 2])
    twist = rng.normal(0.0, [condition.shift] * 3 + [condition.turn] * 3, (arm.joints + 1, 6))
    moved = replace(Displacement.none(arm), twist=twist).moved(arm)
    factor = 1.0 + condition.mass * rng.choice([-1.0, 1.0], arm.joints)
    return replace(moved, mass=arm.mass * factor, inertia=arm.inertia * factor[:, None, None])


def try_condition(
    arm: Arm, condition: ArmCondition, controller: Callable[[Arm], Controller], family: ArmFamily, threads: int,
    on_progress: Progress,
) -> Trials:  # fmt: skip
    """Measure, calibrate and drive all arms of a condition."""
    suggestion = suggest(arm, max(POINTS), visits=2, sigma=SIGMA)
    targets = draw_targets(arm, sets=family.arms, count=family.targets, seed=FAMILY_SIZE * (family.seed + 1) + 1)
    on_progress(0.0, f"{condition.name}: measuring")
    measured = measure(open_condition(arm, condition, family, threads), suggestion, family.seed)
    tried: list[Tried] = []
    share = 1.0 / (len(POINTS) + 2)
    on_progress(share, f"{condition.name}: without calibration")
    before = _errors(_hold(open_condition(arm, condition, family, threads), controller, targets), targets)
    for step, points in enumerate(POINTS):
        on_progress((2 + step) * share, f"{condition.name}: {points} points")
        found = [fit(arm, measured.first(i, points)) for i in range(family.arms)]
        robot = open_condition(arm, condition, family, threads)
        tried.append(try_found(robot, found, controller, targets, points))
    named, accused = find_wrong(arm, measured, family)
    seeds = np.array([family.wear_seed(i) for i in range(family.arms)], dtype=float)
    return Trials(condition=condition, wear_seed=seeds, before=before, tried=tuple(tried), named=named, accused=accused)


def measure(robot: EmulatedRobot, suggestion: Suggestion, seed: int) -> Measured:
    """Bring all arms to the postures, each from its own side, and measure their tools with noise."""
    rng = np.random.default_rng([seed, 3])
    sent, found = robot.read().position, []
    for place, start in zip(suggestion.postures, suggestion.approach, strict=True):
        for goal in (start, place):
            came, sent = robot.read().position, _go(robot, sent, goal)
        last = [robot.step(sent).position for _ in range(8)]
        point = robot.true_tcp() + rng.normal(0.0, SIGMA, (robot.count, 3))
        found.append((np.mean(last, axis=0), came, point))
    position, approach, point = (np.stack(parts, axis=1) for parts in zip(*found, strict=True))
    return Measured(position=position, approach=approach, point=point, posture=suggestion.posture)


def find_wrong(arm: Arm, measured: Measured, family: ArmFamily) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Tell for each arm whether a wrong point is named, and how many right ones are where none is wrong."""
    named, accused = np.zeros(family.arms, dtype=bool), np.zeros(family.arms, dtype=np.int64)
    for i in range(family.arms):
        rng = np.random.default_rng([family.wear_seed(i), 4])
        right = measured.first(i, WRONG_AMONG)
        row, away = int(rng.integers(WRONG_AMONG)), rng.normal(size=3)
        point = right.point.copy()
        point[row] += away * rng.uniform(*WRONG) / np.linalg.norm(away)
        accused[i] = len(fit(arm, right).suspects)
        named[i] = fit(arm, replace(right, point=point)).suspects[:1] == (row,)
    return named, accused


def try_found(
    robot: EmulatedRobot, found: Sequence[Calibration], controller: Callable[[Arm], Controller], targets: Array,
    points: int,
) -> Tried:  # fmt: skip
    """Send all arms, aimed by what was ``found`` of each, to ``targets`` (A, K, 3) [m]."""
    arm, aims = robot.arm, np.empty_like(targets)
    for i, calibration in enumerate(found):
        came = arm.rest
        for k, target in enumerate(targets[i]):
            aims[i, k] = calibration.aim(target, came)
            came = solve_position(arm, aims[i, k], came).q
    recording = _hold(robot, controller, aims)
    error, settled = _errors(recording, targets), _settled(recording, targets.shape[1])
    came = np.concatenate([np.broadcast_to(arm.rest, settled[:, :1].shape), settled[:, :-1]], axis=1)
    inside, expected = np.zeros(error.shape), np.zeros(error.shape)
    for i, calibration in enumerate(found):
        low, high = calibration.interval(settled[i], targets[i], came[i])
        inside[i], expected[i] = (error[i] >= low) & (error[i] <= high), calibration.sigma(settled[i])
    return Tried(
        points=points, error=error, inside=inside, expected=expected,
        left_out=np.array([one.after for one in found]), used=np.array([one.used for one in found]),
    )  # fmt: skip


def _go(robot: EmulatedRobot, sent: Array, goal: Array) -> Array:
    """Bring all arms to ``goal`` (n,) [rad] and wait; returns what was sent last (B, n)."""
    way = goal - sent
    duration = float(np.abs(way).max()) / SPEED
    recording = play(robot, lambda time: sent + np.minimum(time / duration, 1.0)[:, None] * way, duration + WAIT)
    return recording.command[-1]


def _hold(robot: EmulatedRobot, controller: Callable[[Arm], Controller], aims: Array) -> Recording:
    return run(robot, controller(robot.arm), aims, Schedule(dwell=HOLD, keep_going=True))


def _errors(recording: Recording, targets: Array) -> Array:
    """Return true errors (A, K) [m] over the last second at each target; NaN where the guard stopped the arm before."""
    return _over_last(recording, targets.shape[1], lambda rows, i, k: float(
        np.linalg.norm(recording.true_tcp[rows, i] - targets[i, k], axis=-1).mean()
    ))[..., 0]  # fmt: skip


def _settled(recording: Recording, count: int) -> Array:
    """Return encoder positions (A, K, n) [rad] over the same time."""
    return _over_last(recording, count, lambda rows, i, _: recording.position[rows, i].mean(axis=0))


def _over_last(recording: Recording, count: int, value: Callable[[NDArray[np.intp], int, int], Array | float]) -> Array:
    found = []
    for i in range(recording.position.shape[1]):
        for k in range(count):
            rows = np.flatnonzero(recording.active[:, i] & (recording.target_index[:, i] == k))
            since = recording.since_target[rows, i]
            done = len(rows) > 0 and since[-1] > HOLD - LAST
            found.append(np.atleast_1d(value(rows[since > HOLD - LAST], i, k)) if done else None)
    size = max((len(one) for one in found if one is not None), default=1)
    flat = np.array([np.full(size, np.nan) if one is None else one for one in found])
    return flat.reshape(recording.position.shape[1], count, size)
