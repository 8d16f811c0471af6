"""Dynamics of sixteen serial arms at once, compiled: motion and forces joint by joint, inertia, and its inverse.

Bias forces by the recursive Newton-Euler method and inertia by composite bodies (Featherstone 2008, chapters 5 and 6),
both in link frames whose z axis is the joint.

Arrays are (quantity, lane): what is done to a joint stands in one straight piece within a loop over the lanes, which
the compiler turns into vector instructions. It does so only if it knows that no two arrays overlap (`NoAlias`), and
if nothing is called in the loop, so sine and cosine are polynomials here.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN201, E741 - compiled functions take their types from their arguments; l is a lane
from __future__ import annotations

import numpy as np
from numba import njit
from numba.core.compiler import Compiler

LANES = 16
"""Arms that are stepped together (chosen: two vectors of eight numbers, or four of four)"""
ROTATION, PLACE, MASS, MOMENT, INERTIA, CARRIED, LINK = 0, 9, 12, 13, 16, 22, 23
"""Where the constants of a link begin: rotation and place of its joint's frame in the frame before; mass, first moment
and inertia about the joint; the mass of all behind it; and how many there are"""
# What is kept of each joint: rotation 9, angular velocity 3, angular and linear acceleration 3 and 3, force 3, moment
# 3, and of all that it carries the first moment 3 and the inertia 6.
_W, _A, _F, _N, _H, _I, KEPT_ROWS = 9, 12, 18, 21, 24, 27, 33
ACCELERATION, TORQUE = _A + 3, _N + 2
"""Where the linear acceleration of a joint stands in that, of the base it is minus gravity; and its bias torque"""


class NoAlias(Compiler):  # type: ignore[misc]
    """Numba's compiler, told that the arrays it is given do not overlap."""

    def define_pipelines(self):
        """Set the flag that Numba's decorators have no option for."""
        self.state.flags.noalias = True
        return super().define_pipelines()


OPTIONS = {"nogil": True, "cache": True, "pipeline_class": NoAlias, "error_model": "numpy"}

_PI_2A, _PI_2B = 1.5707963267341256, 6.077100506506192e-11
_TWO_OVER_PI = 0.6366197723675814
_ROUND = 6755399441055744.0  # 1.5 * 2^52: adding it rounds to whole numbers


@njit(**OPTIONS)
def turn(q, sine, cosine):
    """Sine and cosine of angles (LANES,) [rad] up to some thousand, to a few 1e-16."""
    for l in range(LANES):
        quarter = (q[l] * _TWO_OVER_PI + _ROUND) - _ROUND
        x = (q[l] - quarter * _PI_2A) - quarter * _PI_2B
        s = x * x
        sin = x + x * s * (
            -1.66666666666666324348e-01
            + s
            * (
                8.33333333332248946124e-03
                + s
                * (
                    -1.98412698298579493134e-04
                    + s
                    * (2.75573137070700676789e-06 + s * (-2.50507602534068634195e-08 + s * 1.58969099521155010221e-10))
                )
            )
        )
        cos = (
            1.0
            - 0.5 * s
            + s
            * s
            * (
                4.16666666666666019037e-02
                + s
                * (
                    -1.38888888888741095749e-03
                    + s
                    * (
                        2.48015872894767294178e-05
                        + s
                        * (
                            -2.75573143513906633035e-07
                            + s * (2.08757232129817482790e-09 + s * -1.13596475577881948265e-11)
                        )
                    )
                )
            )
        )
        half = quarter * 0.5
        odd = abs(half - ((half + _ROUND) - _ROUND)) > 0.25  # swap
        fourth = quarter * 0.25 - 0.125
        turns = (fourth + _ROUND) - _ROUND
        k = quarter - 4.0 * turns  # -1, 0, 1 or 2
        a = cos if odd else sin
        b = sin if odd else cos
        sine[l] = -a if (k > 1.5 or k < -0.5) else a
        cosine[l] = -b if k > 0.5 else b


@njit(**OPTIONS)
def forward(links, j, kept, speed, sine, cosine):
    """Carry motion to joint ``j``: its rotation, velocity and acceleration, and the force and moment that it takes."""
    r0, r1, r2 = links[j, 0], links[j, 1], links[j, 2]
    r3, r4, r5 = links[j, 3], links[j, 4], links[j, 5]
    r6, r7, r8 = links[j, 6], links[j, 7], links[j, 8]
    px, py, pz = links[j, 9], links[j, 10], links[j, 11]
    mass, hx, hy, hz = links[j, 12], links[j, 13], links[j, 14], links[j, 15]
    ixx, iyy, izz, ixy, ixz, iyz = links[j, 16], links[j, 17], links[j, 18], links[j, 19], links[j, 20], links[j, 21]
    for l in range(LANES):
        s, c, v = sine[l], cosine[l], speed[j, l]
        # Rotation from here to before: that of the frame, then about z.
        a00, a01 = r0 * c + r1 * s, r1 * c - r0 * s
        a10, a11 = r3 * c + r4 * s, r4 * c - r3 * s
        a20, a21 = r6 * c + r7 * s, r7 * c - r6 * s
        kept[j + 1, 0, l], kept[j + 1, 1, l], kept[j + 1, 2, l] = a00, a01, r2
        kept[j + 1, 3, l], kept[j + 1, 4, l], kept[j + 1, 5, l] = a10, a11, r5
        kept[j + 1, 6, l], kept[j + 1, 7, l], kept[j + 1, 8, l] = a20, a21, r8
        wx, wy, wz = kept[j, _W, l], kept[j, _W + 1, l], kept[j, _W + 2, l]
        ax, ay, az = kept[j, _A, l], kept[j, _A + 1, l], kept[j, _A + 2, l]
        lx, ly, lz = kept[j, _A + 3, l], kept[j, _A + 4, l], kept[j, _A + 5, l]
        # Acceleration of the joint's place, seen before: linear + angular x p + w x (w x p).
        cx, cy, cz = wy * pz - wz * py, wz * px - wx * pz, wx * py - wy * px
        lx += ay * pz - az * py + wy * cz - wz * cy
        ly += az * px - ax * pz + wz * cx - wx * cz
        lz += ax * py - ay * px + wx * cy - wy * cx
        ux, uy, uz = a00 * wx + a10 * wy + a20 * wz, a01 * wx + a11 * wy + a21 * wz, r2 * wx + r5 * wy + r8 * wz
        bx = a00 * ax + a10 * ay + a20 * az + uy * v
        by = a01 * ax + a11 * ay + a21 * az - ux * v
        bz = r2 * ax + r5 * ay + r8 * az
        dx, dy, dz = a00 * lx + a10 * ly + a20 * lz, a01 * lx + a11 * ly + a21 * lz, r2 * lx + r5 * ly + r8 * lz
        uz += v
        kept[j + 1, _W, l], kept[j + 1, _W + 1, l], kept[j + 1, _W + 2, l] = ux, uy, uz
        kept[j + 1, _A, l], kept[j + 1, _A + 1, l], kept[j + 1, _A + 2, l] = bx, by, bz
        kept[j + 1, _A + 3, l], kept[j + 1, _A + 4, l], kept[j + 1, _A + 5, l] = dx, dy, dz
        # Force: mass * place + angular x first moment + w x (w x first moment); moment about the joint.
        ex, ey, ez = uy * hz - uz * hy, uz * hx - ux * hz, ux * hy - uy * hx
        kept[j + 1, _F, l] = mass * dx + by * hz - bz * hy + uy * ez - uz * ey
        kept[j + 1, _F + 1, l] = mass * dy + bz * hx - bx * hz + uz * ex - ux * ez
        kept[j + 1, _F + 2, l] = mass * dz + bx * hy - by * hx + ux * ey - uy * ex
        kx, ky, kz = ixx * ux + ixy * uy + ixz * uz, ixy * ux + iyy * uy + iyz * uz, ixz * ux + iyz * uy + izz * uz
        kept[j + 1, _N, l] = ixx * bx + ixy * by + ixz * bz + uy * kz - uz * ky + hy * dz - hz * dy
        kept[j + 1, _N + 1, l] = ixy * bx + iyy * by + iyz * bz + uz * kx - ux * kz + hz * dx - hx * dz
        kept[j + 1, _N + 2, l] = ixz * bx + iyz * by + izz * bz + ux * ky - uy * kx + hx * dy - hy * dx
        kept[j + 1, _H, l], kept[j + 1, _H + 1, l], kept[j + 1, _H + 2, l] = hx, hy, hz
        kept[j + 1, _I, l], kept[j + 1, _I + 1, l], kept[j + 1, _I + 2, l] = ixx, iyy, izz
        kept[j + 1, _I + 3, l], kept[j + 1, _I + 4, l], kept[j + 1, _I + 5, l] = ixy, ixz, iyz


@njit(**OPTIONS)
def backward(links, j, kept):
    """Add to what joint ``j`` hangs on the force and moment on it, and what it and all behind it weigh."""
    px, py, pz, mass = links[j, PLACE], links[j, PLACE + 1], links[j, PLACE + 2], links[j, CARRIED]
    for l in range(LANES):
        r0, r1, r2 = kept[j + 1, 0, l], kept[j + 1, 1, l], kept[j + 1, 2, l]
        r3, r4, r5 = kept[j + 1, 3, l], kept[j + 1, 4, l], kept[j + 1, 5, l]
        r6, r7, r8 = kept[j + 1, 6, l], kept[j + 1, 7, l], kept[j + 1, 8, l]
        x, y, z = kept[j + 1, _F, l], kept[j + 1, _F + 1, l], kept[j + 1, _F + 2, l]
        fx, fy, fz = r0 * x + r1 * y + r2 * z, r3 * x + r4 * y + r5 * z, r6 * x + r7 * y + r8 * z
        x, y, z = kept[j + 1, _N, l], kept[j + 1, _N + 1, l], kept[j + 1, _N + 2, l]
        kept[j, _F, l] += fx
        kept[j, _F + 1, l] += fy
        kept[j, _F + 2, l] += fz
        kept[j, _N, l] += r0 * x + r1 * y + r2 * z + py * fz - pz * fy
        kept[j, _N + 1, l] += r3 * x + r4 * y + r5 * z + pz * fx - px * fz
        kept[j, _N + 2, l] += r6 * x + r7 * y + r8 * z + px * fy - py * fx
        x, y, z = kept[j + 1, _H, l], kept[j + 1, _H + 1, l], kept[j + 1, _H + 2, l]
        hx, hy, hz = r0 * x + r1 * y + r2 * z, r3 * x + r4 * y + r5 * z, r6 * x + r7 * y + r8 * z
        kept[j, _H, l] += hx + mass * px
        kept[j, _H + 1, l] += hy + mass * py
        kept[j, _H + 2, l] += hz + mass * pz
        ixx, iyy, izz = kept[j + 1, _I, l], kept[j + 1, _I + 1, l], kept[j + 1, _I + 2, l]
        ixy, ixz, iyz = kept[j + 1, _I + 3, l], kept[j + 1, _I + 4, l], kept[j + 1, _I + 5, l]
        # R I R', then the parallel axis: for p and the first moment h of what is moved.
        a0, a1, a2 = r0 * ixx + r1 * ixy + r2 * ixz, r0 * ixy + r1 * iyy + r2 * iyz, r0 * ixz + r1 * iyz + r2 * izz
        b0, b1, b2 = r3 * ixx + r4 * ixy + r5 * ixz, r3 * ixy + r4 * iyy + r5 * iyz, r3 * ixz + r4 * iyz + r5 * izz
        c0, c1, c2 = r6 * ixx + r7 * ixy + r8 * ixz, r6 * ixy + r7 * iyy + r8 * iyz, r6 * ixz + r7 * iyz + r8 * izz
        gx, gy, gz = hx + 0.5 * mass * px, hy + 0.5 * mass * py, hz + 0.5 * mass * pz
        kept[j, _I, l] += a0 * r0 + a1 * r1 + a2 * r2 + 2.0 * (py * gy + pz * gz)
        kept[j, _I + 1, l] += b0 * r3 + b1 * r4 + b2 * r5 + 2.0 * (px * gx + pz * gz)
        kept[j, _I + 2, l] += c0 * r6 + c1 * r7 + c2 * r8 + 2.0 * (px * gx + py * gy)
        kept[j, _I + 3, l] += a0 * r3 + a1 * r4 + a2 * r5 - px * gy - py * gx
        kept[j, _I + 4, l] += a0 * r6 + a1 * r7 + a2 * r8 - px * gz - pz * gx
        kept[j, _I + 5, l] += b0 * r6 + b1 * r7 + b2 * r8 - py * gz - pz * gy


@njit(**OPTIONS)
def coupling(links, j, kept, reach, inertia):
    """Fill the row of joint ``j`` in the ``inertia`` (n, n, LANES): what its acceleration asks of those before it."""
    for l in range(LANES):
        reach[0, l], reach[1, l], reach[2, l] = -kept[j + 1, _H + 1, l], kept[j + 1, _H, l], 0.0
        reach[3, l], reach[4, l], reach[5, l] = kept[j + 1, _I + 4, l], kept[j + 1, _I + 5, l], kept[j + 1, _I + 2, l]
        inertia[j, j, l] = kept[j + 1, _I + 2, l]
    for i in range(j, 0, -1):
        px, py, pz = links[i, PLACE], links[i, PLACE + 1], links[i, PLACE + 2]
        for l in range(LANES):
            r0, r1, r2 = kept[i + 1, 0, l], kept[i + 1, 1, l], kept[i + 1, 2, l]
            r3, r4, r5 = kept[i + 1, 3, l], kept[i + 1, 4, l], kept[i + 1, 5, l]
            r6, r7, r8 = kept[i + 1, 6, l], kept[i + 1, 7, l], kept[i + 1, 8, l]
            x, y, z = reach[0, l], reach[1, l], reach[2, l]
            fx, fy, fz = r0 * x + r1 * y + r2 * z, r3 * x + r4 * y + r5 * z, r6 * x + r7 * y + r8 * z
            x, y, z = reach[3, l], reach[4, l], reach[5, l]
            reach[0, l], reach[1, l], reach[2, l] = fx, fy, fz
            reach[3, l] = r0 * x + r1 * y + r2 * z + py * fz - pz * fy
            reach[4, l] = r3 * x + r4 * y + r5 * z + pz * fx - px * fz
            nz = r6 * x + r7 * y + r8 * z + px * fy - py * fx
            reach[5, l] = nz
            inertia[j, i - 1, l] = nz


@njit(**OPTIONS)
def invert(joints, inertia, half, inverse, scratch):
    """Invert symmetric matrices (n, n, LANES), of which the lower half is given, by their Cholesky factors."""
    for j in range(joints):
        for l in range(LANES):
            scratch[l] = inertia[j, j, l]
        for k in range(j):
            for l in range(LANES):
                scratch[l] -= half[j, k, l] * half[j, k, l]
        for l in range(LANES):
            half[j, j, l] = 1.0 / np.sqrt(scratch[l])  # of the factor's diagonal: the inverse
        for i in range(j + 1, joints):
            for l in range(LANES):
                scratch[l] = inertia[i, j, l]
            for k in range(j):
                for l in range(LANES):
                    scratch[l] -= half[i, k, l] * half[j, k, l]
            for l in range(LANES):
                scratch[l] *= half[j, j, l]
            for l in range(LANES):
                half[i, j, l] = scratch[l]
    for j in range(joints):  # the factor's inverse, into the lower half of `inverse`, transposed: [j, i] is of row i
        for l in range(LANES):
            inverse[j, j, l] = half[j, j, l]
        for i in range(j + 1, joints):
            for l in range(LANES):
                scratch[l] = 0.0
            for k in range(j, i):
                for l in range(LANES):
                    scratch[l] -= half[i, k, l] * inverse[j, k, l]
            for l in range(LANES):
                inverse[j, i, l] = scratch[l] * half[i, i, l]
    for i in range(joints):  # W' W, where W is that inverse
        for j in range(i + 1):
            for l in range(LANES):
                scratch[l] = 0.0
            for k in range(i, joints):
                for l in range(LANES):
                    scratch[l] += inverse[i, k, l] * inverse[j, k, l]
            for l in range(LANES):
                half[i, j, l] = scratch[l]
    for i in range(joints):
        for j in range(i + 1):
            for l in range(LANES):
                scratch[l] = half[i, j, l]
            for l in range(LANES):
                inverse[i, j, l] = scratch[l]
            for l in range(LANES):
                inverse[j, i, l] = scratch[l]
