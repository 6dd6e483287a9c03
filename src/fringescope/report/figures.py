"""Figures of numbers: error maps with their histogram, reasons per pixel, and contact sheets (Figs. 7 to 11).

Drawn with Matplotlib's Agg canvas, without pyplot and without touching its global state; the same input gives the same
file. Every function returns the picture, (h, w, 3) uint8, and writes it as PNG where `path` is given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike, NDArray

from fringescope.errors import EmptyResultError, UsageError
from fringescope.kernels import draw
from fringescope.report.render import DARK
from fringescope.types import F32, F64, U8, U16, Reason

INK, PALE, PAPER, NOTHING = "#1d2430", "#5d6675", "#ffffff", "#e9ebee"
DIVERGING = LinearSegmentedColormap.from_list(
    "deviation", ["#0b2a63", "#2767b1", "#7fb0dc", "#f6f4f0", "#f0a878", "#c4502a", "#6b1508"]
)  #: blue = below, red = above; told apart by lightness and by any kind of colour sight
REASON_COLOURS: dict[Reason, str] = {
    Reason.DARK: "#2b2f45",
    Reason.SATURATED: "#f4d03f",
    Reason.LOW_MODULATION: "#7a5aa6",
    Reason.ORDER_UNCERTAIN: "#d55e00",
    Reason.REVERSED: "#00b3c4",
    Reason.JUMP: "#cc3f97",
    Reason.ISLAND: "#3b7dd8",
    Reason.OUT_OF_VOLUME: "#8a6a4a",
    Reason.INCONSISTENT: "#e02b2b",
    Reason.VIEWS_DISAGREE: "#59b13f",
    Reason.NOT_LOCAL: "#f2a3bd",
}  #: colour of each reason in pictures and legends
_FONT: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": "#b8bec8",
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": PALE,
    "ytick.color": PALE,
}


def _picture(fig: Figure, path: Path | str | None) -> U8:
    canvas: Any = FigureCanvasAgg(fig)
    canvas.draw()
    rgb: U8 = np.array(canvas.buffer_rgba())[..., :3].copy()
    if path is not None:
        fig.savefig(path, format="png", dpi=fig.dpi, facecolor=fig.get_facecolor(), metadata={"Software": None})
    return rgb


# ---------------------------------------------------------------------------------------------------------- error maps


def bin_map(flat_mm: ArrayLike, value: ArrayLike, cells: int = 420) -> tuple[F32, tuple[float, float, float, float]]:
    """Mean of `value` (n,) over square cells of the plane coordinates `flat_mm` (n, 2): map and its extent in mm.

    The map has about `cells` cells along its longer side, fewer where the points lie farther apart; row 0 is the lowest
    y; NaN = no point. Extent is (left, right, bottom, top).
    """
    xy, v = np.asarray(flat_mm, dtype=np.float64), np.asarray(value, dtype=np.float64)
    ok = np.isfinite(xy).all(1) & np.isfinite(v)
    if not ok.any():
        raise EmptyResultError("no point with an error; there is nothing to map")
    xy, v = xy[ok], v[ok]
    low, high = np.percentile(xy, [0.02, 99.98], axis=0)
    size = np.maximum(high - low, 1e-9)
    cell = float(max(size.max() / cells, math.sqrt(size[0] * size[1] / len(v)) * 1.4))
    shape = math.ceil(size[1] / cell) + 1, math.ceil(size[0] / cell) + 1
    out, count = np.zeros(shape), np.zeros(shape, np.int64)
    at = (xy - low) / cell
    draw.bin_mean(np.ascontiguousarray(at[:, 0]), np.ascontiguousarray(at[:, 1]), v, out, count)
    left, bottom = float(low[0]), float(low[1])
    return out.astype(np.float32), (left, left + shape[1] * cell, bottom, bottom + shape[0] * cell)


def error_map(
    flat_mm: ArrayLike,
    error_um: ArrayLike,
    title: str,
    figures: Sequence[tuple[str, str]] = (),
    path: Path | str | None = None,
    limit_um: float | None = None,
) -> U8:
    """Signed deviation over a surface with its histogram beside it (Figs. 8 and 9).

    `flat_mm` (n, 2) coordinates within the surface, `error_um` (n,), NaN = left out; `figures` are (name, value) pairs
    that stand under the title. Colours reach from -limit to +limit, default 3.5 robust standard deviations rounded up
    to a plain number; the histogram shows normal noise of the same robust spread as a line.
    """
    e = np.asarray(error_um, dtype=np.float64)
    grid, extent = bin_map(flat_mm, e)
    e = e[np.isfinite(e)]
    middle = float(np.median(e))
    std = 1.4826 * float(np.median(np.abs(e - middle)))
    limit = limit_um or _plain_limit(3.5 * std + abs(middle))
    width, height = extent[1] - extent[0], extent[3] - extent[2]
    map_w = min(7.6, 4.7 * width / height)
    map_h = map_w * height / width
    if map_h > 4.9:
        map_w, map_h = map_w * 4.9 / map_h, 4.9
    W, H = map_w + 4.0, map_h + 2.0
    with mpl.rc_context(_FONT):
        fig = Figure(figsize=(W, H), dpi=150, facecolor=PAPER)
        ax = fig.add_axes((0.75 / W, 0.7 / H, map_w / W, map_h / H))
        ax.set_facecolor(NOTHING)
        ax.imshow(grid, origin="lower", extent=extent, cmap=DIVERGING, vmin=-limit, vmax=limit, interpolation="nearest")
        ax.set_xlabel("mm")
        ax.set_ylabel("mm")
        ax.tick_params(length=3)
        _histogram(fig, ((0.75 + map_w + 0.95) / W, 0.7 / H, 1.85 / W, map_h / H), e, limit, middle, std)
        fig.text(0.75 / W, 1 - 0.42 / H, title, fontsize=14, fontweight="bold", va="center")
        _figures_line(fig, figures, 0.75 / W, 1 - 0.8 / H, W)
        return _picture(fig, path)


def _plain_limit(x: float) -> float:
    """`x` rounded up to 1, 2, 3, 5 or 8 times a power of ten."""
    if not x > 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(x))
    return next(m * power for m in (1, 2, 3, 5, 8, 10) if m * power >= x * 0.999)


def _histogram(
    fig: Figure, where: tuple[float, float, float, float], e: F64, limit: float, middle: float, std: float
) -> None:
    bar = fig.add_axes((where[0], where[1], 0.12 * where[2], where[3]))
    bar.imshow(
        np.linspace(-1, 1, 256)[:, None], origin="lower", aspect="auto", cmap=DIVERGING, extent=(0, 1, -limit, limit)
    )
    bar.set_xticks([])
    bar.set_ylabel("deviation (µm)")
    for side in bar.spines.values():
        side.set_visible(False)
    ax = fig.add_axes((where[0] + 0.17 * where[2], where[1], 0.83 * where[2], where[3]))
    edges = np.linspace(-limit, limit, 81)
    count, _ = np.histogram(e, edges)
    centres = (edges[1:] + edges[:-1]) / 2
    colours = DIVERGING(0.5 + 0.5 * centres / limit)
    ax.barh(centres, count, height=edges[1] - edges[0], color=colours, edgecolor="none")
    ax.plot(count, centres, color=PALE, lw=0.7, drawstyle="steps-mid")
    if std > 0:
        normal = np.exp(-0.5 * ((centres - middle) / std) ** 2) / (std * math.sqrt(2 * math.pi))
        ax.plot(len(e) * (edges[1] - edges[0]) * normal, centres, color=INK, lw=1.2)
    ax.set_ylim(-limit, limit)
    ax.set_xlim(0, max(1, count.max()) * 1.08)
    ax.set_xticks([])
    ax.set_yticks([])
    ax.spines["bottom"].set_visible(False)
    outside = float((np.abs(e) > limit).mean())
    ax.set_xlabel(f"{len(e):,} points" + (f"\n{_share(outside)} beyond" if outside else ""), color=PALE, fontsize=9)


def _share(x: float) -> str:
    return f"{100 * x:.1f} %" if x >= 0.001 else f"{1e6 * x:.0f} ppm"


def _figures_line(fig: Figure, figures: Sequence[tuple[str, str]], x: float, y: float, width_in: float) -> None:
    """Names and values in one line, as wide as they are."""
    canvas: Any = FigureCanvasAgg(fig)
    renderer = canvas.get_renderer()
    for name, value in figures:
        for text, colour, weight, gap in ((name, PALE, "normal", 0.07), (value, INK, "bold", 0.24)):
            drawn = fig.text(x, y, text, color=colour, fontweight=weight, va="center", fontsize=10.5)
            x += float(drawn.get_window_extent(renderer).width) / fig.dpi / width_in + gap / width_in


# ------------------------------------------------------------------------------------------------------------- reasons


def reasons_picture(reasons: U16, backdrop: NDArray[Any] | None = None) -> U8:
    """Why each pixel carries no point: (H, W, 3). A pixel with several reasons shows that of the earliest stage.

    Pixels with a point show `backdrop` ((H, W), any scale; such as the background A) in grey, else light grey.
    """
    base = np.full(reasons.shape, 215, np.uint8) if backdrop is None else _grey(backdrop)
    out = np.repeat(base[..., None], 3, axis=2)
    for reason, colour in reversed(REASON_COLOURS.items()):
        out[(reasons & np.uint16(reason.value)) != 0] = np.rint(255 * np.array(to_rgb(colour)))
    return out


def _grey(a: NDArray[Any]) -> U8:
    x = np.nan_to_num(np.asarray(a, dtype=np.float32))
    low, high = np.percentile(x, [1, 99.5])
    out: U8 = np.rint(70 + 170 * np.clip((x - low) / max(float(high - low), 1e-9), 0, 1) ** 0.6).astype(np.uint8)
    return out


def reasons_map(reasons: U16, title: str, backdrop: NDArray[Any] | None = None, path: Path | str | None = None) -> U8:
    """The picture of `reasons_picture` with a legend: each reason that occurs, with its share of the pixels."""
    rgb = reasons_picture(reasons, backdrop)
    h, w = reasons.shape
    map_w = 7.6 if w >= h else 7.6 * w / h
    map_h = map_w * h / w
    W, H = map_w + 3.5, max(map_h + 1.25, 4.2)
    with mpl.rc_context(_FONT):
        fig = Figure(figsize=(W, H), dpi=150, facecolor=PAPER)
        top = 1 - 0.85 / H
        ax = fig.add_axes((0.4 / W, top - map_h / H, map_w / W, map_h / H))
        ax.imshow(rgb, interpolation="antialiased")
        _bare(ax)
        fig.text(0.4 / W, 1 - 0.45 / H, title, fontsize=14, fontweight="bold", va="center")
        rows = [("point", "#d7d7d7", int((reasons == 0).sum()))]
        rows += [(r.label, c, int(((reasons & np.uint16(r.value)) != 0).sum())) for r, c in REASON_COLOURS.items()]
        legend = fig.add_axes(((0.4 + map_w + 0.25) / W, 0, 2.7 / W, top), xlim=(0, 2.7), ylim=(-top * H, 0))
        legend.axis("off")
        y = -0.12
        for name, colour, count in rows:
            if count == 0:
                continue
            legend.add_patch(Rectangle((0, y - 0.09), 0.18, 0.18, facecolor=colour, edgecolor="none"))
            legend.text(0.3, y, name, va="center", fontsize=9.5)
            share = f"{100 * count / reasons.size:.2f} %"
            legend.text(2.65, y, share, va="center", ha="right", fontsize=9.5, color=PALE)
            y -= 0.3
        note = "A pixel may have several reasons;\nits colour is that of the first."
        legend.text(0, y - 0.2, note, fontsize=8, color=PALE)
        return _picture(fig, path)


def _bare(ax: Axes) -> None:
    ax.set_xticks([])
    ax.set_yticks([])
    for side in ax.spines.values():
        side.set_visible(False)


# -------------------------------------------------------------------------------------------------------------- sheets


@dataclass(frozen=True, eq=False)
class Panel:
    """One picture of a contact sheet: (h, w), (h, w, 3) uint8, its title and a line below it."""

    image: NDArray[Any]
    title: str
    caption: str = ""


def contact_sheet(
    panels: Sequence[Panel],
    columns: int = 3,
    panel_px: tuple[int, int] = (560, 374),
    path: Path | str | None = None,
    dark: bool = False,
) -> U8:
    """Panels in rows with numbered titles, each picture fitted whole into `panel_px` on a dark field (Fig. 7).

    Raises UsageError without panels or columns.
    """
    if not panels or columns < 1:
        raise UsageError(f"contact sheet of {len(panels)} panels in {columns} columns; needed at least one of each")
    ink, pale, paper = ("#f2f4f7", "#a9b2c0", "#11141a") if dark else (INK, PALE, PAPER)
    dpi, (pw, ph), gap, head, foot = 100, panel_px, 22, 34, 26
    rows = math.ceil(len(panels) / columns)
    foot = foot if any(p.caption for p in panels) else 4
    W, H = columns * pw + (columns + 1) * gap, rows * (ph + head + foot) + gap
    with mpl.rc_context(_FONT):
        fig = Figure(figsize=(W / dpi, H / dpi), dpi=dpi, facecolor=paper)
        for i, panel in enumerate(panels):
            x, y = gap + (i % columns) * (pw + gap), H - (i // columns) * (ph + head + foot) - head - ph
            image = _fitted(panel.image, pw, ph)
            ax = fig.add_axes((x / W, y / H, pw / W, ph / H))
            ax.imshow(image, interpolation="nearest", aspect="auto")
            _bare(ax)
            fig.text(x / W, (y + ph + 12) / H, f"{i + 1}", fontsize=12, fontweight="bold", color="#2f7fd0", va="center")
            where = (x + 20) / W, (y + ph + 12) / H
            fig.text(*where, panel.title, fontsize=12, fontweight="bold", color=ink, va="center")
            fig.text(x / W, (y - 14) / H, panel.caption, fontsize=9.5, color=pale, va="center")
        return _picture(fig, path)


def _fitted(image: NDArray[Any], w: int, h: int) -> U8:
    """The picture scaled to fit w x h, in the middle of a dark field."""
    rgb = np.repeat(image[..., None], 3, axis=2) if image.ndim == 2 else image[..., :3]
    scale = min(w / rgb.shape[1], h / rgb.shape[0])
    size = max(1, round(rgb.shape[1] * scale)), max(1, round(rgb.shape[0] * scale))
    method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
    small = np.asarray(cv2.resize(np.ascontiguousarray(rgb), size, interpolation=method), np.uint8)
    out = np.empty((h, w, 3), np.uint8)
    out[:] = DARK
    y, x = (h - size[1]) // 2, (w - size[0]) // 2
    out[y : y + size[1], x : x + size[0]] = small
    return out


def fringe_picture(frame: NDArray[Any], bits: int = 8, gamma: float = 0.6) -> U8:
    """A raw frame (H, W) as people see it: Bayer sites averaged over 2 x 2, brightened by `gamma`, (H, W) uint8."""
    soft = soften(frame.astype(np.float32) / float((1 << bits) - 1))
    high = max(float(np.percentile(soft, 99.7)), 1e-6)
    out: U8 = np.rint(255 * np.clip(soft / high, 0, 1) ** gamma).astype(np.uint8)
    return out


def soften(a: NDArray[Any]) -> F32:
    """Mean of each 2 x 2 neighbourhood of (H, W): a Bayer mosaic without its pattern."""
    x = np.pad(np.nan_to_num(np.asarray(a, dtype=np.float32)), ((0, 1), (0, 1)), mode="reflect")
    out: F32 = (x[:-1, :-1] + x[1:, :-1] + x[:-1, 1:] + x[1:, 1:]) / np.float32(4)
    return out


def phase_picture(phase: NDArray[Any], valid: NDArray[np.bool_] | None = None) -> U8:
    """Absolute phase (H, W), rad, in perceptual colours that ripple once per fringe; dark where NaN or not `valid`."""
    ok = np.isfinite(phase) if valid is None else np.isfinite(phase) & valid
    out = np.empty((*phase.shape, 3), np.uint8)
    out[:] = DARK
    if not ok.any():
        return out
    low, high = np.percentile(phase[ok], [0.5, 99.5])
    x = np.clip((np.nan_to_num(phase, nan=float(low)) - low) / max(float(high - low), 1e-9), 0, 1)
    rgb = mpl.colormaps["viridis"](x)[..., :3]
    ripple = 0.86 + 0.14 * np.cos(np.nan_to_num(phase))
    out[ok] = np.rint(255 * rgb * ripple[..., None])[ok].astype(np.uint8)
    return out
