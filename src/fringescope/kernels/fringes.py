"""Frames to phase (equations 3 to 5): sums frame by frame, wrapped phase, noise, and the search for the order.

Arrays and scalars only. Angles in radians; intensities in codes; coordinates in projector-plane units.
"""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.sinusoid import ROUNDING, TWO_PI, follow, left_over, phase_variance, turns
from fringescope.threads import by_rows


@by_rows(lambda frame, *_: frame.shape[0])
def accumulate(first, last, frame, n, cos_n, sin_n, max_value, total, in_phase, quadrature, squares, clipped):
    """Add frame n (H, W) to the sums of its set: sum I, sum I cos, sum I sin, sum I^2.

    Saturated samples say nothing but "at least this much": they stay out of the sums and set bit n of `clipped`.
    """
    bit = np.uint64(1) << np.uint64(n)
    for i in range(first, last):
        for j in range(frame.shape[1]):
            raw = frame[i, j]
            if raw >= max_value:
                clipped[i, j] |= bit
            else:
                x = float(raw)
                total[i, j] += x
                in_phase[i, j] += x * cos_n
                quadrature[i, j] += x * sin_n
                squares[i, j] += x * x


@njit(cache=True, error_model="numpy")
def normal_matrix(clipped, steps):
    """Sums over the samples that are left of 1, cos, sin, cos^2, cos sin, sin^2, as a tuple with 1 first."""
    m00 = m01 = m02 = m11 = m12 = m22 = 0.0
    for n in range(steps):
        if (clipped >> np.uint64(n)) & np.uint64(1):
            continue
        c = math.cos(TWO_PI * n / steps)
        s = math.sin(TWO_PI * n / steps)
        m00 += 1.0
        m01 += c
        m02 += s
        m11 += c * c
        m12 += c * s
        m22 += s * s
    return m00, m01, m02, m11, m12, m22


@njit(cache=True, error_model="numpy")
def clipped_sinusoid(clipped, steps, total, in_phase, quadrature):
    """The sinusoid A + c cos + s sin of the samples that are not clipped: is there one, A, c, s, samples left."""
    m00, m01, m02, m11, m12, m22 = normal_matrix(clipped, steps)
    c00 = m11 * m22 - m12 * m12
    c01 = m02 * m12 - m01 * m22
    c02 = m01 * m12 - m02 * m11
    det = m00 * c00 + m01 * c01 + m02 * c02
    if m00 < 3.0 or det < 1e-9:
        return False, total / m00 if m00 > 0.0 else np.inf, 0.0, 0.0, m00
    c11 = m00 * m22 - m02 * m02
    c12 = m01 * m02 - m00 * m12
    c22 = m00 * m11 - m01 * m01
    a = (c00 * total + c01 * in_phase + c02 * quadrature) / det
    c = (c01 * total + c11 * in_phase + c12 * quadrature) / det
    s = (c02 * total + c12 * in_phase + c22 * quadrature) / det
    return True, a, c, s, m00


@njit(cache=True, error_model="numpy")
def clipped_gain(clipped, steps, phase):
    """What takes the place of 2 / N in the phase's variance where samples are clipped; infinite if too many are."""
    m00, m01, m02, m11, m12, m22 = normal_matrix(clipped, steps)
    det = m00 * (m11 * m22 - m12 * m12) + m01 * (m02 * m12 - m01 * m22) + m02 * (m01 * m12 - m02 * m11)
    if det < 1e-9:
        return np.inf
    jc, js = -math.sin(phase), math.cos(phase)
    c11 = m00 * m22 - m02 * m02
    c12 = m01 * m02 - m00 * m12
    c22 = m00 * m11 - m01 * m01
    return (jc * jc * c11 + 2.0 * jc * js * c12 + js * js * c22) / det


@njit(cache=True, error_model="numpy")
def count_clipped(clipped):
    """Bits that are set."""
    n = 0
    while clipped != np.uint64(0):
        clipped &= clipped - np.uint64(1)
        n += 1
    return n


@by_rows(lambda total, *_: total.shape[0])
def wrap(first, last, total, in_phase, quadrature, squares, clipped, steps, phase, background, modulation, variance):
    """Sums to the least-squares sinusoid of the samples that are left: wrapped phase in (-pi, pi], A and B.

    `variance` is that of the samples about the sinusoid, NaN where none is left over (three samples). Pixels with fewer
    than three samples get phase 0, modulation 0 and the background of what there is.
    """
    for i in range(first, last):
        for j in range(total.shape[1]):
            t, p, q = total[i, j], in_phase[i, j], quadrature[i, j]
            left = float(steps)
            if clipped[i, j] == np.uint64(0):
                a = t / steps
                c = 2.0 * p / steps
                s = 2.0 * q / steps
            else:
                ok, a, c, s, left = clipped_sinusoid(clipped[i, j], steps, t, p, q)
                if not ok:
                    phase[i, j] = 0.0
                    background[i, j] = a
                    modulation[i, j] = 0.0
                    variance[i, j] = np.nan
                    continue
            phase[i, j] = TWO_PI * turns(s, c)
            background[i, j] = a
            modulation[i, j] = math.sqrt(c * c + s * s)
            if left > 3.0:
                variance[i, j] = left_over(squares[i, j], t, p, q, a, c, s, 1.0 / (left - 3.0))
            else:
                variance[i, j] = np.nan


@by_rows(lambda phase, *_: phase.shape[0])
def phase_sigma(first, last, phase, background, modulation, clipped, steps, a, b, max_clipped, out, lost):
    """Standard deviation of the wrapped phase for sample variance a + b I: sqrt(2 (a + b A) / N) / B for N > 3.

    Three steps have a further term (see `phase_variance`); with clipped samples the inverse normal matrix of the rest
    takes the place of 2 / N. Infinite where B is 0 or more than `max_clipped` samples are clipped. `lost` counts them.
    """
    for i in range(first, last):
        for j in range(phase.shape[1]):
            B = modulation[i, j]
            v = max(a + b * background[i, j], ROUNDING)
            gain = 2.0 / steps
            lost[i, j] = 0
            whole = clipped[i, j] == np.uint64(0)
            if not whole:
                lost[i, j] = count_clipped(clipped[i, j])
                gain = clipped_gain(clipped[i, j], steps, phase[i, j]) if lost[i, j] <= max_clipped else np.inf
            three = 3 if whole and steps == 3 else 4
            cos_phase = math.cos(phase[i, j]) if three == 3 else 1.0
            variance = phase_variance(v, b, float(B), cos_phase, gain, three) if B > 0.0 else np.inf
            out[i, j] = math.sqrt(max(variance, 0.0))


@by_rows(lambda phase, *_: phase.shape[1])
def merge_brackets(first, last, phase, background, modulation, sigma, out):
    """Merge HDR brackets (E, H, W) per pixel by inverse variance of the phase; brackets of infinite sigma stay out.

    `out` (5, H, W): phase, background, modulation, sigma of the merged measurement, and the number of the best bracket,
    whose background and modulation stand for all, so that they stay within the range of one exposure.
    """
    for i in range(first, last):
        for j in range(phase.shape[2]):
            best = 0
            s = c = w_sum = 0.0
            for e in range(phase.shape[0]):
                sg = sigma[e, i, j]
                if sg > 0.0 and sg < np.inf:
                    w = 1.0 / (sg * sg)
                    s += w * math.sin(phase[e, i, j])
                    c += w * math.cos(phase[e, i, j])
                    w_sum += w
                if sg < sigma[best, i, j]:
                    best = e
            out[0, i, j] = math.atan2(s, c)
            out[1, i, j] = background[best, i, j]
            out[2, i, j] = modulation[best, i, j]
            out[3, i, j] = 1.0 / math.sqrt(w_sum) if w_sum > 0.0 else np.inf
            out[4, i, j] = best


@njit(cache=True, inline="always", error_model="numpy")
def _chain(phases, sigmas, freq, i, j, first, order):
    """Follow the sets from coarse to fine from an order of set `first`: absolute turns of the finest and chi squared.

    Sets of infinite sigma are passed over. The third value is the margin of the closest rounding on the way, squared:
    how many standard deviations the next order of that set would fit worse.
    """
    absolute = phases[first, i, j] / TWO_PI + order
    variance = (sigmas[first, i, j] / TWO_PI) ** 2
    last = first
    chi2 = 0.0
    margin2 = np.inf
    for k in range(first + 1, phases.shape[0]):
        if not sigmas[k, i, j] < np.inf:
            continue
        fine = (sigmas[k, i, j] / TWO_PI) ** 2
        absolute, rest, margin = follow(absolute, variance, phases[k, i, j] / TWO_PI, fine, freq[k] / freq[last])
        chi2 += rest
        margin2 = min(margin2, margin)
        variance = fine
        last = k
    return absolute, chi2, margin2


@njit(cache=True, error_model="numpy")
def best_order(phases, sigmas, freq, i, j, lo, hi, soft_lo, soft_hi, unexpected, middle, half, soft):
    """The order of pixel (i, j) of K parallel sets that fits best: absolute phase of the finest and its margin.

    See `unwrap`; `middle` is the pixel's Gray code (NaN = no opinion), the bounds are the pixel's own.
    """
    K = phases.shape[0]
    best = np.nan
    best_chi2 = second_chi2 = best_margin2 = np.inf
    if middle == middle:
        lo = max(lo, middle - 2.0 * half)
        hi = min(hi, middle + 2.0 * half)
    coarsest = 0
    while coarsest < K - 1 and not sigmas[coarsest, i, j] < np.inf:
        coarsest += 1
    if lo <= hi and sigmas[K - 1, i, j] < np.inf:
        up = freq[K - 1] / freq[coarsest]
        first = math.floor((lo / up - phases[coarsest, i, j]) / TWO_PI)
        last = math.ceil((hi / up - phases[coarsest, i, j]) / TWO_PI)
        for order in range(int(first), int(last) + 1):
            absolute, chi2, rounding2 = _chain(phases, sigmas, freq, i, j, coarsest, order)
            absolute *= TWO_PI
            if absolute < lo or absolute > hi:
                continue
            if absolute < soft_lo or absolute > soft_hi:
                chi2 += unexpected
            if middle == middle:
                off = max(abs(absolute - middle) - half, 0.0) / soft
                chi2 += off * off
            if chi2 < best_chi2:
                second_chi2 = best_chi2
                best, best_chi2, best_margin2 = absolute, chi2, rounding2
            elif chi2 < second_chi2:
                second_chi2 = chi2
    return best, min(math.sqrt(max(min(second_chi2 - best_chi2, best_margin2), 0.0)), 99.0)


@by_rows(lambda phases, *_: phases.shape[1])
def unwrap(first, last, phases, sigmas, freq, bounds, unexpected, gray, gray_half, gray_soft, out, margin):
    """Absolute phase of the finest of K parallel sets (K, H, W), coarse to fine, by least chi squared (equation 5).

    `bounds` (4, h, w) span the image bilinearly, corner on corner. Every order of the coarsest set is tried whose
    finest phase lies between bounds 0 and 1; outside bounds 2 and 3 it costs `unexpected` of chi squared. Residuals of
    the finer sets decide (excess fractions: this covers hierarchical sets, beats, and coarse periods that wrap), and so
    does a Gray code where `gray` (H, W or (0, 0)) holds the finest phase at the middle of its code cell: `gray_half` is
    half the cell, `gray_soft` the uncertainty of its edges, both in finest phase. NaN in `gray` = no opinion.

    Writes the phase (NaN if no order fits into the bounds) and `margin`: how many standard deviations the next best
    order fits worse, be it another order of the coarsest set or the other way of rounding a finer one; at most 99.
    """
    H, W = phases.shape[1], phases.shape[2]
    h, w = bounds.shape[1], bounds.shape[2]
    use_gray = gray.shape[0] == H
    for i in range(first, last):
        y = i * (h - 1) / max(H - 1, 1)
        y0 = min(int(y), max(h - 2, 0))
        fy = y - y0
        y1 = min(y0 + 1, h - 1)
        for j in range(W):
            x = j * (w - 1) / max(W - 1, 1)
            x0 = min(int(x), max(w - 2, 0))
            fx = x - x0
            x1 = min(x0 + 1, w - 1)
            w00 = (1 - fy) * (1 - fx)
            w01 = (1 - fy) * fx
            w10 = fy * (1 - fx)
            w11 = fy * fx
            lo = w00 * bounds[0, y0, x0] + w01 * bounds[0, y0, x1] + w10 * bounds[0, y1, x0] + w11 * bounds[0, y1, x1]
            hi = w00 * bounds[1, y0, x0] + w01 * bounds[1, y0, x1] + w10 * bounds[1, y1, x0] + w11 * bounds[1, y1, x1]
            elo = w00 * bounds[2, y0, x0] + w01 * bounds[2, y0, x1] + w10 * bounds[2, y1, x0] + w11 * bounds[2, y1, x1]
            ehi = w00 * bounds[3, y0, x0] + w01 * bounds[3, y0, x1] + w10 * bounds[3, y1, x0] + w11 * bounds[3, y1, x1]
            middle = gray[i, j] if use_gray else np.nan
            out[i, j], margin[i, j] = best_order(
                phases, sigmas, freq, i, j, lo, hi, elo, ehi, unexpected, middle, gray_half, gray_soft
            )


@by_rows(lambda frame, *_: frame.shape[0])
def gray_bit(first, last, frame, inverse, threshold, noise_codes, bit, code, contrast):
    """Read one Gray-code frame against its inverse (or a threshold image): code = 2 code + bit; -1 where uncertain.

    `contrast` keeps the smallest distance from the threshold over the frames, in codes.
    """
    use_inverse = inverse.shape[0] == frame.shape[0]
    for i in range(first, last):
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
