"""Two raw pictures of one camera, made comparable: one brightness, one size of pixels, and what may vote."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from fringescope.settings import WatchSettings
from fringescope.types import F32, F64, AnyArray, Bool, NoiseModel, PixelFormat

KERNEL = np.array([0.25, 0.5, 0.25])  #: along rows and columns: takes an RGGB mosaic to one grey, whatever its colour
POWER = float((KERNEL**2).sum() ** 2)  #: variance of white noise that is left after it
NEAR_FULL = 0.985  #: share of full scale from which a sample counts as saturated


@dataclass(frozen=True, eq=False)
class Pair:
    """Then and now in codes of the scan's format, on pixels `bin_` camera pixels wide: arrays (h, w).

    `var` is the noise variance of now minus then, before any smoothing; `then_ok`, `now_ok` tell usable pixels;
    `gain`, `offset` per channel: now = gain then + offset, already taken out of `now`.
    """

    then: F32
    now: F32
    var: F32
    then_ok: Bool
    now_ok: Bool
    bin_: int
    gain: tuple[float, ...]
    offset: tuple[float, ...]


def channels(fmt: PixelFormat) -> list[tuple[slice, slice]]:
    """Which rows and columns are the sites of each channel: R, G, G, B of a mosaic, else all."""
    if not fmt.is_bayer:
        return [(slice(None), slice(None))]
    return [(slice(i, None, 2), slice(j, None, 2)) for i in (0, 1) for j in (0, 1)]


def grey(frame: AnyArray, fmt: PixelFormat) -> F32:
    """One sample per pixel (H, W): a mosaic as it is, of RGB8 the sum of the channels."""
    return np.asarray(frame.sum(2) if fmt is PixelFormat.RGB8 else frame, np.float32)


def usable(frame: AnyArray, fmt: PixelFormat, mask: Bool | None) -> Bool:
    """Where (H, W) a frame is neither saturated nor masked."""
    below = np.asarray(frame < NEAR_FULL * fmt.max_value)
    ok = np.asarray(below.all(axis=2)) if below.ndim == 3 else below
    return ok if mask is None else np.asarray(ok & ~mask)


def binned(a: AnyArray, n: int) -> F32:
    """Means of n x n pixels; what is left over at the right and below is cut off."""
    h, w = a.shape[0] // n, a.shape[1] // n
    if n == 1:
        return np.asarray(a, np.float32)
    return np.asarray(a[: h * n, : w * n].reshape(h, n, w, n).mean((1, 3), dtype=np.float32))


def smooth(a: AnyArray) -> F32:
    """By `KERNEL` along rows and columns."""
    return np.asarray(cv2.sepFilter2D(np.asarray(a, np.float32), -1, KERNEL, KERNEL, borderType=cv2.BORDER_REFLECT_101))


def eroded(ok: Bool, pixels: int) -> Bool:
    """Where everything within `pixels` is usable; the border is not."""
    side = np.ones((2 * pixels + 1, 2 * pixels + 1), np.uint8)
    return np.asarray(cv2.erode(ok.astype(np.uint8), side, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0)


def robust_line(x: F64, y: F64, prior: float) -> tuple[float, float]:
    """Gain and offset of y = gain x + offset that most of the points (n,) agree on; `prior`: deviation of the offset
    that is expected, in the unit of y. Starts from the median ratio, weighs by Geman and McClure.
    """
    gain, offset = float(np.median(y / np.maximum(x, 1e-6))), 0.0
    for _ in range(20):
        r = y - gain * x - offset
        spread = 1.4826 * float(np.median(np.abs(r))) + 1e-3 * float(np.median(y)) + 1e-6
        w = 1.0 / (1.0 + (r / (2.5 * spread)) ** 2) ** 2
        a, b, c = (w * x * x).sum(), (w * x).sum(), w.sum() + (spread / prior) ** 2
        d, e = (w * x * y).sum(), (w * y).sum()
        det = a * c - b * b
        if not det > 1e-12 * a * c:
            return float(d / max(a, 1e-12)), 0.0
        gain, offset = float((c * d - b * e) / det), float((a * e - b * d) / det)
    return gain, offset


def highlights(a: F32, ok: Bool, s: WatchSettings) -> Bool:
    """Spots (h, w) much brighter than what lies within a tile around them: what a film mirrors."""
    side = (2 * s.tile + 1, 2 * s.tile + 1)
    part = cv2.boxFilter(ok.astype(np.float32), -1, side)
    around = cv2.boxFilter(np.where(ok, a, 0.0).astype(np.float32), -1, side) / np.maximum(part, 1e-3)
    spots = ok & (a > (1 + s.bright) * around + 1.0)
    return np.asarray(cv2.dilate(spots.astype(np.uint8), np.ones((3, 3))) > 0)


def noise_of(then: AnyArray, now: AnyArray, fmt: PixelFormat) -> NoiseModel:
    """The noise of one sample from two pictures of one thing: of what differs between like neighbours, by brightness.

    What moved makes it larger, so that less is called significant.
    """
    a, b = grey(then, fmt), grey(now, fmt)
    step = 2 if fmt.is_bayer else 1
    d = (b - a)[:, 2 * step :] - 2 * (b - a)[:, step:-step] + (b - a)[:, : -2 * step]
    at = a[:, step:-step]
    ok = (at < NEAR_FULL * fmt.full_scale) & (b[:, step:-step] < NEAR_FULL * fmt.full_scale)
    if ok.sum() < 100:
        return NoiseModel(0.5, 0.02)
    x, y = at[ok], d[ok] / np.sqrt(12.0)
    edges = np.percentile(x, np.linspace(0, 100, 9))
    level, spread = [], []
    for low, high in pairwise(edges):
        one = (x >= low) & (x <= high)
        if one.sum() > 50:
            level.append(float(x[one].mean()))
            spread.append((1.4826 * float(np.median(np.abs(y[one])))) ** 2)
    if len(level) < 2 or np.ptp(level) < 1:
        return NoiseModel(max(float(np.mean(spread or [0.5])), 1 / 12), 0.0, "pictures")
    slope, start = np.polyfit(level, spread, 1)
    return NoiseModel(float(start), max(float(slope), 0.0), "pictures")


def factor(mm_per_px: float, fmt: PixelFormat, s: WatchSettings) -> int:
    """Camera pixels to a pixel of the comparison: even for a mosaic, so that each holds as much of each colour."""
    n = max(1, round(s.pitch_mm / mm_per_px))
    return n if n == 1 or not fmt.is_bayer else max(2, n // 2 * 2)


def pair(
    then: AnyArray, now: AnyArray, fmt: PixelFormat, mask: Bool | None, noise: NoiseModel, n: int, s: WatchSettings
) -> Pair | None:
    """Both frames of one format and size, brought to one brightness; None where too little of them is usable."""
    ok = usable(then, fmt, None), usable(now, fmt, mask)
    a, b = grey(then, fmt), grey(now, fmt)
    both = ok[0] & ok[1]
    side = max(8, s.tile * n) // 2 * 2
    matched, factors, offsets = b.copy(), [], []
    for rows, columns in channels(fmt):
        one = both[rows, columns]
        cell = max(4, side // (2 if fmt.is_bayer else 1))
        share = binned(one, cell)
        x, y = (binned(np.where(one, c[rows, columns], 0.0), cell) for c in (a, b))
        use = share > 0.5
        if use.sum() < 6:
            return None
        gain, offset = robust_line(
            (x[use] / share[use]).astype(float), (y[use] / share[use]).astype(float), 0.01 * fmt.full_scale
        )
        factors.append(gain)
        offsets.append(offset)
        if not gain > 0:
            return Pair(a, b, a, ok[0], ok[1], n, tuple(factors), tuple(offsets))
        matched[rows, columns] = (b[rows, columns] - offset) / gain
    mean_gain = float(np.mean(factors))
    var = (noise.variance(a) + noise.variance(b) / mean_gain**2) / n**2
    before, after, spread = (binned(c, n) for c in (a, matched, var))
    fine = [binned(o, n) > 0.999 for o in ok]
    fine = [np.asarray(o & ~highlights(smooth(c), o, s)) for o, c in zip(fine, (before, after), strict=True)]
    return Pair(before, after, spread, fine[0], fine[1], n, tuple(factors), tuple(offsets))
