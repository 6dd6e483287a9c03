"""Places on the tissue to the projector's plane: what is hidden and why, how wide the line is, how exact, how long."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fringescope import geometry
from fringescope.guide.drape import Samples, Source, in_shadow
from fringescope.guide.tissue import Tissue
from fringescope.settings import GuideSettings
from fringescope.types import F64, U8, Guided, Hidden, HiddenPart, Layout, Projector, Stroke, Trace
from fringescope.types.guidance import WIDTH_MM

REASONS = tuple(Hidden)
SMOOTH_MM = 0.5  #: of a line, before its length and direction are taken
SHORTEST = 2  #: samples of a piece that can be drawn


def mirror_units(projector: Projector) -> float:
    """Side of a device pixel in projector-plane units (across its edges, on the diamond lattice)."""
    return math.sqrt(2.0) if projector.layout is Layout.DIAMOND else 1.0


def trace(samples: Samples, stroke: Stroke, tissue: Tissue, calibration_mm: float, s: GuideSettings) -> Trace:
    """Samples on the tissue to a trace on the projector's plane (equation 19, exact for its lens).

    `calibration_mm`: what the rig may be wrong by. Half widths are those that look `width_mm` wide on the tissue.
    """
    projector = tissue.rig.projector
    xyz, source = samples.xyz, samples.source
    uv = geometry.project(projector, xyz)
    to_light = geometry.centre(projector.pose) - xyz
    to_light /= np.linalg.norm(to_light, axis=1, keepdims=True)
    normal = _filled(tissue.relief.of(tissue.relief.normal, uv), to_light)
    tangent = _tangent(xyz, samples.piece, s.sample_mm)
    across = np.cross(normal, tangent)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    with np.errstate(invalid="ignore"):
        facing = (normal * to_light).sum(1)
        grazing = (facing < math.cos(math.radians(s.grazing_deg))) & np.isfinite(tissue.relief.depth_at(uv))
        w, h = projector.plane_size
        outside = ~((uv >= -0.5).all(1) & (uv[:, 0] <= w - 0.5) & (uv[:, 1] <= h - 0.5)) & np.isfinite(xyz).all(1)
    why = np.zeros(len(xyz), np.uint8)
    shadow = in_shadow(xyz, uv, source, tissue, s)
    nobody = source == Source.NOBODY
    for hidden, where in (
        (Hidden.GRAZING, grazing & ~nobody),
        (Hidden.HOLE, nobody),
        (Hidden.SHADOW, shadow),
        (Hidden.OUTSIDE, outside),
    ):
        why[where] = 1 + REASONS.index(hidden)
    half, pitch_mm = _half_widths(xyz, uv, across, tangent, stroke, projector)
    with np.errstate(invalid="ignore", divide="ignore"):
        slide = samples.ray - (-to_light) * ((samples.ray * normal).sum(1) / -facing)[:, None]
        drift = np.abs((slide * across).sum(1)) * samples.sigma
        drift = np.where(np.isfinite(drift), drift, 0.0)
        mirror = s.mirror_error * pitch_mm / np.clip(facing, 0.05, 1)
    sigma = np.sqrt(drift**2 + mirror**2 + (calibration_mm / np.clip(facing, 0.2, 1)) ** 2)
    return Trace(xyz, normal, sigma, uv, half, samples.piece, why, source == Source.OTHERS)


def _filled(normal: F64, otherwise: F64) -> F64:
    """Normals (n, 3), where there is none that of the nearest sample, or `otherwise`."""
    known = np.isfinite(normal).all(1)
    if not known.any():
        return otherwise
    at = np.flatnonzero(known)
    index = np.arange(len(normal))
    right = np.clip(np.searchsorted(at, index), 0, len(at) - 1)
    left = np.clip(right - 1, 0, len(at) - 1)
    nearest = np.where(np.abs(at[left] - index) <= np.abs(at[right] - index), at[left], at[right])
    return np.asarray(np.where((np.abs(nearest - index) < 20)[:, None], normal[nearest], otherwise))


def smoothed(xyz: F64, piece: Any, window: int) -> F64:
    """Places along each piece, averaged over `window` samples (odd); near the ends over as many as there are evenly."""
    out = xyz.copy()
    bounds = np.flatnonzero(np.diff(piece)) + 1
    for first, last in zip(np.r_[0, bounds], np.r_[bounds, len(xyz)], strict=True):
        n = last - first
        if n < 3 or window < 3:
            continue
        a = np.arange(n)
        reach = np.minimum(np.minimum(a, n - 1 - a), window // 2)
        total = np.concatenate([np.zeros((1, 3)), np.cumsum(np.nan_to_num(xyz[first:last]), axis=0)])
        out[first:last] = (total[a + reach + 1] - total[a - reach]) / (2 * reach + 1)[:, None]
    return np.where(np.isfinite(xyz), out, np.nan)


def _tangent(xyz: F64, piece: Any, pace: float) -> F64:
    """Unit direction of the line at each sample (n, 3)."""
    steps = np.linalg.norm(np.diff(xyz, axis=0), axis=1)
    usual = float(np.nanmedian(steps)) if np.isfinite(steps).any() else pace
    window = 2 * int(np.clip(round(0.5 * SMOOTH_MM / max(usual, 1e-6)), 0, 50)) + 1
    return direction(smoothed(xyz, piece, window), piece)


def direction(p: F64, piece: Any) -> F64:
    """Unit direction (n, 3) of pieces of polyline at their points (n, 3)."""
    if len(p) == 1:
        return np.array([[1.0, 0.0, 0.0]])
    ahead, behind = np.vstack([p[1:], p[-1:]]), np.vstack([p[:1], p[:-1]])
    same_after, same_before = np.r_[np.diff(piece) == 0, False], np.r_[False, np.diff(piece) == 0]
    t = np.where(same_after[:, None], ahead, p) - np.where(same_before[:, None], behind, p)
    length = np.linalg.norm(t, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        t = t / length
    ok = np.isfinite(t).all(1)
    if not ok.any():
        return np.tile([1.0, 0.0, 0.0], (len(p), 1))
    at = np.flatnonzero(ok)
    return np.asarray(t[at[np.clip(np.searchsorted(at, np.arange(len(p))), 0, len(at) - 1)]])


def _half_widths(
    xyz: F64, uv: F64, across: F64, tangent: F64, stroke: Stroke, projector: Projector
) -> tuple[F64, F64]:
    """Half the line's width (n,), units across the line on the plane, and the size of a mirror on a facing surface, mm.

    The edges of a line of constant width on the tissue lie at `across` times half its width; how far they are from the
    middle line on the plane is taken across that.
    """
    h = 0.05
    side = geometry.project(projector, xyz + h * across) - geometry.project(projector, xyz - h * across)
    ahead = geometry.project(projector, xyz + h * tangent) - geometry.project(projector, xyz - h * tangent)
    side, ahead = side / (2 * h), ahead / (2 * h)
    pace = np.linalg.norm(ahead, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        per_mm = np.abs(side[:, 0] * ahead[:, 1] - side[:, 1] * ahead[:, 0]) / pace
    depth = geometry.transform(projector.pose, xyz)[:, 2]
    K = projector.lens.K
    mirror = mirror_units(projector)
    pitch_mm = depth * mirror / math.sqrt(K[0, 0] * K[1, 1])
    if stroke.width_px is not None:
        return np.full(len(uv), 0.5 * stroke.width_px * mirror), pitch_mm
    width = stroke.width_mm if stroke.width_mm is not None else WIDTH_MM
    return np.maximum(0.5 * width * np.nan_to_num(per_mm), 0.25 * mirror), pitch_mm


# ---------------------------------------------------------------------------------------------------------- pieces


def runs(flags: Any) -> list[tuple[int, int]]:
    """First and last + 1 of each run of equal values."""
    cuts = np.flatnonzero(np.diff(flags)) + 1
    return list(zip(np.r_[0, cuts].tolist(), np.r_[cuts, len(flags)].tolist(), strict=True))


def visible_runs(t: Trace) -> list[tuple[int, int]]:
    """The pieces of a trace that are drawn: samples first..last - 1 of each."""
    key = t.piece.astype(np.int64) * 2 + (t.why == 0)
    return [(a, b) for a, b in runs(key) if t.why[a] == 0 and b - a >= SHORTEST] if len(t) else []


def hidden_parts(t: Trace) -> list[HiddenPart]:
    """The parts of a trace that are not drawn, each with its reason; they reach to the drawn pieces beside them."""
    shown = np.zeros(len(t), bool)
    for a, b in visible_runs(t):
        shown[a:b] = True
    why = np.where(shown, 0, np.where(t.why == 0, 1 + REASONS.index(Hidden.HOLE), t.why))
    out = []
    for a, b in runs(why.astype(np.int64) + 100 * t.piece) if len(t) else []:
        if why[a] == 0:
            continue
        first = max(a - 1, 0) if a and t.piece[a - 1] == t.piece[a] else a
        last = min(b + 1, len(t)) if b < len(t) and t.piece[b] == t.piece[a] else b
        part = t.uv[first:last]
        part = part[np.isfinite(part).all(1)]
        length = float(np.nansum(np.linalg.norm(np.diff(t.xyz[first:last], axis=0), axis=1)))
        out.append(HiddenPart(part, REASONS[why[a] - 1], length))
    return out


def length(t: Trace, sigma_mm: float) -> tuple[float, float]:
    """Length along the surface, mm, and its standard deviation: over holes it is straight.

    Noise is smoothed over `SMOOTH_MM` before; what is left of it, `sigma_mm` a place, enters at the bends and the ends.
    """
    if len(t) < 2:
        return 0.0, 0.0
    steps = np.linalg.norm(np.diff(t.xyz, axis=0), axis=1)
    usual = float(np.nanmedian(steps)) if np.isfinite(steps).any() else 1.0
    window = 2 * int(np.clip(round(0.5 * SMOOTH_MM / max(usual, 1e-6)), 0, 50)) + 1
    p = smoothed(t.xyz, t.piece, window)
    d = np.diff(p, axis=0)
    one = (np.diff(t.piece) == 0) & np.isfinite(d).all(1)
    total = float(np.linalg.norm(d[one], axis=1).sum())
    s = sigma_mm / math.sqrt(window)
    u = d[one] / np.maximum(np.linalg.norm(d[one], axis=1, keepdims=True), 1e-12)
    bends = float((np.diff(u, axis=0) ** 2).sum()) if len(u) > 1 else 0.0
    return total, math.sqrt((2.0 + bends) * s * s)


def usual_sigma(t: Trace) -> float:
    """Median error of a trace's places, mm; 0 where none is known."""
    known = t.sigma[np.isfinite(t.sigma)]
    return float(np.median(known)) if len(known) else 0.0


def guided(stroke: Stroke, traces: list[Trace], notes: tuple[str, ...], area: tuple[float, float] | None) -> Guided:
    """The record of a stroke: its visible pieces, what is hidden, length, expected error."""
    segments, lands, errors, hidden = [], [], [], []
    total = variance = 0.0
    for t in traces:
        for a, b in visible_runs(t):
            segments.append(t.uv[a:b])
            lands.append(t.xyz[a:b])
            errors.append(t.sigma[a:b])
        hidden += hidden_parts(t)
        if len(t):
            one, sigma = length(t, usual_sigma(t))
            total, variance = total + one, variance + sigma**2
    every: F64 | U8 = np.concatenate(errors) if errors else np.zeros(0)
    return Guided(
        stroke,
        tuple(traces),
        tuple(segments),
        tuple(lands),
        tuple(hidden),
        total,
        math.sqrt(variance),
        None if area is None else area[0],
        None if area is None else area[1],
        1e3 * float(np.sqrt(np.mean(every**2))) if len(every) else None,
        notes,
    )
