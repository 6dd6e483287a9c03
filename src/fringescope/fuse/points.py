"""Organised grids to one cloud: what the views agree on, who owns a place, what colour it has (III-C end, Fig. 12)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from fringescope import geometry
from fringescope.errors import EmptyResultError, RigError
from fringescope.fuse.photo import encode_srgb, is_grey, view_gains
from fringescope.kernels import surface as k
from fringescope.settings import FuseSettings
from fringescope.types import F32, F64, U8, AnyArray, Bool, Cloud, Grid, Photo, Rig

_SMOOTH = (15, 15)  # cells over which a view's weight is averaged before ownership is settled
_GAP = (7, 7)  # pixels around a gap in the blending that tell what blending does there
_BAND = 256  # rows worked on at a time, which bounds the memory of the sums


@dataclass(frozen=True, eq=False)
class Fused:
    """All views after fusion, still organised. One entry per view, in the order of the grids.

    `grids` hold the fused points and sigmas on each view's own pixel rays; `owned` (H, W) says which of them make the
    single layer of the cloud; `seen` (H, W) has bit v set where view number v (in this order) sees the point too;
    `pictures` (H, W, 3) are sRGB, blended from all views; `spacing_mm` is each view's median sampling on the surface.
    """

    grids: tuple[Grid, ...]
    normals: tuple[F32, ...]
    pictures: tuple[U8, ...]
    owned: tuple[Bool, ...]
    seen: tuple[U8, ...]
    spacing_mm: tuple[float, ...]
    gains: F64  #: (V, 3) factors that balance the pictures


@dataclass(frozen=True, eq=False)
class _View:
    """One view with what the sums need: weights fall to zero towards borders and highlights."""

    grid: Grid
    centre: F64
    normal: F32
    sigma_n: F32
    cosine: F32
    weight: F32
    rgb: F32
    colour_weight: F32
    spacing: float


def _check(grids: Sequence[Grid], photos: Sequence[Photo], rig: Rig) -> None:
    if len(grids) != len(photos):
        raise RigError(f"{len(grids)} grids and {len(photos)} pictures; needed one picture per grid, in the same order")
    if not 1 <= len(grids) <= 8:
        raise RigError(f"{len(grids)} views; fusion takes 1 to 8")
    for g, p in zip(grids, photos, strict=True):
        if not 0 <= g.view < len(rig.cameras):
            raise RigError(f"view {g.view} of camera '{g.camera}'; the rig has {len(rig.cameras)} cameras")
        if g.camera != p.camera:
            raise RigError(f"points of camera '{g.camera}' with the picture of '{p.camera}'; needed the same order")
        if g.sigma.shape != p.rgb.shape[:2]:
            raise RigError(f"camera '{g.camera}': points on {g.sigma.shape[1]} x {g.sigma.shape[0]} pixels, picture of "
                           f"{p.rgb.shape[1]} x {p.rgb.shape[0]}; needed the same size")
    if not any(bool(g.valid.any()) for g in grids):
        raise EmptyResultError("no view has a single valid point: nothing to fuse; see the reasons per view")


def normals(grid: Grid, rig: Rig, s: FuseSettings | None = None) -> F32:
    """Unit normals (H, W, 3) towards the camera; NaN where there is no point.

    Regression of the points in a window of `normal_radius` on their pixel coordinates, not across jumps.
    """
    s = s or FuseSettings()
    out = np.empty_like(grid.xyz)
    k.normals(grid.xyz, grid.sigma, geometry.centre(rig.cameras[grid.view].pose), s.normal_radius, s.max_slope,
              s.jump_sigma, out)
    return out


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


def _view(grid: Grid, photo: Photo, gain: F64, colourless: bool, rig: Rig, s: FuseSettings) -> _View:
    """Weights of one view: cosine of incidence / sigma^2 along the normal, times its rise from borders and jumps."""
    centre = geometry.centre(rig.cameras[grid.view].pose)
    n = normals(grid, rig, s)
    cosine, step = np.empty_like(grid.sigma), np.empty_like(grid.sigma)
    k.incidence(grid.xyz, n, centre, cosine)
    k.spacing(grid.xyz, step)
    found = step[np.isfinite(step)]
    spacing = float(np.median(found)) if len(found) else 0.0
    valid = np.isfinite(grid.xyz[..., 0])
    whole = _close(valid, max(1.0, 0.5 * s.hole_mm / spacing) if spacing > 0 else 1.0)
    jump = np.empty(valid.shape, np.bool_)
    k.jumps(grid.xyz, grid.sigma, centre, s.max_slope, s.jump_sigma, jump)
    whole &= ~jump
    rise = _rise(whole, s.blend_mm / spacing if spacing > 0 else 1.0)
    low, high = np.cos(np.radians([s.grazing_deg, s.oblique_deg]))
    front = np.clip((cosine - low) / max(high - low, 1e-6), 0.0, 1.0)
    rise = np.maximum(rise, 1e-3) * front * front * (3 - 2 * front)
    with np.errstate(invalid="ignore"):
        sigma_n = grid.sigma * np.maximum(cosine, 0.05)
        weight = np.where(valid, rise * cosine / np.maximum(sigma_n, 1e-6) ** 2, 0.0)
    clear = _rise(~photo.saturated, s.highlight_pixels) if photo.saturated.any() else np.ones_like(rise)
    colour_weight = np.where(valid, rise * clear * cosine**2, 0.0)
    if colourless:
        colour_weight *= 1e-6
    rgb = photo.rgb * gain.astype(np.float32)
    return _View(grid, centre, n, sigma_n.astype(np.float32), cosine, weight.astype(np.float32), rgb,
                 colour_weight.astype(np.float32), spacing)


def _views(grids: Sequence[Grid], photos: Sequence[Photo], rig: Rig, s: FuseSettings) -> tuple[list[_View], F64]:
    gains = view_gains(grids, photos, rig, s) if s.harmonise and len(grids) > 1 else np.ones((len(grids), 3))
    grey = [is_grey(p) for p in photos]
    colourless = [g and not all(grey) for g in grey]
    return [_view(g, p, gains[i], colourless[i], rig, s)
            for i, (g, p) in enumerate(zip(grids, photos, strict=True))], gains


def merge(grids: Sequence[Grid], photos: Sequence[Photo], rig: Rig, s: FuseSettings | None = None) -> Fused:
    """All views in one frame: on every pixel ray the mean of the views that see the place, weighted by sigma and angle.

    Each view contributes one sample, not an interpolation of several, so that fusion averages over views and never over
    neighbours. A view's weight rises from nothing at its border, so that no step appears there. Views that disagree by
    more than their sigmas explain do not see the same place. `photos` has one picture per grid, in the same order.
    Raises RigError for views that the rig lacks, or of other sizes, EmptyResultError if no view has a valid point.
    """
    s = s or FuseSettings()
    _check(grids, photos, rig)
    views, gains = _views(grids, photos, rig, s)
    V = len(views)
    lenses = [geometry.lens_vector(rig.cameras[v.grid.view].lens) for v in views]
    poses = [rig.cameras[v.grid.view].pose for v in views]
    fused, ns, pictures, seen_all = [], [], [], []
    for a, v in enumerate(views):
        H, W = v.grid.sigma.shape
        xyz, n, sigma = np.empty_like(v.grid.xyz), np.empty_like(v.grid.xyz), np.empty_like(v.grid.sigma)
        colour, seen = np.empty_like(v.rgb), np.zeros((H, W), np.uint8)
        for row0 in range(0, H, _BAND):
            row1 = min(row0 + _BAND, H)
            shift, total, variance = (np.zeros((row1 - row0, W), np.float64) for _ in range(3))
            facing = np.zeros((row1 - row0, W, 3), np.float64)
            samples = np.zeros((max(V - 1, 1), row1 - row0, W, 4), np.float32)
            others = [b for b in range(V) if b != a]
            for slot, b in enumerate(others):
                w = views[b]
                k.gather(v.grid.xyz, v.normal, v.sigma_n, v.centre, row0, row1, poses[b].R, poses[b].t, lenses[b],
                         w.grid.xyz, w.normal, w.sigma_n, w.cosine, w.weight, w.rgb, w.colour_weight, s.agree_sigma,
                         s.agree_mm, np.uint8(1 << b), shift, total, variance, facing, seen[row0:row1], samples[slot])
            k.settle(v.grid.xyz, v.normal, v.sigma_n, v.weight, v.centre, row0, row1, shift, total, variance, facing,
                     xyz, n, sigma)
            k.blend(samples, s.gloss, row0, v.rgb, v.colour_weight, colour)
        _even(colour, v.rgb, seen != 0)
        seen[np.isfinite(v.sigma_n)] |= np.uint8(1 << a)
        fused.append(Grid(v.grid.view, v.grid.camera, xyz, sigma, v.grid.reasons))
        ns.append(n)
        pictures.append(encode_srgb(colour))
        seen_all.append(seen)
    own = _ownership(fused, ns, [v.weight for v in views], [v.spacing for v in views], rig, s)
    return Fused(tuple(fused), tuple(ns), tuple(pictures), tuple(own), tuple(seen_all),
                 tuple(v.spacing for v in views), gains)


def _even(colour: F32, own: F32, blended: Bool) -> None:
    """Carry what blending did to a picture into its gaps: pixels where no other view sees the place, but around which
    others do, as single pixels without a point in a highlight. They get their own colour times the ratio of blended to
    own colour around them.
    """
    if blended.all() or not blended.any():
        return
    there = blended.astype(np.float32)
    share = cv2.blur(there, _GAP)
    after, before = (cv2.blur(c * there[..., None], _GAP) for c in (colour, own))
    gap = ~blended & (share > 0.3)
    colour[gap] = own[gap] * np.clip(after[gap] / np.maximum(before[gap], 1e-6), 0.0, 4.0)


def _ownership(grids: Sequence[Grid], ns: Sequence[F32], weights: Sequence[F32], spacings: Sequence[float], rig: Rig,
               s: FuseSettings) -> list[Bool]:
    """Which points make the one layer.

    Every point is lit by the projector, so the surface is single-valued over the projector's field: cells of it, about
    two samples wide, each belong to the view with the largest smoothed weight among those with a point there.
    Points of different views nearer than the separation across a border of cells are doubles; one of them goes.
    """
    valid = [np.isfinite(g.xyz[..., 0]) for g in grids]
    if len(grids) == 1:
        return valid
    pose = rig.projector.pose
    coordinates = []
    depth = np.inf
    for g in grids:
        ab = np.empty((*g.sigma.shape, 2), np.float64)
        k.plane_coordinates(g.xyz, pose.R, pose.t, ab)
        coordinates.append(ab)
        some = g.xyz[::8, ::8].reshape(-1, 3)
        some = some[np.isfinite(some[:, 0])]
        if len(some):
            depth = min(depth, float(np.median(geometry.transform(pose, some)[:, 2])))
    spacing = max(x for x, ok in zip(spacings, valid, strict=True) if ok.any())
    separation = max(s.separation_mm, 0.5 * spacing) / depth
    cell = max(2.0 * spacing / depth, 1.01 * separation)
    with np.errstate(invalid="ignore"):
        filled = [ab.reshape(-1, 2) for ab, ok in zip(coordinates, valid, strict=True) if ok.any()]
        low = np.min([np.nanmin(ab, axis=0) for ab in filled], axis=0)
        high = np.max([np.nanmax(ab, axis=0) for ab in filled], axis=0)
    cols, rows = (np.floor((high - low) / cell).astype(int) + 1).tolist()
    best, owner = np.zeros((rows, cols), np.float32), np.full((rows, cols), -1, np.int16)
    for i, (ab, w) in enumerate(zip(coordinates, weights, strict=True)):
        total, count = np.zeros((rows, cols)), np.zeros((rows, cols), np.int32)
        k.bin_weights(ab, w, low, cell, total, count)
        smooth = cv2.blur(total, _SMOOTH) / np.maximum(cv2.blur(count.astype(np.float64), _SMOOTH), 1e-9)
        score = np.where(count > 0, smooth + 1e-12, 0.0).astype(np.float32)
        better = score > best
        best[better], owner[better] = score[better], i
    own = []
    for i, ab in enumerate(coordinates):
        mine = np.empty(ab.shape[:2], np.bool_)
        k.owned(ab, low, cell, owner, i, mine)
        own.append(mine)
    _drop_doubles(grids, ns, coordinates, own, owner, low, cell, separation, 1.05 * s.separation_mm, 3 * cell * depth)
    return own


def _drop_doubles(grids: Sequence[Grid], ns: Sequence[F32], coordinates: Sequence[F64], own: Sequence[Bool],
                  owner: AnyArray, low: F64, cell: float, separation: float, sideways: float, near: float) -> None:
    """Clear from `own` the points that lie within the separation of another view's point."""
    lowest = cv2.erode(owner, np.ones((3, 3), np.uint8))
    edge = (cv2.dilate(owner, np.ones((3, 3), np.uint8)) != lowest) & (owner >= 0)
    where, ab, cells, views, xyz, normal = [], [], [], [], [], []
    for i, mine in enumerate(own):
        at = np.argwhere(mine)
        p = coordinates[i][mine]
        c = ((p - low) / cell).astype(np.int64)
        close = edge[c[:, 1], c[:, 0]]
        at = at[close]
        where.append(at)
        xyz.append(grids[i].xyz[at[:, 0], at[:, 1]])
        normal.append(ns[i][at[:, 0], at[:, 1]])
        ab.append(p[close])
        cells.append(c[close, 1] * owner.shape[1] + c[close, 0])
        views.append(np.full(int(close.sum()), i, np.int16))
    index, points, view = np.concatenate(cells), np.concatenate(ab), np.concatenate(views)
    if not len(index):
        return
    order = np.argsort(index, kind="stable")
    unique, start = np.unique(index[order], return_index=True)
    lookup = np.full(owner.shape, -1, np.int64)
    lookup.ravel()[unique] = np.arange(len(unique))
    out = np.zeros(len(order), np.bool_)
    k.doubles(points[order], np.concatenate(xyz)[order], np.concatenate(normal)[order], view[order], separation,
              sideways, near, np.append(start, len(order)),
              unique // owner.shape[1], unique % owner.shape[1], lookup, out)
    gone = np.zeros(len(order), np.bool_)
    gone[order[out]] = True
    first = 0
    for i, at in enumerate(where):
        g = gone[first : first + len(at)]
        own[i][at[g, 0], at[g, 1]] = False
        first += len(at)


def _stack(grids: Sequence[Grid], ns: Sequence[F32], pictures: Sequence[U8], masks: Sequence[Bool]) -> Cloud:
    return Cloud(
        np.concatenate([g.xyz[m] for g, m in zip(grids, masks, strict=True)]),
        np.concatenate([n[m] for n, m in zip(ns, masks, strict=True)]),
        np.concatenate([p[m] for p, m in zip(pictures, masks, strict=True)]),
        np.concatenate([g.sigma[m] for g, m in zip(grids, masks, strict=True)]),
        np.concatenate([np.full(int(m.sum()), g.view, np.uint8) for g, m in zip(grids, masks, strict=True)]),
    )


def cloud(fused: Fused) -> Cloud:
    """The default cloud: one layer, each place by the view that owns it, with the combined sigma along its ray."""
    return _stack(fused.grids, fused.normals, fused.pictures, fused.owned)


def all_points(grids: Sequence[Grid], photos: Sequence[Photo], rig: Rig, s: FuseSettings | None = None) -> Cloud:
    """Every valid pixel of every view, from its own samples: row by row, view by view, nothing moved, nothing twice.

    Colours are those of the view's own picture, balanced between the views. Raises as `merge`.
    """
    s = s or FuseSettings()
    _check(grids, photos, rig)
    gains = view_gains(grids, photos, rig, s) if s.harmonise and len(grids) > 1 else np.ones((len(grids), 3))
    masks = [np.asarray(np.isfinite(g.xyz[..., 0])) for g in grids]
    pictures = [encode_srgb(p.rgb * g.astype(np.float32)) for p, g in zip(photos, gains, strict=True)]
    return _stack(grids, [normals(g, rig, s) for g in grids], pictures, masks)


def median_spacing(fused: Fused) -> float:
    """Median sampling, mm, of the views that own something."""
    own = [x for x, o in zip(fused.spacing_mm, fused.owned, strict=True) if o.any()]
    return float(np.median(own)) if own else math.nan
