"""The growth of cost as a drawing (SVG)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from fringescope.report.svg import BLUE, FAINT, INK, ORANGE, PALE, plain, text

LINES = (
    ("copy_floor", "copy of the same bytes", PALE),
    ("decode_triangulate", "decode + triangulate", BLUE),
    ("one_view", "with all masks", ORANGE),
)
WIDTH, HEIGHT, LEFT, TOP, GAP = 250.0, 190.0, 52.0, 42.0, 44.0


def drawing(result: Mapping[str, Any]) -> str:
    """The result of `bench.measure` with `growth` as an SVG file: ns a pixel over pixels, frames and cores."""
    panels = [
        ("megapixels", result["ns_per_pixel"]),
        (f"frames of {result['growth_megapixels']:g} megapixels", result["ns_per_pixel_by_frames"]),
        (f"cores, {result['growth_megapixels']:g} megapixels", result["ns_per_pixel_by_cores"]),
    ]
    panels = [(what, data) for what, data in panels if data]
    parts = []
    for n, (what, data) in enumerate(panels):
        parts += _panel(LEFT + n * (WIDTH + GAP), what, data)
    width, height = LEFT + len(panels) * (WIDTH + GAP), TOP + HEIGHT + 62
    for n, (_, name, colour) in enumerate(LINES):
        x = LEFT + 190 * n
        parts.append(f'<path d="M{x} {height - 14}h22" stroke="{colour}" stroke-width="2.5"/>')
        parts.append(text(x + 28, height - 10, name, colour=INK))
    parts.append(text(LEFT, 18, f"ns a pixel, {result['machine']}, {result['date']}", size=13, colour=INK))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'font-family="sans-serif"><rect width="100%" height="100%" fill="white"/>' + "".join(parts) + "</svg>\n"
    )


def _panel(x0: float, what: str, data: Mapping[str, Mapping[str, float]]) -> list[str]:
    at = [float(key) for key in data]
    most = max(one[name] for one in data.values() for name, _, _ in LINES)
    step = plain(most / 3)
    top = step * math.ceil(most / step)
    low, high = math.log(at[0]), math.log(at[-1])

    def x(value: float) -> float:
        return x0 + (WIDTH * (math.log(value) - low) / (high - low) if high > low else WIDTH / 2)

    def y(value: float) -> float:
        return TOP + HEIGHT * (1 - value / top)

    out = []
    for n in range(round(top / step) + 1):
        out.append(f'<path d="M{x0} {y(n * step):.1f}h{WIDTH}" stroke="{FAINT}"/>')
        out.append(text(x0 - 6, y(n * step) + 4, f"{n * step:g}", "end"))
    for value in at:
        out.append(text(x(value), TOP + HEIGHT + 16, f"{value:g}", "middle"))
    out.append(text(x0 + WIDTH / 2, TOP + HEIGHT + 32, what, "middle", colour=INK))
    for name, _, colour in LINES:
        points = [(x(float(key)), y(one[name])) for key, one in data.items()]
        way = "L".join(f"{a:.1f} {b:.1f}" for a, b in points)
        out.append(f'<path d="M{way}" fill="none" stroke="{colour}" stroke-width="2.5"/>')
        out += [f'<circle cx="{a:.1f}" cy="{b:.1f}" r="3.2" fill="{colour}"/>' for a, b in points]
    return out
