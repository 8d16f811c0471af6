"""The step of `rejoint.twin.chain.step` as a kernel of NVIDIA Warp: one thread an arm, all steps of a call in it.

The same physics in the same order, in vectors of three where the other one has lanes: bias forces by recursive
Newton-Euler, inertia by composite bodies (Featherstone 2008, chapters 5 and 6), friction by Gauss-Seidel sweeps. In
double precision: an arm moves as on a processor, but for the last digits of sines, sums and roots.
"""

# mypy: ignore-errors
# ruff: noqa: ANN202, ANN401 - this is read by Warp's compiler, whose types are its own
from functools import cache
from typing import Any

import warp as wp

from rejoint.twin.chain.dynamics import CARRIED, INERTIA, MASS, MOMENT, PLACE
from rejoint.twin.chain.step import ARMATURE, DAMPING, KEPT, LIMIT, OFFSET, SOFTNESS, STIFFNESS, SWEEPS
from rejoint.twin.friction import STRIBECK_SPEED

# Numbers within a kernel are of single precision, these are not.
_SLOW, _KEPT = wp.constant(wp.float64(STRIBECK_SPEED)), wp.constant(wp.float64(KEPT))
_SOFT, _YIELDING = wp.constant(wp.float64(SOFTNESS)), wp.constant(wp.float64(1.0 + SOFTNESS))

_LINKS = wp.array2d(dtype=wp.float64)
_BY_STEP = wp.array3d(dtype=wp.float64)


@wp.func
def _vector(links: _LINKS, j: int, first: int) -> wp.vec3d:
    return wp.vec3d(links[j, first], links[j, first + 1], links[j, first + 2])


@wp.func
def _inertia(links: _LINKS, j: int) -> wp.mat33d:
    xx, yy, zz = links[j, INERTIA], links[j, INERTIA + 1], links[j, INERTIA + 2]
    xy, xz, yz = links[j, INERTIA + 3], links[j, INERTIA + 4], links[j, INERTIA + 5]
    return wp.mat33d(xx, xy, xz, xy, yy, yz, xz, yz, zz)


@wp.func
def _turn(links: _LINKS, j: int, angle: wp.float64) -> wp.mat33d:
    """Rotation from the frame of joint ``j`` to the one before: that of the link, then about z."""
    zero, one, s, c = wp.float64(0.0), wp.float64(1.0), wp.sin(angle), wp.cos(angle)
    fixed = wp.mat33d(
        links[j, 0], links[j, 1], links[j, 2], links[j, 3], links[j, 4], links[j, 5], links[j, 6], links[j, 7],
        links[j, 8],
    )  # fmt: skip
    return fixed * wp.mat33d(c, -s, zero, s, c, zero, zero, zero, one)


@wp.func
def _row(rows: Any, j: int) -> wp.vec3d:
    return wp.vec3d(rows[j, 0], rows[j, 1], rows[j, 2])


@wp.func
def _dry_friction(terms: _BY_STEP, i: int, j: int, speed: wp.float64) -> wp.float64:
    """Friction as in `rejoint.twin.friction.dry_friction`."""
    ratio, one = speed / _SLOW, wp.float64(1.0)
    return terms[0, i, j] * (one + (terms[terms.shape[0] - 1, i, j] - one) * wp.exp(-ratio * ratio))


@cache
def step_kernel(joints: int) -> wp.Kernel:
    """Make the kernel for arms of so many joints; Warp compiles it at its first launch, and keeps it on disk."""
    vector = wp.types.vector(length=joints, dtype=wp.float64)
    square = wp.types.matrix(shape=(joints, joints), dtype=wp.float64)
    triples = wp.types.matrix(shape=(joints, 3), dtype=wp.float64)
    tensors = wp.types.matrix(shape=(3 * joints, 3), dtype=wp.float64)

    @wp.kernel(enable_backward=False, module="unique")
    def advance(
        links: _LINKS, parameters: wp.array3d(dtype=wp.float64), terms: _BY_STEP, steady: bool, gravity: _LINKS,
        timestep: wp.array(dtype=wp.float64), control: _BY_STEP, qpos: _LINKS, qvel: _LINKS, impulse: _LINKS,
        path: _BY_STEP,
    ):  # fmt: skip
        i, n = wp.tid(), links.shape[0]  # a number that is known beforehand would unroll every loop
        h, zero, half = timestep[i], wp.float64(0.0), wp.float64(0.5)
        axis, unit = wp.vec3d(zero, zero, wp.float64(1.0)), wp.identity(n=3, dtype=wp.float64)
        position, speed, push, free, after = vector(), vector(), vector(), vector(), vector()
        force, moment, first = triples(), triples(), triples()
        composite, inertia, inverse, factor = tensors(), square(), square(), square()
        for j in range(n):
            position[j] = qpos[i, j]
            speed[j] = qvel[i, j]
            push[j] = impulse[i, j]
        for k in range(control.shape[1]):
            turning, bending = wp.vec3d(), wp.vec3d()
            falling = -wp.vec3d(gravity[i, 0], gravity[i, 1], gravity[i, 2])
            for j in range(n):
                turn, place = wp.transpose(_turn(links, j, position[j])), _vector(links, j, PLACE)
                falling = turn * (falling + wp.cross(bending, place) + wp.cross(turning, wp.cross(turning, place)))
                before = turn * turning
                bending = turn * bending + wp.cross(before, speed[j] * axis)
                turning = before + speed[j] * axis
                about, own = _vector(links, j, MOMENT), _inertia(links, j)
                pull = links[j, MASS] * falling + wp.cross(bending, about)
                pull += wp.cross(turning, wp.cross(turning, about))
                twist = own * bending + wp.cross(turning, own * turning) + wp.cross(about, falling)
                for c in range(3):
                    force[j, c] = pull[c]
                    moment[j, c] = twist[c]
                    first[j, c] = about[c]
                    for r in range(3):
                        composite[3 * j + r, c] = own[r, c]
            for back in range(n):
                j = n - 1 - back
                about, carried = _row(first, j), wp.mat33d()
                for r in range(3):
                    for c in range(3):
                        carried[r, c] = composite[3 * j + r, c]
                pull, twist = wp.vec3d(-about[1], about[0], zero), wp.vec3d(carried[0, 2], carried[1, 2], carried[2, 2])
                inertia[j, j] = carried[2, 2] + parameters[ARMATURE, i, j] + h * parameters[DAMPING, i, j]
                for on in range(j):
                    m = j - on
                    turn = _turn(links, m, position[m])
                    pull = turn * pull
                    twist = turn * twist + wp.cross(_vector(links, m, PLACE), pull)
                    inertia[j, m - 1] = twist[2]
                if j > 0:
                    turn, place = _turn(links, j, position[j]), _vector(links, j, PLACE)
                    mass = wp.float64(links[j, CARRIED])
                    pull = turn * _row(force, j)
                    twist = turn * _row(moment, j) + wp.cross(place, pull)
                    about = turn * about
                    middle = about + half * mass * place
                    carried = turn * carried * wp.transpose(turn) - wp.outer(place, middle) - wp.outer(middle, place)
                    carried += wp.float64(2.0) * wp.dot(place, middle) * unit
                    about += mass * place
                    for c in range(3):
                        force[j - 1, c] += pull[c]
                        moment[j - 1, c] += twist[c]
                        first[j - 1, c] += about[c]
                        for r in range(3):
                            composite[3 * (j - 1) + r, c] += carried[r, c]
                wanted = control[i, k, j] + parameters[OFFSET, i, j]
                torque = parameters[STIFFNESS, i, j] * (wanted - position[j])
                torque = wp.clamp(torque, -parameters[LIMIT, i, j], parameters[LIMIT, i, j])
                free[j] = h * (torque - moment[j, 2] - parameters[DAMPING, i, j] * speed[j]) + push[j]
            # Inverse of the inertia by its Cholesky factor; the factor's inverse goes into `inverse` first.
            for j in range(n):
                total = inertia[j, j]
                for m in range(j):
                    total -= factor[j, m] * factor[j, m]
                factor[j, j] = wp.sqrt(total)
                for r in range(j + 1, n):
                    total = inertia[r, j]
                    for m in range(j):
                        total -= factor[r, m] * factor[j, m]
                    factor[r, j] = total / factor[j, j]
            for j in range(n):
                inertia[j, j] = wp.float64(1.0) / factor[j, j]
                for r in range(j + 1, n):
                    total = wp.float64(0.0)
                    for m in range(j, r):
                        total -= factor[r, m] * inertia[m, j]
                    inertia[r, j] = total / factor[r, r]
            for r in range(n):
                for j in range(r + 1):
                    total = wp.float64(0.0)
                    for m in range(r, n):
                        total += inertia[m, r] * inertia[m, j]
                    inverse[r, j] = total
                    inverse[j, r] = total
            for r in range(n):
                total = speed[r]
                for j in range(n):
                    total += inverse[r, j] * free[j]
                after[r] = total
            for _sweep in range(SWEEPS):
                for j in range(n):
                    dry = terms[0, i, j]
                    if not steady:
                        dry = _dry_friction(terms, i, j, speed[j])
                    most, own_inverse, old = h * dry, inverse[j, j], push[j]
                    wrong = after[j] - _KEPT * speed[j] + _SOFT * own_inverse * old
                    new = old - wrong / (own_inverse * _YIELDING)
                    new = wp.clamp(new, -most, most)
                    push[j] = new
                    for r in range(n):
                        after[r] += inverse[r, j] * (new - old)
            for j in range(n):
                speed[j] = after[j]
                position[j] += h * after[j]
                path[i, k, j] = position[j]
        for j in range(n):
            qpos[i, j] = position[j]
            qvel[i, j] = speed[j]
            impulse[i, j] = push[j]

    return advance
