"""What makes two neighbours one surface: a step below T1 (III-D 3). Scalar functions, written once."""

import math

from fringescope.jit import njit


@njit(cache=True, inline="always", error_model="numpy")
def spread(field, i, j, H, W, c):
    """Channel c of a coarse field (h, w, C) that spans the image corner on corner, at pixel (i, j)."""
    h, w = field.shape[0], field.shape[1]
    y = i * (h - 1) / max(H - 1, 1)
    x = j * (w - 1) / max(W - 1, 1)
    y0 = min(int(y), max(h - 2, 0))
    x0 = min(int(x), max(w - 2, 0))
    y1 = min(y0 + 1, h - 1)
    x1 = min(x0 + 1, w - 1)
    fy = y - y0
    fx = x - x0
    return (1 - fy) * ((1 - fx) * field[y0, x0, c] + fx * field[y0, x1, c]) + fy * (
        (1 - fx) * field[y1, x0, c] + fx * field[y1, x1, c]
    )


@njit(cache=True, inline="always", error_model="numpy")
def largest_step(field, factor, floor, i, j, H, W):
    """T1 without noise: `factor` times the growth that a surface facing both devices has at this pixel, per pixel.

    The growth is channel 2 of `field`, radians per pixel; T1 is at least `floor`.
    """
    return max(factor * spread(field, i, j, H, W, 2), floor)


@njit(cache=True, inline="always", error_model="numpy")
def linked(phase, sigma, step, noise, i, j, y, x):
    """Whether two pixels in one row or column or diagonal continue one surface: their phases differ by less than T1.

    T1 = `step` (see `largest_step`) times the distance, plus `noise` standard deviations.
    """
    limit = step * max(abs(i - y), abs(j - x)) + noise * math.sqrt(sigma[i, j] ** 2 + sigma[y, x] ** 2)
    return abs(phase[i, j] - phase[y, x]) < limit
