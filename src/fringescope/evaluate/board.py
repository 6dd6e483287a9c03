"""Trueness on a calibration board: measured corners against the printed grid, seen through whole reconstructions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from fringescope import geometry
from fringescope.errors import EmptyResultError
from fringescope.evaluate.statistics import plain
from fringescope.types import F64, I32, Board, Grid, Rig, Sighting

LEAST_POINTS = 24  #: surface points around a corner that give its depth
LEAST_CORNERS = 8


@dataclass(frozen=True)
class BoardTrueness:
    """Measured corners against the board's grid, all views together.

    `rms_um` is what remains after a rigid motion, per coordinate in space; `scale_error_ppm` (with its standard error)
    is how much too large the board is measured; `form_um` the rms out of the plane; `views_um` the distance between the
    places where different views put the same corner (median, None with one view).
    """

    corners: int
    rms_um: float
    form_um: float
    scale_error_ppm: float
    scale_sigma_ppm: float
    views_um: float | None

    def to_dict(self) -> dict[str, Any]:
        """For JSON."""
        return plain(self)


def corners_in_space(grid: Grid, sighting: Sighting, rig: Rig) -> F64:
    """World places (n, 3), mm, of a sighting's corners: each pixel's ray meets the plane of the points around it.

    NaN where too few points are around. The window is as wide as the corners are apart, so that bright squares on both
    sides of a corner carry it.
    """
    camera = rig.cameras[grid.view]
    H, W = grid.reasons.shape
    px = sighting.corner_px
    out = np.full((len(px), 3), np.nan)
    if len(px) < 2:
        return out
    gaps = np.linalg.norm(px[:, None] - px[None], axis=2)
    np.fill_diagonal(gaps, np.inf)
    reach = max(2, int(0.9 * np.median(gaps.min(axis=1))))
    origin, rays = geometry.world_rays(camera, px)
    for i, (u, v) in enumerate(np.rint(px).astype(int)):
        rows, columns = slice(max(v - reach, 0), min(v + reach + 1, H)), slice(max(u - reach, 0), min(u + reach + 1, W))
        p = grid.xyz[rows, columns][grid.valid[rows, columns]].astype(np.float64)
        plane = _robust_plane(p)
        if plane is None:
            continue
        point, normal = plane
        slope = float(rays[i] @ normal)
        if abs(slope) > 0.05:
            out[i] = origin + rays[i] * float((point - origin) @ normal) / slope
    return out


def _robust_plane(p: F64) -> tuple[F64, F64] | None:
    for _ in range(4):
        if len(p) < LEAST_POINTS:
            return None
        middle = p.mean(axis=0)
        normal = np.linalg.svd(p - middle, full_matrices=False)[2][2]
        off = (p - middle) @ normal
        limit = 3.5 * 1.4826 * float(np.median(np.abs(off))) + 1e-9
        if (np.abs(off) <= limit).all():
            break
        p = p[np.abs(off) <= limit]
    return middle, normal


def board_trueness(grids: Sequence[Grid], sightings: Sequence[Sighting], board: Board, rig: Rig) -> BoardTrueness:
    """How true a rig measures a board of one pose; `sightings` agree on the numbering of the corners.

    Raises EmptyResultError if fewer than 8 corners lie on measured surface.
    """
    seen = {s.camera: s for s in sightings}
    at: dict[tuple[int, int], list[F64]] = {}
    for g in grids:
        if g.camera not in seen:
            continue
        places = corners_in_space(g, seen[g.camera], rig)
        index = _numbered(places, seen[g.camera].corner, at, board)
        for place, i in zip(places, index, strict=True):
            if np.isfinite(place).all():
                at.setdefault((int(i[0]), int(i[1])), []).append(place)
    if len(at) < LEAST_CORNERS:
        raise EmptyResultError(f"{len(at)} corners of the board lie on measured surface; needed {LEAST_CORNERS}")
    index = np.array([k for k, v in at.items() for _ in v], dtype=np.int32)
    places = np.array([p for v in at.values() for p in v])
    wanted = board.corner_mm(index)
    keep = np.ones(len(places), bool)
    for _ in range(3):
        T, scale = geometry.similarity(wanted[keep], places[keep])
        rest = places - geometry.transform(T, wanted)
        size = np.linalg.norm(rest, axis=1)
        keep = size <= 5 * float(np.median(size)) + 1e-9
    rest = rest[keep] @ T.R  # board coordinates
    spread = float(np.sqrt(((wanted[keep] - wanted[keep].mean(axis=0)) ** 2).sum()))
    rms = float(np.sqrt(np.mean(rest**2)))
    apart = [float(np.linalg.norm(np.array(v) - np.mean(v, axis=0), axis=1).mean()) * 2 for v in at.values() if v[1:]]
    return BoardTrueness(
        len(at),
        1e3 * rms,
        1e3 * float(np.sqrt(np.mean(rest[:, 2] ** 2))),
        1e6 * (scale - 1),
        1e6 * rms / spread,
        1e3 * float(np.median(apart)) if apart else None,
    )


def _numbered(places: F64, index: I32, at: dict[tuple[int, int], list[F64]], board: Board) -> I32:
    """The numbers of corners that lie at `places`, shifted or turned to agree with those that other views gave.

    A view that sees part of a chequerboard, or one that looks the same after half a turn, numbers from another end.
    """
    if not at or not np.isfinite(places[:, 0]).any():
        return index
    known = np.array([v[0] for v in at.values()])
    number = np.array(list(at), dtype=np.int32)
    ok = np.isfinite(places[:, 0])
    distance, nearest = cKDTree(known).query(places[ok])
    near = np.asarray(distance < board.square_mm / 3)
    nearest = np.asarray(nearest)
    if not near.any():
        return index
    best, votes = index, -1
    for turned in (index, -index):
        shifts, counts = np.unique(number[nearest[near]] - turned[ok][near], axis=0, return_counts=True)
        if counts.max() > votes:
            best, votes = turned + shifts[np.argmax(counts)], int(counts.max())
    return best.astype(np.int32)
