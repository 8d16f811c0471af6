"""The compiled loop over blocks of arms and steps."""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN202 - compiled functions take their types from their arguments
from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
from numba import njit

from rejoint.twin import friction
from rejoint.twin.chain import dynamics, step
from rejoint.twin.chain.dynamics import ACCELERATION, GROUP, LANES, OPTIONS
from rejoint.twin.chain.step import FRICTION, step_block

_dry_friction = njit(inline="always")(friction.dry_friction)


def _compiled(sources):
    """Compile the loop; cached until this file or its ``sources`` change."""

    @njit(**OPTIONS)
    def advance(links, motors, gravity, timestep, control, state, path, part):
        """Advance the arms of a ``part``; copies of the last arm fill the last group."""
        (parameters, terms, steady), (qpos, qvel, impulse), (first, last, work) = motors, state, part
        joints = len(links)
        h = np.empty(LANES)
        servo = np.empty((len(parameters), joints, LANES))
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
                    if steady:
                        servo[FRICTION, j, lane] = dry[0, j, lane]
                    position[j, lane], speed[j, lane], push[j, lane] = qpos[i, j], qvel[i, j], impulse[i, j]
            for k in range(control.shape[1]):
                for lane in range(lanes):
                    i = min(begin + lane, last - 1)
                    for j in range(joints):
                        reference[j, lane] = control[i, k, j]
                        if not steady:
                            servo[FRICTION, j, lane] = _dry_friction(dry[:, j, lane], speed[j, lane])
                step_block(lanes, links, h, servo, reference, (position, speed, push), work)
                for lane in range(count):
                    for j in range(joints):
                        path[begin + lane, k, j] = position[j, lane]
            for lane in range(count):
                for j in range(joints):
                    qpos[begin + lane, j], qvel[begin + lane, j] = position[j, lane], speed[j, lane]
                    impulse[begin + lane, j] = push[j, lane]
        return sources

    return advance


advance = _compiled(zlib.crc32(b"".join(Path(str(part.__file__)).read_bytes() for part in (friction, dynamics, step))))
