"""The fused surface as the projector sees it: what it can light, and so where guidance can be."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from fringescope import geometry
from fringescope.kernels import guiding as k
from fringescope.settings import GuideSettings
from fringescope.types import F32, F64, AnyArray, Bool, Projector, Surface

STEP_MM = 0.25  #: of a walk along the surface


@dataclass(frozen=True, eq=False)
class Relief:
    """The surface nearest to the projector at each unit of its plane; arrays (h, w) float32, NaN where there is none.

    `depth` along its axis, mm; `steep`: by how much the depth changes to a neighbour, mm; `normal` (h, w, 3) unit,
    towards the projector, over a window; `area`: of the surface in one unit, mm^2; `away`: how far the nearest surface
    is to the side, mm, and `beside` its depth.
    """

    projector: Projector
    depth: F32
    steep: F32
    normal: F32
    area: F32
    away: F32
    beside: F32
    jump_mm: float

    def at(self, uv: ArrayLike) -> F64:
        """Points (n, 3) of the surface on the projector's rays through (n, 2); NaN where there is none."""
        uv = np.asarray(uv, dtype=np.float64)
        depth = self.depth_at(uv)
        origin, rays = geometry.world_rays(self.projector, uv)
        return np.asarray(origin + rays * (depth / (rays @ self.projector.pose.R[2]))[:, None])

    def depth_at(self, uv: F64) -> F64:
        """Depth (n,) at plane coordinates (n, 2): between neighbours of one surface, else that of the nearest."""
        corners, fx, fy = self._corners(uv)
        with np.errstate(invalid="ignore"):
            one = np.ptp(corners, axis=0) <= self.jump_mm
        mix = (corners[0] * (1 - fx) + corners[1] * fx) * (1 - fy) + (corners[2] * (1 - fx) + corners[3] * fx) * fy
        nearest = np.take_along_axis(corners, ((fx >= 0.5) + 2 * (fy >= 0.5))[None].astype(np.intp), 0)[0]
        return np.asarray(np.where(one, mix, nearest))

    def _corners(self, uv: F64) -> tuple[F64, F64, F64]:
        """Depths (4, n) of the four units around, NaN off the plane, and the place between them."""
        h, w = self.depth.shape
        with np.errstate(invalid="ignore"):
            inside = (uv >= -0.5).all(1) & (uv[:, 0] <= w - 0.5) & (uv[:, 1] <= h - 0.5)
        p = np.clip(np.where(inside[:, None], uv, 0.0), 0.0, [w - 1, h - 1])
        c, r = (np.minimum(np.floor(p[:, i]).astype(np.intp), max(n - 2, 0)) for i, n in ((0, w), (1, h)))
        c1, r1 = np.minimum(c + 1, w - 1), np.minimum(r + 1, h - 1)
        d = self.depth
        corners = np.stack([d[r, c], d[r, c1], d[r1, c], d[r1, c1]]).astype(np.float64)
        corners[:, ~inside] = np.nan
        return corners, p[:, 0] - c, p[:, 1] - r

    def of(self, layer: AnyArray, uv: F64) -> AnyArray:
        """The values of a layer (h, w, ..) at the nearest units; NaN off the plane."""
        h, w = self.depth.shape
        with np.errstate(invalid="ignore"):
            inside = (uv >= -0.5).all(1) & (uv[:, 0] < w - 0.5) & (uv[:, 1] < h - 0.5)
        p = np.floor(np.where(inside[:, None], uv, 0.0) + 0.5).astype(np.intp)
        out = layer[p[:, 1], p[:, 0]].astype(np.float64)
        out[~inside] = np.nan
        return np.asarray(out)

    def walk(self, start: F64, direction: F64, distance: F64) -> tuple[F64, Bool]:
        """Where n walkers come to, who go straight ahead along the surface.

        From `start` (n, 3), towards `direction` (n, 3), so many mm (n,). Returns the places (n, 3), and whether the
        ground was measured there: over holes and from edges they go on straight ahead through the air.
        """
        p, _, ground = self.walk_on(start, direction, distance)
        return p, ground

    def walk_on(self, start: F64, direction: F64, distance: F64) -> tuple[F64, F64, Bool]:
        """As `walk`, with the directions (n, 3) in which the walkers look in the end."""
        p, d = start.astype(np.float64).copy(), _unit(direction)
        left = distance.astype(np.float64).copy()
        ground = np.ones(len(p), bool)
        for _ in range(int(np.ceil(np.max(left, initial=0.0) / STEP_MM)) + 1):
            go = np.flatnonzero(left > 1e-9)
            if not go.size:
                break
            step = np.minimum(left[go], STEP_MM)
            p[go], d[go], ground[go] = self._step(p[go], d[go], step)
            left[go] -= step
        return p, d, ground

    def paths(self, start: F64, direction: F64, distance: float, most_air_mm: float) -> tuple[F64, F64, Bool, Bool]:
        """The ways of n walkers, who stop where the surface jumps, and at holes wider than `most_air_mm`.

        Returns the places (k + 1, n, 3) after each of k equal steps, the directions (n, 3) in which they look in the
        end, and, of each step (k + 1, n), whether they still walk then, and whether the ground was measured there.
        """
        k = max(1, int(np.ceil(distance / STEP_MM)))
        step = distance / k
        p, d = start.astype(np.float64).copy(), _unit(direction)
        air, goes, ground = np.zeros(len(p)), np.ones(len(p), bool), np.ones(len(p), bool)
        ways, walks, grounds = [p.copy()], [goes.copy()], [ground.copy()]
        for _ in range(k):
            go = np.flatnonzero(goes)
            p[go], d[go], ground[go] = self._step(p[go], d[go], np.full(len(go), step))
            air[go] = np.where(ground[go], 0.0, air[go] + step)
            off = go[~ground[go]]
            other = np.isfinite(self.depth_at(geometry.project(self.projector, p[off])))  # a jump, and no hole
            air[off[other]] = np.inf
            goes = goes & (air <= most_air_mm)
            ways.append(p.copy())
            walks.append(goes.copy())
            grounds.append(ground & goes)
        return np.stack(ways), d, np.stack(walks), np.stack(grounds)

    def _step(self, p: F64, d: F64, step: F64) -> tuple[F64, F64, Bool]:
        ahead = p + d * step[:, None]
        uv = geometry.project(self.projector, ahead)
        q = self.at(uv)
        gone = np.linalg.norm(q - p, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            stretched = p + d * (step * np.clip(step / gone, 0.2, 1.5))[:, None]
        uv2 = geometry.project(self.projector, np.where(np.isfinite(gone)[:, None], stretched, ahead))
        q2 = self.at(uv2)
        with np.errstate(invalid="ignore"):
            ok = np.isfinite(q2).all(1) & (np.linalg.norm(q2 - p, axis=1) <= 4 * step + 0.05)
        out = np.where(ok[:, None], q2, ahead)
        n = self.of(self.normal, uv2)
        flat = d - (d * n).sum(1)[:, None] * n
        turned = ok & np.isfinite(flat).all(1) & (np.linalg.norm(flat, axis=1) > 0.1)
        return out, _unit(np.where(turned[:, None], flat, d)), ok


def _unit(a: F64) -> F64:
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(a / np.linalg.norm(a, axis=-1, keepdims=True))


def build(vertices: AnyArray, faces: AnyArray, projector: Projector, s: GuideSettings) -> Relief:
    """The relief of a triangle mesh: `vertices` (n, 3) world mm, `faces` (m, 3)."""
    w, h = projector.plane_size
    vertices = np.asarray(vertices, np.float64)
    screen = np.column_stack(
        [geometry.project(projector, vertices), geometry.transform(projector.pose, vertices)[:, 2]]
    )
    depth = np.full((h, w), np.inf)
    k.relief(screen, np.ascontiguousarray(faces, np.int64), depth)
    depth[~np.isfinite(depth)] = np.nan
    return of_depth(depth.astype(np.float32), projector, s)


def of_surface(surface: Surface, projector: Projector, s: GuideSettings) -> Relief:
    """The relief of a scan's surface."""
    faces = [np.asarray(p.vertex_index)[p.faces] for p in surface.parts]
    return build(surface.vertices, np.concatenate(faces) if faces else np.zeros((0, 3), np.int64), projector, s)


def of_depth(depth: F32, projector: Projector, s: GuideSettings) -> Relief:
    """The relief of a depth picture (h, w), mm, NaN = none, of the projector's plane."""
    h, w = depth.shape
    around = cv2.copyMakeBorder(depth, 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=float("nan"))
    steep = np.zeros_like(depth)
    for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        steep = np.fmax(steep, np.abs(around[1 + dv : h + 1 + dv, 1 + du : w + 1 + du] - depth))
    v, u = np.meshgrid(np.arange(h, dtype=np.float64), np.arange(w, dtype=np.float64), indexing="ij")
    origin, rays = geometry.world_rays(projector, np.stack([u, v], -1))
    xyz = (origin + rays * (depth / (rays @ projector.pose.R[2]))[..., None]).astype(np.float32)
    middle = float(np.nanmedian(depth)) if np.isfinite(depth).any() else 500.0
    reach = [max(1, round(s.normal_mm * projector.lens.K[i, i] / middle)) for i in (0, 1)]
    along_u = _slope(xyz, depth, 1, s.jump_mm)
    along_v = _slope(xyz, depth, 0, s.jump_mm)
    area = np.linalg.norm(np.cross(along_u, along_v), axis=-1).astype(np.float32)
    size = (2 * reach[0] + 1, 2 * reach[1] + 1)
    normal = np.cross(_mean(along_u, size), _mean(along_v, size))
    with np.errstate(invalid="ignore", divide="ignore"):
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    normal *= np.where((normal * rays).sum(-1, keepdims=True) > 0, -1, 1)
    away, beside = _beside(depth, max(middle / projector.lens.K[i, i] for i in (0, 1)))
    return Relief(projector, depth, steep, normal.astype(np.float32), area, away, beside, s.jump_mm)


def _beside(depth: F32, mm_per_unit: float) -> tuple[F32, F32]:
    """Distance of each unit from the nearest one with a surface, mm, and the depth there."""
    none = (~np.isfinite(depth)).astype(np.uint8)
    if none.all():
        return np.full_like(depth, np.inf), depth
    away, label = cv2.distanceTransformWithLabels(none, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    depths = np.empty(label.max() + 1, np.float32)
    depths[label[none == 0]] = depth[none == 0]
    return away * np.float32(mm_per_unit), depths[label]


def _slope(xyz: F32, depth: F32, axis: int, jump: float) -> F32:
    """What the surface moves on by, mm per unit along an axis (h, w, 3): NaN across jumps and holes."""
    out = np.full(xyz.shape, np.nan, np.float32)
    inner: list[Any] = [slice(None), slice(None)]
    before, after = list(inner), list(inner)
    inner[axis], before[axis], after[axis] = slice(1, -1), slice(None, -2), slice(2, None)
    a, b = xyz[tuple(before)], xyz[tuple(after)]
    with np.errstate(invalid="ignore"):
        one = np.abs(depth[tuple(after)] - depth[tuple(before)]) <= 2 * jump
    out[tuple(inner)] = np.where(one[..., None], (b - a) / 2, np.float32(np.nan))
    return out


def _mean(a: F32, size: tuple[int, int]) -> F32:
    """Mean of what there is in windows of `size` (columns, rows)."""
    there = np.isfinite(a[..., 0]).astype(np.float32)
    total = cv2.boxFilter(np.nan_to_num(a), -1, size, normalize=False)
    count = cv2.boxFilter(there, -1, size, normalize=False)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(count[..., None] > 0.5, total / count[..., None], np.nan), np.float32)
