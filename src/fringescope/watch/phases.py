"""The surface measured again with one set of fringes: by how much has each place come nearer or gone farther?

The phase that a pixel sees is compared with the phase that its point of the scan would show (equations 8 to 15 read
backwards); the difference over the phase's slope along the ray is a change of depth. A shift by a whole fringe cannot
be told from none, so this goes with the pictures, not in their place.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fringescope import geometry
from fringescope.errors import CaptureError
from fringescope.settings import WatchSettings
from fringescope.types import (
    F64,
    AnyArray,
    CameraWatch,
    Grid,
    Rig,
    Standing,
    TileState,
    Watched,
    WatchTiles,
    WrappedSet,
)
from fringescope.watch import judging

MOST_SIGMA = 0.5  #: radians; a phase noisier than this was not seen
COHERENT = 0.7  #: length of the mean phasor of a tile below which its pixels disagree: it is no longer one surface
STEP_MM = 0.05  #: along the ray, for the slope of the phase


@dataclass(frozen=True, eq=False)
class Remeasured:
    """One camera's part: its grid of the scan and the set that was measured now, None where no frames came.

    `dark`: modulation, in codes, below which a pixel was not seen.
    """

    grid: Grid
    now: WrappedSet | None
    dark: float


def compare_fringes(views: Sequence[Remeasured], rig: Rig, settings: WatchSettings | None = None) -> Watched:
    """Whether the surface is still where the scan says, by its depth along each camera's rays.

    `WatchTiles.shift_mm` holds the change of depth, positive away from the camera, and 0. Raises CaptureError for no
    views, or a set of another size than the grid.
    """
    from scipy.stats import norm

    s = settings or WatchSettings()
    if not views:
        raise CaptureError("no view to watch; needed the grid and the fringes of one camera at least")
    found = [_depths(v, rig, s) for v in views]
    number = max(sum(int(f.votes.sum()) for f in found), 1)
    limit = float(norm.isf(s.false_alarm / number / 2)) ** 2
    cameras = tuple(_camera(v.grid.camera, f, limit, s) for v, f in zip(views, found, strict=True))
    least = max((float(f.chi2[f.votes].max(initial=0.0)) for f in found), default=0.0)
    p = min(1.0, 2 * float(norm.sf(np.sqrt(least))) * number)
    standing, why = _judge(cameras, s)
    return Watched(standing, why, cameras, None, p, float(np.mean([c.judged for c in cameras])), "fringes")


@dataclass(frozen=True, eq=False)
class _Depths:
    """Tiles of one camera, arrays (n,): change of depth mm, its sigma, and what they are worth."""

    centre: F64
    side: float
    change: F64
    sigma: F64
    chi2: F64
    could: AnyArray
    votes: AnyArray
    odd: AnyArray
    mm: float = 1.0  #: width of a camera pixel across the line of sight


def _depths(v: Remeasured, rig: Rig, s: WatchSettings) -> _Depths:
    camera = rig.camera(v.grid.camera)
    H, W = v.grid.reasons.shape
    if v.now is not None and v.now.phase.shape != (H, W):
        came = f"{v.now.phase.shape[1]} x {v.now.phase.shape[0]}"
        raise CaptureError(f"{v.grid.camera}: fringes of {came} pixels, the scan's grid has {W} x {H}; measure with "
                           "the whole sensor")  # fmt: skip
    valid = v.grid.valid
    if v.now is None or not valid.any():
        none = np.zeros(0)
        return _Depths(np.zeros((0, 2)), 1.0, none, none, none, none > 0, none > 0, none > 0)
    depth = geometry.transform(camera.pose, v.grid.xyz[valid][:: max(1, int(valid.sum()) // 5000)])[:, 2]
    mm = float(np.median(depth)) / float(camera.lens.K[0, 0])
    tile = s.tile * s.pitch_mm / mm  # camera pixels
    step = max(1, int(tile / s.tile / 2))
    half = max(2, round(tile / 2 / step))
    seen, off, rate, sigma = _pixels(v, v.now, rig, step)
    weight = np.where(seen, 1.0 / np.maximum(sigma, 1e-6) ** 2, 0.0)
    area, part, total, c, d, slope = (
        _tiles(a, half)
        for a in (
            valid[step // 2 :: step, step // 2 :: step], seen, weight, weight * np.cos(off), weight * np.sin(off),
            weight * rate,
        )
    )  # fmt: skip
    with np.errstate(divide="ignore", invalid="ignore"):
        change = np.nan_to_num(np.arctan2(d, c) * total / slope)
        together = np.nan_to_num(np.hypot(c, d) / total)
        spread = np.nan_to_num(np.sqrt(1.0 / total + s.floor_depth_mm**2), posinf=0.0)
    could = area > s.min_surface * (2 * half) ** 2
    votes = could & (part > 0.5 * area)
    odd = votes & (together < COHERENT)
    chi2 = np.where(votes & ~odd, (change / np.maximum(spread, 1e-9)) ** 2, 0.0)
    rows, columns = np.meshgrid(*(half * (np.arange(k) + 1.0) - 0.5 for k in area.shape), indexing="ij")
    centre = np.stack([columns.ravel(), rows.ravel()], 1) * step + step // 2
    return _Depths(
        centre, 2.0 * half * step, change.ravel(), spread.ravel(), chi2.ravel(), could.ravel(), votes.ravel(),
        odd.ravel(), mm,
    )  # fmt: skip


def _pixels(v: Remeasured, now: WrappedSet, rig: Rig, step: int) -> tuple[AnyArray, F64, F64, F64]:
    """At every so many-th pixel (h, w): whether it was seen, the phase that it is off in (-pi, pi], growing with the
    distance, the phase's growth in radians per mm along the ray, and the sigma of the depth in mm.
    """
    cut = (slice(step // 2, None, step), slice(step // 2, None, step))
    p = np.where(v.grid.valid[cut][..., None], v.grid.xyz[cut], np.nan).astype(np.float64)
    ray = p - geometry.centre(rig.camera(v.grid.camera).pose)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    near, here, far = (geometry.phase_at(rig.projector, now.g, p + k * STEP_MM * ray) for k in (-1, 0, 1))
    rate = (far - near) / (2 * STEP_MM)
    with np.errstate(invalid="ignore", divide="ignore"):
        off = np.sign(rate) * np.angle(np.exp(1j * (now.phase[cut] - here)))
        sigma = np.hypot(now.sigma[cut] / np.abs(rate), v.grid.sigma[cut])
        seen = np.isfinite(off) & np.isfinite(sigma) & (now.sigma[cut] < MOST_SIGMA) & (now.modulation[cut] > v.dark)
    seen &= (now.saturated[cut] == 0) & (np.abs(rate) > 0)
    return seen, np.where(seen, off, 0.0), np.where(seen, np.abs(rate), 0.0), np.where(seen, sigma, 1.0)


def _tiles(a: AnyArray, half: int) -> F64:
    """Sums over tiles of twice `half` pixels a side, one every `half` pixels."""
    h, w = a.shape[0] // half, a.shape[1] // half
    cells = a[: h * half, : w * half].reshape(h, half, w, half).sum((1, 3), dtype=np.float64)
    return np.asarray(cells[:-1, :-1] + cells[1:, :-1] + cells[:-1, 1:] + cells[1:, 1:])


def _camera(name: str, f: _Depths, limit: float, s: WatchSettings) -> CameraWatch:
    size = np.abs(f.change)
    real = f.votes & ~f.odd & (f.chi2 > limit) & (size > s.suspect_depth_mm)
    real &= judging.touching(f.centre, f.side, real, np.stack([np.sign(f.change), 0 * size], 1)) >= judging.TOGETHER
    odd = f.odd & (judging.touching(f.centre, f.side, f.odd, None) >= judging.TOGETHER)
    state = np.where(f.votes, int(TileState.STILL), int(TileState.NO_VOTE)).astype(np.int8)
    state[real] = TileState.SHIFTED
    state[real & (size > s.stale_depth_mm)] = TileState.MOVED
    state[odd] = TileState.CHANGED
    n = len(size)
    shift = np.where(f.votes[:, None], np.stack([f.change, np.zeros(n)], 1), np.nan)
    size_px, width = np.full(n, f.side), np.full(n, f.side * f.mm)
    tiles = WatchTiles(f.centre, size_px, width, shift, f.sigma, np.exp(-f.chi2 / 2), state)
    worst = int(np.argmax(np.where(real, size, -1.0))) if n else 0
    at = (float(f.centre[worst, 0]), float(f.centre[worst, 1])) if real.any() else None
    votes, could = int(f.votes.sum()), int(f.could.sum())
    note = "" if could else "no fringes came, or the scan has no point there"
    return CameraWatch(
        name, float(size[worst]) if at else 0.0, at, votes / max(could, 1), float(odd.sum()) / max(votes, 1), (), tiles,
        note,
    )  # fmt: skip


def _judge(cameras: Sequence[CameraWatch], s: WatchSettings) -> tuple[Standing, str]:
    worst, gone = max(cameras, key=lambda c: c.shift_mm), max(cameras, key=lambda c: c.changed)
    u, v = worst.at or (0.0, 0.0)
    told = f"{worst.camera}: the depth changed by {worst.shift_mm:.3f} mm at pixel ({u:.0f}, {v:.0f})"
    if int((worst.tiles.state == TileState.MOVED).sum()) >= judging.TOGETHER:
        return Standing.STALE, told
    if gone.changed > 0.5:
        return Standing.STALE, f"{gone.camera}: {100 * gone.changed:.0f} % of the surface is no longer what was scanned"
    if worst.at is not None:
        return Standing.SUSPECT, told
    if gone.changed > 0:
        return Standing.SUSPECT, f"{gone.camera}: {100 * gone.changed:.1f} % of the surface is covered or changed"
    for c in cameras:
        if c.note:
            return Standing.SUSPECT, f"{c.camera}: {c.note}"
    least = min(cameras, key=lambda c: c.judged)
    if least.judged < s.min_judged:
        return Standing.SUSPECT, f"{least.camera}: only {100 * least.judged:.0f} % of its points can be measured again"
    return Standing.VALID, f"no depth changed by more than {s.suspect_depth_mm:g} mm"
