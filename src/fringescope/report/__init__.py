"""Pictures for people: error maps, reasons, rendered clouds and surfaces, contact sheets."""

from fringescope.report.render import DARK, WHITE, Light, Viewpoint, render_cloud, render_surface

__all__ = ["DARK", "WHITE", "Light", "Viewpoint", "render_cloud", "render_surface"]
