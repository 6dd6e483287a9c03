"""Thinned frames and the rig that took them: what the first, coarse level of a scan is made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache

import numpy as np

from fringescope.errors import CaptureError
from fringescope.threads import WORKERS
from fringescope.types import AnyArray, Camera, Lens, Rig, ViewInput

PIXELS = 200_000  #: of a view that are about left
BAND = 64  #: thinned rows that are copied at a time


def thinned(views: Sequence[ViewInput], rig: Rig, pixels: int = PIXELS) -> tuple[tuple[ViewInput, ...], Rig]:
    """The views with every n-th row and column alone, and the rig whose cameras have such pixels.

    n is odd, so that every colour of a mosaic comes in, and leaves about `pixels` of each view (from a third to three
    times as many; a picture of fewer stays whole). Frames must be sequences; they are copied, the rows that are left
    out are not read. Raises CaptureError for a view without frames, RigError if the rig lacks a camera.
    """
    strides, made = [1] * len(rig.cameras), []
    with ThreadPoolExecutor(WORKERS) as pool:
        for view in views:
            n, n_frames = 1, list(view.frames)
            if not n_frames:
                raise CaptureError(f"view '{view.plan.camera}': no frames came")
            n = stride_for(n_frames[0][1].shape[0] * n_frames[0][1].shape[1], pixels)
            strides[rig.index(view.plan.camera)] = n
            if n == 1:
                made.append(replace(view, frames=n_frames))
                continue
            few = list(pool.map(lambda f, n=n: _thin(f, n), [f for _, f in n_frames]))  # type: ignore[misc]
            color = None if view.color is None else _thin(view.color, n)
            keys = [key for key, _ in n_frames]
            made.append(replace(view, frames=list(zip(keys, few, strict=True)), color=color))
    return tuple(made), thinned_rig(rig, tuple(strides))


def stride_for(size: int, pixels: int = PIXELS) -> int:
    """The odd number n for which `size` / n^2 comes nearest to `pixels`, as a ratio."""
    n = max(1, 2 * int(math.sqrt(size / pixels) / 2) + 1)
    return min((m for m in (n - 2, n, n + 2) if m > 0), key=lambda m: abs(math.log(size / (m * m * pixels))))


def _thin(frame: AnyArray, n: int) -> AnyArray:
    """Every n-th row and column, contiguous."""
    return np.ascontiguousarray(frame[::n, ::n])


@lru_cache(maxsize=8)
def thinned_rig(rig: Rig, strides: tuple[int, ...]) -> Rig:
    """The rig with every n-th pixel of each of its cameras, in rows and columns; the same again for the same rig."""
    cameras = zip(rig.cameras, strides, strict=True)
    return replace(rig, cameras=tuple(Camera(c.name, thinned_lens(c.lens, n), c.pose) for c, n in cameras))


def thinned_lens(lens: Lens, n: int) -> Lens:
    """The lens before every n-th pixel, each way: pixel (i, j) is pixel (n i, n j) of the full picture."""
    K = lens.K / np.array([[n], [n], [1]])
    return Lens(-(-lens.width // n), -(-lens.height // n), K, lens.distortion)
