"""Where did the projected lines land? Found in pictures to a fraction of a pixel, triangulated, and compared (IV-D).

Three pictures of each camera: dark, all mirrors on, and the guidance. Their ratio is free of the tissue's colour and of
other light. At stations along each line the step response of a line of known width is fitted across it; what several
cameras find is triangulated in the plane across the line, with the scanned surface as one more, soft observation.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fringescope import geometry
from fringescope.guide.tissue import Tissue
from fringescope.guide.trace import visible_runs
from fringescope.settings import LoopSettings
from fringescope.types import F32, F64, AnyArray, Bool, Camera, Fill, Guidance, Guided, Landing, PixelFormat
from fringescope.types.guidance import WIDTH_MM

REACHES = 61  #: places across a line at which its centre is tried, before it is refined


@dataclass(frozen=True, eq=False)
class Shots:
    """What one camera saw: raw frames (H, W) of the dark, of all mirrors on, and of the guidance."""

    camera: str
    pixel_format: PixelFormat
    dark: AnyArray
    white: AnyArray
    guided: AnyArray


@dataclass(frozen=True, eq=False)
class _Stations:
    """Places of a stroke at which it is looked for: on the tissue, along it, across it, and half its width, mm.

    `before` and `after` lie on the line, at the ends of the piece that a station looks at.
    """

    place: F64
    before: F64
    after: F64
    along: F64
    across: F64
    normal: F64
    half: F64


def landings(
    guidance: Guidance, shots: Sequence[Shots], tissue: Tissue, s: LoopSettings
) -> tuple[Landing, ...]:
    """The landing of every stroke that is shown, in the order of the strokes.

    Text and what is filled are not looked for, and no line where another one crosses or runs beside it.
    """
    out = []
    everything = [_points(g) for g in guidance.strokes]
    for i, g in enumerate(guidance.strokes):
        if g.refused is not None or not any(len(t) for t in g.traces) or g.stroke.fill is Fill.SOLID:
            continue
        others = np.concatenate([np.zeros((0, 4)), *(p for j, p in enumerate(everything) if j != i)])
        stations = _alone(_stations(g, s), others, s)
        out.append(_landing(g.stroke.id, stations, shots, tissue, s))
    return tuple(out)


def _points(g: Guided) -> F64:
    """Places on the tissue of a stroke that are lit, with half its width there (n, 4), mm."""
    rows = [
        np.column_stack([t.xyz[a:b], _half_mm(g, t.half[a:b])]) for t in g.traces for a, b in visible_runs(t)
    ]
    return np.concatenate([np.zeros((0, 4)), *rows])


def _half_mm(g: Guided, half: F64) -> F64:
    width = g.stroke.width_mm
    if width is None and g.stroke.width_px is None:
        width = WIDTH_MM
    return np.full(len(half), 0.5 * width) if width is not None else np.full(len(half), np.nan)


def _stations(g: Guided, s: LoopSettings) -> _Stations:
    """Stations every `station_mm` along the visible pieces, clear of their ends."""
    parts: list[tuple[F64, ...]] = []
    for t in g.traces:
        for a, b in visible_runs(t):
            p = t.xyz[a:b]
            gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
            clear = s.along_mm + 0.3
            if gone[-1] <= 2 * clear + 0.1:
                continue
            n = max(1, int((gone[-1] - 2 * clear) / s.station_mm))
            at = np.linspace(clear, gone[-1] - clear, n)
            i = np.clip(np.searchsorted(gone, at), 1, len(p) - 1)
            reach = s.along_mm
            before, place, after = (
                np.stack([np.interp(at + d, gone, p[:, k]) for k in range(3)], 1) for d in (-reach, 0.0, reach)
            )
            along = after - before
            along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
            normal = t.normal[a:b][i]
            across = np.cross(normal, along)
            across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
            parts.append((place, before, after, along, across, np.cross(along, across), _half_mm(g, t.half[a:b])[i]))
    if not parts:
        return _Stations(*(np.zeros((0, 3)),) * 6, np.zeros(0))
    return _Stations(*(np.concatenate(c) for c in zip(*parts, strict=True)))


def _alone(st: _Stations, others: F64, s: LoopSettings) -> _Stations:
    """The stations that no other line comes near."""
    if not len(others) or not len(st.place):
        return st
    from scipy.spatial import cKDTree

    reach = np.nan_to_num(others[:, 3], nan=0.3).max() + np.nan_to_num(st.half, nan=0.3) + s.search_mm
    away = cKDTree(others[:, :3]).query(st.place)[0] > reach
    return _Stations(*(getattr(st, f.name)[away] for f in dataclasses.fields(st)))


# ----------------------------------------------------------------------------------------------------- one stroke


def _landing(name: str, st: _Stations, shots: Sequence[Shots], tissue: Tissue, s: LoopSettings) -> Landing:
    n = len(st.place)
    offset, sigma = np.full((len(shots), n), np.nan), np.full((len(shots), n), np.nan)
    slopes = np.zeros((len(shots), n, 2))
    seen = np.zeros((len(shots), n), bool)
    views = []
    for k, shot in enumerate(shots):
        number = tissue.number(shot.camera)
        views.append(tissue.grids[number].view)
        camera = tissue.rig.cameras[views[-1]]
        seen[k] = _sees(tissue, number, st.place)
        lines = _in_picture(camera, st)
        slopes[k] = lines.slopes
        look = np.flatnonzero(seen[k])
        if look.size:
            offset[k, look], sigma[k, look] = _find(shot, lines.of(look), st.half[look], s)
    found, height = _triangulate(offset, sigma, slopes, s)
    ok = np.isfinite(found)
    told = 1e3 * np.abs(found[ok])
    words = []
    expected = seen.any(0)
    share = float(ok[expected].mean()) if expected.any() else 0.0
    if n == 0:
        words.append("too short, or too close to other lines, to be looked for")
    elif share < 0.5:
        words.append(f"found at {share:.0%} of the places where it should be seen")
    if ok.any() and abs(float(np.median(height[ok]))) > s.max_height_mm:
        words.append(f"lies {np.median(height[ok]):+.2f} mm off the scanned surface: it has changed; re-scan")
    kk, jj = np.nonzero(np.isfinite(offset) & ok[None])
    mine = offset[kk, jj]
    pace_mm = slopes[kk, jj, 0]
    return Landing(
        name,
        st.place[jj] + st.across[jj] * (mine / np.where(np.abs(pace_mm) > 1e-6, pace_mm, np.nan))[:, None],
        st.place[jj],
        1e3 * found[jj],
        np.array([views[k] for k in kk], np.int32),
        float(np.median(told)) if len(told) else None,
        float(np.percentile(told, 95)) if len(told) else None,
        float(told.max()) if len(told) else None,
        share,
        tuple(words),
    )


def _sees(tissue: Tissue, number: int, place: F64) -> Bool:
    """Whether the camera of a grid measured these very places (n, 3)."""
    g = tissue.grids[number]
    uv = geometry.project(tissue.rig.cameras[g.view], place)
    H, W = g.reasons.shape
    with np.errstate(invalid="ignore"):
        ok = (uv >= 1).all(1) & (uv[:, 0] < W - 2) & (uv[:, 1] < H - 2)
    c, r = np.floor(np.where(ok[:, None], uv, 1) + 0.5).astype(np.intp).T
    near = np.linalg.norm(g.xyz[r, c] - place, axis=1)
    return np.asarray(ok & (g.reasons[r, c] == 0) & (near < 0.2 + 1.5 * tissue.footprints[number]))


@dataclass(frozen=True, eq=False)
class _Lines:
    """Stations in a picture, pixels: place (n, 2), unit direction across the line (n, 2), how far it moves across for a
    mm across and a mm up (n, 2), pixels per mm along it (n,), and its bend: how far across after a pixel along (n,).
    """

    at: F64
    side: F64
    slopes: F64
    pace: F64
    bend: F64

    def of(self, look: Any) -> _Lines:
        """Some of them."""
        return _Lines(*(getattr(self, f.name)[look] for f in dataclasses.fields(self)))


def _in_picture(camera: Camera, st: _Stations) -> _Lines:
    h = 0.05

    def moved(d: F64) -> F64:
        a = geometry.project(camera, st.place + h * d) - geometry.project(camera, st.place - h * d)
        return np.asarray(a / (2 * h))

    at = geometry.project(camera, st.place)
    along, across, up = moved(st.along), moved(st.across), moved(st.normal)
    pace = np.linalg.norm(along, axis=1)
    line = along / np.maximum(pace, 1e-9)[:, None]
    side = np.stack([-line[:, 1], line[:, 0]], 1)
    side *= np.sign((side * across).sum(1))[:, None]
    ends = [geometry.project(camera, e) - at for e in (st.before, st.after)]
    reach2 = 0.5 * sum((e**2).sum(1) for e in ends)
    bend = (0.5 * (ends[0] + ends[1]) * side).sum(1) / np.maximum(reach2, 1e-9)
    return _Lines(at, side, np.stack([(side * across).sum(1), (side * up).sum(1)], 1), pace, bend)


def _find(shot: Shots, lines: _Lines, half: F64, s: LoopSettings) -> tuple[F64, F64]:
    """How far across the line (n,), pixels, from where it should be its light is centred, and the error of that.

    NaN where it is not found: too little light, saturated, or a profile that is not that of a line.
    """
    at, side, wide = lines.at, lines.side, np.abs(lines.slopes[:, 0])
    per_mm = float(np.median(lines.pace))
    reach_across = float(np.nanmax(np.nan_to_num(half, nan=0.3)) + s.search_mm) * per_mm
    reach_along = max(s.along_mm * per_mm, 1.0)
    R = math.ceil(math.hypot(reach_across, reach_along)) + 1
    stride = max(1, int(2 * R / 40))  # many pixels do not make it better
    steps = np.arange(-R, R + 1, stride)
    dv, du = (a.ravel() for a in np.meshgrid(steps, steps, indexing="ij"))
    base = np.floor(at + 0.5).astype(np.intp)
    H, W = shot.dark.shape[:2]
    c, r = base[:, :1] + du, base[:, 1:] + dv
    inside = (c >= 0) & (c < W) & (r >= 0) & (r < H)
    cc, rr = np.where(inside, c, 0), np.where(inside, r, 0)
    px, py = cc - at[:, :1], rr - at[:, 1:]
    x = px * side[:, :1] + py * side[:, 1:]
    along = px * side[:, 1:] - py * side[:, :1]
    x -= lines.bend[:, None] * along**2
    dark, white, lit = (_sampled(f, rr, cc) for f in (shot.dark, shot.white, shot.guided))
    top = float(shot.pixel_format.max_value)
    usable = inside & (np.abs(x) <= reach_across) & (np.abs(along) <= reach_along)
    usable &= (white < top) & (lit < top) & (white - dark > 4 * top / 255)
    full = np.where(usable, white - dark, 1.0)
    ratio = np.where(usable, (lit - dark) / full, 0.0)
    kind = (rr % 2) * 2 + cc % 2 if shot.pixel_format.is_bayer else np.zeros_like(rr)
    middle = np.abs(x) <= (np.nan_to_num(half, nan=0.3) * wide)[:, None]
    weight, ratio = _one_scale(ratio, full * usable, kind, middle, usable)
    return _fit(x, ratio, weight, np.nan_to_num(half, nan=0.3) * wide, s, per_mm)


def _sampled(frame: AnyArray, r: Any, c: Any) -> F32:
    f = frame[r, c]
    return np.asarray(f.mean(-1) if f.ndim == 3 else f, np.float32)


def _one_scale(ratio: F32, full: F32, kind: Any, middle: Bool, usable: Bool) -> tuple[F64, F64]:
    """Weights, and ratios as multiples of what each kind of pixel (of a colour mosaic) shows of the line's colour."""
    weight, out = np.zeros(ratio.shape), np.zeros(ratio.shape)
    for k in range(int(kind.max()) + 1 if kind.size else 0):
        mine = (kind == k) & usable
        core = mine & middle
        if core.sum() < 5:
            continue
        level = float(np.percentile(ratio[core], 80))
        if level < 0.03:
            continue
        out[mine] = ratio[mine] / level
        weight[mine] = (full[mine] * level) ** 2 / np.maximum(full[mine], 1.0)
    return weight, out


def _fit(x: F64, y: F64, w: F64, half_px: F64, s: LoopSettings, per_mm: float) -> tuple[F64, F64]:
    """Centre of a line's profile `y` (n, m) at `x`, weights `w`: least squares over place, height and ground."""
    from scipy.special import erf

    n = len(x)
    out, error = np.full(n, np.nan), np.full(n, np.nan)
    if not n:
        return out, error
    span = s.search_mm * per_mm
    tries = np.linspace(-span, span, REACHES)
    blur = math.hypot(s.blur_mm * per_mm, 0.4)
    enough = (w > 0).sum(1) >= 12

    def cost(centre: F64, rows: Any) -> tuple[F64, F64, F64]:
        d = x[rows] - centre[:, None]
        a = half_px[rows][:, None]
        t = 0.5 * (erf((d + a) / (math.sqrt(2) * blur)) - erf((d - a) / (math.sqrt(2) * blur)))
        ww, yy = w[rows], y[rows]
        s0, st, stt = ww.sum(1), (ww * t).sum(1), (ww * t * t).sum(1)
        sy, sty, syy = (ww * yy).sum(1), (ww * t * yy).sum(1), (ww * yy * yy).sum(1)
        det = s0 * stt - st * st
        det = np.where(det > 0, det, np.nan)
        height = (s0 * sty - st * sy) / det
        ground = (stt * sy - st * sty) / det
        return syy - height * sty - ground * sy, height, s0

    rows = np.flatnonzero(enough)
    if not rows.size:
        return out, error
    table = np.stack([cost(np.full(len(rows), c), rows)[0] for c in tries], 1)
    table = np.where(np.isfinite(table), table, np.inf)
    best = table.argmin(1)
    centre = tries[best]
    inner = (best > 0) & (best < REACHES - 1)
    step = tries[1] - tries[0]
    for _ in range(3):  # a parabola through three costs, ever closer
        low, mid, high = (cost(centre + d, rows)[0] for d in (-step, 0.0, step))
        bend = low - 2 * mid + high
        with np.errstate(invalid="ignore", divide="ignore"):
            move = np.where(bend > 0, 0.5 * (low - high) / bend, 0.0) * step
        centre = centre + np.clip(np.nan_to_num(move), -step, step)
        step *= 0.4
    left, height, total = cost(centre, rows)
    bend = cost(centre + step, rows)[0] - 2 * left + cost(centre - step, rows)[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        noise = left / np.maximum((w[rows] > 0).sum(1) - 3, 1)
        err = np.sqrt(2 * np.maximum(noise, 0) / (bend / step**2))
        misfit = np.sqrt(np.maximum(left, 0) / total)
        good = inner & (height > s.min_height) & (misfit < s.max_misfit * height) & np.isfinite(err) & (err < 0.5)
    out[rows[good]] = centre[good]
    error[rows[good]] = np.maximum(err[good], 0.01)
    return out, error


def _triangulate(offset: F64, sigma: F64, slopes: F64, s: LoopSettings) -> tuple[F64, F64]:
    """Across the line and up (n,), mm: what the cameras' offsets (K, n), pixels, say together.

    Each camera ties a combination of both (`slopes` (K, n, 2), pixels per mm); the scanned surface, that up is 0 to
    within `surface_mm`. NaN where no camera found the line.
    """
    ok = np.isfinite(offset)
    w = np.where(ok, 1 / np.maximum(np.nan_to_num(sigma, nan=1.0), 0.03) ** 2, 0.0)
    a, b, y = slopes[..., 0], slopes[..., 1], np.where(ok, offset, 0.0)
    aa, ab, bb = (w * a * a).sum(0), (w * a * b).sum(0), (w * b * b).sum(0) + 1 / s.surface_mm**2
    ya, yb = (w * a * y).sum(0), (w * b * y).sum(0)
    det = aa * bb - ab * ab
    with np.errstate(invalid="ignore", divide="ignore"):
        across, up = (bb * ya - ab * yb) / det, (aa * yb - ab * ya) / det
    none = ~ok.any(0)
    across[none] = up[none] = np.nan
    return across, up
