"""The whole judgement of one cloud, as `fringescope evaluate` prints it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from fringescope.errors import UsageError
from fringescope.evaluate.plane import PlaneFit, describe_plane, fit_plane, refine_plane, search_plane
from fringescope.evaluate.sphere import SphereFit, fit_spheres
from fringescope.evaluate.statistics import BAND_MM, along_rays, neighbour_correlation, plain, sigma_ratio
from fringescope.types import F64, Bool

RATIO = (0.8, 1.25)  #: robust spread of error over sigma that counts as calibrated
ALIKE = 0.4  #: neighbours' errors more alike than this did not come from samples of their own


@dataclass(frozen=True, eq=False)
class Evaluation:
    """What `evaluate` found in a cloud: a plane, or spheres with the plane that they stand on (if there is one).

    `error_mm` (n,) is each point's distance to its own form (NaN for flying points). `sigma_ratio`: robust spread of
    error over sigma, 1 where the uncertainty is calibrated (None without sigmas). `center_distances_mm`: (i, j, mm).
    `words`: what the figures mean where they are not as they should be.
    """

    kind: str
    points: int
    band_mm: float
    flying_ppm: float
    plane: PlaneFit | None
    spheres: tuple[SphereFit, ...]
    center_distances_mm: tuple[tuple[int, int, float], ...]
    sigma_ratio: float | None
    neighbour_correlation: float | None
    words: tuple[str, ...]
    error_mm: F64

    def to_dict(self) -> dict[str, Any]:
        """Numbers only, for `--json`."""
        d = plain(self)
        d["plane"] = self.plane.to_dict() if self.plane else None
        d["spheres"] = [s.to_dict() for s in self.spheres]
        return d


def evaluate(
    xyz: ArrayLike,
    fit: str,
    nominal_radii_mm: Sequence[float] = (),
    sigma_mm: ArrayLike | None = None,
    view: ArrayLike | None = None,
    centres: ArrayLike | None = None,
    band_mm: float = BAND_MM,
    seed: int = 0,
) -> Evaluation:
    """Fit a cloud (n, 3) and say how good it is: `fit` is "plane", or "sphere" for all spheres and their base plane.

    `sigma_mm` (n,) along the rays, `view` (n,) and `centres` (V, 3), the cameras' centres in the world, make
    `sigma_ratio`; without centres the error is taken along the normal. Points with NaN are left out. Raises UsageError
    for another `fit`, EmptyResultError if there is no such form.
    """
    if fit not in ("plane", "sphere"):
        raise UsageError(f"fit '{fit}'; needed \"plane\" or \"sphere\"")
    if not 0 < band_mm < np.inf:
        raise UsageError(f"band of {band_mm} mm; needed a positive length")
    every = np.asarray(xyz, dtype=np.float64)
    if every.ndim != 2 or every.shape[1] != 3:
        raise UsageError(f"points of shape {every.shape}; needed (n, 3)")
    finite = np.isfinite(every).all(1)
    p = every[finite]
    views = None if view is None else np.asarray(view)[finite]
    spheres: tuple[SphereFit, ...] = ()
    plane: PlaneFit | None
    if fit == "plane":
        plane = fit_plane(p, band_mm, seed=seed)
    else:
        spheres = fit_spheres(p, nominal_radii_mm, band_mm, seed=seed)
        rest = ~np.any([s.own for s in spheres], axis=0)
        plane = _base(p, rest, band_mm, seed)
    error = np.full(len(p), np.nan)
    normal = np.zeros((len(p), 3))
    for s in reversed(spheres):
        error[s.own] = s.error_mm[s.own]
        normal[s.own] = (p[s.own] - s.center) / s.radius_mm
    if plane is not None:
        own = plane.own & np.isnan(error)
        error[own] = plane.error_mm[own]
        normal[own] = plane.normal
    ratio, along = None, views is not None and centres is not None
    if sigma_mm is not None:
        e = error
        if views is not None and centres is not None:
            e = along_rays(error, normal, p, np.asarray(centres, dtype=np.float64)[views])
        ratio = sigma_ratio(e, np.asarray(sigma_mm)[finite])
    distances = tuple(
        (i, j, float(np.linalg.norm(np.subtract(a.center, b.center))))
        for i, a in enumerate(spheres)
        for j, b in enumerate(spheres[i + 1 :], i + 1)
    )
    alike = neighbour_correlation(p, error, views)
    return Evaluation(
        fit, len(p), band_mm, 1e6 * float(np.isnan(error).mean()), plane, spheres, distances, ratio, alike,
        _words(ratio, along, alike), error,
    )  # fmt: skip


def _words(ratio: float | None, along: bool, alike: float | None) -> tuple[str, ...]:
    """What a sigma that does not fit the errors, and errors that are alike, tell."""
    out = []
    if ratio is not None and ratio > RATIO[1]:
        out.append(
            f"errors are {ratio:.2g} times what sigma says: vibration, light from surface to surface, a rig that has "
            "drifted, or a form that is not quite this one"
        )
    if ratio is not None and ratio < RATIO[0]:
        out.append(
            f"errors are only {ratio:.2g} of what sigma says: "
            + (
                "something smoothed the points or their frames, or the capture's noise figures are too high"
                if along
                else "sigma is along the camera's ray, the error here across the form: give the rig to compare them"
            )
        )
    if alike is not None and alike > ALIKE:
        out.append(
            f"errors of neighbours are alike (correlation {alike:.2f}): frames with interpolated pixels (demosaiced, "
            "scaled, smoothed, JPEG), or an error that is not noise"
        )
    return tuple(out)


def _base(p: F64, rest: Bool, band: float, seed: int) -> PlaneFit | None:
    """The plane under the spheres, if a fifth of the remaining points lies on one."""
    if rest.sum() < max(100, 0.05 * len(p)):
        return None
    point, normal, share = search_plane(p[rest], band, np.random.default_rng(seed))
    if share < 0.2:
        return None
    point, normal = refine_plane(p[rest], point, normal, band)
    return describe_plane(p, point, normal, band, 3.0)
