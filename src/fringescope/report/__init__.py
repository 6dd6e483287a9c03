"""Pictures for people: error maps, reasons, rendered clouds and surfaces, contact sheets."""

from fringescope.report.calibration import calibration_page
from fringescope.report.case import write_case
from fringescope.report.comparison import change_colours, change_limit, change_picture, change_surface
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
from fringescope.report.guidance import caption as guidance_caption
from fringescope.report.guidance import guidance_preview, landing_caption, landing_picture, plane_light
from fringescope.report.render import DARK, WHITE, Light, Viewpoint, render_cloud, render_surface
from fringescope.report.response import RippleCurve, response_picture
from fringescope.report.sighting import sighting_picture
from fringescope.report.story import VIEWPOINTS, around, story
from fringescope.report.watching import watched_picture

__all__ = [
    "DARK",
    "REASON_COLOURS",
    "VIEWPOINTS",
    "WHITE",
    "Light",
    "Panel",
    "RippleCurve",
    "Viewpoint",
    "around",
    "bin_map",
    "calibration_page",
    "change_colours",
    "change_limit",
    "change_picture",
    "change_surface",
    "contact_sheet",
    "error_map",
    "fringe_picture",
    "guidance_caption",
    "guidance_preview",
    "landing_caption",
    "landing_picture",
    "phase_picture",
    "plane_light",
    "reasons_map",
    "reasons_picture",
    "render_cloud",
    "render_surface",
    "response_picture",
    "sighting_picture",
    "story",
    "watched_picture",
    "write_case",
]
