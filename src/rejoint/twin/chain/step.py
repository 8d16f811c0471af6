"""Compiled time steps of free serial arms with position servos.

The physics of `rejoint.twin.table`; dry friction is an impulse per joint by projected Gauss-Seidel.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN201, ANN202, E741 - compiled functions take their types from their arguments; l is a lane
from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rejoint.twin import parameters
from rejoint.twin.chain import dynamics
from rejoint.twin.chain.dynamics import (
    ACCELERATION,
    CARRIED,
    GROUP,
    KEPT_ROW,
    LANES,
    OPTIONS,
    REACH_ROW,
    TORQUE,
    coupling,
    forward,
    invert,
    turn,
)

SWEEPS = 5
"""Gauss-Seidel sweeps; chosen"""
SOFTNESS = 1e-6
"""Softness of friction, relative to a free joint"""
KEPT = 1.0 - 1.0 / 0.9999
"""Share of speed that a stopped joint keeps"""
STIFFNESS, OFFSET, LIMIT, DAMPING, ARMATURE, GAIN, FRICTION = range(7)
"""Rows of the parameters of servos; ``GAIN``: the part of ``DAMPING`` within the limit"""


_dry_friction = njit(inline="always")(parameters.dry_friction)


@njit(**OPTIONS | {"cache": False})  # cached in `advance`, which knows the law of friction
def step_block(lanes, links, timestep, servo, dry, reference, state, work):
    """Advance ``lanes`` arms of n joints by ``timestep`` (lanes,) [s]; arrays have room for LANES.

    ``servo`` (7, n, lanes), ``dry`` (t, n, lanes) of `dry_friction`, ``reference`` (n, lanes) [rad]; changes
    ``state``: position, speed, impulse (n, lanes).
    ``work``: `workspace` with minus gravity in its first row, the base's.
    """
    position, speed, impulse = state
    kept, inertia, inverse, reach, column, free, next_speed, scratch, sine, cosine = work
    joints = len(links)
    for j in range(joints):
        for l in range(lanes):
            scratch[l] = position[j, l]
        turn(lanes, scratch, sine, cosine)
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
            torque = limit if torque > limit else torque
            torque = -limit if torque < -limit else torque
            # The impulse of everything but friction, and with that of the step before as a first guess.
            scratch[l] = 0.5 * abs(
                torque + kept[j + 1, TORQUE + l]
            )  # the mean of what drives gears and what they drive
            free[j, l] = h * (torque - kept[j + 1, TORQUE + l] - beside * speed[j, l]) + impulse[j, l]
        for l in range(lanes):  # a loop of its own: that above has no exponential function, and is vectorised
            servo[FRICTION, j, l] = _dry_friction(dry[:, j, l], speed[j, l], scratch[l])
    invert(lanes, joints, inertia, inverse, column, scratch)
    for i in range(joints):
        for l in range(lanes):
            scratch[l] = speed[i, l]
        for k in range(joints):
            for l in range(lanes):
                scratch[l] += inverse[i, k, l] * free[k, l]
        for l in range(lanes):
            next_speed[i, l] = scratch[l]
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
                new = old - wrong / (own * (1.0 + SOFTNESS))
                new = most if new > most else new
                new = -most if new < -most else new
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


@njit(cache=True, nogil=True, error_model="numpy")
def cross(gear, motor, lead, speed, friction, step):
    """Move one motor for ``step`` [s]; return its place, speed and flank, whether it was free, and the joint's speed.

    ``gear``: half the backlash [rad], place ahead of the joint [rad], speed [rad/s], flank (1, -1, or 0: between them)
    and inertia [kg m^2] of what the joint turns. ``motor``: stiffness, torque limit, damping and armature. ``lead``
    [rad] of the command, ``speed`` [rad/s] of the joint, dry ``friction`` [N m].
    """
    (edge, place, v, flank, link), (stiffness, limit, damping, armature) = gear, motor
    torque = min(max(stiffness * lead, -limit), limit)
    if flank != 0.0:
        at_rest = abs(speed) < 1e-3
        net = torque - np.sign(torque if at_rest else speed) * friction - damping * speed
        if (at_rest and abs(torque) <= friction) or net * flank >= 0.0:
            return place, v, flank, False, speed  # the motor pushes, or both stand still
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
    return place, v, flank, True, speed


def _compiled(sources):
    """Compile the loop over blocks of arms and steps; cached until this file or its ``sources`` change."""

    @njit(**OPTIONS)
    def advance(links, motors, gears, world, control, state, path, part):
        """Advance the arms of a ``part``; copies of the last arm fill the last group."""
        (parameters, terms), (qpos, qvel, impulse), (first, last, work) = motors, state, part
        (gear, carried, geared), (gravity, timestep) = gears, world
        joints = len(links)
        h = np.empty(LANES)
        servo = np.empty((len(parameters) + 1, joints, LANES))
        dry = np.empty((len(terms), joints, LANES))
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
                    for k in range(len(parameters)):
                        servo[k, j, lane] = parameters[k, i, j]
                    for k in range(len(terms)):
                        dry[k, j, lane] = terms[k, i, j]
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
                            half, place, v, flank, grease = gear[:, i, j]
                            if half == 0.0:
                                continue
                            turned = speed[j, lane] if flank != 0.0 else v
                            friction = _dry_friction(terms[:, i, j], turned, 0.0)
                            motor = parameters[:, i, j]
                            place, v, flank, free, speed[j, lane] = cross(
                                (half, place, v, flank, carried[j]),
                                (motor[STIFFNESS], motor[LIMIT], motor[DAMPING], motor[ARMATURE]),
                                reference[j, lane] + motor[OFFSET] - position[j, lane],
                                speed[j, lane],
                                friction,
                                h[lane],
                            )
                            gear[1, i, j], gear[2, i, j], gear[3, i, j] = place, v, flank
                            if free:
                                reference[j, lane] = position[j, lane] - motor[OFFSET]
                            alone = flank == 0.0  # the joint, without its motor
                            servo[ARMATURE, j, lane] = 0.0 if alone else motor[ARMATURE]
                            servo[DAMPING, j, lane] = motor[DAMPING] * (grease if alone else 1.0)
                            servo[GAIN, j, lane] = 0.0 if alone else motor[GAIN]
                            for t in range(len(terms)):
                                dry[t, j, lane] = 0.0 if alone else terms[t, i, j]
                step_block(lanes, links, h, servo, dry, reference, (position, speed, push), work)
                for lane in range(count):
                    for j in range(joints):
                        path[begin + lane, k, j] = position[j, lane]
            for lane in range(count):
                for j in range(joints):
                    qpos[begin + lane, j], qvel[begin + lane, j] = position[j, lane], speed[j, lane]
                    impulse[begin + lane, j] = push[j, lane]
        return sources

    return advance


advance = _compiled(zlib.crc32(b"".join(Path(str(part.__file__)).read_bytes() for part in (parameters, dynamics))))
