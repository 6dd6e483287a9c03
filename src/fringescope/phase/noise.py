"""The sensor's noise, from the capture itself: `variance = a + b I` by the residuals about the fitted sinusoids."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from fringescope.kernels import statistics as k
from fringescope.phase.sums import Measured
from fringescope.types import F64, AnyArray, NoiseModel
from fringescope.types.capture import ROUNDING

SAMPLES = 10_000  #: pixels that are enough to tell the noise
SPOILT = 3.0  #: a set whose residuals are this many times those of the quietest set is no measure of noise


class _Bins(NamedTuple):
    """What one set says: variance at some levels, and how much each counts."""

    level: F64
    variance: F64
    weight: F64


def estimate_noise(measured: Sequence[Measured], max_value: int) -> NoiseModel:
    """Sensor noise `variance = a + b I` from the capture itself: the residuals about the sinusoids of sets with N > 3.

    In bins of the background the residuals (a chi-squared of N - 3 degrees of freedom, outliers left out) give the
    variance; a line through the bins gives a and b. Sets that are far noisier than the quietest one are spoilt (a lost
    frame, motion) and do not count. With three steps only, the backgrounds of two sets of one exposure differ by noise
    and serve instead. Falls back to 0.6 codes of read noise and b = 0.03 of the 8-bit scale.
    """
    thin = k.odd_stride(measured[0].phase.size if measured else SAMPLES, SAMPLES)
    cut = (slice(None, None, thin), slice(None, None, thin))
    sets: list[_Bins] = []
    for m in measured:
        if m.steps > 3:
            ok = m.clipped[cut] == 0
            sets.append(_binned(m.background[cut][ok], m.variance[cut][ok], m.steps - 3, max_value))
    if not sets:
        sets = [_between(m1, m2, thin, max_value) for m1, m2 in pairwise(measured)]
    sets = _unspoilt([b for b in sets if len(b.level)])
    if sum(len(b.level) for b in sets) < 3:
        scale = max_value / 255.0
        return NoiseModel(0.36 * scale * scale, 0.03 * scale, "default")
    level, variance, weight = (np.concatenate(part) for part in zip(*sets, strict=True))
    a, b = _line(level, np.maximum(variance, ROUNDING), weight)
    return NoiseModel(a, b, "residuals")


def _between(one: Measured, two: Measured, thin: int, max_value: int) -> _Bins:
    """What the backgrounds of two sets of one exposure say: they differ by noise, and by the ripple of the response.

    The ripple is smooth along the rows: second differences (every other pixel, for mosaics) leave it out.
    """
    if one.phase.shape != two.phase.shape or one.fringe_set.exposure_us != two.fringe_set.exposure_us:
        return _Bins(*np.zeros((3, 0)))
    rows = slice(None, None, thin * thin)
    d = one.background[rows].astype(np.float64) - two.background[rows]
    clean = (one.clipped[rows] == 0) & (two.clipped[rows] == 0)
    if d.shape[1] < 5:
        return _Bins(*np.zeros((3, 0)))
    bend = d[:, 4:] - 2 * d[:, 2:-2] + d[:, :-4]
    ok = clean[:, 4:] & clean[:, 2:-2] & clean[:, :-4]
    level = one.background[rows][:, 2:-2][ok]
    return _binned(level, bend[ok] ** 2 / (6 * (1 / one.steps + 1 / two.steps)), 1, max_value)


def _binned(background: AnyArray, variance: AnyArray, dof: int, max_value: int) -> _Bins:
    """Variance in up to 24 bins of the background, each with the mean level of its pixels.

    The residuals are chi-squared but for outliers: a truncated mean, made consistent, tells the variance. No median:
    with four steps the residuals of integer codes take few values, and a median jumps between them.
    """
    ok = (0.01 * max_value < background) & (0.9 * max_value > background)
    background, variance = background[ok], variance[ok]
    if len(background) < 400:
        return _Bins(*np.zeros((3, 0)))
    order = np.argsort(background)
    level, rest = background[order].astype(np.float64), variance[order].astype(np.float64)
    edges = np.unique(np.interp(np.linspace(0, len(level) - 1, 25), np.arange(len(level)), level))
    begin = np.append(np.searchsorted(level, edges[:-1], side="left"), len(level))
    out = np.empty((24, 3))
    n = k.bins(level, rest, begin, 50, *_truncation(dof), out)
    mean, typical, count = np.ascontiguousarray(out[:n].T)
    return _Bins(mean, typical, count * dof)


@lru_cache(maxsize=64)
def _truncation(dof: int) -> tuple[float, float, float]:
    """Of a chi-squared over its degrees of freedom: mean of its lowest 80 %; 99.8 % quantile, and the mean below it."""
    few, most = _chi2_quantile(0.8, dof), _chi2_quantile(0.998, dof)
    return _chi2_share(few, dof + 2) / 0.8, most / dof, _chi2_share(most, dof + 2) / 0.998


def _chi2_share(x: float, dof: int) -> float:
    """Share of a chi-squared of `dof` degrees of freedom below `x` > 0, by its series; SciPy's is slow to import."""
    a, y = 0.5 * dof, 0.5 * x
    term = total = 1.0 / a
    while term > 1e-17 * total:
        a += 1.0
        term *= y / a
        total += term
    return total * math.exp(0.5 * dof * math.log(y) - y - math.lgamma(0.5 * dof))


def _chi2_quantile(share: float, dof: int) -> float:
    """Where a chi-squared of `dof` degrees of freedom has `share` below it, 0 < share < 1."""
    low, high = 0.0, dof + 20.0 * math.sqrt(2.0 * dof) + 20.0
    while (middle := 0.5 * (low + high)) not in (low, high):
        low, high = (middle, high) if _chi2_share(middle, dof) < share else (low, middle)
    return high


def _unspoilt(sets: Sequence[_Bins]) -> list[_Bins]:
    """The sets whose residuals are like those of the quietest, at like levels."""
    if len(sets) < 2:
        return list(sets)
    lines = [_line(b.level, np.maximum(b.variance, ROUNDING), b.weight) if len(b.level) > 2 else None for b in sets]
    middle = float(np.median(np.concatenate([b.level for b in sets])))
    heights = [line[0] + line[1] * middle if line is not None else math.inf for line in lines]
    best = lines[int(np.argmin(heights))]
    if best is None:
        return list(sets)
    out = []
    for b in sets:
        expected = np.maximum(best[0] + best[1] * b.level, ROUNDING)
        if float(np.average(np.maximum(b.variance, ROUNDING) / expected, weights=b.weight)) < SPOILT:
            out.append(b)
    return out


def _line(x: F64, y: F64, weight: F64) -> tuple[float, float]:
    """Intercept and slope (at least 0) through variances y at levels x; bins spoilt by motion or gamma lie above it."""
    intercept, slope = k.line(x, y, weight, ROUNDING)
    return float(intercept), float(slope)
