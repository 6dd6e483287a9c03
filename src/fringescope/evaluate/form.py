"""What every fitted form tells of its points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fringescope.evaluate.statistics import Spread, plain
from fringescope.types import F64, Bool


@dataclass(frozen=True, eq=False, kw_only=True)
class FormFit:
    """The points of a form: `error_mm` (n,) signed distances of all points, `own` (n,) which of them are its own.

    `form_um` is the low-order shape error: standard deviation of the medians of tiles of `tile_mm`, free of pixel
    noise (None if there are too few points). `flat_mm` (n, 2) are coordinates within the form.
    """

    inliers: int
    spread: Spread
    form_um: float | None
    tile_mm: float
    error_mm: F64
    flat_mm: F64
    own: Bool

    def to_dict(self) -> dict[str, Any]:
        """Numbers only, for `--json`."""
        return plain(self)

    @property
    def deviation_um(self) -> F64:
        """(n,) deviation of the form's own points, NaN elsewhere: with `flat_mm` what `report.error_map` draws."""
        return np.where(self.own, 1e3 * self.error_mm, np.nan)

    def spread_lines(self) -> tuple[tuple[str, str], ...]:
        """Name and value of the spread's main figures, for people."""
        s = self.spread
        return (("std", f"{s.std_um:.2f} µm"), ("rms", f"{s.rms_um:.2f} µm"), ("p99", f"{s.p99_um:.1f} µm"))


def across(normal: F64) -> F64:
    """Two unit vectors (3, 2) that span the plane across a unit `normal` (3,)."""
    x = np.array([1.0, 0, 0]) if abs(normal[0]) < 0.9 else np.array([0, 1.0, 0])
    x -= (x @ normal) * normal
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(normal, x)], 1)
