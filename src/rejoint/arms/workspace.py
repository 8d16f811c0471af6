"""Workspace of an arm: size, rest posture, targets, and room for a diagnosis.

Rest: the best of random postures in front of the base by manipulability (Yoshikawa 1985), mid-range, elbow height,
heading and holding torque. Targets: the largest box that inverse kinematics reaches with margins, at most 0.2 x 0.4 x
0.2 of the reach (Park et al. 2024, section IV-A). Constants in N m or mm are a myCobot 280's.
"""

from dataclasses import replace
from functools import lru_cache
from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from rejoint.arms.arm import Arm, Array, Box, Mask, frozen, mycobot280
from rejoint.arms.inertia import LINK_RADIUS_RATIO, link_ends
from rejoint.arms.kinematics import (
    GRAVITY,
    Frames,
    Solution,
    frames,
    gravity_torque,
    heights,
    levers,
    position_kinematics,
    solve_position,
    tcp_position,
)
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
_CLIMB = 60
"""steps (chosen)"""


def reach(arm: Arm) -> float:
    """Sum of link lengths [m] to the TCP."""
    return float(np.linalg.norm(link_ends(arm), axis=1).sum())


@lru_cache
def rising_frames(arm: Arm, above: float = -np.inf) -> Mask:
    """Joint frames (n,) that change height, and are often ``above`` [m]."""
    height = heights(arm, arm.drawn(64))[:, :-1]
    return frozen((np.ptp(height, axis=0) > 1e-6) & ((height > above).mean(axis=0) > _RISING))


def on_a_surface(arm: Arm) -> bool:
    """Whether the TCP moves on a line or surface only."""
    survey = _survey(arm)
    return survey.manipulability < _FLAT * survey.reach**3


def derive_targets(arm: Arm) -> tuple[Array, Box]:
    """Rest posture (n,) [rad] of the arm, and a target region around the resting TCP; InputError."""
    if (found := _largest_box(_survey(arm), arm.rest)) is None:
        raise InputError(
            "around the rest posture there is no region to drive the TCP to, as where joints move it on a line or a "
            "surface only"
        )
    return arm.rest, found


class _Survey(NamedTuple):
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

    def clear(self, f: Frames, apart: float = 0.0) -> Mask:
        """Whether rising frames and TCP are a link radius, and ``apart`` of the reach, above the floor (...)."""
        height = self.arm.floor + (LINK_RADIUS_RATIO + apart) * self.reach
        frames_clear = (f.position[..., rising_frames(self.arm, height), 2] > height).all(axis=-1)
        return frames_clear & (f.tcp_position[..., 2] > height)


@lru_cache(maxsize=1)
def _survey(arm: Arm) -> _Survey:
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    low, high = np.where(low < high, low, arm.lower), np.where(low < high, high, arm.upper)
    postures = np.random.default_rng(0).uniform(low, high, (SAMPLES, arm.joints))
    torque = np.abs(gravity_torque(arm, postures)).max()
    return _Survey(arm, reach(arm), low, high, postures, _manipulability(arm, postures).max(), torque)


def _manipulability(arm: Arm, q: Array) -> Array:
    j = position_kinematics(arm, q)[1]
    return np.sqrt(np.maximum(np.linalg.det(j @ j.mT), 0.0))


def _score(survey: _Survey, q: Array, apart: float, margin: float) -> Array:
    """Scores of postures (..., n); minus infinity: unusable. See `_SEARCHES`."""
    arm, f = survey.arm, frames(survey.arm, q)
    tcp = f.tcp_position
    middle, half = (survey.high + survey.low) / 2, (survey.high - survey.low) / 2
    elbow = f.position[..., 2].max(axis=-1) - tcp[..., 2]
    distance = np.hypot(tcp[..., 0], tcp[..., 1])
    score = (
        _manipulability(arm, q) / max(survey.manipulability, 1e-12)
        - (((q - middle) / half) ** 2).mean(axis=-1)
        + np.clip(elbow / (0.15 * survey.reach), 0.0, 1.0)
        + tcp[..., 0] / np.maximum(distance, 1e-9)
        - np.abs(gravity_torque(arm, q)).max(axis=-1) / max(survey.torque, 1e-12)
    )
    ahead = (tcp[..., 0] > 0) & (distance > 2 * AXIS_CLEARANCE * survey.reach)
    most = np.minimum((1 - 2 * REST_MARGIN) * half, np.maximum(half - margin, 2 * LIMIT_MARGIN * half))
    inside = (np.abs(q - middle) <= most).all(axis=-1)
    high = tcp[..., 2] > arm.floor + (REST_HEIGHT + 2 * apart) * survey.reach
    return np.where(survey.clear(f, apart) & ahead & inside & high, score, -np.inf)


def _rest_candidates(survey: _Survey, apart: float, margin: float) -> Array:
    """Postures (c, n) [rad] in whole degrees, the best first, by random local search."""
    scores = _score(survey, survey.postures, apart, margin)
    best = np.degrees(survey.postures[np.argsort(-scores, kind="stable")[: _CANDIDATES * _SPREAD : _SPREAD]])
    rng, low, high = np.random.default_rng(1), np.degrees(survey.low), np.degrees(survey.high)
    for width in np.geomspace(0.2, 0.003, _CLIMB):
        moves = width * (high - low) * rng.normal(size=(16, *best.shape)) * (rng.random((16, *best.shape)) < 0.5)
        moves[0] = 0.0
        trial = np.clip(np.rint(best + moves), np.ceil(low), np.floor(high))
        choice = _score(survey, np.radians(trial), apart, margin).argmax(axis=0)
        best = trial[choice, np.arange(len(best))]
    found = np.radians(np.unique(best + 0.0, axis=0))
    value = _score(survey, found, apart, margin)
    return found[np.argsort(-value, kind="stable")][: np.isfinite(value).sum()]


def _good(survey: _Survey, rest: Array, points: Array, iterations: int = 60) -> Mask:
    arm = replace(survey.arm, rest=rest)
    solution = solve_position(arm, points, rest, tolerance=1e-4 * survey.reach, iterations=iterations)
    margin = LIMIT_MARGIN * (arm.upper - arm.lower)
    inside = ((solution.q > arm.lower + margin) & (solution.q < arm.upper - margin)).all(axis=-1)
    load = np.abs(gravity_torque(arm, solution.q)).max(axis=-1)
    away = np.hypot(points[..., 0], points[..., 1]) > AXIS_CLEARANCE * survey.reach
    clear = survey.clear(frames(arm, solution.q))
    return solution.converged & inside & clear & away & (load <= TORQUE_SHARE * survey.torque)


def _largest_box(survey: _Survey, rest: Array) -> Box | None:
    """Grow boxes of good targets around the resting TCP, axis by axis; the largest one."""
    centre, step = tcp_position(survey.arm, rest), EDGES * survey.reach / STEPS
    grid = np.moveaxis(np.indices((2 * STEPS + 1,) * 3), 0, -1) - STEPS
    good, spans = _good(survey, rest, centre + grid * step), []
    for order in permutations(range(3)):
        span = np.full((2, 3), STEPS)
        for axis, _, side in product(order, range(STEPS), (0, 1)):
            bigger = span.copy()
            bigger[side, axis] += 2 * side - 1
            inside = tuple(slice(first, last + 1) for first, last in bigger.T)
            if (np.ptp(bigger, axis=0) <= STEPS).all() and good[inside].all():
                span = bigger
        spans.append(span)
    span = max(spans, key=lambda one: np.ptp(one, axis=0).prod())
    lower, upper = centre + (span - STEPS) * step
    for _ in range(10):
        lower, upper = np.ceil(lower * 1e3) / 1e3, np.floor(upper * 1e3) / 1e3
        if (upper - lower).min() <= 0:
            return None
        box = Box(lower=lower, upper=upper)
        if _good(survey, rest, box.grid(8), 200).all():
            return box
        lower, upper = lower + 0.06 * (centre - lower), upper + 0.06 * (centre - upper)
    return None


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


@lru_cache
def heaviest_load(arm: Arm, per_edge: int = 2) -> Array:
    """Largest gravity torque (n,) [N m] over a grid of targets."""
    return frozen(np.abs(gravity_torque(arm, posture_grid(arm, per_edge).q)).max(axis=0))


@lru_cache
def largest_loads(arm: Arm) -> Array:
    """Largest gravity torque (n,) [N m] over all postures."""
    return frozen(np.abs(gravity_torque(arm, arm.drawn(4096))).max(axis=0))


def posture_grid(arm: Arm, per_edge: int) -> Solution:
    """Postures (per_edge^3, n) [rad] of a grid of targets."""
    return solve_position(arm, arm.targets.grid(per_edge), arm.rest)


@lru_cache
def unloaded_joints(arm: Arm) -> Mask:
    """Joints (n,) without weight at any target."""
    load = heaviest_load(arm)
    return frozen(load < UNLOADED * load.max())


@lru_cache
def moves_tool(arm: Arm) -> Mask:
    """Joints (n,) that move the TCP at targets."""
    return frozen(levers(arm, posture_grid(arm, 2).q).max(axis=0) > LEAST_LEVER * reach(arm))


LEVEL = 0.02
"""Least share of weight times reach that motors can carry, also where gravity does not load them; chosen"""


def least_load(arm: Arm) -> float:
    """Torque [N m] that an arm's motors carry at least, also of one that gravity does not load."""
    return LEVEL * (arm.mass.sum() * np.linalg.norm(GRAVITY)) * reach(arm)


@lru_cache
def torque_size(arm: Arm) -> float:
    """Largest load, or half of that anywhere, over that of a myCobot 280."""
    most = max(heaviest_load(arm).max(), 0.5 * largest_loads(arm).max(), least_load(arm))
    return most / heaviest_load(mycobot280()).max()


@lru_cache
def length_size(arm: Arm) -> float:
    """Reach over that of a myCobot 280."""
    return reach(arm) / reach(mycobot280())


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

_SEARCHES = ((0.0, 0.0), (0.05, 0.3), (0.1, 0.3))
"""Extra distances from floor (over the reach) and limits [rad] (chosen)"""

_STEPS = 0.8 ** np.arange(8)
"""(chosen)"""


def is_safe(arm: Arm, q: Array) -> Mask:
    """Which postures (..., n) [rad] are safe: away from limits, floor and column, lightly loaded."""
    near, low, heavy, sunk, inwards = _dangers(arm, q)
    return ~((near | low | heavy).any(axis=-1) | sunk | inwards)


def line_is_safe(arm: Arm, start: Array, goal: Array) -> Mask:
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


def _dangers(arm: Arm, q: Array) -> tuple[Mask, ...]:
    """Joints (..., n) near a limit, low, heavily loaded; whether (...) the TCP is low, or near the base's axis."""
    f, floor = frames(arm, q), arm.floor + CLEARANCE * length_size(arm)
    rest_reach = np.linalg.norm(tcp_position(arm, arm.rest)[:2])
    return (
        ~((q >= arm.lower + SAFE_MARGIN) & (q <= arm.upper - SAFE_MARGIN)),
        # Frames that never rise or sink, such as a shoulder on its column, may be anywhere.
        rising_frames(arm, floor) & (f.position[..., 2] < floor),
        np.abs(gravity_torque(arm, q)) > heaviest_load(arm) + LOAD_MARGIN * torque_size(arm),
        f.tcp_position[..., 2] < floor,
        np.linalg.norm(f.tcp_position[..., :2], axis=-1) < COLUMN * rest_reach,
    )


def room(arm: Arm) -> tuple[float, float]:
    """Safe shares (0 to 1) of the excursion and the spread about rest."""
    corners = np.array(list(product((-1.0, 1.0), repeat=arm.joints)))
    whole = is_safe(arm, arm.rest + EXCURSION * _STEPS[:, None, None] * corners).all(axis=-1)
    excursion = float(max(_STEPS[whole], default=0.0))
    if excursion < _LEAST:
        return excursion, 0.0
    held = (
        share
        for share in _STEPS
        if len(postures_to_hold(arm, np.random.default_rng(0), spread=share * HOLD_SPREAD)) >= _LEAST_HOLDS * POSTURES
    )
    return excursion, float(next(held, 0.0))


def postures_to_hold(arm: Arm, rng: np.random.Generator, *, spread: float, offset: float = HOLD_OFFSET) -> Array:
    """Draw postures (k, n) [rad] around rest with safe approaches."""
    q = arm.rest + spread * rng.uniform(-1.0, 1.0, (POSTURES, arm.joints))
    for side in (-offset, offset):
        q = q[line_is_safe(arm, arm.rest, q + side) & line_is_safe(arm, q, q + side)]
    return q


def derive_workspace(arm: Arm) -> tuple[Array, Box]:
    """Rest posture (n,) [rad] and targets with room for an excitation; InputError."""
    survey, why, found = _survey(arm), "", []
    for apart, margin in _SEARCHES:
        for rest in _rest_candidates(survey, apart, margin):
            box = _largest_box(survey, rest)
            if box is None:
                continue
            trial, edges = replace(arm, rest=rest, targets=box), box.upper - box.lower
            share, spread = room(trial)
            if (edges >= 0.5 * EDGES * survey.reach).all() and share >= _LEAST and spread == 1.0:
                return rest, box
            why = why or unsafe(trial, rest) or "most postures around it are not safe"
            if min(share, spread) >= _LEAST:
                found.append((share * spread * edges.prod(), rest, box))
    if found:
        return max(found, key=lambda one: one[0])[1:]
    lack = f"has room for an excitation (of the best one: {why})" if why else "has a region of reachable targets"
    raise InputError(
        "no posture with the TCP in front of the base (x > 0), every joint frame above the floor and room in every "
        f"joint {lack}; to drive it, give rest_deg in the arm's TOML file, such as arm.toml of a run"
    )
