"""Robust statistics of a few thousand pixels: variances in bins, lines through them, medians of tiles.

Arrays and scalars only.
"""

import math

import numpy as np

from fringescope.jit import njit


def odd_stride(pixels: int, enough: int) -> int:
    """Every how many-th row and column of a picture leaves about `enough` of its pixels: odd, so that every colour of a
    mosaic comes in.
    """
    return 2 * round((math.sqrt(pixels / enough) - 1) / 2) + 1


@njit(cache=True, nogil=True, error_model="numpy")
def typical(residual, start, limit, kept):
    """Variance behind residuals: the mean of their lowest 80 % over `start`, then, again and again, that of those below
    `limit` times the last estimate, over `kept`.
    """
    n = len(residual)
    few = max(int(0.8 * n), 1)
    estimate = np.partition(residual, few - 1)[:few].mean() / start
    for _ in range(6):
        most, total, count = limit * estimate, 0.0, 0
        for i in range(n):
            inside = residual[i] <= most
            total += residual[i] if inside else 0.0
            count += 1 if inside else 0
        if count == 0:
            return estimate
        if count == n:
            return total / n
        estimate = total / count / kept
    return estimate


@njit(cache=True, nogil=True, error_model="numpy")
def bins(level, variance, begin, least, start, limit, kept, out):
    """Mean of `level`, `typical` variance and number of the pixels between begin[k] and begin[k + 1], in out[k] (3,).

    Bins of fewer than `least` pixels are left out; returns how many there are.
    """
    n = 0
    for k in range(len(begin) - 1):
        first, last = begin[k], begin[k + 1]
        if last - first >= least:
            out[n, 0] = level[first:last].mean()
            out[n, 1] = typical(variance[first:last], start, limit, kept)
            out[n, 2] = last - first
            n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def line(x, y, weight, floor):
    """Intercept and slope (at least 0) through variances y at levels x; those that lie far from it count less.

    `weight` is the number of degrees of freedom of each. A slope that is not twice its standard error is none, and a
    larger one is shrunk by what is far below that error: where all levels are alike, little would tell, far away from
    them, what any slope would.
    """
    w = weight / (y * y)
    mean, middle, spread, slope = 0.0, 0.0, 1.0, 0.0
    for _ in range(8):
        total = w.sum()
        mean, middle = (w * x).sum() / total, (w * y).sum() / total
        spread = max((w * (x - mean) ** 2).sum(), 1e-12)
        slope = max((w * (x - mean) * (y - middle)).sum() / spread, 0.0)
        intercept = middle - slope * mean
        through = np.maximum(intercept + slope * x, floor)
        off = (y - through) / through
        scatter = 1.4826 * np.median(np.abs(off)) + 1e-3
        w = weight / (through * through) / (1.0 + (off / (3.0 * scatter)) ** 2)
    if slope > 0.0:
        slope = max(slope - 4.0 * (2.0 / spread) / slope, 0.0)
    return middle - slope * mean, slope


@njit(cache=True, nogil=True, error_model="numpy")
def tile_medians(picture, least, out):
    """Medians of the finite values in each of (h, w) tiles of a picture, in `out`, where more than `least` are."""
    H, W = picture.shape
    h, w = out.shape
    some = np.empty(H * W // (h * w) + H + W + 1, picture.dtype)
    for a in range(h):
        for b in range(w):
            n = 0
            for i in range(a * H // h, (a + 1) * H // h):
                for j in range(b * W // w, (b + 1) * W // w):
                    if np.isfinite(picture[i, j]):
                        some[n] = picture[i, j]
                        n += 1
            if n > least:
                out[a, b] = np.median(some[:n])


@njit(cache=True, nogil=True, error_model="numpy")
def median(values):
    """The median of values (n,), n > 0, none of them NaN."""
    return np.median(values)


@njit(cache=True, nogil=True, error_model="numpy")
def middle_and_reach(values, share):
    """The median of values (n,), n > 0, and the distance from it within which `share` of them lie."""
    middle = np.median(values)
    n = len(values)
    at = share * (n - 1)
    low = min(int(at), n - 1)
    high = min(low + 1, n - 1)
    off = np.partition(np.abs(values - middle), high)
    below = off[:high].max() if high > low else off[high]
    return middle, below + (at - low) * (off[high] - below)
