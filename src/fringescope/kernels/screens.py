"""Quick looks before slow ones: which pixels a mask has to judge at all. Most surfaces are calm almost everywhere.

Each screen passes a pixel only where the slow kernel of `regions.py` would not reject it, if the sigmas of neighbours
are alike but for a factor of two or three; it asks for all others (True). In float32, in loops that compilers turn
into vector instructions; arrays and scalars only.
"""

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.raw import unowned
from fringescope.kernels.tiles import TILE
from fringescope.threads import by_rows

BLOCK = 512  #: pixels of a row that are looked at together
MIXED, CALM, VOID = 0, 1, 2
CUBIC = np.float32(28.0)  #: sigmas of 60 x^3: what a sum over five by five pixels may tell of cubic terms; noise: 7

_f = np.float32
_ZERO = np.float32(0)
_CONTRACT = {"contract"}


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _column_sums(p0, p1, p2, p3, p4, ref, m, a0, a1, a2):
    """Sums over five rows of the phase, of it times y, times y^2; y = -2 .. 2."""
    two, four = _f(2), _f(4)
    for j in range(m):
        a, b, c, d, e = p0[j] - ref, p1[j] - ref, p2[j] - ref, p3[j] - ref, p4[j] - ref
        a0[j] = (a + e) + (b + d) + c
        a1[j] = two * (e - a) + (d - b)
        a2[j] = four * (a + e) + (b + d)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _quadric(a0, a1, a2, centre, ref, n, c0, c1, c2, c3, c4, c5):
    """The quadric through 24 neighbours, equal weights, of the phase less that of the pixel in their middle."""
    two, four = _f(2), _f(4)
    for j in range(n):
        u, v, w, x, y = a0[j], a0[j + 1], a0[j + 2], a0[j + 3], a0[j + 4]
        p = centre[j + 2] - ref
        s0 = (u + y) + (v + x) + w - _f(25) * p
        sx = two * (y - u) + (x - v)
        sxx = four * (u + y) + (v + x) - _f(50) * p
        sy = (a1[j] + a1[j + 4]) + (a1[j + 1] + a1[j + 3]) + a1[j + 2]
        sxy = two * (a1[j + 4] - a1[j]) + (a1[j + 3] - a1[j + 1])
        syy = (a2[j] + a2[j + 4]) + (a2[j + 1] + a2[j + 3]) + a2[j + 2] - _f(50) * p
        both = sxx + syy
        bend = (_f(24) * both - _f(100) * s0) * _f(1 / 1480)
        skew = (sxx - syy) * _f(1 / 70)
        c0[j] = (_f(270) * s0 - _f(50) * both) * _f(1 / 1480)
        c1[j] = sx * _f(1 / 50)
        c2[j] = sy * _f(1 / 50)
        c3[j] = _f(0.5) * (bend + skew)
        c4[j] = sxy * _f(1 / 100)
        c5[j] = _f(0.5) * (bend - skew)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _off_quadric(p, s, centre, y, limit2, n, c0, c1, c2, c3, c4, c5, off):
    """Raise `off` to the squared residual, less limit2 sigma^2, of the five pixels of a row `y` below the middle."""
    one, two, four = _f(1), _f(2), _f(4)
    yy = y * y
    for j in range(n):
        base = c0[j] + y * c2[j] + yy * c5[j] + centre[j + 2]
        slope, bend = c1[j] + y * c4[j], c3[j]
        a = p[j] - base + two * slope - four * bend
        b = p[j + 1] - base + one * slope - bend
        c = p[j + 2] - base
        d = p[j + 3] - base - one * slope - bend
        e = p[j + 4] - base - two * slope - four * bend
        a = a * a - limit2 * (s[j] * s[j])
        b = b * b - limit2 * (s[j + 1] * s[j + 1])
        c = c * c - limit2 * (s[j + 2] * s[j + 2])
        d = d * d - limit2 * (s[j + 3] * s[j + 3])
        e = e * e - limit2 * (s[j + 4] * s[j + 4])
        off[j] = max(max(max(a, b), max(c, d)), max(e, off[j]))


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _steps_between(p, q, r, m, most, mask):
    """Largest step to the next pixel in a row p and to the row below q, and the reasons of the row r, per column."""
    for j in range(m - 1):
        most[j] = max(most[j], max(abs(p[j + 1] - p[j]), abs(q[j] - p[j])))
        mask[j] |= r[j]
    most[m - 1] = max(most[m - 1], abs(q[m - 1] - p[m - 1]))
    mask[m - 1] |= r[m - 1]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _verdict(off, most, mask, reasons, step, n, ask):
    for j in range(n):
        steep = max(max(most[j], most[j + 1]), max(max(most[j + 2], most[j + 3]), most[j + 4]))
        masked = mask[j] | mask[j + 1] | mask[j + 2] | mask[j + 3] | mask[j + 4]
        rough = (off[j] > _ZERO) | (steep > step) | (masked != 0) | (off[j] != off[j])
        ask[j] = rough & (reasons[j] == 0)


@njit(cache=True, nogil=True, error_model="numpy")
def _some(row):
    """A value of a row that is a number, or 0: what sums are taken from, so that float32 keeps their digits."""
    for j in range(len(row)):
        if row[j] == row[j]:
            return row[j]
    return _ZERO


@njit(cache=True, nogil=True, error_model="numpy")
def _rough_row(phase, sigma, reasons, i, begin, end, step, limit2, wide2, room, mask, ask):
    """See `rough_pixels`: pixels begin..end-1 of row i, by all 25 residuals; `room` (11, BLOCK + 8), mask: scratch."""
    H, W = phase.shape
    row = reasons[i]
    if i < 2 or i >= H - 2 or W < 5:
        for j in range(begin, end):
            ask[j] = row[j] == 0
        return
    a0, a1, a2, most, off = room[0], room[1], room[2], room[3], room[4]
    c0, c1, c2, c3, c4, c5 = room[5], room[6], room[7], room[8], room[9], room[10]
    for j in range(begin, min(end, 2)):
        ask[j] = row[j] == 0
    for j in range(max(begin, W - 2), end):
        ask[j] = row[j] == 0
    for col in range(max(begin, 2), min(end, W - 2), BLOCK):
        n = min(BLOCK, min(end, W - 2) - col)
        left, right = col - 2, col + n + 2
        wide = n + 4
        centre = phase[i, left:right]
        ref = _some(centre)
        p0, p1, p3, p4 = (
            phase[i - 2, left:right], phase[i - 1, left:right], phase[i + 1, left:right], phase[i + 2, left:right]
        )  # fmt: skip
        _column_sums(p0, p1, centre, p3, p4, ref, wide, a0, a1, a2)
        _quadric(a0, a1, a2, centre, ref, n, c0, c1, c2, c3, c4, c5)
        for j in range(n):
            off[j] = c0[j] * c0[j] - limit2 * (sigma[i, col + j] * sigma[i, col + j])
        for y in range(-2, 3):
            _off_quadric(
                phase[i + y, left:right], sigma[i + y, left:right], centre, _f(y), wide2, n,
                c0, c1, c2, c3, c4, c5, off,
            )  # fmt: skip
        for j in range(wide):
            most[j] = _ZERO
            mask[j] = 0
        for y in range(-2, 3):
            below = min(y + 1, 2)
            _steps_between(
                phase[i + y, left:right], phase[i + below, left:right], reasons[i + y, left:right], wide, most, mask
            )
        _verdict(off, most, mask, row[col : col + n], step, n, ask[col : col + n])


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _sums_down(p0, p1, p2, p3, p4, ref, m, a0, a2, a3):
    """Sums over five rows of the phase, of it times y^2 and times what tells a cubic: -1, 2, 0, -2, 1."""
    two, four = _f(2), _f(4)
    for j in range(m):
        a, b, c, d, e = p0[j] - ref, p1[j] - ref, p2[j] - ref, p3[j] - ref, p4[j] - ref
        a0[j] = (a + e) + (b + d) + c
        a2[j] = four * (a + e) + (b + d)
        a3[j] = (e - a) - two * (d - b)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _off_own(a0, a2, a3, centre, sigma, ref, limit2, wide2, cubic2, n, off, own):
    """How far each pixel lies off the quadric through its 24 neighbours, squared: `off` above wide2 sigma^2, `own`
    above limit2 sigma^2; `own` as well how far the surface is from a quadric, by its cubic terms.
    """
    two, four = _f(2), _f(4)
    for j in range(n):
        u, v, w, x, y = a0[j], a0[j + 1], a0[j + 2], a0[j + 3], a0[j + 4]
        s0 = (u + y) + (v + x) + w
        both = four * (u + y) + (v + x) + ((a2[j] + a2[j + 4]) + (a2[j + 1] + a2[j + 3]) + a2[j + 2])
        e = (_f(270) * s0 - _f(50) * both - _f(1750) * (centre[j + 2] - ref)) * _f(1 / 1480)
        across = (y - u) - two * (x - v)
        down = (a3[j] + a3[j + 4]) + (a3[j + 1] + a3[j + 3]) + a3[j + 2]
        v2 = sigma[j] * sigma[j]
        e = e * e
        off[j] = e - wide2 * v2
        across, down = across * across, down * down
        cubic = across if across > down else down
        near, bent = e - limit2 * v2, cubic - cubic2 * v2
        own[j] = near if near > bent else bent


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _spread_five(off, n, out):
    """The greatest of five in a row."""
    for j in range(n):
        a, b, c, d, e = off[j], off[j + 1], off[j + 2], off[j + 3], off[j + 4]
        a = a if a > b else b
        c = c if c > d else d
        a = a if a > c else c
        out[j] = a if a > e else e


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _any_above(a, b, c, d, e, own, n, ask):
    for j in range(n):
        p, q = a[j] if a[j] > b[j] else b[j], c[j] if c[j] > d[j] else d[j]
        p = p if p > q else q
        q = e[j] if e[j] > own[j] else own[j]
        ask[j] = (p > _ZERO) | (q > _ZERO)


@njit(cache=True, nogil=True, error_model="numpy")
def _calm_tiles(phase, sigma, t, begin, end, limit2, wide2, cubic2, room, around, own, ask):
    """See `rough_pixels`: the eight rows of tiles that are calm, as those around them; columns begin..end-1."""
    n = end - begin
    a0, a2, a3, off = room[0], room[1], room[2], room[3]
    top = t * TILE
    ref = phase[top, begin]
    for r in range(TILE + 4):
        i = top + r - 2
        left, right = begin - 4, end + 4
        _sums_down(
            phase[i - 2, left:right], phase[i - 1, left:right], phase[i, left:right], phase[i + 1, left:right],
            phase[i + 2, left:right], ref, n + 8, a0, a2, a3,
        )  # fmt: skip
        _off_own(a0, a2, a3, phase[i, left:right], sigma[i, begin - 2 : end + 2], ref, limit2, wide2, cubic2, n + 4,
                 off, own[r])  # fmt: skip
        _spread_five(off, n, around[r])
    for y in range(TILE):
        _any_above(around[y], around[y + 1], around[y + 2], around[y + 3], around[y + 4], own[y + 2, 2:], n,
                   ask[top + y, begin:end])  # fmt: skip


@by_rows(lambda _phase, _sigma, _reasons, kind, *_: kind.shape[0])
def rough_pixels(first, last, phase, sigma, reasons, kind, step, limit, wide_limit, ask):
    """Pixels that `regions.mark_off_surface` (5 x 5) must judge: True in `ask` (H, W).

    The others are masked; or they lie within `limit` sigmas of the quadric through their 24 neighbours, these within
    `wide_limit`, none of the 25 is masked, and no step between neighbours reaches `step` radians: they are one domain.
    `kind` (h, w) of tiles: CALM, without holes and such steps, as the tiles around it are, none at the border of the
    picture; VOID, all masked; or MIXED. In calm tiles each neighbour is held against its own neighbours, which takes
    fewer sums, and the surface against its cubic terms.
    """
    phase, sigma, reasons, kind, ask = unowned(phase), unowned(sigma), unowned(reasons), unowned(kind), unowned(ask)
    H, W = phase.shape
    room, mask = np.empty((11, BLOCK + 8), np.float32), np.empty(BLOCK + 4, np.uint16)
    around, own = np.empty((TILE + 4, BLOCK), np.float32), np.empty((TILE + 4, BLOCK + 4), np.float32)
    limit2, wide2, step = _f(limit) * _f(limit), _f(wide_limit) * _f(wide_limit), _f(step)
    for t in range(first, last):
        u = 0
        while u < kind.shape[1]:
            what, end = kind[t, u], u + 1
            while end < kind.shape[1] and kind[t, end] == what and end - u < BLOCK // TILE:
                end += 1
            a, b = u * TILE, min(end * TILE, W)
            if what == CALM:
                _calm_tiles(phase, sigma, t, a, b, limit2, wide2, CUBIC * CUBIC, room, around, own, ask)
            else:
                for i in range(t * TILE, min(t * TILE + TILE, H)):
                    if what == VOID:
                        ask[i, a:b] = False
                    else:
                        _rough_row(phase, sigma, reasons, i, a, b, step, limit2, wide2, room, mask, ask[i])
            u = end
