"""Pictures ready for looking at boards: the colour sites of a mosaic made equally bright, nothing moved or smoothed."""

from __future__ import annotations

import cv2
import numpy as np

from fringescope.types import F32, F64, PixelFormat

GRADIENT = 0.05  #: of the local level: places that change less over a cell tell the sites' gains
LEAST_GAIN = 0.05  #: of the mean of the sites: a site that sees less of the light is not used


def equalise(image: F32, pixel_format: PixelFormat) -> tuple[F32, F64]:
    """A picture (H, W) whose four Bayer sites answer alike, and the weights (2, 2) of the sites for least squares.

    Each site keeps its own samples: they are scaled and shifted so that, where the picture is even, they agree with the
    mean of the four. A site that sees next to none of the light gets no weight. Other formats pass through.
    """
    if not pixel_format.is_bayer:
        return np.ascontiguousarray(image, dtype=np.float32), np.ones((2, 2))
    h, w = (image.shape[0] // 2) * 2, (image.shape[1] // 2) * 2
    sites = {(i, j): image[i:h:2, j:w:2].astype(np.float64) for i in (0, 1) for j in (0, 1)}
    mean = np.mean(list(sites.values()), axis=0)
    smooth = cv2.blur(mean, (3, 3))
    spread = cv2.dilate(mean, np.ones((3, 3))) - cv2.erode(mean, np.ones((3, 3)))
    high = float(np.percentile(smooth, 99))
    even = (spread < GRADIENT * np.maximum(smooth, 0.2 * high)) & np.isfinite(smooth)
    out = image.astype(np.float32).copy()
    gains = np.ones((2, 2))
    for (i, j), site in sites.items():
        shift, gain = _line(mean[even], site[even])
        gains[i, j] = gain
        if gain > LEAST_GAIN:
            out[i::2, j::2] = (image[i::2, j::2] - shift) / gain
        else:
            out[i:h:2, j:w:2] = mean  # for the eye of the detector; the fit gives it no weight
    weights = np.where(gains > LEAST_GAIN, gains, 0.0)
    return out, weights / max(float(weights.max()), 1e-9)


def _line(x: F64, y: F64) -> tuple[float, float]:
    """Robust straight line y = shift + gain x."""
    if x.size < 50:
        return 0.0, float(np.sum(y) / max(np.sum(x), 1e-9)) if x.size else 1.0
    if x.size > 50_000:
        step = x.size // 50_000 + 1
        x, y = x[::step], y[::step]
    w = np.ones_like(x)
    shift, gain = 0.0, 1.0
    for _ in range(6):
        mx, my = np.average(x, weights=w), np.average(y, weights=w)
        var = np.average((x - mx) ** 2, weights=w)
        gain = float(np.average((x - mx) * (y - my), weights=w) / var) if var > 1e-12 else 1.0
        shift = float(my - gain * mx)
        r = np.abs(y - shift - gain * x)
        w = 1 / np.maximum(r, max(1e-3, float(np.median(r))))
    return shift, gain


def reduced(image: F32, width: int) -> tuple[F32, float]:
    """The picture shrunk by area to at most `width` pixels of its longer side, and the factor; never enlarged."""
    factor = min(1.0, width / max(image.shape))
    if factor == 1.0:
        return image, 1.0
    size = max(round(image.shape[1] * factor), 8), max(round(image.shape[0] * factor), 8)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32), factor
