"""Then and now, by one picture of each camera under the same light (paper, IV-D: the line must lie where it was drawn).

A tile's shift counts where noise does not explain it, at a probability of `false_alarm` over all tiles of all cameras
together, and where it is larger than the limits in mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np

from fringescope import geometry
from fringescope.errors import CaptureError
from fringescope.settings import WatchSettings
from fringescope.types import (
    F64,
    AnyArray,
    Bool,
    Camera,
    Grid,
    NoiseModel,
    Picture,
    PixelFormat,
    Rig,
    Watched,
)
from fringescope.watch import judging, preparing, tracking


@dataclass(frozen=True, eq=False)
class View:
    """One camera's part of a look: its grid and picture of the scan, the picture now, and what must not vote.

    `now` None: the camera gave none. `mask` (H, W): true where guidance is projected. `noise`: of one raw sample, in
    codes of `then`; None: from the two pictures themselves.
    """

    grid: Grid
    then: Picture
    now: Picture | None
    mask: Bool | None = None
    noise: NoiseModel | None = None


def compare(views: Sequence[View], rig: Rig, settings: WatchSettings | None = None) -> Watched:
    """Whether the specimen is still where it was scanned, by a picture of each camera.

    Raises CaptureError for no views, a picture of another size or kind of format than the scan's, or a mask of another
    size. A missing, dark, saturated or covered picture is no error: it makes the verdict SUSPECT.
    """
    s = settings or WatchSettings()
    if not views:
        raise CaptureError("no view to watch; needed the grid and the pictures of one camera at least")
    for v in views:
        _check(v)
    with ThreadPoolExecutor(len(views)) as pool:
        tested = list(pool.map(lambda v: _track(v, rig.camera(v.grid.camera), s), views))
    return judging.verdict(tested, s)


def _check(v: View) -> None:
    H, W = v.grid.reasons.shape
    camera = v.grid.camera
    for what, p in (("the scan's picture", v.then), ("the picture now", v.now)):
        if p is not None and p.frame.shape[:2] != (H, W):
            came = f"{p.frame.shape[1]} x {p.frame.shape[0]}"
            raise CaptureError(f"{camera}: {what} has {came} pixels, the scan's grid {W} x {H}; take it with the whole "
                               "sensor, or reconstruct again")  # fmt: skip
    if v.now is not None and v.now.pixel_format is not v.then.pixel_format:
        a, b = v.then.pixel_format, v.now.pixel_format
        if _kind(a) != _kind(b):
            raise CaptureError(f"{camera}: a picture in {b.value}, the scan's is in {a.value}; needed the same: set "
                               "the camera as for the scan")  # fmt: skip
    if v.mask is not None and (v.mask.shape != (H, W) or v.mask.dtype != np.bool_):
        raise CaptureError(f"{camera}: a mask of {v.mask.shape} {v.mask.dtype}; needed ({H}, {W}) bool")


def _kind(f: PixelFormat) -> str:
    return f.value.rstrip("0123456789")


def _track(v: View, camera: Camera, s: WatchSettings) -> judging.Tested:
    """The tiles of one camera, in mm."""
    xyz = np.asarray(v.grid.xyz)
    valid = v.grid.valid & np.isfinite(xyz).all(-1)
    name = v.grid.camera
    if not valid.any():
        return judging.blind(name, "the scan has no point in this view")
    depth = float(np.median(geometry.transform(camera.pose, xyz[valid][:: max(1, int(valid.sum()) // 5000)])[:, 2]))
    mm = depth / float(camera.lens.K[0, 0])
    fmt = v.then.pixel_format
    n = preparing.factor(mm, fmt, s)
    then = v.then.frame
    if v.now is None:
        return judging.blind(name, "no picture came")
    now = _codes(v.now, fmt)
    noise = v.noise or preparing.noise_of(then, now, fmt)
    p = preparing.pair(then, now, fmt, v.mask, noise, n, s)
    if p is None:
        return judging.blind(name, _why_not(now, fmt))
    off = max(max(g, 1 / max(g, 1e-6)) for g in p.gain)
    if off > s.max_gain:
        if min(p.gain) < 0.05:
            return judging.blind(name, "the picture is dark", p.gain)
        return judging.blind(name, f"the picture is {np.median(p.gain):.2f} times as bright as the scan's", p.gain)
    surface = preparing.binned(valid.astype(np.float32), n)
    levels = tracking.track(p, surface, s)
    points = _points(levels, xyz, valid, n)
    return judging.Tested(name, camera, levels, points, n, p.gain)


def _codes(p: Picture, fmt: PixelFormat) -> AnyArray:
    """A frame in the codes of a format of the same kind."""
    if p.pixel_format is fmt:
        return p.frame
    return np.asarray(p.frame.astype(np.float32) * (fmt.max_value / p.pixel_format.max_value))


def _why_not(now: AnyArray, fmt: PixelFormat) -> str:
    full = float((now >= preparing.NEAR_FULL * fmt.max_value).mean())
    if full > 0.5:
        return f"{100 * full:.0f} % of the picture is saturated"
    if float(np.median(now)) < 0.02 * fmt.max_value:
        return "the picture is dark"
    return "too little of the picture is left beside what is masked and saturated"


def _points(levels: Sequence[tracking.Tracked], xyz: AnyArray, valid: Bool, n: int) -> list[F64]:
    """Per level the world points (k, 3) in the middle of each tile: means over its middle, NaN where none is."""
    part = preparing.binned(valid.astype(np.float32), n)
    where = np.where(valid[..., None], xyz, 0.0)
    sums = [preparing.binned(where[..., i], n) for i in range(3)]
    out = []
    for t in levels:
        side = max(3, int(t.side / 2) // 2 * 2 + 1)
        u, v = np.rint(t.centre).astype(int).T
        here = [cv2.boxFilter(a, -1, (side, side), borderType=cv2.BORDER_CONSTANT)[v, u] for a in (*sums, part)]
        with np.errstate(invalid="ignore", divide="ignore"):
            out.append(np.stack(here[:3], 1).astype(np.float64) / np.where(here[3] > 1e-6, here[3], np.nan)[:, None])
    return out
