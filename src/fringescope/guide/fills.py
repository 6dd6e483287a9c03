"""What is filled: regions and letters, as shares of the device's pixels; and the area of regions on the tissue."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fringescope import geometry
from fringescope.guide.relief import Relief
from fringescope.guide.tissue import Tissue
from fringescope.types import F32, F64, Layout, Projector

FINE = 4  #: samples along each side of a unit
BITS = 4  #: fractions of a pixel in OpenCV's coordinates
CHECKED = 512  #: pixels along the longer side of an outline that is asked whether it crosses itself


@dataclass(frozen=True, eq=False)
class Patch:
    """Shares (h, w) float32 of the device's pixels in rows from `top` and columns from `left` on."""

    top: int
    left: int
    share: F32


def inside(rings: Sequence[F64], low: Any, size: tuple[int, int], union: bool = False) -> F32:
    """Share of each unit that lies inside polygons, from unit `low` (u, v) on: `size` = (rows, columns).

    By the even-odd rule; with `union` what lies in any of them.
    """
    fine = np.zeros((size[0] * FINE, size[1] * FINE), np.uint8)
    scaled = [
        np.round(((ring - low + 0.5) * FINE - 0.5) * (1 << BITS)).clip(-(2**30), 2**30).astype(np.int32)
        for ring in rings
    ]
    for some in ([x] for x in scaled) if union else (scaled,):
        cv2.fillPoly(fine, some, 1, cv2.LINE_8, BITS)
    return np.asarray(cv2.resize(fine.astype(np.float32), size[::-1], interpolation=cv2.INTER_AREA), np.float32)


def crosses_itself(ring: F64) -> bool:
    """Whether a closed polygon (n, 2) goes round a part of what it encloses twice, or the other way round.

    Then its area by its corners is not that of what is inside; slips of less than 2 % do not count. NaN is left out.
    """
    p = ring[np.isfinite(ring).all(1)]
    if len(p) < 3:
        return False
    low, size = p.min(0), float(np.ptp(p, axis=0).max())
    if size == 0.0:
        return False
    q = (p - low) * (CHECKED / size) + 1
    mask = np.zeros((CHECKED + 3, CHECKED + 3), np.uint8)
    cv2.fillPoly(mask, [np.round(q * (1 << BITS)).astype(np.int32)], 1, cv2.LINE_8, BITS)
    after = np.roll(q, -1, 0)
    corners = 0.5 * abs(float((q[:, 0] * after[:, 1] - q[:, 1] * after[:, 0]).sum()))
    around = float(np.linalg.norm(after - q, axis=1).sum())  # its pixels count as inside, half of each wrongly
    filled = float(np.count_nonzero(mask))
    return abs(corners - filled) > 0.02 * max(corners, filled) + around


def lit(share: F32, low: Any, projector: Projector, relief: Relief) -> Patch:
    """Shares of units of the plane, where there is a surface to receive them, as shares of the device's pixels."""
    rows, columns = share.shape
    there = np.isfinite(relief.depth[low[1] : low[1] + rows, low[0] : low[0] + columns])
    return device_patch(share * there, low, projector)


def device_patch(share: F32, low: Any, projector: Projector) -> Patch:
    """Shares of units of the plane, from unit `low` (u, v) on, as shares of the device's pixels."""
    left, top = int(low[0]), int(low[1])
    if projector.layout is Layout.GRID:
        return Patch(top, left, share)
    # a mirror |du| + |dv| <= 1 covers its own unit, and a quarter of each of the four around
    cover = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], np.float32) / 8
    soft = cv2.filter2D(share, -1, cover, borderType=cv2.BORDER_CONSTANT)
    first = left // 2
    out = np.zeros((share.shape[0], (left + share.shape[1] - 1) // 2 - first + 1), np.float32)
    for r in range(share.shape[0]):
        shift = (top + r) % 2
        u = 2 * (first + np.arange(out.shape[1])) + shift - left
        ok = (u >= 0) & (u < share.shape[1])
        out[r, ok] = soft[r, u[ok]]
    return Patch(top, first, out)


def in_photograph(pixels: F64, camera: str, tissue: Tissue) -> tuple[F32, Any] | None:
    """Which units of the plane light what lies inside a polygon (n, 2) of a photograph: shares, and the first (u, v).

    A unit counts where its place on the surface lies in the polygon and the camera saw that very place.
    """
    number = tissue.number(camera)
    grid = tissue.grids[number]
    device = tissue.rig.cameras[grid.view]
    H, W = grid.reasons.shape
    low = np.clip(np.floor(pixels.min(0)) - 1, 0, [W - 1, H - 1]).astype(int)
    high = np.clip(np.ceil(pixels.max(0)) + 1, 0, [W - 1, H - 1]).astype(int)
    size = (int(high[1] - low[1] + 1), int(high[0] - low[0] + 1))
    share = inside([pixels], low, size)
    part = (slice(low[1], high[1] + 1), slice(low[0], high[0] + 1))
    seen = (grid.reasons[part] == 0) & (share > 0)
    if not seen.any():
        return None
    points = grid.xyz[part][seen][:: max(1, int(seen.sum()) // 20_000)]
    uv = geometry.project(tissue.rig.projector, points.astype(np.float64))
    w, h = tissue.rig.projector.plane_size
    a = np.clip(np.floor(np.nanmin(uv, 0)) - 3, 0, [w - 1, h - 1]).astype(int)
    b = np.clip(np.ceil(np.nanmax(uv, 0)) + 3, 0, [w - 1, h - 1]).astype(int)
    v, u = np.meshgrid(np.arange(a[1], b[1] + 1.0), np.arange(a[0], b[0] + 1.0), indexing="ij")
    place = tissue.relief.at(np.stack([u.ravel(), v.ravel()], 1))
    at = geometry.project(device, place)
    x, y = (at - low).astype(np.float32).T
    with np.errstate(invalid="ignore"):
        x, y = (np.nan_to_num(a, nan=-9).reshape(u.shape) for a in (x, y))
        out = cv2.remap(share, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0).ravel()
        off = ~((at >= -0.5).all(1) & (at[:, 0] < W - 0.5) & (at[:, 1] < H - 0.5))
    c, r = np.floor(np.where(off[:, None], 0, at) + 0.5).astype(np.intp).T
    near = np.linalg.norm(grid.xyz[r, c] - place, axis=1)
    same = (grid.reasons[r, c] == 0) & (near < 0.5 + 4 * tissue.footprints[number])
    lone = (grid.reasons[r, c] != 0) & tissue.supported(np.nan_to_num(place), camera)
    there = np.isfinite(place).all(1)
    seen = (~off & (same | lone) & there).reshape(u.shape)
    whole = cv2.morphologyEx(seen.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))  # specks of noise
    out[~(seen | (whole > 0)).ravel() | ~there] = 0
    return out.reshape(u.shape), a


def area(share: F32, low: Any, relief: Relief, outline: F64, sigma_mm: float) -> tuple[float, float, float]:
    """Area on the tissue of what units cover, mm^2, its standard deviation, and the share of it that is not measured.

    `outline` (n, 3): the border; each half millimetre of it errs on its own by `sigma_mm` sideways.
    """
    rows, columns = share.shape
    part = (slice(low[1], low[1] + rows), slice(low[0], low[0] + columns))
    size = relief.area[part]
    known = np.isfinite(size) & (share > 0)
    total = float((share * np.where(known, size, 0)).sum())
    whole = float(share.sum())
    missing = float(share[(share > 0) & ~known].sum()) / whole if whole else 0.0
    around = float(np.nansum(np.linalg.norm(np.diff(np.vstack([outline, outline[:1]]), axis=0), axis=1)))
    filled = total / max(1 - missing, 1e-3)
    return filled, math.hypot(sigma_mm * math.sqrt(max(around, 0.5) * 0.5), 0.5 * (filled - total)), missing
