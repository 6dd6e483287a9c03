"""Raw frames to points in one pass, block by block: everything between samples and point stays in the first caches.

Composes the scalar functions of `sinusoid.py` in float32, in loops over blocks of pixels that compilers turn into
vector instructions; only `pipeline` calls it. Pixels with saturated samples take the scalar way of `fringes.py`, in
float64. What keeps the loops fast: scratch arrays that live as long as the call, slices instead of offsets in indices,
and no branch but `a if c else b`. Contracted multiply-adds are the one liberty that the compiler has; NaN stays NaN.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

from fringescope.kernels.depths import mark_outside, points, row_cubics
from fringescope.kernels.fringes import best_order, clipped_gain, clipped_sinusoid, count_clipped
from fringescope.kernels.pixel import TWO_PI, fitted, judged, of_eight, of_four, of_three, weighed
from fringescope.kernels.raw import samples_at
from fringescope.kernels.sinusoid import ROUNDING, follow, left_over
from fringescope.threads import by_rows

BLOCK = 512  #: pixels of a row that are worked on together

_f = np.float32
_ZERO, _HALF, _ONE, _TWO = (np.float32(c) for c in (0.0, 0.5, 1.0, 2.0))
_INF = np.float32(np.inf)
_NAN = np.float32(np.nan)
_P, _Q, _S = BLOCK, 2 * BLOCK, 3 * BLOCK  # where the sums of I cos, I sin and I^2 lie in their scratch
_CONTRACT = {"contract"}
_FAR = np.int32(1 << 30)


class Sets(NamedTuple):
    """The parallel sets of a view, coarse to fine: where each begins among the frames, and its samples."""

    start: np.ndarray  #: (K + 1,) int64
    cos: np.ndarray  #: (F,) float32, of each frame's shift
    sin: np.ndarray
    ratio: np.ndarray  #: (K,) float32, frequency over that of the set before; of the first: 1
    frequency: np.ndarray  #: (K,) float64
    plain: np.ndarray  #: (K,) bool: the sine counts forward
    top: int  #: code of a saturated sample
    pivot: np.float32  #: taken off every sample, so that sums of squares keep their digits


class Limits(NamedTuple):
    """Thresholds, float32, and reason bits, uint16; phases in turns."""

    noise_a: np.float32
    noise_b: np.float32
    systematic: np.float32
    unexpected: np.float32
    margin: np.float32  #: squared
    misfit: np.float32  #: squared
    max_clipped: np.ndarray  #: (K,) int64
    background: np.float32
    modulation: np.float32
    contrast: np.float32
    modulation_sigma: np.float32
    sigma: np.float32
    fine_modulation: np.float32
    dark: np.uint16
    saturated: np.uint16
    low_modulation: np.uint16
    uncertain: np.uint16
    outside: np.uint16
    inconsistent: np.uint16


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _sums(x, first, last, cos, sin, pivot, n, acc):
    """Sums of I, I cos, I sin and squared residuals of frames first..last-1 of a block `x` (F, BLOCK), into `acc`.

    Samples count from `pivot` on.
    """
    for j in range(n):
        acc[j] = _ZERO
        acc[_P + j] = _ZERO
        acc[_Q + j] = _ZERO
        acc[_S + j] = _ZERO
    f = first
    while f + 4 <= last:
        xa, xb, xc, xd = x[f], x[f + 1], x[f + 2], x[f + 3]
        ca, cb, cc, cd = cos[f], cos[f + 1], cos[f + 2], cos[f + 3]
        sa, sb, sc, sd = sin[f], sin[f + 1], sin[f + 2], sin[f + 3]
        for j in range(n):
            a, b, c, d = _f(xa[j]) - pivot, _f(xb[j]) - pivot, _f(xc[j]) - pivot, _f(xd[j]) - pivot
            acc[j] += (a + b) + (c + d)
            acc[_P + j] += (a * ca + b * cb) + (c * cc + d * cd)
            acc[_Q + j] += (a * sa + b * sb) + (c * sc + d * sd)
            acc[_S + j] += (a * a + b * b) + (c * c + d * d)
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
    mean, gain = _ONE / _f(last - first), _TWO / _f(last - first)
    for j in range(n):
        t, p, q = acc[j], acc[_P + j], acc[_Q + j]
        acc[_S + j] = left_over(acc[_S + j], t, p, q, t * mean, p * gain, q * gain, _ONE)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _four(x, first, n, acc):
    """As `_sums` for four steps, by differences: no sum of squares, but that of the residuals, which is one square."""
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
def _eight(x, first, n, acc):
    """As `_four`, for eight steps: the residuals are the second, third and fourth harmonics of the samples."""
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
def _fit(acc, steps, noise_a, noise_b, misfit2, pivot, n, phase, variance, background, modulation, rough):
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
def _ramp(nodes, scale, col, n, out):
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
            target[i] = begin + step * _f(i)
        j = end


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _start(phase, order, n, absolute, chi2, margin2):
    for j in range(n):
        absolute[j] = phase[j] + order
        chi2[j] = _ZERO
        margin2[j] = _INF


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _step(coarse, phase, fine, systematic2, ratio, n, absolute, chi2, margin2):
    """One set finer; `coarse` and `fine` are the variances of both sets' phases, which share a systematic error."""
    for j in range(n):
        a, rest, m = follow(absolute[j], coarse[j] + systematic2, phase[j], fine[j] + systematic2, ratio)
        absolute[j] = a
        chi2[j] += rest
        least = margin2[j]
        margin2[j] = m if m < least else least


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _accept(absolute, bounds, n, best):
    """The one order that comes into question, where it lies in the bounds."""
    lo, hi = bounds[0], bounds[1]
    for j in range(n):
        a = absolute[j]
        best[j] = a if (a >= lo[j]) & (a <= hi[j]) else _NAN


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _consider(absolute, chi2, margin2, bounds, unexpected, n, best, best_chi2, second, best_margin2):
    """Keep the order if it lies in the bounds and fits better; remember how well the next best fits."""
    lo, hi, soft_lo, soft_hi = bounds[0], bounds[1], bounds[2], bounds[3]
    for j in range(n):
        a, cost, next_cost, margin = weighed(
            absolute[j], chi2[j], margin2[j], lo[j], hi[j], soft_lo[j], soft_hi[j], unexpected,
            best[j], best_chi2[j], second[j], best_margin2[j],
        )  # fmt: skip
        best[j] = a
        best_chi2[j] = cost
        second[j] = next_cost
        best_margin2[j] = margin


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _margin(best_chi2, second, best_margin2, n, margin2):
    for j in range(n):
        apart, m = second[j] - best_chi2[j], best_margin2[j]
        margin2[j] = apart if apart < m else m


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _candidates(phase, lo, hi, per_turn, slack, n):
    """First and last order of the coarsest set that any pixel of the block may have; none: last < first."""
    first, last = _FAR, -_FAR
    for j in range(n):
        some = lo[j] <= hi[j]
        a = np.int32(np.ceil(lo[j] * per_turn - phase[j] - slack))
        b = np.int32(np.floor(hi[j] * per_turn - phase[j] + slack))
        a, b = a if some else _FAR, b if some else -_FAR
        first = a if a < first else first
        last = b if b > last else last
    return first, last


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _judge(variance, background, modulation, coarse_modulation, rough, usual, absolute, margin2, limits, n, sigma,
           reasons):  # fmt: skip
    """Reason bits of unsaturated pixels: exposure (III-D 1), order, consistency; and sigma, turns, from its square."""
    for j in range(n):
        s = math.sqrt(variance[j])
        sigma[j] = s
        reasons[j] = judged(
            background[j], modulation[j], coarse_modulation[j], s, rough[j], usual[j], absolute[j], margin2[j], limits
        )


@njit(cache=True, nogil=True, error_model="numpy")
def clipped_pixel(x, j, sets, limits, bounds, phase, sigma, background, modulation, used):
    """A pixel with saturated samples, by the scalar way, in float64: its reasons, phase, sigma, A, B of the finest set.

    `phase` .. `modulation` (K, 1, 1) and `used` (K, 2) are scratch. A coarse set of two samples borrows the background
    of the set with most samples left, if that has more than three (see `phase.sums.rescue`).
    """
    K = len(sets.frequency)
    for k in range(K):
        first, last = sets.start[k], sets.start[k + 1]
        steps = last - first
        clipped = np.uint64(0)
        t = p = q = 0.0
        for f in range(first, last):
            if x[f, j] >= sets.top:
                clipped |= np.uint64(1) << np.uint64(f - first)
            else:
                value = float(x[f, j])
                t += value
                p += value * math.cos(2.0 * math.pi * (f - first) / steps)
                q += value * math.sin(2.0 * math.pi * (f - first) / steps)
        _, a, c, s, left = clipped_sinusoid(clipped, steps, t, p, q)
        used[k, 0], used[k, 1] = clipped, np.uint64(left)
        background[k, 0, 0] = a if a < np.inf else float(sets.top)
        modulation[k, 0, 0] = math.hypot(c, s)
        phase[k, 0, 0] = math.atan2(s, c)
    donor = 0
    for k in range(K):
        donor = k if used[k, 1] > used[donor, 1] else donor
    for k in range(K):
        steps = sets.start[k + 1] - sets.start[k]
        a, b = background[k, 0, 0], modulation[k, 0, 0]
        gain = clipped_gain(used[k, 0], steps, phase[k, 0, 0])
        if K > 1 and used[k, 1] == np.uint64(2) and used[donor, 1] > np.uint64(3):
            a = background[donor, 0, 0]
            m11 = m12 = m22 = p = q = 0.0
            for f in range(sets.start[k], sets.start[k + 1]):
                if x[f, j] < sets.top:
                    angle = 2.0 * math.pi * (f - sets.start[k]) / steps
                    co, si = math.cos(angle), math.sin(angle)
                    m11 += co * co
                    m12 += co * si
                    m22 += si * si
                    p += (x[f, j] - a) * co
                    q += (x[f, j] - a) * si
            det = m11 * m22 - m12 * m12
            if det > 1e-9:
                c, s = (m22 * p - m12 * q) / det, (m11 * q - m12 * p) / det
                phase[k, 0, 0] = math.atan2(s, c)
                background[k, 0, 0] = a
                b = modulation[k, 0, 0] = max(math.hypot(c, s), 1e-6)
                gain = 2.0
        v = max(limits.noise_a + limits.noise_b * a, ROUNDING)
        lost = count_clipped(used[k, 0])
        if lost > limits.max_clipped[k] or not b > 0.0:
            gain = np.inf
        elif lost == 0 and steps == 3:
            v -= 0.5 * limits.noise_b * b * math.cos(3.0 * phase[k, 0, 0])
        sigma[k, 0, 0] = math.sqrt(gain * max(v, ROUNDING)) / b if gain < np.inf else np.inf
    own = sigma[K - 1, 0, 0]
    for k in range(K):
        sigma[k, 0, 0] = math.hypot(sigma[k, 0, 0], 2.0 * math.pi * limits.systematic)
    turn = 2.0 * math.pi
    best, margin = best_order(
        phase, sigma, sets.frequency, 0, 0, turn * bounds[0, j], turn * bounds[1, j], turn * bounds[2, j],
        turn * bounds[3, j], limits.unexpected, np.nan, 1.0, 1.0,
    )  # fmt: skip
    a, b = background[K - 1, 0, 0], modulation[K - 1, 0, 0]
    noise = math.sqrt(max(limits.noise_a + limits.noise_b * a, ROUNDING))
    reasons = 0
    if not own < np.inf:
        reasons = limits.saturated if used[K - 1, 0] != np.uint64(0) else limits.low_modulation
    elif a < limits.background:
        reasons = limits.dark
    elif b < max(limits.modulation, limits.contrast * a, limits.modulation_sigma * noise) or own > turn * limits.sigma:
        reasons = limits.low_modulation
    if own < np.inf:
        if best != best:
            reasons |= limits.outside
        elif not margin * margin >= limits.margin:
            reasons |= limits.uncertain
    return reasons, best / turn, own / turn, a, b


@by_rows(lambda _addresses, _bytes, _like, _sets, _limits, _bounds, _usual, _depths, phase, *_: phase.shape[0])
def decode(first, last, addresses, row_bytes, like, sets, limits, bounds, usual, depths,
           phase, sigma, background, modulation, reasons, xyz, sigma_mm):  # fmt: skip
    """Raw frames to points: the rows of frame f lie `row_bytes[f]` apart in memory, from `addresses[f]` on, as samples
    of the type of the array `like`.

    Writes (H, W) absolute phase of the finest set and its sigma, radians; A and B, codes; reason bits; world points,
    mm, and their sigma along the ray. `bounds` (4, h', w') and `usual` (h'', w'') span the picture corner on corner:
    orders' bounds in turns, the usual contrast of the finest set over that of the next coarser one.
    """
    F, K = len(addresses), len(sets.frequency)
    height, W = phase.shape
    x = np.empty((F, BLOCK), like.dtype)
    top = np.empty(BLOCK, like.dtype)
    acc = np.empty(4 * BLOCK, np.float32)
    wrapped, own = np.empty((K, BLOCK), np.float32), np.empty((K, BLOCK), np.float32)
    mod = np.empty((K, BLOCK), np.float32)
    limit = np.empty((4, BLOCK), np.float32)
    absolute, chi2, margin2, best, best_chi2, second, best_margin2, rough, back, around, fine = (
        np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32),
        np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32),
        np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32),
        np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32),
    )  # fmt: skip
    bits = np.empty(BLOCK, np.uint16)
    one = np.empty((4, K, 1, 1), np.float64)
    used = np.empty((K, 2), np.uint64)
    limit_row = np.empty((4, bounds.shape[2]), np.float64)
    usual_row = np.empty(usual.shape[1], np.float64)
    limit_scale, usual_scale = (bounds.shape[2] - 1) / max(W - 1, 1), (usual.shape[1] - 1) / max(W - 1, 1)
    row = np.empty(depths.table.shape[1], np.float32)
    X, Y, Z = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    systematic2 = limits.systematic * limits.systematic
    per_turn = _f(sets.frequency[0] / sets.frequency[K - 1])
    slack = _ZERO
    for k in range(1, K):
        slack += _f(sets.frequency[0] / sets.frequency[k])
    slack = _HALF * slack + _f(0.01)
    for i in range(first, last):
        rows_between(bounds, i, height, limit_row)
        row_between(usual, i, height, usual_row)
        row_cubics(depths.table, i, depths.step, row)
        for col in range(0, W, BLOCK):
            n = min(BLOCK, W - col)
            for f in range(F):
                source = samples_at(addresses[f] + i * row_bytes[f] + col * like.itemsize, n, like)
                target = x[f]
                for j in range(n):
                    target[j] = source[j]
            for j in range(n):
                top[j] = x[0, j]
                rough[j] = _ZERO
            for f in range(1, F):
                target = x[f]
                for j in range(n):
                    top[j] = max(top[j], target[j])
            brightest = top[0]
            for j in range(n):
                brightest = max(brightest, top[j])
            for k in range(K):
                a, b = sets.start[k], sets.start[k + 1]
                pivot = sets.pivot
                if b - a == 4 and sets.plain[k]:
                    _four(x, a, n, acc)
                    pivot = _ZERO
                elif b - a == 8 and sets.plain[k]:
                    _eight(x, a, n, acc)
                    pivot = _ZERO
                else:
                    _sums(x, a, b, sets.cos, sets.sin, pivot, n, acc)
                _fit(acc, b - a, limits.noise_a, limits.noise_b, limits.misfit, pivot, n, wrapped[k], own[k], back,
                     mod[k], rough)  # fmt: skip
            for m in range(2):
                _ramp(limit_row[m], limit_scale, col, n, limit[m])
            _ramp(usual_row, usual_scale, col, n, around)
            low, high = _candidates(wrapped[0], limit[0], limit[1], per_turn, slack, n)
            if low != high or brightest >= sets.top:
                for m in range(2, 4):
                    _ramp(limit_row[m], limit_scale, col, n, limit[m])
            if low != high:
                for j in range(n):
                    best[j] = _NAN
                    best_chi2[j] = second[j] = best_margin2[j] = _INF
            for order in range(low, high + 1):
                _start(wrapped[0], _f(order), n, absolute, chi2, margin2)
                for k in range(1, K):
                    _step(own[k - 1], wrapped[k], own[k], systematic2, sets.ratio[k], n, absolute, chi2, margin2)
                if low == high:
                    _accept(absolute, limit, n, best)
                else:
                    _consider(absolute, chi2, margin2, limit, limits.unexpected, n, best, best_chi2, second,
                              best_margin2)  # fmt: skip
            if low != high:
                _margin(best_chi2, second, best_margin2, n, margin2)
            b = mod[K - 1]
            _judge(own[K - 1], back, b, mod[max(K - 2, 0)], rough, around, best, margin2, limits, n, fine, bits)
            for j in range(n if brightest >= sets.top else 0):
                if top[j] >= sets.top:
                    bits[j], best[j], fine[j], back[j], b[j] = clipped_pixel(
                        x, j, sets, limits, limit, one[0], one[1], one[2], one[3], used
                    )
            lost = ~limits.uncertain
            for j in range(n):
                lost = lost if bits[j] & ~limits.uncertain else np.uint16(0)
            point, along = xyz[i, col : col + n], sigma_mm[i, col : col + n]
            if lost != 0:
                for j in range(n):
                    along[j] = point[j, 0] = point[j, 1] = point[j, 2] = _NAN
            else:
                points(best, fine, row, depths, col, n, X, Y, Z, along)
                mark_outside(X, Y, Z, depths, n, bits, limits.outside, limits.uncertain)
                for j in range(n):
                    point[j, 0] = X[j]
                    point[j, 1] = Y[j]
                    point[j, 2] = Z[j]
            out_phase, out_sigma = phase[i, col : col + n], sigma[i, col : col + n]
            out_a, out_b, out_r = background[i, col : col + n], modulation[i, col : col + n], reasons[i, col : col + n]
            for j in range(n):
                out_phase[j] = TWO_PI * best[j]
                out_sigma[j] = TWO_PI * fine[j]
            for j in range(n):
                out_a[j] = back[j]
                out_b[j] = b[j]
                out_r[j] = bits[j]


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
