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
from fringescope.kernels.pixel import TWO_PI, fitted, judged, weighed
from fringescope.kernels.sinusoid import ROUNDING, follow, phase_variance

BLOCK = 512  #: pixels of a row that are worked on together

_f = np.float32
_ZERO, _HALF, _ONE, _TWO = (np.float32(c) for c in (0.0, 0.5, 1.0, 2.0))
_INF = np.float32(np.inf)
_NAN = np.float32(np.nan)
_P, _Q, _S = BLOCK, 2 * BLOCK, 3 * BLOCK  # where the sums of I cos, I sin and I^2 lie in their scratch
_CONTRACT = {"contract"}


class Sets(NamedTuple):
    """The parallel sets of a view, coarse to fine: where each begins among the frames, and its samples."""

    start: np.ndarray  #: (K + 1,) int64
    cos: np.ndarray  #: (F,) float32, of each frame's shift
    sin: np.ndarray
    ratio: np.ndarray  #: (K,) float32, frequency over that of the set before; of the first: 1
    frequency: np.ndarray  #: (K,) float64
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
    """Sums of I, I cos, I sin and I^2 of frames first..last-1 of a block `x` (F, BLOCK) into `acc` (4 BLOCK,)."""
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


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _fit(acc, steps, noise_a, noise_b, pivot, n, phase, sigma, background, modulation, rough):
    """Sums to wrapped phase and sigma, turns, A and B, and the square of misfit over noise, added up by maximum."""
    mean, gain = _ONE / _f(steps), _TWO / _f(steps)
    share = _ONE / _f(steps - 3) if steps > 3 else _ZERO
    for j in range(n):
        wrapped, a, b, v, misfit = fitted(
            acc[j], acc[_P + j], acc[_Q + j], acc[_S + j], mean, gain, share, noise_a, noise_b, pivot
        )
        phase[j] = wrapped
        background[j] = a
        modulation[j] = b
        sigma[j] = v
        rough[j] = max(rough[j], misfit)
    if steps == 3:
        for j in range(n):
            b = modulation[j]
            c = acc[_P + j] * gain / b
            sigma[j] = math.sqrt(max(phase_variance(sigma[j], noise_b, b, c, gain, 3), _ZERO)) / TWO_PI
    else:
        for j in range(n):
            sigma[j] = math.sqrt(phase_variance(sigma[j], noise_b, modulation[j], _ONE, gain, 4)) / TWO_PI


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _ramp(nodes, width, col, n, out):
    """Values of a row of nodes that spans a picture of `width` pixels corner on corner, at columns col..col+n-1."""
    last = len(nodes) - 1
    scale = last / max(width - 1, 1)
    j = 0
    while j < n:
        k = min(int((col + j) * scale), last - 1)
        end = n if k == last - 1 else min(n, math.ceil((k + 1) / scale) - col)
        end = max(end, j + 1)
        slope = _f((nodes[k + 1] - nodes[k]) * scale)
        begin = _f(nodes[k] + (nodes[k + 1] - nodes[k]) * ((col + j) * scale - k))
        for i in range(end - j):
            out[j + i] = begin + slope * _f(i)
        j = end


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _wide_sigma(sigma, systematic, n, out):
    for j in range(n):
        out[j] = math.sqrt(sigma[j] * sigma[j] + systematic * systematic)


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _step(absolute, carried, phase, sigma, ratio, n, chi2, margin2):
    for j in range(n):
        a, rest, m = follow(absolute[j], carried[j], phase[j], sigma[j], ratio)
        absolute[j] = a
        carried[j] = sigma[j]
        chi2[j] += rest
        margin2[j] = min(margin2[j], m)


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


@njit(cache=True, nogil=True, error_model="numpy")
def _candidates(phase, lo, hi, up, slack, n):
    """First and last order of the coarsest set that any pixel of the block may have; none: last < first."""
    first, last = 1 << 30, -(1 << 30)
    for j in range(n):
        if lo[j] <= hi[j]:
            first = min(first, math.ceil(lo[j] / up - phase[j] - slack))
            last = max(last, math.floor(hi[j] / up - phase[j] + slack))
    return first, last


@njit(cache=True, nogil=True, error_model="numpy", fastmath=_CONTRACT)
def _judge(sigma, background, modulation, coarse_modulation, rough, usual, absolute, best_chi2, second, margin2, limits,
           n, reasons):  # fmt: skip
    """Reason bits of unsaturated pixels: exposure (III-D 1), order, consistency."""
    for j in range(n):
        reasons[j] = judged(
            background[j], modulation[j], coarse_modulation[j], sigma[j], rough[j], usual[j], absolute[j],
            best_chi2[j], second[j], margin2[j], limits,
        )  # fmt: skip


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


@njit(cache=True, nogil=True, error_model="numpy")
def decode(first, last, frames, row0, height, sets, limits, bounds, usual, depths,
           phase, sigma, background, modulation, reasons, xyz, sigma_mm):  # fmt: skip
    """Rows first..last-1 of a band of raw frames (F, h, W), whose row 0 is row `row0` of a picture of `height` rows.

    Writes the rows of the outputs, which are bands as well: absolute phase of the finest set and its sigma, radians;
    A and B, codes; reason bits; world points, mm, and their sigma along the ray. `bounds` (4, h', w') and `usual`
    (h'', w'') span the picture corner on corner: orders' bounds in turns, the usual contrast of the finest set over
    that of the next coarser one.
    """
    F, _, W = frames.shape
    K = len(sets.frequency)
    x = np.empty((F, BLOCK), frames.dtype)
    top = np.empty(BLOCK, frames.dtype)
    acc = np.empty(4 * BLOCK, np.float32)
    wrapped, own = np.empty((K, BLOCK), np.float32), np.empty((K, BLOCK), np.float32)
    wide, mod = np.empty((K, BLOCK), np.float32), np.empty((K, BLOCK), np.float32)
    limit = np.empty((4, BLOCK), np.float32)
    absolute, carried, chi2, margin2, best, best_chi2, second, best_margin2, rough, back, around = (
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
    row = np.empty(depths.table.shape[1], np.float32)
    X, Y, Z = np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32), np.empty(BLOCK, np.float32)
    up = _f(sets.frequency[K - 1] / sets.frequency[0])
    slack = _ZERO
    for k in range(1, K):
        slack += _f(sets.frequency[0] / sets.frequency[k])
    slack = _HALF * slack + _f(0.01)
    for i in range(first, last):
        rows_between(bounds, row0 + i, height, limit_row)
        row_between(usual, row0 + i, height, usual_row)
        row_cubics(depths.table, row0 + i, depths.step, row)
        for col in range(0, W, BLOCK):
            n = min(BLOCK, W - col)
            for f in range(F):
                x[f, :n] = frames[f, i, col : col + n]
            for j in range(n):
                top[j] = x[0, j]
                rough[j] = _ZERO
            for f in range(1, F):
                target = x[f]
                for j in range(n):
                    top[j] = max(top[j], target[j])
            for k in range(K):
                a, b = sets.start[k], sets.start[k + 1]
                _sums(x, a, b, sets.cos, sets.sin, sets.pivot, n, acc)
                _fit(acc, b - a, limits.noise_a, limits.noise_b, sets.pivot, n, wrapped[k], own[k], back, mod[k], rough)
                _wide_sigma(own[k], limits.systematic, n, wide[k])
            for m in range(4):
                _ramp(limit_row[m], W, col, n, limit[m])
            _ramp(usual_row, W, col, n, around)
            for j in range(n):
                best[j] = _NAN
                best_chi2[j] = second[j] = best_margin2[j] = _INF
            low, high = _candidates(wrapped[0], limit[0], limit[1], up, slack, n)
            for order in range(low, high + 1):
                for j in range(n):
                    absolute[j] = wrapped[0, j] + _f(order)
                    carried[j] = wide[0, j]
                    chi2[j] = _ZERO
                    margin2[j] = _INF
                for k in range(1, K):
                    _step(absolute, carried, wrapped[k], wide[k], sets.ratio[k], n, chi2, margin2)
                _consider(absolute, chi2, margin2, limit, limits.unexpected, n, best, best_chi2, second, best_margin2)
            _judge(own[K - 1], back, mod[K - 1], mod[max(K - 2, 0)], rough, around, best, best_chi2, second,
                   best_margin2, limits, n, bits)  # fmt: skip
            for j in range(n):
                if top[j] >= sets.top:
                    bits[j], best[j], own[K - 1, j], back[j], mod[K - 1, j] = clipped_pixel(
                        x, j, sets, limits, limit, one[0], one[1], one[2], one[3], used
                    )
            points(best, own[K - 1], row, depths, col, n, X, Y, Z, sigma_mm[i, col : col + n])
            mark_outside(X, Y, Z, depths, n, bits, limits.outside, limits.uncertain)
            point = xyz[i, col : col + n]
            for j in range(n):
                point[j, 0] = X[j]
                point[j, 1] = Y[j]
                point[j, 2] = Z[j]
            out_phase, out_sigma = phase[i, col : col + n], sigma[i, col : col + n]
            out_a, out_b, out_r = background[i, col : col + n], modulation[i, col : col + n], reasons[i, col : col + n]
            fine, b = own[K - 1], mod[K - 1]
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
