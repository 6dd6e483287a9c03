"""Circles, arrow heads, parallel lines and hatches: curves that are walked along the surface, in mm on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from fringescope import geometry
from fringescope.errors import GuidanceError
from fringescope.guide.drape import DEEP_MM, Samples, Source, bridged, on_surface, places
from fringescope.guide.inside import Inside
from fringescope.guide.tissue import Tissue
from fringescope.guide.trace import direction, runs, smoothed
from fringescope.settings import GuideSettings
from fringescope.types import F64, Bool, Side, Stroke
from fringescope.types.guidance import WIDTH_MM

CIRCLE = 2000  #: samples of a circle at most
CRUMB_MM = 0.5  #: shorter pieces of a circle are not drawn
TURN_BACK = 2  #: samples to each side over which a rim must go forward
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


@dataclass(frozen=True, eq=False)
class Disc:
    """What is walked over from a circle's centre: places (k + 1, n, 3) on the ways to its rim, and whether they (k + 1,
    n) are on the surface and continue those of the way beside.
    """

    ways: F64
    whole: Bool


def circle(stroke: Stroke, tissue: Tissue, s: GuideSettings) -> tuple[Samples, Disc]:
    """All that lies `radius_mm` from the centre, along the surface; or as far as the second point does.

    The rim is broken where the surface jumps or ends on the way there, and where it can be reached by a shorter way.
    """
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
    right, down, normal = frame_at(at[0], tissue)
    n = int(np.clip(math.ceil(2 * math.pi * radius / s.sample_mm), 24, CIRCLE))
    a = np.linspace(0, 2 * math.pi, n + 1)
    towards = np.cos(a)[:, None] * right + np.sin(a)[:, None] * down
    ways, d, walks, ground = tissue.relief.paths(np.repeat(at[:1], n + 1, 0), towards, radius, 2 * s.gap_mm)
    far = max(s.jump_mm, 8 * 2 * math.pi * radius / n)
    beside = np.linalg.norm(np.diff(ways, axis=1), axis=2) <= far
    there = ground[-1] & ~_turned_back(ways[-1], d, float(np.sign(np.cross(right, normal) @ down)), tissue)
    rim = np.where(there[:, None], ways[-1], np.nan)
    jump = ~beside[-1] & there[1:] & there[:-1]
    piece = np.concatenate([[0], np.cumsum(jump)]).astype(np.int32)
    length = np.concatenate([[0.0], np.linalg.norm(np.diff(rim, axis=0), axis=1)])
    for first, last in runs(np.where(there, piece, -1)):  # crumbs
        if there[first] and np.nansum(length[first + 1 : last]) < min(CRUMB_MM, 0.5 * radius):
            there[first:last] = False
    rim, _ = bridged(np.where(there[:, None], rim, np.nan))
    notes = [f"radius {radius:.2f} mm"]
    if (lost := float((~there[:-1]).mean())) >= 0.005:
        notes.append(f"{lost:.0%} of it is not reached along the surface, which jumps or ends before: not drawn there")
    if breaks := int(jump.sum()):
        notes.append(f"the surface jumps under it: it is broken in {breaks} place{'' if breaks == 1 else 's'}")
    whole = np.logical_and.accumulate(walks[:, 1:] & walks[:, :-1] & beside, axis=0)
    return on_surface(rim, there, piece, tuple(notes)), Disc(ways, whole)


def _turned_back(rim: F64, d: F64, sense: float, tissue: Tissue) -> Bool:
    """Which places of a rim (n, 3), reached in directions `d`, run against the turn: other ways there are shorter."""
    n = tissue.relief.of(tissue.relief.normal, geometry.project(tissue.rig.projector, rim))
    ring = np.concatenate([rim[-1 - TURN_BACK : -1], rim, rim[1 : 1 + TURN_BACK]])
    with np.errstate(invalid="ignore"):
        return np.asarray(((ring[2 * TURN_BACK :] - ring[: -2 * TURN_BACK]) * np.cross(d, n)).sum(1) * sense < 0)


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


def hatch(outline: F64, inside: Inside, stroke: Stroke, tissue: Tissue, s: GuideSettings) -> list[Samples]:
    """Lines every `spacing_mm` across a region, on its mean plane, dropped onto the surface; `outline` (n, 3) mm.

    What they would meet that does not belong to the region is left out, or hidden, where it lies above it.
    """
    projector = tissue.rig.projector
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
            uv = geometry.project(projector, spot)
            ground = tissue.relief.at(uv)
            there: Bool = np.asarray(np.isfinite(ground).all(1))
            spot = np.where(there[:, None], ground, spot)
            behind = inside.behind(uv)
            deep = there & (behind > DEEP_MM)  # something else is before it
            eye = geometry.centre(projector.pose)
            ray = spot[deep] - eye
            spot[deep] += ray * (behind[deep] / (ray @ projector.pose.R[2]))[:, None]
            keep = np.flatnonzero(~there | deep | inside.holds(uv))
            if len(keep) < 2:
                continue
            made = on_surface(spot[keep], there[keep], np.cumsum(np.diff(keep, prepend=keep[0]) > 1).astype(np.int32))
            made.source[deep[keep]] = Source.ASKED
            out.append(made)
    return out


def _inside(ring: F64, y: float) -> list[tuple[float, float]]:
    """Where a horizontal line lies inside a closed polygon (n, 2), by the even-odd rule."""
    a, b = ring, np.roll(ring, -1, 0)
    cross = (a[:, 1] <= y) != (b[:, 1] <= y)
    x = np.sort(a[cross, 0] + (y - a[cross, 1]) / (b[cross, 1] - a[cross, 1]) * (b[cross, 0] - a[cross, 0]))
    return [(float(p), float(q)) for p, q in zip(x[::2], x[1::2], strict=False) if q - p > 0.05]
