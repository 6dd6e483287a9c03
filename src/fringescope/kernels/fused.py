"""Raw frames to points in one pass, block by block: everything between samples and point stays in the first caches.

Composes the loops of `blocks.py` and `depths.py`, in float32; only `pipeline` calls it. Pixels with saturated samples
take the scalar way of `fringes.py`, in float64. What keeps the loops fast: scratch arrays that live as long as the
call, slices instead of offsets in indices, and no branch but `a if c else b`. Contracted multiply-adds are the one
liberty that the compiler has; NaN stays NaN.
"""

import math
from typing import NamedTuple

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.blocks import (
    BLOCK,
    accept,
    all_dark,
    candidates,
    coarsest,
    consider,
    eight,
    fit,
    four,
    judge,
    leave_dark,
    load,
    nothing,
    order_margin,
    ramp,
    row_between,
    rows_between,
    step,
    sums,
)
from fringescope.kernels.depths import mark_outside, points, row_cubics, unowned_depths
from fringescope.kernels.fringes import best_order, clipped_gain, clipped_sinusoid, count_clipped
from fringescope.kernels.pixel import TWO_PI
from fringescope.kernels.raw import samples_at, unowned
from fringescope.kernels.running import FLOATS, POINT_BYTES, finish
from fringescope.kernels.sinusoid import ROUNDING
from fringescope.threads import by_rows

_f = np.float32
_ZERO, _HALF = np.float32(0.0), np.float32(0.5)
_INF = np.float32(np.inf)
_NAN = np.float32(np.nan)


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


NO_OCTET = np.empty(0, np.uint8)


@njit(cache=True, inline="always", error_model="numpy")
def unowned_sets(s):
    """See `raw.unowned`."""
    return Sets(
        unowned(s.start), unowned(s.cos), unowned(s.sin), unowned(s.ratio), unowned(s.frequency), unowned(s.plain),
        s.top, s.pivot,
    )  # fmt: skip


@njit(cache=True, inline="always", error_model="numpy")
def unowned_limits(s):
    """See `raw.unowned`."""
    return Limits(
        s.noise_a, s.noise_b, s.systematic, s.unexpected, s.margin, s.misfit,
        unowned(s.max_clipped), s.background, s.modulation, s.contrast, s.modulation_sigma,
        s.sigma, s.fine_modulation, s.dark, s.saturated, s.low_modulation, s.uncertain, s.outside, s.inconsistent,
    )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
def clipped_pixel(x, j, sets, limits, bounds, phase, sigma, background, modulation, used):
    """A pixel with saturated samples, by the scalar way, in float64: its reasons, phase, sigma, A, B of the finest set.

    `phase` .. `modulation` (K, 1, 1) and `used` (K, 2) are scratch. A coarse set of two samples borrows the background
    of the set with most samples left, if that has more than three (see `phase.sums.rescue`).
    """
    K, torn = len(sets.frequency), False
    for k in range(K):
        first, last = sets.start[k], sets.start[k + 1]
        steps = last - first
        clipped = np.uint64(0)
        t = p = q = squares = 0.0
        for f in range(first, last):
            if x[f, j] >= sets.top:
                clipped |= np.uint64(1) << np.uint64(f - first)
            else:
                value = float(x[f, j])
                t += value
                p += value * math.cos(2.0 * math.pi * (f - first) / steps)
                q += value * math.sin(2.0 * math.pi * (f - first) / steps)
                squares += value * value
        there, a, c, s, left = clipped_sinusoid(clipped, steps, t, p, q)
        used[k, 0], used[k, 1] = clipped, np.uint64(left)
        background[k, 0, 0] = a if a < np.inf else float(sets.top)
        modulation[k, 0, 0] = math.hypot(c, s)
        phase[k, 0, 0] = math.atan2(s, c)
        if there and left > 3.0:
            rest = (squares - a * t - c * p - s * q) / (left - 3.0)
            torn |= rest > limits.misfit * max(limits.noise_a + limits.noise_b * a, ROUNDING)
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
        if not sets.plain[k]:
            phase[k, 0, 0] = -phase[k, 0, 0]
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
    if torn:
        reasons |= limits.inconsistent
    return reasons, best / turn, own / turn, a, b


@by_rows(lambda *args: args[-1].shape[0])
def decode(first, last, begin, end, addresses, row_bytes, like, packed, sets, limits, bounds, usual, depths,
           summed, kind, rest, phase, sigma, background, modulation, reasons, xyz, sigma_mm):  # fmt: skip
    """Raw frames to points: the rows of frame f lie `row_bytes[f]` apart in memory, from `addresses[f]` on, as samples
    of the type of the array `like`; or `packed`, two samples of 12 bits in three octets.

    Writes (H, W) absolute phase of the finest set and its sigma, radians; A and B, codes; reason bits; world points,
    mm, and their sigma along the ray. `bounds` (4, h', w') and `usual` (h'', w'') span the picture corner on corner:
    orders' bounds in turns, the usual contrast of the finest set over that of the next coarser one.

    Sets `begin` .. `end` - 1 are taken: all, or as they come. Before the last of them the outputs hold what the sets so
    far say, for the next call to go on from: absolute phase, its variance, turns; squared margin, B, misfit; and at the
    head of each block whether all sets have to be taken at once: for orders that only they tell apart, and saturated
    samples. Frames of sets that are yet to come are not read.

    So many frames of the finest set are `summed` already, if all others are done: the sums, of `kind`, lie in `xyz` and
    `rest`, see `running.add`. Not all of them; 0: none.
    """
    F, K = len(addresses), len(sets.frequency)
    samples, top, bits = np.empty((F, BLOCK), like.dtype), np.empty(BLOCK, like.dtype), np.empty(BLOCK, np.uint16)
    floats = np.empty((SCRATCH + 3 * K) * BLOCK, np.float32)
    out = phase, sigma, background, modulation, reasons, xyz, sigma_mm
    _decode(first, last, begin, end, addresses, row_bytes, like, packed, sets, limits, bounds, usual, depths, summed,
            kind, rest, out, samples, top, bits, floats)  # fmt: skip


SCRATCH = 29  #: lines of BLOCK floats that `_decode` needs, and three for each set


@njit(cache=True, nogil=True, error_model="numpy")
def _decode(first, last, begin, end, addresses, row_bytes, like, packed, sets, limits, bounds, usual, depths, summed,
            kind, rest, out, samples, top, bits, floats):  # fmt: skip
    """See `decode`. The caller holds the arrays."""
    phase, sigma, background, modulation, reasons, xyz, sigma_mm = out
    F, K = len(addresses), len(sets.frequency)
    height, W = phase.shape
    phase, sigma, background, modulation = unowned(phase), unowned(sigma), unowned(background), unowned(modulation)
    reasons, sigma_mm = unowned(reasons), unowned(sigma_mm)
    xyz = samples_at(xyz.ctypes.data, (height, 3 * W), xyz)
    beyond = rest.shape[1] // max(W, 1)
    addresses, row_bytes, like, octet = unowned(addresses), unowned(row_bytes), unowned(like), unowned(NO_OCTET)
    sets, limits, depths = unowned_sets(sets), unowned_limits(limits), unowned_depths(depths)
    x, top, bits = unowned(samples), unowned(top), unowned(bits)
    line, room = BLOCK * floats.itemsize, floats.ctypes.data
    wrapped, own, mod = (
        samples_at(room, (K, BLOCK), floats), samples_at(room + K * line, (K, BLOCK), floats),
        samples_at(room + 2 * K * line, (K, BLOCK), floats),
    )  # fmt: skip
    room += 3 * K * line
    acc, limit = samples_at(room, 4 * BLOCK, floats), samples_at(room + 4 * line, (4, BLOCK), floats)
    margins, found = (
        samples_at(room + 8 * line, (2, BLOCK), floats), samples_at(room + 10 * line, (2, 4, BLOCK), floats)
    )  # fmt: skip
    summands = samples_at(room + 10 * line, (8, BLOCK), floats)  # where `found` lies, which comes later
    lines = samples_at(room + 18 * line, (11, BLOCK), floats)
    absolute, chi2, best, rough, back, around, fine, other = (
        lines[0], lines[1], lines[2], lines[3], lines[4], lines[5], lines[6], lines[7]
    )  # fmt: skip
    X, Y, Z = lines[8], lines[9], lines[10]
    one = np.empty((4, K, 1, 1), np.float64)
    used = np.empty((K, 2), np.uint64)
    limit_row = np.empty((4, bounds.shape[2]), np.float64)
    usual_row = np.empty(usual.shape[1], np.float64)
    limit_scale, usual_scale = (bounds.shape[2] - 1) / max(W - 1, 1), (usual.shape[1] - 1) / max(W - 1, 1)
    row = np.empty(depths.table.shape[1], np.float32)
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
            out_phase, out_sigma = phase[i, col : col + n], sigma[i, col : col + n]
            out_a, out_b, out_r = background[i, col : col + n], modulation[i, col : col + n], reasons[i, col : col + n]
            point, along = xyz[i, 3 * col : 3 * (col + n)], sigma_mm[i, col : col + n]
            a = begin if begin > 0 and out_r[0] == 0 else 0
            if a == 0 and begin > 0 and end < K:
                continue  # once all sets have come
            ready = summed if a > 0 else 0
            f, g = sets.start[a] + ready, sets.start[end]
            brightest = load(x, f, g, addresses, row_bytes, i, col, n, like, packed, octet, top)
            if a > 0 and brightest >= sets.top and end == K:
                brightest = load(x, 0, F, addresses, row_bytes, i, col, n, like, packed, octet, top)
                a = ready = 0
            for j in range(n):
                rough[j] = _ZERO
            turn = 0  #: which of `margins` and `found` holds
            if a > 0:
                margin2, before, coarse_b = margins[0], own[a - 1], mod[a - 1]
                for j in range(n):
                    absolute[j] = out_phase[j]
                    before[j] = out_sigma[j]
                    margin2[j] = out_a[j]
                    coarse_b[j] = out_b[j]
                    rough[j] = along[j]
                    chi2[j] = _ZERO
            dark = False
            for back_to_front in range(end - a):  # the finest set first: where it is dark all over, that is all
                k = end - 1 - back_to_front
                f, g = sets.start[k], sets.start[k + 1]
                pivot = sets.pivot
                if ready > 0:
                    here = xyz.ctypes.data + (i * W + col) * POINT_BYTES
                    there = rest.ctypes.data + (i * W + col) * beyond
                    pivot = pivot if kind == FLOATS else _ZERO
                    finish(kind, x, f + ready, g, f, sets, pivot, n, here, there, summands, acc)
                elif g - f == 4 and sets.plain[k]:
                    four(x, f, n, acc)
                    pivot = _ZERO
                elif g - f == 8 and sets.plain[k]:
                    eight(x, f, n, acc)
                    pivot = _ZERO
                else:
                    sums(x, f, g, sets.cos, sets.sin, pivot, n, acc)
                fit(acc, g - f, limits.noise_a, limits.noise_b, limits.misfit, pivot, n, wrapped[k], own[k],
                     back if k == K - 1 else other, mod[k], rough)  # fmt: skip
                if k == K - 1 and brightest < sets.top:
                    dark = all_dark(back, n, limits.background)
                if dark:
                    break
            if dark:
                leave_dark(back, mod[K - 1], limits, n, bits)
                b, fine_2 = mod[K - 1], own[K - 1]
                for j in range(n):
                    along[j] = out_phase[j] = _NAN
                for j in range(3 * n):
                    point[j] = _NAN
                for j in range(n):
                    out_sigma[j] = TWO_PI * math.sqrt(fine_2[j])
                    out_a[j] = back[j]
                    out_b[j] = b[j]
                    out_r[j] = bits[j]
                continue
            for m in range(2):
                ramp(limit_row[m], limit_scale, col, n, limit[m])
            low = high = 0
            if a == 0:
                low, high = candidates(wrapped[0], limit[0], limit[1], per_turn, slack, n)
            if end < K:
                out_r[0] = 0 if low == high and brightest < sets.top else 1
                if out_r[0] != 0:
                    continue
            if low == high:  # else the loop over orders, below
                if a == 0:
                    coarsest(wrapped[0], _f(low), n, absolute, chi2, margins[0])
                for k in range(max(a, 1), end):
                    step(own[k - 1], wrapped[k], own[k], systematic2, sets.ratio[k], n, absolute, chi2,
                         margins[turn], margins[1 - turn])  # fmt: skip
                    turn = 1 - turn
            margin2 = margins[turn]
            if end < K:
                variance, b = own[end - 1], mod[end - 1]
                for j in range(n):
                    out_phase[j] = absolute[j]
                    out_sigma[j] = variance[j]
                    out_a[j] = margin2[j]
                    out_b[j] = b[j]
                    along[j] = rough[j]
                continue
            ramp(usual_row, usual_scale, col, n, around)
            if low != high or brightest >= sets.top:
                for m in range(2, 4):
                    ramp(limit_row[m], limit_scale, col, n, limit[m])
            if low == high:
                accept(absolute, limit, n, best)
            else:
                nothing(n, found[0])
                for order in range(low, high + 1):
                    coarsest(wrapped[0], _f(order), n, absolute, chi2, margins[0])
                    for k in range(1, K):
                        step(own[k - 1], wrapped[k], own[k], systematic2, sets.ratio[k], n, absolute, chi2,
                             margins[(k - 1) % 2], margins[k % 2])  # fmt: skip
                    consider(absolute, chi2, margins[(K - 1) % 2], limit, limits.unexpected, n, found[turn],
                             found[1 - turn])  # fmt: skip
                    turn = 1 - turn
                order_margin(found[turn], n, best, margin2)
            b = mod[K - 1]
            judge(own[K - 1], back, b, mod[max(K - 2, 0)], rough, around, best, margin2, limits, n, fine, bits)
            for j in range(n if brightest >= sets.top else 0):
                if top[j] >= sets.top:
                    bits[j], best[j], fine[j], back[j], b[j] = clipped_pixel(
                        x, j, sets, limits, limit, one[0], one[1], one[2], one[3], used
                    )
            lost = ~limits.uncertain
            for j in range(n):
                lost = lost if bits[j] & ~limits.uncertain else np.uint16(0)
            if lost != 0:
                for j in range(n):
                    along[j] = _NAN
                for j in range(3 * n):
                    point[j] = _NAN
            else:
                points(best, fine, row, depths, col, n, X, Y, Z, along)
                mark_outside(X, Y, Z, depths, n, bits, limits.outside, limits.uncertain)
                for j in range(n):
                    point[3 * j] = X[j]
                    point[3 * j + 1] = Y[j]
                    point[3 * j + 2] = Z[j]
            for j in range(n):
                out_phase[j] = TWO_PI * best[j]
                out_sigma[j] = TWO_PI * fine[j]
            for j in range(n):
                out_a[j] = back[j]
                out_b[j] = b[j]
                out_r[j] = bits[j]
