"""The twin's compiled inner loops: its own lens maths, light lookup and blur; nothing here is shared with the decoder.

Lens vectors are `[fx, fy, u0, v0, skew, k1, k2, p1, p2, k3]`; points and directions float64, light float32.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange


@njit(cache=True, nogil=True)
def _bend(x, y, lens):
    """Ideal normalised coordinates to those after the lens' distortion."""
    k1, k2, p1, p2, k3 = lens[5], lens[6], lens[7], lens[8], lens[9]
    r2 = x * x + y * y
    c = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return c * x + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), c * y + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y


@njit(cache=True, nogil=True)
def _unbend(xd, yd, lens):
    """The inverse of `_bend` by Newton's method with a differenced Jacobian."""
    x, y, h = xd, yd, 1e-6
    for _ in range(8):
        fx, fy = _bend(x, y, lens)
        ex, ey = fx - xd, fy - yd
        if abs(ex) + abs(ey) < 1e-14:
            break
        ax, ay = _bend(x + h, y, lens)
        bx, by = _bend(x, y + h, lens)
        a, c, b, d = (ax - fx) / h, (ay - fy) / h, (bx - fx) / h, (by - fy) / h
        det = a * d - b * c
        x -= (d * ex - b * ey) / det
        y -= (a * ey - c * ex) / det
    return x, y


@njit(cache=True, nogil=True)
def plane_coordinates(points, R, t, lens, out):
    """World points (n, 3) to (u, v, depth) (n, 3) of a device; NaN where the point lies behind it."""
    for i in range(points.shape[0]):
        X, Y, Z = points[i, 0], points[i, 1], points[i, 2]
        z = R[2, 0] * X + R[2, 1] * Y + R[2, 2] * Z + t[2]
        if not z > 0.0:
            out[i, 0] = out[i, 1] = out[i, 2] = math.nan
            continue
        x = (R[0, 0] * X + R[0, 1] * Y + R[0, 2] * Z + t[0]) / z
        y = (R[1, 0] * X + R[1, 1] * Y + R[1, 2] * Z + t[1]) / z
        xd, yd = _bend(x, y, lens)
        out[i, 0] = lens[0] * xd + lens[4] * yd + lens[2]
        out[i, 1] = lens[1] * yd + lens[3]
        out[i, 2] = z


@njit(cache=True, nogil=True)
def directions(uv, R, lens, out):
    """Plane coordinates (n, 2) of a device to unit ray directions (n, 3) in the world."""
    for i in range(uv.shape[0]):
        yd = (uv[i, 1] - lens[3]) / lens[1]
        xd = (uv[i, 0] - lens[2] - lens[4] * yd) / lens[0]
        x, y = _unbend(xd, yd, lens)
        s = 1.0 / math.sqrt(x * x + y * y + 1.0)
        for k in range(3):
            out[i, k] = s * (R[0, k] * x + R[1, k] * y + R[2, k])


@njit(cache=True, nogil=True)
def refine_triangle_hits(origins, dirs, prim, vertices, faces, normals, t, n):
    """Exact distance to the plane of the struck triangle (float64) and the interpolated vertex normal.

    `prim` (k,) is -1 for a miss; `t` (k,) and `n` (k, 3) are filled, NaN and 0 for a miss.
    """
    for i in range(prim.shape[0]):
        f = prim[i]
        if f < 0:
            t[i] = math.inf
            continue
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        e1x = vertices[b, 0] - vertices[a, 0]
        e1y = vertices[b, 1] - vertices[a, 1]
        e1z = vertices[b, 2] - vertices[a, 2]
        e2x = vertices[c, 0] - vertices[a, 0]
        e2y = vertices[c, 1] - vertices[a, 1]
        e2z = vertices[c, 2] - vertices[a, 2]
        gx, gy, gz = e1y * e2z - e1z * e2y, e1z * e2x - e1x * e2z, e1x * e2y - e1y * e2x
        den = gx * dirs[i, 0] + gy * dirs[i, 1] + gz * dirs[i, 2]
        sx = vertices[a, 0] - origins[i, 0]
        sy = vertices[a, 1] - origins[i, 1]
        sz = vertices[a, 2] - origins[i, 2]
        d = (gx * sx + gy * sy + gz * sz) / den
        t[i] = d
        wx, wy, wz = d * dirs[i, 0] - sx, d * dirs[i, 1] - sy, d * dirs[i, 2] - sz
        g2 = gx * gx + gy * gy + gz * gz
        wb = ((wy * e2z - wz * e2y) * gx + (wz * e2x - wx * e2z) * gy + (wx * e2y - wy * e2x) * gz) / g2
        wc = ((e1y * wz - e1z * wy) * gx + (e1z * wx - e1x * wz) * gy + (e1x * wy - e1y * wx) * gz) / g2
        wa = 1.0 - wb - wc
        s = 0.0
        for k in range(3):
            n[i, k] = wa * normals[a, k] + wb * normals[b, k] + wc * normals[c, k]
            s += n[i, k] * n[i, k]
        s = 1.0 / math.sqrt(s)
        for k in range(3):
            n[i, k] *= s


@njit(cache=True, nogil=True, parallel=True)
def blur(image, taps, scratch, out):
    """Separable symmetric blur of (h, w) float32 by `taps` (2, r + 1): half kernels along v and u; edges repeat."""
    h, w = image.shape
    r = taps.shape[1] - 1
    for y in prange(h):
        for x in range(w):
            scratch[y, x] = taps[0, 0] * image[y, x]
        for k in range(1, r + 1):
            a, b, c = max(y - k, 0), min(y + k, h - 1), taps[0, k]
            if c != 0.0:
                for x in range(w):
                    scratch[y, x] += c * (image[a, x] + image[b, x])
    for y in prange(h):
        for x in range(w):
            out[y, x] = taps[1, 0] * scratch[y, x]
        for k in range(1, r + 1):
            c = taps[1, k]
            if c != 0.0:
                for x in range(k, w - k):
                    out[y, x] += c * (scratch[y, x - k] + scratch[y, x + k])
                for x in range(min(k, w)):
                    out[y, x] += c * (scratch[y, 0] + scratch[y, min(x + k, w - 1)])
                for x in range(max(w - k, k), w):
                    out[y, x] += c * (scratch[y, max(x - k, 0)] + scratch[y, w - 1])


@njit(cache=True, nogil=True)
def _bilinear(a, x, y):
    h, w = a.shape
    if not (x >= 0.0 and y >= 0.0 and x <= w - 1.001 and y <= h - 1.001):
        return np.float32(0.0)
    i, j = int(x), int(y)
    fx, fy = np.float32(x - i), np.float32(y - j)
    top = a[j, i] + fx * (a[j, i + 1] - a[j, i])
    low = a[j + 1, i] + fx * (a[j + 1, i + 1] - a[j + 1, i])
    return top + fy * (low - top)


@njit(cache=True, nogil=True)
def light_at(fine, coarse, u, v, level):
    """Light at (u, v): between level 0 (`fine`, unit spacing) and 1, 2 .. (`coarse` (L, h/2, w/2)); linear in `level`.

    (u, v) are counted from the top-left sample of `fine`; a coarse sample covers two by two fine ones.
    """
    k = int(level)
    f = np.float32(level - k)
    x, y = 0.5 * u - 0.25, 0.5 * v - 0.25
    top = coarse.shape[0]
    if k >= top:
        return _bilinear(coarse[top - 1], x, y)
    a = _bilinear(fine, u, v) if k == 0 else _bilinear(coarse[k - 1], x, y)
    if f > 0.0:
        a += f * (_bilinear(coarse[k], x, y) - a)
    return a


@njit(cache=True, nogil=True, parallel=True)
def gather(fine, coarse, u, v, level, gain, steady, out):
    """Signal of every pixel: `steady` (n,) plus the sum of its rays' gain times light; ray arrays are (n, rays)."""
    n, s = u.shape
    for i in prange(n):
        total = steady[i]
        for j in range(s):
            g = gain[i, j]
            if g > 0.0:
                total += g * light_at(fine, coarse, u[i, j], v[i, j], level[i, j])
        out[i] = total


@njit(cache=True, nogil=True)
def gather_sparse(fine, coarse, pixel, u, v, level, gain, out):
    """Adds gain times light of each listed ray to its pixel."""
    for i in range(pixel.shape[0]):
        out[pixel[i]] += gain[i] * light_at(fine, coarse, u[i], v[i], level[i])


@njit(cache=True, nogil=True, parallel=True)
def expose(signal, noise, electrons, read_noise, per_electron, offset, full_well, top, out):
    """Signal (n,) to codes: photo-electrons with shot and read noise, clipped at the well, offset, rounded, clipped.

    `noise` (n,) standard normal, or empty for a noise-free sensor. Shot noise is drawn as normal with the mean as
    its variance, which the read noise covers where few electrons come.
    """
    noisy = noise.size > 0
    for i in prange(signal.size):
        e = max(signal[i] * electrons, 0.0)
        if noisy:
            e += math.sqrt(e + read_noise * read_noise) * noise[i]
        c = math.floor(min(e, full_well) * per_electron + offset + 0.5)
        out[i] = min(max(c, 0.0), top)
