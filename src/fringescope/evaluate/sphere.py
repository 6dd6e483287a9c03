"""Sphere fits, several in one cloud (IV-B)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from fringescope.errors import EmptyResultError
from fringescope.evaluate.form import FormFit, across
from fringescope.evaluate.plane import refine_plane, search_plane
from fringescope.evaluate.statistics import BAND_MM, finite_points, sample, scale_of, spread, tile_form, triple, tukey
from fringescope.types import F64


@dataclass(frozen=True, eq=False, kw_only=True)
class SphereFit(FormFit):
    """A sphere; errors outside it are positive. Its own points lie within the band, and not nearer to the base plane.

    `cap_deg` is the polar angle that the inliers fill (180 = whole). With a nominal radius, `radius_error_um` is fitted
    minus nominal and `fixed_rms_um` the rms about the best sphere of exactly that radius. `flat_mm` unrolls the
    sphere about the middle of the cap (equal area).
    """

    center: tuple[float, float, float]
    radius_mm: float
    cap_deg: float
    nominal_radius_mm: float | None
    radius_error_um: float | None
    fixed_rms_um: float | None

    def lines(self) -> tuple[tuple[str, str], ...]:
        """Name and value of the main figures, for people."""
        error = self.radius_error_um
        told = (("radius error", f"{error:+.2f} µm".replace("-", "−")),) if error is not None else ()
        return (
            ("points", f"{self.inliers:,}"),
            ("radius", f"{self.radius_mm:.4f} mm"),
            *told,
            *self.spread_lines(),
        )


def fit_sphere(
    xyz: ArrayLike, nominal_radius_mm: float | None = None, band_mm: float = BAND_MM, seed: int = 0
) -> SphereFit:
    """The dominant sphere of a cloud; what else it holds (a base, other spheres) does no harm. See `fit_spheres`."""
    return fit_spheres(xyz, (nominal_radius_mm,) if nominal_radius_mm else (), band_mm, most=1, seed=seed)[0]


def fit_spheres(
    xyz: ArrayLike,
    nominal_radii_mm: Sequence[float] = (),
    band_mm: float = BAND_MM,
    most: int = 8,
    least_points: int = 200,
    seed: int = 0,
) -> tuple[SphereFit, ...]:
    """The spheres of a cloud (n, 3), most points first, each by geometric least squares with Tukey's weights.

    Found by random local quadruples after the dominant plane (a base) is set aside, fitted to all points within
    `band_mm`. A cap must rise by 0.15 radii and 4 bands to count: a plane is no sphere. `nominal_radii_mm`: each found
    sphere is compared with the nearest of them. NaN points are left out; deterministic for one `seed`. Raises
    EmptyResultError if there is no sphere, UsageError for another shape.
    """
    p = finite_points(xyz, 20)
    rng = np.random.default_rng(seed)
    base = np.full(len(p), np.inf)  # distance to the plane that the spheres stand on
    point, normal, share = search_plane(p, band_mm, rng)
    if share > 0.1:
        point, normal = refine_plane(p, point, normal, band_mm)
        base = np.abs((p - point) @ normal)
    free = base > 2 * band_mm
    out: list[SphereFit] = []
    while len(out) < most and free.sum() >= least_points:
        found = _search_sphere(p[free], band_mm, rng)
        if found is None:
            break
        centre, radius = _refine_sphere(p[base > band_mm], *found, band_mm)
        fit = _describe_sphere(p, base, centre, radius, band_mm, nominal_radii_mm)
        if fit.inliers < least_points:
            break
        out.append(fit)
        free &= np.abs(fit.error_mm) > 3 * band_mm
    if not out:
        raise EmptyResultError(f"no sphere among {len(p)} points; needed a cap of at least {least_points} of them")
    return tuple(sorted(out, key=lambda s: -s.inliers))


def _search_sphere(p: F64, band: float, rng: np.random.Generator, tries: int = 3000) -> tuple[F64, float] | None:
    """The best sphere of a sample: centre and radius, or None."""
    q = sample(p, rng)
    extent = float(np.linalg.norm(np.ptp(np.percentile(q, [1, 99], axis=0), axis=0)))
    tree = cKDTree(q)
    quads = []
    for k in (12, 50, 200, 800):  # caps of many sizes
        if k <= len(q):
            around = np.asarray(tree.query(q[rng.integers(0, len(q), tries // 4)], k)[1])
            quads.append(q[np.take_along_axis(around, rng.integers(0, k, (len(around), 4)), axis=1)])
    if not quads:
        return None
    a = np.concatenate(quads)
    M = 2 * (a[:, 1:] - a[:, :1])
    solid = np.abs(np.linalg.det(M)) > 1e-12 * extent**3
    a, M = a[solid], M[solid]
    centre = np.linalg.solve(M, (a[:, 1:] ** 2).sum(2, keepdims=True) - (a[:, :1] ** 2).sum(2, keepdims=True))[:, :, 0]
    radius = np.linalg.norm(a[:, 0] - centre, axis=1)
    sane = (radius < extent) & (radius > 4 * band)
    centre, radius = centre[sane], radius[sane]
    tested: list[tuple[F64, float]] = []
    coarse = q[rng.choice(len(q), min(len(q), 2500), replace=False)]
    pairs = zip(centre, radius, strict=True)
    score = np.array([(np.abs(np.linalg.norm(coarse - c, axis=1) - r) < 2 * band).sum() for c, r in pairs])
    best: tuple[int, F64, float] | None = None
    for i in np.argsort(-score, kind="stable")[:60]:
        c, r = centre[i], float(radius[i])
        if any(np.abs(c - d).max() + abs(r - s) < 0.2 * s for d, s in tested):
            continue
        try:
            for width in (8 * band, 4 * band, 2 * band, band, band):
                c, r = _algebraic(q[np.abs(np.linalg.norm(q - c, axis=1) - r) < width])
        except EmptyResultError:
            continue
        tested.append((c, r))
        e = np.linalg.norm(q - c, axis=1) - r
        on = np.abs(e) < band
        if on.sum() < 20 or not 4 * band < r < extent or _rise(q[on], c) < max(4 * band, 0.15 * r):
            continue
        if scale_of(e[on] - np.median(e[on])) < 0.35 * band and (best is None or int(on.sum()) > best[0]):
            best = int(on.sum()), c, r
    return None if best is None else best[1:]


def _rise(q: F64, centre: F64) -> float:
    """How far a cap rises along its own axis, mm."""
    d = q - centre
    axis = d.mean(0)
    h = d @ axis / max(float(np.linalg.norm(axis)), 1e-12)
    low, high = np.percentile(h, [2, 98])
    return float(high - low)


def _algebraic(q: F64) -> tuple[F64, float]:
    """Linear least-squares sphere, a start for the geometric one."""
    if len(q) < 8:
        raise EmptyResultError("too few points for a sphere")
    m = q.mean(0)
    d = q - m
    s = (d**2).sum(1)
    M = 4 * d.T @ d  # with the mean at the origin, centre and radius part
    if np.linalg.cond(M) > 1e10:
        raise EmptyResultError("the points do not bend like a sphere")
    c = np.linalg.solve(M, 2 * d.T @ s)
    return c + m, math.sqrt(float(s.mean() + c @ c))


def _refine_sphere(p: F64, centre: F64, radius: float, band: float, fixed: bool = False) -> tuple[F64, float]:
    """Gauss-Newton on distances with Tukey's weights, on all points within the band; `fixed` keeps the radius."""
    p = p[np.abs(np.linalg.norm(p - centre, axis=1) - radius) < 5 * band]
    for _ in range(40):
        d = p - centre
        length = np.sqrt((d**2).sum(1))
        near = np.abs(length - radius) < band
        e, u = length[near] - radius, d[near] / length[near, None]
        if len(e) < 8:
            break
        w = tukey(e - np.median(e), scale_of(e - np.median(e)))
        J = u if fixed else np.column_stack([u, np.ones(len(u))])
        step = np.linalg.solve((w[:, None] * J).T @ J + 1e-12 * np.eye(J.shape[1]), J.T @ (w * e))
        centre, radius = centre + step[:3], radius if fixed else radius + float(step[3])
        if np.abs(step).max() < 1e-10:
            break
    return centre, radius


def _describe_sphere(
    p: F64, base: F64, centre: F64, radius: float, band: float, nominal: Sequence[float]
) -> SphereFit:
    d = p - centre
    length = np.linalg.norm(d, axis=1)
    e = length - radius
    near = (np.abs(e) < band) & (np.abs(e) <= base)
    unit = d / np.maximum(length, 1e-12)[:, None]
    axis = unit[near].mean(0)
    axis /= max(float(np.linalg.norm(axis)), 1e-12)
    height = np.clip(unit @ axis, -1, 1)
    flat = radius * np.sqrt(2 / np.maximum(1 + height, 1e-9))[:, None] * (unit @ across(axis))
    tile = min(3.0, radius / 3)
    form, tile = tile_form(flat[near], e[near], tile)
    named = min(nominal, key=lambda r: abs(r - radius)) if nominal else None
    fixed_rms = None
    if named is not None:
        c, _ = _refine_sphere(p[near], centre, named, band + abs(named - radius), fixed=True)
        fixed_rms = 1e3 * float(np.sqrt(np.mean((np.linalg.norm(p[near] - c, axis=1) - named) ** 2)))
    return SphereFit(
        center=triple(centre),
        radius_mm=radius,
        inliers=int(near.sum()),
        spread=spread(e[near]),
        form_um=None if form is None else 1e3 * form,
        tile_mm=tile,
        cap_deg=2 * math.degrees(math.acos(float(np.percentile(height[near], 2)))),
        nominal_radius_mm=named,
        radius_error_um=None if named is None else 1e3 * (radius - named),
        fixed_rms_um=fixed_rms,
        error_mm=e,
        flat_mm=flat,
        own=near,
    )
