"""What the fused decoder does with one pixel, written once: `fused.py` calls it in loops over blocks, `gpu.py` in a
thread each. In the precision of what comes in, float32: no literal forces another. Phases in turns, intensities in
codes.
"""

import math

import numpy as np

from fringescope.jit import njit
from fringescope.kernels.lens import to_plane
from fringescope.kernels.sinusoid import ROUNDING, phase_variance, turns

TWO_PI = np.float32(2 * math.pi)

_f = np.float32
_ZERO, _ONE, _TWO, _THREE = (np.float32(c) for c in (0.0, 1.0, 2.0, 3.0))
_INF = np.float32(np.inf)
_HALF_ROOT = np.float32(math.sqrt(0.5))
_PER_TURN2 = np.float32(1.0 / (4.0 * math.pi**2))


@njit(cache=True, inline="always", error_model="numpy")
def four_of_harmonics(total, in_phase, quadrature, off):
    """Sums of I, I cos, I sin and squared residuals of four samples a, b, c, d, from their sum, a - c, b - d, and
    a - b + c - d.
    """
    return total, in_phase, quadrature, _f(0.25) * off * off


@njit(cache=True, inline="always", error_model="numpy")
def of_four(a, b, c, d):
    """Sums of I, I cos, I sin and squared residuals of four samples, by differences."""
    even, odd = a + c, b + d
    return four_of_harmonics(even + odd, a - c, b - d, even - odd)


@njit(cache=True, inline="always", error_model="numpy")
def eight_of_harmonics(total, c4, c2, q2, d0, d2, less, both):
    """As `four_of_harmonics`, of eight samples: the residuals are their second, third and fourth harmonics.

    With the differences d0 .. d3 of opposite samples: `less` is d1 - d3, `both` d1 + d3.
    """
    u, v = _HALF_ROOT * less, _HALF_ROOT * both
    c3, q3 = d0 - u, v - d2
    rest = _f(0.25) * ((c2 * c2 + q2 * q2) + (c3 * c3 + q3 * q3)) + _f(0.125) * c4 * c4
    return total, d0 + u, d2 + v, rest


@njit(cache=True, inline="always", error_model="numpy")
def of_eight(a, b, c, d, e, f, g, h):
    """As `of_four`, of eight samples."""
    s0, s1, s2, s3 = a + e, b + f, c + g, d + h
    d0, d1, d2, d3 = a - e, b - f, c - g, d - h
    even, odd = s0 + s2, s1 + s3
    return eight_of_harmonics(even + odd, even - odd, s0 - s2, s1 - s3, d0, d2, d1 - d3, d1 + d3)


@njit(cache=True, inline="always", error_model="numpy")
def fitted(t, p, q, residuals, mean, gain, share, noise_a, noise_b, misfit2, pivot):
    """Sums of I, I cos, I sin and squared residuals of a set to wrapped phase, A, B, the phase's variance in turns, and
    by how much the variance of the samples about the sinusoid exceeds `misfit2` times that of the noise.

    `mean`, `gain`, `share`: 1 / N, 2 / N, 1 / (N - 3); `pivot` has been taken off every sample. Three steps have a
    variance of their own: see `of_three`.
    """
    a, c, s = t * mean, p * gain, q * gain
    b = math.sqrt(c * c + s * s)
    a += pivot
    v = noise_a + noise_b * a
    v = v if v > _f(ROUNDING) else _f(ROUNDING)
    own = phase_variance(v, _ZERO, b, _ONE, gain, 4) * _PER_TURN2
    return turns(s, c), a, b, own, residuals * share - misfit2 * v


@njit(cache=True, inline="always", error_model="numpy")
def of_three(p, a, b, gain, noise_a, noise_b):
    """Variance of the phase of three steps, turns; `p` is the sum of I cos. NaN where b is 0."""
    v = noise_a + noise_b * a
    v = v if v > _f(ROUNDING) else _f(ROUNDING)
    v = phase_variance(v, noise_b, b, p * gain / b, gain, 3)
    return (_ZERO if v < _ZERO else v) * _PER_TURN2


@njit(cache=True, inline="always", error_model="numpy")
def weighed(a, chi2, margin2, lo, hi, soft_lo, soft_hi, unexpected, best, best_chi2, second, best_margin2):
    """The better of two orders: absolute phase, chi squared, that of the next best, and squared margin of the rounding.

    An order outside lo .. hi does not count; outside soft_lo .. soft_hi it costs `unexpected`.
    """
    cost = chi2 + (unexpected if (a < soft_lo) | (a > soft_hi) else _ZERO)
    cost = cost if (a >= lo) & (a <= hi) else _INF
    better = cost < best_chi2
    other = second if second < cost else cost
    second = best_chi2 if better else other
    return a if better else best, cost if better else best_chi2, second, margin2 if better else best_margin2


@njit(cache=True, inline="always", error_model="numpy")
def weak(a, b, limits):
    """Whether modulation b is too low for background a and its noise."""
    w = limits.noise_a + limits.noise_b * a
    noise2 = w if w > _f(ROUNDING) else _f(ROUNDING)
    low = (b < limits.modulation) | (b < limits.contrast * a)
    return low | (b * b < limits.modulation_sigma * limits.modulation_sigma * noise2)


@njit(cache=True, inline="always", error_model="numpy")
def judged(a, b, coarse_b, sigma, rough, usual, absolute, margin2, limits):
    """Reason bits of an unsaturated pixel (`fused.Limits`): exposure (III-D 1), order, consistency."""
    dark = a < limits.background
    low = weak(a, b, limits)
    torn = rough > _ZERO
    fine = b * (_ONE + _TWO * TWO_PI * sigma) < limits.fine_modulation * usual * coarse_b
    low = low | (((sigma > limits.sigma) | fine) & (not dark) & (not torn))
    none = absolute != absolute
    certain = margin2 >= limits.margin
    r = limits.dark if dark else 0
    r |= limits.low_modulation if low else 0
    r |= limits.inconsistent if torn else 0
    r |= (limits.outside if sigma < _INF else 0) if none else (0 if certain else limits.uncertain)
    return r


@njit(cache=True, inline="always", error_model="numpy")
def cubic(t, a):
    """The cubic of four coefficients at t."""
    return a[0] + t * (a[1] + t * (a[2] + t * a[3]))


@njit(cache=True, inline="always", error_model="numpy")
def point(turn, own, t, cubics, centre, per_depth):
    """Absolute turns and their sigma to a world point and its sigma along the ray (equations 8 to 15).

    `cubics`: nine of the depth table in the place t between nodes, as `depths.points` has them; `centre` of the camera.
    """
    d = turn - cubic(t, cubics[0])
    bend = cubic(t, cubics[1])
    s0, s1, s2, s3 = cubic(t, cubics[2]), cubic(t, cubics[3]), cubic(t, cubics[4]), cubic(t, cubics[5])
    px, py, pz = cubic(t, cubics[6]), cubic(t, cubics[7]), cubic(t, cubics[8])
    inverse = _ONE / (_ONE - bend * d)
    s = s0 + d * (s1 + d * (s2 + d * s3))
    grown = d * s * inverse
    slope = (s + d * (s1 + d * (_TWO * s2 + d * _THREE * s3)) + bend * grown) * inverse
    dx, dy, dz = (px - centre[0]) * per_depth, (py - centre[1]) * per_depth, (pz - centre[2]) * per_depth
    sigma = own * abs(slope) * math.sqrt(dx * dx + dy * dy + dz * dz)
    return px + grown * dx, py + grown * dy, pz + grown * dz, sigma


@njit(cache=True, inline="always", error_model="numpy")
def is_inside(x, y, z, pose, lens, field, box):
    """Whether a world point lies in the light of the projector and in the measuring space.

    `pose`, `lens`, `field`, `box`: tuples of what `depths.Depths` holds of the projector and of the space.
    """
    depth = pose[6] * x + pose[7] * y + pose[8] * z + pose[11]
    inverse = _ONE / depth
    u, v = to_plane(
        (pose[0] * x + pose[1] * y + pose[2] * z + pose[9]) * inverse,
        (pose[3] * x + pose[4] * y + pose[5] * z + pose[10]) * inverse,
        lens,
    )
    x, y, z = x - box[0], y - box[1], z - box[2]
    m0, m1 = abs(box[3] * x + box[4] * y + box[5] * z), abs(box[6] * x + box[7] * y + box[8] * z)
    m2 = abs(box[9] * x + box[10] * y + box[11] * z)
    inside = (depth > _ZERO) & (u >= field[0]) & (u <= field[2]) & (v >= field[1]) & (v <= field[3])
    return inside & (m0 <= box[12]) & (m1 <= box[13]) & (m2 <= box[14])
