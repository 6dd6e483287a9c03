"""Repeated scans of a still scene: the spread that was seen and the one that was predicted."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.stats import chi2

from fringescope.errors import EmptyResultError, UsageError
from fringescope.types import Grid


@dataclass(frozen=True)
class Repeatability:
    """Spread of repeated scans along the camera's rays, pixel by pixel.

    `std_um` and `sigma_um` are medians over the pixels of what was seen and what was predicted; `ratio` is seen over
    predicted (1 = calibrated), from the median of the variance ratio. `drift_um`: largest median shift of one scan.
    """

    camera: str
    scans: int
    pixels: int
    std_um: float
    sigma_um: float
    ratio: float
    drift_um: float

    def to_dict(self) -> dict[str, Any]:
        """Numbers only, for `--json`."""
        return dataclasses.asdict(self)


def repeatability(grids: Sequence[Grid]) -> Repeatability:
    """Spread of repeated scans of a still scene by one camera, and whether sigma predicts it (IV-A; style: sample it).

    Pixels valid in every scan count. A pixel's points lie on one ray, so their spread in space is that along the ray.
    Raises UsageError with fewer than 2 grids, or grids of different size or camera; EmptyResultError if no pixel is
    valid in all.
    """
    if len(grids) < 2 or len({(g.camera, g.xyz.shape) for g in grids}) != 1:
        names = ", ".join(sorted({g.camera for g in grids})) or "none"
        raise UsageError(f"{len(grids)} grids ({names}); needed 2 or more of one camera and size")
    both = np.all([g.valid for g in grids], axis=0)
    if not both.any():
        raise EmptyResultError(f"no pixel of '{grids[0].camera}' is valid in all {len(grids)} scans")
    xyz = np.stack([g.xyz[both] for g in grids]).astype(np.float64)
    sigma2 = np.mean([g.sigma[both].astype(np.float64) ** 2 for g in grids], axis=0)
    mean = xyz.mean(0)
    d = xyz - mean
    k = len(grids)
    variance = (d**2).sum(2).sum(0) / (k - 1)
    usual = float(chi2.median(k - 1)) / (k - 1)
    axis = np.linalg.eigh(np.einsum("kni,knj->ij", d, d))[1][:, 2]  # the rays of one camera are nearly parallel
    drift = float(np.abs(np.median(d @ axis, axis=1)).max())
    return Repeatability(
        camera=grids[0].camera,
        scans=k,
        pixels=int(both.sum()),
        std_um=1e3 * math.sqrt(float(np.median(variance)) / usual),
        sigma_um=1e3 * math.sqrt(float(np.median(sigma2))),
        ratio=math.sqrt(float(np.median(variance / sigma2)) / usual),
        drift_um=1e3 * drift,
    )
