"""A sighting drawn on its picture: corners in their order, white squares, phase samples, and what was left out."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fringescope.types import F64, U8, Bool, Residuals, Sighting

LONGEST = 1200  #: pixels of the drawn picture's longer side, at least half of it
SHIFT = 4  #: binary places of OpenCV's drawing
CORNER, SQUARE, SAMPLE, OUT = (255, 196, 0), (80, 220, 120), (70, 190, 255), (255, 60, 60)
AXIS_X, AXIS_Y, MISS = (255, 90, 90), (120, 255, 90), (255, 120, 255)
GAP = 1.5  #: how far neighbouring corners of a row may lie apart to be joined, in columns


def sighting_picture(image: NDArray[Any], sighting: Sighting, residuals: Residuals | None = None) -> U8:
    """The picture (h, w, 3) uint8 with what was found: an image (H, W) or (H, W, 3) of any codes, mosaics too.

    An image that is smaller than `sighting.size` shows the same, reduced.

    Yellow rings: corners, joined row by row from the first (white disc; its arrows are the board's x, red, and y,
    green). Green diamonds: white squares. Blue dots: phase samples. Red crosses: left out by the solve, where
    `residuals` are given; purple lines then show the corners' residuals, so much too long that they can be seen.
    """
    grey = grey_picture(image)
    k = LONGEST / max(grey.shape)
    k = min(k, 1.0) if k < 1 else min(float(np.ceil(k)), 2.0)
    size = (max(1, round(grey.shape[1] * k)), max(1, round(grey.shape[0] * k)))
    way = cv2.INTER_AREA if k < 1 else cv2.INTER_CUBIC
    out = cv2.cvtColor(cv2.resize(grey, size, interpolation=way), cv2.COLOR_GRAY2RGB)
    unit = max(size) / LONGEST
    k *= grey.shape[1] / sighting.size[0]
    left_out = _left_out(sighting, residuals)
    _samples(out, _place(sighting.sample_px, k), left_out[1], unit)
    corners = _place(sighting.corner_px, k)
    step = _spacing(sighting.corner, corners)
    for p in _place(sighting.square_px, k):
        r = max(0.09 * step, 2.5 * unit)
        diamond = np.array([[p[0] - r, p[1]], [p[0], p[1] - r], [p[0] + r, p[1]], [p[0], p[1] + r]])
        cv2.polylines(out, [_fixed(diamond)], True, SQUARE, 1, cv2.LINE_AA, SHIFT)
    _rows(out, sighting.corner, corners)
    r = max(0.13 * step, 3.0 * unit)
    for p, bad in zip(corners, left_out[0], strict=True):
        if bad:
            _cross(out, p, 1.3 * r, max(1, round(2 * unit)))
        else:
            cv2.circle(out, _point(p), int(r * 2**SHIFT), CORNER, max(1, round(1.4 * unit)), cv2.LINE_AA, SHIFT)
    if residuals is not None and residuals.corner.shape == corners.shape and not left_out[0].all():
        d = residuals.corner[~left_out[0]]
        times = 0.4 * step / max(float(np.percentile(np.hypot(*d.T), 90)), 1e-9)
        for p, q in zip(corners[~left_out[0]], times * d, strict=True):
            cv2.line(out, _point(p), _point(p + q), MISS, max(1, round(unit)), cv2.LINE_AA, SHIFT)
    _axes(out, sighting.corner, corners, step, unit)
    return np.asarray(out, dtype=np.uint8)


def _place(pixels: F64, k: float) -> F64:
    """Places (n, 2) of the camera's pixels in the picture that is `k` times as large."""
    return np.asarray((pixels.reshape(-1, 2) + 0.5) * k - 0.5, dtype=np.float64)


def grey_picture(image: NDArray[Any]) -> U8:
    """An image (H, W) or (H, W, 3) of any codes, mosaics too, as grey (H, W) that can be looked at."""
    a = np.nan_to_num(np.asarray(image, dtype=np.float32))
    if a.ndim == 3:
        a = a.mean(axis=2)
    sites = [float(a[i::2, j::2].mean()) for i in (0, 1) for j in (0, 1)] if min(a.shape) > 3 else [1.0]
    if max(sites) > 1.04 * max(min(sites), 1e-9):  # a mosaic: each 2 x 2 becomes its mean
        a = cv2.boxFilter(a, -1, (2, 2), anchor=(0, 0))
    low, high = np.percentile(a, [0.5, 99.8])
    out: U8 = np.rint(225 * np.clip((a - low) / max(float(high - low), 1e-9), 0, 1) ** 0.75).astype(np.uint8)
    return out


def _left_out(s: Sighting, r: Residuals | None) -> tuple[Bool, Bool]:
    corner: Bool = np.zeros(len(s.corner_px), dtype=np.bool_)
    sample: Bool = np.zeros(len(s.sample_px), dtype=np.bool_)
    if r is not None and len(r.corner) == len(corner):
        corner = np.asarray(~np.isfinite(r.corner).all(axis=1))
    if r is not None and len(r.sample) == len(sample) and len(sample):
        sample = np.asarray(~np.isfinite(r.sample).any(axis=1))
    return corner, sample


def _samples(out: U8, places: F64, bad: Bool, unit: float) -> None:
    h, w = out.shape[:2]
    wide = max(1, round(1.2 * unit))
    for colour, which in ((SAMPLE, ~bad), (OUT, bad)):
        p = np.rint(places[which]).astype(int)
        p = p[(p >= 0).all(axis=1) & (p[:, 0] < w - wide) & (p[:, 1] < h - wide)]
        for i in range(wide):
            for j in range(wide):
                out[p[:, 1] + j, p[:, 0] + i] = colour


def _spacing(index: NDArray[Any], places: F64) -> float:
    """Median distance of corners that are neighbours in a row, drawn pixels."""
    if len(index) < 2:
        return 20.0
    order = np.lexsort((index[:, 0], index[:, 1]))
    i, p = index[order], places[order]
    beside = (np.diff(i[:, 1]) == 0) & (np.diff(i[:, 0]) == 1)
    return float(np.median(np.hypot(*np.diff(p, axis=0)[beside].T))) if beside.any() else 20.0


def _rows(out: U8, index: NDArray[Any], places: F64) -> None:
    for row in np.unique(index[:, 1]) if len(index) else ():
        mine = np.flatnonzero(index[:, 1] == row)
        mine = mine[np.argsort(index[mine, 0])]
        for a, b in pairwise(mine):
            if index[b, 0] - index[a, 0] < GAP:
                cv2.line(out, _point(places[a]), _point(places[b]), CORNER, 1, cv2.LINE_AA, SHIFT)


def _axes(out: U8, index: NDArray[Any], places: F64, step: float, unit: float) -> None:
    """Where the numbering begins: the corner nearest to (0, 0), and the board's x and y there."""
    if not len(index):
        return
    first = int(index.sum(axis=1).argmin())
    wide = max(2, round(2.5 * unit))
    for axis, colour in ((0, AXIS_X), (1, AXIS_Y)):
        other = np.flatnonzero((index[:, 1 - axis] == index[first, 1 - axis]) & (index[:, axis] > index[first, axis]))
        if len(other):
            way = places[other[index[other, axis].argmin()]] - places[first]
            tip = places[first] + 1.5 * step * way / max(float(np.hypot(*way)), 1e-9)
            cv2.arrowedLine(out, _round(places[first]), _round(tip), colour, wide, cv2.LINE_AA, 0, 0.3)
    radius = int(max(0.1 * step, 3 * unit) * 2**SHIFT)
    cv2.circle(out, _point(places[first]), radius, (255, 255, 255), -1, cv2.LINE_AA, SHIFT)


def _cross(out: U8, p: F64, r: float, wide: int) -> None:
    for a, b in (((-r, -r), (r, r)), ((-r, r), (r, -r))):
        cv2.line(out, _point(p + a), _point(p + b), OUT, wide, cv2.LINE_AA, SHIFT)


def _fixed(p: F64) -> NDArray[np.int32]:
    return np.asarray(np.rint(p * 2**SHIFT), dtype=np.int32)


def _point(p: F64) -> tuple[int, int]:
    x, y = np.clip(_fixed(p), -(2**20), 2**20).tolist()
    return x, y


def _round(p: F64) -> tuple[int, int]:
    return round(float(p[0])), round(float(p[1]))
