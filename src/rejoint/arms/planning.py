"""Trajectories between postures: straight in joint space, else with corners; jerk-limited.

Each straight piece has one time-optimal profile for all joints (Biagiotti and Melchiorri, Trajectory Planning for
Automatic Machines and Robots, 2008, section 3.4). At corners pieces overlap in time.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rejoint.arms.arm import Arm, Array, Mask, frozen
from rejoint.arms.collision import clearances_of, contact
from rejoint.arms.kinematics import gravity_torque, link_inertia, tcp_position
from rejoint.arms.postures import Motors, body_of, pool_of, redundancy
from rejoint.arms.workspace import length_size
from rejoint.system.errors import InputError
from rejoint.system.records import entity
from rejoint.system.shell import Late

interpolate = Late("scipy.interpolate")

RAMP, EASE = 0.1, 0.05
"""[s] to full speed, and to full acceleration (chosen: a servo of this class follows both)"""
CLEARANCE = 0.012
"""[m] margin of links (chosen: with half of it, worn arms come nearer than 5 mm)"""
LOW = 0.001
"""[m] margin above floors of a myCobot 280 (chosen)"""
_SPEED = 0.999  # of the limit, so that rounding takes no command beyond what the guard allows
_DRAWN, _SHORTCUTS = 4000, 80
LEAD = np.radians(15.0)
"""[rad] by which commands may lead joints in motion, also those of classical controllers (anti-windup); chosen"""
SLOWEST = 0.2
"""Share of an arm's speed that each motor is trusted with (chosen)"""
LIGHTER, LONGER = 0.95, 0.05
"""Share of the load that makes another trajectory better, and weight of a radian (chosen)"""
SHORTER = 0.995
"""Share of a way's time that makes a shortcut worth it (chosen)"""
_OTHERS, _PARTS = 200, 8
_OVERLAPS = (1.0, 0.75, 0.5, 0.25)
_SAMPLE = 0.002  # [s] between the checks of a corner
_INSTANT = 1e-12  # [s] of a piece that is left out
_ROUNDED = 3e-5  # [m] by which a posture that was chosen at a bound may be beyond it


class PlanningError(InputError):
    """No trajectory found; the message names the obstacle."""


@entity
class JointTrajectory:
    """A jerk-limited motion, in pieces that may overlap."""

    duration: float
    """[s]"""
    start: Array
    """(n,) [rad]"""
    goal: Array
    """(n,) [rad]"""
    moves: Array
    """(m, n) [rad] straight pieces"""
    begins: Array
    """(m,) [s]"""
    shares: tuple[Any, ...]
    """(m,) share of each piece over its time, a `scipy.interpolate.PPoly`"""
    motors: Motors | None = None
    """of the `plan`"""
    heavy: bool = False
    """whether those motors may not lift the arm on it"""

    def at(self, time: Array | float, derivative: int = 0) -> Array:
        """Positions (..., n) [rad] at ``time`` (...) [s], clamped; or a derivative, up to the third."""
        moment = np.asarray(time, dtype=float)
        result = np.zeros((*moment.shape, len(self.goal)))
        for move, begin, share in zip(self.moves, self.begins, self.shares, strict=True):
            past = moment - begin
            value = share(np.clip(past, 0.0, share.x[-1]), derivative)
            moves = (derivative == 0) | ((past >= 0.0) & (past <= share.x[-1]))
            result += np.where(moves, value, 0.0)[..., None] * move
        return result if derivative else np.where(moment[..., None] >= self.duration, self.goal, self.start + result)


def plan(
    arm: Arm,
    start: Array,
    goal: Array,
    *,
    motors: Motors | None = None,
) -> JointTrajectory:
    """Plan a motion between rests, ``start`` (n,) to ``goal`` (n,) [rad].

    The links keep twice, once or half of `CLEARANCE`, as there is a way; less where an end is closer.

    Parameters
    ----------
    arm
        with payload, tool and forbidden boxes
    start, goal
        postures; the start may have a contact
    motors
        their torques: the plan respects their speed, and takes the lightest detour where they may not lift the arm

    Returns
    -------
    JointTrajectory
        the guard does not shorten it

    Raises
    ------
    PlanningError
        the message names the obstacle
    """
    start, goal = np.array(start, dtype=float), np.array(goal, dtype=float)
    found: list[tuple[float, _Field, Array]] = []
    for room in (2.0 * CLEARANCE, CLEARANCE, 0.5 * CLEARANCE):
        if found and room < CLEARANCE:  # rather heavy than so near
            break
        field = _Field.of(arm, start, goal, room)
        share, item = field.passes(start, goal, leaving=True)
        way = np.stack([start, goal]) if share == 1.0 else field.detour(start, goal)
        if way is not None:
            load = 0.0
            if motors:
                way = field.lightest(way, motors)
                load = max(1.0, float(_load(arm, way[None], motors)[0]))
            found.append((load, field, way))
            if load <= 1.0:
                break
    if not found:
        blocked = field.blocked(item, start + share * (goal - start))
        raise PlanningError(f"{blocked}; no way round it was found")
    load, field, way = min(found, key=lambda one: one[0])
    return replace(_timed(field, way, _limits(arm, way, motors)), motors=motors, heavy=load > 1.0)


@entity
class _Field:
    arm: Arm
    body: Any
    """`body_of` it"""
    least: Array
    """(n + c,) [m]"""

    @classmethod
    def of(cls, arm: Arm, start: Array, goal: Array, clearance: float) -> _Field:
        """Field of a trajectory; PlanningError where its goal has a contact."""
        body = body_of(arm)
        least = np.full(arm.joints + len(body.least), clearance)
        least[: arm.joints] = LOW * length_size(arm)
        least[arm.joints : arm.joints + len(body.shape.pairs)] *= 2.0
        always = np.append(np.zeros(arm.joints, dtype=bool), np.isneginf(body.least))
        ends = np.stack([clearances_of(arm, body.shape, q) for q in (start, goal)])
        least = np.where(always, -np.inf, np.minimum(least, np.maximum(ends, -_ROUNDED).min(axis=0)))
        field = cls(arm=arm, body=body, least=frozen(least))
        wrong = (ends[1] < np.minimum(ends[0], 0.0) - _ROUNDED) & ~always
        if wrong.any():
            raise PlanningError(f"goal: {field.blocked(int(np.argmin(np.where(wrong, ends[1], np.inf))), goal)}")
        return field

    def passes(self, start: Array, goal: Array, *, leaving: bool = False) -> tuple[float, int]:
        """Clear share (0 to 1) of a straight piece, and the distance that ends it."""
        return redundancy.passable(self.body, start, goal, self.least, leaving)

    def blocked(self, item: int, q: Array) -> str:
        """Name the obstacle at ``q`` (n,)."""
        at = ", ".join(f"{1e3 * value:.0f}" for value in tcp_position(self.arm, q))
        what, other = contact(self.arm, item)
        return f"{what} would come too near to {other}; the straight way is clear up to ({at}) mm"

    def detour(self, start: Array, goal: Array) -> Array | None:
        """Corners (k, n) of a detour, with its ends; None: none found."""
        rng, (low, high) = np.random.default_rng(0), self.body.inner
        begin = self._left(start, rng)
        if begin is None:
            return None
        drawn = rng.uniform(low, high, (_DRAWN, self.arm.joints))
        near = rng.random(_DRAWN) < 0.6
        spread = rng.uniform(0.2, 1.5, (_DRAWN, 1)) * rng.standard_normal(drawn.shape)
        drawn[near] = (begin + rng.random((_DRAWN, 1)) * (goal - begin) + spread)[near]
        way = redundancy.connect(self.body, begin, goal, np.clip(drawn, low, high), self.least)
        if not len(way):
            return None
        corners = self._shortened(way, rng)
        return corners if begin is start else np.vstack([start, corners])

    def lightest(self, way: Array, motors: Motors) -> Array:
        """Return the way (k, n), or where the ``motors`` may not lift the arm, the clear one that needs least."""
        arm, ends, straight = self.arm, way[[0, -1]], _load(self.arm, way[None], motors)[0]
        if straight <= 1.0:
            return way
        pool = pool_of(arm).posture
        over = pool[np.random.default_rng(0).integers(len(pool), size=_OTHERS)]
        heavy = np.abs(gravity_torque(arm, ends[0])) > motors.usable  # such a joint waits until the others lightened it
        over[::2, heavy] = ends[0, heavy]
        ways = np.stack([np.tile(ends[0], (_OTHERS, 1)), over, np.tile(ends[1], (_OTHERS, 1))], axis=1)
        longest = np.abs(np.diff(ways, axis=1)).max(axis=-1).sum(axis=-1)
        load = np.maximum(_load(arm, ways, motors), 1.0)
        for k in np.argsort(load + LONGER * longest):
            if load[k] > LIGHTER * straight:
                break
            if self.passes(ends[0], over[k], leaving=True)[0] == 1.0 == self.passes(over[k], ends[1])[0]:
                return ways[k]
        return way

    def _left(self, start: Array, rng: np.random.Generator) -> Array | None:
        """Return ``start`` (n,), or the way out of its contact."""
        if self.passes(start, start)[0] == 1.0:
            return start
        for size in np.repeat([0.1, 0.3, 0.6, 1.0], 60):
            trial = np.clip(start + size * rng.standard_normal(self.arm.joints), *self.body.inner)
            if self.passes(start, trial, leaving=True)[0] == 1.0 and self.passes(trial, trial)[0] == 1.0:
                return trial
        return None

    def _shortened(self, way: Array, rng: np.random.Generator) -> Array:
        """Shorten the way (k, n) by straight pieces between random places."""
        for _ in range(_SHORTCUTS):
            if len(way) == 2:
                break
            places = np.sort(rng.uniform(0.0, len(way) - 1.0, 2))
            if rng.random() < 0.5:
                places = np.array([np.floor(places[0]), np.ceil(places[1])])
            first = places.astype(int)
            after = np.minimum(first + 1, len(way) - 1)
            ends = way[first] + (places - first)[:, None] * (way[after] - way[first])
            trial = np.vstack([way[: int(np.ceil(places[0]))], ends, way[int(places[1]) + 1 :]])
            if self._time(trial) < SHORTER * self._time(way) and self.passes(*ends)[0] == 1.0:
                way = trial
        return way

    def _time(self, way: Array) -> float:
        """[s] at full speed along the way (k, n)."""
        return (np.abs(np.diff(way, axis=0)) / self.arm.max_speed).max(axis=-1).sum()


def _torques(arm: Arm, ways: Array, parts: int) -> tuple[Array, Mask]:
    """Gravity (parts, W, k - 1, n) [N m] along ways (W, k, n), and where it is lifted."""
    shares, moves = np.linspace(0.0, 1.0, parts)[:, None, None, None], np.diff(ways, axis=1)
    torque = gravity_torque(arm, ways[:, :-1] + shares * moves)
    return torque, torque * moves > 0.0


def _load(arm: Arm, ways: Array, motors: Motors) -> Array:
    """Largest share (W,) of what ``motors`` give on ways (W, k, n): less for lifting than for holding."""
    torque, lifted = _torques(arm, ways, _PARTS)
    given = np.where(lifted, motors.usable, motors.limit)
    return (np.abs(torque) / given).max(axis=(0, 2, 3))


def _limits(arm: Arm, way: Array, motors: Motors | None) -> Array:
    """Limits (3, n) of speed, acceleration and jerk on the way (k, n)."""
    fastest = _SPEED * arm.max_speed
    acceleration = np.minimum(fastest / RAMP, arm.servo_acceleration)
    if motors is not None:
        torque, lifted = _torques(arm, way[None], 4 * _PARTS)
        against = motors.coulomb + np.where(lifted, np.abs(torque), 0.0).max(axis=(0, 1, 2))
        inertia = motors.armature + link_inertia(arm, np.linspace(way[:-1], way[1:], _PARTS)).max(axis=(0, 1))
        slowest = SLOWEST * np.stack([fastest, acceleration])
        for most, drag in ((motors.limit, motors.back_emf), (LEAD * motors.stiffness, motors.damping)):
            left = most - against
            fastest = np.clip(left / np.maximum(drag, 1e-9), slowest[0], fastest)
            spare = (left - 0.5 * drag * fastest) / inertia  # half way to full speed
            acceleration = np.clip(spare, slowest[1], acceleration)
    return np.stack([fastest, acceleration, acceleration / EASE])


def _timed(field: _Field, way: Array, limits: Array) -> JointTrajectory:
    """Motion along the corners (k, n), with overlapping pieces where allowed."""
    moves = np.diff(way, axis=0)
    moves = moves[np.abs(moves).max(axis=-1) > 1e-12]
    shares = tuple(_share(move, limits) for move in moves)
    overlaps = np.zeros(max(len(moves) - 1, 0))
    for k in range(len(overlaps)):
        for overlap in np.multiply(_OVERLAPS, min(shares[k].x[3], shares[k + 1].x[3])):  # of full ramps
            corner = _assembled(way[k : k + 3], moves[k : k + 2], shares[k : k + 2], np.array([overlap]))
            if _corner_holds(field, corner, limits):
                overlaps[k] = overlap
                break
    return _assembled(way, moves, shares, overlaps)


def _assembled(way: Array, moves: Array, shares: tuple[Any, ...], overlaps: Array) -> JointTrajectory:
    lengths = np.array([share.x[-1] for share in shares])
    begins = np.append(0.0, np.cumsum(lengths[:-1] - overlaps))[: len(moves)]
    duration = float((begins + lengths).max(initial=0.0))
    return JointTrajectory(duration=duration, start=way[0], goal=way[-1], moves=moves, begins=begins, shares=shares)


def _corner_holds(field: _Field, corner: JointTrajectory, limits: Array) -> bool:
    first, last = corner.begins[1], corner.shares[0].x[-1]
    inside = np.concatenate([corner.shares[0].x, first + corner.shares[1].x])
    inside = inside[(inside > first) & (inside < last)]
    time = np.union1d(np.linspace(first, last, 2 + int((last - first) / _SAMPLE)), np.append(inside, inside + 1e-9))
    for order in (1, 2, 3):
        if (np.abs(corner.at(time, order)) > limits[order - 1] * (1.0 + 1e-6)).any():
            return False
    return bool((clearances_of(field.arm, field.body.shape, corner.at(time)) >= field.least - 1e-7).all())


def _share(move: Array, limits: Array) -> Any:  # noqa: ANN401 - a PPoly of an untyped library
    """Share of a straight ``move`` (n,) between rests, over time: constant jerk in seven pieces."""
    speed, acceleration, jerk = (limits / np.maximum(np.abs(move), 1e-12)).min(axis=1)
    # The speed from which braking must begin at once: without constant acceleration, and with it.
    peak = np.cbrt(jerk / 4.0)
    if peak * jerk > acceleration**2:
        ramp = acceleration / jerk
        peak = 0.5 * acceleration * (np.sqrt(ramp**2 + 4.0 / acceleration) - ramp)
    speed = min(speed, peak)
    ramp = min(acceleration / jerk, np.sqrt(speed / jerk))
    steady = speed / (jerk * ramp) - ramp
    cruise = 1.0 / speed - 2.0 * ramp - steady
    times = np.maximum([ramp, steady, ramp, cruise, ramp, steady, ramp], _INSTANT)
    jerks = jerk * np.array([[1.0, 0.0, -1.0, 0.0, -1.0, 0.0, 1.0]])
    return interpolate.PPoly(jerks, np.append(0.0, np.cumsum(times))).antiderivative(3)
