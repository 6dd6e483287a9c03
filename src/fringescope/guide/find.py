"""Where did the projected lines land? Found in pictures to a fraction of a pixel, triangulated, and compared (IV-D).

Three pictures of each camera: dark, all mirrors on, and the guidance. Their ratio is free of the tissue's colour and of
other light. At stations along each line the step response of a line of known width is fitted across it; what several
cameras find is triangulated in the plane across the line, with the scanned surface as one more, soft observation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fringescope import geometry
from fringescope.guide import stations
from fringescope.guide.stations import Stations
from fringescope.guide.tissue import Tissue
from fringescope.settings import LoopSettings
from fringescope.types import F32, F64, AnyArray, Bool, Camera, Fill, Grid, Guidance, Landing, PixelFormat, Projector

REACHES = 61  #: places across a line at which its centre is tried, before it is refined
LEAST = 2  #: pixels of a line's profile, and of the ground to each side of it, must be seen
SIDE_SHARE = 0.25  #: and this share of those that there are
FEW = 16  #: pixels of each kind of a colour mosaic around a station: with fewer they are taken together
KIND_SHARE = 0.3  #: the same, of each kind of pixel of a colour mosaic, of what the best of them sees
SIZES = (10, 20, 40)  #: pixels around stations that are looked at, by which they are taken together
BLUR_PIXELS = 0.6  #: softness of a camera's pictures (standard deviation)
SOFTER = (0.7, 0.85, 1.0, 1.15, 1.3, 1.5, 1.75, 2.0)  #: than expected that lines may be
DARK = 0.03  #: light, as a share of that of all mirrors, that is none
SLOPE_LEAST = 0.5  #: pixels that a line must move for a mm across


@dataclass(frozen=True, eq=False)
class Shots:
    """What one camera saw: raw frames (H, W) of the dark, of all mirrors on, and of the guidance."""

    camera: str
    pixel_format: PixelFormat
    dark: AnyArray
    white: AnyArray
    guided: AnyArray


def landings(
    guidance: Guidance, shots: Sequence[Shots], tissue: Tissue, s: LoopSettings
) -> tuple[Landing, ...]:
    """The landing of every stroke that is shown, in the order of the strokes.

    Text and what is filled are not looked for, and no line where others cross or run beside it, or where it ends.
    """
    out = []
    every = stations.lights(guidance, tissue)
    for i, g in enumerate(guidance.strokes):
        if g.refused is not None or not any(len(t) for t in g.traces) or g.stroke.fill is Fill.SOLID:
            continue
        out.append(_landing(g.stroke.id, stations.of_stroke(g, i, every, tissue, s), shots, tissue, s))
    return tuple(out)


# ----------------------------------------------------------------------------------------------------- one stroke


def _landing(name: str, st: Stations, shots: Sequence[Shots], tissue: Tissue, s: LoopSettings) -> Landing:
    n = len(st.place)
    offset, sigma = np.full((len(shots), n), np.nan), np.full((len(shots), n), np.nan)
    slopes = np.zeros((len(shots), n, 2))
    seen = np.zeros((len(shots), n), bool)
    views = []
    fit_for = st.reach > 0
    for k, shot in enumerate(shots):
        grid = tissue.grids[tissue.number(shot.camera)]
        views.append(grid.view)
        camera = tissue.rig.cameras[grid.view]
        seen[k] = _sees(tissue, tissue.number(shot.camera), st.place)
        at, side, slopes[k], pace = _in_picture(camera, st)
        look = np.flatnonzero(seen[k] & fit_for & (np.abs(slopes[k, :, 0]) > SLOPE_LEAST))
        if look.size:
            some = st.of(look)
            mm, error = _find(
                shot, grid, some, at[look], side[look], slopes[k, look, 0], pace[look], tissue.rig.projector, s
            )
            offset[k, look], sigma[k, look] = mm * slopes[k, look, 0], error * np.abs(slopes[k, look, 0])
    found, height = _triangulate(offset, sigma, slopes, s)
    ok = np.isfinite(found)
    told = 1e3 * np.abs(found[ok])
    kk, jj = np.nonzero(np.isfinite(offset) & ok[None])
    return Landing(
        name,
        st.place[jj] + st.across[jj] * (offset[kk, jj] / slopes[kk, jj, 0])[:, None],
        st.place[jj],
        1e3 * found[jj],
        np.array([views[k] for k in kk], np.int32),
        float(np.median(told)) if len(told) else None,
        float(np.percentile(told, 95)) if len(told) else None,
        float(told.max()) if len(told) else None,
        float(ok[seen.any(0)].mean()) if seen.any() else 0.0,
        _words(ok, np.asarray(seen.any(0)), fit_for, height, s),
    )


def _words(ok: Bool, seen: Bool, fit_for: Bool, height: F64, s: LoopSettings) -> tuple[str, ...]:
    """What is to be said of a landing: `ok` where it was found, of the places that are `seen` and can be judged."""
    words = []
    expected = seen & fit_for
    if not fit_for.any():
        words.append("too short, or too close to other lines, to be looked for")
    else:
        if (share := float(ok[expected].mean()) if expected.any() else 0.0) < 0.5:
            words.append(f"found at {share:.0%} of the places where it should be seen")
        if seen.any() and (judged := float(ok[seen].mean())) < 0.5:
            words.append(f"{judged:.0%} of it was judged: the rest is near ends, bends, edges or other lines")
    if ok.any() and abs(float(np.median(height[ok]))) > s.max_height_mm:
        words.append(f"lies {np.median(height[ok]):+.2f} mm off the scanned surface: it has changed; re-scan")
    return tuple(words)


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


def _in_picture(camera: Camera, st: Stations) -> tuple[F64, F64, F64, F64]:
    """Stations in a picture: their pixels (n, 2), the unit direction across the line (n, 2), how far the line moves so
    for a mm across and a mm up (n, 2), pixels, and pixels per mm along it (n,).
    """
    h = 0.05

    def moved(d: F64) -> F64:
        a = geometry.project(camera, st.place + h * d) - geometry.project(camera, st.place - h * d)
        return np.asarray(a / (2 * h))

    along, across, up = moved(st.along), moved(st.across), moved(st.normal)
    pace = np.linalg.norm(along, axis=1)
    line = along / np.maximum(pace, 1e-9)[:, None]
    side = np.stack([-line[:, 1], line[:, 0]], 1)
    side *= np.sign((side * across).sum(1))[:, None]
    return geometry.project(camera, st.place), side, np.stack([(side * across).sum(1), (side * up).sum(1)], 1), pace


def _find(
    shot: Shots, grid: Grid, st: Stations, at: F64, side: F64, slope: F64, pace: F64, projector: Projector,
    s: LoopSettings,
) -> tuple[F64, F64]:
    """How far across the line (n,), mm, from where it should be its light is centred, and the error of that.

    Each pixel tells of the place that the camera measured there: how far that is from the line is taken on the
    projector's plane, where a line keeps its width whatever it lies on. NaN where the line is not found: too little
    light, saturated, one side of it not seen, or a profile that is not that of a line.
    """
    size = np.hypot((st.half / st.per_mm + s.search_mm) * np.abs(slope), st.reach * pace)
    found, error = np.full(len(at), np.nan), np.full(len(at), np.nan)
    seen: list[tuple[Any, _Profiles]] = []
    for low, high in zip((0, *SIZES), (*SIZES, np.inf), strict=True):
        if (some := np.flatnonzero((size > low) & (size <= high))).size:
            R = math.ceil(float(size[some].max())) + 1
            where = at[some], side[some], slope[some], pace[some]
            seen.append((some, _profiles(shot, grid, st.of(some), *where, R, projector)))
    levels = _levels([p for _, p in seen])
    for some, p in seen:
        width = np.hypot(s.blur_mm, BLUR_PIXELS / np.abs(slope[some]))
        found[some], error[some] = _fit(p, levels, st.search[some], width, np.abs(slope[some]), s)
    return found, error


@dataclass(frozen=True, eq=False)
class _Profiles:
    """Pixels around n stations: how far across the line they lie (n, m), mm, their light as a share of that of all
    mirrors, their weights (0: not to be used); the columns of each kind of pixel of a colour mosaic; half the line's
    width (n,), mm, and half its curvature, 1/mm; how many pixels there are to its left, on it and to its right (n, 3).
    """

    x: F64
    y: F64
    w: F64
    kinds: list[Any]
    half: F64
    bow: F64
    room: F64


def _profiles(
    shot: Shots, grid: Grid, st: Stations, at: F64, side: F64, slope: F64, pace: F64, R: int, projector: Projector
) -> _Profiles:
    """The profiles of lines in a picture, within R pixels of the stations."""
    stride = max(1, int(2 * R / 40)) | 1  # many pixels do not make it better; odd, to meet all kinds of them
    steps = np.arange(-stride * math.ceil(R / stride), R + 2, stride)
    dv, du = (a.ravel() for a in np.meshgrid(steps, steps, indexing="ij"))
    base = 2 * np.floor(0.5 * at + 0.25).astype(np.intp)  # even: the mosaic is the same around each
    H, W = shot.dark.shape[:2]
    c, r = base[:, :1] + du, base[:, 1:] + dv
    inside = (c >= 0) & (c < W) & (r >= 0) & (r < H)
    cc, rr = np.where(inside, c, 0), np.where(inside, r, 0)
    inside &= grid.reasons[rr, cc] == 0
    uv = np.full((*rr.shape, 2), np.nan)
    uv[inside] = geometry.project(projector, grid.xyz[rr[inside], cc[inside]].astype(np.float64))
    x, along = st.beside(uv)
    dark, white, lit = (_sampled(f, rr, cc) for f in (shot.dark, shot.white, shot.guided))
    top = float(shot.pixel_format.max_value)
    with np.errstate(invalid="ignore"):
        usable = inside & (x >= st.low[:, None]) & (x <= st.high[:, None]) & (np.abs(along) <= st.reach[:, None])
    usable &= (white < top) & (lit < top) & (white - dark > 4 * top / 255)
    full = np.where(usable, white - dark, 1.0)
    # a camera's blur draws the line's edge to where the tissue is brighter
    x = x + _gradient(shot, rr, cc, side) * (BLUR_PIXELS**2 / slope)[:, None]
    kinds = [np.arange(len(du))]
    if shot.pixel_format.is_bayer:
        kinds = [np.flatnonzero((dv % 2 == i) & (du % 2 == j)) for i in (0, 1) for j in (0, 1)]
    half = st.half / st.per_mm
    widths = np.stack([-st.low - half, 2 * half, st.high - half], 1)
    return _Profiles(
        np.where(usable, x, 0.0), np.where(usable, (lit - dark) / full, 0.0), full * usable, kinds, half,
        st.bend * st.pace**2 / st.per_mm, 2 * (st.reach * pace * np.abs(slope))[:, None] * widths / stride**2,
    )  # fmt: skip


def _gradient(shot: Shots, r: Any, c: Any, side: F64) -> F64:
    """By how much the logarithm of what all mirrors light grows for a pixel across the line (n, m)."""
    far = 2 if shot.pixel_format.is_bayer else 1
    H, W = shot.dark.shape[:2]
    floor = 4 * float(shot.pixel_format.max_value) / 255

    def log(dr: int, dc: int) -> F64:
        at = np.clip(r + dr, 0, H - 1), np.clip(c + dc, 0, W - 1)
        return np.asarray(np.log(np.maximum(_sampled(shot.white, *at) - _sampled(shot.dark, *at), floor)))

    across, down = (log(0, far) - log(0, -far)) / (2 * far), (log(far, 0) - log(-far, 0)) / (2 * far)
    return np.asarray(across * side[:, :1] + down * side[:, 1:])


def _sampled(frame: AnyArray, r: Any, c: Any) -> F32:
    f = frame[r, c]
    return np.asarray(f.mean(-1) if f.ndim == 3 else f, np.float32)


def _levels(profiles: Sequence[_Profiles]) -> list[float]:
    """How bright the middle of the line is to each kind of pixel, as a share of the light of all mirrors; 0 = dark."""
    out = []
    for k in range(max((len(p.kinds) for p in profiles), default=0)):
        core = []
        for p in profiles:
            c = p.kinds[k]
            core.append(p.y[:, c][(p.w[:, c] > 0) & (np.abs(p.x[:, c]) <= p.half[:, None])])
        every = np.concatenate(core)
        level = float(np.percentile(every, 80)) if len(every) >= 5 else 0.0
        out.append(level if level >= DARK else 0.0)
    return out


def _fit(
    p: _Profiles, levels: Sequence[float], search: F64, blur: F64, per_mm: F64, s: LoopSettings
) -> tuple[F64, F64]:
    """Centres of lines (n,), mm, and their errors: least squares over the place, and the height and ground that each
    kind of pixel sees.
    """
    from scipy.special import erf

    out, error = np.full(len(p.x), np.nan), np.full(len(p.x), np.nan)
    kinds = [(c, level) for c, level in zip(p.kinds, levels, strict=True) if level]
    if not kinds:
        return out, error
    every = np.concatenate([c for c, _ in kinds])
    cuts = np.concatenate([[0], np.cumsum([len(c) for c, _ in kinds])])
    level = np.array([level for _, level in kinds])
    x, y, w = p.x[:, every], p.y[:, every], p.w[:, every]
    half = p.half[:, None]
    sides = (x < -half, np.abs(x) <= half, x > half)
    if np.median((w > 0).sum(1)) < FEW * len(kinds):  # too few for each kind: all see the line as bright as they should
        scale = np.repeat(level, np.diff(cuts))
        y, w = y / scale, w * scale**2
        cuts, level = np.array([0, len(every)]), np.ones(1)
    else:  # a kind of pixel that sees the line from one side only, or in part, does not tell where it is
        counts = [np.add.reduceat((w > 0) & side, cuts[:-1], axis=1) for side in sides]
        w = w * np.repeat(np.all([n >= _enough(n) for n in counts], axis=0), np.diff(cuts), axis=1)
    counted = np.stack([((w > 0) & side).sum(1) for side in sides], 1)
    rows = np.flatnonzero((counted >= np.maximum(LEAST, SIDE_SHARE * p.room * len(kinds) / len(p.kinds))).all(1))
    if not rows.size:
        return out, error
    x, y, w, half, span, blur, per_mm, bow = (a[rows] for a in (x, y, w, half, search, blur, per_mm, p.bow))

    def sums(a: F64) -> F64:
        return np.asarray(np.add.reduceat(a, cuts[:-1], axis=1))

    wy = w * y
    s0, sy, syy = sums(w), sums(wy), sums(wy * y)
    expected = (s0 * level).sum(1)

    def cost(centre: F64, blur: F64) -> tuple[F64, F64, F64]:
        """What is left of the light's squares with lines at `centre`; their height, of what it should be, and power.

        A blurred line that bends is brighter on the inner side of its bend.
        """
        soft = math.sqrt(2) * blur[:, None]
        d = x - (centre + bow * blur**2)[:, None]
        t = 0.5 * (erf((d + half) / soft) - erf((d - half) / soft))
        wt = w * t
        st, stt, sty = sums(wt), sums(wt * t), sums(wt * y)
        det = s0 * stt - st * st
        with np.errstate(invalid="ignore", divide="ignore"):
            height = np.where(det > 1e-6 * s0 * s0, (s0 * sty - st * sy) / det, 0.0)
            ground = np.where(s0 > 0, (sy - st * height) / s0, 0.0)
        left = syy - height * sty - ground * sy
        return left.sum(1), (s0 * height).sum(1) / expected, (s0 * height**2).sum(1)

    def refined(centre: F64, step: F64, blur: F64) -> tuple[F64, F64]:
        for _ in range(3):  # a parabola through three costs, ever closer
            low, mid, high = (cost(centre + d, blur)[0] for d in (-step, 0.0, step))
            bend = low - 2 * mid + high
            with np.errstate(invalid="ignore", divide="ignore"):
                move = np.where(bend > 0, 0.5 * (low - high) / bend, 0.0) * step
            centre = centre + np.clip(np.nan_to_num(move), -step, step)
            step = 0.4 * step
        return centre, step

    tries = np.linspace(-1, 1, REACHES)
    table = np.stack([cost(c * span, blur)[0] for c in tries], 1)
    best = table.argmin(1)
    inner = (best > 0) & (best < REACHES - 1)
    first = (tries[1] - tries[0]) * span
    centre, _ = refined(tries[best] * span, first, blur)
    # how soft the lines are is told by all of them together
    softer = [float((left / np.maximum(power, 1e-9))[inner].sum()) for left, _, power in
              (cost(centre, f * blur) for f in SOFTER)]  # fmt: skip
    blur = SOFTER[int(np.argmin(softer))] * blur
    centre, step = refined(centre, 0.4 * first, blur)
    left, height, power = cost(centre, blur)
    bend = cost(centre + step, blur)[0] - 2 * left + cost(centre - step, blur)[0]
    with np.errstate(invalid="ignore", divide="ignore"):
        noise = left / np.maximum((w > 0).sum(1) - 3, 1)
        err = np.sqrt(2 * np.maximum(noise, 0) / (bend / step**2))
        good = inner & (height > s.min_height) & (left < s.max_misfit**2 * power)
        good &= np.isfinite(err) & (err * per_mm < 0.5)
    out[rows[good]] = centre[good]
    error[rows[good]] = np.maximum(err[good], 0.01 / per_mm[good])
    return out, error


def _enough(counts: AnyArray) -> AnyArray:
    """How many pixels of a kind, of `counts` (n, kinds), are enough (n, 1)."""
    return np.asarray(np.maximum(1, KIND_SHARE * counts.max(1, keepdims=True)))


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
