"""The three masks of section III-D and a fourth, as reason codes per pixel (Figs. 7, 10, 11).

1 background and modulation, 2 phase monotonicity, 3 phase jumps and contiguous domains; then 4: each phase within some
of its own sigmas of the local surface, and, where views overlap, their agreement. Masks take points away, they never
move one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from fringescope import calm, geometry, memory
from fringescope.kernels import regions as k
from fringescope.kernels import screens, statistics, views
from fringescope.settings import DenoiseSettings
from fringescope.types import (
    F32,
    F64,
    U16,
    Bool,
    Decoded,
    Direction,
    Grid,
    PixelFormat,
    Reason,
    Rig,
    ViewVerdict,
    WrappedSet,
)

NEAR, WIDE = 3.5, 4.6  #: sigmas; pixels that lie nearer to the local surface, and all around them, need no slower look
_PENDING = np.uint16(1 << 15)  #: no reason: a mark that a mask leaves and clears
TELLING = 0.5  #: least share of the best direction's sensitivity to depth that a direction needs to be judged by


class Tiles:
    """How much the phase of each direction of a view steps within each tile of pixels; measured when first asked."""

    def __init__(self, decoded: Decoded, steps: Sequence[F32] = ()) -> None:
        self._decoded = decoded
        self._steps = dict(enumerate(steps))

    def steps(self, d: Direction) -> F32:
        """See `calm.steps_of`; `d` must be one of the view's."""
        key = next(n for n, one in enumerate(self._decoded.directions) if one is d)
        if key not in self._steps:
            self._steps[key] = calm.steps_of(d.phase)
        return self._steps[key]


def exposed(decoded: Decoded, pixel_format: PixelFormat, s: DenoiseSettings) -> U16:
    """III-D 1: dark, saturated and low-modulation pixels, as reason codes (H, W).

    The modulation must exceed a floor in codes, a share of the background, a number of standard deviations of the
    sensor noise at that background (bright and dark regions get different thresholds, V-D), and leave a phase that is
    not much noisier than usual. Where the finest fringes have lost more contrast against the next coarser ones than is
    usual around, the light came by way of other places (from surface to surface, below the surface): low modulation
    too.
    """
    out = decoded.reasons.copy()
    A, B = decoded.background, decoded.modulation
    if not decoded.sets:  # Gray code alone: background and modulation are the contrast of the bits
        out[s.min_modulation * pixel_format.full_scale / 255.0 > B] |= np.uint16(Reason.LOW_MODULATION)
        return out
    dark, low = weak(decoded, pixel_format, s)
    out[dark] |= np.uint16(Reason.DARK)
    out[low] |= np.uint16(Reason.LOW_MODULATION)
    every = odd_stride(A.size)
    cut = (slice(None, None, every), slice(None, None, every))
    for d in decoded.directions:
        family = [w for w in decoded.sets if abs(d.g[0] * w.g[1] - d.g[1] * w.g[0]) < 1e-4 * _norm(d.g) * _norm(w.g)]
        family.sort(key=lambda w: _norm(w.g))
        if not family:
            continue
        fine = family[-1]
        clipped = (fine.saturated > 0) & ~np.isfinite(d.sigma)
        out[clipped] |= np.uint16(Reason.SATURATED)
        out[clipped] &= ~np.uint16(Reason.LOW_MODULATION | Reason.ORDER_UNCERTAIN)
        ok = (out | np.uint16(Reason.ORDER_UNCERTAIN)) == Reason.ORDER_UNCERTAIN
        limit, least, contrast = usual_exposure(family, ~(dark | low), s, cut)
        out[ok & (d.sigma > limit)] |= np.uint16(Reason.LOW_MODULATION)
        if len(family) > 1:
            coarse = family[-2]
            around = (_between(A.shape[0], 8) @ contrast @ _between(A.shape[1], 8).T).astype(np.float32)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = fine.modulation / coarse.modulation * (1 + 2.0 * fine.sigma)  # sigma of B / B is the phase's
            whole = ok & (coarse.saturated == 0) & (fine.saturated == 0)
            out[whole & (ratio < least * around)] |= np.uint16(Reason.LOW_MODULATION)
    out[dark] &= ~np.uint16(Reason.ORDER_UNCERTAIN | Reason.INCONSISTENT)
    out[(out & Reason.LOW_MODULATION) != 0] &= ~np.uint16(Reason.ORDER_UNCERTAIN)
    return out


def _norm(g: tuple[float, float]) -> float:
    return float(np.hypot(*g))


def weak(decoded: Decoded, pixel_format: PixelFormat, s: DenoiseSettings) -> tuple[Bool, Bool]:
    """Which pixels (H, W) are dark, and which are modulated too little by their brightness and noise."""
    scale = pixel_format.full_scale / 255.0
    A, B = decoded.background, decoded.modulation
    noise = np.sqrt(decoded.noise.variance(A))
    low = (s.min_modulation * scale > B) | (s.min_contrast * A > B) | (s.min_modulation_sigma * noise > B)
    return np.asarray(s.min_background * scale > A), np.asarray(low)


FEW = 10_000  #: pixels that are enough for a median


def odd_stride(pixels: int, enough: int = FEW) -> int:
    """Every how many-th row and column is enough for a median; see `statistics.odd_stride`."""
    return statistics.odd_stride(pixels, enough)


def usual_exposure(
    family: Sequence[WrappedSet], ok: Bool, s: DenoiseSettings, cut: tuple[slice, slice] = (slice(None), slice(None))
) -> tuple[float, float, F64]:
    """What is usual in a view, from its well exposed pixels `ok`: the largest sigma of a useful phase, radians; the
    least share of the usual modulation of the finest of the parallel sets `family` over that of the next coarser one;
    and this usual contrast.

    The latter as (8, 8) nodes that span the picture corner on corner: medians of tiles, smoothed. With three steps the
    share allows for how much the contrast scatters, since harmonics ripple there. `cut` thins.
    """
    fine = family[-1]
    ok = ok[cut] & (fine.saturated[cut] == 0)
    sigma = fine.sigma[cut][ok]
    limit = max(s.max_sigma_rad, s.max_sigma_factor * float(statistics.median(sigma))) if sigma.size else np.inf
    usual = np.ones((8, 8), np.float32)
    if len(family) == 1:
        return limit, 0.0, usual.astype(np.float64)
    coarse = family[-2]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(ok & (coarse.saturated[cut] == 0), fine.modulation[cut] / coarse.modulation[cut], np.nan)
    there = ratio[np.isfinite(ratio)]
    if not there.size:
        return limit, 0.0, usual.astype(np.float64)
    H, W = ratio.shape
    usual[:] = statistics.median(there)
    statistics.tile_medians(ratio, max(16, H * W // 640), usual)
    contrast = np.asarray(cv2.blur(usual, (3, 3)), np.float64)
    ripple = 0.0
    if min(fine.steps, coarse.steps) == 3:
        off = np.abs(ratio / (_between(H, 8) @ contrast @ _between(W, 8).T) - 1)
        ripple = 1.4826 * float(np.nanmedian(off))
    return limit, min(s.min_fine_modulation, 1 - 3 * ripple), contrast


def _between(length: int, nodes: int) -> F64:
    """Weights (length, nodes) of linear interpolation between nodes that span a side of `length` pixels end to end."""
    at = np.arange(length) * (nodes - 1) / max(length - 1, 1)
    return np.asarray(np.clip(1.0 - np.abs(at[:, None] - np.arange(nodes)), 0.0, None))


def monotonic(
    decoded: Decoded, reasons: U16, rig: Rig, s: DenoiseSettings, tiles: Tiles | None = None, *, in_place: bool = False
) -> U16:
    """III-D 2: fringes that run backwards come mirrored, from the substrate (equation 17).

    On every surface that faces camera and projector the phase grows along the image of the projector's rays in one
    sense, which the rig predicts at each pixel. Neighbours vote, so that noise on flat phase marks nothing.
    """
    out = reasons if in_place else calm.copy_of(reasons)
    H, W = decoded.shape
    reach = max(1, round(s.monotonic_reach * W / 684))
    radius = int(s.monotonic_window) // 2
    tiles = tiles or Tiles(decoded)
    for d in telling(decoded, rig):
        field = geometry.epipolar_field(rig, rig.camera(decoded.camera), d.g)
        cover = calm.cover_of(out)
        doubtful = ~calm.growing(tiles.steps(d), cover, field, (H, W), reach) & (cover != calm.VOID)
        if not doubtful.any():
            continue
        signs, backward = memory.empty((H, W), np.int8), np.empty(doubtful.shape, np.bool_)
        seen = calm.widened(doubtful, 2 * radius)
        k.gradient_signs(d.phase, d.sigma, out, seen, field, reach, s.monotonic_sigma, signs, backward)
        asked = calm.widened(backward, radius) & (cover != calm.VOID)
        if asked.any():
            bit = np.uint16(Reason.REVERSED)
            k.mark_backward(signs, asked, radius, s.monotonic_share, 4, bit, out)
    return out


def telling(decoded: Decoded, rig: Rig | None) -> tuple[Direction, ...]:
    """The directions whose phase tells of the surface: all, or those that tell at least half as much of depth as the
    best one. Along the others the phase hardly grows with depth; its sign and its jumps would be noise.
    """
    if rig is None or len(decoded.directions) == 1:
        return decoded.directions
    camera = rig.camera(decoded.camera)
    weight = []
    for d in decoded.directions:
        sigma = d.sigma[np.isfinite(d.sigma)]
        growth = float(np.median(geometry.epipolar_field(rig, camera, d.g)[..., 2]))
        weight.append(growth / max(float(np.median(sigma)), 1e-6) if sigma.size else 0.0)
    return tuple(d for d, w in zip(decoded.directions, weight, strict=True) if w >= TELLING * max(weight))


def connected(
    decoded: Decoded, reasons: U16, rig: Rig | None, s: DenoiseSettings, tiles: Tiles | None = None, *,
    in_place: bool = False,
) -> U16:  # fmt: skip
    """III-D 3: neighbours whose phases differ by less than T1 form domains; domains of fewer than T2 pixels go.

    Pixels that continue too few of their neighbours stand on a jump and go first.
    """
    out = reasons if in_place else calm.copy_of(reasons)
    tiles = tiles or Tiles(decoded)
    for d in telling(decoded, rig):
        field = _slopes(d, out, decoded, rig)
        cover = calm.cover_of(out)
        asked = ~calm.linked(tiles.steps(d), cover, _least_step(field, s), around=1) & (cover != calm.VOID)
        if asked.any():
            k.mark_loose(
                d.phase, d.sigma, out, asked, field, s.jump_factor, s.jump_floor_rad, s.jump_sigma, int(s.jump_links),
                _PENDING,
            )  # fmt: skip
            k.confirm(out, asked, _PENDING, np.uint16(Reason.JUMP))
        found = _domains(d, out, field, s, tiles)
        found.mark_small(s.island_share * decoded.background.size, np.uint16(Reason.ISLAND), out)
    return out


def local(
    decoded: Decoded, reasons: U16, rig: Rig | None, s: DenoiseSettings, tiles: Tiles | None = None, *,
    in_place: bool = False,
) -> U16:  # fmt: skip
    """The fourth test: a point's phase lies within some of its own sigmas of the surface of its neighbours."""
    out = reasons if in_place else calm.copy_of(reasons)
    tiles = tiles or Tiles(decoded)
    for d in telling(decoded, rig):
        for _ in range(int(s.local_rounds)):
            field = _slopes(d, out, decoded, rig)
            found = _domains(d, out, field, s, tiles)
            asked = _rough(d, out, field, s, tiles)
            k.mark_off_surface(
                d.phase, d.sigma, found.node, found.label, found.kind, asked, int(s.local_window) // 2,
                int(s.local_least), s.local_sigma, s.local_roughness, np.uint16(Reason.NOT_LOCAL), out,
                np.empty((2, 0, 0), np.float32),
            )  # fmt: skip
    return out


def _domains(d: Direction, reasons: U16, field: F64, s: DenoiseSettings, tiles: Tiles) -> calm.Domains:
    return calm.domains(
        d.phase, d.sigma, reasons, field, (s.jump_factor, s.jump_floor_rad, s.jump_sigma), tiles.steps(d),
        _least_step(field, s),
    )  # fmt: skip


def _least_step(field: F64, s: DenoiseSettings) -> float:
    """The least T1 anywhere in a view, radians, without what noise adds."""
    return max(s.jump_factor * float(field[..., 2].min()), s.jump_floor_rad)


def _rough(d: Direction, reasons: U16, field: F64, s: DenoiseSettings, tiles: Tiles) -> Bool:
    """The pixels that have to be judged: those that a quick look does not find calm, if the window is the usual one."""
    asked = memory.empty(reasons.shape, np.bool_)
    if int(s.local_window) == 5:
        limits = min(NEAR, 0.75 * s.local_sigma), min(WIDE, s.local_sigma, 1.8 * s.local_roughness)
        step = _least_step(field, s)
        kind = calm.kinds(tiles.steps(d), calm.cover_of(reasons), step)
        screens.rough_pixels(d.phase, d.sigma, reasons, kind, step, *limits, asked)
    else:
        asked[:] = True
    return asked


def _slopes(d: Direction, reasons: U16, decoded: Decoded, rig: Rig | None) -> F64:
    """Expected phase growth per pixel, as channel 2 of a coarse field: from the rig, or the usual one of the image."""
    if rig is not None:
        return geometry.epipolar_field(rig, rig.camera(decoded.camera), d.g)
    ok = reasons == 0
    usual = 0.0
    for axis in (0, 1):
        a = np.diff(np.where(ok, d.phase, np.nan), axis=axis)
        a = a[np.isfinite(a)]
        usual = max(usual, float(np.median(np.abs(a)))) if a.size else usual
    return np.full((2, 2, 3), usual or 1.0)


MOST = 7  #: other views; with more of them a kernel of its own is compiled


def agree(grids: Sequence[Grid], rig: Rig, s: DenoiseSettings, *, in_place: bool = False) -> tuple[Grid, ...]:
    """Where views overlap: a point in front of what another view sees through it, and that no view confirms, goes.

    A point confirmed by any other view stays; one that lies behind another view's surface is hidden there and stays.
    A grid that loses nothing comes back as it is; one that loses points is copied, or with `in_place` written to.
    """
    sights = [_sight(g, rig) for g in grids]
    planes = [_planes(v, g, rig) for v, g in zip(sights, grids, strict=True)]
    limits = float(s.agree_sigma), float(s.agree_slack)
    found = []
    for i, g in enumerate(grids):
        others = [n for n, o in enumerate(grids) if o.view != g.view]
        bad, lost = np.zeros(g.reasons.shape, np.uint8), np.zeros(len(g.reasons), np.int64)
        if others:
            asked = np.empty((len(others), *planes[i].shape[:2]), np.bool_)
            for n, some in zip(others, asked, strict=True):
                views.doubtful(sights[i], planes[i], sights[n], planes[n], *limits, some)
            n = len(others)
            filled = tuple(sights[others[min(k, n - 1)]] for k in range(max(MOST, n)))  # one kernel for any number
            views.contradicted(sights[i], filled, n, *limits, asked, bad, lost)
        found.append((bad, lost))
    out = []
    for g, (bad, lost) in zip(grids, found, strict=True):  # all are judged before any loses a point
        kept = g
        if lost.any():
            if not in_place:
                kept = replace(g, xyz=g.xyz.copy(), sigma=g.sigma.copy(), reasons=g.reasons.copy())
            views.blank(bad, lost, np.uint16(Reason.VIEWS_DISAGREE), kept.xyz, kept.sigma, kept.reasons)
        out.append(kept)
    return tuple(out)


def _sight(grid: Grid, rig: Rig) -> views.View:
    """A grid as the kernels look at it."""
    H, W = grid.reasons.shape
    camera = rig.cameras[grid.view]
    xyz, sigma = views.constant(grid.xyz), views.constant(grid.sigma)
    return views.View(xyz.reshape(-1), sigma.reshape(-1), H, W, geometry.pose_vector(camera.pose),
                      geometry.lens_vector(camera.lens))


def _planes(sight: views.View, grid: Grid, rig: Rig) -> F32:
    out: F32 = memory.empty((*calm.shape_of(grid.reasons.shape), 16), np.float32)
    views.planes(sight, geometry.centre(rig.cameras[grid.view].pose), out)
    return out


def interpolated(decoded: Decoded, pixel_format: PixelFormat) -> bool:
    """Whether an RGB view's pixels were interpolated from their neighbours (demosaiced, scaled, JPEG).

    Tells by the misfits of the coarsest N-step set (N > 3), which are noise: from interpolated pixels they vary less
    between neighbours than farther apart, or differ between the two colours of a chessboard. Judged as
    V(1) / V(3) of their second differences, and as the ratio of their mean squares.
    """
    if pixel_format is not PixelFormat.RGB8:
        return False
    for w in sorted((w for w in decoded.sets if w.steps > 3), key=lambda w: _norm(w.g)):
        bright = np.isfinite(w.misfit) & (w.saturated == 0) & (w.modulation > 0.1 * w.background)
        m = np.where(bright, np.minimum(w.misfit, 3.0), np.nan)
        near, far = (_second_difference(m, k) for k in (1, 3))
        even, odd = (np.concatenate([m[0::2, a::2].ravel(), m[1::2, 1 - a :: 2].ravel()]) for a in (0, 1))
        squares = [float(np.sum(x[np.isfinite(x)] ** 2)) / max(np.isfinite(x).sum(), 1) for x in (even, odd)]
        if np.isfinite(m).sum() < 1000 or not (far > 0 and min(squares) > 0):
            continue
        return near < 0.9 * far or abs(np.log(squares[0] / squares[1])) > 0.15
    return False


def _second_difference(m: F32, k: int) -> float:
    """Mean square of m(i - k) - 2 m(i) + m(i + k) along rows and columns."""
    along, down = m[:, 2 * k :] - 2 * m[:, k:-k] + m[:, : -2 * k], m[2 * k :] - 2 * m[k:-k] + m[: -2 * k]
    d = np.concatenate([along.ravel(), down.ravel()])
    d = d[np.isfinite(d)]
    return float(np.mean(d * d)) if d.size else 0.0


def verdict(grid: Grid, alike: bool = False) -> ViewVerdict:
    """What a view lost and why, in figures and in words that a person can act on; `alike` is that of `interpolated`."""
    n = int(grid.reasons.size)
    count = calm.tally(grid.reasons)
    codes = np.flatnonzero(count)
    count = count[codes]

    def of(bits: int, without: int = 0) -> int:
        return int(count[((codes & bits) != 0) & ((codes & without) == 0)].sum())

    lost = {r.name.lower(): of(r) for r in Reason if r.name}
    points = int(count[codes == 0].sum())
    unlit = int(Reason.DARK | Reason.LOW_MODULATION)
    lit = n - of(unlit)
    words = [f"{grid.camera}: {points} points on {lit} pixels with fringes of {n}"]
    if not points:
        words.append(f"{grid.camera}: no point was left")
    for reason, share, advice in _ADVICE:
        weak = reason in (Reason.DARK, Reason.LOW_MODULATION)
        part = of(reason) / n if weak else of(reason, unlit) / max(lit, 1)
        if part > share:
            base = "all pixels" if weak else "the pixels with fringes"
            words.append(f"{grid.camera}: {100 * part:.1f} % of {base}: {reason.label}; {advice}")
    if alike:
        words.append(
            f"{grid.camera}: its pixels were interpolated from their neighbours, whose errors are thus alike: sigma is "
            "too small for whatever averages them; record raw Bayer frames"
        )
    return ViewVerdict(grid.camera, n, points, lost, tuple(words))


#: reason, share of the pixels with fringes (DARK, LOW_MODULATION: of all) above which it is worth a word, what to do
_ADVICE = (
    (Reason.DARK, 0.97, "no fringes reached this view: check lens cap, trigger and projector"),
    (Reason.SATURATED, 0.01, "halve the exposure, or add a shorter bracket"),
    (Reason.LOW_MODULATION, 0.8, "hardly any fringes: expose longer, refocus, or bring the specimen into the light"),
    (
        Reason.ORDER_UNCERTAIN,
        0.02,
        "orders left open: add a coarser or intermediate set, or light; pure fringes may lower phase.systematic_rad",
    ),
    (Reason.REVERSED, 0.005, "mirrored fringes: dry the surface or put something dark below it"),
    (Reason.JUMP, 0.05, "edges and steep walls: turn the specimen"),
    (Reason.ISLAND, 0.02, "crumbs without neighbours: raise the exposure, or lower denoise.island_share"),
    (Reason.OUT_OF_VOLUME, 0.05, "points outside the measuring volume: move the specimen into it, or check the rig"),
    (Reason.INCONSISTENT, 0.01, "frames do not fit one sinusoid: something moved, or a frame is out of order"),
    (Reason.VIEWS_DISAGREE, 0.02, "the views contradict each other: the rig has drifted, calibrate anew"),
    (Reason.NOT_LOCAL, 0.05, "rough phase: light from surface to surface, or vibration"),
)
