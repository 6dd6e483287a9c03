"""The depth table as kernels read it: absolute phase to points and their sigma, block by block (equations 8 to 15).

In float32, in loops that compilers turn into vector instructions; `fused.py` calls them.
"""

from typing import NamedTuple

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.blocks import COUNT
from fringescope.kernels.pixel import is_inside, point
from fringescope.kernels.raw import unowned

FIELDS = 9  #: of the table: see `geometry.depth_table`

_f = np.float32
_ONE = np.float32(1.0)
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


@njit(cache=True, inline="always", error_model="numpy")
def unowned_depths(d):
    """See `raw.unowned`."""
    return Depths(
        unowned(d.table), d.step, unowned(d.camera), d.depth, unowned(d.projector),
        unowned(d.lens), unowned(d.field), unowned(d.box),
    )  # fmt: skip


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


@njit(cache=True, inline="always", error_model="numpy")
def cubics_of(c):
    """The nine cubics of a segment of a row, c (FIELDS * 4,), as tuples: what `pixel.point` takes."""
    return (
        (c[0], c[1], c[2], c[3]), (c[4], c[5], c[6], c[7]), (c[8], c[9], c[10], c[11]), (c[12], c[13], c[14], c[15]),
        (c[16], c[17], c[18], c[19]), (c[20], c[21], c[22], c[23]), (c[24], c[25], c[26], c[27]),
        (c[28], c[29], c[30], c[31]), (c[32], c[33], c[34], c[35]),
    )  # fmt: skip


@njit(cache=True, inline="always", error_model="numpy")
def space_of(depths):
    """Pose and lens of the projector, its field and the measuring box, as tuples: what `pixel.is_inside` takes."""
    P, L, F, B = depths.projector, depths.lens, depths.field, depths.box
    return (
        (P[0], P[1], P[2], P[3], P[4], P[5], P[6], P[7], P[8], P[9], P[10], P[11]),
        (L[0], L[1], L[2], L[3], L[4], L[5], L[6], L[7], L[8], L[9]),
        (F[0], F[1], F[2], F[3]),
        (B[0], B[1], B[2], B[3], B[4], B[5], B[6], B[7], B[8], B[9], B[10], B[11], B[12], B[13], B[14]),
    )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def points(cycles, sigma, row, depths, col, n, X, Y, Z, sigma_mm):
    """Absolute turns of a block to world points and their sigma along the ray (equations 8 to 15).

    `row` (segments * FIELDS * 4,): cubics in the place between nodes of: turns at the table's depth, curvature b,
    s0 .. s3, and the ray's world point at that depth (see `geometry.depth_table`).
    """
    step = depths.step
    per_step = _ONE / _f(step)
    per_depth = _ONE / depths.depth
    centre = (depths.camera[0], depths.camera[1], depths.camera[2])
    j = 0
    while j < n:
        k = (col + j) // step
        m = min(n, (k + 1) * step - col) - j
        c = row[k * FIELDS * 4 : (k + 1) * FIELDS * 4]
        cubics = cubics_of(c)
        begin = _f(col + j - k * step) * per_step
        turns_, own = cycles[j : j + m], sigma[j : j + m]
        x, y, z, out = X[j : j + m], Y[j : j + m], Z[j : j + m], sigma_mm[j : j + m]
        for i in range(m):
            t = begin + COUNT[i] * per_step
            x[i], y[i], z[i], out[i] = point(turns_[i], own[i], t, cubics, centre, per_depth)
        j += m


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def mark_outside(X, Y, Z, depths, n, reasons, outside, uncertain):
    """Give `outside` to points that have no reason yet (or an uncertain order) and lie outside the measuring space."""
    pose, lens, field, box = space_of(depths)
    for i in range(n):
        inside = is_inside(X[i], Y[i], Z[i], pose, lens, field, box)
        free = (reasons[i] | uncertain) == uncertain
        reasons[i] |= outside if free & (not inside) else 0
