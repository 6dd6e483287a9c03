"""What the fused decoder does with one pixel, written once: `fused.py` calls it in loops over blocks, `gpu.py` in a
thread each. In the precision of what comes in, float32: no literal forces another. Phases in turns, intensities in
codes.
"""

import math

import numpy as np
from numba import njit

from fringescope.kernels.lens import to_plane
from fringescope.kernels.sinusoid import ROUNDING, left_over, turns

TWO_PI = np.float32(2 * math.pi)

_f = np.float32
_ZERO, _ONE, _TWO, _THREE = (np.float32(c) for c in (0.0, 1.0, 2.0, 3.0))
_INF = np.float32(np.inf)


@njit(cache=True, inline="always", error_model="numpy")
def fitted(t, p, q, squares, mean, gain, share, noise_a, noise_b, pivot):
    """Sums of I, I cos, I sin, I^2 of a set to wrapped phase, A, B, variance of a sample, square of misfit over noise.

    `mean`, `gain`, `share`: 1 / N, 2 / N, 1 / (N - 3); `pivot` has been taken off every sample.
    """
    a, c, s = t * mean, p * gain, q * gain
    b = math.sqrt(c * c + s * s)
    rest = left_over(squares, t, p, q, a, c, s, share)
    a += pivot
    v = max(noise_a + noise_b * a, _f(ROUNDING))
    return turns(s, c), a, b, v, rest / v


@njit(cache=True, inline="always", error_model="numpy")
def weighed(a, chi2, margin2, lo, hi, soft_lo, soft_hi, unexpected, best, best_chi2, second, best_margin2):
    """The better of two orders: absolute phase, chi squared, that of the next best, and squared margin of the rounding.

    An order outside lo .. hi does not count; outside soft_lo .. soft_hi it costs `unexpected`.
    """
    cost = chi2 + (unexpected if a < soft_lo or a > soft_hi else _ZERO)
    cost = cost if a >= lo and a <= hi else _INF
    better = cost < best_chi2
    second = best_chi2 if better else min(second, cost)
    return a if better else best, cost if better else best_chi2, second, margin2 if better else best_margin2


@njit(cache=True, inline="always", error_model="numpy")
def judged(a, b, coarse_b, sigma, rough, usual, absolute, best_chi2, second, margin2, limits):
    """Reason bits of an unsaturated pixel (`fused.Limits`): exposure (III-D 1), order, consistency."""
    noise = math.sqrt(max(limits.noise_a + limits.noise_b * a, _f(ROUNDING)))
    dark = a < limits.background
    low = b < limits.modulation or b < limits.contrast * a or b < limits.modulation_sigma * noise
    torn = rough > limits.misfit
    fine = b / coarse_b * (_ONE + _TWO * TWO_PI * sigma) < limits.fine_modulation * usual
    weak = sigma > limits.sigma or fine
    low = low or (weak and not dark and not torn)
    none = absolute != absolute
    certain = min(second - best_chi2, margin2) >= limits.margin
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
