"""The whole way on one sheet, as in Fig. 7: fringes, phase, what cannot be trusted, surface, colour."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fringescope.report.figures import Panel, contact_sheet, fringe_picture, phase_picture, reasons_picture, soften
from fringescope.report.render import Viewpoint, render_surface
from fringescope.types import U8, AnyArray, Decoded, Grid, PixelFormat, Surface

VIEWPOINTS = (Viewpoint(), Viewpoint(-90, 89.9), Viewpoint(-160, 35), Viewpoint(20, 35))  #: around a specimen


def story(
    frame: AnyArray,
    pixel_format: PixelFormat,
    decoded: Decoded,
    grid: Grid,
    surface: Surface,
    viewpoint: Viewpoint | None = None,
    path: Path | str | None = None,
) -> U8:
    """Six panels of one view and of the fused surface; (h, w, 3), written as PNG where `path` is given.

    `frame` is a raw frame of the finest set, `decoded` and `grid` are of the same view. The same input gives the same
    picture.
    """
    where = viewpoint or VIEWPOINTS[0]
    phase = decoded.directions[0].phase
    raw = frame if frame.ndim == 2 else frame.mean(axis=2)
    size = (1120, 748)
    kept = int(np.count_nonzero(grid.valid))
    share = 100 * kept / grid.valid.size
    doubts = reasons_picture(grid.reasons, soften(decoded.background))
    panels = [
        Panel(fringe_picture(raw, pixel_format.bits), "Fringes", f"{grid.camera}, one frame of the finest set"),
        Panel(phase_picture(phase), "Absolute phase", "before anything is removed"),
        Panel(doubts, "What cannot be trusted", f"{100 - share:.1f} % of the pixels, each with its reason"),
        Panel(phase_picture(phase, grid.valid), "Clean phase", f"{kept:,} points, {share:.1f} % of the pixels"),
        Panel(render_surface(surface, size, where, coloured=False), "Surface", "all views fused"),
        Panel(render_surface(surface, size, where), "In colour", "ring-light pictures on the surface"),
    ]
    return contact_sheet(panels, path=path)


def around(surface: Surface, path: Path | str | None = None) -> U8:
    """The surface from four sides, in colour and as a relief; (h, w, 3), written as PNG where `path` is given."""
    names = ("From the front", "From above", "From the left", "From the right")
    panels = []
    for coloured, how in ((True, "colour"), (False, "relief")):
        for name, viewpoint in zip(names, VIEWPOINTS, strict=True):
            panels.append(Panel(render_surface(surface, (880, 588), viewpoint, coloured), name, how))
    return contact_sheet(panels, columns=4, panel_px=(440, 294), path=path)
