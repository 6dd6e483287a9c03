"""Chequerboard corners: the ring test of a saddle and the fit of a blurred chequer corner. Arrays and scalars only."""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.threads import by_rows

TERMS = 14  #: place (2), two edge angles, blur, offset polynomial (6), contrast polynomial (3)


@njit(cache=True, inline="always", error_model="numpy")
def bilinear(image, x, y):
    """Image (H, W) at (x, y); places outside take the nearest pixel."""
    H, W = image.shape
    x = min(max(x, 0.0), W - 1.0)
    y = min(max(y, 0.0), H - 1.0)
    j = min(int(x), max(W - 2, 0))
    i = min(int(y), max(H - 2, 0))
    fx, fy = x - j, y - i
    jj, ii = min(j + 1, W - 1), min(i + 1, H - 1)
    return (1 - fy) * ((1 - fx) * image[i, j] + fx * image[i, jj]) + fy * (
        (1 - fx) * image[ii, j] + fx * image[ii, jj]
    )


@by_rows(lambda _image, place, *_: place.shape[0])
def ring_tests(first, last, image, place, radius, out):
    """How much each place (n, 2) looks like a chequer corner on a circle around it.

    out (n, 4): angle alpha and angle beta in [0, pi) of the two edges, the bright sectors running from alpha to beta
    (anticlockwise in x right, y down: the way the angle grows); contrast, half the difference of bright and dark;
    symmetry, the correlation of the ring with itself after half a turn. Contrast 0 = not four sectors.
    """
    count = 32
    ring = np.empty(count)
    cross = np.empty(4)
    for n in range(first, last):
        out[n, :] = 0.0
        for k in range(count):
            t = 2.0 * math.pi * k / count
            ring[k] = bilinear(image, place[n, 0] + radius * math.cos(t), place[n, 1] + radius * math.sin(t))
        low, high = ring[0], ring[0]
        for k in range(count):
            low, high = min(low, ring[k]), max(high, ring[k])
        level = 0.5 * (low + high)
        found = 0
        rising = -1
        for k in range(count):
            a, b = ring[k] - level, ring[(k + 1) % count] - level
            if (a < 0.0) != (b < 0.0):
                if found < 4:
                    cross[found] = (k + a / (a - b)) * 2.0 * math.pi / count
                    if a < 0.0 and rising < 0:
                        rising = found
                found += 1
        if found != 4:
            continue
        alpha = 0.5 * (cross[rising] + cross[(rising + 2) % 4] + (math.pi if rising >= 2 else -math.pi))
        falling = (rising + 1) % 4
        beta = 0.5 * (cross[falling] + cross[(falling + 2) % 4] + (math.pi if falling >= 2 else -math.pi))
        same = other = 0.0
        for k in range(count // 2):
            a, b = ring[k] - level, ring[k + count // 2] - level
            same += 2.0 * a * b
            other += a * a + b * b
        out[n, 0] = alpha % math.pi
        out[n, 1] = beta % math.pi
        out[n, 2] = 0.5 * (high - low)
        out[n, 3] = same / other


@njit(cache=True, inline="always", error_model="numpy")
def edge_profile(d, half1, half2, blur):
    """A step from -1 to 1 at d = 0 seen through a Gaussian of width `blur` and a square pixel whose shadow on the
    normal is the sum of two boxes of half widths `half1`, `half2`: its value, first and second derivative by d.
    """
    if d > half1 + half2 + 6.0 * blur:
        return 1.0, 0.0, 0.0
    if d < -half1 - half2 - 6.0 * blur:
        return -1.0, 0.0, 0.0
    value = first = second = 0.0
    for k in range(4):
        z = d + (half1 if k < 2 else -half1) + (half2 if k % 2 == 0 else -half2)
        sign = 1.0 if k == 0 or k == 3 else -1.0
        e = math.erf(z / (math.sqrt(2.0) * blur))
        g = math.sqrt(2.0 / math.pi) * blur * math.exp(-0.5 * (z / blur) ** 2)
        value += sign * 0.5 * ((z * z + blur * blur) * e + z * g)
        first += sign * (z * e + g)
        second += sign * e
    scale = 0.25 / (half1 * half2)
    return value * scale, first * scale, second * scale


@njit(cache=True, inline="always", error_model="numpy")
def _model(p, x, y, bend1, bend2, row):
    """Value of the corner model at (x, y) and its derivatives in `row` (TERMS,)."""
    dx, dy = x - p[0], y - p[1]
    c1, s1, c2, s2 = math.cos(p[2]), math.sin(p[2]), math.cos(p[3]), math.sin(p[3])
    t1, t2 = c1 * dx + s1 * dy, c2 * dx + s2 * dy
    n1, n2 = c1 * dy - s1 * dx, c2 * dy - s2 * dx
    d1, d2 = n1 - 0.5 * bend1 * t1 * t1, n2 - 0.5 * bend2 * t2 * t2
    e1, g1, h1 = edge_profile(d1, 0.5 * max(abs(s1), 0.01), 0.5 * max(abs(c1), 0.01), p[4])
    e2, g2, h2 = edge_profile(d2, 0.5 * max(abs(s2), 0.01), 0.5 * max(abs(c2), 0.01), p[4])
    contrast = p[11] + p[12] * dx + p[13] * dy
    e = e1 * e2
    a1, a2 = contrast * g1 * e2, contrast * g2 * e1
    row[0] = a1 * (s1 + bend1 * t1 * c1) + a2 * (s2 + bend2 * t2 * c2)
    row[1] = a1 * (-c1 + bend1 * t1 * s1) + a2 * (-c2 + bend2 * t2 * s2)
    row[2] = -a1 * (t1 + bend1 * t1 * n1)
    row[3] = -a2 * (t2 + bend2 * t2 * n2)
    row[4] = contrast * p[4] * (h1 * e2 + h2 * e1)
    row[5], row[6], row[7] = 1.0, dx, dy
    row[8], row[9], row[10] = dx * dx, dx * dy, dy * dy
    row[11], row[12], row[13] = e, e * dx, e * dy
    offset = p[5] + p[6] * dx + p[7] * dy + p[8] * dx * dx + p[9] * dx * dy + p[10] * dy * dy
    row[0] -= p[6] + 2 * p[8] * dx + p[9] * dy + p[12] * e
    row[1] -= p[7] + 2 * p[10] * dy + p[9] * dx + p[13] * e
    return offset + contrast * e


@njit(cache=True, inline="always", error_model="numpy")
def _counts(a, b, reach, clear, dark):
    """Whether a pixel at lattice offsets (a, b) from the corner takes part: within reach and off a white square's
    marker; `dark` is the sign of a b in the dark squares.
    """
    if abs(a) > reach or abs(b) > reach:
        return False
    return clear >= reach or min(abs(a), abs(b)) <= clear or a * b * dark > 0.0


@njit(cache=True, error_model="numpy")
def fit_corner(image, weights, start, step1, step2, bend1, bend2, blur, reach, clear, dark, radius, out):
    """Fit one blurred chequer corner by Levenberg-Marquardt; see `fit_corners` for the arguments and `out`."""
    H, W = image.shape
    out[:] = math.nan
    det = step1[0] * step2[1] - step1[1] * step2[0]
    half_x = min(radius, reach * (abs(step1[0]) + abs(step2[0])))
    half_y = min(radius, reach * (abs(step1[1]) + abs(step2[1])))
    x0, x1 = math.ceil(start[0] - half_x), math.floor(start[0] + half_x)
    y0, y1 = math.ceil(start[1] - half_y), math.floor(start[1] + half_y)
    if not abs(det) > 1.0 or x0 < 0 or y0 < 0 or x1 >= W or y1 >= H:
        return
    p = np.zeros(TERMS)
    p[0], p[1] = start[0], start[1]
    p[2], p[3] = math.atan2(step1[1], step1[0]), math.atan2(step2[1], step2[0])
    p[4] = blur
    bright = dim = wb = wd = 0.0
    for i in range(y0, y1 + 1):
        for j in range(x0, x1 + 1):
            dx, dy = j - start[0], i - start[1]
            a, b = (dx * step2[1] - dy * step2[0]) / det, (dy * step1[0] - dx * step1[1]) / det
            w = weights[i & 1, j & 1]
            if abs(a) > reach or abs(b) > reach or dx * dx + dy * dy > radius * radius or w <= 0:
                continue
            if a * b * dark > 0.0:
                dim += w * image[i, j]
                wd += w
            else:
                bright += w * image[i, j]
                wb += w
    if wd == 0.0 or wb == 0.0:
        return
    bright, dim = bright / wb, dim / wd
    p[5] = 0.5 * (bright + dim)
    p[11] = 0.5 * (bright - dim) * dark  # d1 d2 has the sign of -a b
    row, trial = np.empty(TERMS), np.empty(TERMS)
    N, r = np.empty((TERMS, TERMS)), np.empty(TERMS)
    damping, cost = 1e-3, math.inf
    best = p.copy()
    BN = N.copy()
    count = 0
    total = 0.0
    for _ in range(30):
        N[:] = 0.0
        r[:] = 0.0
        chi = 0.0
        n = 0
        sw = 0.0
        for i in range(y0, y1 + 1):
            for j in range(x0, x1 + 1):
                dx, dy = j - start[0], i - start[1]
                w = weights[i & 1, j & 1]
                if dx * dx + dy * dy > radius * radius or w <= 0:
                    continue
                a, b = (dx * step2[1] - dy * step2[0]) / det, (dy * step1[0] - dx * step1[1]) / det
                if not _counts(a, b, reach, clear, dark):
                    continue
                miss = image[i, j] - _model(p, j, i, bend1, bend2, row)
                chi += w * miss * miss
                n += 1
                sw += w
                for k in range(TERMS):
                    wk = w * row[k]
                    r[k] += wk * miss
                    for m in range(k + 1):
                        N[k, m] += wk * row[m]
        if n < 2 * TERMS or not chi < math.inf:
            return
        done = False
        if chi <= cost:
            done = cost - chi < 1e-7 * chi or chi < 1e-12
            cost, count, total = chi, n, sw
            best[:] = p
            for k in range(TERMS):
                for m in range(k):
                    N[m, k] = N[k, m]
            BN[:] = N
            trial[:] = r
            damping = max(damping * 0.2, 1e-9)
        else:
            damping *= 8.0
            if damping > 1e6:
                break
        if done:
            break
        M = BN.copy()
        for k in range(TERMS):
            M[k, k] *= 1.0 + damping
            M[k, k] += 1e-300
        step = np.linalg.solve(M, trial)
        p[:] = best + step
        p[4] = min(max(p[4], 0.25 * best[4]), 4.0 * best[4])
        p[4] = max(p[4], 0.12)
    for k in range(TERMS):
        BN[k, k] += 1e-12 * BN[k, k] + 1e-300
    C = np.linalg.inv(BN)
    variance = cost / (count - TERMS)
    out[0], out[1] = best[0], best[1]
    out[2] = math.sqrt(max(0.5 * (C[0, 0] + C[1, 1]) * variance, 0.0))
    out[3] = best[4]
    out[4] = best[5]
    out[5] = abs(best[11])
    out[6] = math.sqrt(cost / total)
    out[7] = best[2]
    out[8] = best[3]
    out[9] = count
    out[10] = 1.0 if best[11] > 0.0 else -1.0  # sign of a b in the dark squares


@by_rows(lambda _image, _weights, start, *_: start.shape[0])
def fit_corners(first, last, image, weights, start, step1, step2, bend, blur, reach, clear, dark, radius, out):
    """Fit blurred chequer corners: two crossing edges, low-order light (offset of degree 2, contrast of degree 1).

    `image` (H, W) with the colour sites made equal, `weights` (2, 2) of the sites of a 2 x 2 cell; per corner (n) the
    `start` (2,), the steps (2,) to its two neighbours along the lattice in pixels, the `bend` (2,) of the two edges
    (1/pixel), `dark` (+1 or -1, the sign of a b in the dark squares at lattice offsets a, b). Pixels within `reach`
    squares and `radius` pixels take part; in the white squares only those within `clear` squares of an edge.
    out (n, 11): x, y, standard deviation of x and y, blur, mean level, half the contrast, rms misfit, two edge angles,
    pixels, and the sign of the dark squares found; NaN where it fails.
    """
    for n in range(first, last):
        fit_corner(
            image, weights, start[n], step1[n], step2[n], bend[n, 0], bend[n, 1], blur, reach, clear, dark[n], radius,
            out[n],
        )  # fmt: skip
