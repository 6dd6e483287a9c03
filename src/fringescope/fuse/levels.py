"""Levels of detail: which points of a triangulated sheet stay vertices when there may be fewer triangles."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from fringescope.kernels import mesh as k
from fringescope.types import F32, F64, Bool

I64 = NDArray[np.int64]

_FIRST = 0.8  # share of the inner vertices that a lattice gives; the others go where it misses the surface
_ROUNDS = 2  # triangulations of a level: the lattice, and what is added
_NOISE = 0.3  # a vertex one of its own residuals off its neighbours is worth this share of it less
_FLAT = 1.0  # of the median bend: below it cells grow no further
_CENTRED = 2.0  # what half a cell off its middle costs a point of the lattice, in residuals of the usual size


@dataclass(frozen=True, eq=False)
class Sheet:
    """A surface that is single-valued over a plane: the Delaunay triangles of its points that lie on it.

    `ab` (n, 2) and `xyz` (n, 3) are the points in the plane and in the world, mm; `simplices`, `neighbours` (m, 3) all
    triangles; `on` (m,) those of the surface; `normal` (n, 3) unit normals.
    """

    ab: F64
    xyz: F32
    normal: F32
    simplices: NDArray[np.int32]
    neighbours: NDArray[np.int32]
    on: Bool

    @property
    def faces(self) -> I64:
        """Triangles of the surface (f, 3)."""
        return self.simplices[self.on].astype(np.int64)

    @property
    def border(self) -> Bool:
        """(n,) whether a point is an end of an edge with surface on one side only."""
        beyond = (self.neighbours < 0) | ~self.on[self.neighbours]
        t, c = np.nonzero(beyond & self.on[:, None])
        out = np.zeros(len(self.ab), np.bool_)
        out[self.simplices[t, (c + 1) % 3]] = True
        out[self.simplices[t, (c + 2) % 3]] = True
        return out


@dataclass(eq=False)
class _Level:
    """One level in the making: how many inner vertices it may have, and which vertices it has so far."""

    inner: int
    chosen: Bool


def triangulations(plane: Sequence[F64]) -> list[Delaunay]:
    """Delaunay triangulations of several sets of points (n, 2), side by side."""
    if len(plane) == 1:
        return [Delaunay(plane[0])]
    with ThreadPoolExecutor(len(plane)) as pool:
        return list(pool.map(Delaunay, plane))


def _ring(faces: I64, rings: tuple[I64, I64], value: F32) -> F32:
    """Mean of a value over each point and its neighbours."""
    out = np.empty(len(value), np.float32)
    k.ring_mean(faces, *rings, value, out)
    return out


def _cells(bend: F32, area: float, count: float) -> F64:
    """Side (n,) of the lattice's cell at each point, so that there are about `count` of them.

    A triangle of side h misses a surface of curvature c by about c h^2 / 8: cells shrink with the square root of
    `bend`, in steps of the square root of 2, so that neighbours share a lattice.
    """
    floor = max(_FLAT * float(np.median(bend)), 1e-9)
    relative = 1.0 / np.sqrt(np.maximum(bend, floor).astype(np.float64) / floor)
    some = relative[:: max(1, len(bend) // 10_000)]
    low, high = 1e-3 * np.sqrt(area / count), 1e3 * np.sqrt(area / count)
    for _ in range(30):
        side = np.sqrt(low * high)
        cells = len(bend) * np.minimum(area / len(bend) / (side * some) ** 2, 1.0).mean()
        low, high = (side, high) if cells > count else (low, side)
    return np.asarray(low * np.exp2(np.round(2.0 * np.log2(relative)) / 2.0))


def _lattice(sheet: Sheet, area: float, free: Bool, bend: F32, residual: F32, count: int) -> I64:
    """Nearly `count` of the `free` points, one in each cell of a lattice: quiet ones near the cell's middle."""
    at = np.flatnonzero(free)
    ab = sheet.ab[at] - sheet.ab[at].min(axis=0)
    quiet = np.abs(residual[at])
    quiet /= max(float(np.median(quiet)), 1e-9)
    wanted, best = float(count), at
    for _ in range(4):
        side = _cells(bend[at], area, wanted)
        place = ab / side[:, None]
        cell = place.astype(np.int64)
        off = 2.0 * np.abs(place - cell - 0.5).max(axis=1)
        step = np.round(2.0 * np.log2(side.max() / side)).astype(np.int64)
        width = int(cell.max()) + 1
        _, group = np.unique((cell[:, 1] + step * width) * width + cell[:, 0], return_inverse=True)
        best = np.empty(int(group.max()) + 1, np.int64)
        k.best_of_each(group.reshape(-1), -(quiet + _CENTRED * off * off), best)
        if len(best) <= count:
            return at[best]
        wanted *= 0.97 * count / len(best)
    return at[np.sort(best)[np.linspace(0, len(best) - 1, count).astype(np.int64)]]


def _missed(d: Delaunay, sheet: Sheet, faces: I64, rings: tuple[I64, I64], level: _Level, free: Bool,
            count: int) -> I64:
    """At most `count` points where the surface leaves the level's triangles most, one for each triangle.

    What counts is the mean deviation of a point and its neighbours; of a triangle's points a quiet one is taken, so
    that noise decides neither where vertices go nor which.
    """
    at = np.flatnonzero(free & ~level.chosen)
    inside = np.empty(len(at), np.int64)
    k.locate(sheet.ab[at], d.points, d.simplices, d.neighbors, inside)
    triangle = np.full(len(sheet.ab), -1, np.int64)
    triangle[at] = inside
    off = np.empty(len(sheet.ab), np.float32)
    k.deviations(sheet.xyz, triangle, np.flatnonzero(level.chosen)[d.simplices], off)
    mean = _ring(faces, rings, off)
    score = np.abs(mean) - np.float32(_NOISE) * np.abs(off - mean)
    best = np.empty(len(d.simplices), np.int64)
    k.best_of_each(inside, score[at], best)
    best = at[best[best >= 0]]
    return best[np.argsort(-np.abs(mean[best]))[:count]]


def _kept(d: Delaunay, sheet: Sheet, chosen: Bool) -> I64:
    """The triangles of a level that lie on the sheet.

    An edge of a Delaunay triangulation stays one when other points go. All ends of the sheet's border stay, hence so
    does its border, and a triangle of the level lies on the sheet as a whole or not at all: its middle tells.
    """
    middle = d.points[d.simplices].mean(axis=1)
    inside = np.empty(len(middle), np.int64)
    k.locate(middle, sheet.ab, sheet.simplices, sheet.neighbours, inside)
    return np.asarray(np.flatnonzero(chosen)[d.simplices[(inside >= 0) & sheet.on[inside]]])


def removable(sheet: Sheet, triangles: int) -> bool:
    """Whether the border leaves enough of `triangles` for what lies within it."""
    return 2 * int(sheet.border.sum()) <= triangles


def simplify(sheet: Sheet, triangles: Sequence[int]) -> list[I64]:
    """For each count of `triangles` a coarser surface (f, 3) over a subset of the sheet's points, at most that many.

    Points on borders stay, so borders stay as they are. Inner vertices come from a lattice, then where the surface
    deviates most from the triangles so far. Each is removed with two triangles, so the count comes out exactly. The
    result is a manifold if the sheet is one, and counter-clockwise in `ab`. Levels are made side by side.
    """
    faces = sheet.faces
    border = sheet.border
    used = np.zeros(len(sheet.ab), np.bool_)
    used[faces] = True
    free = used & ~border
    rings = k.incident(faces, len(sheet.ab))
    residual = np.zeros(len(sheet.ab), np.float32)
    for axis in range(3):
        column = np.ascontiguousarray(sheet.xyz[:, axis])
        residual += (column - _ring(faces, rings, column)) * sheet.normal[:, axis]
    mean = _ring(faces, rings, residual)
    bend = np.abs(_ring(faces, rings, mean))
    residual -= mean
    corner = sheet.ab[faces]
    u, v = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = 0.5 * float(np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]).sum())
    levels = []
    for most in triangles:
        inner = int(free.sum()) - max(0, -(-(len(faces) - most) // 2))
        level = _Level(max(inner, 0), border.copy())
        if level.inner:
            level.chosen[_lattice(sheet, area, free, bend, residual, max(1, round(_FIRST * level.inner)))] = True
        levels.append(level)
    made = triangulations([sheet.ab[x.chosen] for x in levels])
    for left in range(_ROUNDS - 1, 0, -1):
        for x, d in zip(levels, made, strict=True):
            missing = x.inner - int((x.chosen & free).sum())
            x.chosen[_missed(d, sheet, faces, rings, x, free, -(-missing // left))] = True
        made = triangulations([sheet.ab[x.chosen] for x in levels])
    return [_kept(d, sheet, x.chosen) for x, d in zip(levels, made, strict=True)]
