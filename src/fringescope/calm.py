"""Where a phase image is calm: tiles of pixels of which masks need not look at any.

What a mask decides about single pixels, it would decide alike for all pixels of such a tile. The steps between
neighbours tell: they bound every difference of phases within reach.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fringescope import memory
from fringescope.kernels import domains as k
from fringescope.kernels import screens, tiles
from fringescope.kernels.tiles import MIXED, TILE, VOID, WHOLE
from fringescope.threads import WORKERS, in_bands
from fringescope.types import F32, F64, U8, U16, AnyArray, Bool

__all__ = ["MIXED", "VOID", "WHOLE", "Domains", "copy_of", "cover_of", "domains", "growing", "kinds", "linked", "rise",
           "steps_of", "tally", "update_steps", "widened"]  # fmt: skip

SAFE = 0.999  #: of a limit, so that rounding decides nothing


def shape_of(shape: tuple[int, int]) -> tuple[int, int]:
    """Tiles of an image of so many rows and columns."""
    return -(-shape[0] // TILE), -(-shape[1] // TILE)


def steps_of(phase: F32) -> F32:
    """Least and greatest step to the next pixel in row and column, and phase, of each tile (6, h, w)."""
    out = np.empty((6, *shape_of(phase.shape)), np.float32)
    tiles.steps(phase, np.ones(out.shape[1:], np.bool_), out)
    return out


def update_steps(phase: F32, some: Bool, steps: F32) -> None:
    """Measure the steps of `some` tiles (h, w) anew, in place."""
    tiles.steps(phase, some, steps)


def cover_of(reasons: U16, bits: int = 0xFFFF) -> U8:
    """MIXED, WHOLE or VOID of each tile (h, w), as to the reasons `bits`."""
    out = np.empty(shape_of(reasons.shape), np.uint8)
    tiles.cover(reasons, np.uint16(bits), out)
    return out


def tally(codes: U16) -> NDArray[np.int64]:
    """How often each code comes: (65536,)."""
    bands = 4 * WORKERS
    rows = -(-len(codes) // bands)
    parts = np.zeros((bands, 1 << 16), np.int64)
    in_bands(len(codes), rows, lambda first, last: tiles.tally(first, last, codes, parts[first // rows]))
    return np.asarray(parts.sum(axis=0))


def copy_of(reasons: U16) -> U16:
    """A copy of reason codes."""
    out = memory.empty(reasons.shape, np.uint16)
    np.copyto(out, reasons)
    return out


def _window(pixels: float) -> AnyArray:
    reach = math.ceil(pixels / TILE)
    return np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)


def widened(some: Bool, pixels: float) -> Bool:
    """The tiles (h, w) that have a pixel within so many pixels of one of `some` tiles."""
    return np.asarray(cv2.dilate(some.astype(np.uint8), _window(pixels)) > 0)


def rise(steps: F32) -> F32:
    """Most that the phase changes over one pixel of each tile (h, w), along row and column together; inf: unknown."""
    across = np.maximum(np.maximum(-steps[0], steps[1]), 0)
    return np.asarray(across + np.maximum(np.maximum(-steps[2], steps[3]), 0), dtype=np.float32)


def linked(steps: F32, cover: U8, limit: float, around: int = 0) -> Bool:
    """Tiles (h, w) without a hole in which neighbours differ by less than `limit`; with `around`: the next ones too."""
    good = (cover == WHOLE) & (rise(steps) < SAFE * limit)
    if around:
        good = cv2.erode(good.astype(np.uint8), _window(around * TILE)).astype(np.bool_)
    return np.asarray(good)


def kinds(steps: F32, cover: U8, limit: float) -> U8:
    """CALM, VOID or MIXED of each tile (h, w), as `kernels.screens` wants it: `linked` with those around, none at a
    border.
    """
    inner = np.zeros(cover.shape, np.bool_)
    inner[1:-1, 1:-1] = linked(steps, cover, limit, around=1)[1:-1, 1:-1]
    return np.where(inner, screens.CALM, np.where(cover == VOID, screens.VOID, screens.MIXED)).astype(np.uint8)


def growing(steps: F32, cover: U8, field: F64, shape: tuple[int, int], reach: int) -> Bool:
    """Tiles (h, w) from whose pixels the phase cannot fall over `reach` pixels along the unit direction in `field`.

    `field` (h', w', 3) spans the image of `shape` corner on corner.
    """
    whole = cv2.erode((cover == WHOLE).astype(np.uint8), _window(reach + 1)) > 0
    out = np.empty(cover.shape, np.bool_)
    tiles.growing(steps, whole, field, *shape, reach, out)
    return out


@dataclass(frozen=True, eq=False)
class Domains:
    """Contiguous domains of a view, as `kernels.domains` reads them: `label` of each node, pixels of each label."""

    kind: U8  #: (h, w) of each tile
    node: NDArray[np.int32]  #: (h, w) first node of each tile
    label: NDArray[np.int32]  #: of each node, -1 = masked
    sizes: NDArray[np.int64]

    def mark_small(self, least: float, bit: np.uint16, reasons: U16) -> None:
        """Give `bit` to pixels without a reason of domains of fewer than `least` pixels."""
        if (self.sizes < least).any():
            k.mark_small(self.node, self.label, self.kind, self.sizes, least, bit, reasons)


def domains(
    phase: F32, sigma: F32, reasons: U16, field: F64, limits: tuple[float, float, float], steps: F32, least_step: float
) -> Domains:
    """Domains of pixels without a reason that are linked with the next in row or column, over one masked pixel too.

    T1 = factor times the growth in channel 2 of `field`, at least floor, plus noise sigmas: `limits` = factor, floor,
    noise. `least_step`: the least T1 anywhere; `steps`: of the phase, see `steps_of`.
    """
    cover = cover_of(reasons)
    kind = np.where(cover == VOID, k.VOID, np.where(linked(steps, cover, least_step), k.CALM, k.PIXELS))
    kind = kind.astype(np.uint8)
    node = np.empty(kind.shape, np.int32)
    parent = np.arange(k.number(kind, node), dtype=np.int32)
    rows = max(8, -(-len(kind) // (4 * WORKERS)))
    args = (phase, sigma, reasons, field, *limits, kind, node, parent)
    in_bands(len(kind), rows, lambda first, last: k.link(first, last, *args))
    for first in range(rows, len(kind), rows):
        k.link_up(first, *args)
    label = np.empty(len(parent), np.int32)
    sizes = k.settle(reasons, kind, node, parent, label)
    return Domains(kind, node, label, sizes)
