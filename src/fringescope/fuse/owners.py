"""Who owns a place: a raster over the projector's field, in which all views meet, and the doubles across its borders.

Every point is lit by the projector, so the surface is single-valued over its field: cells of it, about two samples
wide, each belong to the view with the largest smoothed weight among those with a point there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fringescope import geometry, memory
from fringescope.kernels import fusing
from fringescope.kernels import ownership as k
from fringescope.settings import FuseSettings
from fringescope.types import F32, F64, U8, AnyArray, Bool, Grid, Pose, Rig

_GROUP = 5  # cells; weights are averaged over three groups before ownership is settled
_THIN = 300_000  # pixels that suffice to tell a view's weights, which are smooth
_SAMPLES = 60_000  # pixels of a view that tell where it is
EDGE = 128  #: bit of a cell near those of other views
_REACH = (5, 5)  # cells around a border in which doubles are looked for, after points have moved


@dataclass(frozen=True, eq=False)
class Raster:
    """Cells over the projector's ideal coordinates: those of a cell are `low` + `cell` * (column, row)."""

    pose: Pose
    low: F64
    cell: float
    shape: tuple[int, int]
    depth: float  #: mm from the projector, of the nearest view
    separation: float  #: least distance of points of different views, ideal coordinates

    @property
    def vector(self) -> F64:
        """As kernels take it (15,): see `surface.locate`."""
        return np.concatenate([geometry.pose_vector(self.pose), self.low, [1.0 / self.cell]])


def _sample(grid: Grid) -> F64:
    """Some of a view's points (n, 3); none only if it has none."""
    H, W = grid.sigma.shape
    for step in (max(1, math.ceil(math.sqrt(H * W / _SAMPLES))), 1):
        p = grid.xyz[::step, ::step].reshape(-1, 3)
        p = p[np.isfinite(p[:, 0])]
        if len(p):
            break
    return p.astype(np.float64)


def raster_of(grids: Sequence[Grid], spacings: Sequence[float], rig: Rig, s: FuseSettings) -> Raster:
    """The raster for views of which one has a point at least."""
    pose = rig.projector.pose
    seen = [geometry.transform(pose, p) for p in map(_sample, grids)]
    depth = min(float(np.median(q[:, 2])) for q in seen if len(q))
    spacing = max(x for x, q in zip(spacings, seen, strict=True) if len(q))
    separation = max(s.separation_mm, 0.5 * spacing) / depth
    cell = max(2.0 * spacing / depth, 1.01 * separation)
    q = np.concatenate(seen)
    ab = q[:, :2] / q[:, 2:]
    low, high = ab.min(axis=0) - cell, ab.max(axis=0) + cell
    cols, rows = (np.floor((high - low) / cell).astype(int) + 1).tolist()
    return Raster(pose, low, cell, (rows, cols), depth, separation)


def settle_owners(sides: Sequence[fusing.Side], limits: fusing.Limits, raster: Raster, there: U8) -> U8:
    """One plus the view that owns each cell (rows, cols), 0 if none; with EDGE where others own cells near by.

    `there` (V, rows, cols) tells which views have points in a cell.
    """
    rows, cols = raster.shape
    h, w = -(-rows // _GROUP), -(-cols // _GROUP)
    score = np.empty((len(sides), h + 2, w + 2), np.float32)
    for i, side in enumerate(sides):
        step = min(max(1, int(math.sqrt(side.height * side.width / _THIN))), 4)
        shape = (-(-side.height // step), -(-side.width // step))
        weight, row, column = np.empty(shape, np.float32), np.empty(shape, np.int32), np.empty(shape, np.int32)
        fusing.thinned(side, limits, step, raster.vector, rows, cols, weight, row, column)
        total, count = np.zeros((h, w)), np.zeros((h, w))
        k.bin_weights(weight.reshape(-1), row.reshape(-1), column.reshape(-1), _GROUP, total, count)
        smooth = cv2.blur(total, (3, 3)) / np.maximum(cv2.blur(count, (3, 3)), 1e-9)
        score[i] = np.pad(smooth, 1, mode="edge")
    owner = np.empty(raster.shape, np.uint8)
    k.owners(there, score, _GROUP, owner)
    window = np.ones(_REACH, np.uint8)
    low = cv2.erode(np.where(owner == 0, np.uint8(255), owner), window)
    owner[low < cv2.dilate(owner, window)] |= EDGE
    return owner


def bits_of(view: int) -> U8:
    """The marks (256,) of points of view number `view` in cells of each number that `settle_owners` gives."""
    out = np.full(256, fusing.POINT, np.uint8)
    out[view + 1] |= fusing.OWNED
    out[view + 1 | EDGE] |= fusing.OWNED | fusing.EDGE
    return out


def drop_doubles(xyz: F32, normal: F32, view: AnyArray, raster: Raster, s: FuseSettings) -> Bool:
    """Which points (n,) near borders lie within the separation of another view's point that stays."""
    if not len(xyz):
        return np.zeros(0, np.bool_)
    rows, cols = raster.shape
    ab, index = memory.empty((len(xyz), 2), np.float64), memory.empty((len(xyz),), np.int64)
    k.place(xyz, raster.vector, rows, cols, ab, index)
    start, order = np.zeros(rows * cols + 2, np.int32), memory.empty((len(index),), np.int64)
    k.sort_cells(index, start, order)
    out = np.zeros(len(index), np.bool_)
    k.doubles(ab, xyz, normal, view, raster.separation, 1.05 * s.separation_mm, 3 * raster.cell * raster.depth, index,
              rows, cols, start, order, out)
    return out
