"""Delaunay triangulations of points in the plane that may grow; they are unique and hold for subsets, edge by edge."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fringescope.errors import UsageError
from fringescope.kernels import delaunay as k
from fringescope.types import F64, AnyArray

I32 = NDArray[np.int32]
I64 = NDArray[np.int64]

_BITS = 11  # of each coordinate that order the points: 2048 x 2048 cells


def snapped(ab: AnyArray) -> F64:
    """Points (n, 2) on a lattice of whole numbers from 0 to below 2^25: moved and scaled by a power of two, rounded.

    That is a part in 16 million of the larger side or finer. Points that fall on each other are one.
    Raises UsageError for coordinates that are not finite.
    """
    if not np.isfinite(ab.sum()) and not np.isfinite(ab).all():
        bad = int((~np.isfinite(ab).all(axis=1)).sum())
        raise UsageError(f"{bad} of {len(ab)} points have no coordinates; needed finite numbers")
    if not len(ab):
        return np.zeros((0, 2))
    low = np.array([ab[:, 0].min(), ab[:, 1].min()])
    size = float(max(ab[:, 0].max() - low[0], ab[:, 1].max() - low[1]))
    scale = 2.0 ** math.floor(math.log2((k.SIDE - 1) / size)) if size > 0.0 else 1.0
    return np.asarray(np.rint((ab - low) * scale), dtype=np.float64)


def along_curve(ab: F64) -> I64:
    """Indices (n,) of snapped points in order along a Hilbert curve: what follows each other lies near each other."""
    key = np.empty(len(ab), np.int64)
    order = np.empty(len(ab), np.int64)
    k.hilbert(ab, _BITS, key)
    k.sort_by(key, 2 * _BITS, order)
    return order


class Triangulation:
    """The Delaunay triangulation of those of the snapped points `ab` (n, 2) that were put in so far.

    `room` is how many may be put in altogether. Fast where the indices follow a curve as `along_curve` gives it, right
    for any order. Of points on each other one is a corner; points on one line have no triangles.
    """

    def __init__(self, ab: F64, at: I64, room: int | None = None) -> None:
        self._ab = ab
        self._net = np.empty(16 * max(len(at), room or 0, 3) + 16, np.int32)
        self._at: I64 = np.zeros(0, np.int64)
        self._used = self._near = 0
        self.add(at)

    def add(self, at: I64) -> None:
        """Put in the points with the indices `at` (m,)."""
        j = m = -1
        if not self._used:
            at = np.concatenate([self._at, at])
            j, m = k.first_triangle(self._ab, at, self._net) if len(at) > 2 else (-1, -1)
            if m < 0:  # nothing but a line: kept until there is more
                self._at = at
                return
            self._used = 32
        self._used, self._near = k.insert(self._ab, at, self._net, self._used, self._near, j, m)

    def triangles(self) -> tuple[I32, I32]:
        """Corners (m, 3), counter-clockwise, as indices of points; neighbours (m, 3) opposite of them, -1 for none."""
        count = self._used // 8
        simplices, neighbours = np.empty((count, 3), np.int32), np.empty((count, 3), np.int32)
        m = k.finite(self._net, self._used, np.empty(count, np.int32), simplices, neighbours)
        return simplices[:m], neighbours[:m]
