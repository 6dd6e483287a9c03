"""Tiles of 8 x 8 pixels: how much the phase steps within each and whether it has holes, so that calm ones are known.

Most of a surface is calm: there the masks of `regions.py` need not look at single pixels. Arrays and scalars only.
"""

import numpy as np
from numba import njit

from fringescope.threads import by_rows

TILE = 8  #: pixels along a side
MIXED, WHOLE, VOID = 0, 1, 2  #: some pixels of a tile are masked; none; all

_BLOCK = 64 * TILE
_INF = np.float32(np.inf)
_CONTRACT = {"contract"}


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _take_in(here, there, n, low, high, total):
    """Take the steps from each of n pixels to another into the least and greatest so far, and their sum."""
    for j in range(n):
        d, a, b = there[j] - here[j], low[j], high[j]
        low[j] = d if d < a else a
        high[j] = d if d > b else b
        total[j] += d


@njit(cache=True, nogil=True, error_model="numpy")
def _fold(low, high, total, n, out_low, out_high):
    """Least and greatest of each tile's columns; -inf and inf where a step is NaN, which the total shows."""
    for t in range(len(out_low)):
        a, b, sound = low[TILE * t], high[TILE * t], total[TILE * t] == total[TILE * t]
        for j in range(TILE * t + 1, min(TILE * t + TILE, n)):
            a = low[j] if low[j] < a else a
            b = high[j] if high[j] > b else b
            sound &= total[j] == total[j]
        out_low[t], out_high[t] = a if sound else -_INF, b if sound else _INF


@by_rows(lambda _phase, out: out.shape[1])
def steps(first, last, phase, out):
    """Least and greatest step of the phase in each tile (4, h, w): to the next pixel in the row, in the column.

    Steps from a tile's last pixels to the next tile's first ones are among them. Without a step: inf, -inf.
    Where a phase is missing: -inf, inf.
    """
    H, W = phase.shape
    low, high = np.empty((2, _BLOCK), np.float32), np.empty((2, _BLOCK), np.float32)
    total = np.empty((2, _BLOCK), np.float32)
    for t in range(first, last):
        for col in range(0, W, _BLOCK):
            n = min(_BLOCK, W - col)
            low[:] = _INF
            high[:] = -_INF
            total[:] = np.float32(0)
            for i in range(t * TILE, min(t * TILE + TILE, H)):
                m = min(n, W - 1 - col)
                here = phase[i, col : col + n]
                if m > 0:
                    _take_in(here, phase[i, col + 1 : col + 1 + m], m, low[0], high[0], total[0])
                if i + 1 < H:
                    _take_in(here, phase[i + 1, col : col + n], n, low[1], high[1], total[1])
            a, b = col // TILE, -(-(col + n) // TILE)
            for axis in range(2):
                _fold(low[axis], high[axis], total[axis], n, out[2 * axis, t, a:b], out[2 * axis + 1, t, a:b])


@by_rows(lambda _reasons, _bits, out: out.shape[0])
def cover(first, last, reasons, bits, out):
    """Whether each tile (h, w) is MIXED, WHOLE (no pixel has one of the reasons `bits`) or VOID (all have)."""
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
