"""Scalar lens functions (OpenCV's five-term model), shared by every kernel that meets a ray or a projection.

A lens travels as one float64 vector of ten numbers: fx, fy, u0, v0, skew, k1, k2, p1, p2, k3.
"""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.threads import by_rows


@njit(cache=True, inline="always", error_model="numpy")
def distort(x, y, lens):
    """Ideal normalised coordinates to distorted ones, in the precision of what it gets (no number is written out)."""
    k1, k2, p1, p2, k3 = lens[5], lens[6], lens[7], lens[8], lens[9]
    xx, yy, xy = x * x, y * y, x * y
    r2 = xx + yy
    radial = r2 * (k1 + r2 * (k2 + r2 * k3))
    xd = x + (x * radial + (p1 + p1) * xy + p2 * (r2 + xx + xx))
    yd = y + (y * radial + p1 * (r2 + yy + yy) + (p2 + p2) * xy)
    return xd, yd


@njit(cache=True, inline="always", error_model="numpy")
def distort_jacobian(x, y, lens):
    """`distort` and its derivatives: xd, yd, dxd/dx, dxd/dy (= dyd/dx), dyd/dy."""
    k1, k2, p1, p2, k3 = lens[5], lens[6], lens[7], lens[8], lens[9]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    dr = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    jxx = radial + x * x * dr + 2.0 * p1 * y + 6.0 * p2 * x
    jxy = x * y * dr + 2.0 * p1 * x + 2.0 * p2 * y
    jyy = radial + y * y * dr + 6.0 * p1 * y + 2.0 * p2 * x
    return xd, yd, jxx, jxy, jyy


@njit(cache=True, inline="always", error_model="numpy")
def to_plane(x, y, lens):
    """Ideal normalised coordinates to plane coordinates (u, v)."""
    xd, yd = distort(x, y, lens)
    return lens[0] * xd + lens[4] * yd + lens[2], lens[1] * yd + lens[3]


@njit(cache=True, error_model="numpy")
def from_plane(u, v, lens):
    """Plane coordinates to ideal normalised ones: Newton on `distort` to 1e-13; NaN if it fails."""
    yd = (v - lens[3]) / lens[1]
    xd = (u - lens[2] - lens[4] * yd) / lens[0]
    x, y = xd, yd
    for _ in range(20):
        ex, ey, jxx, jxy, jyy = distort_jacobian(x, y, lens)
        ex -= xd
        ey -= yd
        det = jxx * jyy - jxy * jxy
        if not det > 0.0:
            return math.nan, math.nan
        dx = (jyy * ex - jxy * ey) / det
        dy = (jxx * ey - jxy * ex) / det
        x -= dx
        y -= dy
        if abs(dx) + abs(dy) < 1e-13:
            return x, y
    return math.nan, math.nan


@by_rows(lambda p, *_: p.shape[0])
def project_points(first, last, p, R, t, lens, out):
    """World points (n, 3) to plane coordinates (n, 2); NaN behind the device."""
    for i in range(first, last):
        X = R[0, 0] * p[i, 0] + R[0, 1] * p[i, 1] + R[0, 2] * p[i, 2] + t[0]
        Y = R[1, 0] * p[i, 0] + R[1, 1] * p[i, 1] + R[1, 2] * p[i, 2] + t[1]
        Z = R[2, 0] * p[i, 0] + R[2, 1] * p[i, 1] + R[2, 2] * p[i, 2] + t[2]
        if Z > 0.0:
            out[i, 0], out[i, 1] = to_plane(X / Z, Y / Z, lens)
        else:
            out[i, 0] = np.nan
            out[i, 1] = np.nan


@by_rows(lambda uv, *_: uv.shape[0])
def unproject_points(first, last, uv, lens, out):
    """Plane coordinates (n, 2) to ideal normalised coordinates (n, 2)."""
    for i in range(first, last):
        out[i, 0], out[i, 1] = from_plane(uv[i, 0], uv[i, 1], lens)


@by_rows(lambda _lens, out: out.shape[0])
def pixel_rays(first, last, lens, out):
    """Ideal normalised coordinates (H, W, 2) of every pixel centre."""
    for i in range(first, last):
        for j in range(out.shape[1]):
            x, y = from_plane(float(j), float(i), lens)
            out[i, j, 0] = x
            out[i, j, 1] = y
