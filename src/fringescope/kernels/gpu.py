"""The fused decoder for a GPU: a thread a pixel, the same scalar functions as on the processor, compiled for CUDA.

Numba compiles what a kernel calls for the device; in its simulator the kernels call what is compiled for the processor.
Arrays travel in tuples of the kinds that `fused.decode` takes. Only `pipeline` calls it.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import cuda, njit, types
from numba.cuda import libdevice
from numba.extending import overload

from fringescope.kernels.blocks import row_between
from fringescope.kernels.depths import FIELDS, Depths, cubics_of, row_cubics, space_of
from fringescope.kernels.fused import Limits, Sets, clipped_pixel
from fringescope.kernels.pixel import TWO_PI, fitted, is_inside, judged, of_eight, of_four, of_three, point, weighed
from fringescope.kernels.sinusoid import follow, left_over, whole

MAX_SETS = 8  #: of a view: what a thread has room for
MAX_FRAMES = 128
THREADS = 128  #: of a block: pixels of a row
BLOCKS = 128  #: of a launch at least: Numba warns of fewer; the spare ones have nothing to do
CLIPPED = np.uint16(0xFFFF)  #: mark of a pixel with saturated samples, until `clipped` has looked at it

_f = np.float32
_ZERO, _HALF, _ONE, _TWO = (np.float32(c) for c in (0.0, 0.5, 1.0, 2.0))
_INF = np.float32(np.inf)
_NAN = np.float32(np.nan)


class Nodes(NamedTuple):
    """What spans a picture corner on corner: see `fused.decode`. Arrays reach kernels in tuples alone, because the
    simulator would wrap them.
    """

    bounds: np.ndarray  #: (4, h, w) float64
    usual: np.ndarray  #: (h', w') float64


class Rows(NamedTuple):
    """What differs from row to row of a picture (H, W), made by `rows`."""

    cubics: np.ndarray  #: (H, segments * FIELDS * 4) float32, of the depth table: see `depths.row_cubics`
    bounds: np.ndarray  #: (4, H, w) float64: bounds of the orders, turns
    usual: np.ndarray  #: (H, w') float64: usual contrast


class Band(NamedTuple):
    """Rows of a view and their results, as `fused.decode` has them; row 0 is row `row0` of the picture."""

    frames: np.ndarray  #: (F, h, W)
    row0: int
    phase: np.ndarray  #: (h, W) float32, rad
    sigma: np.ndarray
    background: np.ndarray  #: codes
    modulation: np.ndarray
    reasons: np.ndarray  #: (h, W) uint16
    xyz: np.ndarray  #: (h, W, 3) float32, mm
    sigma_mm: np.ndarray


@overload(whole, target="cuda")
def _whole(x):
    """`sinusoid.whole` on the device, which knows no `np.floor`."""
    return (lambda x: libdevice.floorf(x)) if x == types.float32 else (lambda x: libdevice.floor(x))


@njit(cache=True, error_model="numpy")
def row_of(i, height, depths, nodes, out):
    """Row i of a picture of `height` rows into `out`, a `Rows`."""
    row_cubics(depths.table, i, depths.step, out.cubics[i])
    for m in range(nodes.bounds.shape[0]):
        row_between(nodes.bounds[m], i, height, out.bounds[m, i])
    row_between(nodes.usual, i, height, out.usual[i])


@njit(cache=True, error_model="numpy")
def _place(j, width, nodes):
    """Where column j of a picture of `width` pixels lies in a row of nodes that spans it corner on corner."""
    at = j * ((nodes - 1) / max(width - 1, 1))
    k = min(int(at), nodes - 2)
    return k, at - k


@njit(cache=True, error_model="numpy")
def _between(nodes, k, t):
    return _f(nodes[k] + (nodes[k + 1] - nodes[k]) * t)


@njit(cache=True, error_model="numpy")
def _sums(frames, i, j, first, last, cos, sin, pivot):
    """Sums of I, I cos, I sin and squared residuals of frames first..last-1, four by four as on the processor."""
    t = p = q = squares = _ZERO
    f = first
    while f + 4 <= last:
        a, b = _f(frames[f, i, j]) - pivot, _f(frames[f + 1, i, j]) - pivot
        c, d = _f(frames[f + 2, i, j]) - pivot, _f(frames[f + 3, i, j]) - pivot
        t += (a + b) + (c + d)
        p += (a * cos[f] + b * cos[f + 1]) + (c * cos[f + 2] + d * cos[f + 3])
        q += (a * sin[f] + b * sin[f + 1]) + (c * sin[f + 2] + d * sin[f + 3])
        squares += (a * a + b * b) + (c * c + d * d)
        f += 4
    while f < last:
        a = _f(frames[f, i, j]) - pivot
        t += a
        p += a * cos[f]
        q += a * sin[f]
        squares += a * a
        f += 1
    mean, gain = _ONE / _f(last - first), _TWO / _f(last - first)
    return t, p, q, left_over(squares, t, p, q, t * mean, p * gain, q * gain, _ONE)


@njit(cache=True, error_model="numpy")
def _finish(band, i, j, depths, cubics, turn, own, a, b, reasons, limits):
    """The point of a pixel, whether it lies in the measuring space, and all results to their places."""
    step = depths.step
    k = j // step
    t = _f(j - k * step) * (_ONE / _f(step))
    c = cubics[k * FIELDS * 4 : (k + 1) * FIELDS * 4]
    centre = (depths.camera[0], depths.camera[1], depths.camera[2])
    x, y, z, sigma_mm = point(turn, own, t, cubics_of(c), centre, _ONE / depths.depth)
    pose, lens, field, box = space_of(depths)
    free = (reasons | limits.uncertain) == limits.uncertain
    if free and not is_inside(x, y, z, pose, lens, field, box):
        reasons |= limits.outside
    band.phase[i, j] = TWO_PI * turn
    band.sigma[i, j] = TWO_PI * own
    band.background[i, j] = a
    band.modulation[i, j] = b
    band.reasons[i, j] = reasons
    band.xyz[i, j, 0] = x
    band.xyz[i, j, 1] = y
    band.xyz[i, j, 2] = z
    band.sigma_mm[i, j] = sigma_mm


@njit(cache=True, error_model="numpy")
def decode_pixel(band, i, j, sets, limits, rows, depths, wrapped, variance):
    """Pixel (i, j) of a band from samples to its point; one with saturated samples is marked and left.

    `wrapped`, `variance` (MAX_SETS,) are scratch.
    """
    frames, row, K = band.frames, band.row0 + i, len(sets.frequency)
    top = frames[0, i, j]
    for f in range(1, frames.shape[0]):
        top = max(top, frames[f, i, j])
    if top >= sets.top:
        band.reasons[i, j] = CLIPPED
        return
    a = b = coarse_b = own = rough = slack = _ZERO
    systematic2 = limits.systematic * limits.systematic
    for k in range(K):
        first, last = sets.start[k], sets.start[k + 1]
        steps = last - first
        pivot = sets.pivot
        if steps == 4 and sets.plain[k]:
            pivot = _ZERO
            total, p, q, residuals = of_four(
                _f(frames[first, i, j]), _f(frames[first + 1, i, j]), _f(frames[first + 2, i, j]),
                _f(frames[first + 3, i, j]),
            )  # fmt: skip
        elif steps == 8 and sets.plain[k]:
            pivot = _ZERO
            total, p, q, residuals = of_eight(
                _f(frames[first, i, j]), _f(frames[first + 1, i, j]), _f(frames[first + 2, i, j]),
                _f(frames[first + 3, i, j]), _f(frames[first + 4, i, j]), _f(frames[first + 5, i, j]),
                _f(frames[first + 6, i, j]), _f(frames[first + 7, i, j]),
            )  # fmt: skip
        else:
            total, p, q, residuals = _sums(frames, i, j, first, last, sets.cos, sets.sin, pivot)
        mean, gain = _ONE / _f(steps), _TWO / _f(steps)
        share = _ONE / _f(steps - 3) if steps > 3 else _ZERO
        coarse_b = b
        w, a, b, own, off = fitted(
            total, p, q, residuals, mean, gain, share, limits.noise_a, limits.noise_b, limits.misfit, pivot
        )
        rough = off if off > rough else rough
        if steps == 3:
            own = of_three(p, a, b, gain, limits.noise_a, limits.noise_b)
        wrapped[k] = w
        variance[k] = own + systematic2
        slack += _f(sets.frequency[0] / sets.frequency[k]) if k > 0 else _ZERO
    coarse_b = coarse_b if K > 1 else b
    W = frames.shape[2]
    at, t = _place(j, W, rows.bounds.shape[2])
    lo, hi = _between(rows.bounds[0, row], at, t), _between(rows.bounds[1, row], at, t)
    soft_lo, soft_hi = _between(rows.bounds[2, row], at, t), _between(rows.bounds[3, row], at, t)
    best, best_chi2, second, best_margin2 = _NAN, _INF, _INF, _INF
    if lo <= hi:
        per_turn = _f(sets.frequency[0] / sets.frequency[K - 1])
        slack = _HALF * slack + _f(0.01)
        low, high = math.ceil(lo * per_turn - wrapped[0] - slack), math.floor(hi * per_turn - wrapped[0] + slack)
        for order in range(low, high + 1):
            absolute, chi2, margin2 = wrapped[0] + _f(order), _ZERO, _INF
            for k in range(1, K):
                absolute, rest, margin = follow(absolute, variance[k - 1], wrapped[k], variance[k], sets.ratio[k])
                chi2 += rest
                margin2 = margin if margin < margin2 else margin2
            best, best_chi2, second, best_margin2 = weighed(
                absolute, chi2, margin2, lo, hi, soft_lo, soft_hi, limits.unexpected,
                best, best_chi2, second, best_margin2,
            )  # fmt: skip
    at, t = _place(j, W, rows.usual.shape[1])
    usual = _between(rows.usual[row], at, t)
    apart, sigma = second - best_chi2, math.sqrt(own)
    margin2 = apart if apart < best_margin2 else best_margin2
    reasons = judged(a, b, coarse_b, sigma, rough, usual, best, margin2, limits)
    _finish(band, i, j, depths, rows.cubics[row], best, sigma, a, b, reasons, limits)


@njit(cache=True, error_model="numpy")
def decode_clipped(band, i, j, sets, limits, rows, depths, x, bounds, one, used):
    """Pixel (i, j), if it is marked, by the scalar way of `fringes.py`.

    Scratch: `x` (MAX_FRAMES, 1), `bounds` (4, 1), `one` (4, MAX_SETS, 1, 1) float64, `used` (MAX_SETS, 2) uint64.
    """
    if band.reasons[i, j] != CLIPPED:
        return
    K, F, W = len(sets.frequency), band.frames.shape[0], band.frames.shape[2]
    for f in range(F):
        x[f, 0] = band.frames[f, i, j]
    at, t = _place(j, W, rows.bounds.shape[2])
    for m in range(4):
        bounds[m, 0] = _between(rows.bounds[m, band.row0 + i], at, t)
    reasons, turn, own, a, b = clipped_pixel(
        x, 0, sets, limits, bounds, one[0, :K], one[1, :K], one[2, :K], one[3, :K], used
    )
    _finish(band, i, j, depths, rows.cubics[band.row0 + i], _f(turn), _f(own), _f(a), _f(b), reasons, limits)


@cuda.jit(cache=True)
def _rows(height, depths, nodes, out):
    i = cuda.grid(1)
    if i < height:
        row_of(i, height, depths, nodes, out)


@cuda.jit(cache=True)
def _decode(band, sets, limits, rows, depths):
    i, j = cuda.blockIdx.y, cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    wrapped = cuda.local.array(MAX_SETS, np.float32)
    variance = cuda.local.array(MAX_SETS, np.float32)
    if i < band.frames.shape[1] and j < band.frames.shape[2]:
        decode_pixel(band, i, j, sets, limits, rows, depths, wrapped, variance)


@cuda.jit(cache=True)
def _clipped(band, sets, limits, rows, depths):
    i, j = cuda.blockIdx.y, cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
    x = cuda.local.array((MAX_FRAMES, 1), np.uint16)
    bounds = cuda.local.array((4, 1), np.float32)
    one = cuda.local.array((4, MAX_SETS, 1, 1), np.float64)
    used = cuda.local.array((MAX_SETS, 2), np.uint64)
    if i < band.frames.shape[1] and j < band.frames.shape[2]:
        decode_clipped(band, i, j, sets, limits, rows, depths, x, bounds, one, used)


def rows(height: int, depths: Depths, nodes: Nodes, out: Rows) -> None:
    """Launch: fill `out`, a `Rows` on the device, for a picture of `height` rows."""
    _rows[max(-(-height // 32), BLOCKS), 32](height, depths, nodes, out)


def decode(band: Band, sets: Sets, limits: Limits, rows: Rows, depths: Depths, stream: Any) -> None:
    """Launch on a stream: a `Band` on the device from frames to points. Bands of 65535 rows at most."""
    _, height, width = band.frames.shape
    grid = (-(-width // THREADS), max(height, BLOCKS))
    _decode[grid, (THREADS, 1), stream](band, sets, limits, rows, depths)
    _clipped[grid, (THREADS, 1), stream](band, sets, limits, rows, depths)
