"""Inverse kinematics over all branches, with a choice of posture.

Cost: static torque over what the motor surely lifts, distance from joint limits, clearance, longest joint travel. The
search moves stored postures to the target by damped least squares, and lowers the cost of the best in the null space
(`rejoint.arms.redundancy`). A comfortable posture of `solve_position` is kept.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rejoint.arms.arm import Arm, Array
from rejoint.arms.collision import clearances, collision_shape, contact, guarded_floors, usual_distances
from rejoint.arms.kinematics import gravity_torque, joint_terms, tcp_position
from rejoint.arms.rotations import Orientation, tool_axis
from rejoint.arms.workspace import length_size
from rejoint.system.errors import InputError
from rejoint.system.shell import Late

redundancy = Late("rejoint.arms.redundancy")

MARGIN = float(np.radians(0.5))
"""[rad] inside the joint limits, as the guard's"""
CLEARANCE, SPACIOUS = 0.006, 0.015
"""[m] least clearance, twice that between links (chosen: capsules 5 mm thicker touch nothing); and sufficient clearance
of a myCobot 280 (chosen)"""
POOL, DRAWN = 8000, 40000
"""Stored and drawn postures (chosen: 18 mm apart for a myCobot 280)"""
EFFORT = (40, 4, 10)
"""Moved and improved stored postures, and steps (chosen)"""
THOROUGH = (500, 24, 25)
"""The same before a target is refused (chosen)"""
NEIGHBOUR, SWITCH = 0.06, 3.0
"""[m] of a myCobot 280 between neighbours, and cost for another branch (chosen)"""
COMFORTABLE = 0.1
"""Largest comfortable cost (chosen: four in five of a myCobot 280)"""
UNLOADED = 0.03
"""Least torque that counts, over the largest joint's"""
SURE = 0.95
"""Share of torque limits at the nearest possible place (chosen)"""
_BISECTIONS, _TRIED = 7, 4


class Motors(NamedTuple):
    """Torques of an arm's motors."""

    limit: Array
    """(n,) [N m] largest holding torque"""
    usable: Array
    """(n,) [N m] surely lifted, against friction"""


@dataclass(frozen=True, kw_only=True, eq=False)
class Goals:
    """Postures of K targets."""

    q: Array
    """(K, n) [rad] of the target, or the nearest possible place"""
    refusals: tuple[str, ...]
    """(K,) reasons in one line; empty: possible"""
    nearest: Array
    """(K, 3) [m] nearest possible places"""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Demand:
    """A search without its target."""

    arm: Arm
    scale: Array
    """(n,) [N m] torque that counts as one"""
    most: Array
    """(n,) [N m] largest"""


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
    """Choose a posture for each of ``targets`` (K, 3) [m], from ``start`` (n,) or (K, n) [rad].

    Parameters
    ----------
    arm
        with payload, tool and forbidden boxes
    targets
        TCP in the base frame
    start
        of all targets, or of each
    turn
        wanted orientations (K,); None: any
    motors
        postures that they surely lift are preferred; None: no target is too heavy
    chained
        the arm goes from target to target; neighbours stay on one branch
    thorough
        search 0.4 s before a target is refused, also for the reason and a near place

    Returns
    -------
    Goals
        postures, refusals and the nearest possible places

    Raises
    ------
    InputError
        for wrong shapes, numbers that are not finite, or boxes that leave no posture
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
    """Postures (P, n) [rad] over the workspace, away from limits and contacts."""
    pool = pool_of(arm)
    return frozen(pool.posture[pool.bare <= max(COMFORTABLE, float(np.median(pool.bare)))])


def _choose(demand: _Demand, goal: Array, start: Array, near: bool) -> Array | None:
    """Posture (n,) of one goal (17,), or None."""
    arm, body = demand.arm, body_of(demand.arm)
    stayed = np.empty(arm.joints)
    begin = frozen(start)
    cost = redundancy.stay(body, goal, begin, demand.scale, demand.most, near, stayed)
    if cost == 0.0 or (near and cost < SWITCH):
        return stayed
    found, other, _ = _search(demand, goal, begin, EFFORT)
    if other >= redundancy.FAR and cost >= redundancy.FAR:
        return None
    return stayed if cost <= other + float(near) else found


def _search(demand: _Demand, goal: Array, start: Array, effort: tuple[int, int, int]) -> tuple[Array, float, Array]:
    """Best posture (n,) of a goal, its cost, and the posture (n,) nearest to the goal."""
    arm = demand.arm
    found, nearest = np.empty(arm.joints), np.empty(arm.joints + 1)
    size = 0.05 * length_size(arm)
    cost = redundancy.search(
        body_of(arm), pool_of(arm), goal, start, demand.scale, demand.most, size, *effort, found, nearest
    )
    return found, cost, nearest[:-1]


def _refuse(demand: _Demand, goal: Array, start: Array) -> tuple[str, Array, Array]:
    """Search thoroughly: the refusal or empty, and the nearest possible posture (n,) and place (3,)."""
    arm = demand.arm
    begin = frozen(start)
    if goal[2] < arm.floor:
        lifted = np.array(goal)
        lifted[2] = arm.floor
        why = f"below the floor: {1e3 * goal[2]:.0f} mm high, the tool stays above {1e3 * arm.floor:.0f} mm"
        lifted.setflags(write=False)
        found = _choose(demand, lifted, start, False)
        return (why, found, lifted[:3]) if found is not None else (why, *_nearby(demand, goal, begin))
    found, cost, closest = _search(demand, goal, begin, THOROUGH)
    if cost < redundancy.FAR:
        return "", found, goal[:3]
    return _why(demand, goal, begin, found, cost, closest), *_nearby(demand, goal, begin)


def _why(demand: _Demand, goal: Array, start: Array, found: Array, cost: float, closest: Array) -> str:
    arm = demand.arm
    if cost == np.inf:
        if goal[16] > 0.0:
            place = frozen(np.append(goal[:16], 0.0))
            found, cost, closest = _search(demand, place, start, THOROUGH)
            if cost < redundancy.FAR:
                return "the orientation cannot be reached there; the place alone can"
        if cost == np.inf:
            away = float(np.linalg.norm(goal[:3] - tcp_position(arm, closest)))
            return f"out of reach by {1e3 * away:.1f} mm"
    distances = clearances(arm, found, body_of(arm).floors)
    touching = distances[arm.joints :] < body_of(arm).least
    if touching.any():
        light, cost, _ = _search(_demand(arm, None), goal, start, THOROUGH)
        if cost < redundancy.FAR:
            found, touching[:] = light, False
    if touching.any():
        what, other = contact(arm, int(np.argmin(distances[arm.joints :] - np.maximum(body_of(arm).least, -1e3))))
        return f"in collision: {what} would touch {other}"
    joint, why = too_heavy(arm, found, demand.most)
    if joint is not None:
        return f"too heavy: {why}"
    low = int(np.argmin(distances[: arm.joints]))
    name = "the tool" if low == arm.joints - 1 else arm.joint_names[low + 1]
    return f"below the floor: {name} would be lower than {1e3 * body_of(arm).floors[low]:.0f} mm"


def too_heavy(arm: Arm, q: Array, limit: Array) -> tuple[int | None, str]:
    """Return the joint that cannot hold ``q`` (n,) [rad] with the ``limit`` (n,) [N m], and why; None: all can."""
    torque = np.abs(gravity_torque(arm, q))
    j = int(np.argmax(torque / limit))
    share = 100.0 * torque[j] / limit[j]
    if share <= 100.0:
        return None, ""
    why = f"{arm.joint_names[j]} needs {torque[j]:.2f} N m and gives {limit[j]:.2f} N m, {share:.0f} per cent of it"
    return j, why


def _nearby(demand: _Demand, goal: Array, start: Array) -> tuple[Array, Array]:
    """Posture (n,) and place (3,) [m] nearest to the goal, by bisection from stored postures."""
    demand, pool = replace(demand, most=frozen(SURE * demand.most)), pool_of(demand.arm)
    light = (np.abs(pool.torque) <= demand.most).all(axis=-1)
    away = np.where(light, np.linalg.norm(pool.place[:, :3] - goal[:3], axis=-1), np.inf)
    best, least = (np.array(start), tcp_position(demand.arm, start)), np.inf
    for k in np.argsort(away)[:_TRIED]:
        works, place = pool.posture[k], pool.place[k, :3]
        low, high = 0.0, 1.0
        for _ in range(_BISECTIONS + 1):
            share = low if goal[16] > 0.0 and low == 0.0 and high == 1.0 else 0.5 * (low + high)
            trial = frozen(np.append(place + share * (goal[:3] - place), goal[3:]))
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
    """Whether two goals (17,) should share a branch."""
    apart = np.linalg.norm(goal[:3] - other[:3])
    turned = np.linalg.norm(goal[3:12] - other[3:12]) if goal[16] > 0.0 else 0.0
    return bool(apart < NEIGHBOUR * length_size(arm) and turned < 0.5)


def _goal(arm: Arm, place: Array, turn: Orientation | None, k: int) -> Array:
    """Goal (17,), see `rejoint.arms.redundancy`."""
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
    """Return data of an arm for compiled loops."""
    shape = collision_shape(arm)
    sizes = np.array([shape.radius, shape.ground, SPACIOUS * length_size(arm)])
    ranges = np.minimum(MARGIN, 0.25 * (arm.upper - arm.lower))
    return redundancy.ArmTables(
        terms=frozen(joint_terms(arm)),
        tip=frozen(arm.tip),
        axes=frozen(arm.axis),
        lower=arm.lower,
        upper=arm.upper,
        inner=frozen(np.stack([arm.lower + ranges, arm.upper - ranges])),
        rest=arm.rest,
        mass=arm.mass,
        com=frozen(arm.com),
        floors=frozen(guarded_floors(arm)),
        pairs=frozen(shape.pairs),
        places=frozen(shape.places),
        moving=frozen(shape.moving),
        boxes=frozen(shape.boxes),
        sizes=frozen(sizes),
        least=frozen(_least(arm)),
    )


def _least(arm: Arm) -> Array:
    """Least distances (c,) [m]; smaller between usually close links."""
    apart = usual_distances(arm)
    kept = np.full(apart.shape[1], CLEARANCE)
    kept[: len(collision_shape(arm).pairs)] *= 2.0
    usual = np.minimum(kept, 0.5 * np.median(apart, axis=0))
    least = np.where(np.ptp(apart, axis=0) < 1e-6, -np.inf, np.maximum(usual, 0.0))
    boxes = len(collision_shape(arm).moving) * len(arm.keep_out)
    least[len(least) - boxes :] = CLEARANCE
    return least


@lru_cache(maxsize=32)
def pool_of(arm: Arm) -> Any:  # noqa: ANN401 - `redundancy.Pool`, likewise
    """Return stored postures without contacts; InputError: none."""
    rng, body = np.random.default_rng(0), body_of(arm)
    drawn = frozen(np.vstack([arm.rest, rng.uniform(body.inner[0], body.inner[1], (DRAWN, arm.joints))]))
    place, torque, bare = np.empty((len(drawn), 12)), np.empty(drawn.shape), np.empty(len(drawn))
    redundancy.survey(body, drawn, place, torque, bare)
    free = np.flatnonzero(bare < redundancy.FAR)[:POOL]
    if not len(free):
        cause = "its keep_out boxes leave it no posture" if arm.keep_out else "it touches itself or the ground always"
        raise InputError(f"arm {arm.name}: {cause}, of {DRAWN} that were tried; correct its file")
    return redundancy.Pool(*(frozen(array[free]) for array in (drawn, place, torque, bare)))


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
    """Contiguous read-only array, as compiled loops need."""
    result = np.array(array, order="C")
    result.setflags(write=False)
    return result
