"""The fused points to a textured triangle mesh with levels of detail; its vertices are points of the cloud."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from fringescope import geometry, memory
from fringescope.errors import EmptyResultError
from fringescope.fuse.delaunay import Triangulation, along_curve, snapped
from fringescope.fuse.levels import Sheet, removable, simplify
from fringescope.fuse.points import Fused
from fringescope.kernels import mesh as k
from fringescope.kernels.fusing import OWNED
from fringescope.kernels.ownership import number
from fringescope.settings import MeshSettings
from fringescope.types import F32, F64, I32, U8, AnyArray, Bool, Rig, Surface, SurfacePart

_MARGIN = 2  # pixels kept around the used part of a picture, so that interpolation has neighbours
_PREVIEW = 2  # points that a preview starts from, per triangle that it may have

I64 = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Points:
    """The vertices before simplification, in order along a curve over the projector's field.

    Place in that field (snapped), positions, normals, sigma, sampling, owner (order of the views), pixel.
    """

    ab: F64
    xyz: F32
    normal: F32
    sigma: F32
    reach: F32
    owner: U8
    seen: U8
    pixel: I32  #: (n, 2) of the owning camera
    stride: int  #: of pixels, along rows and columns

    def at(self, which: AnyArray, stride: int = 1) -> _Points:
        """Some of the points; `stride` tells how many times farther apart they lie."""
        some = {f.name: getattr(self, f.name)[which] for f in fields(self) if f.name != "stride"}
        if stride != 1:
            some["reach"] = some["reach"] * np.float32(stride)
        return _Points(**some, stride=self.stride * stride)


def _points(fused: Fused, rig: Rig, s: MeshSettings) -> _Points:
    """Owned points, strided where there are more than `max_points`."""
    stride = max(1, math.ceil(math.sqrt(len(fused.cloud) / s.max_points)))

    def numbered(marks: U8) -> tuple[I64, int]:
        at = np.empty((-(-marks.shape[0] // stride), -(-marks.shape[1] // stride)), np.int64)
        return at, number(marks, OWNED, stride, 0, at)

    def of_view(i: int, numbers: I64, first: int) -> tuple[AnyArray, ...]:
        grid = fused.grids[i]
        rows, cols = (a.astype(np.int32) * np.int32(stride) for a in np.nonzero(numbers >= 0))
        at = numbers[numbers >= 0] + first
        xyz, normal = (np.take(x, at, axis=0) for x in (fused.cloud.xyz, fused.cloud.normals))
        camera = rig.cameras[grid.view]
        reach = np.empty(len(at), np.float32)
        pixel_rad = stride / math.sqrt(camera.lens.K[0, 0] * camera.lens.K[1, 1])
        k.sampling(xyz, normal, geometry.centre(camera.pose), pixel_rad, reach)
        return (xyz, normal, np.take(fused.cloud.sigma, at), reach, np.full(len(at), i, np.uint8),
                np.take(fused.seen, at), np.stack([cols, rows], axis=1))

    with ThreadPoolExecutor(len(fused.grids)) as pool:
        numbers, counts = zip(*pool.map(numbered, fused.marks), strict=True)
        firsts = np.cumsum((0, *counts[:-1])).tolist()
        parts = list(pool.map(of_view, range(len(fused.grids)), numbers, firsts))
    xyz, normal, sigma, reach, owner, seen, pixel = (np.concatenate(column) for column in zip(*parts, strict=True))
    q = geometry.transform(rig.projector.pose, xyz)
    ab = snapped(q[:, :2] / q[:, 2:])
    return _Points(ab, xyz, normal, sigma, reach, owner, seen, pixel, stride).at(along_curve(ab))


def _crumbs(faces: I32, xyz: F32, min_area: float) -> Bool:
    """Triangles of connected pieces with at least the area `min_area`, mm^2."""
    area = np.empty(len(faces), np.float64)
    k.areas(faces, xyz, area)
    label = k.pieces(faces, len(xyz))
    return np.asarray(np.bincount(label, weights=area)[label] >= min_area)


def _one_fan(simplices: I32, neighbours: I32, on: Bool, n: int) -> Bool:
    """Triangles that may stay so that no vertex joins two fans: then the surface is a manifold with border."""
    leaving, largest = np.empty(n, np.int32), np.empty(n, np.int32)
    while True:
        k.border_edges(simplices, neighbours, on, leaving)
        if len(leaving) == 0 or leaving.max() < 2:
            return on
        keep = on.copy()
        k.bow_ties(simplices, neighbours, on, leaving, largest, keep)
        on = keep


def _sheet(p: _Points, s: MeshSettings) -> Sheet:
    """Triangles by Delaunay over the projector's field, in which the surface is single-valued.

    Triangles across a hole, a shadow or a jump are not on the surface, nor are crumbs.
    """
    simplices, neighbours = Triangulation(p.ab, np.arange(len(p.ab))).triangles()
    on = np.empty(len(simplices), np.bool_)
    k.on_surface(simplices, p.xyz, p.normal, p.sigma, p.reach, s.max_edge, s.jump_slope, s.jump_sigma, on)
    if on.any():
        on[on] = _crumbs(simplices[on], p.xyz, s.min_area_mm2)
    return Sheet(p.ab, p.xyz, p.normal, simplices, neighbours, _one_fan(simplices, neighbours, on, len(p.xyz)))


def _levels(p: _Points, rig: Rig, s: MeshSettings, wanted: Sequence[int]) -> list[I32]:
    """Triangles of each level, of so many as are `wanted` at most.

    Where the border alone takes most of a level's triangles, as on ragged surfaces, the level starts from fewer points.
    """
    sheet = _sheet(p, s)
    plain = [t for t in wanted if removable(sheet, t) and len(sheet.faces) > t]
    simple = dict(zip(plain, simplify(sheet, plain), strict=True)) if plain else {}
    out = []
    for triangles in wanted:
        faces = simple.get(triangles, sheet.faces)
        stride = 1
        while len(faces) > triangles:
            stride *= 2
            at = np.flatnonzero((p.pixel % (stride * p.stride) == 0).all(axis=1))
            coarse = _sheet(p.at(at, stride), s)
            small = coarse.faces
            if len(small) > triangles and removable(coarse, triangles):
                (small,) = simplify(coarse, [triangles])
            faces = at.astype(np.int32)[small]
        out.append(_outward(faces, p.xyz, rig))
    return out


def _outward(faces: I32, xyz: F32, rig: Rig) -> I32:
    """The same triangles, all counter-clockwise as the projector sees them; without those that have no area."""
    out, area = np.empty_like(faces), np.empty(len(faces), np.bool_)
    k.towards(faces, xyz, geometry.centre(rig.projector.pose), out, area)
    return out if area.all() else out[area]


def _marked(faces: I32, n: int) -> I64:
    """Which of `n` points the triangles have, in order."""
    used = np.zeros(n, np.bool_)
    used[faces.ravel()] = True
    return np.flatnonzero(used)


def _numbers(used: I64, n: int) -> NDArray[np.uint32]:
    """The place (n,) of each of the points in `used`."""
    number = np.empty(n, np.uint32)
    number[used] = np.arange(len(used), dtype=np.uint32)
    return number


def _place(view: int, used: I64, p: _Points, fused: Fused, rig: Rig) -> F64:
    """Pixel coordinates (m, 2) of points in the picture of a view."""
    grid = fused.grids[view]
    uv = p.pixel[used].astype(np.float64)
    other = np.flatnonzero(p.owner[used] != view)
    uv[other] = geometry.project(rig.cameras[grid.view], p.xyz[used[other]])
    H, W = grid.sigma.shape
    np.clip(uv[:, 0], 0, W - 1, out=uv[:, 0])
    np.clip(uv[:, 1], 0, H - 1, out=uv[:, 1])
    return uv


@dataclass(frozen=True, eq=False)
class _Part:
    """The triangles of one level that one view textures: points `used`, where they lie in its picture, `faces`."""

    view: int
    used: I64
    uv: F64
    faces: NDArray[np.uint32]


def _parts(faces: I32, p: _Points, fused: Fused, rig: Rig) -> list[_Part]:
    """One level cut by the view whose picture textures each triangle."""
    view = np.zeros(len(faces), np.uint8)
    k.textured_by(faces, p.owner, p.seen, len(fused.grids), view)
    out = []
    for v in np.flatnonzero(np.bincount(view)).tolist():
        mine = faces[view == v]
        used = _marked(mine, len(p.xyz))
        out.append(_Part(v, used, _place(v, used, p, fused, rig), _numbers(used, len(p.xyz))[mine]))
    return out


def _crop(view: int, uv: Sequence[F64], fused: Fused) -> tuple[NDArray[np.int_], NDArray[np.int_], U8]:
    """The part of a picture in which the points `uv` lie: first pixel (x, y), the one after the last, and a copy."""
    H, W = fused.grids[view].sigma.shape
    low = np.floor(np.min([[x[:, 0].min(), x[:, 1].min()] for x in uv], axis=0)).astype(int) - _MARGIN
    high = np.ceil(np.max([[x[:, 0].max(), x[:, 1].max()] for x in uv], axis=0)).astype(int) + _MARGIN + 1
    low, high = np.maximum(low, 0), np.minimum(high, [W, H])
    part = fused.pictures[view][low[1] : high[1], low[0] : high[0]]
    texture = memory.empty(part.shape, np.uint8)
    np.copyto(texture, part)
    return low, high, texture


def _assemble(levels: Sequence[I32], p: _Points, fused: Fused, rig: Rig) -> tuple[Surface, ...]:
    """Surfaces with the used part of each view's picture, which the levels share."""
    cut = [_parts(faces, p, fused, rig) for faces in levels]
    places: dict[int, list[F64]] = {}
    for part in (part for parts in cut for part in parts):
        places.setdefault(part.view, []).append(part.uv)
    with ThreadPoolExecutor(max(len(places), 1)) as pool:
        crop = dict(zip(places, pool.map(lambda v: _crop(v, places[v], fused), places), strict=True))
    out = []
    for faces, parts in zip(levels, cut, strict=True):
        used = _marked(faces, len(p.xyz))
        vertex = _numbers(used, len(p.xyz))
        made = []
        for part in parts:
            low, high, texture = crop[part.view]
            uv = ((part.uv - low + 0.5) / (high - low)).astype(np.float32)
            made.append(SurfacePart(fused.grids[part.view].view, vertex[part.used], uv, part.faces, texture))
        out.append(Surface(p.xyz[used], p.normal[used], tuple(made)))
    return tuple(out)


def _surfaces(fused: Fused, rig: Rig, s: MeshSettings, wanted: Sequence[int]) -> tuple[Surface, ...]:
    p = _points(fused, rig, s)
    levels = _levels(p, rig, s, wanted)
    if not all(len(faces) for faces in levels):
        raise EmptyResultError(f"no surface: {len(p.xyz)} points, none with neighbours near enough for a triangle; "
                               "look at the reasons per view, or raise mesh.max_edge")
    return _assemble(levels, p, fused, rig)


def surface(fused: Fused, rig: Rig, s: MeshSettings | None = None) -> tuple[Surface, ...]:
    """Levels of detail, finest first: at most `triangles`, then at most `preview_triangles`.

    Vertices are points of the cloud. Textures are the owning views' blended pictures at the cameras' sampling, cropped
    to what is used; the levels share them. Raises EmptyResultError if no triangle is left.
    """
    s = s or MeshSettings()
    return _surfaces(fused, rig, s, (s.triangles, s.preview_triangles))


def preview(fused: Fused, rig: Rig, s: MeshSettings | None = None) -> Surface:
    """The level of at most `preview_triangles` alone, made sooner and from fewer points than by `surface`.

    Denser clouds are strided to about two points per triangle, so the border is coarser than that of `surface`.
    As `surface` otherwise.
    """
    s = s or MeshSettings()
    few = replace(s, max_points=min(s.max_points, max(_PREVIEW * s.preview_triangles, 1000)))
    return _surfaces(fused, rig, few, (s.preview_triangles,))[0]
