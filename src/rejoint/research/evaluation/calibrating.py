"""What outside measurements bring: fresh arms are measured, calibrated, and sent to fresh targets.

All arms of a condition are one batch. Calibrations from the first 1, 3, ... measurements drive to the same targets:
in the target region, and anywhere that the worn arms reach and hold by their twins.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rejoint.arms import Arm, Array, Displacement
from rejoint.arms.kinematics import GRAVITY
from rejoint.arms.rotations import Orientation, rotation_about
from rejoint.control.controller import ControlInput, Controller
from rejoint.control.correction import Modelled
from rejoint.control.goal import Ways
from rejoint.control.loop import Schedule, run
from rejoint.control.recording import Recording
from rejoint.control.reference import TargetSequence
from rejoint.control.robot import Mask
from rejoint.control.start import play
from rejoint.control.targets import draw_targets
from rejoint.diagnosis.calibration.calibration import Calibration
from rejoint.diagnosis.calibration.fit import fit
from rejoint.diagnosis.calibration.measurements import Measurements
from rejoint.diagnosis.calibration.postures import Suggestion, suggest
from rejoint.pages.words import MM, measured, number
from rejoint.system.errors import InputError
from rejoint.system.progress import Progress, part
from rejoint.system.shell import __version__
from rejoint.system.statistics import Estimate, bootstrap_mean, clustered_share, wilson

POINTS = (1, 3, 5, 10, 20)
"""Numbers of measurements from which arms are calibrated"""
SIGMA = 5e-4
"""[m] noise of each measured coordinate (chosen: a vernier ruler)"""
WRONG = (5e-3, 10e-3)
"""[m] error of a wrong point (chosen)"""
WRONG_AMONG = 10
"""Measurements among which one is wrong"""
SPEED, WAIT = 0.5, 1.5
"""[rad/s] and [s]: speed to a posture, and wait before measuring (chosen)"""
HOLD, LAST = 8.0, 1.0
"""[s] at each target, and the end of it over which errors are averaged"""


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
    ArmCondition(
        name="misdescribed",
        meaning="worn arms, masses 15 % off, links off by 1 mm and 0.3 deg",
        mass=0.15,
        shift=1e-3,
        turn=np.radians(0.3),
    ),
    ArmCondition(name="healthy", meaning="healthy arms", profile="healthy"),
    ArmCondition(
        name="play-in-loop", meaning="worn arms whose encoders sit behind the gears' play", profile="play-in-loop"
    ),
)


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
            position=self.position[arm, :count],
            approach=self.approach[arm, :count],
            point=self.point[arm, :count],
            sigma=np.full(count, SIGMA),
            posture=self.posture[:count],
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class FreshTargets:
    """Targets of all arms in one part of the workspace."""

    name: str
    targets: Array
    """(A, K, 3) [m]"""
    ways: Ways | None = None
    """postures and ways there; None: the nearest posture at once"""


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
    used: NDArray[np.bool_]
    """(A,) whether the gate let the correction through"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Held:
    """All arms of a condition on the same fresh targets."""

    where: str
    before: Array
    """(A, K) [m] true error without calibration"""
    tried: tuple[Tried, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Trials:
    """All of one condition."""

    condition: ArmCondition
    held: tuple[Held, ...]
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
        arm,
        family_wears(arm, variant, family),
        address=f"emulated:{condition.name}",
        seed=family.seed,
        threads=threads,
        bodies=bodies,
        gravity=gravity,
    )


def misdescribed(arm: Arm, condition: ArmCondition, seed: int) -> Arm:
    """Draw an arm that differs from its description ``arm``."""
    rng = np.random.default_rng([seed, 2])
    twist = rng.normal(0.0, [condition.shift] * 3 + [condition.turn] * 3, (arm.joints + 1, 6))
    moved = replace(Displacement.none(arm), twist=twist).moved(arm)
    factor = 1.0 + condition.mass * rng.choice([-1.0, 1.0], arm.joints)
    return replace(moved, mass=arm.mass * factor, inertia=arm.inertia * factor[:, None, None])


def evaluate_calibrations(
    arm: Arm,
    conditions: Sequence[ArmCondition],
    contestant: Contestant,
    family: ArmFamily,
    folder: Path,
    threads: int,
    on_progress: Progress,
) -> CalibrationEvaluation:
    """Try calibrations under all conditions; twins of the worn arms are kept in ``folder``."""
    on_progress(0.0, "twins, for targets anywhere")
    box = draw_targets(arm, sets=family.arms, count=family.targets, seed=FAMILY_SIZE * (family.seed + 1) + 1)
    anywhere, ways = targets_anywhere(arm, family, own_twins(arm, family, folder))
    fresh = (
        FreshTargets(name="target region", targets=box),
        FreshTargets(name="anywhere", targets=anywhere, ways=ways),
    )
    ends = np.linspace(0.0, 1.0, len(conditions) + 1)
    trials = [
        try_condition(arm, one, contestant.make, family, fresh, threads, part(on_progress, *ends[i : i + 2]))
        for i, one in enumerate(conditions)
    ]
    return conclude(arm.name, contestant.name, family, trials)


def try_condition(
    arm: Arm,
    condition: ArmCondition,
    controller: Callable[[Arm], Controller],
    family: ArmFamily,
    fresh: Sequence[FreshTargets],
    threads: int,
    on_progress: Progress,
) -> Trials:
    """Measure, calibrate and drive all arms of a condition."""
    suggestion = suggest(arm, max(POINTS), visits=2, sigma=SIGMA)
    on_progress(0.0, f"{condition.name}: measuring")
    measured = measure(open_condition(arm, condition, family, threads), suggestion, family.seed)
    share = 1.0 / (len(POINTS) + 2)
    on_progress(share, f"{condition.name}: without calibration")
    before = [
        _errors(_hold(open_condition(arm, condition, family, threads), controller, one), family.targets)
        for one in fresh
    ]
    tried: list[list[Tried]] = [[] for _ in fresh]
    for step, points in enumerate(POINTS):
        on_progress((2 + step) * share, f"{condition.name}: {points} points")
        found = [fit(arm, measured.first(i, points)) for i in range(family.arms)]
        for one, done in zip(fresh, tried, strict=True):
            done.append(try_found(open_condition(arm, condition, family, threads), found, controller, one, points))
    held = [Held(where=a.name, before=b, tried=tuple(c)) for a, b, c in zip(fresh, before, tried, strict=True)]
    named, accused = find_wrong(arm, measured, family)
    return Trials(condition=condition, held=tuple(held), named=named, accused=accused)


def measure(robot: EmulatedRobot, suggestion: Suggestion, seed: int) -> Measured:
    """Bring all arms to the postures and measure their tools with noise."""
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
    """Tell for each arm whether a wrong point is named, and how many right ones are."""
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
    robot: EmulatedRobot,
    found: Sequence[Calibration],
    controller: Callable[[Arm], Controller],
    fresh: FreshTargets,
    points: int,
) -> Tried:
    """Send all arms, corrected by what was ``found``, to ``fresh`` targets."""
    recording, count = _hold(robot, controller, fresh, OwnCorrections(found)), fresh.targets.shape[1]
    error, settled = _errors(recording, count), _last(recording, recording.position, count)
    inside, expected = np.zeros(error.shape), np.zeros(error.shape)
    for i, calibration in enumerate(found):
        low, high = calibration.interval(settled[i], fresh.targets[i])
        inside[i], expected[i] = (error[i] >= low) & (error[i] <= high), calibration.sigma(settled[i])
    return Tried(
        points=points,
        error=error,
        inside=inside,
        expected=expected,
        used=np.array([one.used for one in found]),
    )


def _go(robot: EmulatedRobot, sent: Array, goal: Array) -> Array:
    """Bring all arms to ``goal`` (n,) [rad] and wait; returns the last command (B, n)."""
    way = goal - sent
    duration = float(np.abs(way).max()) / SPEED
    recording = play(robot, lambda time: sent + np.minimum(time / duration, 1.0)[:, None] * way, duration + WAIT)
    return recording.command[-1]


class OwnCorrections(Modelled):
    """Corrects the targets of each arm by its own calibration."""

    def __init__(self, found: Sequence[Calibration]) -> None:
        self._each = [Modelled(one.arm, one.displacement if one.used else Displacement.none(one.arm)) for one in found]

    def aim(
        self, target: Array, start: Array, where: Mask, near: Array | None = None, turn: Orientation | None = None
    ) -> tuple[Array, Orientation | None]:
        """Corrected targets (B, 3) [m]; points have no orientation."""
        rows = (target, start, where) if near is None else (target, start, where, near)
        each = zip(self._each, *(row[:, None] for row in rows), strict=True)
        return np.concatenate([one.aim(*own)[0] for one, *own in each]), turn

    def again(self, target: Array, inputs: ControlInput) -> Array | None:
        """Correct settled arms once more."""
        fresh, state = inputs.target.copy(), inputs.state
        for i, one in enumerate(self._each):
            own = replace(state, time=state.time[i : i + 1], position=state.position[i : i + 1])
            found = one.again(target[i : i + 1], replace(inputs, state=own, target=inputs.target[i : i + 1]))
            fresh[i] = fresh[i] if found is None else found[0]
        return None if (fresh == inputs.target).all() else fresh


def _hold(
    robot: EmulatedRobot,
    controller: Callable[[Arm], Controller],
    fresh: FreshTargets,
    correction: Modelled | None = None,
) -> Recording:
    reference = TargetSequence(robot.arm, fresh.targets, ways=fresh.ways, correction=correction)
    return run(robot, controller(robot.arm), reference, Schedule(dwell=HOLD, keep_going=True))


def _errors(recording: Recording, count: int) -> Array:
    """Return true errors (A, K) [m] over the last second at each target; NaN after a guard's stop."""
    return _last(recording, np.linalg.norm(recording.true_tcp - recording.target, axis=-1), count)


def _last(recording: Recording, values: Array, count: int) -> Array:
    """Return means (A, K, ...) of ``values`` (T, A, ...) over the same time."""
    late = recording.active & (recording.since_target > HOLD - LAST)
    found = np.full((values.shape[1], count, *values.shape[2:]), np.nan)
    for i, k in np.ndindex(*found.shape[:2]):
        rows = late[:, i] & (recording.target_index[:, i] == k)
        found[i, k] = values[rows, i].mean(axis=0) if rows.any() else np.nan
    return found


HEADERS = (
    "where",
    "points",
    "true error, mm",
    "95 % below, mm",
    "expected, mm",
    "in the interval, %",
    "corrected arms, %",
    "worst arm, mm farther off",
)


@dataclass(frozen=True, kw_only=True)
class CalibratedRow:
    """Arms of one condition, calibrated from so many points."""

    condition: str
    where: str
    """name of the part of the workspace"""
    points: int
    """0: not calibrated"""
    error: Estimate
    """[m] mean true error at fresh targets"""
    p95: float
    """[m]"""
    expected: float | None = None
    """[m] root mean square error by the calibrations themselves"""
    inside: Estimate | None = None
    """share of targets whose true error was in the calibration's interval"""
    used: float | None = None
    """share of the arms that were corrected"""
    harm: float | None = None
    """[m] largest difference of an arm's mean error from that without calibration"""


@dataclass(frozen=True, kw_only=True)
class CalibrationEvaluation:
    """All conditions."""

    arm: str
    software: str
    controller: str
    family: ArmFamily
    meanings: dict[str, str]
    rows: tuple[CalibratedRow, ...]
    named: dict[str, Estimate]
    """by condition: share of arms whose wrong point was named first"""
    accused: dict[str, Estimate]
    """by condition: share of arms with a right point named"""


def rows_of(condition: str, held: Held) -> list[CalibratedRow]:
    """Sum up one condition on the same targets; intervals resample arms."""
    before = held.before
    rows = [CalibratedRow(condition=condition, where=held.where, points=0, error=_mean(before), p95=_p95(before))]
    for tried in held.tried:
        arms = np.repeat(np.arange(len(tried.error)), tried.error.shape[1])
        known = np.where(np.isfinite(tried.error), tried.inside, np.nan)
        harm = np.nanmax(np.nanmean(tried.error, axis=1) - np.nanmean(before, axis=1))
        row = replace(
            rows[0],
            points=tried.points,
            error=_mean(tried.error),
            p95=_p95(tried.error),
            expected=float(np.sqrt(np.nanmean(tried.expected**2))),
            inside=clustered_share(known.ravel(), arms),
            used=float(tried.used.mean()),
            harm=float(harm),
        )
        rows.append(row)
    return rows


def shares_of(trials: Trials) -> tuple[Estimate, Estimate]:
    """Return the shares of arms with the wrong point named, and with a right one."""
    count = len(trials.named)
    return wilson(float(trials.named.sum()), count), wilson(float((trials.accused > 0).sum()), count)


def tables(result: CalibrationEvaluation) -> list[tuple[str, list[str], list[list[str]]]]:
    """Title, headers and rows of each table."""
    found = []
    for name, meaning in result.meanings.items():
        cells = [_cells(row) for row in result.rows if row.condition == name]
        found.append((f"{meaning}: {result.family.arms}, {result.controller}", list(HEADERS), cells))
    wrong = [[name, _words(result.named[name], 100), _words(result.accused[name], 100)] for name in result.meanings]
    headers = ["condition", "wrong point named, % of arms", "right point named, % of arms"]
    return [*found, ("One wrong point among ten, 5 to 10 mm off", headers, wrong)]


def _cells(row: CalibratedRow) -> list[str]:
    cells = [row.where, str(row.points or "none"), _words(row.error), number(row.p95 * MM, 3)]
    if row.expected is None or row.inside is None or row.used is None or row.harm is None:
        return [*cells, "", "", "", ""]
    return [
        *cells,
        number(row.expected * MM, 3),
        _words(row.inside, 100),
        number(100 * row.used, 3),
        f"{row.harm * MM:+.2f}",
    ]


def _words(estimate: Estimate, factor: float = MM) -> str:
    text, note = measured(estimate, factor, 3)
    return f"{text} ({note})" if note else text


def _mean(errors: Array) -> Estimate:
    return bootstrap_mean(errors.ravel(), np.repeat(np.arange(len(errors)), errors.shape[1]))


def _p95(errors: Array) -> float:
    return float(np.nanquantile(errors, 0.95))


def conclude(arm: str, controller: str, family: ArmFamily, trials: Sequence[Trials]) -> CalibrationEvaluation:
    """Put conditions together."""
    shares = {one.condition.name: shares_of(one) for one in trials}
    return CalibrationEvaluation(
        arm=arm,
        software=__version__,
        controller=controller,
        family=family,
        meanings={one.condition.name: one.condition.meaning for one in trials},
        rows=tuple(row for one in trials for held in one.held for row in rows_of(one.condition.name, held)),
        named={name: named for name, (named, _) in shares.items()},
        accused={name: accused for name, (_, accused) in shares.items()},
    )
