"""Workspace of an arm: size, rest posture, targets, and room for a diagnosis.

Rest: random postures in front of the base, clear of floor and limits, scored by manipulability (Yoshikawa 1985),
mid-range, elbow height, heading and holding torque. Targets: the largest box that inverse kinematics reaches with
margins, at most 0.2 x 0.4 x 0.2 of the reach (Park et al. 2024, section IV-A). Constants in N m or mm are a myCobot
280's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array, Box
from rejoint.arms.catalogue import mycobot280
from rejoint.arms.inertia import LINK_RADIUS_RATIO, link_ends
from rejoint.arms.inverse import Solution, solve_position
from rejoint.arms.kinematics import Frames, frames, gravity_torque, position_kinematics, tcp_position
from rejoint.system.errors import InputError

SAMPLES = 4096
"""postures drawn (chosen)"""

EDGES = np.array([0.2, 0.4, 0.2])
"""largest edges over the reach (Park et al. 2024, section IV-A)"""

STEPS = 6
"""grid steps per edge (chosen)"""

LIMIT_MARGIN = 0.05
"""share of a joint's range from each limit, at targets (chosen)"""

REST_MARGIN = 0.15
"""the same at rest (chosen)"""

REST_HEIGHT = 0.18
"""of the TCP above the floor, over the reach (chosen)"""

AXIS_CLEARANCE = 0.15
"""of targets from the base axis, over the reach (chosen)"""

TORQUE_SHARE = 0.9
"""of the largest holding torque, at targets (chosen)"""

_RISING = 0.2
"""Share of postures that lift a joint frame (chosen)"""

_FLAT = 1e-6
"""manipulability over cubed reach on a surface (rounding)"""

_CANDIDATES, _SPREAD = 8, 16
"""start postures and their distance in rank"""
_CLIMB = 200
"""steps"""


def reach(arm: Arm) -> float:
    """Sum of link lengths [m] to the TCP."""
    return float(np.linalg.norm(link_ends(arm.offset, arm.tip), axis=1).sum())


@lru_cache(maxsize=32)
def rising_frames(arm: Arm, above: float = -np.inf) -> NDArray[np.bool_]:
    """Joint frames (n,) that change height, and are often ``above`` [m]."""
    postures = np.random.default_rng(0).uniform(arm.lower, arm.upper, (64, arm.joints))
    height = frames(arm, postures).position[..., 2]
    rising: NDArray[np.bool_] = (np.ptp(height, axis=0) > 1e-6) & ((height > above).mean(axis=0) > _RISING)
    rising.setflags(write=False)
    return rising


def on_a_surface(arm: Arm, seed: int = 0) -> bool:
    """Whether the TCP moves on a line or surface only."""
    survey = _survey(arm, seed)
    return survey.manipulability < _FLAT * survey.reach**3


def derive_targets(arm: Arm, seed: int = 0) -> Box:
    """Target region around the resting TCP; InputError."""
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
    """Rest postures (n,) [rad], targets, and whether those are wide, the best first.

    Postures keep ``apart`` (of the reach) more from the floor and ``margin`` [rad] from limits. InputError: none.
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
    """No rest posture with targets was found."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Survey:
    """Samples of the joint space."""

    arm: Arm
    reach: float
    """[m]"""
    low: Array
    high: Array
    """(n,) [rad] within half a turn each way"""
    postures: Array
    """(S, n) [rad]"""
    manipulability: float
    torque: float
    """[N m] largest of the samples"""
    apart: float = 0.0
    """extra distance from the floor, over the reach"""
    margin: float = 0.0
    """[rad] from the joint limits"""

    def clear(self, f: Frames) -> NDArray[np.bool_]:
        """Whether rising joint frames and TCP are a link radius above the floor (...)."""
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
    """Scores of postures (..., n); minus infinity: unusable."""
    arm, f = survey.arm, frames(survey.arm, q)
    tcp = f.tcp_position
    middle, half = (survey.high + survey.low) / 2, (survey.high - survey.low) / 2
    elbow = f.position[..., 2].max(axis=-1) - tcp[..., 2]
    distance = np.hypot(tcp[..., 0], tcp[..., 1])
    load = np.abs(gravity_torque(arm, q)).max(axis=-1)
    score = (
        _manipulability(arm, q) / max(survey.manipulability, 1e-12)
        + 1.0
        - (((q - middle) / half) ** 2).mean(axis=-1)
        + np.clip(elbow / (0.15 * survey.reach), 0.0, 1.0)
        + tcp[..., 0] / np.maximum(distance, 1e-9)
        + 1.0
        - load / max(survey.torque, 1e-12)
    )
    ahead = (tcp[..., 0] > 0) & (distance > 2 * AXIS_CLEARANCE * survey.reach)
    most = np.minimum((1 - 2 * REST_MARGIN) * half, np.maximum(half - survey.margin, 2 * LIMIT_MARGIN * half))
    inside = (np.abs(q - middle) <= most).all(axis=-1)
    high = tcp[..., 2] > arm.floor + (REST_HEIGHT + 2 * survey.apart) * survey.reach
    return np.where(survey.clear(f) & ahead & inside & high, score, -np.inf)


def _rest_candidates(survey: _Survey, seed: int) -> list[Array]:
    """Best postures (n,) [rad] in whole degrees, by random local search."""
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
    """Climb from ``posture`` (n,) [rad] in whole degrees."""
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
    """First and last index (3,) of the largest good box around the middle of a (2S+1)^3 grid."""
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
    corners = product((0, 1), repeat=3)
    ends = ((a[0], a[1] + 1), (b[0], b[1] + 1), (c[0], c[1] + 1))
    return int(sum((-1) ** (3 - i - j - k) * total[ends[0][i], ends[1][j], ends[2][k]] for i, j, k in corners))


UNLOADED = 0.03
"""Load over the largest of a joint without weight (chosen)"""


LEAST_LEVER = 0.02
"""Share of the reach per radian of a joint that only turns the tool (chosen)"""


METRES = 5e-3
"""[m] of coordinates in metres, not millimetres (chosen)"""


def in_metres(places: Array) -> bool:
    """Whether places (..., 3) [m], read in millimetres, were in metres."""
    known = np.abs(places[np.isfinite(places)])
    return known.size > 0 and bool((known < METRES).all())


@lru_cache(maxsize=32)
def heaviest_load(arm: Arm, per_edge: int = 2) -> Array:
    """Largest gravity torque (n,) [N m] over a grid of targets."""
    load: Array = np.abs(gravity_torque(arm, posture_grid(arm, per_edge).q)).max(axis=0)
    load.setflags(write=False)
    return load


def posture_grid(arm: Arm, per_edge: int) -> Solution:
    """Postures (per_edge^3, n) [rad] of a grid of targets."""
    axes = [np.linspace(low, high, per_edge) for low, high in zip(arm.targets.lower, arm.targets.upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return solve_position(arm, grid, arm.rest)


@lru_cache(maxsize=32)
def unloaded_joints(arm: Arm) -> NDArray[np.bool_]:
    """Joints (n,) without weight at any target."""
    load = heaviest_load(arm)
    mask: NDArray[np.bool_] = load < UNLOADED * load.max()
    mask.setflags(write=False)
    return mask


@lru_cache(maxsize=32)
def moves_tool(arm: Arm) -> NDArray[np.bool_]:
    """Joints (n,) that move the TCP at targets."""
    lever = np.linalg.norm(position_kinematics(arm, posture_grid(arm, 2).q)[1], axis=-2).max(axis=0)
    mask: NDArray[np.bool_] = lever > LEAST_LEVER * reach(arm)
    mask.setflags(write=False)
    return mask


@lru_cache(maxsize=32)
def torque_size(arm: Arm) -> float:
    """Largest load over that of a myCobot 280."""
    return float(heaviest_load(arm).max() / heaviest_load(reference_arm()).max())


@lru_cache(maxsize=32)
def length_size(arm: Arm) -> float:
    """Reach over that of a myCobot 280."""
    return reach(arm) / reach(reference_arm())


@lru_cache(maxsize=1)
def reference_arm() -> Arm:
    """Arm of the chosen constants."""
    return mycobot280()


SAFE_MARGIN = np.radians(10.0)
"""[rad] from joint limits (chosen: a worn arm overshoots)"""

CLEARANCE = 0.05
"""[m] above the floor (chosen)"""

COLUMN = 0.4
"""TCP from the base axis, over the resting reach (chosen)"""

LOAD_MARGIN = 0.02
"""[N m] (chosen)"""

EXCURSION = 0.25
"""[rad] of all joints about rest (chosen)"""

HOLD_SPREAD, HOLD_OFFSET = 0.7, 0.15
"""[rad] held postures from rest, and their approaches (chosen)"""

POSTURES = 400
"""Candidates to hold (chosen)"""

_LEAST = 0.25
"""Safe share of the excursions (chosen)"""

_LEAST_HOLDS = 0.1
"""Safe share around rest (chosen)"""

_CORNERS = 128
"""of the excursion (chosen)"""

_SEARCHES = ((0.0, 0.0), (0.05, 0.3), (0.1, 0.3))
"""Extra distances from floor (over the reach) and limits [rad] (chosen)"""

_STEPS = 0.8 ** np.arange(8)
"""(chosen)"""


def is_safe(arm: Arm, q: Array) -> NDArray[np.bool_]:
    """Which postures (..., n) [rad] are safe: away from limits, floor and column, lightly loaded."""
    near, low, heavy, sunk, inwards = _dangers(arm, q)
    return ~((near | low | heavy).any(axis=-1) | sunk | inwards)


def line_is_safe(arm: Arm, start: Array, goal: Array) -> NDArray[np.bool_]:
    """Which straight motions (..., n) stay safe."""
    share = np.linspace(0.0, 1.0, 12)[:, None]
    return np.asarray(is_safe(arm, start[..., None, :] + share * (goal - start)[..., None, :]).all(axis=-1))


def unsafe(arm: Arm, q: Array) -> str:
    """Why a posture (n,) [rad] is unsafe, or empty."""
    near, low, heavy, sunk, inwards = _dangers(arm, q)
    names, floor = np.array(arm.joint_names), 1e3 * (arm.floor + CLEARANCE * length_size(arm))
    causes = [
        (near.any(), f"{', '.join(names[near])} within {np.degrees(SAFE_MARGIN):.0f} deg of a limit"),
        (low.any(), f"the frame of {', '.join(names[low])} less than {floor:.0f} mm above the base"),
        (sunk, f"the TCP less than {floor:.0f} mm above the base"),
        (heavy.any(), f"more load on {', '.join(names[heavy])} than at any target"),
        (inwards, "the TCP too near to the base's vertical axis"),
    ]
    return ", ".join(cause for holds, cause in causes if holds)


def _dangers(arm: Arm, q: Array) -> tuple[NDArray[np.bool_], ...]:
    """Joints (..., n) near a limit, low, heavily loaded; whether (...) the TCP is low, or near the base's axis."""
    f, floor = frames(arm, q), arm.floor + CLEARANCE * length_size(arm)
    rest_reach = np.linalg.norm(tcp_position(arm, arm.rest)[:2])
    return (
        ~((q >= arm.lower + SAFE_MARGIN) & (q <= arm.upper - SAFE_MARGIN)),
        # Frames that never rise or sink, such as a shoulder on its column, may be anywhere.
        rising_frames(arm, floor) & (f.position[..., 2] < floor),
        np.abs(gravity_torque(arm, q)) > _most_load(arm),
        np.asarray(f.tcp_position[..., 2] < floor),
        np.asarray(np.linalg.norm(f.tcp_position[..., :2], axis=-1) < COLUMN * rest_reach),
    )


def room(arm: Arm, seed: int = 0) -> tuple[float, float]:
    """Safe shares (0 to 1) of the excursion and the spread about rest."""
    corners = np.array(list(product((-1.0, 1.0), repeat=min(arm.joints, 7))))
    if arm.joints > 7:
        corners = np.random.default_rng(seed).choice((-1.0, 1.0), (_CORNERS, arm.joints))
    whole = is_safe(arm, arm.rest + EXCURSION * _STEPS[:, None, None] * corners).all(axis=-1)
    excursion = float(max(_STEPS[whole], default=0.0))
    if excursion < _LEAST:
        return excursion, 0.0
    held = (
        share
        for share in _STEPS
        if len(postures_to_hold(arm, np.random.default_rng(seed), spread=share * HOLD_SPREAD))
        >= _LEAST_HOLDS * POSTURES
    )
    return excursion, float(next(held, 0.0))


def postures_to_hold(
    arm: Arm, rng: np.random.Generator, *, spread: float = HOLD_SPREAD, offset: float = HOLD_OFFSET
) -> Array:
    """Draw postures (k, n) [rad] around rest with safe approaches."""
    q = arm.rest + spread * rng.uniform(-1.0, 1.0, (POSTURES, arm.joints))
    for side in (-offset, offset):
        q = q[line_is_safe(arm, arm.rest, q + side) & line_is_safe(arm, q, q + side)]
    return q


def derive_workspace(arm: Arm, seed: int = 0) -> tuple[Array, Box]:
    """Rest posture (n,) [rad] and targets with room for an excitation; InputError."""
    best: tuple[float, Array, Box] | None = None
    why = ""
    for rest, box, wide in _tried(arm, seed):
        trial = replace(arm, rest=rest, targets=box)
        share, spread = room(trial, seed)
        if wide and share >= _LEAST and spread == 1.0:
            return rest, box
        why = why or unsafe(trial, rest) or "most postures around it are not safe"
        if min(share, spread) >= _LEAST:
            value = share * spread * float((box.upper - box.lower).prod())
            best = (value, rest, box) if best is None or value > best[0] else best
    if best is None:
        lack = f"has room for an excitation (of the best one: {why})" if why else "has a region of reachable targets"
        raise NoPostureError(
            f"arm {arm.name}: no posture with the TCP in front of the base (x > 0) {lack}; give rest_deg in the arm's "
            "TOML file"
        )
    return best[1], best[2]


def _tried(arm: Arm, seed: int) -> Iterator[tuple[Array, Box, bool]]:
    found, refused = False, None
    for apart, margin in _SEARCHES:
        try:
            for candidate in workspaces(arm, seed, apart=apart, margin=margin):
                found = True
                yield candidate
        except NoPostureError as error:
            refused = refused or error
    if refused is not None and not found:
        raise refused


def _most_load(arm: Arm) -> Array:
    """Return allowed load (n,) [N m]."""
    return heaviest_load(arm) + LOAD_MARGIN * torque_size(arm)
