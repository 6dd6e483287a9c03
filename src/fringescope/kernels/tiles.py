"""Tiles of 8 x 8 pixels: how much the phase steps within each and whether it has holes, so that calm ones are known.

Most of a surface is calm: there the masks of `regions.py` need not look at single pixels. Arrays and scalars only.
"""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.links import spread
from fringescope.kernels.raw import unowned
from fringescope.threads import by_rows

TILE = 8  #: pixels along a side
MIXED, WHOLE, VOID = 0, 1, 2  #: some pixels of a tile are masked; none; all

_BLOCK = 128 * TILE
_ZERO, _INF = np.float32(0.0), np.float32(np.inf)
_CONTRACT = {"contract"}


def among(looked):
    """For `by_rows`: rows of tiles, and pixels of those that are looked at."""
    return looked.shape[0], TILE * TILE * int(np.count_nonzero(looked))


# What is kept or replaced has zero added to it: else the compiler makes masked stores of it, slow on some processors.


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _take_in(here, there, n, low, high, total):
    """Take the steps from each of n pixels to another into the least and greatest so far, and their sum."""
    for j in range(n):
        d, a, b = there[j] - here[j], low[j] + _ZERO, high[j] + _ZERO
        low[j] = d if d < a else a
        high[j] = d if d > b else b
        total[j] += d


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _widen(here, n, low, high):
    """Take phases into the least and greatest so far."""
    for j in range(n):
        p, a, b = here[j], low[j] + _ZERO, high[j] + _ZERO
        low[j] = p if p < a else a
        high[j] = p if p > b else b


@njit(cache=True, inline="always", error_model="numpy")
def _less(a, b):
    return a if a < b else b


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _fold(low, high, total, n, out_low, out_high):
    """Least and greatest of each tile's columns; -inf and inf where a step is NaN, which the total shows."""
    for j in range(n, -(-n // TILE) * TILE):
        low[j], high[j], total[j] = _INF, -_INF, _ZERO
    for t in range(len(out_low)):
        p, q, r = low[TILE * t : TILE * t + TILE], high[TILE * t : TILE * t + TILE], total[TILE * t : TILE * t + TILE]
        a = _less(_less(_less(p[0], p[1]), _less(p[2], p[3])), _less(_less(p[4], p[5]), _less(p[6], p[7])))
        b = -_less(
            _less(_less(-q[0], -q[1]), _less(-q[2], -q[3])), _less(_less(-q[4], -q[5]), _less(-q[6], -q[7]))
        )
        all_steps = ((r[0] + r[1]) + (r[2] + r[3])) + ((r[4] + r[5]) + (r[6] + r[7]))
        sound = all_steps == all_steps
        out_low[t], out_high[t] = a if sound else -_INF, b if sound else _INF


@by_rows(lambda _phase, asked, _out: among(asked))
def steps(first, last, phase, asked, out):
    """Least and greatest step of the phase in each tile: to the next pixel in the row, in the column; and phase itself.

    `out` (6, h, w). Steps from a tile's last pixels to the next tile's first ones are among them. Without a step:
    inf, -inf. Where a phase is missing: -inf, inf for the steps. Only the `asked` tiles (h, w) are written.
    """
    phase, out = unowned(phase), unowned(out)
    H, W = phase.shape
    low, high = np.empty((3, _BLOCK), np.float32), np.empty((3, _BLOCK), np.float32)
    total = np.empty((3, _BLOCK), np.float32)
    for t in range(first, last):
        a = 0
        while a < out.shape[2]:
            b = a
            while b < out.shape[2] and b - a < _BLOCK // TILE and asked[t, b]:
                b += 1
            if b == a:
                a += 1
                continue
            col, n = a * TILE, min(b * TILE, W) - a * TILE
            m = min(n, W - 1 - col)  # with a pixel to the right
            low[:] = _INF
            high[:] = -_INF
            total[:] = _ZERO
            for i in range(t * TILE, min(t * TILE + TILE, H)):
                here = phase[i, col : col + n]
                _widen(here, n, low[2], high[2])
                if m > 0:
                    _take_in(here, phase[i, col + 1 : col + 1 + m], m, low[0], high[0], total[0])
                if i + 1 < H:
                    _take_in(here, phase[i + 1, col : col + n], n, low[1], high[1], total[1])
            for axis in range(3):
                _fold(low[axis], high[axis], total[axis], n, out[2 * axis, t, a:b], out[2 * axis + 1, t, a:b])
            a = b


@by_rows(lambda _steps, _whole, _field, _height, _width, _reach, out: out.shape[0])
def growing(first, last, steps, whole, field, height, width, reach, out):
    """Tiles (h, w) from whose pixels the phase cannot fall over `reach` pixels along the unit direction in `field`.

    `field` (h', w', 2) spans the image of `height` x `width` corner on corner; the direction is rounded to pixels,
    hence +-1. `whole` (h, w): no pixel within reach is masked. Either the least phase ahead exceeds the greatest
    behind, or no step on the way goes backward; one tells over long reaches, the other over short ones.
    """
    h, w = out.shape
    near = (reach + TILE) // TILE
    for t in range(first, last):
        for u in range(w):
            out[t, u] = False
            if not whole[t, u]:
                continue
            du = spread(field, t * TILE + TILE // 2, u * TILE + TILE // 2, height, width, 0)
            dv = spread(field, t * TILE + TILE // 2, u * TILE + TILE // 2, height, width, 1)
            size = math.hypot(du, dv)
            if not size > 0.0:
                continue
            x, y = reach * du / size, reach * dv / size
            across, down = round(x / TILE), round(y / TILE)
            if abs(down) < min(t, h - 1 - t) and abs(across) < min(u, w - 1 - u):
                least, most = _INF, -_INF
                for i in range(-1, 2):
                    for j in range(-1, 2):
                        least = min(least, steps[4, t + down + i, u + across + j])
                        most = max(most, steps[5, t - down + i, u - across + j])
                if least >= most:
                    out[t, u] = True
                    continue
            low_x, high_x, low_y, high_y = _INF, -_INF, _INF, -_INF
            for i in range(max(t - near, 0), min(t + near + 1, h)):
                for j in range(max(u - near, 0), min(u + near + 1, w)):
                    low_x, high_x = min(low_x, steps[0, i, j]), max(high_x, steps[1, i, j])
                    low_y, high_y = min(low_y, steps[2, i, j]), max(high_y, steps[3, i, j])
            along = min(min((x - 1) * low_x, (x - 1) * high_x), min((x + 1) * low_x, (x + 1) * high_x))
            beside = min(min((y - 1) * low_y, (y - 1) * high_y), min((y + 1) * low_y, (y + 1) * high_y))
            out[t, u] = along + beside >= 0.0


@by_rows(lambda _reasons, _bits, out: out.shape[0])
def cover(first, last, reasons, bits, out):
    """Whether each tile (h, w) is MIXED, WHOLE (no pixel has one of the reasons `bits`) or VOID (all have)."""
    reasons, out = unowned(reasons), unowned(out)
    H, W = reasons.shape
    some, none = np.empty(W, np.uint16), np.empty(W, np.uint16)
    for t in range(first, last):
        some[:] = 0
        none[:] = 0
        for i in range(t * TILE, min(t * TILE + TILE, H)):
            row = reasons[i]
            for j in range(W):
                r = row[j] & bits
                some[j] |= r
                none[j] |= np.uint16(1) if r == 0 else np.uint16(0)
        for u in range(out.shape[1]):
            masked = free = np.uint16(0)
            for j in range(u * TILE, min(u * TILE + TILE, W)):
                masked |= some[j]
                free |= none[j]
            out[t, u] = WHOLE if masked == 0 else (MIXED if free != 0 else VOID)


@njit(cache=True, nogil=True, error_model="numpy")
def tally(first, last, codes, out):
    """Add how often each of the reason codes (H, W) comes in rows first..last-1 to `out` (65536,)."""
    W = codes.shape[1]
    for i in range(first, last):
        row = codes[i]
        for col in range(0, W, 64):
            end = min(col + 64, W)
            head, other = row[col], np.uint16(0)
            for j in range(col, end):
                other |= row[j] ^ head
            if other == 0:
                out[head] += end - col
                continue
            for j in range(col, end):
                out[row[j]] += 1
