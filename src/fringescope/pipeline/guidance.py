"""The recipe of III-F: strokes and a scan to the picture that the projector shows, and how it will look (Fig. 13)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from fringescope import fuse, geometry, guide, report
from fringescope.errors import GuidanceError
from fringescope.settings import Settings
from fringescope.types import U8, Grid, Guidance, Guidelines, Picture, Rig, Surface


def tissue_of(grids: Sequence[Grid], surface: Surface | None, rig: Rig, s: Settings) -> guide.Tissue:
    """A scan made ready for guidance, once for all its strokes. Raises EmptyResultError for a scan without surface."""
    return guide.tissue(grids, surface, rig, s.guide)


def project_guidance(
    guidelines: Guidelines,
    tissue: guide.Tissue,
    settings: Settings | None = None,
    *,
    dashed: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Guidance:
    """Strokes to the device's picture, and what became of each: a stroke that cannot be shown says why (`refused`).

    `dashed` draws them in dashes: whether they are still true is in doubt. `progress` is told how many strokes are
    done, of how many.
    """
    s = settings or Settings()
    mm = calibration_mm(tissue.rig)
    return guide.guide(guidelines, tissue, s.guide, calibration_mm=mm, dashed=dashed, progress=progress)


def check_bound(guidelines: Guidelines, scan: str, rig: str) -> None:
    """Raises GuidanceError where guidelines were drawn on another scan, or for another rig."""
    for what, asked, came in (("scan", guidelines.scan, scan), ("rig", guidelines.rig, rig)):
        if asked is not None and asked != came:
            raise GuidanceError(
                f"the guidelines belong to {what} {asked[:19]}.., this is {came[:19]}..; "
                "draw them anew, or carry them over (fringescope carry)"
            )


def calibration_mm(rig: Rig) -> float:
    """By how much the rig's own calibration predicts that its views differ, mm; 0 where it tells nothing."""
    carried = rig.extra.get("calibration")
    told = carried.get("predicted_views_um") if isinstance(carried, dict) else None
    values = list(told.values()) if isinstance(told, dict) else []
    return 1e-3 * max((float(v) for v in values if isinstance(v, (int, float)) and math.isfinite(v)), default=0.0)


def previews(guidance: Guidance, tissue: guide.Tissue, pictures: Sequence[Picture], s: Settings) -> dict[str, U8]:
    """How the lines will look in each camera, over its photograph: (h, w, 3) RGB by the camera's name."""
    out = {}
    for grid, picture in zip(tissue.grids, pictures, strict=True):
        photo = fuse.photo(picture.frame, picture.pixel_format, picture.camera, s.fuse)
        camera = tissue.rig.cameras[grid.view]
        uv = geometry.project(tissue.rig.projector, grid.xyz)
        out[grid.camera] = report.guidance_preview(photo.rgb, uv, camera, tissue.rig.projector, guidance)
    return out
