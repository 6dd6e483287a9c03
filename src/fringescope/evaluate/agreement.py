"""Do the views agree? The distance between the surfaces that two cameras see, without any truth.

A rig that has drifted, or was never right, shows here: the same tissue appears at two depths, smoothly over the field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fringescope import geometry
from fringescope.evaluate.statistics import plain
from fringescope.types import F64, Grid, Rig

WINDOW = 5  #: pixels, side of the window that is averaged
STEEPEST = 3.0  #: depth over sideways distance within a window; more is a jump
TILES = (6, 8)  #: rows and columns of tiles in which the systematic part is looked for
LEAST = 30  #: points of a tile whose median counts


@dataclass(frozen=True)
class PairAgreement:
    """One camera's surface against another's: points compared, in um the median distance and its systematic part."""

    cameras: tuple[str, str]
    points: int
    median_um: float  #: of absolute distances
    shift_um: float  #: median of signed distances, positive where the first camera's surface is nearer to it
    systematic_um: float  #: see `systematic_part`


@dataclass(frozen=True)
class Agreement:
    """All pairs of views: median of absolute distances and systematic part in um; None where no views overlap.

    `one_view_um` is the share of each of the two surfaces in that distance, as for errors that are independent: the
    median over the square root of two.
    """

    median_um: float | None
    one_view_um: float | None
    systematic_um: float | None
    pairs: tuple[PairAgreement, ...]

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return plain(self)


def agreement(grids: Sequence[Grid], rig: Rig, window: int = WINDOW) -> Agreement:
    """Distances between the views' surfaces, each averaged over `window` x `window` points, along the normal."""
    smooth = {g.view: _averaged(g, rig, window) for g in grids}
    pairs, every = [], []
    for a, b in permutations(grids, 2):
        found = _distances(smooth[a.view], smooth[b.view], rig, b.view, a.view)
        if found is None:
            continue
        (rows, columns), d = found
        systematic = systematic_part(rows, columns, d, a.reasons.shape)
        pairs.append(
            PairAgreement(
                (a.camera, b.camera), len(d), 1e3 * float(np.median(np.abs(d))), 1e3 * float(np.median(d)),
                1e3 * systematic,
            )
        )  # fmt: skip
        every.append(d)
    if not pairs:
        return Agreement(None, None, None, ())
    n = np.array([p.points for p in pairs], dtype=float)
    systematic_um = float(np.sqrt(np.average([p.systematic_um**2 for p in pairs], weights=n)))
    median_um = 1e3 * float(np.median(np.abs(np.concatenate(every))))
    return Agreement(median_um, median_um / math.sqrt(2.0), systematic_um, tuple(pairs))


def systematic_part(rows: NDArray[np.intp], columns: NDArray[np.intp], error: F64, shape: tuple[int, ...]) -> float:
    """Median over tiles of a picture of `shape` of the size of each tile's signed median: what noise cannot make."""
    tile = rows * TILES[0] // shape[0] * TILES[1] + columns * TILES[1] // shape[1]
    medians = [np.median(error[tile == t]) for t in np.unique(tile) if (tile == t).sum() >= LEAST]
    return float(np.median(np.abs(medians or np.median(error))))


def _averaged(grid: Grid, rig: Rig, window: int) -> F64:
    """Means (H, W, 3) of the points of each full window on one surface; NaN elsewhere."""
    camera = rig.cameras[grid.view]
    depth = geometry.transform(camera.pose, grid.xyz)[..., 2]
    ok = grid.valid & np.isfinite(depth)
    full = cv2.erode(ok.astype(np.uint8), np.ones((window, window), np.uint8), borderValue=0).astype(bool)
    filled = np.where(ok, depth, 0.0).astype(np.float32)
    kernel = np.ones((window, window), np.uint8)
    rise = cv2.dilate(filled, kernel) - cv2.erode(filled, kernel)
    side = (window - 1) * filled / min(camera.lens.K[0, 0], camera.lens.K[1, 1])
    points = np.where(ok[..., None], grid.xyz, 0).astype(np.float64)
    mean: F64 = cv2.blur(points, (window, window)).astype(np.float64)
    mean[~(full & (rise <= STEEPEST * side))] = np.nan
    return mean


def _distances(P: F64, Q: F64, rig: Rig, other: int, own: int) -> tuple[tuple[Any, Any], F64] | None:
    """Pixels of P and signed distances, mm, along Q's normal to the surface that Q's camera sees through its pixels."""
    rows, columns = np.nonzero(np.isfinite(P[..., 0]))
    if not len(rows):
        return None
    p = P[rows, columns]
    uv = geometry.project(rig.cameras[other], p)
    h, w = Q.shape[:2]
    with np.errstate(invalid="ignore"):
        inside = (uv[:, 0] >= 0) & (uv[:, 1] >= 0) & (uv[:, 0] < w - 1) & (uv[:, 1] < h - 1)
    rows, columns, p, uv = rows[inside], columns[inside], p[inside], uv[inside]
    x0, y0 = uv[:, 0].astype(int), uv[:, 1].astype(int)
    fx, fy = (uv[:, 0] - x0)[:, None], (uv[:, 1] - y0)[:, None]
    a, b, c, d = Q[y0, x0], Q[y0, x0 + 1], Q[y0 + 1, x0], Q[y0 + 1, x0 + 1]
    q = (1 - fy) * ((1 - fx) * a + fx * b) + fy * ((1 - fx) * c + fx * d)
    normal = np.cross(b - a + d - c, c - a + d - b)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= length
    away = p - geometry.centre(rig.cameras[own].pose)
    normal *= np.sign(np.einsum("ij,ij->i", normal, away))[:, None]
    s = np.einsum("ij,ij->i", q - p, normal)
    reach = 2 * np.sqrt(0.5 * np.nan_to_num(length[:, 0]))  # mm: a surface farther off than this is another one
    with np.errstate(invalid="ignore"):
        ok = np.isfinite(s) & (np.abs(s) < np.maximum(reach, 0.5))
    return ((rows[ok], columns[ok]), s[ok]) if ok.any() else None
