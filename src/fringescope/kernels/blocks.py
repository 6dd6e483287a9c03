"""What a block of pixels goes through, in loops that compilers turn into vector instructions; `fused.py` composes them.

Blocks are BLOCK pixels of a row at most, of which `n` count; arrays (BLOCK,) float32 unless said otherwise.
"""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.pixel import fitted, judged, of_eight, of_four, of_three, weak, weighed
from fringescope.kernels.raw import samples_at, unpack
from fringescope.kernels.sinusoid import follow, left_over

BLOCK = 512  #: pixels of a row that are worked on together
COUNT = np.arange(BLOCK, dtype=np.float32)  #: a counter that needs no conversion to float

_f = np.float32
_ZERO, _ONE, _TWO = (np.float32(c) for c in (0.0, 1.0, 2.0))
_INF = np.float32(np.inf)
_NAN = np.float32(np.nan)
_P, _Q, _S = BLOCK, 2 * BLOCK, 3 * BLOCK  # where the sums of I cos, I sin and squared residuals lie in their scratch
_CONTRACT = {"contract"}
_FAR, _NEAR = np.int32(1 << 30), np.int32(-(1 << 30))


@njit(cache=True, nogil=True, error_model="numpy")
def load(x, first, last, addresses, row_bytes, i, col, n, like, packed, octet, top):
    """Samples of frames first..last-1 in row i from column `col` on, into `x` (F, BLOCK) of the type of `like`; the
    largest of each pixel, into `top`; and the largest of all. See `fused.decode`.
    """
    for f in range(first, last):
        target, row_begins = x[f], addresses[f] + i * row_bytes[f]
        if packed:
            unpack(samples_at(row_begins + col // 2 * 3, n // 2 * 3, octet), n, target)
            continue
        source = samples_at(row_begins + col * like.itemsize, n, like)
        for j in range(n):
            target[j] = source[j]
    for j in range(n):
        top[j] = x[first, j]
    for f in range(first + 1, last):
        target = x[f]
        for j in range(n):
            top[j] = max(top[j], target[j])
    brightest = top[0]
    for j in range(n):
        brightest = max(brightest, top[j])
    return brightest


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def sums(x, first, last, cos, sin, pivot, n, acc):
    """Sums of I, I cos, I sin and squared residuals of frames first..last-1 of a block `x` (F, BLOCK), into `acc`.

    Samples count from `pivot` on.
    """
    for j in range(n):
        acc[j] = _ZERO
        acc[_P + j] = _ZERO
        acc[_Q + j] = _ZERO
        acc[_S + j] = _ZERO
    more(x, first, last, cos, sin, pivot, n, acc)
    rest_of(acc, last - first, n)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def more(x, first, last, cos, sin, pivot, n, acc):
    """Add frames first..last-1 to sums of I, I cos, I sin, I I, one after the other: so it does not matter, not even
    to the last bit, how many are added at a time.
    """
    f = first
    while f + 4 <= last:
        xa, xb, xc, xd = x[f], x[f + 1], x[f + 2], x[f + 3]
        ca, cb, cc, cd = cos[f], cos[f + 1], cos[f + 2], cos[f + 3]
        sa, sb, sc, sd = sin[f], sin[f + 1], sin[f + 2], sin[f + 3]
        for j in range(n):
            a, b, c, d = _f(xa[j]) - pivot, _f(xb[j]) - pivot, _f(xc[j]) - pivot, _f(xd[j]) - pivot
            acc[j] = (((acc[j] + a) + b) + c) + d
            acc[_P + j] = (((acc[_P + j] + a * ca) + b * cb) + c * cc) + d * cd
            acc[_Q + j] = (((acc[_Q + j] + a * sa) + b * sb) + c * sc) + d * sd
            acc[_S + j] = (((acc[_S + j] + a * a) + b * b) + c * c) + d * d
        f += 4
    while f < last:
        xa = x[f]
        ca, sa = cos[f], sin[f]
        for j in range(n):
            a = _f(xa[j]) - pivot
            acc[j] += a
            acc[_P + j] += a * ca
            acc[_Q + j] += a * sa
            acc[_S + j] += a * a
        f += 1


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def rest_of(acc, steps, n):
    """Sums of I, I cos, I sin, I I of a whole set: squared residuals in place of the last."""
    mean, gain = _ONE / _f(steps), _TWO / _f(steps)
    for j in range(n):
        t, p, q = acc[j], acc[_P + j], acc[_Q + j]
        acc[_S + j] = left_over(acc[_S + j], t, p, q, t * mean, p * gain, q * gain, _ONE)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def four(x, first, n, acc):
    """As `sums` for four steps, by differences: no sum of squares, but that of the residuals, which is one square."""
    xa, xb, xc, xd = x[first], x[first + 1], x[first + 2], x[first + 3]
    total, in_phase, quadrature, rest = acc[:_P], acc[_P:_Q], acc[_Q:_S], acc[_S:]
    for j in range(n):
        a, b, c, d = _f(xa[j]), _f(xb[j]), _f(xc[j]), _f(xd[j])
        t, p, q, r = of_four(a, b, c, d)
        total[j] = t
        in_phase[j] = p
        quadrature[j] = q
        rest[j] = r


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def eight(x, first, n, acc):
    """As `four`, for eight steps: the residuals are the second, third and fourth harmonics of the samples."""
    x0, x1, x2, x3 = x[first], x[first + 1], x[first + 2], x[first + 3]
    x4, x5, x6, x7 = x[first + 4], x[first + 5], x[first + 6], x[first + 7]
    total, in_phase, quadrature, rest = acc[:_P], acc[_P:_Q], acc[_Q:_S], acc[_S:]
    for j in range(n):
        a, b, c, d = _f(x0[j]), _f(x1[j]), _f(x2[j]), _f(x3[j])
        e, f, g, h = _f(x4[j]), _f(x5[j]), _f(x6[j]), _f(x7[j])
        t, p, q, r = of_eight(a, b, c, d, e, f, g, h)
        total[j] = t
        in_phase[j] = p
        quadrature[j] = q
        rest[j] = r


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def fit(acc, steps, noise_a, noise_b, misfit2, pivot, n, phase, variance, background, modulation, rough):
    """Sums to wrapped phase and its variance, turns, A and B; `rough` grows above 0 where a set misses its sinusoid.

    That is where the variance of the samples about it exceeds `misfit2` times that of the noise.
    """
    mean, gain = _ONE / _f(steps), _TWO / _f(steps)
    share = _ONE / _f(steps - 3) if steps > 3 else _ZERO
    total, in_phase, quadrature, residuals = acc[:_P], acc[_P:_Q], acc[_Q:_S], acc[_S:]
    for j in range(n):
        wrapped, a, b, v, off = fitted(
            total[j], in_phase[j], quadrature[j], residuals[j], mean, gain, share, noise_a, noise_b, misfit2, pivot
        )
        worst = rough[j]
        phase[j] = wrapped
        background[j] = a
        modulation[j] = b
        rough[j] = off if off > worst else worst
        variance[j] = v
    if steps == 3:
        for j in range(n):
            variance[j] = of_three(in_phase[j], background[j], modulation[j], gain, noise_a, noise_b)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def ramp(nodes, scale, col, n, out):
    """Values between nodes that lie 1 / `scale` columns apart, the first at column 0, at columns col..col+n-1."""
    last = len(nodes) - 2
    j = 0
    while j < n:
        k = min(int((col + j) * scale), last)
        end = n if k == last else min(n, int((k + 1) / scale) + 1 - col)
        end = max(end, j + 1)
        slope = (nodes[k + 1] - nodes[k]) * scale
        begin, step = _f(nodes[k] + slope * (col + j - k / scale)), _f(slope)
        target = out[j:end]
        for i in range(end - j):
            target[i] = begin + step * COUNT[i]
        j = end


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def coarsest(phase, order, n, absolute, chi2, margin2):
    """Begin the search: an order of the coarsest set."""
    for j in range(n):
        absolute[j] = phase[j] + order
        chi2[j] = _ZERO
        margin2[j] = _INF


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def step(coarse, phase, fine, systematic2, ratio, n, absolute, chi2, so_far, margin2):
    """One set finer; `coarse` and `fine` are the variances of both sets' phases, which share a systematic error.

    `so_far` is the least margin up to here. It must not lie where `margin2` is written: there the compiler would keep
    the lesser of two by a masked store, which is slow. So it is in `consider`.
    """
    for j in range(n):
        a, rest, m = follow(absolute[j], coarse[j] + systematic2, phase[j], fine[j] + systematic2, ratio)
        absolute[j] = a
        chi2[j] += rest
        least = so_far[j]
        margin2[j] = m if m < least else least


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def accept(absolute, bounds, n, best):
    """The one order that comes into question, where it lies in the bounds."""
    lo, hi = bounds[0], bounds[1]
    for j in range(n):
        a = absolute[j]
        best[j] = a if (a >= lo[j]) & (a <= hi[j]) else _NAN


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def consider(absolute, chi2, margin2, bounds, unexpected, n, before, after):
    """Keep the order if it lies in the bounds and fits better; remember how well the next best fits.

    `before` and `after` (4, BLOCK): absolute phase, chi squared, that of the next best, squared margin.
    """
    lo, hi, soft_lo, soft_hi = bounds[0], bounds[1], bounds[2], bounds[3]
    best, best_chi2, second, best_margin2 = before[0], before[1], before[2], before[3]
    new, new_chi2, new_second, new_margin2 = after[0], after[1], after[2], after[3]
    for j in range(n):
        a, cost, next_cost, margin = weighed(
            absolute[j], chi2[j], margin2[j], lo[j], hi[j], soft_lo[j], soft_hi[j], unexpected,
            best[j], best_chi2[j], second[j], best_margin2[j],
        )  # fmt: skip
        new[j] = a
        new_chi2[j] = cost
        new_second[j] = next_cost
        new_margin2[j] = margin


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def nothing(n, found):
    """No order yet, for `consider`."""
    best, best_chi2, second, best_margin2 = found[0], found[1], found[2], found[3]
    for j in range(n):
        best[j] = _NAN
        best_chi2[j] = second[j] = best_margin2[j] = _INF


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def order_margin(found, n, absolute, margin2):
    """What `consider` has found, and how much worse, squared, the next order fits: as a whole, or at the closest
    rounding on the way.
    """
    best, best_chi2, second, best_margin2 = found[0], found[1], found[2], found[3]
    for j in range(n):
        absolute[j] = best[j]
        apart, m = second[j] - best_chi2[j], best_margin2[j]
        margin2[j] = apart if apart < m else m


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def candidates(phase, lo, hi, per_turn, slack, n):
    """First and last order of the coarsest set that any pixel of the block may have; none: last < first."""
    first, last = _FAR, _NEAR
    for j in range(n):
        some = lo[j] <= hi[j]
        a = np.int32(np.ceil(lo[j] * per_turn - phase[j] - slack))
        b = np.int32(np.floor(hi[j] * per_turn - phase[j] + slack))
        a, b = a if some else _FAR, b if some else _NEAR
        first = a if a < first else first
        last = b if b > last else last
    return first, last


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def judge(variance, background, modulation, coarse_modulation, rough, usual, absolute, margin2, limits, n, sigma,
           reasons):  # fmt: skip
    """Reason bits of unsaturated pixels: exposure (III-D 1), order, consistency; and sigma, turns, from its square."""
    for j in range(n):
        s = math.sqrt(variance[j])
        sigma[j] = s
        reasons[j] = judged(
            background[j], modulation[j], coarse_modulation[j], s, rough[j], usual[j], absolute[j], margin2[j], limits
        )


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def all_dark(background, n, least):
    """Whether every pixel is darker than `least`."""
    lit = np.uint32(0)
    for j in range(n):
        lit |= np.uint32(0) if background[j] < least else np.uint32(1)
    return lit == 0


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def leave_dark(background, modulation, limits, n, reasons):
    """Reason bits of a block of dark pixels: dark, and low modulation where it is."""
    for j in range(n):
        reasons[j] = limits.dark | (limits.low_modulation if weak(background[j], modulation[j], limits) else 0)


@njit(cache=True, nogil=True, error_model="numpy")
def row_between(nodes, i, height, out):
    """Row i of a picture of `height` rows from nodes (h, w) that span it corner on corner."""
    h = nodes.shape[0]
    y = i * (h - 1) / max(height - 1, 1)
    y0 = min(int(y), max(h - 2, 0))
    y1 = min(y0 + 1, h - 1)
    fy = y - y0
    for c in range(nodes.shape[1]):
        out[c] = (1.0 - fy) * nodes[y0, c] + fy * nodes[y1, c]


@njit(cache=True, nogil=True, error_model="numpy")
def rows_between(nodes, i, height, out):
    """`row_between` of a stack of nodes (n, h, w), into `out` (n, w)."""
    for m in range(nodes.shape[0]):
        row_between(nodes[m], i, height, out[m])
