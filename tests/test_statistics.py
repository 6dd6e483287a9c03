"""The kernels of robust statistics against slow, obvious twins by numpy, and against what was drawn."""

import numpy as np
import pytest

from fringescope.kernels import statistics as k


@pytest.mark.parametrize("n", [1, 2, 3, 10, 501])
def test_median_and_reach(n):
    x = np.random.default_rng(n).normal(3, 2, n)
    middle, reach = k.middle_and_reach(x, 0.9)
    assert k.median(x) == middle == np.median(x)
    np.testing.assert_allclose(reach, np.quantile(np.abs(x - np.median(x)), 0.9), rtol=1e-12, atol=1e-15)


def test_tile_medians():
    picture = np.random.default_rng(1).normal(5, 1, (83, 157))
    picture[picture < 4] = np.nan
    picture[:11, :20] = np.nan
    out, want = np.full((8, 8), 7.0), np.full((8, 8), 7.0)
    k.tile_medians(picture, 16, out)
    for a in range(8):
        for b in range(8):
            tile = picture[a * 83 // 8 : (a + 1) * 83 // 8, b * 157 // 8 : (b + 1) * 157 // 8]
            tile = tile[np.isfinite(tile)]
            want[a, b] = np.median(tile) if tile.size > 16 else 7.0
    np.testing.assert_array_equal(out, want)
    assert out[0, 0] == 7.0


def slow_typical(residual, start, limit, kept):
    v = np.sort(residual)
    estimate = v[: max(int(0.8 * len(v)), 1)].mean() / start
    for _ in range(6):
        inside = v[v <= limit * estimate]
        if not len(inside) or len(inside) == len(v):
            return v.mean() if len(inside) else estimate
        estimate = inside.mean() / kept
    return estimate


@pytest.mark.parametrize("outliers", [0, 30])
def test_typical_variance(outliers):
    v = 2.5 * np.random.default_rng(4).chisquare(1, 1000)
    v[:outliers] = 1e3
    args = (0.4, 9.5, 0.98)  # near those of one degree of freedom
    np.testing.assert_allclose(k.typical(v, *args), slow_typical(v, *args), rtol=1e-12)
    level = np.sort(np.random.default_rng(5).uniform(10, 90, 1000))
    begin, out = np.array([0, 400, 430, 1000]), np.empty((3, 3))
    assert k.bins(level, v, begin, 50, *args, out) == 2  # thirty are too few
    for row, (a, b) in zip(out, ((0, 400), (430, 1000)), strict=False):
        want = level[a:b].mean(), slow_typical(v[a:b], *args), b - a
        np.testing.assert_allclose(row, want, rtol=1e-12)


def test_a_line_through_variances():
    """What was drawn, by its standard error, a bin far off or not; no slope where all levels are alike."""
    weight, flat = np.full(24, 400.0), 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x = np.linspace(20, 200, 24)
        true = 0.5 + 0.03 * x
        y = true * rng.chisquare(400, 24) / 400
        y[3] *= 5
        a, b = k.line(x, y, weight, 1 / 12)
        w = weight / (2 * true**2)
        error = 1 / np.sqrt((w * (x - np.average(x, weights=w)) ** 2).sum())
        assert abs(b - 0.03) < 3.5 * error
        assert abs(a + 100 * b - 3.5) < 0.2
        alike = 90 + rng.uniform(-0.1, 0.1, 24)
        a, b = k.line(alike, 1.5 * rng.chisquare(400, 24) / 400, weight, 1 / 12)
        assert abs(a + 90 * b - 1.5) < 0.1
        flat += b == 0.0
    assert flat >= 17


@pytest.mark.parametrize("pixels", [1, 9_000, 10_000, 40_000, 311_904, 20_000_000])
def test_strides_are_odd(pixels):
    n = k.odd_stride(pixels, 10_000)
    assert n % 2 == 1
    assert n >= 1
    assert abs(n - (pixels / 10_000) ** 0.5) <= 1  # the nearest one
