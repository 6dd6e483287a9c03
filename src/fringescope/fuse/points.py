"""Organised grids to one cloud: what the views agree on, who owns a place, what colour it has (III-C end, Fig. 12).

Ownership comes first, from the views as they are; then only what is owned is fused, straight into the cloud.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from fringescope import geometry, memory
from fringescope.errors import EmptyResultError, RigError
from fringescope.fuse.owners import Raster, bits_of, drop_doubles, raster_of, settle_owners
from fringescope.fuse.photo import LIGHT, SRGB, is_grey, samples_of, view_gains
from fringescope.kernels import colour as colours
from fringescope.kernels import fusing, ownership
from fringescope.kernels import surface as k
from fringescope.kernels.views import constant
from fringescope.settings import FuseSettings
from fringescope.types import F32, F64, U8, AnyArray, Bool, Camera, Cloud, Grid, Photo, Rig

MOST = 8  #: views that are fused
_SAMPLES = 60_000  # pixels of a view that tell its sampling
_NEAR = 3  # squares of `fusing.TILE` pixels: a picture is blended so far around what the view owns (and back)


@dataclass(frozen=True, eq=False)
class Fused:
    """All views after fusion. One entry per view, in the order of the grids.

    `cloud` holds the fused points, view by view, row by row: those pixels of each view that make the one layer, on
    their own rays. `seen` (n,) has bit v set where view number v (in this order) sees the point too. `grids` are the
    views as they came; `marks` (H, W) have bit 1 where a view owns its pixel. `pictures` (H, W, 3) are sRGB: blended
    from all views where the view owns the place and 32 pixels around at least, elsewhere the view's own, balanced.
    `spacing_mm` is each view's median sampling on the surface.
    """

    cloud: Cloud
    seen: U8
    grids: tuple[Grid, ...]
    marks: tuple[U8, ...]
    pictures: tuple[U8, ...]
    spacing_mm: tuple[float, ...]
    gains: F64  #: (V, 3) factors that balance the pictures

    @property
    def owned(self) -> tuple[Bool, ...]:
        """Which pixels (H, W) of each view make the single layer of the cloud."""
        return tuple(np.asarray((m & fusing.OWNED) != 0) for m in self.marks)


def _check(grids: Sequence[Grid], photos: Sequence[Photo], rig: Rig) -> None:
    if len(grids) != len(photos):
        raise RigError(f"{len(grids)} grids and {len(photos)} pictures; needed one picture per grid, in the same order")
    if not 1 <= len(grids) <= MOST:
        raise RigError(f"{len(grids)} views; fusion takes 1 to {MOST}")
    for g, p in zip(grids, photos, strict=True):
        if not 0 <= g.view < len(rig.cameras):
            raise RigError(f"view {g.view} of camera '{g.camera}'; the rig has {len(rig.cameras)} cameras")
        if g.camera != p.camera:
            raise RigError(f"points of camera '{g.camera}' with the picture of '{p.camera}'; needed the same order")
        if g.sigma.shape != p.rgb.shape[:2]:
            raise RigError(f"camera '{g.camera}': points on {g.sigma.shape[1]} x {g.sigma.shape[0]} pixels, picture of "
                           f"{p.rgb.shape[1]} x {p.rgb.shape[0]}; needed the same size")
    bands = (g.reasons[i : i + 256] for g in grids for i in range(0, len(g.reasons), 256))
    if not any(bool((band == 0).any()) for band in bands):
        raise EmptyResultError("no view has a single valid point: nothing to fuse; see the reasons per view")


def normals(grid: Grid, rig: Rig, s: FuseSettings | None = None) -> F32:
    """Unit normals (H, W, 3) towards the camera; NaN where there is no point.

    Regression of the points in a window of `normal_radius` on their pixel coordinates, not across jumps.
    """
    s = s or FuseSettings()
    camera = rig.cameras[grid.view]
    out = memory.empty(grid.xyz.shape, np.float32)
    k.normals(*_points(grid), geometry.centre(camera.pose), _angle(camera), s.normal_radius, s.max_slope, s.jump_sigma,
              out)
    return out


def _points(grid: Grid) -> tuple[F32, F32, F32]:
    """xyz (H, W, 3), the same as rows (H, 3 W), sigma: as kernels take them."""
    xyz, sigma = constant(grid.xyz), constant(grid.sigma)
    return xyz, xyz.reshape(len(xyz), -1), sigma


def _angle(camera: Camera) -> float:
    """Least angle between the rays of neighbouring pixels, radians."""
    L = camera.lens
    v, u = np.meshgrid(np.linspace(0, L.height - 1, 9), np.linspace(0, L.width - 1, 9), indexing="ij")
    uv = np.stack([u, v], -1)
    ray = [geometry.world_rays(camera, uv + step)[1] for step in ([0, 0], [1, 0], [0, 1], [1, 1], [1, -1])]
    least = float(np.min([np.linalg.norm(r - ray[0], axis=-1) for r in ray[1:]]))
    return least if math.isfinite(least) else 0.0


def _close(mask: Bool, reach: float) -> Bool:
    """The mask with holes narrower than twice `reach` pixels closed; outside the picture there is none."""
    margin = math.ceil(reach) + 1
    hole = np.pad((~mask).astype(np.uint8), margin, constant_values=1)
    grown = (cv2.distanceTransform(hole, cv2.DIST_L2, 5) <= reach).astype(np.uint8)
    inside = cv2.distanceTransform(grown, cv2.DIST_L2, 5)[margin:-margin, margin:-margin]
    return np.asarray(inside > reach) | mask


def _rise(mask: Bool, width: float) -> F32:
    """0 outside the mask, rising smoothly to 1 at `width` pixels from its border; the picture's edge is a border."""
    padded = cv2.copyMakeBorder(mask.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    d = cv2.distanceTransform(padded, cv2.DIST_L2, 5)[1:-1, 1:-1]
    x = np.clip(d / max(width, 1.0), 0.0, 1.0)
    return np.asarray(x * x * (3 - 2 * x), dtype=np.float32)


def _spacing(grid: Grid) -> float:
    """Median sampling of a view on the surface, mm, from some of its pixels; 0 without neighbours."""
    H, W = grid.sigma.shape
    step = max(1, int(math.sqrt(H * W / _SAMPLES)))
    out: F32 = np.empty((-(-H // step), -(-W // step)), np.float32)
    k.spacing(constant(grid.xyz), step, out)
    found = out[np.isfinite(out)]
    return float(np.median(found)) if len(found) else 0.0


def _side(grid: Grid, photo: Photo, share: float, spacing: float, raster: Raster, there: U8, rig: Rig,
          s: FuseSettings) -> fusing.Side:
    """One view as the sums need it, not balanced yet: normals, and how weights rise from its borders and jumps."""
    camera = rig.cameras[grid.view]
    H, W = grid.sigma.shape
    hole = max(1.0, 0.5 * s.hole_mm / spacing) if spacing > 0 else 1.0
    width = s.blend_mm / spacing if spacing > 0 else 1.0
    step = max(1, int(min(0.5 * hole, width / 20)))  # what rises over hundreds of pixels needs no value in each
    squares, code = np.zeros((-(-H // step), -(-W // step)), np.uint8), memory.empty((H, W), np.int32)
    centre = geometry.centre(camera.pose)
    k.survey(*_points(grid), centre, _angle(camera), s.normal_radius, s.max_slope, s.jump_sigma, squares, step,
             raster.vector, code, there)
    whole = _close((squares & k.SOME) != 0, hole / step) & ((squares & k.TORN) == 0)
    rise = memory.empty((H, W), np.uint8)
    colours.spread(rise, np.pad(_rise(whole, width / step), 1, mode="edge"), step)
    clear = np.zeros(1, np.uint8)
    if photo.saturated.any():
        clear = memory.empty((H, W), np.uint8)
        colours.clearness(constant(photo.saturated), s.highlight_pixels, clear)
    light, channels = samples_of(photo)
    return fusing.Side(
        constant(grid.xyz).reshape(-1), constant(grid.sigma).reshape(-1), constant(code).reshape(-1),
        constant(rise).reshape(-1), light, channels, np.ones(3, np.float32), constant(clear).reshape(-1),
        np.float32(share),
        centre.astype(np.float32), H, W, geometry.pose_vector(camera.pose), geometry.lens_vector(camera.lens),
    )


def _limits(s: FuseSettings) -> fusing.Limits:
    low, high = np.cos(np.radians([s.grazing_deg, s.oblique_deg]))
    numbers = (s.agree_sigma, s.agree_mm, low, 1.0 / max(high - low, 1e-6), s.gloss)
    return fusing.Limits(*(np.float32(x) for x in numbers))


def _starts(counts: Sequence[AnyArray]) -> list[AnyArray]:
    """Where the rows of each view begin (H + 1,) if all views' rows follow each other."""
    out, first = [], 0
    for c in counts:
        out.append(np.concatenate([[first], first + np.cumsum(c)]).astype(np.int64))
        first += int(c.sum())
    return out


def _room(n: int) -> tuple[F32, F32, F32]:
    return memory.empty((n, 3), np.float32), memory.empty((n, 3), np.float32), memory.empty((n,), np.float32)


def _views(grids: Sequence[Grid], counts: Sequence[AnyArray]) -> U8:
    """The view of each point, of so many in each row of each view."""
    out = memory.empty((sum(int(c.sum()) for c in counts),), np.uint8)
    first = 0
    for g, c in zip(grids, counts, strict=True):
        out[first : first + int(c.sum())] = g.view
        first += int(c.sum())
    return out


def merge(grids: Sequence[Grid], photos: Sequence[Photo], rig: Rig, s: FuseSettings | None = None) -> Fused:
    """All views to one layer: on every owned pixel's ray the mean of the views that see the place.

    Weighted by sigma and angle. Each view contributes one sample, not an interpolation of several, so that fusion
    averages over views and never over neighbours. A view's weight rises from nothing at its border, so that no step
    appears there. Views that disagree by more than their sigmas explain do not see the same place. Pixels that their
    view does not own are not fused. `photos` has one picture per grid, in the same order. Raises RigError for views
    that the rig lacks, or of other sizes, EmptyResultError if no view has a valid point.
    """
    s = s or FuseSettings()
    _check(grids, photos, rig)
    V, limits = len(grids), _limits(s)
    with ThreadPoolExecutor(1) as aside:  # one core's work, while others look for normals
        balance = aside.submit(view_gains, grids, photos, rig, s)
        grey = [is_grey(p) for p in photos]
        spacings = [_spacing(g) for g in grids]
        raster = raster_of(grids, spacings, rig, s)
        there: U8 = np.zeros((V, *raster.shape), np.uint8)
        sides = [_side(g, p, 1e-6 if grey[i] and not all(grey) else 1.0, spacings[i], raster, there[i], rig, s)
                 for i, (g, p) in enumerate(zip(grids, photos, strict=True))]
        gains = balance.result()
    sides = [side._replace(gain=gain.astype(np.float32)) for side, gain in zip(sides, gains, strict=True)]
    owner = settle_owners(sides, limits, raster, there)
    del there
    filled = tuple(sides[min(i, V - 1)] for i in range(MOST))  # always as many, so that one kernel does for any number
    marks = [memory.empty(g.sigma.shape, np.uint8) for g in grids]
    squares = [tuple(-(-n // fusing.TILE) for n in g.reasons.shape) for g in grids]
    near = [np.zeros(shape, np.uint8) for shape in squares]
    owned, close = ([np.empty(len(m), np.int64) for m in marks] for _ in range(2))
    for i, g in enumerate(grids):
        ownership.mark(_points(g)[1], raster.vector, owner, bits_of(i), fusing.TILE, marks[i], owned[i], close[i],
                       near[i])
    no_picture, nothing = np.empty((0, 0, 3), np.uint8), np.empty((0, 3), np.uint8)
    starts = _starts(close)
    xyz, normal, sigma = _room(int(starts[-1][-1]))
    for i in range(V):
        fusing.fuse(filled, V, i, limits, marks[i], fusing.EDGE, near[i], starts[i], SRGB, xyz, normal, sigma, nothing,
                    nothing[:, 0], no_picture)
    views = np.repeat(np.arange(V, dtype=np.int16), [int(c.sum()) for c in close])
    gone = drop_doubles(xyz, normal, views, raster, s)
    for i in range(V):
        ownership.unmark(marks[i], fusing.EDGE, starts[i], gone)
        ownership.count_marked(marks[i], fusing.OWNED, owned[i])
    starts = _starts(owned)
    n = int(starts[-1][-1])
    xyz, normal, sigma = _room(n)
    rgb, seen = memory.empty((n, 3), np.uint8), memory.empty((n,), np.uint8)
    pictures = [memory.empty((*m.shape, 3), np.uint8) for m in marks]
    for i in range(V):
        around = cv2.dilate(near[i], np.ones((_NEAR, _NEAR), np.uint8))
        fusing.fuse(filled, V, i, limits, marks[i], fusing.OWNED, around, starts[i], SRGB, xyz, normal, sigma, rgb,
                    seen, pictures[i])
        colours.fill_gaps(marks[i], fusing.BLENDED, around, fusing.TILE, sides[i].rgb, sides[i].channels,
                         sides[i].gain, SRGB, LIGHT, pictures[i])
    view = _views(grids, owned)
    return Fused(Cloud(xyz, normal, rgb, sigma, view), seen, tuple(grids), tuple(marks), tuple(pictures),
                 tuple(spacings), gains)


def cloud(fused: Fused) -> Cloud:
    """The default cloud: one layer, each place by the view that owns it, with the combined sigma along its ray."""
    return fused.cloud


def all_points(grids: Sequence[Grid], photos: Sequence[Photo], rig: Rig, s: FuseSettings | None = None) -> Cloud:
    """Every valid pixel of every view, from its own samples: row by row, view by view, nothing moved, nothing twice.

    Colours are those of the view's own picture, balanced between the views. Raises as `merge`.
    """
    s = s or FuseSettings()
    _check(grids, photos, rig)
    gains = view_gains(grids, photos, rig, s)
    counts = []
    for g in grids:
        counts.append(np.empty(len(g.sigma), np.int64))
        colours.count_points(_points(g)[1], counts[-1])
    starts = _starts(counts)
    n = int(starts[-1][-1])
    xyz, normal, sigma = _room(n)
    rgb = memory.empty((n, 3), np.uint8)
    for i, (g, p) in enumerate(zip(grids, photos, strict=True)):
        colours.pack(constant(g.xyz), constant(g.sigma), normals(g, rig, s), constant(p.rgb),
                     gains[i].astype(np.float32), SRGB, starts[i], xyz, normal, sigma, rgb)
    return Cloud(xyz, normal, rgb, sigma, _views(grids, counts))


def median_spacing(fused: Fused) -> float:
    """Median sampling, mm, of the views that own something."""
    own = [x for x, m in zip(fused.spacing_mm, fused.marks, strict=True) if (m & fusing.OWNED).any()]
    return float(np.median(own)) if own else math.nan
