"""Small drawings as inline SVG, made by hand so that they are crisp, small and print well: vectors over a picture,
scatter with histograms, cells, tilts on a compass, maps in false colour, a rig seen from the side.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

import numpy as np

from fringescope.types import F64

INK, PALE, FAINT, PAPER = "#1d2430", "#667085", "#e4e7ec", "#ffffff"
BLUE, ORANGE, GREEN, RED = "#2767b1", "#d97b29", "#2f8f5b", "#c0392b"
SCALE = ((68, 1, 84), (65, 68, 135), (42, 120, 142), (34, 168, 132), (122, 209, 81), (253, 231, 37))


def number(x: float, digits: int = 2) -> str:
    """A figure with so many significant digits, without an exponent where a person reads it more easily."""
    if not math.isfinite(x):
        return "–"
    if x == 0:
        return "0"
    places = digits - 1 - math.floor(math.log10(abs(x)))
    if places > 6 or abs(x) >= 1e7:
        mantissa, _, power = f"{x:.{digits - 1}e}".partition("e")
        raised = str(int(power)).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{mantissa}·10{raised}".replace("-", "−")
    return f"{round(x, places):.{max(places, 0)}f}".replace("-", "−")


def text(x: float, y: float, words: str, anchor: str = "start", size: float = 11, colour: str = PALE) -> str:
    """A word at (x, y)."""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" text-anchor="{anchor}" fill="{colour}">'
        f"{html.escape(words)}</text>"
    )


def picture(width: float, height: float, parts: Sequence[str], label: str) -> str:
    """Parts as one drawing that fills the width it is given, with a name for those who cannot see it."""
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{html.escape(label, quote=True)}">'
        + "".join(parts)
        + "</svg>"
    )


def _path(d: str, stroke: str, width: float, more: str = "") -> str:
    return f'<path d="{d}" fill="none" stroke="{stroke}" stroke-width="{width:g}" {more}/>'


def _dots(points: F64) -> str:
    return "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points.tolist())


def plain(x: float) -> float:
    """`x` rounded down to 1, 2 or 5 times a power of ten."""
    if not (x > 0 and math.isfinite(x)):
        return 1.0
    power = 10.0 ** math.floor(math.log10(x) + 1e-9)
    return next(m * power for m in (5, 2, 1) if m * power <= x * (1 + 1e-9))


# ------------------------------------------------------------------------------------------------------------- vectors


def arrows(
    rows: Sequence[Sequence[float]],
    size: tuple[int, int],
    unit: str,
    colour: str,
    long: float | None = None,
    most: int = 700,
) -> str:
    """Vectors (u, v, du, dv) over a device's plane, drawn far too long; the scale stands below.

    A vector of length `long` (default: most of them are shorter) is drawn over an eighteenth of the width.
    """
    a = np.asarray(rows, dtype=np.float64).reshape(-1, 4)
    if len(a) > most:
        a = a[np.linspace(0, len(a) - 1, most).astype(int)]
    width = 420.0
    k = width / size[0]
    height = k * size[1]
    frame = f'x=".5" y=".5" width="{width - 1:.0f}" height="{height - 1:.1f}" rx="3"'
    parts = [f'<rect {frame} fill="#fbfbfc" stroke="{FAINT}"/>']
    long = usual(rows) if long is None else long
    if not long > 0:
        parts.append(text(width / 2, height / 2, "nothing to draw", "middle"))
        return picture(width, height + 26, parts, "vectors")
    times = width / 18 / long
    at, tip = (a[:, :2] + 0.5) * k, a[:, 2:] * times
    tip *= np.minimum(1, width / 6 / np.maximum(np.hypot(*tip.T), 1e-9))[:, None]
    both = np.column_stack([at, tip]).tolist()
    lines = "".join(f"M{x:.1f} {y:.1f}l{u:.1f} {v:.1f}" for x, y, u, v in both)
    inside = _path(lines, colour, 1.1, 'opacity=".8"') + _path(_dots(at), colour, 2.6, 'stroke-linecap="round"')
    parts.append(f'<svg width="{width:.0f}" height="{height:.1f}" overflow="hidden">{inside}</svg>')
    bar = plain(1.6 * long)
    parts += [
        _path(f"M4 {height + 15:.1f}h{bar * times:.1f}", INK, 1.6),
        text(10 + bar * times, height + 19, f"{number(bar, 1)} {unit}", colour=INK),
        text(width - 2, height + 19, f"drawn {_times(times / k)} times as long", "end"),
    ]
    return picture(width, height + 26, parts, f"residual vectors, {number(bar, 1)} {unit} bar")


def usual(rows: Sequence[Sequence[float]]) -> float:
    """The length that nine of ten vectors stay below."""
    a = np.asarray(rows, dtype=np.float64).reshape(-1, 4)
    return float(np.percentile(np.hypot(a[:, 2], a[:, 3]), 90)) if len(a) else 0.0


def _times(x: float) -> str:
    step = 10.0 ** max(math.floor(math.log10(max(x, 1))) - 1, 0)
    return f"{round(x / step) * step:,.0f}".replace(",", " ")


def scatter(cloud: Sequence[Sequence[float]], unit: str, colour: str, rms: float) -> str:
    """Residuals about zero, with their histograms; the line on a histogram is its own mirror image."""
    a = np.asarray(cloud, dtype=np.float64).reshape(-1, 2)
    W, side, margin = 300.0, 216.0, 24.0
    limit = 1.15 * max(float(np.percentile(np.abs(a), 99)) if len(a) else 0.0, 1e-9)
    k, c = side / 2 / limit, margin + side / 2
    inside = a[(np.abs(a) < limit).all(axis=1)]
    parts = [
        f'<rect x="{margin}" y="4" width="{side}" height="{side}" fill="#fbfbfc" stroke="{FAINT}"/>',
        _path(f"M{margin} {4 + side / 2}h{side}M{c} 4v{side}", FAINT, 1),
        _path(_dots(np.stack([c + inside[:, 0] * k, 4 + side / 2 + inside[:, 1] * k], axis=1)), colour, 2.2,
              'stroke-linecap="round" opacity=".35"'),
    ]  # fmt: skip
    for r in (rms, 2 * rms):
        if 0 < r < 1.4 * limit:
            parts.append(f'<circle cx="{c}" cy="{4 + side / 2}" r="{r * k:.1f}" fill="none" stroke="{INK}" '
                         'stroke-width=".9" stroke-dasharray="3 3" clip-path="inset(0)"/>')  # fmt: skip
    edges = np.linspace(-limit, limit, 37)
    for axis in (0, 1):
        count = np.histogram(a[:, axis], edges)[0].astype(float)
        tall = 40 / max(float(count.max()), 1.0)
        pos = (edges + limit) * k
        steps, mirrored = _steps(pos, count * tall), _steps(pos, count[::-1] * tall)
        below, beside = f"translate({margin} {4 + side + 44}) scale(1 -1)", f"translate({margin + side + 2} 4)"
        turn = beside + " matrix(0 1 1 0 0 0)" if axis else below
        parts.append(
            f'<g transform="{turn}"><path d="{steps}z" fill="{colour}" opacity=".45"/>'
            f'<path d="{mirrored}" fill="none" stroke="{INK}" stroke-width=".9"/></g>'
        )
    bar = plain(0.5 * limit)
    parts += [
        _path(f"M{c} {side + 56}h{bar * k:.1f}", INK, 1.6),
        text(c + bar * k + 6, side + 60, f"{number(bar, 1)} {unit}", colour=INK),
        text(margin, side + 60, "circles: rms, 2 rms"),
    ]
    return picture(W, side + 68, parts, f"distribution of residuals, rms {number(rms)} {unit}")


def _steps(edges: F64, heights: F64) -> str:
    out = f"M{edges[0]:.1f} 0"
    for a, h in zip(edges[1:], heights, strict=True):
        out += f"V{h:.1f}H{a:.1f}"
    return out + "V0"


# ------------------------------------------------------------------------------------------------------------ coverage


def cells(count: Sequence[Sequence[int]], size: tuple[int, int]) -> str:
    """Cells of a picture: darker = more corners, orange outline = none, hatched = needs none."""
    a = np.asarray(count)
    width = 300.0
    height = width * size[1] / size[0]
    h, w = height / a.shape[0], width / a.shape[1]
    most = math.log1p(max(int(a.max()), 1))
    parts = []
    for (j, i), n in np.ndenumerate(a):
        where = f'x="{i * w + 1:.1f}" y="{j * h + 1:.1f}" width="{w - 2:.1f}" height="{h - 2:.1f}" rx="2"'
        if n < 0:
            parts.append(f'<rect {where} fill="#f3f4f6"/>')
            line = f"M{i * w + 3:.1f} {(j + 1) * h - 3:.1f}L{(i + 1) * w - 3:.1f} {j * h + 3:.1f}"
            parts.append(_path(line, "#d5d9e0", 1))
        elif n == 0:
            parts.append(f'<rect {where} fill="#fff7ef" stroke="{ORANGE}" stroke-width="1.2"/>')
        else:
            parts.append(f'<rect {where} fill="{BLUE}" opacity="{0.2 + 0.75 * math.log1p(n) / most:.2f}"/>')
    return picture(width, height, parts, "coverage of the picture")


def compass(tilts: Sequence[tuple[str, float, float]], towards: Sequence[tuple[str, float]] = ()) -> str:
    """Tilts (name, angle, azimuth) in rad as points on a compass of the picture; `towards` marks directions (rad)."""
    W, H, c, R = 300.0, 236.0, 150.0, 88.0
    most = max([20.0, *(math.degrees(t) for _, t, _ in tilts)])
    outer = 10 * math.ceil(most / 10)
    parts = [f'<circle cx="{c}" cy="{H / 2}" r="{R}" fill="#fbfbfc" stroke="{FAINT}"/>']
    for d in range(10 if outer <= 40 else 20, outer, 10 if outer <= 40 else 20):
        parts.append(f'<circle cx="{c}" cy="{H / 2}" r="{R * d / outer:.1f}" fill="none" stroke="{FAINT}"/>')
        parts.append(text(c + 2, H / 2 - R * d / outer - 2, f"{d}°", size=9))
    parts.append(_path(f"M{c - R} {H / 2}h{2 * R}M{c} {H / 2 - R}v{2 * R}", FAINT, 1))
    for name, a in towards:
        x, y = math.cos(a), math.sin(a)
        parts.append(_path(f"M{c + R * x:.1f} {H / 2 + R * y:.1f}l{7 * x:.1f} {7 * y:.1f}", ORANGE, 2.4))
        anchor = "middle" if abs(x) < 0.5 else "start" if x > 0 else "end"
        parts.append(text(c + (R + 10) * x, H / 2 + (R + 15) * y + 4, name, anchor, 10, ORANGE))
    for name, t, a in tilts:
        r = R * math.degrees(t) / outer
        x, y = c + r * math.cos(a), H / 2 + r * math.sin(a)
        named = f"<title>{html.escape(name)}</title>"
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{BLUE}" opacity=".8">{named}</circle>')
        parts.append(text(x + 5, y - 4, name.removeprefix("pose").lstrip("0") or "0", size=9, colour=INK))
    parts.append(text(W - 4, H - 6, f"rim: {outer}°", "end", 10))
    return picture(W, H, parts, "tilts of the boards")


# ---------------------------------------------------------------------------------------------------------------- maps


def shade(share: float) -> str:
    """A colour from dark (0) to light (1), told apart by lightness alone."""
    x = min(max(share, 0.0), 1.0) * (len(SCALE) - 1)
    i = min(int(x), len(SCALE) - 2)
    r, g, b = (round(p + (q - p) * (x - i)) for p, q in zip(SCALE[i], SCALE[i + 1], strict=True))
    return f"#{r:02x}{g:02x}{b:02x}"


def heat(
    values: Sequence[Sequence[float]],
    extent: tuple[float, float, float, float],
    low: float,
    high: float,
    title: str,
) -> str:
    """A map (rows, columns) in false colour over its extent (x0, x1, y0, y1) in mm, y upwards; empty where NaN."""
    a = np.asarray(values, dtype=np.float64)
    width = 220.0
    height = min(max(width * (extent[3] - extent[2]) / max(extent[1] - extent[0], 1e-9), 60.0), 260.0)
    h, w = height / a.shape[0], width / a.shape[1]
    parts = [f'<rect y="16" width="{width}" height="{height:.1f}" fill="#f3f4f6"/>', text(0, 10, title, colour=INK)]
    for (j, i), v in np.ndenumerate(a):
        if math.isfinite(v):
            at = f'x="{i * w:.1f}" y="{16 + height - (j + 1) * h:.1f}" width="{w + 0.5:.1f}" height="{h + 0.5:.1f}"'
            colour = shade((v - low) / max(high - low, 1e-12))
            named = f"<title>{number(float(v))} µm</title>"
            parts.append(f'<rect {at} fill="{colour}" shape-rendering="crispEdges">{named}</rect>')
    parts.append(text(0, height + 29, f"x {extent[0]:.0f}".replace("-", "−"), size=9))
    parts.append(text(width, height + 29, f"{extent[1]:.0f} mm".replace("-", "−"), "end", 9))
    return picture(width, height + 32, parts, title)


def colour_bar(low: float, high: float, unit: str) -> str:
    """The scale of `heat`."""
    n = 40
    parts = [f'<rect x="{40 + 4 * i}" y="2" width="4.3" height="10" fill="{shade(i / (n - 1))}"/>' for i in range(n)]
    parts += [text(35, 11, number(low), "end", 10), text(205, 11, f"{number(high)} {unit}", "start", 10)]
    return picture(260, 16, parts, "colour scale")


# ----------------------------------------------------------------------------------------------------------------- rig


def drawing(
    lines: Sequence[tuple[F64, str, float, bool]], labels: Sequence[tuple[F64, str, str]], across: F64, up: F64
) -> str:
    """Polylines ((n, 3), colour, width, closed) and labels (place, words, colour) in mm, seen along across x up."""
    flat = [np.stack([p @ across, -(p @ up)], axis=1) for p, *_ in lines]
    marks = np.array([[p @ across, -(p @ up)] for p, *_ in labels]).reshape(-1, 2)
    every = np.concatenate([*flat, marks])
    low, high = every.min(axis=0), every.max(axis=0)
    W = 640.0
    k = min((W - 130) / max(high[0] - low[0], 1e-9), 400 / max(high[1] - low[1], 1e-9))
    H = k * (high[1] - low[1]) + 44
    offset = np.array([(W - k * (high[0] - low[0])) / 2, 24.0]) - k * low
    parts = []
    for p, (_, colour, width, closed) in zip(flat, lines, strict=True):
        q = p * k + offset
        d = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in q.tolist()) + ("z" if closed else "")
        fill = f'fill="{colour}" fill-opacity=".07"' if closed else 'fill="none"'
        parts.append(f'<path d="{d}" {fill} stroke="{colour}" stroke-width="{width:g}" stroke-linejoin="round"/>')
    for (_, words, colour), (x, y) in zip(labels, marks * k + offset, strict=True):
        parts.append(text(x, y - 8, words, "middle", 12, colour))
    return picture(W, H, parts, "the rig and the boards")
