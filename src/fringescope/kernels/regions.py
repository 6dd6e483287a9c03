"""Neighbourhoods of the phase image: gradient votes, contiguous domains, the local surface. Arrays and scalars only."""

import math

import numpy as np
from numba import njit

from fringescope.threads import by_rows

STRIP = 8  #: pixels of a row for which the predicted direction is taken at their first


@njit(cache=True, inline="always", error_model="numpy")
def _spread(field, i, j, H, W, c):
    """Channel c of a coarse field (h, w, C) that spans the image corner on corner, at pixel (i, j)."""
    h, w = field.shape[0], field.shape[1]
    y = i * (h - 1) / max(H - 1, 1)
    x = j * (w - 1) / max(W - 1, 1)
    y0 = min(int(y), max(h - 2, 0))
    x0 = min(int(x), max(w - 2, 0))
    y1 = min(y0 + 1, h - 1)
    x1 = min(x0 + 1, w - 1)
    fy = y - y0
    fx = x - x0
    return (1 - fy) * ((1 - fx) * field[y0, x0, c] + fx * field[y0, x1, c]) + fy * (
        (1 - fx) * field[y1, x0, c] + fx * field[y1, x1, c]
    )


@by_rows(lambda phase, *_: phase.shape[0])
def gradient_signs(first, last, phase, sigma, reasons, field, reach, significance, out):
    """Sign of the phase's growth along the predicted direction (equation 17): 1 forward, -1 backward, 0 unknown.

    `field` (h, w, 3) holds the unit direction (du, dv). The difference is taken over `reach` pixels on either side, or
    on one where the other is masked; it must exceed `significance` standard deviations to count.
    """
    H, W = phase.shape
    for i in range(first, last):
        strip = -1
        x = y = 0
        for j in range(W):
            out[i, j] = 0
            if reasons[i, j] != 0:
                continue
            if j // STRIP != strip:  # the direction hardly turns within a strip
                strip = j // STRIP
                du, dv = _spread(field, i, strip * STRIP, H, W, 0), _spread(field, i, strip * STRIP, H, W, 1)
                n = math.hypot(du, dv)
                x = round(reach * du / n) if n > 0.0 else 0
                y = round(reach * dv / n) if n > 0.0 else 0
            if x == 0 and y == 0:
                continue
            a, b = phase[i, j], phase[i, j]
            va = vb = sigma[i, j] ** 2
            if 0 <= i + y < H and 0 <= j + x < W and reasons[i + y, j + x] == 0:
                a = phase[i + y, j + x]
                va = sigma[i + y, j + x] ** 2
            if 0 <= i - y < H and 0 <= j - x < W and reasons[i - y, j - x] == 0:
                b = phase[i - y, j - x]
                vb = sigma[i - y, j - x] ** 2
            if (a - b) * (a - b) > significance * significance * (va + vb):
                out[i, j] = 1 if a > b else -1


@by_rows(lambda signs, *_: signs.shape[0])
def majority_backward(first, last, signs, radius, share, least, out):
    """Where at least `share` of at least `least` signs in the window are backward: a contiguous reversal."""
    H, W = signs.shape
    column = np.empty(W, np.int64)
    for i in range(first, last):
        column[:] = 0
        for y in range(max(i - radius, 0), min(i + radius + 1, H)):
            for j in range(W):
                column[j] += signs[y, j] < 0
        for j in range(W):
            out[i, j] = False
            back = votes = 0
            for x in range(max(j - radius, 0), min(j + radius + 1, W)):
                back += column[x]
            if back == 0:
                continue
            back = 0
            for y in range(max(i - radius, 0), min(i + radius + 1, H)):
                for x in range(max(j - radius, 0), min(j + radius + 1, W)):
                    if signs[y, x] != 0:
                        votes += 1
                        if signs[y, x] < 0:
                            back += 1
            if votes >= least and back >= share * votes:
                out[i, j] = True


@njit(cache=True, inline="always", error_model="numpy")
def largest_step(field, factor, floor, i, j, H, W):
    """T1 without noise: `factor` times the growth that a surface facing both devices has at this pixel, per pixel.

    The growth is channel 2 of `field`, radians per pixel; T1 is at least `floor`.
    """
    return max(factor * _spread(field, i, j, H, W, 2), floor)


@njit(cache=True, inline="always", error_model="numpy")
def linked(phase, sigma, step, noise, i, j, y, x):
    """Whether two pixels in one row or column or diagonal continue one surface: their phases differ by less than T1.

    T1 = `step` (see `largest_step`) times the distance, plus `noise` standard deviations.
    """
    limit = step * max(abs(i - y), abs(j - x)) + noise * math.sqrt(sigma[i, j] ** 2 + sigma[y, x] ** 2)
    return abs(phase[i, j] - phase[y, x]) < limit


@by_rows(lambda phase, *_: phase.shape[0])
def loose_pixels(first, last, phase, sigma, reasons, field, factor, floor, noise, least, out):
    """Pixels that stand on a jump: they continue the surface of fewer than `least` of their eight neighbours.

    At the image border the same share of those inside counts. The eight at distance two may stand in for the next
    ones: on a Bayer sensor these are of the pixel's own colour, and often the only ones with enough light.
    """
    H, W = phase.shape
    for i in range(first, last):
        for j in range(W):
            out[i, j] = False
            if reasons[i, j] != 0:
                continue
            step = largest_step(field, factor, floor, i, j, H, W)
            loose = True
            for distance in range(1, 3):
                links = 0
                inside = 0
                for dy in range(-distance, distance + 1, distance):
                    for dx in range(-distance, distance + 1, distance):
                        y = i + dy
                        x = j + dx
                        if (dy == 0 and dx == 0) or not (0 <= y < H and 0 <= x < W):
                            continue
                        inside += 1
                        if reasons[y, x] != 0:
                            continue
                        if linked(phase, sigma, step, noise, i, j, y, x):
                            links += 1
                loose = loose and 8 * links < least * inside
            out[i, j] = loose


@njit(cache=True, error_model="numpy")
def _root(parent, a):
    while parent[a] != a:
        parent[a] = parent[parent[a]]
        a = parent[a]
    return a


@njit(cache=True, error_model="numpy")
def domains(phase, sigma, reasons, field, factor, floor, noise, label):
    """Contiguous domains of pixels that are `linked` (union-find): labels (H, W) int32, -1 = masked.

    Links go to the next pixel in the row and the column, and over one masked pixel to the next but one. Returns the
    number of pixels of every label.
    """
    H, W = phase.shape
    parent = np.arange(H * W)
    for i in range(H):
        for j in range(W):
            if reasons[i, j] != 0:
                continue
            step = largest_step(field, factor, floor, i, j, H, W)
            for back in range(2):
                y = i - back
                x = j - 1 + back
                if y >= 0 and x >= 0 and reasons[y, x] != 0:
                    y -= back
                    x -= 1 - back
                if y < 0 or x < 0 or reasons[y, x] != 0:
                    continue
                if linked(phase, sigma, step, noise, i, j, y, x):
                    a, b = _root(parent, i * W + j), _root(parent, y * W + x)
                    parent[max(a, b)] = min(a, b)
    count = 0
    for a in range(H * W):
        i, j = a // W, a % W
        if reasons[i, j] != 0:
            label[i, j] = -1
        elif parent[a] == a:
            label[i, j] = count
            count += 1
        else:
            r = _root(parent, a)
            label[i, j] = label[r // W, r % W]
    sizes = np.zeros(count, np.int64)
    for i in range(H):
        for j in range(W):
            if label[i, j] >= 0:
                sizes[label[i, j]] += 1
    return sizes


@njit(cache=True, error_model="numpy")
def _solve(M, rhs, n):
    """Solve the symmetric positive definite n x n system in place by Cholesky.

    Returns (ok, element (0, 0) of the inverse); the solution is in `rhs`.
    """
    inv00 = 0.0
    for a in range(n):
        for b in range(a + 1):
            s = M[a, b]
            for c in range(b):
                s -= M[a, c] * M[b, c]
            if a == b:
                if s <= 1e-12:
                    return False, 0.0
                M[a, a] = math.sqrt(s)
            else:
                M[a, b] = s / M[b, b]
    for a in range(n):
        s = rhs[a]
        t = 1.0 if a == 0 else 0.0
        for c in range(a):
            s -= M[a, c] * rhs[c]
            t -= M[a, c] * M[n, c]
        rhs[a] = s / M[a, a]
        M[n, a] = t / M[a, a]
        inv00 += M[n, a] * M[n, a]
    for a in range(n - 1, -1, -1):
        s = rhs[a]
        for c in range(a + 1, n):
            s -= M[c, a] * rhs[c]
        rhs[a] = s / M[a, a]
    return True, inv00


@njit(cache=True, error_model="numpy")
def _normal_equations(x, y, value, weight, n, terms, M, rhs):
    """Least squares of 1, x, y, x^2, x y, y^2 (the first `terms`): the lower triangle of M (7, 6) and rhs (6,)."""
    m00 = m10 = m01 = m20 = m11 = m02 = 0.0
    m30 = m21 = m12 = m03 = m40 = m31 = m22 = m13 = m04 = 0.0
    r0 = r1 = r2 = r3 = r4 = r5 = 0.0
    for k in range(n):
        a, b, w = x[k], y[k], weight[k]
        aa, ab, bb = a * a, a * b, b * b
        v = w * value[k]
        m00 += w
        m10 += w * a
        m01 += w * b
        m20 += w * aa
        m11 += w * ab
        m02 += w * bb
        r0 += v
        r1 += v * a
        r2 += v * b
        if terms == 6:
            m30 += w * aa * a
            m21 += w * aa * b
            m12 += w * a * bb
            m03 += w * bb * b
            m40 += w * aa * aa
            m31 += w * aa * ab
            m22 += w * aa * bb
            m13 += w * ab * bb
            m04 += w * bb * bb
            r3 += v * aa
            r4 += v * ab
            r5 += v * bb
    M[0, 0] = m00
    M[1, 0], M[1, 1] = m10, m20
    M[2, 0], M[2, 1], M[2, 2] = m01, m11, m02
    rhs[0], rhs[1], rhs[2] = r0, r1, r2
    if terms == 6:
        M[3, 0], M[3, 1], M[3, 2], M[3, 3] = m20, m30, m21, m40
        M[4, 0], M[4, 1], M[4, 2], M[4, 3], M[4, 4] = m11, m21, m12, m31, m22
        M[5, 0], M[5, 1], M[5, 2], M[5, 3], M[5, 4], M[5, 5] = m02, m12, m03, m22, m13, m04
        rhs[3], rhs[4], rhs[5] = r3, r4, r5


@by_rows(lambda phase, *_: phase.shape[0])
def local_surface(first, last, phase, sigma, label, asked, radius, least, out, roughness):
    """Distance of each pixel's phase from the surface of its neighbours, in standard deviations; NaN where too few.

    The surface is a quadric (a plane with fewer than 12 neighbours) through the pixels of the same domain in the
    window, without the pixel itself, by least squares with weights 1 / sigma^2 that let go of outliers (Cauchy at 2.5
    sigma). `roughness` gets the rms of the neighbours about it, in their sigmas; above 1 it widens the yardstick.
    Pixels that are not `asked` (see `screens.rough_pixels`) get 0 for both.
    """
    H, W = phase.shape
    room = (2 * radius + 1) ** 2
    dx, dy, value = np.empty(room), np.empty(room), np.empty(room)
    inverse, weight = np.empty(room), np.empty(room)
    M = np.empty((7, 6))
    c = np.zeros(6)
    for i in range(first, last):
        for j in range(W):
            out[i, j] = np.nan
            roughness[i, j] = np.nan
            own = label[i, j]
            if own < 0:
                continue
            if not asked[i, j]:
                out[i, j] = 0.0
                roughness[i, j] = 0.0
                continue
            n = 0
            here = phase[i, j]
            for y in range(max(i - radius, 0), min(i + radius + 1, H)):
                for x in range(max(j - radius, 0), min(j + radius + 1, W)):
                    if label[y, x] != own or (y == i and x == j):
                        continue
                    dx[n] = x - j
                    dy[n] = y - i
                    value[n] = phase[y, x] - here
                    s = float(sigma[y, x])
                    inverse[n] = 1.0 / (s * s)
                    weight[n] = inverse[n]
                    n += 1
            if n < least:
                continue
            terms = 6 if n >= 12 else 3
            c[3] = c[4] = c[5] = 0.0
            for sweep in range(3):
                _normal_equations(dx, dy, value, weight, n, terms, M, c)
                ok, inv00 = _solve(M, c, terms)
                if not ok:
                    break
                worst = spread = weight_sum = 0.0
                for k in range(n):
                    a, b = dx[k], dy[k]
                    r = value[k] - (c[0] + a * (c[1] + c[3] * a + c[4] * b) + b * (c[2] + c[5] * b))
                    z2 = r * r * inverse[k]
                    w = 1.0 / (1.0 + z2 / 6.25)
                    worst = max(worst, z2)
                    spread += w * z2
                    weight_sum += w
                    weight[k] = w * inverse[k]
                if worst < 9.0 or sweep == 2:
                    spread = math.sqrt(spread / max(weight_sum * (1.0 - terms / n), 1.0))
                    yardstick = math.sqrt(sigma[i, j] ** 2 + inv00) * max(spread, 1.0)
                    out[i, j] = abs(c[0]) / yardstick
                    roughness[i, j] = spread
                    break
