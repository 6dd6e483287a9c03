"""Does a view agree with itself? Where fringes ran in two directions, one gives depth and the other tests the rig."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fringescope import geometry
from fringescope.evaluate.agreement import LEAST, systematic_part
from fringescope.types import Decoded, Direction, Grid, Rig


@dataclass(frozen=True)
class EpipolarResidual:
    """By how much the light misses the place on the projector where the rig expects it, across the depth direction.

    In um on the specimen: median of absolute values, and the part that noise cannot make (see `systematic_part`).
    """

    camera: str
    points: int
    median_um: float
    systematic_um: float


def epipolar_residual(grid: Grid, decoded: Decoded, other: Direction, rig: Rig) -> EpipolarResidual | None:
    """Residual of direction `other` at the points of `grid`, which another direction gave; None without points."""
    projector = rig.projector
    ok = grid.valid & np.isfinite(other.phase)
    rows, columns = np.nonzero(ok)
    if len(rows) < LEAST:
        return None
    p = grid.xyz[rows, columns].astype(np.float64)
    rest = other.phase[rows, columns] - geometry.phase_at(projector, other.g, p)
    depth = float(np.median(geometry.transform(projector.pose, p)[:, 2]))
    fx, fy = projector.lens.K[0, 0], projector.lens.K[1, 1]
    along = np.hypot(other.g[0] * fx, other.g[1] * fy)  # cycles per unit of the ideal image plane
    um = 1e3 * depth * rest / (2 * np.pi * along)
    systematic = systematic_part(rows, columns, um, decoded.shape)
    return EpipolarResidual(grid.camera, len(rows), float(np.median(np.abs(um))), systematic)
