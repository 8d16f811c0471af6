"""Where an arm works well: a rest posture and a region of reachable targets, derived by sampling.

Rest. Postures are drawn uniformly within the joint limits with a fixed seed. Those with the TCP in
front of the base (x > 0, the axis that REP 103 calls forward) and well above the floor, every joint frame that can rise
clear of the floor and every joint clear of its limits are scored by the sum of five terms between 0 and 1:
manipulability (Yoshikawa 1985, det(JJ')^1/2 over the largest seen), nearness to mid-range, an elbow
above the TCP, a TCP straight ahead, and little holding torque against gravity. Weights are equal
(chosen). The best are improved by a random local search and then by one in whole degrees. Which of them is taken is
decided in :mod:`rejoint.arms.room`.

Targets. Inverse kinematics is solved from the rest posture on a grid around the rest TCP. A grid
point is good when it is reached, every joint keeps a margin from its limits, the rising joint
frames are clear of the floor, the TCP stays away from the base's axis and no joint is near
the arm's largest holding torque. The region is the largest box of good points that holds the rest
TCP and has at most the edges that Park et al. 2024 (section IV-A) use, in proportion to the arm:
0.2 x 0.4 x 0.2 of the summed link lengths, rounded inwards to millimetres. It is verified on another
grid, and drawn towards the rest TCP until that holds. For the myCobot 280 this finds
x 145..248, y -107..100, z 120..224 mm, where the paper has 130..230, -100..100, 150..250 (measured).
Self-collision is not looked at.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array, Box
from rejoint.arms.inertia import LINK_RADIUS_RATIO, link_ends
from rejoint.arms.inverse import solve_position
from rejoint.arms.kinematics import Frames, frames, gravity_torque, position_kinematics
from rejoint.system.errors import InputError

SAMPLES = 4096
"""postures drawn (chosen; the best score changes by less than 1 % with the seed or four times as many, measured)"""

EDGES = np.array([0.2, 0.4, 0.2])
"""largest edges of the target region by the summed link lengths (Park et al. 2024, section IV-A: 100 x 200 x 100 mm
on an arm of 521 mm)"""

STEPS = 6
"""grid steps to an edge of the largest region (chosen)"""

LIMIT_MARGIN = 0.05
"""part of a joint's range that targets keep from each limit (chosen)"""

REST_MARGIN = 0.15
"""the same for the rest posture (chosen: targets around it need room)"""

REST_HEIGHT = 0.18
"""least height of the rest posture's TCP above the floor by the summed link lengths (chosen: steps of 0.2 rad in a
shoulder half of that length away lower the TCP by half of it)"""

AXIS_CLEARANCE = 0.15
"""least distance of targets from the base's vertical axis, by the summed link lengths (chosen: outside the column)"""

TORQUE_SHARE = 0.9
"""part of the largest holding torque that targets may need (chosen)"""

_RISING = 0.2
"""Share of postures that lifts a joint frame that is to be above the floor (chosen: frames beyond a shoulder have 0.3
and more on the 53 arms of `python -m benchmarks.arms`, those that a waist can tilt by some degrees have less)"""

_FLAT = 1e-6
"""manipulability by the cube of the summed link lengths below which no posture moves the TCP in space (rounding)"""

_CANDIDATES, _SPREAD = 8, 16
"""start postures of the search, and their distance in rank, so that they lie apart"""
_CLIMB = 200
"""steps of the search in whole degrees; it ends earlier, at the top"""


def reach(arm: Arm) -> float:
    """Add up the link lengths [m] from the first joint to the TCP."""
    return float(np.linalg.norm(link_ends(arm.offset, arm.tip), axis=1).sum())


@lru_cache(maxsize=32)
def rising_frames(arm: Arm, above: float = -np.inf) -> NDArray[np.bool_]:
    """Tell which joint frames (n,) have a height that depends on the posture: a shoulder on a column has not.

    Only those count that a fair share of postures lifts ``above`` a height [m]: of the others that cannot be asked.
    """
    postures = np.random.default_rng(0).uniform(arm.lower, arm.upper, (64, arm.joints))
    height = frames(arm, postures).position[..., 2]
    rising: NDArray[np.bool_] = (np.ptp(height, axis=0) > 1e-6) & ((height > above).mean(axis=0) > _RISING)
    rising.setflags(write=False)
    return rising


def on_a_surface(arm: Arm, seed: int = 0) -> bool:
    """Tell whether the joints move the TCP on a line or a surface only: then there is no region of targets."""
    survey = _survey(arm, seed)
    return survey.manipulability < _FLAT * survey.reach**3


def derive_targets(arm: Arm, seed: int = 0) -> Box:
    """Find the region of reachable targets around the TCP of ``arm.rest``; InputError if there is none."""
    found = _largest_box(_survey(arm, seed))
    if found is None:
        raise NoPostureError(
            f"arm {arm.name}: no region of reachable targets around the rest posture was found; "
            "give targets in the arm's TOML file, or another rest_deg"
        )
    return found


def workspaces(
    arm: Arm, seed: int = 0, *, apart: float = 0.0, margin: float = 0.0
) -> Iterator[tuple[Array, Box, bool]]:
    """Rest postures (n,) [rad] with their regions of targets, the best-scored first, and whether a region is wide.

    A wide region has at least half of the largest edges. Postures keep farther from the floor, by ``apart`` of the
    summed link lengths, and ``margin`` [rad] from the limits of every joint. InputError where the arm cannot move its
    TCP in space, or has no such posture.
    """
    survey = replace(_survey(arm, seed), apart=apart, margin=margin)
    if survey.manipulability < _FLAT * survey.reach**3:
        raise InputError(
            f"arm {arm.name}: its {arm.joints} joints move the TCP on a line or a surface only, and targets are points "
            "in space; choose a base and a tip with at least three joints between them that do not all lie in parallel"
        )
    for rest in _rest_candidates(survey, seed):
        box = _largest_box(replace(survey, arm=replace(arm, rest=rest), apart=0.0))
        if box is not None:
            yield rest, box, bool((box.upper - box.lower >= 0.5 * EDGES * survey.reach).all())


class NoPostureError(InputError):
    """No rest posture with a region of targets could be derived; an owner who knows one can give it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Survey:
    """What sampling the whole joint space tells."""

    arm: Arm
    reach: float
    """[m]"""
    low: Array
    high: Array
    """(n,) [rad] limits, no wider than half a turn each way"""
    postures: Array
    """(S, n) [rad]"""
    manipulability: float
    torque: float
    """[N m] the largest values over the samples"""
    apart: float = 0.0
    """share of the reach by which rest postures keep farther from the floor"""
    margin: float = 0.0
    """[rad] that they keep from the joint limits at least"""

    def clear(self, f: Frames) -> NDArray[np.bool_]:
        """Tell whether the rising joint frames and the TCP are a link's radius above the floor; ``(...)``."""
        height = self.arm.floor + (LINK_RADIUS_RATIO + self.apart) * self.reach
        frames_clear = (f.position[..., rising_frames(self.arm, height), 2] > height).all(axis=-1)
        return frames_clear & (f.tcp_position[..., 2] > height)


def _survey(arm: Arm, seed: int) -> _Survey:
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    low, high = np.where(low < high, low, arm.lower), np.where(low < high, high, arm.upper)
    postures = np.random.default_rng(seed).uniform(low, high, (SAMPLES, arm.joints))
    return _Survey(
        arm=arm,
        reach=reach(arm),
        low=low,
        high=high,
        postures=postures,
        manipulability=float(_manipulability(arm, postures).max()),
        torque=float(np.abs(gravity_torque(arm, postures)).max()),
    )


def _manipulability(arm: Arm, q: Array) -> Array:
    j = position_kinematics(arm, q)[1]
    return np.sqrt(np.maximum(np.linalg.det(j @ np.swapaxes(j, -1, -2)), 0.0))


def _score(survey: _Survey, q: Array) -> Array:
    """Score postures (..., n); minus infinity where a limit or the floor is near or the TCP is not in front."""
    arm, f = survey.arm, frames(survey.arm, q)
    tcp = f.tcp_position
    middle, half = (survey.high + survey.low) / 2, (survey.high - survey.low) / 2
    elbow = f.position[..., 2].max(axis=-1) - tcp[..., 2]
    distance = np.hypot(tcp[..., 0], tcp[..., 1])
    load = np.abs(gravity_torque(arm, q)).max(axis=-1)
    score = (
        _manipulability(arm, q) / max(survey.manipulability, 1e-12)
        + 1.0 - (((q - middle) / half) ** 2).mean(axis=-1)
        + np.clip(elbow / (0.15 * survey.reach), 0.0, 1.0)
        + tcp[..., 0] / np.maximum(distance, 1e-9)
        + 1.0 - load / max(survey.torque, 1e-12)
    )  # fmt: skip
    ahead = (tcp[..., 0] > 0) & (distance > 2 * AXIS_CLEARANCE * survey.reach)
    most = np.minimum((1 - 2 * REST_MARGIN) * half, np.maximum(half - survey.margin, 2 * LIMIT_MARGIN * half))
    inside = (np.abs(q - middle) <= most).all(axis=-1)
    high = tcp[..., 2] > arm.floor + (REST_HEIGHT + 2 * survey.apart) * survey.reach
    return np.where(survey.clear(f) & ahead & inside & high, score, -np.inf)


def _rest_candidates(survey: _Survey, seed: int) -> list[Array]:
    """Best postures (n,) [rad] in whole degrees, improved by a random local search, best first."""
    scores = _score(survey, survey.postures)
    order = np.argsort(-scores, kind="stable")[: _CANDIDATES * _SPREAD : _SPREAD]
    best, value = survey.postures[order], scores[order]
    rng = np.random.default_rng(seed + 1)
    for width in np.geomspace(0.2, 0.005, 40):
        trial = best + width * (survey.high - survey.low) * rng.normal(size=(16, *best.shape))
        trial = np.clip(trial, survey.low, survey.high)
        found = _score(survey, trial)
        choice, every = found.argmax(axis=0), np.arange(len(best))
        better = found[choice, every] > value
        best = np.where(better[:, None], trial[choice, every], best)
        value = np.where(better, found[choice, every], value)
    rounded = np.unique([_whole_degrees(survey, posture) for posture in best], axis=0)
    value = _score(survey, rounded)
    ranked = [rounded[i] for i in np.argsort(-value, kind="stable") if np.isfinite(value[i])]
    if not ranked:
        raise NoPostureError(
            f"arm {survey.arm.name}: no posture has the TCP in front (x > 0), every joint frame above the floor "
            "and room in every joint; give rest_deg in the arm's TOML file"
        )
    return ranked


def _whole_degrees(survey: _Survey, posture: Array) -> Array:
    """Climb from ``posture`` (n,) [rad] to the best score among its neighbours in whole degrees."""
    low, high = np.ceil(np.degrees(survey.low)), np.floor(np.degrees(survey.high))
    here = np.clip(np.rint(np.degrees(posture)), low, high) + 0.0
    unit = np.eye(len(here))
    ways = np.concatenate([unit, *(unit + np.roll(unit, k, axis=1) for k in range(1, len(here)))])
    ways = np.concatenate([ways, *(unit - np.roll(unit, k, axis=1) for k in range(1, len(here)))])
    moves = np.concatenate([size * ways for size in (-20.0, -5.0, -1.0, 1.0, 5.0, 20.0)])
    value = _score(survey, np.radians(here))
    for _ in range(_CLIMB):
        neighbours = np.clip(here + moves, low, high)
        scores = _score(survey, np.radians(neighbours))
        if not scores.max() > value + 1e-9:
            break
        here, value = neighbours[scores.argmax()], scores.max()
    return np.radians(here)


def _good(survey: _Survey, points: Array, iterations: int = 60) -> NDArray[np.bool_]:
    arm = survey.arm
    solution = solve_position(arm, points, arm.rest, tolerance=1e-4 * survey.reach, iterations=iterations)
    margin = LIMIT_MARGIN * (arm.upper - arm.lower)
    inside = ((solution.q > arm.lower + margin) & (solution.q < arm.upper - margin)).all(axis=-1)
    load = np.abs(gravity_torque(arm, solution.q)).max(axis=-1)
    away = np.hypot(points[..., 0], points[..., 1]) > AXIS_CLEARANCE * survey.reach
    clear = survey.clear(frames(arm, solution.q))
    return solution.converged & inside & clear & away & (load <= TORQUE_SHARE * survey.torque)


def _largest_box(survey: _Survey) -> Box | None:
    centre = frames(survey.arm, survey.arm.rest).tcp_position
    step = EDGES * survey.reach / STEPS
    ticks = np.arange(-STEPS, STEPS + 1)
    grid = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), axis=-1)
    span = _largest_span(_good(survey, centre + grid * step))
    if span is None:
        return None
    lower, upper = centre + (span[0] - STEPS) * step, centre + (span[1] - STEPS) * step
    for _ in range(10):
        lower, upper = np.ceil(lower * 1e3) / 1e3, np.floor(upper * 1e3) / 1e3
        points = np.stack(np.meshgrid(*np.linspace(lower, upper, 8).T, indexing="ij"), axis=-1)
        if (upper - lower).min() <= 0:
            return None
        if _good(survey, points, 200).all():
            return Box(lower=lower, upper=upper)
        lower, upper = lower + 0.06 * (centre - lower), upper + 0.06 * (centre - upper)
    return None


def _largest_span(good: NDArray[np.bool_]) -> tuple[NDArray[np.int_], NDArray[np.int_]] | None:
    """First and last index (3,) of the largest all-good box of a (2S+1)^3 grid that holds its middle point.

    Edges are at most S steps and at least one. Of equally large boxes the one whose middle is nearest
    to the grid's is taken.
    """
    total = np.zeros(tuple(np.array(good.shape) + 1), dtype=int)
    total[1:, 1:, 1:] = good.cumsum(0).cumsum(1).cumsum(2)
    intervals = [(i, j) for i in range(STEPS + 1) for j in range(STEPS, 2 * STEPS + 1) if 1 <= j - i <= STEPS]
    best, span = (0, 0), None
    for a, b, c in product(intervals, repeat=3):
        edges = (a[1] - a[0]) * (b[1] - b[0]) * (c[1] - c[0])
        skew = sum((i + j - 2 * STEPS) ** 2 for i, j in (a, b, c))
        if (edges, -skew) <= best:
            continue
        volume = (a[1] - a[0] + 1) * (b[1] - b[0] + 1) * (c[1] - c[0] + 1)
        if _count(total, a, b, c) == volume:
            best, span = (edges, -skew), (np.array([a[0], b[0], c[0]]), np.array([a[1], b[1], c[1]]))
    return span


def _count(total: NDArray[np.int_], a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> int:
    """Good points of a box of the grid, from the running totals (inclusion and exclusion)."""
    corners = product((0, 1), repeat=3)
    ends = ((a[0], a[1] + 1), (b[0], b[1] + 1), (c[0], c[1] + 1))
    return int(sum((-1) ** (3 - i - j - k) * total[ends[0][i], ends[1][j], ends[2][k]] for i, j, k in corners))
