"""Inverse kinematics over all branches, with a choice of posture.

Cost: torque over what the motor surely lifts, joint limits, clearance, joint travel. Stored postures move to the target
by damped least squares; the best lower their cost in the null space. A comfortable posture of `solve_position` is kept.
"""

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from rejoint.arms.arm import Arm, Array, Index, frozen
from rejoint.arms.collision import clearances_of, collides, collision_shape, contact, guarded_floors, usual_distances
from rejoint.arms.inertia import link_ends
from rejoint.arms.kinematics import (
    REST_GAIN,
    ROUNDS,
    TOLERANCE,
    chain_of,
    frames,
    goals_of,
    gravity_torque,
    solve_position,
    task,
    tcp_position,
)
from rejoint.arms.rotations import Orientation
from rejoint.arms.workspace import length_size
from rejoint.system.errors import InputError
from rejoint.system.records import entity
from rejoint.system.shell import Late

redundancy = Late("rejoint.arms.redundancy")

MARGIN = np.radians(0.5)
"""[rad] inside the joint limits, as the guard's"""
CLEARANCE, APART, SPACIOUS = 0.010, 0.016, 0.015
"""[m] least clearance to the ground and to boxes, and between links (chosen: worn arms keep 5 mm); sufficient clearance
of a myCobot 280 (chosen)"""
STEP = 0.004
"""[m] of a myCobot 280: motion between checks of a way (chosen)"""
POOL, DRAWN = 8000, 40000
"""Stored and drawn postures (chosen: 18 mm apart for a myCobot 280)"""
Effort = tuple[int, int, int]
"""Moved and improved stored postures, and steps"""
EFFORT: Effort = (40, 4, 10)
"""(chosen)"""
THOROUGH: Effort = (500, 24, 25)
"""The same before a target is refused (chosen)"""
STORED_NEAR = 0.05
"""[m] of a myCobot 280 that counts as much as a cost of one, between stored posture and goal (chosen)"""
NEIGHBOUR, SWITCH = 0.06, 3.0
"""[m] of a myCobot 280 between neighbours, and cost for another branch (chosen)"""
COMFORTABLE = 0.1
"""Largest comfortable cost (chosen: four in five of a myCobot 280)"""
UNLOADED = 0.03
"""Least torque that counts, over the largest joint's"""
SURE = 0.95
"""Share of torque limits at the nearest possible place (chosen)"""
_STEPS, _TRIED = (0.0, *0.5 ** np.arange(1, 10)), 4
_RANKS = np.unique(np.geomspace(1, POOL, 24, dtype=int)) - 1
"""of stored postures from which that place is sought: near ones, and others"""
NEAR, TURNED = 1e-3, np.radians(0.5)
"""[m], [rad] largest misses of a reachable pose (chosen)"""


class Motors(NamedTuple):
    """Torques of an arm's motors."""

    limit: Array
    """(n,) [N m] largest holding torque"""
    usable: Array
    """(n,) [N m] lifted from rest, against friction"""
    damping: Array | float = 0.0
    """(n,) [N m s/rad] torque by which a command leads a turning joint"""
    coulomb: Array | float = 0.0
    """(n,) [N m] friction"""
    armature: Array | float = 0.0
    """(n,) [kg m^2]"""
    stiffness: Array | float = np.inf
    """(n,) [N m/rad] of the servos"""
    delay: float = 0.09
    """[s] command to effect (chosen for unknown servos: worn ones take 0.07 to 0.15 s)"""
    back_emf: Array | float = 0.0
    """(n,) [N m s/rad] part of the damping that takes from the limit"""
    doubt: Array | float = 1.0
    """(n,) factor by which the limit may be higher"""

    @property
    def most(self) -> Array:
        """(n,) [N m] above which a motor surely cannot hold."""
        return self.doubt * self.limit


@entity
class Goals:
    """Postures of K targets."""

    q: Array
    """(K, n) [rad] of the target, or of the nearest possible place"""
    refusals: tuple[str, ...]
    """(K,) reasons and that place in one line; empty: possible"""


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
        preferred are postures that they surely lift; None: no target is too heavy
    chained
        from target to target, on one branch
    thorough
        search 0.4 s before refusing a target

    Returns
    -------
    Goals
        postures and refusals

    Raises
    ------
    InputError
        for boxes that leave no posture
    """
    places, starts = np.asarray(targets, dtype=float), np.asarray(start, dtype=float)
    goals, load = goals_of(places, turn), _load_of(arm, motors)
    q = starts + np.zeros((len(places), arm.joints))
    refusals = [""] * len(places)
    for k, goal in enumerate(goals):
        begin = q[k - 1] if chained and k else q[k]
        near = chained and k > 0 and _neighbours(arm, goal, goals[k - 1])
        found = _choose(arm, load, goal, begin, near)
        if found is None:
            refusals[k], found = _refuse(arm, load, goal, begin) if thorough else ("not found at once", begin)
        q[k] = found
    return Goals(q=q, refusals=tuple(refusals))


def find_postures(
    arm: Arm, target: Array, start: Array, turn: Orientation | None, *, rest_gain: float = REST_GAIN
) -> Array:
    """Postures (B, n) [rad] of poses, found from ``start`` (B, n); ``target`` (B, 3) [m].

    `choose_postures` helps where that ends off the pose or in a contact. A ``rest_gain`` above 0 pulls to rest.
    """
    if turn is None:
        return solve_position(arm, target, start, rest_gain=rest_gain).q
    found = solve_position(arm, target, start, turn=turn, iterations=ROUNDS // 2, rest_gain=rest_gain).q
    off, angle = missed_pose(arm, found, target, turn)
    for b in np.flatnonzero((off >= NEAR) | (angle > TURNED) | collides(arm, found)):
        goals = choose_postures(arm, target[b : b + 1], start[b], turn=turn[np.array([b])])
        found[b] = found[b] if goals.refusals[0] else goals.q[0]
    return found


def missed_pose(arm: Arm, posture: Array, target: Array, turn: Orientation) -> tuple[Array, Array]:
    """Errors (...) [m] and (...) [rad] of postures (..., n) from their poses; NaN: any angle."""
    error = task(arm, posture, target, turn)[0]
    angle = np.linalg.norm(error[..., 3:], axis=-1) / np.where(turn.counts, turn.weight, np.nan)
    return np.linalg.norm(error[..., :3], axis=-1), angle


def comfortable_postures(arm: Arm) -> Array:
    """Postures (P, n) [rad] over the workspace, away from limits and contacts."""
    pool = pool_of(arm)
    return frozen(pool.posture[pool.bare <= max(COMFORTABLE, np.median(pool.bare))])


def _choose(arm: Arm, load: Array, goal: Array, start: Array, near: bool) -> Array | None:
    """Posture (n,) of one goal (17,), or None; ``load`` as in `rejoint.arms.redundancy`."""
    if goal[2] < arm.floor:
        return None
    cost, stayed = redundancy.stay(body_of(arm), goal, start, load, near)
    if cost == 0.0 or (near and cost < SWITCH):
        return stayed
    other, found = _search(arm, load, goal, start, EFFORT)
    if min(cost, other) >= redundancy.FAR:
        return None
    return stayed if cost <= other + near else found


def _search(arm: Arm, load: Array, goal: Array, start: Array, effort: Effort) -> tuple[float, Array]:
    """Cost and best posture (n,) of a goal."""
    drawn = pool_of(arm).posture[_promising(arm, load, goal, start, effort[0])]
    return redundancy.search(body_of(arm), drawn, goal, start, load, *effort[1:])


def _promising(arm: Arm, load: Array, goal: Array, start: Array, count: int) -> Index:
    """Rows (count,) of the pool near the goal and of low cost, the best first."""
    pool = pool_of(arm)
    away = np.linalg.norm(pool.place - goal[:3], axis=-1) / (STORED_NEAR * length_size(arm))
    if goal[16] > 0.0:
        rotation = goal[3:12].reshape(3, 3)
        if goal[16] == 2.0:
            cosine = 0.5 * (np.einsum("krj,rj->k", pool.rotation, rotation) - 1.0)
        else:
            cosine = pool.rotation @ goal[12:15] @ (rotation @ goal[12:15])
        away += 2.0 * np.arccos(np.clip(cosine, -1.0, 1.0))
    travel = (((pool.posture - start) / np.pi) ** 4).sum(axis=-1) ** 0.25
    heavy = np.minimum((np.abs(pool.torque) / load[0] / redundancy.LOAD) ** 4, 20.0).sum(axis=-1)
    return np.argsort(away + 0.3 * (pool.bare + redundancy.TRAVEL * travel) + 0.15 * heavy, kind="stable")[:count]


def _refuse(arm: Arm, load: Array, goal: Array, start: Array) -> tuple[str, Array]:
    """Search thoroughly: the refusal or empty, and the nearest possible posture (n,)."""
    low = goal[2] < arm.floor
    cost, found = (np.inf, start) if low else _search(arm, load, goal, start, THOROUGH)
    if cost < redundancy.FAR:
        return "", found
    away, best, place = _nearby(arm, load, goal, start)
    by, near = "", "no place that works was found"
    if away < np.inf:
        by = f" by {1e3 * away:.1f} mm"
        near = "the nearest place that works is ({:.0f}, {:.0f}, {:.0f}) mm".format(*(1e3 * place + 0.0))
    if low:
        why = f"below the floor at {1e3 * arm.floor:.1f} mm"
    else:
        why = _why(arm, load, goal, start, found if cost < np.inf else None) or f"out of reach{by}"
    return f"{why}; {near}", best


def _why(arm: Arm, load: Array, goal: Array, start: Array, found: Array | None) -> str:
    """Reason why a goal is refused, empty if out of reach; ``found`` (n,): its best posture."""
    if found is None and goal[16] > 0.0:
        cost, place = _search(arm, load, np.append(goal[:16], 0.0), start, THOROUGH)
        if cost < redundancy.FAR:
            return "the orientation cannot be reached there; the place alone can"
        found = place if cost < np.inf else None
    if found is None:
        return ""
    body = body_of(arm)
    room = clearances_of(arm, body.shape, found) - np.append(np.full(arm.joints, -2.0 * TOLERANCE), body.least)
    if room.min() < 0.0:
        cost, found = _search(arm, _load_of(arm, None), goal, start, THOROUGH)
        if cost >= redundancy.FAR:
            what, other = contact(arm, int(np.argmin(room)))
            return f"in collision: {what} would touch {other}"
    return f"too heavy: {too_heavy(arm, found, load[1])[1]}"


def too_heavy(arm: Arm, q: Array, limit: Array) -> tuple[int | None, str]:
    """Return the joint that cannot hold ``q`` (n,) [rad] with the ``limit`` (n,) [N m], or None; and the worst."""
    torque = np.abs(gravity_torque(arm, q))
    j = int(np.argmax(torque / limit))
    share = 100.0 * torque[j] / limit[j]
    least = f"{share:.0f} per cent of the {limit[j]:.2f} that it surely lifts"
    return j if share > 100.0 else None, f"{arm.joint_names[j]} needs {torque[j]:.2f} N m, {least}"


def _nearby(arm: Arm, load: Array, goal: Array, start: Array) -> tuple[float, Array, Array]:
    """Distance [m] of the nearest place in whole mm that works, its posture (n,) and place (3,); infinity: the start's.

    By bisection from stored postures; each place is tried as it will be named.
    """
    load, pool, rows = np.stack([load[0], SURE * load[1]]), pool_of(arm), _promising(arm, load, goal, start, POOL)
    rows = rows[(np.abs(pool.torque[rows]) <= load[1]).all(axis=-1)]
    aim, best = np.append(goal[:2], max(goal[2], arm.floor)), (np.inf, start, tcp_position(arm, start))
    rays = 0
    for begin in pool.place[rows[_RANKS[len(rows) > _RANKS]]]:
        share = 0.0
        for step in _STEPS:
            trial = np.append(1e-3 * np.round(1e3 * (begin + (share + step) * (aim - begin))), goal[3:])
            away = float(np.linalg.norm(trial[:3] - goal[:3]))
            if away < best[0]:
                found = _choose(arm, load, trial, start, False)
                if found is None:
                    if step == 0.0:
                        break
                    continue
                best = away, found, trial[:3]
            share += step
        else:
            rays += 1
        if rays == _TRIED:
            break
    return best


def _neighbours(arm: Arm, goal: Array, other: Array) -> bool:
    """Whether two goals (17,) should share a branch."""
    apart, turned = np.linalg.norm(goal[:3] - other[:3]), np.linalg.norm(goal[3:12] - other[3:12])
    return bool(apart < NEIGHBOUR * length_size(arm) and turned < 0.5)


def _load_of(arm: Arm, motors: Motors | None) -> Array:
    """Torque (2, n) [N m] that counts as one, and the largest."""
    if motors is not None:
        return np.stack([motors.usable / redundancy.LOAD, motors.most])
    torque = np.abs(pool_of(arm).torque).max(axis=0, initial=1e-9)
    return np.stack([np.maximum(torque, UNLOADED * torque.max()), np.full(arm.joints, np.inf)])


@lru_cache
def body_of(arm: Arm) -> Any:  # noqa: ANN401 - `redundancy.Body`, imported when it is first used
    """Return data of an arm for compiled loops."""
    margin = np.minimum(MARGIN, 0.25 * (arm.upper - arm.lower))
    inner = frozen(np.stack([arm.lower + margin, arm.upper - margin]))
    shape, size = collision_shape(arm)._replace(floors=guarded_floors(arm)), length_size(arm)
    least, levers = frozen(_least(arm)), _levers(arm)
    return redundancy.Body(chain_of(arm), shape, inner, least, SPACIOUS * size, levers, STEP * size)


def _levers(arm: Arm) -> Array:
    """Largest change (n + c, n) [m] of `clearances_of` per radian of a joint."""
    shape, joints = collision_shape(arm), arm.joints
    lengths = np.linalg.norm(link_ends(arm), axis=1)
    far = np.array([[lengths[k:link].sum() for k in range(joints)] for link in range(joints + 1)])
    pairs = [np.where(np.arange(joints) >= one, far[other], 0.0) for one, other in shape.pairs]
    ends = [far[end - 1] for end in shape.places]
    boxed = [far[link] for _ in shape.boxes for link in shape.moving]
    return frozen(np.array([*far[1:], *pairs, *ends, *boxed]))


def _least(arm: Arm) -> Array:
    """Least distances (c,) [m]; smaller between usually close links."""
    apart = usual_distances(arm)
    kept = np.full(apart.shape[1], CLEARANCE)
    kept[: len(collision_shape(arm).pairs)] = APART
    usual = np.minimum(kept, 0.5 * np.median(apart, axis=0))
    least = np.where(np.ptp(apart, axis=0) < 1e-6, -np.inf, np.maximum(usual, 0.0))
    least[len(least) - len(collision_shape(arm).moving) * len(arm.keep_out) :] = CLEARANCE
    return least


class Pool(NamedTuple):
    """Stored postures without contacts."""

    posture: Array
    """(N, n) [rad]"""
    place: Array
    """(N, 3) [m] TCP"""
    rotation: Array
    """(N, 3, 3)"""
    torque: Array
    """(N, n) [N m] against gravity"""
    bare: Array
    """(N,) cost without torque and travel"""


@lru_cache(maxsize=32)
def pool_of(arm: Arm) -> Pool:
    """Return stored postures without contacts; InputError: none."""
    rng, body = np.random.default_rng(0), body_of(arm)
    drawn = np.vstack([arm.rest, rng.uniform(body.inner[0], body.inner[1], (DRAWN, arm.joints))])
    bare = np.empty(len(drawn))
    redundancy.judge_all(body, drawn, np.full((2, arm.joints), np.inf), bare)
    free = np.flatnonzero(bare < redundancy.FAR)[:POOL]
    if not len(free):
        cause = "its keep_out boxes leave it no posture" if arm.keep_out else "it touches itself or the ground always"
        raise InputError(f"arm {arm.name}: {cause}, of {DRAWN} that were tried; correct its file")
    posture = drawn[free]
    f = frames(arm, posture)
    return Pool(*map(frozen, (posture, f.tcp_position, f.tcp_rotation, gravity_torque(arm, posture), bare[free])))
