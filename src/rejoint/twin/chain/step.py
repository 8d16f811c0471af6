"""One compiled time step of free serial arms with position servos.

The physics of `rejoint.twin.batch`; dry friction is an impulse per joint by projected Gauss-Seidel.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN201, ANN202, E741 - compiled functions take their types from their arguments; l is a lane
from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from rejoint.twin.chain.dynamics import (
    KEPT_ROW,
    LANES,
    OPTIONS,
    REACH_ROW,
    TORQUE,
    backward,
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
STIFFNESS, OFFSET, LIMIT, DAMPING, ARMATURE, FRICTION = range(6)
"""Rows of the parameters of servos"""


@njit(**OPTIONS)
def step_block(lanes, links, timestep, servo, reference, state, work):
    """Advance ``lanes`` arms of n joints by ``timestep`` (lanes,) [s]; arrays have room for LANES.

    ``servo`` (6, n, lanes), ``reference`` (n, lanes) [rad]; changes ``state``: position, speed, impulse (n, lanes).
    ``work``: `workspace` with minus gravity in its first row.
    """
    position, speed, impulse = state
    kept, inertia, half, inverse, reach, free, next_speed, scratch, sine, cosine = work
    joints = len(links)
    for j in range(joints):
        for l in range(lanes):
            scratch[l] = position[j, l]
        turn(lanes, scratch, sine, cosine)
        forward(lanes, links[j], kept[j], kept[j + 1], speed[j], sine, cosine)
    for j in range(joints - 1, -1, -1):
        coupling(lanes, links, j, kept, reach, inertia)
        if j > 0:
            backward(lanes, links[j], kept[j], kept[j + 1])
        for l in range(lanes):
            h = timestep[l]
            inertia[j, j, l] += servo[ARMATURE, j, l] + h * servo[DAMPING, j, l]
            torque = servo[STIFFNESS, j, l] * (reference[j, l] + servo[OFFSET, j, l] - position[j, l])
            limit = servo[LIMIT, j, l]
            torque = limit if torque > limit else torque
            torque = -limit if torque < -limit else torque
            # The impulse of everything but friction, and with that of the step before as a first guess.
            free[j, l] = h * (torque - kept[j + 1, TORQUE + l] - servo[DAMPING, j, l] * speed[j, l]) + impulse[j, l]
    invert(lanes, joints, inertia, half, inverse, scratch)
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
    shapes = ((joints + 1, KEPT_ROW), square, square, square, REACH_ROW, row, row, LANES, LANES, LANES)
    return tuple(np.zeros(shape) for shape in shapes)
