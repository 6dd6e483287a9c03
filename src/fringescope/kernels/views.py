"""What other views say of a point: where it lies in their pictures, and whether they look through it.

Arrays and scalars only. In float32, in blocks of pixels that compilers turn into vector instructions; what looks
suspicious there is judged by the slow way, in float64.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from fringescope.kernels.lens import to_plane
from fringescope.threads import by_rows

BLOCK = 512  #: pixels of a row that are worked on together
EDGE = np.float32(0.01)  #: pixels by which float32 may miss the border of a picture
ROUNDING = np.float32(2e-6)  #: of a depth, in float32

_f = np.float32
_ZERO, _HALF, _ONE = np.float32(0), np.float32(0.5), np.float32(1)
_NAN = np.float32(np.nan)
_ADD1, _ADD2 = np.uintp(1), np.uintp(2)  # to indices, which are quicker without a sign
_CONTRACT = {"contract"}


class View(NamedTuple):
    """A view's points, and how its camera sees the world."""

    xyz: np.ndarray  #: (H * W * 3,) float32, world mm, NaN where there is none
    sigma: np.ndarray  #: (H * W,) float32, mm along the ray
    height: int
    width: int
    pose: np.ndarray  #: (12,) float64: R row by row, t
    lens: np.ndarray  #: (10,) float64, see `kernels.lens`


def constant(a: np.ndarray) -> np.ndarray:
    """An array, contiguous and not to be written to: kernels see one type, whoever made it."""
    a = np.ascontiguousarray(a).view()
    a.setflags(write=False)
    return a


@njit(cache=True, nogil=True, error_model="numpy")
def split(row, col, n, X, Y, Z):
    """Points of columns col..col+n-1 of a row (3 W,) into one array per coordinate; returns how many there are."""
    part = row[3 * col : 3 * (col + n)]
    some = 0
    for k in range(n):
        x = part[3 * k]
        X[k] = x
        Y[k] = part[3 * k + 1]
        Z[k] = part[3 * k + 2]
        some += x == x
    return some


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def project(X, Y, Z, pose, lens, n, U, V, D):
    """World points to plane coordinates U, V (pixels) and depths D along the camera's axis, mm."""
    r00, r01, r02, r10, r11, r12 = _f(pose[0]), _f(pose[1]), _f(pose[2]), _f(pose[3]), _f(pose[4]), _f(pose[5])
    r20, r21, r22, t0, t1, t2 = _f(pose[6]), _f(pose[7]), _f(pose[8]), _f(pose[9]), _f(pose[10]), _f(pose[11])
    bend = (
        _f(lens[0]), _f(lens[1]), _f(lens[2]), _f(lens[3]), _f(lens[4]), _f(lens[5]), _f(lens[6]), _f(lens[7]),
        _f(lens[8]), _f(lens[9]),
    )  # fmt: skip
    for k in range(n):
        x, y, z = X[k], Y[k], Z[k]
        depth = r20 * x + r21 * y + r22 * z + t2
        inverse = _ONE / depth
        u, v = to_plane(
            (r00 * x + r01 * y + r02 * z + t0) * inverse, (r10 * x + r11 * y + r12 * z + t1) * inverse, bend
        )
        U[k], V[k], D[k] = u, v, depth


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def nearest(U, V, D, height, width, edge, n, row, column):
    """The pixel nearest to each (U, V) that lies in the picture, grown by `edge`, in front of the camera; else row -1.
    """
    high_u, high_v = _f(width - 1), _f(height - 1)
    for k in range(n):
        u, v = U[k], V[k]
        inside = (D[k] > _ZERO) & (u >= -edge) & (v >= -edge) & (u <= high_u + edge) & (v <= high_v + edge)
        u = min(max(u, _ZERO), high_u) if inside else _ZERO
        v = min(max(v, _ZERO), high_v) if inside else -_ONE
        column[k] = np.int32(u + _HALF)
        row[k] = np.int32(v + _HALF) if inside else np.int32(-1)


@njit(cache=True, nogil=True, error_model="numpy")
def _touch(row, column, width, xyz, n):
    """Reads every fourth of the pixels that will be needed, whose lines then come to the caches side by side."""
    some = _ZERO
    for k in range(0, n, 4):
        if row[k] >= 0:
            some += xyz[np.uintp(3 * (row[k] * width + column[k]))]
    return some


@njit(cache=True, nogil=True, error_model="numpy")
def pick(row, column, width, xyz, n, X, Y, Z):
    """The points at pixels (row, column), NaN where row is -1."""
    for k in range(n):
        if row[k] >= 0:
            p = np.uintp(3 * (row[k] * width + column[k]))
            X[k], Y[k], Z[k] = xyz[p], xyz[p + _ADD1], xyz[p + _ADD2]
        else:
            X[k] = _NAN


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _suspects(D, X, Y, Z, sigma, pose, tolerance, slack, n, ask):
    """Mark points at depths D that lie in front of the other view's points (X, Y, Z) by more than their own sigma."""
    r0, r1, r2, t = _f(pose[6]), _f(pose[7]), _f(pose[8]), _f(pose[11])
    for k in range(n):
        d = r0 * X[k] + r1 * Y[k] + r2 * Z[k] + t
        ask[k] |= D[k] < d - (tolerance * sigma[k] + slack * D[k])


@njit(cache=True, nogil=True, error_model="numpy")
def examine(x, y, z, sigma, other, tolerance, slack):
    """One point against the surface of another view: 1 confirmed, -1 denied, 0 no evidence (see `contradicted`)."""
    R, L, w = other.pose, other.lens, other.width
    depth = R[6] * x + R[7] * y + R[8] * z + R[11]
    if not depth > 0.0:
        return 0
    u, v = to_plane(
        (R[0] * x + R[1] * y + R[2] * z + R[9]) / depth, (R[3] * x + R[4] * y + R[5] * z + R[10]) / depth, L
    )
    if not (0.0 <= u < w - 1 and 0.0 <= v < other.height - 1):
        return 0
    a, b = int(v), int(u)
    fy, fx = v - a, u - b
    there, low, high, noise = 0.0, np.inf, -np.inf, 0.0
    for k in range(4):
        i, j = k >> 1, k & 1
        p = (a + i) * w + b + j
        d = R[6] * other.xyz[3 * p] + R[7] * other.xyz[3 * p + 1] + R[8] * other.xyz[3 * p + 2] + R[11]
        there += (fy if i == 1 else 1.0 - fy) * (fx if j == 1 else 1.0 - fx) * d
        low, high = min(low, d), max(high, d)
        noise = max(noise, float(other.sigma[p]))
    if there != there:
        return 0
    limit = tolerance * math.sqrt(sigma * sigma + noise * noise) + slack * depth / L[0] + (high - low)
    if depth < there - limit:
        return -1
    return 1 if depth <= there + limit else 0


@by_rows(lambda own, *_: own.height)
def contradicted(first, last, own, others, count, tolerance, slack, bad, lost):
    """Points that one of the first `count` of the `others` looks through, and that none confirms: 1 in `bad` (H, W).

    The other surface is interpolated between four pixels that all carry points. Nearer than `tolerance` combined sigmas
    plus `slack` pixel footprints plus the rise among the four: confirmed. In front of it by more: denied. Behind it:
    hidden there, no evidence. Depths are along the other camera's axis. `bad` comes as zeros; `lost` (H,) counts.

    What is denied lies in front of each of the four by more than its own sigmas and the footprints: only points that
    lie so far in front of the nearest pixel's are examined.
    """
    W = own.width
    X, Y, Z = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    U, V, D = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    A, B, C = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    row, column, ask = np.empty(BLOCK, np.int32), np.empty(BLOCK, np.int32), np.empty(BLOCK, np.bool_)
    lost[first:last] = 0
    touched = _ZERO
    for col in range(0, W, BLOCK):  # block by block downwards, so that the other views' pixels are still in the caches
        n = min(BLOCK, W - col)
        for i in range(first, last):
            p = i * W + col
            if split(own.xyz[3 * i * W : 3 * (i + 1) * W], col, n, X, Y, Z) == 0:
                continue
            sigma = own.sigma[p : p + n]
            ask[:n] = False
            for o in range(count):
                other = others[o]
                project(X, Y, Z, other.pose, other.lens, n, U, V, D)
                nearest(U, V, D, other.height, other.width, EDGE, n, row, column)
                touched += _touch(row, column, other.width, other.xyz, n)
                pick(row, column, other.width, other.xyz, n, A, B, C)
                footprint = _f(slack / other.lens[0]) - ROUNDING
                _suspects(D, A, B, C, sigma, other.pose, _f(tolerance), footprint, n, ask)
            for k in range(n):
                if not ask[k]:
                    continue
                denied = confirmed = 0
                for o in range(count):
                    said = examine(float(X[k]), float(Y[k]), float(Z[k]), float(sigma[k]), others[o], tolerance, slack)
                    denied += said < 0
                    confirmed += said > 0
                if denied > 0 and confirmed == 0:
                    bad[i, col + k] = 1
                    lost[i] += 1
    X[0] = touched  # so that no compiler takes the reading away


@by_rows(lambda bad, *_: bad.shape[0])
def blank(first, last, bad, lost, bit, xyz, sigma, reasons):
    """Take the points marked in `bad` (H, W) away, in rows that have `lost` some, and give them the reason `bit`."""
    for i in range(first, last):
        if lost[i] == 0:
            continue
        for j in range(bad.shape[1]):
            if bad[i, j]:
                reasons[i, j] |= bit
                sigma[i, j] = np.nan
                for k in range(3):
                    xyz[i, j, k] = np.nan
