"""The fused points to a textured triangle mesh with levels of detail; its vertices are points of the cloud."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import QhullError

from fringescope import geometry
from fringescope.errors import EmptyResultError
from fringescope.fuse.levels import Sheet, removable, simplify, triangulations
from fringescope.fuse.points import Fused
from fringescope.kernels import mesh as k
from fringescope.kernels.fusing import OWNED
from fringescope.kernels.ownership import number
from fringescope.settings import MeshSettings
from fringescope.types import F32, U8, AnyArray, Bool, Rig, Surface, SurfacePart

_MARGIN = 2  # pixels kept around the used part of a picture, so that interpolation has neighbours


@dataclass(frozen=True, eq=False)
class _Points:
    """The vertices before simplification: positions, normals, sigma, sampling, owner (order of the views), pixel."""

    xyz: F32
    normal: F32
    sigma: F32
    reach: F32
    owner: U8
    seen: U8
    pixel: F32  #: (n, 2) of the owning camera
    stride: int  #: of pixels, along rows and columns


def _points(fused: Fused, rig: Rig, s: MeshSettings) -> _Points:
    """Owned points, strided where there are more than `max_points`."""
    stride = max(1, math.ceil(math.sqrt(len(fused.cloud) / s.max_points)))
    parts: list[tuple[AnyArray, ...]] = []
    first = 0
    for i, (grid, marks) in enumerate(zip(fused.grids, fused.marks, strict=True)):
        at = np.empty((-(-marks.shape[0] // stride), -(-marks.shape[1] // stride)), np.int64)
        first = number(marks, OWNED, stride, first, at)
        rows, cols = np.nonzero(at >= 0)
        at, rows, cols = at[rows, cols], rows * stride, cols * stride
        xyz, normal = fused.cloud.xyz[at], fused.cloud.normals[at]
        camera = rig.cameras[grid.view]
        ray = geometry.centre(camera.pose).astype(np.float32) - xyz
        distance = np.linalg.norm(ray, axis=1)
        cosine = np.einsum("ij,ij->i", ray, normal) / np.maximum(distance, 1e-9)
        pixel_mm = distance / math.sqrt(camera.lens.K[0, 0] * camera.lens.K[1, 1])
        reach = stride * pixel_mm / np.maximum(cosine, 0.2)
        parts.append((xyz, normal, fused.cloud.sigma[at], reach.astype(np.float32), np.full(len(rows), i, np.uint8),
                      fused.seen[at], np.stack([cols, rows], axis=1).astype(np.float32)))
    xyz, normal, sigma, reach, owner, seen, pixel = (np.concatenate(column) for column in zip(*parts, strict=True))
    return _Points(xyz, normal, sigma, reach, owner, seen, pixel, stride)


def _crumbs(faces: NDArray[np.int64], xyz: F32, min_area: float) -> Bool:
    """Triangles of connected pieces with at least the area `min_area`, mm^2."""
    area = np.empty(len(faces), np.float64)
    k.areas(faces, xyz, area)
    label = k.pieces(faces, len(xyz))
    return np.asarray(np.bincount(label, weights=area)[label] >= min_area)


def _one_fan(faces: NDArray[np.int64], n: int) -> Bool:
    """Triangles that may stay so that no vertex joins two fans: then the surface is a manifold with border."""
    stay = np.ones(len(faces), np.bool_)
    while stay.any():
        some = faces[stay]
        start, around = k.incident(some, n)
        drop = np.zeros(len(some), np.bool_)
        if k.bow_ties(some, start, around, np.empty(len(around), np.int64), drop) == 0:
            break
        stay[np.flatnonzero(stay)[drop]] = False
    return stay


def _sheet(p: _Points, rig: Rig, s: MeshSettings) -> Sheet:
    """Triangles by Delaunay over the projector's field, in which the surface is single-valued.

    Triangles across a hole, a shadow or a jump are not on the surface, nor are crumbs.
    """
    q = geometry.transform(rig.projector.pose, p.xyz)
    ab = q[:, :2] / q[:, 2:]
    ab = (ab - ab.mean(axis=0)) * float(np.median(q[:, 2]))
    empty = np.zeros((0, 3), np.int32)
    if len(ab) < 3:
        return Sheet(ab, p.xyz, p.normal, empty, empty, np.zeros(0, np.bool_))
    try:
        (d,) = triangulations([ab])
    except QhullError:  # all on one line
        return Sheet(ab, p.xyz, p.normal, empty, empty, np.zeros(0, np.bool_))
    on = np.empty(len(d.simplices), np.bool_)
    k.on_surface(d.simplices, p.xyz, p.normal, p.sigma, p.reach, s.max_edge, s.jump_slope, s.jump_sigma, on)
    on[on] = _crumbs(d.simplices[on].astype(np.int64), p.xyz, s.min_area_mm2)
    on[on] = _one_fan(d.simplices[on].astype(np.int64), len(p.xyz))
    return Sheet(ab, p.xyz, p.normal, d.simplices, d.neighbors, on)


def _thinned(p: _Points, stride: int) -> tuple[_Points, NDArray[np.int64]]:
    """Every `stride`-th of the points along rows and columns, and which they are."""
    at = np.flatnonzero((p.pixel % (stride * p.stride) == 0).all(axis=1))
    return _Points(p.xyz[at], p.normal[at], p.sigma[at], p.reach[at] * np.float32(stride), p.owner[at], p.seen[at],
                   p.pixel[at], p.stride * stride), at


def _levels(p: _Points, sheet: Sheet, rig: Rig, s: MeshSettings) -> list[NDArray[np.int64]]:
    """Triangles of each level, finest first.

    Where the border alone takes most of a level's triangles, as on ragged surfaces, the level starts from fewer points.
    """
    wanted = (s.triangles, s.preview_triangles)
    plain = [t for t in wanted if removable(sheet, t) and len(sheet.faces) > t]
    simple = dict(zip(plain, simplify(sheet, plain), strict=True)) if plain else {}
    out = []
    for triangles in wanted:
        faces = simple.get(triangles, sheet.faces)
        stride = 1
        while len(faces) > triangles:
            stride *= 2
            some, at = _thinned(p, stride)
            coarse = _sheet(some, rig, s)
            small = coarse.faces
            if len(small) > triangles and removable(coarse, triangles):
                (small,) = simplify(coarse, [triangles])
            faces = at[small]
        out.append(_outward(faces[_one_fan(faces, len(p.xyz))], p.xyz, rig))
    return out


def _outward(faces: NDArray[np.int64], xyz: F32, rig: Rig) -> NDArray[np.int64]:
    """The same triangles, all counter-clockwise as the projector sees them; without those that have no area."""
    side = np.empty(len(faces), np.float64)
    k.facing(faces, xyz, geometry.centre(rig.projector.pose), side)
    faces = faces.copy()
    faces[side < 0] = faces[side < 0][:, [0, 2, 1]]
    return np.asarray(faces[side != 0])


def _part_views(faces: NDArray[np.int64], p: _Points, views: int) -> U8:
    """The view whose picture textures each triangle: one that sees all corners, and owns most of them."""
    score = np.zeros((len(faces), views), np.int32)
    for v in range(views):
        score[:, v] = (p.owner[faces] == v).sum(axis=1)
        score[:, v] += 10 * ((p.seen[faces] >> v) & 1).all(axis=1)
    return np.asarray(score.argmax(axis=1), dtype=np.uint8)


def _part(view: int, faces: NDArray[np.int64], vertex: NDArray[np.int64], p: _Points, fused: Fused,
          rig: Rig) -> SurfacePart:
    """Triangles of one view with the used part of its picture. `vertex` maps points to vertices of the surface."""
    grid = fused.grids[view]
    camera = rig.cameras[grid.view]
    used, local = np.unique(faces, return_inverse=True)
    uv = p.pixel[used].astype(np.float64)
    other = p.owner[used] != view
    uv[other] = geometry.project(camera, p.xyz[used[other]])
    H, W = grid.sigma.shape
    uv = np.clip(uv, 0, [W - 1, H - 1])
    low = np.maximum(np.floor(uv.min(axis=0)).astype(int) - _MARGIN, 0)
    high = np.minimum(np.ceil(uv.max(axis=0)).astype(int) + _MARGIN + 1, [W, H])
    texture = np.ascontiguousarray(fused.pictures[view][low[1] : high[1], low[0] : high[0]])
    return SurfacePart(grid.view, vertex[used].astype(np.uint32), ((uv - low + 0.5) / (high - low)).astype(np.float32),
                       local.reshape(-1, 3).astype(np.uint32), texture)


def _assemble(faces: NDArray[np.int64], p: _Points, fused: Fused, rig: Rig) -> Surface:
    used = np.unique(faces)
    vertex = np.full(len(p.xyz), -1, np.int64)
    vertex[used] = np.arange(len(used))
    view = _part_views(faces, p, len(fused.grids))
    parts = tuple(_part(int(v), faces[view == v], vertex, p, fused, rig) for v in np.unique(view))
    return Surface(p.xyz[used], p.normal[used], parts)


def surface(fused: Fused, rig: Rig, s: MeshSettings | None = None) -> tuple[Surface, ...]:
    """Levels of detail, finest first: at most `triangles`, then at most `preview_triangles`.

    Vertices are points of the cloud. Textures are the owning views' blended pictures at the cameras' sampling, cropped
    to what is used. Raises EmptyResultError if no triangle is left.
    """
    s = s or MeshSettings()
    p = _points(fused, rig, s)
    sheet = _sheet(p, rig, s)
    levels = _levels(p, sheet, rig, s) if sheet.on.any() else []
    if not levels or not all(len(faces) for faces in levels):
        raise EmptyResultError(f"no surface: {len(p.xyz)} points, none with neighbours near enough for a triangle; "
                               "look at the reasons per view, or raise mesh.max_edge")
    return tuple(_assemble(faces, p, fused, rig) for faces in levels)
