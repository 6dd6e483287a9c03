"""Frames to phase (equations 3 to 5): sums frame by frame, wrapped phase, noise, and the search for the order.

Arrays and scalars only. Angles in radians; intensities in codes; coordinates in projector-plane units.
"""

import math

import numpy as np
from numba import njit, prange

TWO_PI = 2.0 * math.pi


@njit(cache=True, parallel=True, error_model="numpy")
def accumulate(frame, cos_n, sin_n, max_value, total, in_phase, quadrature, squares, saturated):
    """Add one frame (H, W) to the sums of its set: sum I, sum I cos, sum I sin, sum I^2, saturated samples."""
    for i in prange(frame.shape[0]):
        for j in range(frame.shape[1]):
            raw = frame[i, j]
            x = float(raw)
            total[i, j] += x
            in_phase[i, j] += x * cos_n
            quadrature[i, j] += x * sin_n
            squares[i, j] += x * x
            if raw >= max_value:
                saturated[i, j] += 1


@njit(cache=True, parallel=True, error_model="numpy")
def wrap(total, in_phase, quadrature, squares, steps, phase, background, modulation, variance):
    """Sums to wrapped phase in (-pi, pi], A, B and the sample variance about the fitted sinusoid (NaN for 3 steps)."""
    for i in prange(total.shape[0]):
        for j in range(total.shape[1]):
            c = 2.0 * in_phase[i, j] / steps
            s = 2.0 * quadrature[i, j] / steps
            a = total[i, j] / steps
            phase[i, j] = math.atan2(s, c)
            background[i, j] = a
            modulation[i, j] = math.sqrt(c * c + s * s)
            if steps > 3:
                rest = squares[i, j] - steps * (a * a + 0.5 * (c * c + s * s))
                variance[i, j] = max(rest, 0.0) / (steps - 3)
            else:
                variance[i, j] = np.nan


@njit(cache=True, parallel=True, error_model="numpy")
def phase_sigma(phase, background, modulation, steps, a, b, out):
    """Standard deviation of the wrapped phase for sample variance a + b I: sqrt(2 (a + b A) / N) / B.

    Exact for N > 3; three steps have a further term, -(b B / 2) cos 3 phi. Infinite where B is 0.
    """
    for i in prange(phase.shape[0]):
        for j in range(phase.shape[1]):
            B = modulation[i, j]
            v = a + b * background[i, j]
            if steps == 3:
                v -= 0.5 * b * B * math.cos(3.0 * phase[i, j])
            out[i, j] = math.sqrt(2.0 * max(v, 0.0) / steps) / B if B > 0.0 else np.inf


@njit(cache=True, parallel=True, error_model="numpy")
def merge_brackets(phase, background, modulation, sigma, saturated, max_saturated, out):
    """Merge HDR brackets (E, H, W) per pixel by inverse variance of the phase; saturated brackets only if all are.

    `out` (5, H, W): phase, background, modulation, sigma of the merged measurement, saturated samples. Background and
    modulation are those of the best bracket, so that they stay within the range of one exposure.
    """
    E = phase.shape[0]
    for i in prange(phase.shape[1]):
        for j in range(phase.shape[2]):
            best, best_sigma, fewest = -1, np.inf, 1 << 30
            for e in range(E):
                fewest = min(fewest, int(saturated[e, i, j]))
            limit = max(fewest, max_saturated)
            s = c = w_sum = 0.0
            for e in range(E):
                sg = sigma[e, i, j]
                if saturated[e, i, j] > limit or not (sg > 0.0 and sg < np.inf):
                    continue
                w = 1.0 / (sg * sg)
                s += w * math.sin(phase[e, i, j])
                c += w * math.cos(phase[e, i, j])
                w_sum += w
                if sg < best_sigma:
                    best, best_sigma = e, sg
            if best < 0:
                best = 0
                out[0, i, j] = phase[0, i, j]
                out[3, i, j] = np.inf
            else:
                out[0, i, j] = math.atan2(s, c)
                out[3, i, j] = 1.0 / math.sqrt(w_sum)
            out[1, i, j] = background[best, i, j]
            out[2, i, j] = modulation[best, i, j]
            out[4, i, j] = saturated[best, i, j]


@njit(cache=True, inline="always", error_model="numpy")
def _chain(phases, sigmas, freq, i, j, order):
    """Follow the sets from coarse to fine from a first order: absolute phase of the finest, chi squared, worst step."""
    absolute = phases[0, i, j] + TWO_PI * order
    chi2 = 0.0
    worst = 0.0
    for k in range(1, phases.shape[0]):
        ratio = freq[k] / freq[k - 1]
        predicted = absolute * ratio
        turns = math.floor((predicted - phases[k, i, j]) / TWO_PI + 0.5)
        rest = predicted - phases[k, i, j] - TWO_PI * turns
        var = (sigmas[k - 1, i, j] * ratio) ** 2 + sigmas[k, i, j] ** 2
        z2 = rest * rest / var
        chi2 += z2
        worst = max(worst, z2)
        absolute = phases[k, i, j] + TWO_PI * turns
    return absolute, chi2, worst


@njit(cache=True, parallel=True, error_model="numpy")
def unwrap(phases, sigmas, freq, low, high, gray, gray_half, gray_soft, out, margin, residual):
    """Absolute phase of the finest of K parallel sets (K, H, W), coarse to fine, by least chi squared (equation 5).

    Every order of the coarsest set is tried whose finest phase lies in [low, high] of its pixel (arrays (h, w) that are
    spread over the image bilinearly, corner on corner). Residuals of the finer sets decide (excess fractions: this
    covers hierarchical sets, beats, and coarse periods that wrap), and so does a Gray code where `gray` (H, W or
    (0, 0)) holds the finest phase at the middle of its code cell: `gray_half` is half the cell, `gray_soft` the
    uncertainty of its edges, both in finest phase. NaN in `gray` = no opinion.

    Writes the phase (NaN if no order fits into the bounds), `margin` = sqrt(chi2 of the second best - best), 99 if
    there is no second, and `residual` = the largest misfit of a step in standard deviations.
    """
    H, W = phases.shape[1], phases.shape[2]
    h, w = low.shape
    K = phases.shape[0]
    up = freq[K - 1] / freq[0]
    use_gray = gray.shape[0] == H
    for i in prange(H):
        y = i * (h - 1) / max(H - 1, 1)
        y0 = min(int(y), max(h - 2, 0))
        fy = y - y0
        y1 = min(y0 + 1, h - 1)
        for j in range(W):
            x = j * (w - 1) / max(W - 1, 1)
            x0 = min(int(x), max(w - 2, 0))
            fx = x - x0
            x1 = min(x0 + 1, w - 1)
            lo = (1 - fy) * ((1 - fx) * low[y0, x0] + fx * low[y0, x1]) + fy * (
                (1 - fx) * low[y1, x0] + fx * low[y1, x1]
            )
            hi = (1 - fy) * ((1 - fx) * high[y0, x0] + fx * high[y0, x1]) + fy * (
                (1 - fx) * high[y1, x0] + fx * high[y1, x1]
            )
            best = np.nan
            best_chi2 = second_chi2 = np.inf
            best_worst = 0.0
            middle = np.nan
            if use_gray:
                middle = gray[i, j]
                if middle == middle:
                    lo = max(lo, middle - 2.0 * gray_half)
                    hi = min(hi, middle + 2.0 * gray_half)
            if lo <= hi and sigmas[K - 1, i, j] < np.inf and sigmas[0, i, j] < np.inf:
                first = math.floor((lo / up - phases[0, i, j]) / TWO_PI)
                last = math.ceil((hi / up - phases[0, i, j]) / TWO_PI)
                for order in range(int(first), int(last) + 1):
                    absolute, chi2, worst = _chain(phases, sigmas, freq, i, j, order)
                    if absolute < lo or absolute > hi:
                        continue
                    if middle == middle:
                        off = max(abs(absolute - middle) - gray_half, 0.0) / gray_soft
                        chi2 += off * off
                    if chi2 < best_chi2:
                        second_chi2 = best_chi2
                        best, best_chi2, best_worst = absolute, chi2, worst
                    elif chi2 < second_chi2:
                        second_chi2 = chi2
            out[i, j] = best
            margin[i, j] = math.sqrt(second_chi2 - best_chi2) if second_chi2 < np.inf else 99.0
            residual[i, j] = math.sqrt(best_worst)


@njit(cache=True, parallel=True, error_model="numpy")
def order_votes(phase, radius, least, majority, max_slope, out, changed):
    """Let the neighbours vote on each pixel's order: `out` = phase + 2 pi (elected order - own).

    A neighbour votes for the order that brings this pixel nearest to it; votes count only if the wrapped difference is
    below `max_slope` times the distance. The own order stays unless another holds `majority` of at least `least` votes.
    `changed` gets the elected change of order (int8), or -128 where no order has the majority.
    """
    H, W = phase.shape
    for i in prange(H):
        for j in range(W):
            p = phase[i, j]
            out[i, j] = p
            changed[i, j] = 0
            if p != p:
                continue
            counts = np.zeros(17, np.int64)
            votes = 0
            for y in range(max(i - radius, 0), min(i + radius + 1, H)):
                for x in range(max(j - radius, 0), min(j + radius + 1, W)):
                    q = phase[y, x]
                    if (y == i and x == j) or q != q:
                        continue
                    turns = math.floor((q - p) / TWO_PI + 0.5)
                    reach = max(abs(y - i), abs(x - j))
                    if abs(q - p - TWO_PI * turns) > max_slope * reach:
                        continue
                    votes += 1
                    if turns >= -8 and turns <= 8:
                        counts[int(turns) + 8] += 1
            if votes < least:
                continue
            top = 8
            for t in range(17):
                if counts[t] > counts[top]:
                    top = t
            if top != 8 and counts[top] >= majority * votes:
                out[i, j] = p + TWO_PI * (top - 8)
                changed[i, j] = top - 8
            elif counts[8] < (1.0 - majority) * votes:
                changed[i, j] = -128


@njit(cache=True, parallel=True, error_model="numpy")
def gray_bit(frame, inverse, threshold, noise_codes, bit, code, contrast):
    """Read one Gray-code frame against its inverse (or a threshold image): code = 2 code + bit; -1 where uncertain.

    `contrast` keeps the smallest distance from the threshold over the frames, in codes.
    """
    use_inverse = inverse.shape[0] == frame.shape[0]
    for i in prange(frame.shape[0]):
        for j in range(frame.shape[1]):
            t = float(inverse[i, j]) if use_inverse else threshold[i, j]
            d = float(frame[i, j]) - t
            if bit == 0:
                contrast[i, j] = abs(d)
            else:
                contrast[i, j] = min(contrast[i, j], abs(d))
            if code[i, j] >= 0:
                previous = code[i, j] & 1
                b = 1 if d > 0.0 else 0
                code[i, j] = 2 * code[i, j] + (b ^ previous if bit > 0 else b)
                if abs(d) < noise_codes:
                    code[i, j] = -1
