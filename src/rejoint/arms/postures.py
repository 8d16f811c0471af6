"""Inverse kinematics over all branches, with a choice of posture.

A place leaves a six-joint arm a family of postures. The cost of a posture counts the static torque of each joint as a
share of what its motor surely lifts against friction, the distance from joint limits, the clearance to the arm itself,
the ground and the declared boxes, and the longest joint travel. The search begins at stored postures that touch
nothing, moves the most promising ones to the target by damped least squares, and lowers the cost of the best along the
postures that keep the target (`rejoint.arms.redundancy`). A comfortable posture that `solve_position` finds from the
start is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array
from rejoint.arms.collision import clearances, collision_shape, contact, guarded_floors
from rejoint.arms.kinematics import gravity_torque, joint_terms, tcp_position
from rejoint.arms.rotations import Orientation, tool_axis
from rejoint.arms.workspace import length_size
from rejoint.system.errors import InputError
from rejoint.system.shell import Late

redundancy = Late("rejoint.arms.redundancy")

MARGIN = float(np.radians(0.5))
"""[rad] by which postures stay inside the joint limits, as the guard's commands do"""
CLEARANCE, SPACIOUS = 0.006, 0.015
"""[m] that a posture keeps at least from what it could touch, and twice that between links (chosen: capsules 5 mm
thicker touch nothing); and from which more is worth nothing, for a myCobot 280 (chosen; goes with the reach)"""
POOL, DRAWN = 8000, 40000
"""Postures that are stored, and the most that are drawn for them (chosen: 18 mm apart for a myCobot 280)"""
STARTS, BESTS, DESCENTS = 40, 4, 10
"""Stored postures that are moved to a target, how many of them are improved, and steps of that (chosen)"""
MORE_STARTS, MORE_BESTS, MORE_DESCENTS = 500, 24, 25
"""The same before a target is refused (chosen)"""
NEIGHBOUR, SWITCH = 0.06, 3.0
"""[m] of a myCobot 280 within which targets are neighbours, and the cost from which another branch than that of the
neighbour is looked for (chosen: more than a joint at its full torque costs)"""
COMFORTABLE = 0.1
"""Cost of a stored posture up to which it counts as comfortable (chosen: four in five of a myCobot 280); at least
half of them do"""
UNLOADED = 0.03
"""Least torque that counts as one, as a share of the largest joint's, where no limits are given"""
SURE = 0.95
"""Share of a torque limit that the nearest place that works needs at most (chosen)"""
_BISECTIONS, _TRIED = 7, 4


class Motors(NamedTuple):
    """What the motors of an arm can give."""

    limit: Array
    """(n,) [N m] more than that cannot be held"""
    usable: Array
    """(n,) [N m] what they surely lift, against friction"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Goals:
    """Postures chosen for K targets, in their order."""

    q: Array
    """(K, n) [rad] chosen postures; where a target is refused, the posture of the nearest place that works"""
    refusals: tuple[str, ...]
    """(K,) empty where the target works, else why it does not, in one line"""
    nearest: Array
    """(K, 3) [m] nearest places that work; the targets themselves where they do"""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Demand:
    """What a search is about, but for its target."""

    arm: Arm
    scale: Array
    """(n,) [N m] torque that counts as one"""
    most: Array
    """(n,) [N m] more than that cannot be"""


def choose_postures(
    arm: Arm,
    targets: Array,
    start: Array,
    *,
    turn: Orientation | None = None,
    motors: Motors | None = None,
    chained: bool = False,
    thorough: bool = True,
) -> Goals:
    """Choose a posture for each of the ``targets`` (K, 3) [m], coming from ``start`` (n,) or (K, n) [rad].

    Parameters
    ----------
    arm
        with its payload and tool, and with the boxes it keeps out of
    targets
        places of the TCP in the base frame
    start
        where the arm is; of all targets, or of each
    turn
        orientations (K,) that the tool is to have; None: any
    motors
        what they can give; postures that they surely lift are preferred. None: no target is too heavy
    chained
        whether the arm goes from target to target; then neighbouring targets stay on one branch
    thorough
        whether a target is refused only after a long search, of 0.4 s, which also finds why and what is near

    Returns
    -------
    Goals
        postures, refusals and the nearest places that work

    Raises
    ------
    InputError
        where shapes are wrong, numbers are not finite, or boxes leave the arm no posture
    """
    places, starts = np.asarray(targets, dtype=float), np.asarray(start, dtype=float)
    _check(arm, places, starts, turn, motors)
    starts = np.broadcast_to(starts, (len(places), arm.joints))
    demand = _demand(arm, motors)
    q, nearest, refusals = np.empty(starts.shape), places.copy(), [""] * len(places)
    for k in range(len(places)):
        begin = q[k - 1] if chained and k else starts[k]
        goal = _goal(arm, places[k], turn, k)
        near = chained and k > 0 and _neighbours(arm, goal, _goal(arm, places[k - 1], turn, k - 1))
        found = None if places[k, 2] < arm.floor else _choose(demand, goal, begin, near)
        if found is None:
            refusals[k], found, nearest[k] = (
                _refuse(demand, goal, begin) if thorough else ("not found at once", begin, tcp_position(arm, begin))
            )
        q[k] = found
    return Goals(q=q, refusals=tuple(refusals), nearest=nearest)


def comfortable_postures(arm: Arm) -> Array:
    """Return postures (P, n) [rad], spread over the workspace, with room to joint limits and to all that is near."""
    pool = pool_of(arm)
    return frozen(pool.posture[pool.bare <= max(COMFORTABLE, float(np.median(pool.bare)))])


def _choose(demand: _Demand, goal: Array, start: Array, near: bool) -> Array | None:
    """Return the posture (n,) of one goal (17,); None where none was found that can be taken."""
    arm, body = demand.arm, body_of(demand.arm)
    stayed, facts = np.empty(arm.joints), np.empty((1, 3))
    begin = np.array(start)
    begin.setflags(write=False)
    cost = redundancy.stay(body, goal, begin, demand.scale, demand.most, near, stayed, facts)
    if cost == 0.0 or (near and cost < SWITCH):
        return stayed
    found, other, _ = _search(demand, goal, begin, (STARTS, BESTS, DESCENTS))
    if other >= redundancy.FAR and cost >= redundancy.FAR:
        return None
    return stayed if cost <= other + float(near) else found


def _search(demand: _Demand, goal: Array, start: Array, effort: tuple[int, int, int]) -> tuple[Array, float, Array]:
    """Return the best posture (n,) of a goal, its cost, and the posture (n,) that comes nearest to the goal."""
    arm = demand.arm
    found, facts, nearest = np.empty(arm.joints), np.empty((1, 3)), np.empty((1, arm.joints + 1))
    size = 0.05 * length_size(arm)
    cost = redundancy.search(
        body_of(arm), pool_of(arm), goal, start, demand.scale, demand.most, size, *effort, found, facts, nearest
    )
    return found, cost, nearest[0, :-1]


def _refuse(demand: _Demand, goal: Array, start: Array) -> tuple[str, Array, Array]:
    """Search thoroughly; return why a goal is refused, and the posture (n,) and place (3,) of the nearest that works.

    The first is empty where the search finds a posture after all.
    """
    arm = demand.arm
    begin = np.array(start)
    begin.setflags(write=False)
    if goal[2] < arm.floor:
        lifted = np.array(goal)
        lifted[2] = arm.floor
        why = f"below the floor: {1e3 * goal[2]:.0f} mm high, the tool stays above {1e3 * arm.floor:.0f} mm"
        lifted.setflags(write=False)
        found = _choose(demand, lifted, start, False)
        return (why, found, lifted[:3]) if found is not None else (why, *_nearby(demand, goal, begin))
    effort = (MORE_STARTS, MORE_BESTS, MORE_DESCENTS)
    found, cost, closest = _search(demand, goal, begin, effort)
    if cost < redundancy.FAR:
        return "", found, goal[:3]
    return _why(demand, goal, begin, found, cost, closest), *_nearby(demand, goal, begin)


def _why(demand: _Demand, goal: Array, start: Array, found: Array, cost: float, closest: Array) -> str:
    """Say in one line why a goal is refused, from what a thorough search ``found`` (n,), at its ``cost``."""
    arm, effort = demand.arm, (MORE_STARTS, MORE_BESTS, MORE_DESCENTS)
    if cost == np.inf:
        if goal[16] > 0.0:
            place = frozen(np.append(goal[:16], 0.0))
            found, cost, closest = _search(demand, place, start, effort)
            if cost < redundancy.FAR:
                return "the orientation cannot be reached there; the place alone can"
        if cost == np.inf:
            away = float(np.linalg.norm(goal[:3] - tcp_position(arm, closest)))
            return f"out of reach by {1e3 * away:.1f} mm"
    distances = clearances(arm, found, body_of(arm).floors)
    touching = distances[arm.joints :] < body_of(arm).least
    if touching.any():
        light, cost, _ = _search(_demand(arm, None), goal, start, effort)
        if cost < redundancy.FAR:
            found, touching[:] = light, False
    if touching.any():
        what, other = contact(arm, int(np.argmin(distances[arm.joints :] - np.maximum(body_of(arm).least, -1e3))))
        return f"in collision: {what} would touch {other}"
    share = np.abs(gravity_torque(arm, found)) / demand.most
    j = int(np.argmax(share))
    if share[j] > 1.0:
        needed, limit = share[j] * demand.most[j], demand.most[j]
        return (
            f"too heavy: {arm.joint_names[j]} needs {needed:.2f} N m and gives {limit:.2f} N m, {100 * share[j]:.0f} "
            "per cent of it"
        )
    low = int(np.argmin(distances[: arm.joints]))
    name = "the tool" if low == arm.joints - 1 else arm.joint_names[low + 1]
    return f"below the floor: {name} would be lower than {1e3 * body_of(arm).floors[low]:.0f} mm"


def _nearby(demand: _Demand, goal: Array, start: Array) -> tuple[Array, Array]:
    """Return the posture (n,) and the place (3,) [m] of the nearest place found that works.

    The search halves the way from stored postures that work to the goal. No joint is loaded to its limit there.
    """
    demand, pool = replace(demand, most=frozen(SURE * demand.most)), pool_of(demand.arm)
    light = (np.abs(pool.torque) <= demand.most).all(axis=-1)
    away = np.where(light, np.linalg.norm(pool.place[:, :3] - goal[:3], axis=-1), np.inf)
    best, least = (np.array(start), tcp_position(demand.arm, start)), np.inf
    for k in np.argsort(away)[:_TRIED]:
        works, place = pool.posture[k], pool.place[k, :3]
        low, high = 0.0, 1.0
        for _ in range(_BISECTIONS + 1):
            share = low if goal[16] > 0.0 and low == 0.0 and high == 1.0 else 0.5 * (low + high)
            trial = np.array(goal)
            trial[:3] = place + share * (goal[:3] - place)
            trial.setflags(write=False)
            found = None if trial[2] < demand.arm.floor else _choose(demand, trial, works, False)
            if found is None:
                high = share
                if share == 0.0:
                    break
            else:
                low, works = share, found
                if share == 0.0:
                    high = 0.999
        reached = tcp_position(demand.arm, works)
        missed = float(np.linalg.norm(reached - goal[:3]))
        if missed < least:
            best, least = (np.array(works), reached), missed
    return best


def _neighbours(arm: Arm, goal: Array, other: Array) -> bool:
    """Tell whether two goals (17,) are so near that the arm should not change its branch between them."""
    apart = np.linalg.norm(goal[:3] - other[:3])
    turned = np.linalg.norm(goal[3:12] - other[3:12]) if goal[16] > 0.0 else 0.0
    return bool(apart < NEIGHBOUR * length_size(arm) and turned < 0.5)


def _goal(arm: Arm, place: Array, turn: Orientation | None, k: int) -> Array:
    """Return a goal (17,) as `rejoint.arms.redundancy` takes it."""
    goal = np.zeros(17)
    goal[:3], goal[3:12], goal[12:15] = place, np.eye(3).ravel(), tool_axis(arm)
    if turn is not None and turn.weight[k] > 0.0:
        goal[3:12], goal[12:15], goal[15] = turn.rotation[k].ravel(), turn.axis, turn.weight[k]
        goal[16] = 2.0 if turn.whole[k] else 1.0
    return frozen(goal)


def _demand(arm: Arm, motors: Motors | None) -> _Demand:
    if motors is not None:
        return _Demand(arm=arm, scale=frozen(motors.usable / redundancy.LOAD), most=frozen(motors.limit))
    torque = np.abs(pool_of(arm).torque).max(axis=0, initial=1e-9)
    scale = np.maximum(torque, UNLOADED * torque.max())
    return _Demand(arm=arm, scale=frozen(scale), most=frozen(np.full(arm.joints, np.inf)))


@lru_cache(maxsize=32)
def body_of(arm: Arm) -> Any:  # noqa: ANN401 - `redundancy.ArmTables`, imported when it is first used
    """Return what the compiled loops read of an arm."""
    shape = collision_shape(arm)
    sizes = np.array([shape.radius, shape.ground, SPACIOUS * length_size(arm)])
    ranges = np.minimum(MARGIN, 0.25 * (arm.upper - arm.lower))
    return redundancy.ArmTables(
        terms=frozen(joint_terms(arm)), tip=frozen(arm.tip), axes=frozen(arm.axis), lower=arm.lower, upper=arm.upper,
        inner=frozen(np.stack([arm.lower + ranges, arm.upper - ranges])), rest=arm.rest, mass=arm.mass,
        com=frozen(arm.com), floors=frozen(guarded_floors(arm)), pairs=frozen(shape.pairs),
        places=frozen(shape.places), moving=frozen(shape.moving), boxes=frozen(shape.boxes), sizes=frozen(sizes),
        least=frozen(_least(arm)),
    )  # fmt: skip


def _least(arm: Arm) -> Array:
    """Distances (c,) [m] that postures keep at least; less between links that are near each other in most postures."""
    drawn = np.random.default_rng(1).uniform(arm.lower, arm.upper, (256, arm.joints))
    apart = clearances(arm, drawn, np.zeros(arm.joints))[:, arm.joints :]
    kept = np.full(apart.shape[1], CLEARANCE)
    kept[: len(collision_shape(arm).pairs)] *= 2.0
    usual = np.minimum(kept, 0.5 * np.median(apart, axis=0))
    least = np.where(np.ptp(apart, axis=0) < 1e-6, -np.inf, np.maximum(usual, 0.0))
    boxes = len(collision_shape(arm).moving) * len(arm.keep_out)
    least[len(least) - boxes :] = CLEARANCE
    return least


@lru_cache(maxsize=32)
def pool_of(arm: Arm) -> Any:  # noqa: ANN401 - `redundancy.Pool`, likewise
    """Return stored postures in which an arm touches nothing; InputError where there are none."""
    rng, body = np.random.default_rng(0), body_of(arm)
    drawn = frozen(np.vstack([arm.rest, rng.uniform(body.inner[0], body.inner[1], (DRAWN, arm.joints))]))
    place, torque, facts = np.empty((len(drawn), 12)), np.empty(drawn.shape), np.empty((len(drawn), 2))
    redundancy.survey(body, drawn, place, torque, facts)
    free = np.flatnonzero(facts[:, 0] < redundancy.FAR)[:POOL]
    if not len(free):
        cause = "its keep_out boxes leave it no posture" if arm.keep_out else "it touches itself or the ground always"
        raise InputError(f"arm {arm.name}: {cause}, of {DRAWN} that were tried; correct its file")
    return redundancy.Pool(*(frozen(array[free]) for array in (drawn, place, torque, facts[:, 0])))


def _check(arm: Arm, places: Array, starts: Array, turn: Orientation | None, motors: Motors | None) -> None:
    if places.ndim != 2 or places.shape[1] != 3 or not np.isfinite(places).all():
        raise InputError(f"targets: expected K places of three finite numbers [m], got shape {places.shape}")
    if starts.shape not in ((arm.joints,), (len(places), arm.joints)) or not np.isfinite(starts).all():
        raise InputError(f"start: expected {arm.joints} finite joint positions [rad], or {len(places)} times as many")
    if turn is not None and turn.weight.shape != (len(places),):
        raise InputError(f"turn: expected {len(places)} orientations, got {turn.weight.shape}")
    if motors is not None and (np.shape(motors) != (2, arm.joints) or not (np.array(motors) > 0.0).all()):
        raise InputError(f"motors: expected {arm.joints} positive torques [N m] each, got {motors}")


def frozen(array: NDArray[Any]) -> NDArray[Any]:
    """Return a contiguous array that cannot be written: compiled loops take no other."""
    result = np.array(array, order="C")
    result.setflags(write=False)
    return result
