"""The sensor's noise, from the capture itself: `variance = a + b I` by the residuals about the fitted sinusoids."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from fringescope.phase.sums import Measured
from fringescope.types import AnyArray, NoiseModel


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
    for m in measured:
        if m.steps > 3:
            ok = m.clipped == 0
            samples.append((m.background[ok], m.variance[ok], m.steps - 3))
    if not samples:
        for m1, m2 in pairwise(measured):
            if m1.phase.shape == m2.phase.shape and m1.fringe_set.exposure_us == m2.fringe_set.exposure_us:
                ok = (m1.clipped == 0) & (m2.clipped == 0)
                A, d = m1.background[ok], (m1.background[ok] - m2.background[ok]).astype(np.float64)
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
    floor = 1.0 / 12.0
    if len(levels) < 3:
        scale = max_value / 255.0
        return NoiseModel(0.36 * scale * scale, 0.03 * scale, "default")
    x, y, w = np.array(levels), np.array(variances), np.array(weights)
    w = w / np.maximum(y, floor) ** 2
    for _ in range(5):  # iteratively reweighted: bins spoilt by motion or gamma lie above the line
        M = np.stack([np.ones_like(x), x], 1)
        a, b = (float(c) for c in np.linalg.lstsq(M * np.sqrt(w)[:, None], y * np.sqrt(w), rcond=None)[0])
        if b < 0:
            a, b = float(np.average(y, weights=w)), 0.0
        if a < floor:
            a, b = floor, max(float(np.sum(w * x * (y - floor)) / np.sum(w * x * x)), 0.0)
        r = (y - a - b * x) / np.maximum(a + b * x, floor)
        scale = 1.4826 * float(np.median(np.abs(r))) + 1e-3
        w = np.array(weights) / np.maximum(a + b * x, floor) ** 2 / (1 + (r / (3 * scale)) ** 2)
    return NoiseModel(float(a), float(b), "residuals")


def _chi2_median(dof: int) -> float:
    """Median over mean of a chi-squared variable (Wilson and Hilferty; exact 0.4549 for one degree of freedom)."""
    return 0.45494 if dof == 1 else (1 - 2 / (9 * dof)) ** 3
