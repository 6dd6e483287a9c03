"""Robust statistics of errors; what every fit shares."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fringescope.errors import EmptyResultError, UsageError
from fringescope.types import F64

BAND_MM = 0.2  #: farther than this from the form is a flying point
MAD = 1.482602218505602  #: robust standard deviation of a normal distribution over its median absolute deviation
TUKEY = 4.685  #: cut-off, in standard deviations, of Tukey's biweight (95 % efficient)
SAMPLE = 20_000  #: points in which forms are searched; they are fitted to all


@dataclass(frozen=True)
class Spread:
    """Statistics of signed errors: `bias` = median, `std` robust (1.4826 MAD), the others plain; micrometres."""

    points: int
    bias_um: float
    std_um: float
    std_plain_um: float
    rms_um: float
    p95_um: float
    p99_um: float
    max_um: float


def plain(x: Any) -> dict[str, Any]:
    """The fields of a result without its arrays."""
    out: dict[str, Any] = {}
    for f in dataclasses.fields(x):
        v = getattr(x, f.name)
        if isinstance(v, np.ndarray):
            continue
        out[f.name] = dataclasses.asdict(v) if dataclasses.is_dataclass(v) and not isinstance(v, type) else v
    return out


def spread(error_mm: ArrayLike) -> Spread:
    """Bias, spread and tail of signed errors in mm; NaN are left out. Raises EmptyResultError if none is left."""
    e = np.asarray(error_mm, dtype=np.float64).ravel()
    e = e[np.isfinite(e)]
    if not len(e):
        raise EmptyResultError("no finite error to take statistics of; needed at least one point on the form")
    median, size = float(np.median(e)), np.abs(e)
    p95, p99 = np.percentile(size, [95, 99])
    return Spread(
        len(e), 1e3 * median, 1e3 * MAD * float(np.median(np.abs(e - median))), 1e3 * float(e.std()),
        1e3 * float(np.sqrt(np.mean(e**2))), 1e3 * float(p95), 1e3 * float(p99), 1e3 * float(size.max()),
    )  # fmt: skip


def sigma_ratio(error_mm: ArrayLike, sigma_mm: ArrayLike) -> float:
    """Robust spread (1.4826 MAD) of error over sigma: 1 where the uncertainty is calibrated. NaN are left out.

    Errors and sigmas must be of one kind; `along_rays` turns distances from a surface into those along rays.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.asarray(error_mm, dtype=np.float64) / np.asarray(sigma_mm, dtype=np.float64)
    z = z[np.isfinite(z)]
    if not len(z):
        raise EmptyResultError("no point with an error and a sigma; needed at least one")
    return MAD * float(np.median(np.abs(z - np.median(z))))


def along_rays(error_mm: ArrayLike, normals: ArrayLike, xyz: ArrayLike, centre: ArrayLike) -> F64:
    """Distances (n,) from a surface turned into distances along the rays from `centre` (3,) or (n, 3).

    `normals` (3,) or (n, 3) unit normals of the surface at the points. Positive = farther from the camera where the
    normal points away from it. NaN where the ray grazes the surface (under 0.6 degrees).
    """
    ray = np.asarray(xyz, dtype=np.float64) - np.asarray(centre, dtype=np.float64)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    cosine = (ray * np.asarray(normals, dtype=np.float64)).sum(-1)
    cosine[np.abs(cosine) < 0.01] = np.nan
    out: F64 = np.asarray(error_mm, dtype=np.float64) / cosine
    return out


def tile_form(flat_mm: F64, error_mm: F64, tile_mm: float, least: int = 200) -> tuple[float | None, float]:
    """Low-order form error, mm, and the side of the square tiles that it was taken with.

    The standard deviation of the medians of tiles with more than `least` points, which holds hardly any pixel noise.
    Tiles grow, from `tile_mm` by halves to at most 8 times that, until such tiles hold half of the points and there are
    3 of them; None if that is never so.
    """
    for side in tile_mm * 1.5 ** np.arange(6):
        cell = np.floor(flat_mm / side).astype(np.int64)
        cell -= cell.min(0, initial=0)
        key = cell[:, 0] * (int(cell[:, 1].max(initial=0)) + 1) + cell[:, 1]
        count = np.unique(key, return_counts=True)[1]
        full = count > least
        if full.sum() < 3 or 2 * count[full].sum() < len(key):
            continue
        ordered = error_mm[np.lexsort((error_mm, key))]
        first = np.cumsum(count) - count
        medians = 0.5 * (ordered[first + (count - 1) // 2] + ordered[first + count // 2])[full]
        return float(medians.std()), float(side)
    return None, tile_mm


def neighbour_correlation(xyz: F64, error_mm: F64, view: NDArray[Any] | None = None) -> float | None:
    """Correlation of the errors of points that follow each other in a row of one view.

    Near 0 where each point stands on its own samples, high where a filter smoothed. Points must lie row by row, view by
    view, NaN errors are left out; None with fewer than 100 pairs.
    """
    near = np.isfinite(error_mm[1:]) & np.isfinite(error_mm[:-1])
    if view is not None:
        near &= view[1:] == view[:-1]
    if near.sum() < 100:
        return None
    distance = np.linalg.norm(xyz[1:] - xyz[:-1], axis=1)
    limit = 4 * MAD * np.nanmedian(np.abs(error_mm))
    with np.errstate(invalid="ignore"):
        small = np.abs(error_mm) < limit
    near &= (distance < 1.5 * np.median(distance[near])) & small[1:] & small[:-1]
    if near.sum() < 100:
        return None
    return float(np.corrcoef(error_mm[:-1][near], error_mm[1:][near])[0, 1])


def finite_points(xyz: ArrayLike, least: int) -> F64:
    """The finite ones of points (n, 3). Raises UsageError for another shape, EmptyResultError if under `least`."""
    p = np.asarray(xyz, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3:
        raise UsageError(f"points of shape {p.shape}; needed (n, 3)")
    finite = np.isfinite(p).all(1)
    p = p if finite.all() else p[finite]
    if len(p) < least:
        raise EmptyResultError(f"{len(p)} finite points; needed at least {least} for a fit")
    return p


def sample(p: F64, rng: np.random.Generator, n: int = SAMPLE) -> F64:
    """At most `n` of the points, drawn at random."""
    return p if len(p) <= n else p[rng.choice(len(p), n, replace=False)]


def tukey(e: F64, scale: float) -> F64:
    """Tukey's biweight of residuals of standard deviation `scale`: 1 at zero, 0 from the cut-off on."""
    w = 1 - (e / (TUKEY * scale)) ** 2
    return np.where(w > 0, w, 0.0) ** 2


def scale_of(e: F64) -> float:
    """Robust standard deviation of centred residuals, never zero."""
    return max(MAD * float(np.median(np.abs(e))), 1e-9)


def triple(v: F64) -> tuple[float, float, float]:
    """Three floats."""
    return float(v[0]), float(v[1]), float(v[2])
