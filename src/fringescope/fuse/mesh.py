"""The fused points to a textured triangle mesh with levels of detail; its vertices are points of the cloud."""

from __future__ import annotations

import math
from dataclasses import dataclass

import meshoptimizer
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError

from fringescope import geometry
from fringescope.errors import EmptyResultError
from fringescope.fuse.points import Fused
from fringescope.kernels import mesh as k
from fringescope.settings import MeshSettings
from fringescope.types import F32, U8, AnyArray, Bool, Rig, Surface, SurfacePart

_ANY_ERROR = 1e6  # mm; the number of triangles decides, so that a level has the size that a browser takes
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


def _points(fused: Fused, rig: Rig, s: MeshSettings) -> _Points:
    """Owned points, strided where there are more than `max_points`."""
    total = sum(int(o.sum()) for o in fused.owned)
    stride = max(1, math.ceil(math.sqrt(total / s.max_points)))
    parts: list[tuple[AnyArray, ...]] = []
    for i, grid in enumerate(fused.grids):
        rows, cols = np.nonzero(fused.owned[i][::stride, ::stride])
        rows, cols = rows * stride, cols * stride
        xyz, normal = grid.xyz[rows, cols], fused.normals[i][rows, cols]
        camera = rig.cameras[grid.view]
        ray = geometry.centre(camera.pose).astype(np.float32) - xyz
        distance = np.linalg.norm(ray, axis=1)
        cosine = np.einsum("ij,ij->i", ray, normal) / np.maximum(distance, 1e-9)
        pixel_mm = distance / math.sqrt(camera.lens.K[0, 0] * camera.lens.K[1, 1])
        reach = stride * pixel_mm / np.maximum(cosine, 0.2)
        parts.append((xyz, normal, grid.sigma[rows, cols], reach.astype(np.float32), np.full(len(rows), i, np.uint8),
                      fused.seen[i][rows, cols], np.stack([cols, rows], axis=1).astype(np.float32)))
    return _Points(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _crumbs(faces: NDArray[np.int64], xyz: F32, min_area: float) -> Bool:
    """Triangles of connected pieces with at least the area `min_area`, mm^2."""
    if not len(faces):
        return np.zeros(0, np.bool_)
    n = len(xyz)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array((np.ones(len(ends), np.int8), (ends[:, 0], ends[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1][faces[:, 0]]
    area = np.empty(len(faces), np.float64)
    k.areas(faces, xyz, area)
    total = np.bincount(label, weights=area)
    return np.asarray(total[label] >= min_area)


def _two_sided(faces: NDArray[np.int64], xyz: F32) -> NDArray[np.int64]:
    """Drop the smallest triangles at edges that more than two of them share, which a simplification may leave."""
    while len(faces):
        ends = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        key = ends[:, 0] * len(xyz) + ends[:, 1]
        _, edge, count = np.unique(key, return_inverse=True, return_counts=True)
        crowded = np.flatnonzero(count[edge] > 2)
        if not len(crowded):
            break
        area = np.empty(len(faces), np.float64)
        k.areas(faces, xyz, area)
        face = crowded % len(faces)
        order = np.lexsort((area[face], edge[crowded]))
        first = np.unique(edge[crowded][order], return_index=True)[1]
        faces = np.delete(faces, face[order[first]], axis=0)
    return faces


def _one_fan(faces: NDArray[np.int64], n: int) -> NDArray[np.int64]:
    """Drop triangles until no vertex joins two fans, so that the surface is a manifold with border."""
    while len(faces):
        corner = faces.ravel()
        order = np.argsort(corner, kind="stable")
        start = np.searchsorted(corner[order], np.arange(n + 1))
        drop = np.zeros(len(faces), np.bool_)
        if k.bow_ties(faces, start, order // 3, np.empty(len(order), np.int64), drop) == 0:
            break
        faces = faces[~drop]
    return faces


def _triangulate(p: _Points, rig: Rig, s: MeshSettings) -> NDArray[np.int64]:
    """Triangles (m, 3) by Delaunay over the projector's field, in which the surface is single-valued.

    Triangles across a hole, a shadow or a jump go, then crumbs. Counter-clockwise as the projector sees them.
    """
    q = geometry.transform(rig.projector.pose, p.xyz)
    ab = q[:, :2] / q[:, 2:]
    ab = (ab - ab.mean(axis=0)) * float(np.median(q[:, 2]))
    if len(ab) < 3:
        return np.zeros((0, 3), np.int64)
    try:
        faces = Delaunay(ab).simplices.astype(np.int64)
    except QhullError:  # all on one line
        return np.zeros((0, 3), np.int64)
    good = np.empty(len(faces), np.bool_)
    k.on_surface(faces, p.xyz, p.normal, p.sigma, p.reach, s.max_edge, s.jump_slope, s.jump_sigma, good)
    faces = faces[good]
    return _outward(_one_fan(faces[_crumbs(faces, p.xyz, s.min_area_mm2)], len(p.xyz)), p.xyz, rig)


def _outward(faces: NDArray[np.int64], xyz: F32, rig: Rig) -> NDArray[np.int64]:
    """The same triangles, all counter-clockwise as the projector sees them; without those that have no area."""
    side = np.empty(len(faces), np.float64)
    k.facing(faces, xyz, geometry.centre(rig.projector.pose), side)
    faces = faces.copy()
    faces[side < 0] = faces[side < 0][:, [0, 2, 1]]
    return np.asarray(faces[side != 0])


def _simplify(faces: NDArray[np.int64], xyz: F32, triangles: int) -> NDArray[np.int64]:
    """At most `triangles` triangles over a subset of the vertices, with the least change of shape; borders last."""
    if len(faces) <= triangles:
        return faces
    used, local = np.unique(faces, return_inverse=True)
    index = local.reshape(-1).astype(np.uint32)
    out = np.zeros_like(index)
    vertices, count = np.ascontiguousarray(xyz[used]), 0
    for border in (meshoptimizer.SIMPLIFY_LOCK_BORDER, 0):  # a ragged surface is mostly border
        count = meshoptimizer.simplify(out, index, vertices, target_index_count=3 * triangles, target_error=_ANY_ERROR,
                                       options=border | meshoptimizer.SIMPLIFY_ERROR_ABSOLUTE)
        if count <= 3.03 * triangles:
            break
    return used[out[:count].reshape(-1, 3)].astype(np.int64)


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
    faces = _triangulate(p, rig, s)
    if not len(faces):
        raise EmptyResultError(f"no surface: {len(p.xyz)} points, none with neighbours near enough for a triangle; "
                               "look at the reasons per view, or raise mesh.max_edge")
    levels = []
    for triangles in (s.triangles, s.preview_triangles):
        faces = _one_fan(_two_sided(_simplify(faces, p.xyz, triangles), p.xyz), len(p.xyz))
        levels.append(_assemble(faces, p, fused, rig))
    return tuple(levels)
