"""The twin's compiled inner loops: its own lens maths, light lookup and blur; nothing here is shared with the decoder.

Lens vectors are `[fx, fy, u0, v0, skew, k1, k2, p1, p2, k3]`; points and directions float64, light float32.
"""

from __future__ import annotations

import math

import numpy as np

from fringescope.jit import njit
from fringescope.threads import by_rows


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


@njit(cache=True, nogil=True, fastmath=True)
def blur(image, taps, scratch, out):
    """Separable symmetric blur of (h, w) float32 by `taps` (2, r + 1): half kernels along v and u; edges repeat."""
    h, w = image.shape
    r = min(taps.shape[1] - 1, (w - 1) // 2)
    for y in range(h):
        row = scratch[y]
        row[:] = taps[0, 0] * image[y]
        for k in range(1, r + 1):
            above, below, c = image[max(y - k, 0)], image[min(y + k, h - 1)], taps[0, k]
            for x in range(w):
                row[x] += c * (above[x] + below[x])
        target = out[y]
        target[:] = taps[1, 0] * row
        for k in range(1, r + 1):
            c, left, right, middle = taps[1, k], row[: w - 2 * k], row[2 * k :], target[k : w - k]
            for x in range(w - 2 * k):
                middle[x] += c * (left[x] + right[x])
            for x in range(k):
                target[x] += c * (row[0] + row[x + k])
                target[w - 1 - x] += c * (row[w - 1 - x - k] + row[w - 1])


@njit(cache=True, nogil=True)
def _cubic(a, x, y):
    """Catmull-Rom interpolation of (h, w) at column x, row y; 0 outside."""
    h, w = a.shape
    if not (x >= 1.0 and y >= 1.0 and x < w - 2.0 and y < h - 2.0):
        return np.float32(0.0)
    i, j = int(x), int(y)
    f = np.float32(x - i)
    g = np.float32(y - j)
    half = np.float32(0.5)
    a0 = half * f * (-1 + f * (2 - f))
    a1 = 1 + half * f * f * (-5 + 3 * f)
    a2 = half * f * (1 + f * (4 - 3 * f))
    a3 = half * f * f * (f - 1)
    b0 = half * g * (-1 + g * (2 - g))
    b1 = 1 + half * g * g * (-5 + 3 * g)
    b2 = half * g * (1 + g * (4 - 3 * g))
    b3 = half * g * g * (g - 1)
    r0 = a0 * a[j - 1, i - 1] + a1 * a[j - 1, i] + a2 * a[j - 1, i + 1] + a3 * a[j - 1, i + 2]
    r1 = a0 * a[j, i - 1] + a1 * a[j, i] + a2 * a[j, i + 1] + a3 * a[j, i + 2]
    r2 = a0 * a[j + 1, i - 1] + a1 * a[j + 1, i] + a2 * a[j + 1, i + 1] + a3 * a[j + 1, i + 2]
    r3 = a0 * a[j + 2, i - 1] + a1 * a[j + 2, i] + a2 * a[j + 2, i + 1] + a3 * a[j + 2, i + 2]
    return b0 * r0 + b1 * r1 + b2 * r2 + b3 * r3


@njit(cache=True, nogil=True)
def light_at(levels, x, y, level):
    """Light at column x, row y of `levels` (L, h, w), between two of them; linear in `level`, clipped at the last."""
    k = min(int(level), levels.shape[0] - 1)
    f = np.float32(level - k)
    a = _cubic(levels[k], x, y)
    if f > 0.0 and k + 1 < levels.shape[0]:
        a += f * (_cubic(levels[k + 1], x, y) - a)
    return max(a, np.float32(0.0))


@by_rows(lambda _levels, x, *_: x.size)
def gather(first, last, levels, x, y, level, gain, steady, out):
    """Signal of every pixel (n,): `steady` plus its gain times the light where it looks."""
    for i in range(first, last):
        g = gain[i]
        out[i] = steady[i] + (g * light_at(levels, x[i], y[i], level[i]) if g > 0.0 else np.float32(0.0))


@njit(cache=True, nogil=True)
def gather_sparse(levels, pixel, x, y, level, gain, out):
    """Adds gain times light of each listed ray to its pixel."""
    for i in range(pixel.shape[0]):
        out[pixel[i]] += gain[i] * light_at(levels, x[i], y[i], level[i])


@njit(cache=True, nogil=True)
def bilinear(values, x0, y0, step, points, out):
    """Looks up a raster (h, w, k) at x and y of points (n, 3) into out (n, k); edges repeat."""
    h, w, m = values.shape
    for i in range(points.shape[0]):
        x = min(max((points[i, 0] - x0) / step, 0.0), w - 1.001)
        y = min(max((points[i, 1] - y0) / step, 0.0), h - 1.001)
        c, r = int(x), int(y)
        f, g = x - c, y - r
        for k in range(m):
            top = values[r, c, k] * (1 - f) + values[r, c + 1, k] * f
            low = values[r + 1, c, k] * (1 - f) + values[r + 1, c + 1, k] * f
            out[i, k] = top * (1 - g) + low * g


@njit(cache=True, nogil=True)
def spline(lattice, x, y, out):
    """Cubic B-spline over a periodic lattice (128, 128) at columns x and rows y, all (n,)."""
    for i in range(out.size):
        c, r = math.floor(x[i]), math.floor(y[i])
        f, g = x[i] - c, y[i] - r
        e, h = 1 - f, 1 - g
        b0, b1, b2, b3 = e * e * e, 4 + f * f * (3 * f - 6), 4 + e * e * (3 * e - 6), f * f * f
        d0, d1, d2, d3 = h * h * h, 4 + g * g * (3 * g - 6), 4 + h * h * (3 * h - 6), g * g * g
        c0, c1, c2, c3 = (c - 1) & 127, c & 127, (c + 1) & 127, (c + 2) & 127
        s = 0.0
        for j, d in ((-1, d0), (0, d1), (1, d2), (2, d3)):
            row = lattice[(r + j) & 127]
            s += d * (b0 * row[c0] + b1 * row[c1] + b2 * row[c2] + b3 * row[c3])
        out[i] = s / 36.0


@njit(cache=True, nogil=True)
def _fresnel(f0, c):
    m = 1.0 - min(max(c, 0.0), 1.0)
    return f0 + (1.0 - f0) * m * m * m * m * m


@njit(cache=True, nogil=True)
def _lobe(nx, ny, nz, lx, ly, lz, ex, ey, ez, alpha, f0):
    """pi times GGX reflectance (Walter et al. 2007, Schlick's Smith shadowing) for unit vectors."""
    hx, hy, hz = lx + ex, ly + ey, lz + ez
    s = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
    nh = min(max((nx * hx + ny * hy + nz * hz) * s, 0.0), 1.0)
    eh = (ex * hx + ey * hy + ez * hz) * s
    nl, ne = max(nx * lx + ny * ly + nz * lz, 1e-4), max(nx * ex + ny * ey + nz * ez, 1e-4)
    a2, k = alpha * alpha, 0.5 * alpha
    q = nh * nh * (a2 - 1.0) + 1.0
    return a2 / (q * q) * _fresnel(f0, eh) / ((nl * (1 - k) + k) * (ne * (1 - k) + k)) / 4.0


@njit(cache=True, nogil=True)
def reflect(points, normals, shiny, dirs, lamp, axis, reach, falloff, alpha, f0, diffuse, tint, least_alpha, out):
    """Light (n,) that surfaces send along -dirs from a lamp at (3,): Lambert under a film, and the film's gloss.

    The lamp gives 1 at distance `reach`, falling with the square of the distance and cos(angle to its `axis`)^falloff.
    `diffuse`, `tint` (n,): the sensor's response to the body's colour, and to white.
    """
    for i in range(points.shape[0]):
        lx, ly, lz = lamp[0] - points[i, 0], lamp[1] - points[i, 1], lamp[2] - points[i, 2]
        r = math.sqrt(lx * lx + ly * ly + lz * lz)
        lx, ly, lz = lx / r, ly / r, lz / r
        cos = lx * normals[i, 0] + ly * normals[i, 1] + lz * normals[i, 2]
        if not cos > 0.0:
            out[i] = 0.0
            continue
        ex, ey, ez = -dirs[i, 0], -dirs[i, 1], -dirs[i, 2]
        E = (reach / r) ** 2
        if falloff > 0.0:
            E *= max(-(lx * axis[0] + ly * axis[1] + lz * axis[2]), 0.0) ** falloff
        value = diffuse[i]
        if f0[i] > 0.0:
            ne = ex * normals[i, 0] + ey * normals[i, 1] + ez * normals[i, 2]
            value *= (1.0 - _fresnel(f0[i], ne)) * (1.0 - f0[i])
            a = max(alpha[i], least_alpha)
            value += tint[i] * _lobe(shiny[i, 0], shiny[i, 1], shiny[i, 2], lx, ly, lz, ex, ey, ez, a, f0[i])
        out[i] = E * cos * value


@njit(cache=True, nogil=True)
def expose(signal, noise, electrons, read_noise, per_electron, offset, full_well, top, out):
    """Signal (n,) to codes: photo-electrons with shot and read noise, clipped at the well, offset, rounded, clipped.

    `noise` (n,) standard normal, or empty for a noise-free sensor. Shot noise is drawn as normal with the mean as
    its variance, which the read noise covers where few electrons come.
    """
    noisy = noise.size > 0
    for i in range(signal.size):
        e = max(signal[i] * electrons, 0.0)
        if noisy:
            e += math.sqrt(e + read_noise * read_noise) * noise[i]
        c = math.floor(min(e, full_well) * per_electron + offset + 0.5)
        out[i] = min(max(c, 0.0), top)
