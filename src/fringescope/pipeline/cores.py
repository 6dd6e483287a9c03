"""The fused kernels on all cores: over the frames of a view, over some rows of them, and frame by frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fringescope import geometry, memory
from fringescope.kernels import fused as k
from fringescope.kernels import running
from fringescope.kernels.depths import Depths
from fringescope.pipeline.tiling import ByRows
from fringescope.types import F64, AnyArray, FrameKey, NoiseModel


@dataclass(frozen=True, eq=False)
class Way:
    """What the kernel needs to know of a view: its frames in the order of its sets, coarse to fine, and the tables."""

    frames: tuple[AnyArray, ...]
    g: tuple[float, float]
    noise: NoiseModel
    notes: tuple[str, ...]
    table: geometry.DepthTable
    sets: k.Sets
    limits: k.Limits
    depths: Depths
    bounds: F64  #: (4, h, w) turns
    usual: F64  #: (8, 8)


@dataclass(eq=False)
class Summed:
    """Frames of the finest set that lie in sums already: the first ones of it, never all."""

    pivot: float  #: taken off every sample
    kind: int  #: see `kernels.running`
    rest: AnyArray  #: (H, bytes) of the sums that do not fit into the points
    frames: int = 0


def size_of(frame: AnyArray) -> tuple[int, int]:
    """Rows and columns of pixels of a frame, which may be packed."""
    return frame.shape[0], frame.shape[1] if frame.ndim == 2 else 2 * frame.shape[1]


def room(H: int, W: int) -> tuple[AnyArray, ...]:
    """The outputs of the kernel: phase, sigma, A, B, reasons, points, their sigma."""
    absolute, sigma, A, B, sigma_mm = (memory.empty((H, W), np.float32) for _ in range(5))
    return absolute, sigma, A, B, memory.empty((H, W), np.uint16), memory.empty((H, W, 3), np.float32), sigma_mm


NO_REST = np.zeros((0, 0), np.uint8)


def on_cpu(
    way: Way, out: tuple[AnyArray, ...], begin: int = 0, end: int | None = None, summed: Summed | None = None
) -> None:
    """Runs the kernel over rows on all cores, on sets `begin` .. `end` - 1; it reads the frames where they lie, packed
    ones too. Frames of later sets may be missing. `summed`: what was begun of the last set, if all others are done.
    """
    held, addresses, row_bytes = _places(way.frames, int(way.sets.start[-1]))
    last = len(way.sets.frequency) if end is None else end
    count, kind, rest = 0, running.FLOATS, NO_REST
    if summed is not None and begin == last - 1 > 0 and summed.pivot == way.sets.pivot:
        count, kind, rest = summed.frames, summed.kind, summed.rest
    k.decode(begin, last, addresses, row_bytes, *_type(held[0]), way.sets, way.limits, way.bounds, way.usual,
             way.depths, count, kind, rest, *out)  # fmt: skip


def add(way: Way, out: tuple[AnyArray, ...], frames: Sequence[AnyArray], summed: Summed | None) -> Summed:
    """Add the next frames of the finest set, in their order, to its sums, whose first ones lie in `out`."""
    if summed is None:
        steps = int(way.sets.start[-1] - way.sets.start[-2])
        kind, size = running.kind_of(steps, bool(way.sets.plain[-1]), way.sets.top)
        H, W = out[0].shape
        rest = memory.empty((H, W * max(0, size - running.POINT_BYTES)), np.uint8)
        summed = Summed(float(way.sets.pivot), kind, rest)
    begin = int(way.sets.start[-2]) + summed.frames
    held, addresses, row_bytes = _places(frames, int(way.sets.start[-1]), begin)
    running.add(begin, begin + len(frames), summed.frames == 0, addresses, row_bytes, *_type(held[0]), way.sets,
                summed.kind, out[5], summed.rest, out[4])  # fmt: skip
    summed.frames += len(frames)
    return summed


def by_rows(tiled: ByRows, way: Way, keys: Sequence[FrameKey], out: tuple[AnyArray, ...]) -> None:
    """As `on_cpu`, of some rows at a time: the same, since the kernel knows no neighbours."""

    def work(first: int, last: int, rows: list[AnyArray]) -> None:
        _, addresses, row_bytes = _places(rows, len(rows))
        k.decode.among(first, last, 0, len(way.sets.frequency), addresses - first * row_bytes, row_bytes,
                       *_type(rows[0]), way.sets, way.limits, way.bounds, way.usual, way.depths, 0, running.FLOATS,
                       NO_REST, *out)  # fmt: skip

    tiled.in_bands(keys, way.frames[0], work)


def _places(
    frames: Sequence[AnyArray], count: int, begin: int = 0
) -> tuple[list[AnyArray], NDArray[np.int64], NDArray[np.int64]]:
    """Frames whose samples follow each other within a row; of `count` frames, whose first `begin` ones and last ones
    may be missing, where they lie and how far apart their rows are. Who uses the addresses holds the frames.
    """
    held = [f if f[0].flags.c_contiguous else np.ascontiguousarray(f) for f in frames]
    addresses, row_bytes = np.zeros(count, np.int64), np.zeros(count, np.int64)
    there = slice(begin, begin + len(held))
    addresses[there] = [f.ctypes.data for f in held]
    row_bytes[there] = [f.strides[0] for f in held]
    return held, addresses, row_bytes


def _type(frame: AnyArray) -> tuple[AnyArray, bool]:
    """An array of the samples' type, and whether they are packed."""
    packed = frame.ndim == 3
    return np.empty(0, np.uint16 if packed else frame.dtype), packed
