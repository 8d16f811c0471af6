"""Compiled time steps of some dozen free serial arms with position servos at once.

Bias forces by recursive Newton-Euler, inertia by composite bodies (Featherstone 2008, chapters 5 and 6), about the
base's origin, so that bodies add. Link frames have their joint as z axis. Loops over arms vectorize with arrays without
overlap (`NoAlias`), one row per quantity, only `INLINE` calls, and an unknown number of lanes.

The physics of `rejoint.twin.table`; dry friction is an impulse per joint by projected Gauss-Seidel.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN201, ANN202, E741 - compiled functions take their types from their arguments; l is a lane
import zlib
from pathlib import Path

import numpy as np
from numba import njit
from numba.core.compiler import Compiler
from numpy.typing import NDArray

from rejoint.twin import parameters

LANES, GROUP = 64, 8
"""Arms stepped together, at most, and their granularity; chosen"""
ROTATION, PLACE, MASS, MOMENT, INERTIA, CARRIED, LINK = 0, 9, 12, 13, 16, 22, 23
"""Indices of a link's constants: columns of the rotation, and place, of its joint; mass, first moment and inertia about
it; the mass behind it; their number"""
VECTOR = 3 * LANES
# Where the vectors of a joint begin in the row of it that is kept, LANES numbers of each element: columns of its
# rotation, place, moment of its axis about the origin, angular and linear velocity and acceleration, torque (a number);
# and, of all that it carries, force, moment, first moment and inertia (xx, yy, zz; xy, xz, yz).
X, Y, Z, AT, AXIS, SPIN, SPEED, TURN, ACCELERATION, TORQUE, FORCE, MOMENT_OF, FIRST, SPREAD, SKEW, KEPT_ROW = range(
    0, 16 * VECTOR, VECTOR
)
_LINEAR, _ANGULAR, REACH_ROW = 0, VECTOR, 2 * VECTOR  # momentum of a joint's unit motion


class NoAlias(Compiler):  # type: ignore[misc]
    """Numba's compiler for arrays that do not overlap."""

    def define_pipelines(self):
        """Set the flag that Numba's decorators lack."""
        self.state.flags.noalias = True
        return super().define_pipelines()


OPTIONS = {"nogil": True, "cache": True, "pipeline_class": NoAlias, "error_model": "numpy"}
INLINE = {"inline": "always", "error_model": "numpy"}


@njit(**INLINE)
def _load(row, first, l):
    return row[first + l], row[first + LANES + l], row[first + 2 * LANES + l]


@njit(**INLINE)
def _store(row, first, l, a):
    row[first + l], row[first + LANES + l], row[first + 2 * LANES + l] = a


@njit(**INLINE)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(**INLINE)
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(**INLINE)
def _plus(a, b, factor):
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


@njit(**INLINE)
def _constants(link, first):
    return link[first], link[first + 1], link[first + 2]


@njit(**INLINE)
def _turned(columns, a):
    """Multiply a vector by a matrix, such as a rotation, with these columns."""
    x, y, z = columns
    return (
        x[0] * a[0] + y[0] * a[1] + z[0] * a[2],
        x[1] * a[0] + y[1] * a[1] + z[1] * a[2],
        x[2] * a[0] + y[2] * a[1] + z[2] * a[2],
    )


@njit(**INLINE)
def _product(columns, others):
    return _turned(columns, others[0]), _turned(columns, others[1]), _turned(columns, others[2])


@njit(**INLINE)
def _symmetric(diagonal, beside):
    (xx, yy, zz), (xy, xz, yz) = diagonal, beside
    return (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)


@njit(**INLINE)
def _spun(row, l, a):
    return _turned(_symmetric(_load(row, SPREAD, l), _load(row, SKEW, l)), a)


@njit(**OPTIONS)
def turn(lanes, q, sine, cosine):
    """Sine and cosine of angles (lanes,) [rad]; in a loop of their own, for calls stop the compiler's vectors."""
    for l in range(lanes):
        sine[l], cosine[l] = np.sin(q[l]), np.cos(q[l])


@njit(**OPTIONS)
def forward(lanes, link, before, here, speed, sine, cosine):
    """Carry motion from the joint ``before``; store the link's inertia, inertial force and moment."""
    joint = _constants(link, ROTATION), _constants(link, ROTATION + 3), _constants(link, ROTATION + 6)
    inertia = _symmetric(_constants(link, INERTIA), _constants(link, INERTIA + 3))
    place, first, mass, none = _constants(link, PLACE), _constants(link, MOMENT), link[MASS], (0.0, 0.0, 0.0)
    for l in range(lanes):
        s, c, v = sine[l], cosine[l], speed[l]
        base = _load(before, X, l), _load(before, Y, l), _load(before, Z, l)
        a, b, z = _product(base, joint)
        x, y = _plus(_plus(none, a, c), b, s), _plus(_plus(none, b, c), a, -s)
        frame = x, y, z
        _store(here, X, l, x)
        _store(here, Y, l, y)
        _store(here, Z, l, z)
        at = _plus(_load(before, AT, l), _turned(base, place), 1.0)
        axis = _cross(at, z)
        _store(here, AT, l, at)
        _store(here, AXIS, l, axis)
        w, u = _plus(_load(before, SPIN, l), z, v), _plus(_load(before, SPEED, l), axis, v)
        _store(here, SPIN, l, w)
        _store(here, SPEED, l, u)
        dw = _plus(_load(before, TURN, l), _cross(w, z), v)
        du = _plus(_plus(_load(before, ACCELERATION, l), _cross(w, axis), v), _cross(u, z), v)
        _store(here, TURN, l, dw)
        _store(here, ACCELERATION, l, du)
        # First moment h; inertia: R I R', then the parallel axis.
        h = _turned(frame, first)
        g = _plus(h, at, 0.5 * mass)
        h = _plus(h, at, mass)
        _store(here, FIRST, l, h)
        back = (x[0], y[0], z[0]), (x[1], y[1], z[1]), (x[2], y[2], z[2])
        e, f, t = _product(_product(frame, inertia), back)
        sx, sy, sz = at[0] * g[0], at[1] * g[1], at[2] * g[2]
        _store(here, SPREAD, l, _plus((e[0], f[1], t[2]), (sy + sz, sx + sz, sx + sy), 2.0))
        cross = at[0] * g[1] + at[1] * g[0], at[0] * g[2] + at[2] * g[0], at[1] * g[2] + at[2] * g[1]
        _store(here, SKEW, l, _plus((e[1], e[2], f[2]), cross, -1.0))
        # Momentum p and k, and what changes it: force and moment.
        p = _plus(_cross(w, h), u, mass)
        k = _plus(_spun(here, l, w), _cross(h, u), 1.0)
        _store(here, FORCE, l, _plus(_plus(_cross(dw, h), du, mass), _cross(w, p), 1.0))
        moment = _plus(_spun(here, l, dw), _cross(h, du), 1.0)
        _store(here, MOMENT_OF, l, _plus(_plus(moment, _cross(w, k), 1.0), _cross(u, p), 1.0))


@njit(**OPTIONS)
def coupling(lanes, mass, j, kept, reach, inertia):
    """Fill row ``j`` of the ``inertia`` (n, n, LANES) and its torque; add what it carries to the joint before."""
    here, before = kept[j + 1], kept[j]
    for l in range(lanes):
        z, axis, h = _load(here, Z, l), _load(here, AXIS, l), _load(here, FIRST, l)
        _store(reach, _LINEAR, l, _plus(_cross(z, h), axis, mass))
        _store(reach, _ANGULAR, l, _plus(_spun(here, l, z), _cross(h, axis), 1.0))
        here[TORQUE + l] = _dot(z, _load(here, MOMENT_OF, l)) + _dot(axis, _load(here, FORCE, l))
    for i in range(j + 1):
        there, row = kept[i + 1], inertia[j, i]
        for l in range(lanes):
            turning = _dot(_load(there, Z, l), _load(reach, _ANGULAR, l))
            row[l] = turning + _dot(_load(there, AXIS, l), _load(reach, _LINEAR, l))
    for k in range(FORCE, KEPT_ROW, LANES):
        for l in range(lanes):
            before[k + l] += here[k + l]


@njit(**OPTIONS)
def invert(lanes, joints, inertia, inverse, column, factor):
    """Invert positive definite matrices (n, n, LANES), given as lower half, by sweeps (Goodnight 1979)."""
    for k in range(joints):
        for l in range(lanes):
            factor[l] = -1.0 / inertia[k, k, l]
        for i in range(joints):
            row = inertia[i, k] if i > k else inertia[k, i]
            for l in range(lanes):
                column[i, l] = row[l]
        for i in range(joints):
            for j in range(i + 1):
                for l in range(lanes):
                    inertia[i, j, l] += factor[l] * column[i, l] * column[j, l]
        for i in range(joints):
            row = inertia[i, k] if i > k else inertia[k, i]
            for l in range(lanes):
                row[l] = factor[l] if i == k else -factor[l] * column[i, l]
    for i in range(joints):
        for j in range(i + 1):
            for l in range(lanes):
                inverse[i, j, l] = -inertia[i, j, l]
            for l in range(lanes):
                inverse[j, i, l] = -inertia[i, j, l]


SWEEPS = 5
"""Gauss-Seidel sweeps; chosen"""
SOFTNESS = 1e-6
"""Softness of friction, relative to a free joint"""
KEPT = 1.0 - 1.0 / 0.9999
"""Share of speed that a stopped joint keeps"""
STIFFNESS, OFFSET, LIMIT, DAMPING, ARMATURE, GAIN, FRICTION, TERMS = range(8)
"""Rows of the parameters of servos; ``GAIN``: the part of ``DAMPING`` within the limit; from ``TERMS`` on the terms of
`dry_friction`, of which `step_block` makes ``FRICTION``"""


_dry_friction = njit(inline="always")(parameters.dry_friction)


@njit(**OPTIONS | {"cache": False})  # cached in `advance`, which knows the law of friction
def step_block(lanes, links, timestep, servo, reference, state, work):
    """Advance ``lanes`` arms of n joints by ``timestep`` (lanes,) [s]; arrays have room for LANES.

    ``servo`` (TERMS + t, n, lanes) with t terms, ``reference`` (n, lanes) [rad]; changes ``state``: position, speed,
    impulse (n, lanes).
    ``work``: `workspace` with minus gravity in its first row, the base's.
    """
    position, speed, impulse = state
    kept, inertia, inverse, reach, column, free, next_speed, scratch, sine, cosine = work
    joints = len(links)
    for j in range(joints):
        turn(lanes, position[j], sine, cosine)
        forward(lanes, links[j], kept[j], kept[j + 1], speed[j], sine, cosine)
    for j in range(joints - 1, -1, -1):
        coupling(lanes, links[j, CARRIED], j, kept, reach, inertia)
        for l in range(lanes):
            h = timestep[l]
            gain, beside = servo[GAIN, j, l], servo[DAMPING, j, l] - servo[GAIN, j, l]
            torque = servo[STIFFNESS, j, l] * (reference[j, l] + servo[OFFSET, j, l] - position[j, l])
            torque -= gain * speed[j, l]
            limit = servo[LIMIT, j, l]
            gain = gain if abs(torque) < limit else 0.0
            inertia[j, j, l] += servo[ARMATURE, j, l] + h * (beside + gain)
            torque = min(max(torque, -limit), limit)
            # The impulse of everything but friction, and with that of the step before as a first guess.
            scratch[l] = 0.5 * abs(
                torque + kept[j + 1, TORQUE + l]
            )  # the mean of what drives gears and what they drive
            free[j, l] = h * (torque - kept[j + 1, TORQUE + l] - beside * speed[j, l]) + impulse[j, l]
        for l in range(lanes):  # a loop of its own: that above has no exponential function, and is vectorised
            servo[FRICTION, j, l] = _dry_friction(servo[TERMS:, j, l], speed[j, l], scratch[l])
    invert(lanes, joints, inertia, inverse, column, scratch)
    for i in range(joints):
        row = next_speed[i]
        for l in range(lanes):
            row[l] = speed[i, l]
        for k in range(joints):
            for l in range(lanes):
                row[l] += inverse[i, k, l] * free[k, l]
    _rest(lanes, timestep, servo, speed, impulse, inverse, next_speed, scratch)
    for j in range(joints):
        for l in range(lanes):
            v = next_speed[j, l]
            speed[j, l] = v
            position[j, l] += timestep[l] * v


@njit(**OPTIONS)
def _rest(lanes, timestep, servo, speed, impulse, inverse, next_speed, scratch):
    """Find the impulses of dry friction, and the ``next_speed`` by them."""
    joints = len(speed)
    for _ in range(SWEEPS):
        for j in range(joints):
            for l in range(lanes):
                own = inverse[j, j, l]
                most = timestep[l] * servo[FRICTION, j, l]
                old = impulse[j, l]
                wrong = next_speed[j, l] - KEPT * speed[j, l] + SOFTNESS * own * old
                new = min(max(old - wrong / (own * (1.0 + SOFTNESS)), -most), most)
                impulse[j, l] = new
                scratch[l] = new - old
            for i in range(joints):
                for l in range(lanes):
                    next_speed[i, l] += inverse[i, j, l] * scratch[l]


def workspace(joints: int) -> tuple[NDArray[np.float64], ...]:
    """Allocate the scratch arrays of a block."""
    square, row = (joints, joints, LANES), (joints, LANES)
    shapes = ((joints + 1, KEPT_ROW), square, square, REACH_ROW, row, row, row, LANES, LANES, LANES)
    arrays = tuple(np.zeros(shape) for shape in shapes)
    arrays[0][0, : 9 * LANES] = np.repeat(np.eye(3).ravel(), LANES)  # the base is not turned
    return arrays


# Backlash inside the servo loop: an unloaded joint rests anywhere between the flanks; to turn it back the motor first
# crosses the backlash. Logs do not separate it from friction: only training draws it. Out of contact, motor and joint
# are two bodies; they exchange momentum when they meet (Nordin and Gutman 2002).
RESTITUTION = 0.5
"""Of motor and joint; chosen: greased steel"""

SOFT = 0.01
"""[rad/s] closing speed without rebound; chosen"""


@njit(**OPTIONS)
def cross(gear, link, motor, lead, speed, step):
    """Move one motor for ``step`` [s]; return whether it was free, and the joint's speed.

    ``gear``: half the backlash [rad] and, changed, the motor's place ahead of the joint [rad], speed [rad/s] and flank
    (1, -1, or 0: between them). ``link``: inertia [kg m^2] of what the joint turns. ``motor``: rows of its parameters.
    ``lead`` [rad] of the command, ``speed`` [rad/s] of the joint.
    """
    edge, place, v, flank = gear[0], gear[1], gear[2], gear[3]
    limit, damping, armature = motor[LIMIT], motor[DAMPING], motor[ARMATURE]
    friction = _dry_friction(motor[TERMS:], speed if flank != 0.0 else v, 0.0)
    torque = min(max(motor[STIFFNESS] * lead, -limit), limit)
    if flank != 0.0:
        at_rest = abs(speed) < 1e-3
        net = torque - np.sign(torque if at_rest else speed) * friction - damping * speed
        if (at_rest and abs(torque) <= friction) or net * flank >= 0.0:
            return False, speed  # the motor pushes, or both stand still
        flank, v = 0.0, speed
    if v != 0.0 or abs(torque) > friction:
        against = np.sign(v) if v != 0.0 else np.sign(torque)
        h = step / armature
        v = (v + h * (torque - against * friction)) / (1.0 + h * damping)
        v = v if v * against > 0.0 else 0.0  # friction stops a motor, it does not turn it back
    place += step * (v - speed)
    if abs(place) >= edge:
        place = np.sign(place) * edge
        closing, whole = v - speed, armature + link
        common = (armature * v + link * speed) / whole
        bounce = RESTITUTION if abs(closing) > SOFT else 0.0
        v = common - bounce * closing * link / whole
        speed = common + bounce * closing * armature / whole
        if bounce == 0.0:
            flank = np.sign(place)
    gear[1], gear[2], gear[3] = place, v, flank
    return True, speed


def _compiled(source):
    """Compile the loop over blocks of arms and steps; cached until this file or the digest of its ``source`` change."""

    @njit(**OPTIONS)
    def advance(links, motors, gears, world, control, state, path, part):
        """Advance the arms of a ``part``; copies of the last arm fill the last group."""
        (qpos, qvel, impulse), (first, last, work) = state, part
        (gear, carried, geared), (gravity, timestep) = gears, world
        joints = len(links)
        h = np.empty(LANES)
        servo = np.empty((len(motors), joints, LANES))
        reference, position = np.empty((joints, LANES)), np.empty((joints, LANES))
        speed, push = np.empty((joints, LANES)), np.empty((joints, LANES))
        for begin in range(first, last, LANES):
            count = min(LANES, last - begin)
            lanes = -(-count // GROUP) * GROUP
            for lane in range(lanes):
                i = min(begin + lane, last - 1)
                h[lane] = timestep[i]
                for axis in range(3):
                    work[0][0, ACCELERATION + LANES * axis + lane] = -gravity[i, axis]
                for j in range(joints):
                    for k in range(len(motors)):
                        servo[k, j, lane] = motors[k, i, j]
                    position[j, lane], speed[j, lane], push[j, lane] = qpos[i, j], qvel[i, j], impulse[i, j]
            for k in range(control.shape[1]):
                for lane in range(lanes):
                    i = min(begin + lane, last - 1)
                    for j in range(joints):
                        reference[j, lane] = control[i, k, j]
                if geared:
                    for lane in range(count):
                        for j in range(joints):
                            i = begin + lane
                            own, motor = gear[:, i, j], motors[:, i, j]
                            if own[0] == 0.0:
                                continue
                            lead = reference[j, lane] + motor[OFFSET] - position[j, lane]
                            free, speed[j, lane] = cross(own, carried[j], motor, lead, speed[j, lane], h[lane])
                            if free:
                                reference[j, lane] = position[j, lane] - motor[OFFSET]
                            alone = own[3] == 0.0  # the joint, without its motor
                            servo[ARMATURE, j, lane] = 0.0 if alone else motor[ARMATURE]
                            servo[DAMPING, j, lane] = motor[DAMPING] * (own[4] if alone else 1.0)
                            servo[GAIN, j, lane] = 0.0 if alone else motor[GAIN]
                            for t in range(TERMS, len(motors)):
                                servo[t, j, lane] = 0.0 if alone else motor[t]
                step_block(lanes, links, h, servo, reference, (position, speed, push), work)
                for lane in range(count):
                    for j in range(joints):
                        path[begin + lane, k, j] = position[j, lane]
            for lane in range(count):
                for j in range(joints):
                    qpos[begin + lane, j], qvel[begin + lane, j] = position[j, lane], speed[j, lane]
                    impulse[begin + lane, j] = push[j, lane]
        return source

    return advance


advance = _compiled(zlib.crc32(Path(str(parameters.__file__)).read_bytes()))
