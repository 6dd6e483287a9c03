"""Where a cut ran: the centre line of a kerf, the rim of anything wider."""

from __future__ import annotations

import cv2
import numpy as np

from fringescope import heights
from fringescope.heights import Frame, Layout
from fringescope.types import F64, Bool

_MOST_CUT = 4000  #: points of a cut at most
EDGE_MM = 1.5  #: so near to the specimen's own edge a rim is not the cut's
HOLE_MM2 = 10.0  #: smaller unchanged places within a cut have no rim


def cut_line(
    width_mm: float | None, core: Bool, frame: Frame, where: Layout, smooth: F64, limit: F64, full_a: F64,
    domain: Bool, grounded: bool,
) -> F64:  # fmt: skip
    """Where a cut ran, (n, 3) world mm on the first surface: the centre line of a kerf of `width_mm`, else the rim.

    Maps (h, w): `core` the changed cells, `smooth` the depth removed, `limit` what counts, `full_a` the first
    surface's height, `domain` what was compared; `grounded`: heights are above a substrate.
    """
    if width_mm is not None:
        xy = _centre_line(where, core, smooth, max(width_mm, 2 * where.cell_mm))
    else:
        square = np.ones((5, 5), np.uint8)
        deep = cv2.dilate(np.where(core, smooth, 0.0), square)
        wall = deep > limit + 2 * where.cell_mm  # steeper than 45 degrees
        level = np.where(wall, np.maximum(limit, 0.5 * deep), limit)  # half way down a wall
        border = cv2.erode(core.astype(np.uint8), np.ones((7, 7), np.uint8)) == 0
        core = _without_small_holes(core & ~(border & (smooth < level)), HOLE_MM2 / where.area_mm2)
        xy = heights.outline(where, smooth - level, core, 0.0)
        ij = np.rint((xy - where.low) / where.cell_mm).astype(int)
        around = np.asarray(cv2.dilate(core.astype(np.uint8), np.ones((7, 7), np.uint8)) > 0) & ~core & domain
        if grounded:  # the specimen's own edge is no cut
            n = 2 * max(1, round(EDGE_MM / where.cell_mm)) + 1
            around &= cv2.erode((domain & (full_a > 0.1)).astype(np.uint8), np.ones((n, n), np.uint8)) > 0
        beside = np.asarray(cv2.dilate(around.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
        h, w = where.shape
        xy = xy[beside[np.clip(ij[:, 1], 0, h - 1), np.clip(ij[:, 0], 0, w - 1)]]
    step = max(1, len(xy) // _MOST_CUT)
    xy = xy[::step]
    return frame.world(np.column_stack([xy, sampled(full_a, where, xy)]))


def _without_small_holes(core: Bool, cells: float) -> Bool:
    n, labels, area = heights.pieces(~core)
    small = np.flatnonzero(area[1:] < cells) + 1 if n else np.zeros(0, np.int64)
    return np.asarray(core | np.isin(labels, small))


def sampled(values: F64, where: Layout, xy: F64) -> F64:
    """Bilinear values (n,) of a map at places (n, 2) in it."""
    h, w = values.shape
    x, y = ((xy - where.low) / where.cell_mm).T
    j = np.clip(x.astype(int), 0, w - 2)
    i = np.clip(y.astype(int), 0, h - 2)
    a, b = np.clip(x - j, 0, 1), np.clip(y - i, 0, 1)
    upper = (1 - a) * values[i, j] + a * values[i, j + 1]
    return np.asarray((1 - b) * upper + b * ((1 - a) * values[i + 1, j] + a * values[i + 1, j + 1]))


def _centre_line(where: Layout, core: Bool, depth: F64, width: float) -> F64:
    """Places (n, 2) on the middle of a kerf: cells moved, across it, to the mean of what was removed around them."""
    from scipy.spatial import cKDTree

    i, j = np.nonzero(core)
    xy = where.low + where.cell_mm * np.stack([j, i], 1)
    weight = np.clip(depth[i, j], 0, np.quantile(depth[i, j], 0.8))
    tree = cKDTree(xy)
    at = xy[:: max(1, len(xy) // 600)].copy()
    for _ in range(3):
        sure = np.zeros(len(at), dtype=bool)
        for reach in (1.2 * width, 2.2 * width):  # a wider look where the kerf ends, which is as wide as long
            left = np.flatnonzero(~sure)
            for k, these in zip(left, tree.query_ball_point(at[left], reach), strict=True):
                p, w = xy[these], weight[these]
                mean = (p * w[:, None]).sum(0) / max(float(w.sum()), 1e-12)
                d = p - mean
                values, vectors = np.linalg.eigh((d * w[:, None]).T @ d)
                across = vectors[:, 0]
                sure[k] = values[1] > 2 * values[0]
                if sure[k]:
                    at[k] += across * float(across @ (mean - at[k]))
    return at[sure] if sure.any() else at
