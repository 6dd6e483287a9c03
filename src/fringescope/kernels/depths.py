"""The depth table as kernels read it: absolute phase to points and their sigma, block by block (equations 8 to 15).

In float32, in loops that compilers turn into vector instructions; `fused.py` calls them.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from fringescope.kernels.lens import to_plane

FIELDS = 9  #: of the table: see `geometry.depth_table`

_f = np.float32
_ZERO, _ONE, _TWO, _THREE = (np.float32(c) for c in (0.0, 1.0, 2.0, 3.0))
_CONTRACT = {"contract"}


class Depths(NamedTuple):
    """The rig as smooth fields over the picture: see `geometry.depth_table`."""

    table: np.ndarray  #: (rows, segments * FIELDS * 4) float64: cubics along a row, at rows `step` pixels apart
    step: int  #: pixels between nodes
    camera: np.ndarray  #: (3,) float32, centre of the camera, world mm
    depth: np.float32  #: mm along the camera's axis, where the table begins to count
    projector: np.ndarray  #: (12,) float32, R and t of the projector
    lens: np.ndarray  #: (10,) float32
    field: np.ndarray  #: (4,) float32: least u and v, greatest u and v, on the projector's plane
    box: np.ndarray  #: (15,) float32: centre, three axes, half sizes


@njit(cache=True, nogil=True, error_model="numpy")
def row_cubics(table, i, step, out):
    """The depth table's cubics of row i: a cubic through the four rows of nodes around it."""
    k = i // step
    t = (i - k * step) / step
    w0 = -t * (t - 1.0) * (t - 2.0) / 6.0
    w1 = (t + 1.0) * (t - 1.0) * (t - 2.0) / 2.0
    w2 = -(t + 1.0) * t * (t - 2.0) / 2.0
    w3 = (t + 1.0) * t * (t - 1.0) / 6.0
    a, b, c, d = table[k], table[k + 1], table[k + 2], table[k + 3]
    for m in range(len(out)):
        out[m] = w0 * a[m] + w1 * b[m] + w2 * c[m] + w3 * d[m]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def points(cycles, sigma, row, depths, col, n, X, Y, Z, sigma_mm):
    """Absolute turns of a block to world points and their sigma along the ray (equations 8 to 15).

    `row` (segments * FIELDS * 4,): cubics in the place between nodes of: turns at the table's depth, curvature b,
    s0 .. s3, and the ray's world point at that depth (see `geometry.depth_table`).
    """
    step = depths.step
    per_step = _ONE / _f(step)
    per_depth = _ONE / depths.depth
    cx, cy, cz = depths.camera[0], depths.camera[1], depths.camera[2]
    j = 0
    while j < n:
        k = (col + j) // step
        m = min(n, (k + 1) * step - col) - j
        c = row[k * FIELDS * 4 : (k + 1) * FIELDS * 4]
        a00, a01, a02, a03 = c[0], c[1], c[2], c[3]
        a10, a11, a12, a13 = c[4], c[5], c[6], c[7]
        a20, a21, a22, a23 = c[8], c[9], c[10], c[11]
        a30, a31, a32, a33 = c[12], c[13], c[14], c[15]
        a40, a41, a42, a43 = c[16], c[17], c[18], c[19]
        a50, a51, a52, a53 = c[20], c[21], c[22], c[23]
        a60, a61, a62, a63 = c[24], c[25], c[26], c[27]
        a70, a71, a72, a73 = c[28], c[29], c[30], c[31]
        a80, a81, a82, a83 = c[32], c[33], c[34], c[35]
        begin = _f(col + j - k * step) * per_step
        turns_, own = cycles[j : j + m], sigma[j : j + m]
        x, y, z, out = X[j : j + m], Y[j : j + m], Z[j : j + m], sigma_mm[j : j + m]
        for i in range(m):
            t = begin + _f(i) * per_step
            d = turns_[i] - (a00 + t * (a01 + t * (a02 + t * a03)))
            bend = a10 + t * (a11 + t * (a12 + t * a13))
            s0 = a20 + t * (a21 + t * (a22 + t * a23))
            s1 = a30 + t * (a31 + t * (a32 + t * a33))
            s2 = a40 + t * (a41 + t * (a42 + t * a43))
            s3 = a50 + t * (a51 + t * (a52 + t * a53))
            px = a60 + t * (a61 + t * (a62 + t * a63))
            py = a70 + t * (a71 + t * (a72 + t * a73))
            pz = a80 + t * (a81 + t * (a82 + t * a83))
            inverse = _ONE / (_ONE - bend * d)
            s = s0 + d * (s1 + d * (s2 + d * s3))
            grown = d * s * inverse
            slope = (s + d * (s1 + d * (_TWO * s2 + d * _THREE * s3)) + bend * grown) * inverse
            dx, dy, dz = (px - cx) * per_depth, (py - cy) * per_depth, (pz - cz) * per_depth
            x[i] = px + grown * dx
            y[i] = py + grown * dy
            z[i] = pz + grown * dz
            out[i] = own[i] * abs(slope) * math.sqrt(dx * dx + dy * dy + dz * dz)
        j += m


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def mark_outside(X, Y, Z, depths, n, reasons, outside, uncertain):
    """Give `outside` to points that have no reason yet (or an uncertain order) and lie outside the measuring space."""
    P, L, F, B = depths.projector, depths.lens, depths.field, depths.box
    r00, r01, r02, r10, r11, r12 = P[0], P[1], P[2], P[3], P[4], P[5]
    r20, r21, r22, t0, t1, t2 = P[6], P[7], P[8], P[9], P[10], P[11]
    lens = (L[0], L[1], L[2], L[3], L[4], L[5], L[6], L[7], L[8], L[9])
    low_u, low_v, high_u, high_v = F[0], F[1], F[2], F[3]
    b0, b1, b2 = B[0], B[1], B[2]
    e00, e01, e02, e10, e11, e12, e20, e21, e22 = B[3], B[4], B[5], B[6], B[7], B[8], B[9], B[10], B[11]
    h0, h1, h2 = B[12], B[13], B[14]
    for i in range(n):
        x, y, z = X[i], Y[i], Z[i]
        depth = r20 * x + r21 * y + r22 * z + t2
        inverse = _ONE / depth
        u, v = to_plane(
            (r00 * x + r01 * y + r02 * z + t0) * inverse, (r10 * x + r11 * y + r12 * z + t1) * inverse, lens
        )
        x, y, z = x - b0, y - b1, z - b2
        m0, m1 = abs(e00 * x + e01 * y + e02 * z), abs(e10 * x + e11 * y + e12 * z)
        m2 = abs(e20 * x + e21 * y + e22 * z)
        inside = (depth > _ZERO) & (u >= low_u) & (u <= high_u) & (v >= low_v) & (v <= high_v)
        inside = inside & (m0 <= h0) & (m1 <= h1) & (m2 <= h2)
        free = (reasons[i] | uncertain) == uncertain
        reasons[i] |= outside if free & (not inside) else 0
