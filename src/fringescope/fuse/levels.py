"""Levels of detail: which points of a triangulated sheet stay vertices when there may be fewer triangles."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fringescope.fuse.delaunay import Triangulation
from fringescope.kernels import mesh as k
from fringescope.types import F32, F64, I32, Bool

I64 = NDArray[np.int64]

_FIRST = 0.8  # share of the inner vertices that a lattice gives; the others go where it misses the surface
_ROUNDS = 2  # in which these are found
_NOISE = 0.3  # a vertex one of its own residuals off its neighbours is worth this share of it less
_FLAT = 1.0  # of the median bend: below it cells grow no further
_FINEST = 60  # cells are at most this many times the square root of 2 smaller than the largest
_TRIES = 5  # at a lattice with as many cells as are wanted
_SHORT = 0.01  # share of the cells by which a try aims lower
_CENTRED = 2.0  # what half a cell off its middle costs a point of the lattice, in residuals of the usual size


@dataclass(frozen=True, eq=False)
class Sheet:
    """A surface that is single-valued over a plane: the Delaunay triangles of its points that lie on it.

    `ab` (n, 2) are the points in the plane, snapped (see `delaunay`), `xyz` (n, 3) in the world, mm; `simplices`,
    `neighbours` (m, 3) all triangles; `on` (m,) those of the surface; `normal` (n, 3) unit normals.
    """

    ab: F64
    xyz: F32
    normal: F32
    simplices: I32
    neighbours: I32
    on: Bool

    @cached_property
    def faces(self) -> I32:
        """Triangles of the surface (f, 3)."""
        return self.simplices[self.on]

    @cached_property
    def border(self) -> Bool:
        """(n,) whether a point is an end of an edge with surface on one side only."""
        leaving = np.empty(len(self.ab), np.int32)
        k.border_edges(self.simplices, self.neighbours, self.on, leaving)
        return leaving > 0


@dataclass(frozen=True, eq=False)
class _Measures:
    """What decides where vertices go: the inner points `at` (k,) of a sheet, their triangles, and how it bends there.

    `step` (k,) tells how often a cell at the point is smaller than the largest, by the square root of 2; `quiet` (k,)
    is the residual from the neighbours, 1 the usual; `area` that of the sheet in its plane.
    """

    sheet: Sheet
    at: I64
    inner: Bool  #: (n,) the same as `at`
    rings: tuple[I32, I32]
    area: float
    step: I32
    quiet: F32


def _ring(faces: I32, rings: tuple[I32, I32], value: F32) -> F32:
    """Mean of a value over each point and its neighbours."""
    out = np.empty(len(value), np.float32)
    k.ring_mean(faces, *rings, value, out)
    return out


def _measures(sheet: Sheet) -> _Measures:
    """A triangle of side h misses a surface of curvature c by about c h^2 / 8: cells shrink with the square root of the
    bend, in steps of the square root of 2, so that neighbours share a lattice.
    """
    faces = sheet.faces
    used = np.zeros(len(sheet.ab), np.bool_)
    used[faces.ravel()] = True
    inner = used & ~sheet.border
    rings = k.incident(faces, len(sheet.ab))
    residual = np.empty(len(sheet.ab), np.float32)
    k.residuals(faces, *rings, sheet.xyz, sheet.normal, residual)
    mean = _ring(faces, rings, residual)
    bend = np.abs(_ring(faces, rings, mean))
    at = np.flatnonzero(inner)
    bend, quiet = bend[at], np.abs(residual[at] - mean[at])
    step = np.zeros(len(at), np.int32)
    if len(at):
        quiet /= np.float32(max(float(np.median(quiet)), 1e-9))
        bend /= np.float32(max(_FLAT * float(np.median(bend)), 1e-9))
        step = np.minimum(np.rint(np.log2(np.maximum(bend, 1))), _FINEST).astype(np.int32)
    area = np.empty(len(faces), np.float64)
    k.plane_areas(faces, sheet.ab, area)
    return _Measures(sheet, at, inner, rings, float(area.sum()), step, quiet)


def _side(m: _Measures, count: float) -> float:
    """Side of the largest cells, so that there are about `count` of all sizes, but at most one a point."""
    share = np.bincount(m.step) / len(m.step)
    smaller = np.exp2(np.arange(len(share)) / 2.0)
    low, high = 1e-3 * np.sqrt(m.area / count), 1e3 * np.sqrt(m.area / count)
    for _ in range(40):
        side = float(np.sqrt(low * high))
        cells = len(m.step) * float(share @ np.minimum(m.area / len(m.step) * (smaller / side) ** 2, 1.0))
        low, high = (side, high) if cells > count else (low, side)
    return float(low)


def _lattice(m: _Measures, count: int) -> Bool:
    """Nearly `count` of the inner points (n,), one in each cell of a lattice: quiet ones near the cell's middle.

    How many cells have points is found by trying; it grows nearly as a power of how many are wanted.
    """
    n = len(m.sheet.ab)
    size = 1 << max(4, int(2 * len(m.at) - 1).bit_length())
    keys, best = np.empty(size, np.int64), np.full(size, -1, np.int32)
    shrink = np.exp2(-np.arange(_FINEST + 1) / 2.0)
    wanted, power = 0.5 * count, 0.8
    most, out = 0, np.zeros(n, np.bool_)
    before: tuple[float, float] | None = None
    for _ in range(_TRIES):
        chosen = np.zeros(n, np.bool_)
        sides = np.maximum(_side(m, wanted) * shrink, 1.0)
        cells = k.best_of_cells(m.sheet.ab, m.at, m.step, sides, m.quiet, np.float32(_CENTRED), keys, best, chosen)
        if most < cells <= count or most == 0 or most > count:
            most, out = cells, chosen
        if (1 - 2 * _SHORT) * count <= cells <= count or cells == len(m.at):
            break
        now = math.log(wanted), math.log(cells)
        if before is not None and now[0] != before[0]:
            power = min(max((now[1] - before[1]) / (now[0] - before[0]), 0.4), 1.0)
        before = now
        wanted *= ((1 - _SHORT) * count / cells) ** (1 / power)
    if most > count:
        at = np.flatnonzero(out)
        out = np.zeros(n, np.bool_)
        out[at[np.linspace(0, most - 1, count).astype(np.int64)]] = True
    return out


def _missed(simplices: I32, neighbours: I32, m: _Measures, chosen: Bool, count: int) -> I64:
    """At most `count` points where the surface leaves the level's triangles most, one for each triangle.

    What counts is the mean deviation of a point and its neighbours; of a triangle's points a quiet one is taken, so
    that noise decides neither where vertices go nor which.
    """
    sheet = m.sheet
    at = np.flatnonzero(m.inner & ~chosen)
    inside = np.empty(len(at), np.int64)
    k.locate(sheet.ab[at], sheet.ab, simplices, neighbours, inside)
    triangle = np.full(len(sheet.ab), -1, np.int64)
    triangle[at] = inside
    off = np.empty(len(sheet.ab), np.float32)
    k.deviations(sheet.xyz, triangle, simplices, off)
    mean = _ring(sheet.faces, m.rings, off)[at]
    size = np.abs(mean)
    best = np.empty(len(simplices), np.int64)
    k.best_of_each(inside, size - np.float32(_NOISE) * np.abs(off[at] - mean), best)
    best = best[best >= 0]
    if len(best) > count:
        best = best[np.argpartition(-size[best], count)[:count]]
    return np.sort(at[best])


def _kept(simplices: I32, m: _Measures) -> I32:
    """The triangles of a level that lie on the sheet.

    An edge of a Delaunay triangulation stays one when other points go. All ends of the sheet's border stay, hence so
    does its border, and a triangle of the level lies on the sheet as a whole or not at all: a corner within the sheet
    tells, or else its middle.
    """
    sheet = m.sheet
    keep = m.inner[simplices[:, 0]] | m.inner[simplices[:, 1]] | m.inner[simplices[:, 2]]
    ask = np.flatnonzero(~keep)
    middle = sheet.ab[simplices[ask]].mean(axis=1)
    inside = np.empty(len(middle), np.int64)
    k.locate(middle, sheet.ab, sheet.simplices, sheet.neighbours, inside)
    keep[ask] = (inside >= 0) & sheet.on[inside]
    return simplices[keep]


def _level(m: _Measures, triangles: int) -> I32:
    """A coarser surface (f, 3) of so many triangles."""
    sheet = m.sheet
    count = max(len(m.at) - max(0, -(-(len(sheet.faces) - triangles) // 2)), 0)
    chosen = _lattice(m, max(1, round(_FIRST * count))) if count else np.zeros(len(sheet.ab), np.bool_)
    missing = count - int(np.count_nonzero(chosen))
    border = np.flatnonzero(chosen | sheet.border)
    made = Triangulation(sheet.ab, border, len(border) + max(missing, 0))
    for left in range(_ROUNDS, 0, -1):
        if missing > 0:
            more = _missed(*made.triangles(), m, chosen, -(-missing // left))
            chosen[more] = True
            missing -= len(more)
            made.add(more)
    return _kept(made.triangles()[0], m)


def removable(sheet: Sheet, triangles: int) -> bool:
    """Whether the border leaves enough of `triangles` for what lies within it."""
    return 2 * int(np.count_nonzero(sheet.border)) <= triangles


def simplify(sheet: Sheet, triangles: Sequence[int]) -> list[I32]:
    """For each count of `triangles` a coarser surface (f, 3) over a subset of the sheet's points, at most that many.

    Points on borders stay, so borders stay as they are. Inner vertices come from a lattice, then where the surface
    deviates most from the triangles so far. Each is removed with two triangles, so the count comes out exactly. The
    result is a manifold if the sheet is one, and counter-clockwise in `ab`. Levels are made side by side.
    """
    measures = _measures(sheet)
    if len(triangles) == 1:
        return [_level(measures, triangles[0])]
    with ThreadPoolExecutor(max(len(triangles), 1)) as pool:
        return list(pool.map(lambda most: _level(measures, most), triangles))
