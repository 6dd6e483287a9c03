"""Plane fits (IV-A)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from fringescope.errors import EmptyResultError
from fringescope.evaluate.form import FormFit, across
from fringescope.evaluate.statistics import BAND_MM, finite_points, sample, scale_of, spread, tile_form, triple, tukey
from fringescope.types import F64


@dataclass(frozen=True, eq=False, kw_only=True)
class PlaneFit(FormFit):
    """A plane: `(p - point) . normal = 0`, normal with positive z; its own points lie within the band."""

    point: tuple[float, float, float]
    normal: tuple[float, float, float]
    flying_ppm: float

    def lines(self) -> tuple[tuple[str, str], ...]:
        """Name and value of the main figures, for people."""
        form = (("form", f"{self.form_um:.2f} µm"),) if self.form_um is not None else ()
        flying = ("flying", f"{self.flying_ppm:.0f} ppm")
        return (("points", f"{self.inliers:,}"), *self.spread_lines(), *form, flying)


def search_plane(p: F64, band: float, rng: np.random.Generator, tries: int = 600) -> tuple[F64, F64, float]:
    """The plane that holds most of a sample within `band`: point, normal, share."""
    q = sample(p, rng)
    a, b, c = q[rng.integers(0, len(q), (3, tries))]
    normal = np.cross(b - a, c - a)
    length = np.linalg.norm(normal, axis=1)
    keep = length > 1e-9 * max(1.0, float(np.ptp(q, axis=0).max()) ** 2)
    if not keep.any():
        raise EmptyResultError("the points lie on one line; needed a surface to fit a plane")
    normal = normal[keep] / length[keep, None]
    offset = (normal * a[keep]).sum(1)
    count = np.array([(np.abs(q @ n - o) < band).sum() for n, o in zip(normal, offset, strict=True)])
    i = int(np.argmax(count))
    return a[keep][i], normal[i], float(count[i]) / len(q)


def refine_plane(p: F64, point: F64, normal: F64, band: float) -> tuple[F64, F64]:
    """Least squares with Tukey's weights on all points within the band, until nothing moves."""
    for _ in range(30):
        e = (p - point) @ normal
        near = np.abs(e) < band
        q = p[near]
        w = tukey(e[near] - np.median(e[near]), scale_of(e[near] - np.median(e[near])))
        centre = (w[:, None] * q).sum(0) / w.sum()
        d = q - centre
        fresh = np.linalg.eigh((w[:, None] * d).T @ d)[1][:, 0]
        fresh = fresh * np.sign(fresh @ normal or 1.0)
        moved = float(np.abs(fresh - normal).max()) * 100 + abs(float((centre - point) @ fresh))
        point, normal = centre, fresh
        if moved < 1e-9:
            break
    return point, normal


def fit_plane(xyz: ArrayLike, band_mm: float = BAND_MM, tile_mm: float = 3.0, seed: int = 0) -> PlaneFit:
    """The dominant plane of a cloud (n, 3): random triples, then least squares with Tukey's weights on all points.

    NaN points are left out before anything is counted (`error_mm` is of the finite ones, in order). Deterministic for
    one `seed`. Raises UsageError for another shape, EmptyResultError with fewer than 10 points or points on a line.
    """
    p = finite_points(xyz, 10)
    rng = np.random.default_rng(seed)
    point, normal, _ = search_plane(p, band_mm, rng)
    point, normal = refine_plane(p, point, normal, band_mm)
    return describe_plane(p, point, normal, band_mm, tile_mm)


def measure_plane(
    xyz: ArrayLike, point: ArrayLike, normal: ArrayLike, band_mm: float = BAND_MM, tile_mm: float = 3.0
) -> PlaneFit:
    """The figures of `fit_plane` about a plane that is known: nothing is fitted. `normal` need not be a unit vector."""
    p, n = finite_points(xyz, 1), np.asarray(normal, dtype=np.float64)
    return describe_plane(p, np.asarray(point, dtype=np.float64), n / np.linalg.norm(n), band_mm, tile_mm)


def describe_plane(p: F64, point: F64, normal: F64, band: float, tile: float) -> PlaneFit:
    """The figures of points (n, 3) about the plane through `point` with unit `normal`."""
    normal = normal * (np.sign(normal[2]) or 1.0)
    e = (p - point) @ normal
    near = np.abs(e) < band
    if not near.any():
        raise EmptyResultError(f"no point within {band:g} mm of the plane")
    flat = (p - point) @ across(normal)
    form, side = tile_form(flat[near], e[near], tile)
    return PlaneFit(
        point=triple(point),
        normal=triple(normal),
        inliers=int(near.sum()),
        flying_ppm=1e6 * float((~near).mean()),
        spread=spread(e[near]),
        form_um=None if form is None else 1e3 * form,
        tile_mm=side,
        error_mm=e,
        flat_mm=flat,
        own=near,
    )
