"""What changed between two scans, for people: a map with its legend, and the colours of the changed surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

from fringescope.report.figures import (
    _FONT,
    DIVERGING,
    INK,
    NOTHING,
    PALE,
    PAPER,
    _figures_line,
    _picture,
    _plain_limit,
)
from fringescope.types import F64, U8, AnyArray, Surface, SurfacePart

_PALETTE = 256
_GUIDE, _CUT = "#0a7d4f", "#111111"


def change_limit(depth_mm: AnyArray, labels: AnyArray) -> float:
    """The depth, mm, at which the colours of a change end: a plain number that holds nearly all of it."""
    d = np.abs(depth_mm[(labels > 0) & np.isfinite(depth_mm)])
    return _plain_limit(float(np.percentile(d, 98))) if len(d) else 1.0


def change_colours(depth_mm: AnyArray, limit_mm: float) -> U8:
    """sRGB (n, 3) of depths removed: red where something was removed, blue where something was added."""
    table = np.rint(255 * DIVERGING(np.linspace(0, 1, _PALETTE))[:, :3]).astype(np.uint8)
    at = np.clip((np.nan_to_num(depth_mm) / limit_mm + 1) / 2, 0, 1)
    return np.asarray(table[np.rint(at * (_PALETTE - 1)).astype(int)])


def change_surface(surface: Surface, depth_mm: F64, labels: AnyArray, limit_mm: float) -> Surface:
    """A textured mesh whose changed triangles are coloured by the depth removed at its vertices (n,), mm.

    The others keep their pictures. `labels` (n,): the regions of the vertices, 0 = unchanged.
    """
    parts: list[SurfacePart] = []
    changed: list[AnyArray] = []
    for part in surface.parts:
        index = part.vertex_index.astype(np.int64)
        hit = (labels[index] > 0)[part.faces.astype(np.int64)].any(1)
        changed.append(index[part.faces[hit].astype(np.int64)])
        if (~hit).any():
            parts.append(replace(part, faces=part.faces[~hit]))
    faces = np.concatenate(changed) if changed else np.zeros((0, 3), np.int64)
    if len(faces):
        used, corner = np.unique(faces, return_inverse=True)
        u = np.clip((np.nan_to_num(depth_mm[used]) / limit_mm + 1) / 2, 0, 1)
        uv = np.stack([(u * (_PALETTE - 1) + 0.5) / _PALETTE, np.full(len(used), 0.5)], 1).astype(np.float32)
        strip = np.repeat(change_colours(np.linspace(-limit_mm, limit_mm, _PALETTE), limit_mm)[None], 16, axis=0)
        own = corner.reshape(-1, 3).astype(np.uint32)
        parts.append(SurfacePart(len(surface.parts), used.astype(np.uint32), uv, own, strip))
    return replace(surface, parts=tuple(parts))


def change_picture(
    depth_mm: F64,
    labels: AnyArray,
    surface_mm: F64,
    low_mm: tuple[float, float],
    cell_mm: float,
    title: str,
    figures: Sequence[tuple[str, str]] = (),
    strokes: Sequence[F64] = (),
    cut: F64 | None = None,
    path: Path | str | None = None,
) -> U8:
    """The map of a change over a relief of the surface, its regions numbered, with its legend: (h, w, 3).

    Maps (h, w): `depth_mm` removed (NaN = not compared), `labels` of the regions, `surface_mm` heights to be shaded;
    row 0 is the lowest y, `low_mm` the middle of its first cell. `strokes` (m, 2) and `cut` (n, 2) in the map's mm.
    """
    limit = change_limit(depth_mm, labels)
    h, w = depth_mm.shape
    extent = (low_mm[0] - cell_mm / 2, low_mm[0] + (w - 0.5) * cell_mm,
              low_mm[1] - cell_mm / 2, low_mm[1] + (h - 0.5) * cell_mm)  # fmt: skip
    gy, gx = np.gradient(surface_mm, cell_mm)
    facing = 0.7 * (gx - gy) / np.sqrt(1 + gx**2 + gy**2)  # light from the upper left
    light = np.clip(0.66 + 0.3 * facing - 0.05 * np.hypot(gx, gy), 0.2, 0.95)
    shown = np.repeat(light[..., None], 3, axis=2)
    on = (labels > 0) & np.isfinite(depth_mm)
    shown[on] = change_colours(depth_mm[on], limit) / 255
    shown[~np.isfinite(depth_mm)] = mpl.colors.to_rgb(NOTHING)
    width, height = extent[1] - extent[0], extent[3] - extent[2]
    map_w = min(8.0, 5.2 * width / height)
    map_h = map_w * height / width
    W, H = max(map_w + 2.4, 7.5), map_h + 1.9
    with mpl.rc_context(_FONT):
        fig = Figure(figsize=(W, H), dpi=150, facecolor=PAPER)
        ax = fig.add_axes((0.75 / W, 0.6 / H, map_w / W, map_h / H))
        ax.imshow(shown, origin="lower", extent=extent, interpolation="nearest")
        halo = [withStroke(linewidth=3, foreground="white")]
        names = []
        for k, line in enumerate(strokes):
            ax.plot(line[:, 0], line[:, 1], color=_GUIDE, lw=1.4, path_effects=halo, label=None if k else "guideline")
            names.append("guideline")
        if cut is not None and len(cut):
            ax.plot(cut[:, 0], cut[:, 1], ".", color=_CUT, ms=1.6, label="cut")
            names.append("cut")
        for k in range(1, min(int(labels.max()), 40) + 1):
            i, j = np.nonzero(labels == k)
            if len(i):
                far = int(np.argmax((i - i.mean()) + (j - j.mean())))
                at = (low_mm[0] + cell_mm * (j[far] + 3), low_mm[1] + cell_mm * (i[far] + 3))
                ax.text(*at, str(k), fontsize=11, fontweight="bold", color=INK, path_effects=halo, ha="center")
        ax.set_xlim(*extent[:2])
        ax.set_ylim(*extent[2:])
        ax.set_xlabel("mm")
        ax.set_ylabel("mm")
        ax.tick_params(length=3)
        if names:
            ax.legend(loc="lower right", fontsize=9, markerscale=5, frameon=True, framealpha=0.85, edgecolor="none")
        bar = fig.add_axes(((0.75 + map_w + 0.35) / W, 0.6 / H, 0.18 / W, map_h / H))
        bar.imshow(np.linspace(-1, 1, 256)[:, None], origin="lower", aspect="auto", cmap=DIVERGING,
                   extent=(0, 1, -limit, limit))  # fmt: skip
        bar.set_xticks([])
        bar.yaxis.tick_right()
        bar.yaxis.set_label_position("right")
        bar.set_ylabel("added  (mm)  removed", color=PALE)
        for side in bar.spines.values():
            side.set_visible(False)
        fig.text(0.75 / W, 1 - 0.42 / H, title, fontsize=14, fontweight="bold", va="center")
        _figures_line(fig, figures, 0.75 / W, 1 - 0.8 / H, W)
        return _picture(fig, path)
