"""What guidance stands on: a scan's organised points, its fused surface as the projector sees it, and the rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fringescope import geometry
from fringescope.errors import EmptyResultError, GuidanceError
from fringescope.guide import relief
from fringescope.guide.relief import Relief
from fringescope.settings import GuideSettings
from fringescope.types import F64, Bool, Grid, Rig, Surface

SUPPORT_MM = 0.4  #: another camera's point this near, and its sampling, says that a place was measured


@dataclass(frozen=True, eq=False)
class Tissue:
    """A scan made ready for guidance, once for all its strokes."""

    rig: Rig
    grids: tuple[Grid, ...]
    relief: Relief
    spans: tuple[tuple[float, float], ...]  #: nearest and farthest range of each grid's points from its camera, mm
    footprints: tuple[float, ...]  #: mm that a pixel of each grid covers, across its ray
    sigmas: tuple[float, ...]  #: median of the error along its rays, mm

    def number(self, camera: str) -> int:
        """Which of the grids is that of a camera. Raises GuidanceError if the scan has none."""
        for i, g in enumerate(self.grids):
            if g.camera == camera:
                return i
        raise GuidanceError(f"camera '{camera}': the scan has {', '.join(g.camera for g in self.grids)}")

    def supported(self, p: F64, camera: str | None = None, slack_mm: float = SUPPORT_MM) -> Bool:
        """Whether points (n, 3) lie within `slack_mm`, and the sampling, of what some camera but `camera` measured."""
        out = np.zeros(len(p), bool)
        for g, footprint in zip(self.grids, self.footprints, strict=True):
            if g.camera == camera:
                continue
            uv = geometry.project(self.rig.cameras[g.view], p)
            H, W = g.reasons.shape
            with np.errstate(invalid="ignore"):
                k = np.flatnonzero((uv >= -0.5).all(1) & (uv[:, 0] < W - 0.5) & (uv[:, 1] < H - 0.5) & ~out)
            c, r = np.floor(uv[k] + 0.5).astype(np.intp).T
            near = np.linalg.norm(g.xyz[r, c] - p[k], axis=1)
            out[k] = (g.reasons[r, c] == 0) & (near <= slack_mm + footprint)
        return out


def tissue(grids: Sequence[Grid], surface: Surface | None, rig: Rig, s: GuideSettings) -> Tissue:
    """A scan's grids and its surface, made ready. Raises EmptyResultError for a scan without a surface or points."""
    if surface is None or not surface.n_faces:
        raise EmptyResultError("the scan has no surface, so nothing can be drawn on it; scan again with more points")
    spans, footprints, sigmas = [], [], []
    for g in grids:
        camera = rig.cameras[g.view]
        every = tuple(slice(None, None, max(1, n // 400)) for n in g.reasons.shape)
        there = g.reasons[every] == 0
        seen = g.xyz[every][there]
        if not len(seen):
            spans.append((np.nan, np.nan))
            footprints.append(0.0)
            sigmas.append(0.0)
            continue
        far = np.linalg.norm(seen.astype(np.float64) - geometry.centre(camera.pose), axis=1)
        spans.append((float(far.min()) - 1.0, float(far.max()) + 1.0))
        footprints.append(float(np.median(far)) / float(camera.lens.K[0, 0]))
        sigmas.append(float(np.median(g.sigma[every][there])))
    made = relief.of_surface(surface, rig.projector, s)
    return Tissue(rig, tuple(grids), made, tuple(spans), tuple(footprints), tuple(sigmas))
