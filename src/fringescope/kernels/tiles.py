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
def _take_in(here, there, n, low, high):
    """Take the steps from each of n pixels to another into the least and greatest so far; NaN is a step of any size."""
    for j in range(n):
        d, a, b = there[j] - here[j], low[j], high[j]
        low[j] = -_INF if d != d else (d if d < a else a)
        high[j] = _INF if d != d else (d if d > b else b)


@njit(cache=True, nogil=True, error_model="numpy")
def _fold(low, high, n, out_low, out_high):
    """Least and greatest of each tile's columns."""
    for t in range(len(out_low)):
        a, b = low[TILE * t], high[TILE * t]
        for j in range(TILE * t + 1, min(TILE * t + TILE, n)):
            a = low[j] if low[j] < a else a
            b = high[j] if high[j] > b else b
        out_low[t], out_high[t] = a, b


@by_rows(lambda _phase, out: out.shape[1])
def steps(first, last, phase, out):
    """Least and greatest step of the phase in each tile (4, h, w): to the next pixel in the row, in the column.

    Steps from a tile's last pixels to the next tile's first ones are among them. Without a step: inf, -inf.
    Where a phase is missing: -inf, inf.
    """
    H, W = phase.shape
    low, high = np.empty((2, _BLOCK), np.float32), np.empty((2, _BLOCK), np.float32)
    for t in range(first, last):
        for col in range(0, W, _BLOCK):
            n = min(_BLOCK, W - col)
            low[:] = _INF
            high[:] = -_INF
            for i in range(t * TILE, min(t * TILE + TILE, H)):
                m = min(n, W - 1 - col)
                here = phase[i, col : col + n]
                if m > 0:
                    _take_in(here, phase[i, col + 1 : col + 1 + m], m, low[0], high[0])
                if i + 1 < H:
                    _take_in(here, phase[i + 1, col : col + n], n, low[1], high[1])
            a, b = col // TILE, -(-(col + n) // TILE)
            for axis in range(2):
                _fold(low[axis], high[axis], n, out[2 * axis, t, a:b], out[2 * axis + 1, t, a:b])


@by_rows(lambda _reasons, out: out.shape[0])
def cover(first, last, reasons, out):
    """Whether each tile (h, w) is MIXED, WHOLE (no pixel has a reason) or VOID (all have)."""
    H, W = reasons.shape
    some, none = np.empty(W, np.uint16), np.empty(W, np.uint16)
    for t in range(first, last):
        some[:] = 0
        none[:] = 0
        for i in range(t * TILE, min(t * TILE + TILE, H)):
            row = reasons[i]
            for j in range(W):
                some[j] |= row[j]
                none[j] |= np.uint16(1) if row[j] == 0 else np.uint16(0)
        for u in range(out.shape[1]):
            masked = free = np.uint16(0)
            for j in range(u * TILE, min(u * TILE + TILE, W)):
                masked |= some[j]
                free |= none[j]
            out[t, u] = WHOLE if masked == 0 else (MIXED if free != 0 else VOID)
