"""Circles, arrow heads, parallel lines and hatches: curves that are walked along the surface, in mm on it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fringescope import geometry
from fringescope.errors import GuidanceError
from fringescope.guide.drape import Samples, Source, on_surface, places
from fringescope.guide.tissue import Tissue
from fringescope.guide.trace import direction, smoothed
from fringescope.settings import GuideSettings
from fringescope.types import F64, Bool, Side, Stroke
from fringescope.types.guidance import WIDTH_MM

CIRCLE = 360  #: samples of a circle at most
HEAD_WIDTHS = 6.0  #: length of an arrow's head that asks for none, in widths of its line
HEAD_TURN = math.radians(150)  #: from where the arrow points to where the wings of its head go


def frame_at(point: F64, tissue: Tissue) -> tuple[F64, F64, F64]:
    """Unit vectors (3,) at a place on the tissue: to the projector's right, down, and its normal."""
    p = tissue.rig.projector
    uv = geometry.project(p, point[None])
    n = tissue.relief.of(tissue.relief.normal, uv)[0]
    if not np.isfinite(n).all():
        n = geometry.centre(p.pose) - point
    n = n / np.linalg.norm(n)
    right = p.pose.R[0] - (p.pose.R[0] @ n) * n
    right /= np.linalg.norm(right)
    return right, np.cross(right, n) * np.sign(np.cross(right, n) @ p.pose.R[1]), n


def circle(stroke: Stroke, tissue: Tissue, s: GuideSettings) -> Samples:
    """All that lies `radius_mm` from the centre, along the surface; or as far as the second point does."""
    at = places(stroke, stroke.points[:2], tissue, s)
    if not np.isfinite(at[0]).all():
        raise GuidanceError("the centre of the circle is not on the measured surface; move it")
    radius = stroke.radius_mm
    if radius is None:
        if not np.isfinite(at[1]).all():
            raise GuidanceError("the rim of the circle is not on the measured surface; move it or give radius_mm")
        radius = float(np.linalg.norm(at[1] - at[0]))
        if radius < 0.05:
            raise GuidanceError("the circle's second point lies on its centre; needed a radius of 0.05 mm or more")
    right, down, _ = frame_at(at[0], tissue)
    n = int(np.clip(math.ceil(2 * math.pi * radius / s.sample_mm), 24, CIRCLE))
    a = np.linspace(0, 2 * math.pi, n + 1)
    towards = np.cos(a)[:, None] * right + np.sin(a)[:, None] * down
    rim, ground = tissue.relief.walk(np.repeat(at[:1], n + 1, 0), towards, np.full(n + 1, radius))
    return on_surface(rim, ground, notes=(f"radius {radius:.2f} mm",))


def head(line: Samples, stroke: Stroke, tissue: Tissue, s: GuideSettings) -> list[Samples]:
    """The two wings of an arrow's head, from the last place of its line that is on the surface."""
    known = np.flatnonzero((line.source != Source.NOBODY) & np.isfinite(line.xyz).all(1))
    if len(known) < 2:
        return []
    width = stroke.width_mm or WIDTH_MM
    size = stroke.head_mm or HEAD_WIDTHS * width
    tip = line.xyz[known[-1]]
    back = np.linalg.norm(line.xyz[known] - tip, axis=1) >= min(size, 1.0)
    before = line.xyz[known[np.flatnonzero(back)[-1] if back.any() else 0]]
    _, _, n = frame_at(tip, tissue)
    ahead = (tip - before) - ((tip - before) @ n) * n
    ahead /= max(float(np.linalg.norm(ahead)), 1e-9)
    out = []
    for turn in (HEAD_TURN, -HEAD_TURN):
        towards = math.cos(turn) * ahead + math.sin(turn) * np.cross(n, ahead)
        out.append(_straight(tip, towards, size, tissue, s))
    return out


def _straight(start: F64, towards: F64, length: float, tissue: Tissue, s: GuideSettings) -> Samples:
    """A walk straight ahead, sampled."""
    distance = np.linspace(0, length, max(3, math.ceil(length / s.sample_mm) + 1))
    n = len(distance)
    return on_surface(*tissue.relief.walk(np.tile(start, (n, 1)), np.tile(towards, (n, 1)), distance))


def offsets(line: Samples, stroke: Stroke, tissue: Tissue) -> list[Samples]:
    """`count` lines to the side of a line, every `spacing_mm` along the surface.

    Inside a bend the outer parts of parallel lines would cross: what comes nearer to the line than its spacing goes.
    """
    known = (line.source != Source.NOBODY) & np.isfinite(line.xyz).all(1)
    if known.sum() < 2:
        return []
    base = line.xyz[known]
    piece = _parts(line.piece[known], np.flatnonzero(known), 1)
    pace = float(np.median(np.linalg.norm(np.diff(base, axis=0), axis=1)))
    window = 2 * int(np.clip(round(0.5 / max(pace, 1e-6)), 0, 100)) + 1
    base = smoothed(base, piece, window)
    normal = tissue.relief.of(tissue.relief.normal, geometry.project(tissue.rig.projector, base))
    # to the right of one who looks at it from the projector
    aside = np.cross(direction(base, piece), normal)
    known = np.isfinite(aside).all(1)
    sides = {Side.RIGHT: (1,), Side.LEFT: (-1,), Side.BOTH: (1, -1)}[stroke.side]
    lines = {
        (k, side): line
        for side in sides
        for k, line in enumerate(_parallels(base[known], piece[known], side * aside[known], stroke, pace, tissue))
    }
    return [lines[key] for key in sorted(lines, key=lambda key: (key[0], -key[1])) if len(lines[key])]


def _parallels(base: F64, piece: Any, aside: F64, stroke: Stroke, pace: float, tissue: Tissue) -> list[Samples]:
    """The lines to one side of a line, the nearest first: each is walked to from the one before."""
    from scipy.spatial import cKDTree  # only who draws such lines needs it

    tree, p, d = cKDTree(base), base, aside
    out = []
    for _ in range(stroke.count):
        p, d, ground = tissue.relief.walk_on(p, d, np.full(len(base), stroke.spacing_mm))
        # the straight distance is less than that along the surface; the line's own crossings come much nearer
        keep = np.flatnonzero(tree.query(p)[0] >= 0.97 * np.linalg.norm(p - base, axis=1))
        q = p[keep]
        gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(q, axis=0), axis=1))])
        out.append(on_surface(q, ground[keep], _parts(piece[keep], gone, 10 * pace)))
    return out


def _parts(piece: Any, at: Any, most: float) -> Any:
    """Numbers of unbroken pieces (n,), broken also where `at` goes on by more than `most`."""
    return np.concatenate([[0], np.cumsum((np.diff(piece) != 0) | (np.diff(at) > most))]).astype(np.int32)[: len(piece)]


def hatch(outline: F64, stroke: Stroke, tissue: Tissue, s: GuideSettings) -> list[Samples]:
    """Lines every `spacing_mm` across a region, on its mean plane, dropped onto the surface; `outline` (n, 3) mm."""
    centre = outline.mean(0)
    _, _, axes = np.linalg.svd(outline - centre, full_matrices=False)
    right, _, _ = frame_at(centre, tissue)
    e1, e2 = axes[0], axes[1]
    flat = (outline - centre) @ np.stack([e1, e2], 1)
    turn = math.atan2(float(right @ e2), float(right @ e1)) + math.pi / 4
    c, d = math.cos(turn), math.sin(turn)
    q = flat @ np.array([[c, -d], [d, c]])
    out = []
    first = math.ceil(q[:, 1].min() / stroke.spacing_mm)
    for i in range(first, math.floor(q[:, 1].max() / stroke.spacing_mm) + 1):
        for a, b in _inside(q, i * stroke.spacing_mm):
            n = max(3, math.ceil((b - a) / s.sample_mm) + 1)
            line = np.stack([np.linspace(a, b, n), np.full(n, i * stroke.spacing_mm)], 1) @ np.array([[c, d], [-d, c]])
            spot = centre + line[:, :1] * e1 + line[:, 1:] * e2
            ground = tissue.relief.at(geometry.project(tissue.rig.projector, spot))
            there: Bool = np.asarray(np.isfinite(ground).all(1))
            out.append(on_surface(np.where(there[:, None], ground, spot), there))
    return out


def _inside(ring: F64, y: float) -> list[tuple[float, float]]:
    """Where a horizontal line lies inside a closed polygon (n, 2), by the even-odd rule."""
    a, b = ring, np.roll(ring, -1, 0)
    cross = (a[:, 1] <= y) != (b[:, 1] <= y)
    x = np.sort(a[cross, 0] + (y - a[cross, 1]) / (b[cross, 1] - a[cross, 1]) * (b[cross, 0] - a[cross, 0]))
    return [(float(p), float(q)) for p, q in zip(x[::2], x[1::2], strict=False) if q - p > 0.05]
