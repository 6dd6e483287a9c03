"""Neighbourhoods of the phase image: gradient votes, contiguous domains, the local surface. Arrays and scalars only."""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.domains import label_of
from fringescope.kernels.links import largest_step, linked, spread
from fringescope.kernels.raw import unowned
from fringescope.kernels.tiles import TILE
from fringescope.threads import by_rows


@by_rows(lambda _phase, _sigma, _reasons, asked, *_: asked.shape[0])
def gradient_signs(first, last, phase, sigma, reasons, asked, field, reach, significance, out, backward):
    """Sign of the phase's growth along the predicted direction (equation 17): 1 forward, -1 backward, 0 unknown.

    `field` (h, w, 3) holds the unit direction (du, dv). The difference is taken over `reach` pixels on either side, or
    on one where the other is masked; it must exceed `significance` standard deviations to count. Only the pixels of
    tiles that are `asked` (see `tiles.py`) are looked at; `backward` gets the tiles that have a sign of -1.
    """
    phase, sigma, reasons = unowned(phase), unowned(sigma), unowned(reasons)
    asked, out, backward = unowned(asked), unowned(out), unowned(backward)
    H, W = phase.shape
    for t in range(first, last):
        for u in range(asked.shape[1]):
            backward[t, u] = False
            if not asked[t, u]:
                continue
            for i in range(t * TILE, min(t * TILE + TILE, H)):
                # the direction hardly turns within a tile's row
                du, dv = spread(field, i, u * TILE, H, W, 0), spread(field, i, u * TILE, H, W, 1)
                n = math.hypot(du, dv)
                x = round(reach * du / n) if n > 0.0 else 0
                y = round(reach * dv / n) if n > 0.0 else 0
                for j in range(u * TILE, min(u * TILE + TILE, W)):
                    out[i, j] = 0
                    if reasons[i, j] != 0 or (x == 0 and y == 0):
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
                        backward[t, u] |= a < b


@by_rows(lambda _signs, asked, *_: asked.shape[0])
def mark_backward(first, last, signs, asked, radius, share, least, bit, reasons):
    """Give `bit` to pixels without a reason where at least `share` of at least `least` signs in the window are
    backward: a contiguous reversal. Only in tiles that are `asked`; there and around them `signs` must be known.
    """
    H, W = signs.shape
    for t in range(first, last):
        for u in range(asked.shape[1]):
            if not asked[t, u]:
                continue
            for i in range(t * TILE, min(t * TILE + TILE, H)):
                for j in range(u * TILE, min(u * TILE + TILE, W)):
                    if reasons[i, j] != 0:
                        continue
                    back = votes = 0
                    for y in range(max(i - radius, 0), min(i + radius + 1, H)):
                        for x in range(max(j - radius, 0), min(j + radius + 1, W)):
                            votes += signs[y, x] != 0
                            back += signs[y, x] < 0
                    if votes >= least and back >= share * votes:
                        reasons[i, j] = bit


@by_rows(lambda _phase, _sigma, _reasons, asked, *_: asked.shape[0])
def mark_loose(first, last, phase, sigma, reasons, asked, field, factor, floor, noise, least, pending):
    """Give `pending` to pixels that stand on a jump: they continue the surface of fewer than `least` of their eight
    neighbours. Only in the tiles that are `asked`; `confirm` turns the pending bit, which counts for no reason yet,
    into another.

    At the image border the same share of those inside counts. The eight at distance two may stand in for the next
    ones: on a Bayer sensor these are of the pixel's own colour, and often the only ones with enough light.
    """
    phase, sigma = unowned(phase), unowned(sigma)
    reasons, asked = unowned(reasons), unowned(asked)
    H, W = phase.shape
    others = ~pending
    for t in range(first, last):
        for u in range(asked.shape[1]):
            if not asked[t, u]:
                continue
            for i in range(t * TILE, min(t * TILE + TILE, H)):
                for j in range(u * TILE, min(u * TILE + TILE, W)):
                    if reasons[i, j] & others != 0:
                        continue
                    step = largest_step(field, factor, floor, i, j, H, W)
                    loose = True
                    for distance in range(1, 3):
                        links = inside = 0
                        for dy in range(-distance, distance + 1, distance):
                            for dx in range(-distance, distance + 1, distance):
                                y, x = i + dy, j + dx
                                if (dy == 0 and dx == 0) or not (0 <= y < H and 0 <= x < W):
                                    continue
                                inside += 1
                                if reasons[y, x] & others == 0 and linked(phase, sigma, step, noise, i, j, y, x):
                                    links += 1
                        loose = loose and 8 * links < least * inside
                        if not loose:
                            break
                    if loose:
                        reasons[i, j] |= pending


@by_rows(lambda _reasons, asked, *_: asked.shape[0])
def confirm(first, last, reasons, asked, pending, bit):
    """Turn the bit `pending` into `bit`, in the tiles that are `asked`."""
    H, W = reasons.shape
    for t in range(first, last):
        for u in range(asked.shape[1]):
            if not asked[t, u]:
                continue
            for i in range(t * TILE, min(t * TILE + TILE, H)):
                for j in range(u * TILE, min(u * TILE + TILE, W)):
                    if reasons[i, j] & pending:
                        reasons[i, j] = (reasons[i, j] & ~pending) | bit


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


@njit(cache=True, error_model="numpy")
def _off_surface(phase, sigma, node, label, kind, i, j, radius, least, room, M, c):
    """Distance of a pixel's phase from the surface of its neighbours, and their roughness; see `mark_off_surface`.

    `room` (5, window) and M, c are scratch. NaN where there are too few neighbours.
    """
    H, W = phase.shape
    dx, dy, value, inverse, weight = room[0], room[1], room[2], room[3], room[4]
    own = label_of(node, label, kind, i, j)
    here = phase[i, j]
    n = 0
    for y in range(max(i - radius, 0), min(i + radius + 1, H)):
        for x in range(max(j - radius, 0), min(j + radius + 1, W)):
            if (y == i and x == j) or label_of(node, label, kind, y, x) != own:
                continue
            dx[n] = x - j
            dy[n] = y - i
            value[n] = phase[y, x] - here
            s = float(sigma[y, x])
            inverse[n] = 1.0 / (s * s)
            weight[n] = inverse[n]
            n += 1
    if n < least:
        return np.nan, np.nan
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
            return abs(c[0]) / yardstick, spread
    return np.nan, np.nan


@by_rows(lambda phase, *_: phase.shape[0])
def mark_off_surface(first, last, phase, sigma, node, label, kind, asked, radius, least, far, rough, bit, reasons,
                     measures):  # fmt: skip
    """Give `bit` to pixels without a reason whose phase lies more than `far` standard deviations off the surface of
    their neighbours, or whose neighbours are rougher than `rough`, or too few.

    The surface is a quadric (a plane with fewer than 12 neighbours) through the pixels of the same domain (see
    `domains.py`) in the window, without the pixel itself, by least squares with weights 1 / sigma^2 that let go of
    outliers (Cauchy at 2.5 sigma). Roughness is the rms of the neighbours about it, in their sigmas; above 1 it widens
    the yardstick. Pixels that are not `asked` (see `screens.rough_pixels`) are taken as lying on it. `measures` (2, H,
    W), if it is not empty, gets both figures, NaN where there is none.
    """
    phase, sigma = unowned(phase), unowned(sigma)
    node, label, reasons = unowned(node), unowned(label), unowned(reasons)
    W = phase.shape[1]
    room = np.empty((5, (2 * radius + 1) ** 2))
    M = np.empty((7, 6))
    c = np.zeros(6)
    for i in range(first, last):
        row = asked[i]
        for col in range(0, W, 64):
            end = min(col + 64, W)
            some = False
            for j in range(col, end):
                some |= row[j]
            if not some:
                continue
            for j in range(col, end):
                if not row[j] or reasons[i, j] != 0:
                    continue
                distance, roughness = _off_surface(phase, sigma, node, label, kind, i, j, radius, least, room, M, c)
                if measures.size > 0:
                    measures[0, i, j], measures[1, i, j] = distance, roughness
                if not (distance <= far and roughness <= rough):
                    reasons[i, j] = bit
