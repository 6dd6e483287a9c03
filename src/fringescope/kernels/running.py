"""Sums of the finest set of a view, frame after frame as they come, kept in memory that its points will take.

A block of n pixels (see `blocks.py`) has lines of n numbers: four or eight steps have as many whole ones, harmonics
of the samples whose factors are 1, 0 and -1; any other number of steps has the four sums of `blocks.sums`, float32.
The first lines, 12 bytes a pixel, lie where the block's points will be written, the others in `rest`.

Whole numbers of up to 24 bits are exact in float32, in which they are added; float sums are added in the order in
which `blocks.sums` adds them: either way what comes of them is what comes of all frames at once, bit for bit.
"""

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.blocks import BLOCK, load, more, rest_of
from fringescope.kernels.pixel import eight_of_harmonics, four_of_harmonics
from fringescope.kernels.raw import samples_at
from fringescope.threads import by_rows

FLOATS, SHORT, LONG = 0, 1, 2  #: what the lines hold: sums in float32, whole numbers of 16 bits, of 32
POINT_BYTES = 12  #: of the points of a pixel, which are not there yet

_f = np.float32
_ZERO = np.float32(0.0)
_P, _Q, _S = BLOCK, 2 * BLOCK, 3 * BLOCK  # as in `blocks`
_CONTRACT = {"contract"}
_SHORTS, _LONGS, _REALS = np.empty(0, np.int16), np.empty(0, np.int32), np.empty(0, np.float32)
_OCTET = np.empty(0, np.uint8)

#: factor of sample n (column) in each line: all; a - c; b - d; every second one backward
FOUR = np.array([[1, 1, 1, 1], [1, 0, -1, 0], [0, 1, 0, -1], [1, -1, 1, -1]], np.int8)
#: all; every second one backward; the second harmonic's two; the parts of the first and the third
EIGHT = np.array(
    [[1, 1, 1, 1, 1, 1, 1, 1], [1, -1, 1, -1, 1, -1, 1, -1], [1, 0, -1, 0, 1, 0, -1, 0], [0, 1, 0, -1, 0, 1, 0, -1],
     [1, 0, 0, 0, -1, 0, 0, 0], [0, 0, 1, 0, 0, 0, -1, 0], [0, 1, 0, -1, 0, -1, 0, 1], [0, 1, 0, 1, 0, -1, 0, -1]],
    np.int8,
)  # fmt: skip


def kind_of(steps: int, plain: bool, top: int) -> tuple[int, int]:
    """What the lines of a set hold, and how many bytes a pixel they take; `top`: the largest code."""
    if not plain or steps not in (4, 8):
        return FLOATS, 16
    return (SHORT, 2 * steps) if steps * top <= np.iinfo(np.int16).max else (LONG, 4 * steps)


@njit(cache=True, inline="always", error_model="numpy")
def _size_of(kind):
    """Bytes of a number of the lines."""
    return 2 if kind == SHORT else 4


@njit(cache=True, inline="always", error_model="numpy")
def _place(line, size, n, here, there):
    """Where a block's line begins, of whose numbers, `size` bytes each, so many fit into its points."""
    fit = POINT_BYTES // size
    return here + line * n * size if line < fit else there + (line - fit) * n * size


@njit(cache=True, nogil=True, error_model="numpy")
def _get(kind, lines, n, here, there, out):
    """The lines of a block, at the addresses of its points and of its share of the rest, as floats (lines, BLOCK)."""
    size = _size_of(kind)
    for k in range(lines):
        target, at = out[k], _place(k, size, n, here, there)
        if kind == SHORT:
            short = samples_at(at, n, _SHORTS)
            for j in range(n):
                target[j] = _f(short[j])
        elif kind == LONG:
            long = samples_at(at, n, _LONGS)
            for j in range(n):
                target[j] = _f(long[j])
        else:
            real = samples_at(at, n, _REALS)
            for j in range(n):
                target[j] = real[j]


@njit(cache=True, nogil=True, error_model="numpy")
def _put(kind, lines, n, here, there, values):
    """The reverse of `_get`."""
    size = _size_of(kind)
    for k in range(lines):
        source, at = values[k], _place(k, size, n, here, there)
        if kind == SHORT:
            short = samples_at(at, n, _SHORTS)
            for j in range(n):
                short[j] = np.int16(source[j])
        elif kind == LONG:
            long = samples_at(at, n, _LONGS)
            for j in range(n):
                long[j] = np.int32(source[j])
        else:
            real = samples_at(at, n, _REALS)
            for j in range(n):
                real[j] = source[j]


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _take(x, first, last, begin, signs, n, values):
    """Add frames first..last-1 of a block, of a set that begins with frame `begin`, to its lines of whole numbers."""
    for f in range(first, last):
        samples = x[f]
        for k in range(len(signs)):
            line, sign = values[k], signs[k, f - begin]
            if sign > 0:
                for j in range(n):
                    line[j] += _f(samples[j])
            elif sign < 0:
                for j in range(n):
                    line[j] -= _f(samples[j])


@njit(cache=True, inline="always", error_model="numpy")
def _lines(kind, steps):
    return 4 if kind == FLOATS else steps


@by_rows(lambda *args: args[-2].shape[0])
def add(first, last, begin, end, fresh, addresses, row_bytes, like, packed, sets, kind, xyz, rest, reasons):
    """Add frames `begin` .. `end` - 1 of a view, of its finest set, to the sums; `fresh`: they are its first ones.

    Frames as for `fused.decode`; `rest` (H, bytes). The head of a block in `reasons` that is not 0 says that all sets
    have to be taken at once; so it will where a sample is saturated.
    """
    W = reasons.shape[1]
    start, steps = sets.start[-2], sets.start[-1] - sets.start[-2]
    samples, top = np.empty((len(addresses), BLOCK), like.dtype), np.empty(BLOCK, like.dtype)
    floats = np.empty((8, BLOCK), np.float32)
    signs = EIGHT if steps == 8 else FOUR
    lines = _lines(kind, steps)
    beyond = rest.shape[1] // max(W, 1)
    for i in range(first, last):
        here, there = xyz.ctypes.data + i * POINT_BYTES * W, rest.ctypes.data + i * rest.shape[1]
        for col in range(0, W, BLOCK):
            if reasons[i, col] != 0:
                continue
            n = min(BLOCK, W - col)
            brightest = load(samples, begin, end, addresses, row_bytes, i, col, n, like, packed, _OCTET, top)
            if brightest >= sets.top:
                reasons[i, col] = 1
                continue
            points, others = here + POINT_BYTES * col, there + beyond * col
            if fresh:
                for k in range(lines):
                    for j in range(n):
                        floats[k, j] = _ZERO
            else:
                _get(kind, lines, n, points, others, floats)
            if kind == FLOATS:
                more(samples, begin, end, sets.cos, sets.sin, sets.pivot, n, floats.ravel())
            else:
                _take(samples, begin, end, start, signs, n, floats)
            _put(kind, lines, n, points, others, floats)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def finish(kind, x, first, last, begin, sets, pivot, n, here, there, values, acc):
    """What `blocks.sums`, or `four` or `eight`, makes of a set that begins with frame `begin`: of its sums, at these
    addresses, and of frames first..last-1, into `acc`. `values` (8 * BLOCK,) is scratch.
    """
    steps = last - begin
    if kind == FLOATS:
        lines = acc.reshape(4, BLOCK)
        _get(kind, 4, n, here, there, lines)
        more(x, first, last, sets.cos, sets.sin, pivot, n, acc)
        rest_of(acc, steps, n)
        return
    _get(kind, steps, n, here, there, values)
    total, in_phase, quadrature, rest = acc[:_P], acc[_P:_Q], acc[_Q:_S], acc[_S:]
    if steps == 4:
        _take(x, first, last, begin, FOUR, n, values)
        v0, v1, v2, v3 = values[0], values[1], values[2], values[3]
        for j in range(n):
            t, p, q, r = four_of_harmonics(v0[j], v1[j], v2[j], v3[j])
            total[j] = t
            in_phase[j] = p
            quadrature[j] = q
            rest[j] = r
        return
    _take(x, first, last, begin, EIGHT, n, values)
    v0, v1, v2, v3, v4, v5, v6, v7 = (
        values[0], values[1], values[2], values[3], values[4], values[5], values[6], values[7]
    )  # fmt: skip
    for j in range(n):
        t, p, q, r = eight_of_harmonics(v0[j], v1[j], v2[j], v3[j], v4[j], v5[j], v6[j], v7[j])
        total[j] = t
        in_phase[j] = p
        quadrature[j] = q
        rest[j] = r
