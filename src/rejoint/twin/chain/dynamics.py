"""Compiled dynamics of some dozen serial arms at once.

Bias forces by recursive Newton-Euler, inertia by composite bodies (Featherstone 2008, chapters 5 and 6), in link frames
whose z axis is the joint. To vectorize, loops over the arms need arrays without overlap (`NoAlias`), one row per
quantity of a joint, no calls but of `INLINE` functions, and an unknown number of lanes.
"""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False, disallow-untyped-decorators=False
# ruff: noqa: ANN001, ANN201, ANN202, E741 - compiled functions take their types from their arguments; l is a lane
from __future__ import annotations

import numpy as np
from numba import njit
from numba.core.compiler import Compiler

LANES, GROUP = 64, 8
"""Arms stepped together, at most, and their granularity; chosen"""
ROTATION, PLACE, MASS, MOMENT, INERTIA, CARRIED, LINK = 0, 9, 12, 13, 16, 22, 23
"""Indices of a link's constants: rotation and place of its joint; mass, first moment and inertia about it; the mass
behind it; their number"""
# Where the quantities of a joint begin in the row of it that is kept, LANES numbers of each: rotation R, angular
# velocity W, angular and linear acceleration A and L, force F, moment N; of all that it carries first moment H and
# inertia I.
R0, R1, R2, R3, R4, R5, R6, R7, R8 = (LANES * k for k in range(9))
WX, WY, WZ, AX, AY, AZ, LX, LY, LZ = (LANES * k for k in range(9, 18))
FX, FY, FZ, NX, NY, NZ, HX, HY, HZ = (LANES * k for k in range(18, 27))
IXX, IYY, IZZ, IXY, IXZ, IYZ, KEPT_ROW = (LANES * k for k in range(27, 34))
_X, _Y, _Z, _U, _V, _T, REACH_ROW = (LANES * k for k in range(7))  # of a force and a moment that are carried on
ACCELERATION, TORQUE = LX, NZ
"""Indices of a joint's linear acceleration (base: minus gravity) and bias torque"""


class NoAlias(Compiler):  # type: ignore[misc]
    """Numba's compiler for arrays that do not overlap."""

    def define_pipelines(self):
        """Set the flag that Numba's decorators lack."""
        self.state.flags.noalias = True
        return super().define_pipelines()


OPTIONS = {"nogil": True, "cache": True, "pipeline_class": NoAlias, "error_model": "numpy"}
INLINE = {"inline": "always", "error_model": "numpy"}

SINE = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
COSINE = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)
"""Coefficients of the polynomials in x^2, the highest first (fdlibm)"""
_PI_2A, _PI_2B = 1.5707963267341256, 6.077100506506192e-11
_TWO_OVER_PI = 0.6366197723675814
_ROUND = 6755399441055744.0  # 1.5 * 2^52: adding it rounds to whole numbers


@njit(**INLINE)
def _cross(ax, ay, az, bx, by, bz):
    return ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx


@njit(**INLINE)
def _turned(here, l, x, y, z):
    """Turn a vector of the frame ``here`` to the one before."""
    return (
        here[R0 + l] * x + here[R1 + l] * y + here[R2 + l] * z,
        here[R3 + l] * x + here[R4 + l] * y + here[R5 + l] * z,
        here[R6 + l] * x + here[R7 + l] * y + here[R8 + l] * z,
    )


@njit(**INLINE)
def _back(here, l, x, y, z):
    """Turn a vector of the frame before to ``here``."""
    return (
        here[R0 + l] * x + here[R3 + l] * y + here[R6 + l] * z,
        here[R1 + l] * x + here[R4 + l] * y + here[R7 + l] * z,
        here[R2 + l] * x + here[R5 + l] * y + here[R8 + l] * z,
    )


@njit(**OPTIONS)
def turn(lanes, q, sine, cosine):
    """Sine and cosine of angles (lanes,) [rad] up to some thousand, to a few 1e-16."""
    for l in range(lanes):
        quarter = (q[l] * _TWO_OVER_PI + _ROUND) - _ROUND
        x = (q[l] - quarter * _PI_2A) - quarter * _PI_2B
        s = x * x
        sin, cos = SINE[0], COSINE[0]
        for k in range(1, 6):
            sin, cos = SINE[k] + s * sin, COSINE[k] + s * cos
        sin = x + x * s * sin
        cos = 1.0 - 0.5 * s + s * s * cos
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
def forward(lanes, link, before, here, speed, sine, cosine):
    """Carry motion from the joint ``before``; store the inertial force and moment."""
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = link[0], link[1], link[2], link[3], link[4], link[5], link[6], link[7], link[8]
    px, py, pz = link[PLACE], link[PLACE + 1], link[PLACE + 2]
    mass, hx, hy, hz = link[MASS], link[MOMENT], link[MOMENT + 1], link[MOMENT + 2]
    ixx, iyy, izz = link[INERTIA], link[INERTIA + 1], link[INERTIA + 2]
    ixy, ixz, iyz = link[INERTIA + 3], link[INERTIA + 4], link[INERTIA + 5]
    for l in range(lanes):
        s, c, v = sine[l], cosine[l], speed[l]
        # Rotation from here to before: that of the frame, then about z.
        here[R0 + l], here[R1 + l], here[R2 + l] = r0 * c + r1 * s, r1 * c - r0 * s, r2
        here[R3 + l], here[R4 + l], here[R5 + l] = r3 * c + r4 * s, r4 * c - r3 * s, r5
        here[R6 + l], here[R7 + l], here[R8 + l] = r6 * c + r7 * s, r7 * c - r6 * s, r8
        wx, wy, wz = before[WX + l], before[WY + l], before[WZ + l]
        ax, ay, az = before[AX + l], before[AY + l], before[AZ + l]
        lx, ly, lz = before[LX + l], before[LY + l], before[LZ + l]
        # Acceleration of the joint's place, seen before: linear + angular x p + w x (w x p).
        cx, cy, cz = _cross(wx, wy, wz, px, py, pz)
        lx += ay * pz - az * py + wy * cz - wz * cy
        ly += az * px - ax * pz + wz * cx - wx * cz
        lz += ax * py - ay * px + wx * cy - wy * cx
        ux, uy, uz = _back(here, l, wx, wy, wz)
        bx, by, bz = _back(here, l, ax, ay, az)
        dx, dy, dz = _back(here, l, lx, ly, lz)
        bx, by, uz = bx + uy * v, by - ux * v, uz + v
        here[WX + l], here[WY + l], here[WZ + l] = ux, uy, uz
        here[AX + l], here[AY + l], here[AZ + l] = bx, by, bz
        here[LX + l], here[LY + l], here[LZ + l] = dx, dy, dz
        # Force: mass * place + angular x first moment + w x (w x first moment); moment about the joint.
        ex, ey, ez = _cross(ux, uy, uz, hx, hy, hz)
        here[FX + l] = mass * dx + by * hz - bz * hy + uy * ez - uz * ey
        here[FY + l] = mass * dy + bz * hx - bx * hz + uz * ex - ux * ez
        here[FZ + l] = mass * dz + bx * hy - by * hx + ux * ey - uy * ex
        kx, ky, kz = ixx * ux + ixy * uy + ixz * uz, ixy * ux + iyy * uy + iyz * uz, ixz * ux + iyz * uy + izz * uz
        here[NX + l] = ixx * bx + ixy * by + ixz * bz + uy * kz - uz * ky + hy * dz - hz * dy
        here[NY + l] = ixy * bx + iyy * by + iyz * bz + uz * kx - ux * kz + hz * dx - hx * dz
        here[NZ + l] = ixz * bx + iyz * by + izz * bz + ux * ky - uy * kx + hx * dy - hy * dx
        here[HX + l], here[HY + l], here[HZ + l] = hx, hy, hz
        here[IXX + l], here[IYY + l], here[IZZ + l] = ixx, iyy, izz
        here[IXY + l], here[IXZ + l], here[IYZ + l] = ixy, ixz, iyz


@njit(**OPTIONS)
def backward(lanes, link, before, here):
    """Add a joint's force, moment and mass to those before."""
    px, py, pz, mass = link[PLACE], link[PLACE + 1], link[PLACE + 2], link[CARRIED]
    for l in range(lanes):
        r0, r1, r2 = here[R0 + l], here[R1 + l], here[R2 + l]
        r3, r4, r5 = here[R3 + l], here[R4 + l], here[R5 + l]
        r6, r7, r8 = here[R6 + l], here[R7 + l], here[R8 + l]
        fx, fy, fz = _turned(here, l, here[FX + l], here[FY + l], here[FZ + l])
        x, y, z = _turned(here, l, here[NX + l], here[NY + l], here[NZ + l])
        before[FX + l] += fx
        before[FY + l] += fy
        before[FZ + l] += fz
        before[NX + l] += x + py * fz - pz * fy
        before[NY + l] += y + pz * fx - px * fz
        before[NZ + l] += z + px * fy - py * fx
        hx, hy, hz = _turned(here, l, here[HX + l], here[HY + l], here[HZ + l])
        before[HX + l] += hx + mass * px
        before[HY + l] += hy + mass * py
        before[HZ + l] += hz + mass * pz
        ixx, iyy, izz = here[IXX + l], here[IYY + l], here[IZZ + l]
        ixy, ixz, iyz = here[IXY + l], here[IXZ + l], here[IYZ + l]
        # R I R', then the parallel axis: for p and the first moment h of what is moved.
        a0, b0, c0 = _turned(here, l, ixx, ixy, ixz)
        a1, b1, c1 = _turned(here, l, ixy, iyy, iyz)
        a2, b2, c2 = _turned(here, l, ixz, iyz, izz)
        gx, gy, gz = hx + 0.5 * mass * px, hy + 0.5 * mass * py, hz + 0.5 * mass * pz
        before[IXX + l] += a0 * r0 + a1 * r1 + a2 * r2 + 2.0 * (py * gy + pz * gz)
        before[IYY + l] += b0 * r3 + b1 * r4 + b2 * r5 + 2.0 * (px * gx + pz * gz)
        before[IZZ + l] += c0 * r6 + c1 * r7 + c2 * r8 + 2.0 * (px * gx + py * gy)
        before[IXY + l] += a0 * r3 + a1 * r4 + a2 * r5 - px * gy - py * gx
        before[IXZ + l] += a0 * r6 + a1 * r7 + a2 * r8 - px * gz - pz * gx
        before[IYZ + l] += b0 * r6 + b1 * r7 + b2 * r8 - py * gz - pz * gy


@njit(**OPTIONS)
def coupling(lanes, links, j, kept, reach, inertia):
    """Fill row ``j`` of the ``inertia`` (n, n, LANES)."""
    here = kept[j + 1]
    for l in range(lanes):
        reach[_X + l], reach[_Y + l], reach[_Z + l] = -here[HY + l], here[HX + l], 0.0
        reach[_U + l], reach[_V + l], reach[_T + l] = here[IXZ + l], here[IYZ + l], here[IZZ + l]
        inertia[j, j, l] = here[IZZ + l]
    for i in range(j, 0, -1):
        _carry(lanes, links[i], kept[i + 1], reach, inertia[j, i - 1])


@njit(**OPTIONS)
def _carry(lanes, link, here, reach, moment):
    px, py, pz = link[PLACE], link[PLACE + 1], link[PLACE + 2]
    for l in range(lanes):
        fx, fy, fz = _turned(here, l, reach[_X + l], reach[_Y + l], reach[_Z + l])
        x, y, z = _turned(here, l, reach[_U + l], reach[_V + l], reach[_T + l])
        reach[_X + l], reach[_Y + l], reach[_Z + l] = fx, fy, fz
        reach[_U + l] = x + py * fz - pz * fy
        reach[_V + l] = y + pz * fx - px * fz
        reach[_T + l] = moment[l] = z + px * fy - py * fx


@njit(**OPTIONS)
def invert(lanes, joints, inertia, half, inverse, scratch):
    """Invert symmetric matrices (n, n, LANES), given as lower half, by Cholesky factors."""
    for j in range(joints):
        for l in range(lanes):
            scratch[l] = inertia[j, j, l]
        for k in range(j):
            for l in range(lanes):
                scratch[l] -= half[j, k, l] * half[j, k, l]
        for l in range(lanes):
            half[j, j, l] = 1.0 / np.sqrt(scratch[l])  # of the factor's diagonal: the inverse
        for i in range(j + 1, joints):
            for l in range(lanes):
                scratch[l] = inertia[i, j, l]
            for k in range(j):
                for l in range(lanes):
                    scratch[l] -= half[i, k, l] * half[j, k, l]
            for l in range(lanes):
                scratch[l] *= half[j, j, l]
            for l in range(lanes):
                half[i, j, l] = scratch[l]
    for j in range(joints):  # the factor's inverse, into the lower half of `inverse`, transposed: [j, i] is of row i
        for l in range(lanes):
            inverse[j, j, l] = half[j, j, l]
        for i in range(j + 1, joints):
            for l in range(lanes):
                scratch[l] = 0.0
            for k in range(j, i):
                for l in range(lanes):
                    scratch[l] -= half[i, k, l] * inverse[j, k, l]
            for l in range(lanes):
                inverse[j, i, l] = scratch[l] * half[i, i, l]
    for i in range(joints):  # W' W, where W is that inverse
        for j in range(i + 1):
            for l in range(lanes):
                scratch[l] = 0.0
            for k in range(i, joints):
                for l in range(lanes):
                    scratch[l] += inverse[i, k, l] * inverse[j, k, l]
            for l in range(lanes):
                half[i, j, l] = scratch[l]
    for i in range(joints):
        for j in range(i + 1):
            for l in range(lanes):
                scratch[l] = half[i, j, l]
            for l in range(lanes):
                inverse[i, j, l] = scratch[l]
            for l in range(lanes):
                inverse[j, i, l] = scratch[l]
