"""Maps of height over a plane, for any stage: points to square cells, holes filled, outlines between cells.

A frame has its z axis up, away from the substrate and towards the instrument. Row i, column j of a map is the square
cell around (low x + j cell, low y + i cell) of the frame, in mm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np

from fringescope.types import F64, AnyArray, Bool

STEEPEST = 4.0  #: slopes are taken as no steeper than this


@dataclass(frozen=True, eq=False)
class Frame:
    """A plane: its origin (3,) and unit axes in rows (3, 3), the third of them up."""

    origin: F64
    axes: F64

    def local(self, points: AnyArray) -> F64:
        """World points (..., 3) as (x, y, height)."""
        p = np.asarray(points)
        out = np.empty(p.shape)
        x, y, z = (p[..., k] - self.origin[k] for k in range(3))
        for k, (a, b, c) in enumerate(self.axes):
            out[..., k] = a * x + b * y + c * z
        return out

    def world(self, local: AnyArray) -> F64:
        """(x, y, height) (..., 3) as world points."""
        return np.asarray(np.asarray(local, dtype=np.float64) @ self.axes + self.origin)


def frame_at(origin: F64, up: F64) -> Frame:
    """The frame at a point whose z axis is `up` and whose x axis lies as near to the world's as it can."""
    z = up / np.linalg.norm(up)
    x = np.eye(3)[0] if abs(z[0]) < 0.9 else np.eye(3)[1]
    x = x - (x @ z) * z
    x /= np.linalg.norm(x)
    return Frame(np.asarray(origin, dtype=np.float64), np.stack([x, np.cross(z, x), z]))


@dataclass(frozen=True, eq=False)
class Layout:
    """Where the cells of a map are: middle of the first one (2,), rows and columns, side in mm."""

    low: F64
    shape: tuple[int, int]
    cell_mm: float

    @property
    def area_mm2(self) -> float:
        """Of one cell."""
        return self.cell_mm**2

    def cells(self, xy: AnyArray) -> AnyArray:
        """Flat cell numbers (n,) of points (n, 2); -1 outside."""
        j = np.rint((xy[:, 0] - self.low[0]) / self.cell_mm).astype(np.int64)
        i = np.rint((xy[:, 1] - self.low[1]) / self.cell_mm).astype(np.int64)
        h, w = self.shape
        return np.where((j >= 0) & (i >= 0) & (j < w) & (i < h), i * w + j, -1)

    def places(self) -> tuple[F64, F64]:
        """x and y of the middles of all cells, each (h, w)."""
        h, w = self.shape
        x, y = np.meshgrid(self.low[0] + self.cell_mm * np.arange(w), self.low[1] + self.cell_mm * np.arange(h))
        return x, y


def layout(xy: F64, least_mm: float = 0.0, per_cell: float = 2.5, most: int = 400) -> Layout:
    """Cells for points (n, 2): about `per_cell` points in each, not smaller than `least_mm`, `most` along a side."""
    few = xy[:: max(1, len(xy) // 40_000)]
    low, high = (np.array([f(xy[:, 0]), f(xy[:, 1])]) for f in (np.min, np.max))
    size = np.maximum(high - low, 1e-6)
    coarse = max(float(size.max()) / 48, 1e-6)
    at = ((few - low) / coarse).astype(np.int64)
    counts = np.bincount(at[:, 1] * (int(at[:, 0].max()) + 1) + at[:, 0])
    density = float(np.median(counts[counts > 0])) / coarse**2 * len(xy) / len(few)
    cell = max(math.sqrt(per_cell / density), float(size.max()) / most, least_mm)
    shape = (math.ceil(size[1] / cell) + 3, math.ceil(size[0] / cell) + 3)
    return Layout(low - cell, shape, cell)


@dataclass(frozen=True, eq=False)
class HeightMap:
    """Mean height of the points of each cell, at its middle: arrays (h, w), NaN where there is no point.

    `sigma` is the standard deviation of the height that the points' noise makes, `slope` the size of the gradient.
    """

    frame: Frame
    layout: Layout
    height: F64
    sigma: F64
    slope: F64

    @property
    def seen(self) -> Bool:
        """(h, w), true where there are points."""
        return np.isfinite(self.height)


def height_map(frame: Frame, where: Layout, local: F64, sigma_up: F64, gradient: F64) -> HeightMap:
    """Points (n, 3) of a frame, standard deviations of their heights (n,) and gradients (n, 2), as a map.

    The mean height of a cell's points is carried from their mean place to the cell's middle along their mean gradient.
    """
    n = where.shape[0] * where.shape[1]
    at = where.cells(local[:, :2])
    if (at < 0).any():
        ok = at >= 0
        at, local, sigma_up, gradient = at[ok], local[ok], sigma_up[ok], gradient[ok]
    count = np.bincount(at, minlength=n)

    def mean(v: AnyArray) -> F64:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.bincount(at, v, n) / count)

    w = where.shape[1]
    x = where.low[0] + where.cell_mm * (np.arange(n) % w)
    y = where.low[1] + where.cell_mm * (np.arange(n) // w)
    gx, gy = mean(gradient[:, 0]), mean(gradient[:, 1])
    height = mean(local[:, 2]) - gx * (mean(local[:, 0]) - x) - gy * (mean(local[:, 1]) - y)
    with np.errstate(invalid="ignore", divide="ignore"):
        sigma = np.sqrt(mean(sigma_up**2) / count)
    maps = (a.reshape(where.shape) for a in (height, sigma, np.hypot(gx, gy)))
    return HeightMap(frame, where, *maps)


def gradients(frame: Frame, normals: AnyArray) -> F64:
    """Slopes (n, 2) dz/dx, dz/dy of surfaces with unit normals (n, 3), at most STEEPEST; 0 without a normal."""
    n = [sum(np.asarray(normals)[:, k] * axis[k] for k in range(3)) for axis in frame.axes]
    level = np.hypot(n[0], n[1])
    with np.errstate(invalid="ignore", divide="ignore"):
        scale = -np.minimum(1.0 / np.abs(n[2]), STEEPEST / level) * np.where(n[2] < 0, -1.0, 1.0)
        scale = np.where(level > 0, scale, 0.0)
        return np.stack([np.nan_to_num(n[0] * scale), np.nan_to_num(n[1] * scale)], 1)


def filled(height: F64, rounds: int = 24) -> F64:
    """The map (h, w) with holes filled: smoothly from their rims, then as a stretched skin (Laplace). Needs one cell.
    """
    seen = np.isfinite(height)
    if seen.all():
        return height
    out = _pulled(np.where(seen, height, 0.0), seen.astype(np.float64))
    cross = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]) / 4.0
    for _ in range(rounds):
        out = np.where(seen, height, cv2.filter2D(out, -1, cross, borderType=cv2.BORDER_REPLICATE))
    return out


def _pulled(value: F64, weight: F64) -> F64:
    """Weighted values where there are some; elsewhere those of the next coarser level, so on upwards."""
    h, w = value.shape
    if min(h, w) < 2 or (weight > 0).all():
        return np.asarray(np.where(weight > 0, value, value.sum() / max(float((weight > 0).sum()), 1.0)))
    small_w = cv2.pyrDown(weight)
    small = cv2.pyrDown(value * weight)
    coarse = _pulled(np.where(small_w > 0, small / np.maximum(small_w, 1e-12), 0.0), np.minimum(4 * small_w, 1.0))
    up = cv2.pyrUp(coarse, dstsize=(w, h))
    return np.asarray(np.where(weight > 0, value, up))


def enclosed(seen: Bool, reach: int) -> Bool:
    """Cells that were seen or lie in a hole, not outside: gaps up to twice `reach` cells wide lead nowhere."""
    k = 2 * reach + 1
    padded = np.pad(seen.astype(np.uint8), k)
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (k, k))
    closed = cv2.morphologyEx(padded, cv2.MORPH_CLOSE, disc)
    outside = np.zeros((closed.shape[0] + 2, closed.shape[1] + 2), np.uint8)
    flooded = closed.copy()
    cv2.floodFill(flooded, outside, (0, 0), 2)
    return np.asarray(flooded[k:-k, k:-k] != 2) | seen


def pieces(mask: Bool) -> tuple[int, AnyArray, AnyArray]:
    """Connected pieces (by sides): how many, labels (h, w) from 1, cells of each (0 = outside)."""
    n, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return n - 1, labels, stats[:, cv2.CC_STAT_AREA]


def outline(where: Layout, height: F64, inside: Bool, level: float, steep: float | None = None) -> F64:
    """Places (n, 2) between cells inside and their neighbours outside where the height crosses `level`.

    Halfway where the heights do not say. Where the surface is steeper than 45 degrees the cell inside straddles a wall:
    then, if `steep` is given, that share of the way to the neighbour (below 0: back into the cell).
    """
    found = []
    h, w = inside.shape
    top = cv2.dilate(np.where(inside, height, -np.inf), np.ones((3, 3), np.uint8))
    for di, dj in ((0, 1), (1, 0)):
        a, b = inside[: h - di, : w - dj], inside[di:, dj:]
        i, j = np.nonzero(a != b)
        za, zb = height[i, j] - level, height[i + di, j + dj] - level
        with np.errstate(invalid="ignore", divide="ignore"):
            t = np.where(za * zb < 0, za / (za - zb), 0.5)
        if steep is not None:
            drop = np.maximum(top[i, j], top[i + di, j + dj]) - np.minimum(za, zb) - level
            t = np.where(drop > 2 * where.cell_mm, np.where(inside[i, j], steep, 1 - steep), t)
        found.append(where.low + where.cell_mm * np.stack([j + t * dj, i + t * di], 1))
    return np.concatenate(found)


def surface_area(where: Layout, height: F64, inside: Bool) -> float:
    """Area, mm^2, of the triangles between the middles of cells, times their share of what is `inside`."""
    z = np.where(np.isfinite(height), height, 0.0)
    c = where.cell_mm
    a, b, d, e = z[:-1, :-1], z[:-1, 1:], z[1:, :-1], z[1:, 1:]
    first = np.sqrt(1 + ((b - a) / c) ** 2 + ((e - b) / c) ** 2)
    second = np.sqrt(1 + ((e - d) / c) ** 2 + ((d - a) / c) ** 2)
    m = inside.astype(np.float64)
    share = (m[:-1, :-1] + m[:-1, 1:] + m[1:, :-1] + m[1:, 1:]) / 4
    return float((share * (first + second) / 2).sum()) * c * c


def bridged(height: F64, rounds: int = 24) -> tuple[F64, F64]:
    """The map (h, w) with holes filled, and how far (h, w) the true heights may lie from that, mm; 0 where seen.

    What is not seen lies behind something that is, rather low than high: between the stretched skin (see `filled`) and
    the lowest place on the hole's rim, a quarter of the way down; a fifth of the way is the standard deviation.
    """
    seen = np.isfinite(height)
    if seen.all() or not seen.any():
        return np.nan_to_num(height), np.zeros_like(height)
    skin = filled(height, rounds)
    low = np.where(seen, height, np.inf)
    kernel = np.ones((3, 3), np.uint8)
    for _ in range(8):
        low = np.where(seen, height, cv2.erode(low, kernel))
    below = np.where(~seen & np.isfinite(low), np.maximum(skin - low, 0.0), 0.0)
    return skin - below / 4, np.asarray(np.where(seen, 0.0, below / 5 + 0.02))
