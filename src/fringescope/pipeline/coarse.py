"""Thinned frames and the rig that took them: what the first, coarse level of a scan is made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache

import numpy as np

from fringescope import phase
from fringescope.errors import CaptureError
from fringescope.settings import Settings
from fringescope.threads import WORKERS
from fringescope.types import AnyArray, Camera, FrameKey, Lens, PixelFormat, Rig, ViewInput


def thinned(views: Sequence[ViewInput], rig: Rig, pixels: int) -> tuple[tuple[ViewInput, ...], Rig, tuple[int, ...]]:
    """The views with every n-th row and column alone, the rig whose cameras all have such pixels, n of each view.

    n is odd, so that every colour of a mosaic comes in, and leaves about `pixels` of each view: from a third to three
    times as many, fewer only where a view has fewer. A view of another size than the rig's stays whole, for the stages
    to refuse. Frames are read one by one; rows that are left out are not touched. Raises CaptureError for a view
    without frames, RigError if the rig lacks a camera.
    """
    with ThreadPoolExecutor(WORKERS) as pool:
        made = list(pool.map(lambda view: _thinned(view, rig.camera(view.plan.camera).lens, pixels), views))
    strides = [stride_for(c.lens, pixels) for c in rig.cameras]
    for view, n in made:
        strides[rig.index(view.plan.camera)] = n
    return tuple(view for view, _ in made), thinned_rig(rig, tuple(strides)), tuple(n for _, n in made)


def settings_for(n: int, s: Settings) -> Settings:
    """Settings for every n-th pixel: the phase may step so much more between neighbours."""
    return replace(s, denoise=replace(s.denoise, jump_floor_rad=n * s.denoise.jump_floor_rad))


def _thinned(view: ViewInput, lens: Lens, pixels: int) -> tuple[ViewInput, int]:
    """One view with every n-th row and column, and n."""
    n = 0
    few: list[tuple[FrameKey, AnyArray]] = []
    for key, frame in view.frames:
        if n == 0:
            columns = frame.shape[1] * (2 if view.plan.pixel_format.packs(frame) else 1)
            n = stride_for(lens, pixels) if (frame.shape[0], columns) == (lens.height, lens.width) else 1
        few.append((key, _thin(frame, view.plan.pixel_format, n)))
    if not few:
        raise CaptureError(f"view '{view.plan.camera}': no frames came")
    color = None if view.color is None else _thin(view.color, view.plan.pixel_format, n)
    return replace(view, frames=few, color=color), n


def stride_for(lens: Lens, pixels: int) -> int:
    """The odd number n for which every n-th row and column of a picture leave nearest to `pixels`, as a ratio."""
    size = lens.width * lens.height
    n = max(1, 2 * int(math.sqrt(size / pixels) / 2) + 1)
    return min((m for m in (n - 2, n, n + 2) if m > 0), key=lambda m: abs(math.log(size / (m * m * pixels))))


def _thin(frame: AnyArray, pixel_format: PixelFormat, n: int) -> AnyArray:
    """Every n-th row and column, unpacked and contiguous; for n = 1 the frame as it is."""
    return frame if n == 1 else np.ascontiguousarray(phase.thinned(frame, pixel_format, n))


@lru_cache(maxsize=8)
def thinned_rig(rig: Rig, strides: tuple[int, ...]) -> Rig:
    """The rig with every n-th pixel of each of its cameras, in rows and columns; the same again for the same rig."""
    cameras = zip(rig.cameras, strides, strict=True)
    return replace(rig, cameras=tuple(Camera(c.name, thinned_lens(c.lens, n), c.pose) for c, n in cameras))


def thinned_lens(lens: Lens, n: int) -> Lens:
    """The lens before every n-th pixel, each way: pixel (i, j) is pixel (n i, n j) of the full picture."""
    K = lens.K / np.array([[n], [n], [1]])
    return Lens(-(-lens.width // n), -(-lens.height // n), K, lens.distortion)
