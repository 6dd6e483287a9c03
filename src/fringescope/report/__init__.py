"""Pictures for people: error maps, reasons, rendered clouds and surfaces, contact sheets."""

from fringescope.report.figures import (
    REASON_COLOURS,
    Panel,
    bin_map,
    contact_sheet,
    error_map,
    fringe_picture,
    phase_picture,
    reasons_map,
    reasons_picture,
)
from fringescope.report.render import DARK, WHITE, Light, Viewpoint, render_cloud, render_surface

__all__ = [
    "DARK",
    "REASON_COLOURS",
    "WHITE",
    "Light",
    "Panel",
    "Viewpoint",
    "bin_map",
    "contact_sheet",
    "error_map",
    "fringe_picture",
    "phase_picture",
    "reasons_map",
    "reasons_picture",
    "render_cloud",
    "render_surface",
]
