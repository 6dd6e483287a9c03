"""Sphinx configuration: Markdown in, a static site without any address outside it."""

project = "Fringescope"
author = "The Fringescope authors"
copyright = "The Fringescope authors"
extensions = ["myst_parser"]
myst_heading_anchors = 3
exclude_patterns = ["evidence"]
html_theme = "alabaster"
html_theme_options = {
    "description": "Fringe images to a clean, coloured surface of tissue",
    "fixed_sidebar": True,
    "page_width": "1080px",
    "sidebar_width": "240px",
    "font_family": "system-ui, sans-serif",
    "head_font_family": "system-ui, sans-serif",
}
html_static_path = ["_static"]
html_css_files = ["style.css"]
html_copy_source = False
html_show_sourcelink = False
suppress_warnings = ["myst.xref_missing"]
