"""Scalar functions of N-step decoding, written once: the staged kernels call them with float64, the fused ones with
float32. Phases are in turns (1 = one period), so that quadrants are exact in either; intensities in codes.
"""

import math

import numpy as np
from numba.extending import overload

from fringescope.jit import njit

TWO_PI = 2.0 * math.pi
ROUNDING = 1.0 / 12.0  #: least variance of a sample, codes squared

# atan(x) / (2 pi x) on [0, 1] as a polynomial of x^2, equal ripple: off by 6e-9
_C0, _C1, _C2, _C3, _C4, _C5, _C6, _C7 = (
    np.float32(c / TWO_PI)
    for c in (
        0.99999934, -0.33329861, 0.19946567, -0.13908633, 0.09642202, -0.05591235, 0.02186295, -0.00405456,
    )
)  # fmt: skip
_ZERO, _QUARTER, _HALF, _ONE, _TWO, _THREE, _FOUR = (np.float32(c) for c in (0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 4.0))
_TINY = np.float32(1e-30)


def whole(x):
    """The greatest whole number that is not above x, in x's type; each target has its own way (see `gpu.py`)."""
    return np.floor(x)


@overload(whole, inline="always", target="cpu")
def _whole(x):  # noqa: ARG001
    return lambda x: np.floor(x)


@njit(cache=True, inline="always", error_model="numpy")
def turns(y, x):
    """The angle of (x, y) in turns, -0.5 to 0.5, without branches; 0 where both are 0. Off by less than 5e-8."""
    ax, ay = abs(x), abs(y)
    r = min(ax, ay) / max(max(ax, ay), _TINY)
    t = r * r
    a = ((((((_C7 * t + _C6) * t + _C5) * t + _C4) * t + _C3) * t + _C2) * t + _C1) * t + _C0
    a = a * r
    a = _QUARTER - a if ay > ax else a
    a = _HALF - a if x < _ZERO else a
    return -a if y < _ZERO else a


@njit(cache=True, inline="always", error_model="numpy")
def left_over(squares, total, in_phase, quadrature, a, c, s, share):
    """Variance of the samples about the sinusoid a + c cos + s sin; `share` = 1 / (samples - 3)."""
    rest = squares - a * total - c * in_phase - s * quadrature
    return max(rest, rest - rest) * share  # a zero of the same type


@njit(cache=True, inline="always", error_model="numpy")
def phase_variance(variance, background_share, modulation, cos_phase, gain, steps):
    """Variance of the phase, radians squared, of a full set: gain (2 / N) times that of a sample over B^2.

    Three steps have a further term, -(b B / 2) cos 3 phi, where `background_share` is b of variance = a + b I.
    """
    v = variance
    if steps == 3:
        cos3 = cos_phase * (_FOUR * cos_phase * cos_phase - _THREE)
        v = v - background_share * modulation * cos3 * _HALF
    return gain * v / (modulation * modulation)


@njit(cache=True, inline="always", error_model="numpy")
def follow(absolute, variance, phase, fine_variance, ratio):
    """One step from coarse to fine, in turns: absolute phase of the finer set, chi squared, margin^2 of the rounding.

    The margin: how many standard deviations worse the next turn would fit, squared.
    """
    predicted = absolute * ratio
    n = whole(predicted - phase + _HALF)
    rest = predicted - phase - n
    weight = _ONE / (variance * (ratio * ratio) + fine_variance)
    return phase + n, rest * rest * weight, (_ONE - _TWO * abs(rest)) * weight
