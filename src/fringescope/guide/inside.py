"""What lies inside a closed stroke: the tissue that its outline means, and no other that is before or below it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fringescope import geometry
from fringescope.guide import fills
from fringescope.guide.drape import known_gap
from fringescope.guide.tissue import Tissue
from fringescope.settings import GuideSettings
from fringescope.types import F32, F64, Bool, Projector, Trace

OUTLINE = 256  #: places of an outline that say where the tissue inside lies
UNITS = 10_000  #: units of the plane for which that is worked out; others lie between them
STEEP = 2.0  #: beside the measured surface, so much of the way there the tissue may have risen or fallen
SHARD_MM = 1.5  #: narrower parts of a filled circle, where a few ways get on, are not lit
BLOCK = 4_000_000  #: distances that are held at once


@dataclass(frozen=True, eq=False)
class Inside:
    """Shares (h, w) of units of the projector's plane, from unit `low` (u, v) on, that light what a stroke encloses.

    `gap` (h, w) mm: how far behind what the projector lights the enclosed tissue lies, as its outline does; None = 0.
    `dark`: the share of what the outline encloses on the plane that is other tissue.
    """

    share: F32
    low: Any
    gap: F32 | None = None
    dark: float = 0.0

    def behind(self, uv: F64) -> F64:
        """How far the enclosed tissue lies behind what is lit, mm, at places of the plane (n, 2)."""
        if self.gap is None:
            return np.zeros(len(uv))
        at, there = self._units(uv)
        return np.asarray(np.where(there, self.gap[at[:, 1], at[:, 0]], 0.0))

    def holds(self, uv: F64) -> Bool:
        """Whether places of the plane (n, 2) lie in it, or beside it by a unit."""
        at, there = self._units(uv)
        wide = cv2.dilate((self.share > 0).astype(np.uint8), np.ones((3, 3), np.uint8))
        return np.asarray(there & (wide[at[:, 1], at[:, 0]] > 0))

    def _units(self, uv: F64) -> tuple[Any, Bool]:
        h, w = self.share.shape
        at = uv - self.low
        with np.errstate(invalid="ignore"):
            there = (at > -0.5).all(1) & (at[:, 0] < w - 0.5) & (at[:, 1] < h - 0.5)
        return np.floor(np.where(there[:, None], at, 0) + 0.5).astype(np.intp), np.asarray(there)


def window(every: F64, projector: Projector) -> tuple[Any, tuple[int, int]]:
    """The first unit (u, v) and the size (rows, columns) of the part of the plane that holds places (n, 2)."""
    w, h = projector.plane_size
    low = np.clip(np.floor(every.min(0)) - 1, 0, [w - 1, h - 1]).astype(int)
    high = np.clip(np.ceil(every.max(0)) + 1, 0, [w - 1, h - 1]).astype(int)
    return low, (int(high[1] - low[1] + 1), int(high[0] - low[0] + 1))


def of_outline(t: Trace, tissue: Tissue, s: GuideSettings) -> Inside | None:
    """What the traced outline of a stroke encloses.

    Where the outline lies below what the projector lights, or floats above it, so does the tissue that is meant inside;
    in between it lies in between. Only where it is what is lit it belongs to the stroke.
    """
    ring = t.uv[np.isfinite(t.uv).all(1)]
    if len(ring) < 3:
        return None
    low, size = window(ring, tissue.rig.projector)
    share = fills.inside([ring], low, size)
    known, gaps = _outline_gaps(t, tissue, s)
    if not known.any():
        return Inside(np.zeros_like(share), low, None, 1.0)
    gap: F32 | None = None
    ok = np.ones(share.shape, bool)
    if gaps.any():
        pick = np.flatnonzero(known)
        pick = pick[np.unique(np.linspace(0, len(pick) - 1, OUTLINE).astype(np.intp))]
        gap = _between(t.uv[pick], gaps[pick], low, size)
        part = (slice(low[1], low[1] + size[0]), slice(low[0], low[0] + size[1]))
        slack = np.nan_to_num(np.minimum(tissue.relief.steep[part], s.jump_mm))
        ok = (gap <= s.shadow_mm + slack) & (gap >= -s.off_surface_mm - slack)
    if not (t.why == 0).any():
        ok[:] = False
    whole = float(share.sum())
    out = share * ok
    return Inside(np.asarray(out, np.float32), low, gap, 1 - float(out.sum()) / whole if whole else 0.0)


def _outline_gaps(t: Trace, tissue: Tissue, s: GuideSettings) -> tuple[Bool, F64]:
    """How far places of an outline lie behind what is lit (n,), mm, 0 where they are on it; and where that is known."""
    p, r = tissue.rig.projector, tissue.relief
    known = np.asarray(np.isfinite(t.uv).all(1) & np.isfinite(t.xyz).all(1))
    depth = geometry.transform(p.pose, t.xyz)[:, 2]
    raw, slack = known_gap(t.xyz, t.uv, tissue)
    raw = np.where(np.isfinite(raw), raw, depth - r.depth_at(t.uv))
    # beside the measured surface: by the nearest of it, as far as slopes do not explain it
    w, h = p.plane_size
    at = np.clip(np.where(known[:, None], t.uv, 0.0), 0, [w - 1, h - 1])
    aside = np.linalg.norm(np.where(known[:, None], t.uv, 0.0) - at, axis=1) * depth / p.lens.K[0, 0]
    behind = depth - r.of(r.beside, at)
    beside = np.sign(behind) * np.maximum(np.abs(behind) - STEEP * (np.nan_to_num(r.of(r.away, at)) + aside), 0)
    with np.errstate(invalid="ignore"):
        near = (raw <= s.shadow_mm + slack) & (raw >= -s.off_surface_mm - slack)
        beside = np.where(np.abs(beside) > s.off_surface_mm, beside, 0.0)
        gaps = np.where(np.isfinite(raw), np.where(near, 0.0, raw), beside)
    gaps[t.why == 0] = 0.0
    return np.asarray(known & np.isfinite(gaps)), np.nan_to_num(gaps)


def _between(at: F64, value: F64, low: Any, size: tuple[int, int]) -> F32:
    """Values (m,) at places (m, 2) of the plane, spread over its units: the nearest count for the most."""
    stride = max(1, math.ceil(math.sqrt(size[0] * size[1] / UNITS)))
    v, u = np.arange(0, size[0] + stride, stride), np.arange(0, size[1] + stride, stride)
    grid = np.stack(np.meshgrid(u, v), -1).reshape(-1, 2) + low
    out = np.empty(len(grid))
    for block in np.array_split(np.arange(len(grid)), len(grid) * len(at) // BLOCK + 1):
        d2 = ((grid[block][:, None] - at) ** 2).sum(2)
        weight = 1 / np.maximum(d2, 0.25) ** 2
        out[block] = (weight * value).sum(1) / weight.sum(1)
    coarse = out.reshape(len(v), len(u)).astype(np.float32)
    y, x = np.meshgrid(np.arange(size[0]) / stride, np.arange(size[1]) / stride, indexing="ij")
    return np.asarray(cv2.remap(coarse, x.astype(np.float32), y.astype(np.float32), cv2.INTER_LINEAR), np.float32)


def of_ways(ways: F64, whole: Bool, projector: Projector) -> Inside | None:
    """What n + 1 neighbouring ways (k + 1, n + 1, 3) pass over, each with the next as far as they go on `whole` (k + 1,
    n) together.
    """
    uv = geometry.project(projector, ways)
    strips = _strips(uv, whole)
    if not strips:
        return None
    low, size = window(np.concatenate(strips), projector)
    share = fills.inside(strips, low, size, union=True)
    radius = float(np.linalg.norm(np.diff(ways[:, 0], axis=0), axis=1).sum())
    depth = float(geometry.transform(projector.pose, ways[0, 0])[2])
    narrow = min(SHARD_MM, 0.5 * radius) * projector.lens.K[0, 0] / depth
    return Inside(_without_shards(share, uv[0, 0] - low, narrow), low)


def _without_shards(share: F32, at: F64, narrow: float) -> F32:
    """Shares (h, w) without what is narrower than `narrow` units, and what only that joins to the place `at` (u, v)."""
    size = int(narrow) | 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    wide = cv2.morphologyEx((share > 0.5).astype(np.uint8), cv2.MORPH_OPEN, kernel)
    _, part = cv2.connectedComponents(wide, connectivity=4)
    h, w = share.shape
    u, v = np.clip(np.floor(at + 0.5).astype(int), 0, [w - 1, h - 1])
    mine = (part == part[v, u]) & (wide > 0)
    return np.asarray(share * cv2.dilate(mine.astype(np.uint8), np.ones((3, 3), np.uint8)), np.float32)


def _strips(uv: F64, whole: Bool) -> Sequence[F64]:
    """The polygons between each two ways, to where they part."""
    there = np.asarray(np.isfinite(uv).all(2))
    lasts = np.logical_and.accumulate(whole & there[:, 1:] & there[:, :-1], axis=0).sum(0)
    return [np.concatenate([uv[:n, i], uv[:n, i + 1][::-1]]) for i, n in enumerate(lasts.tolist()) if n > 1]
