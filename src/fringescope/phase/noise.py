"""The sensor's noise, from the capture itself: `variance = a + b I` by the residuals about the fitted sinusoids."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from fringescope.phase.sums import Measured
from fringescope.types import AnyArray, NoiseModel
from fringescope.types.capture import ROUNDING

SAMPLES = 100_000  #: pixels that are enough to tell the noise


def estimate_noise(measured: Sequence[Measured], max_value: int) -> NoiseModel:
    """Sensor noise `variance = a + b I` from the capture itself: the residuals about the sinusoids of sets with N > 3.

    In bins of the background the median residual (a chi-squared of N - 3 degrees of freedom) stands for the variance;
    a line through the bins gives a and b. With three steps only, the backgrounds of two sets of one exposure differ
    by noise alone and serve instead. Falls back to 0.6 codes of read noise and b = 0.03 of the 8-bit scale.
    """
    levels: list[float] = []
    variances: list[float] = []
    weights: list[float] = []
    samples: list[tuple[AnyArray, AnyArray, int]] = []
    thin = round(math.sqrt(measured[0].phase.size / SAMPLES)) | 1 if measured else 1  # odd: every colour of a mosaic
    cut = (slice(None, None, thin), slice(None, None, thin))
    for m in measured:
        if m.steps > 3:
            ok = m.clipped[cut] == 0
            samples.append((m.background[cut][ok], m.variance[cut][ok], m.steps - 3))
    if not samples:
        for m1, m2 in pairwise(measured):
            if m1.phase.shape == m2.phase.shape and m1.fringe_set.exposure_us == m2.fringe_set.exposure_us:
                ok = (m1.clipped[cut] == 0) & (m2.clipped[cut] == 0)
                A = m1.background[cut][ok]
                d = A.astype(np.float64) - m2.background[cut][ok]
                d -= np.median(d) if d.size else 0.0
                samples.append((A, d * d / (1 / m1.steps + 1 / m2.steps), 1))
    for A, v, dof in samples:
        ok = (0.01 * max_value < A) & (0.9 * max_value > A)
        if np.count_nonzero(ok) < 400:
            continue
        level, rest = A[ok], v[ok]
        edges = np.unique(np.quantile(level, np.linspace(0, 1, 25)))
        where = np.clip(np.searchsorted(edges, level, side="right") - 1, 0, max(len(edges) - 2, 0))
        for n in range(len(edges) - 1):
            inside = where == n
            if inside.sum() >= 50:
                levels.append(float(level[inside].mean()))
                variances.append(float(np.median(rest[inside])) / _chi2_median(dof))
                weights.append(float(inside.sum()) * dof)
    if len(levels) < 3:
        scale = max_value / 255.0
        return NoiseModel(0.36 * scale * scale, 0.03 * scale, "default")
    x, y = np.array(levels), np.maximum(np.array(variances), ROUNDING)
    w = np.array(weights) / y**2
    intercept, slope = 0.0, 0.0
    for _ in range(8):  # iteratively reweighted: bins spoilt by motion or gamma lie above the line
        mean = float(np.average(x, weights=w))
        middle = float(np.average(y, weights=w))
        spread = max(float(np.sum(w * (x - mean) ** 2)), 1e-12)
        slope = max(float(np.sum(w * (x - mean) * (y - middle))) / spread, 0.0)
        intercept = middle - slope * mean
        line = np.maximum(intercept + slope * x, ROUNDING)
        off = (y - line) / line
        scatter = 1.4826 * float(np.median(np.abs(off))) + 1e-3
        w = np.array(weights) / line**2 / (1 + (off / (3 * scatter)) ** 2)
    return NoiseModel(intercept, slope, "residuals")


def _chi2_median(dof: int) -> float:
    """Median over mean of a chi-squared variable (Wilson and Hilferty; exact 0.4549 for one degree of freedom)."""
    return 0.45494 if dof == 1 else (1 - 2 / (9 * dof)) ** 3
