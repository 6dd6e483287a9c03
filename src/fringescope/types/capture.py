"""What is projected and what comes back: sets, plans, frames, noise."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np

from fringescope.errors import CaptureError
from fringescope.types.names import F32, AnyArray, Layout, PixelFormat
from fringescope.types.response import Response

ROUNDING = 1.0 / 12.0  #: variance of rounding to whole codes, codes squared


@dataclass(frozen=True)
class FringeSet:
    """N-step sinusoidal fringes `I_n = A + B cos(Phi - 2 pi n / N)`, `Phi = 2 pi (gx u + gy v)`.

    `cycles_per_pixel` = (gx, gy) in projector-plane units. Sets with equal g and different `exposure_us` are
    brackets of one measurement.
    """

    cycles_per_pixel: tuple[float, float]
    steps: int
    exposure_us: float | None = None

    def __post_init__(self) -> None:
        if not 3 <= self.steps <= 64:
            raise CaptureError(f"a fringe set with {self.steps} steps; phase shifting needs 3 to 64")
        gx, gy = self.cycles_per_pixel
        if not (math.isfinite(gx) and math.isfinite(gy)) or math.hypot(gx, gy) == 0:
            raise CaptureError(f"cycles_per_pixel {self.cycles_per_pixel}; needed two finite numbers, not both zero")

    @property
    def frequency(self) -> float:
        """Cycles per projector-plane unit along the gradient."""
        return math.hypot(*self.cycles_per_pixel)

    @property
    def period(self) -> float:
        """Projector-plane units per cycle along the gradient."""
        return 1.0 / self.frequency


@dataclass(frozen=True)
class GraySet:
    """Reflected binary code along `axis` ("u" or "v"); `bits` frames, most significant first.

    `cell` is the width, in projector-plane units, of one code value: value k covers
    [-0.5 + k cell, -0.5 + (k + 1) cell).
    """

    axis: str
    cell: float
    bits: int
    inverse: bool = False
    white: bool = False
    black: bool = False

    def __post_init__(self) -> None:
        if self.axis not in ("u", "v"):
            raise CaptureError(f"Gray code along '{self.axis}'; needed \"u\" or \"v\"")
        if not (math.isfinite(self.cell) and self.cell > 0):
            raise CaptureError(f"Gray code cell {self.cell}; needed a positive width in projector-plane units")
        if not 1 <= self.bits <= 16:
            raise CaptureError(f"Gray code of {self.bits} frames; needed 1 to 16")


class Role(Enum):
    """What a frame of a set is."""

    STEP = "step"  #: frame n of an N-step fringe set
    BIT = "bit"  #: frame n of a Gray code, most significant first
    INVERSE = "inverse"  #: the same, inverted
    WHITE = "white"
    BLACK = "black"


class FrameKey(NamedTuple):
    """Which frame of a view this is: set number in the plan, role, number within the role."""

    set_index: int
    role: Role
    number: int


@dataclass(frozen=True)
class ViewPlan:
    """What one camera sees: its pixel format and the sets, in the order of the capture."""

    camera: str
    pixel_format: PixelFormat
    sets: tuple[FringeSet | GraySet, ...]
    projector_size: tuple[int, int]  #: extent (u, v) of the projector plane, in its units

    def __post_init__(self) -> None:
        if not self.sets:
            raise CaptureError(f"view '{self.camera}' has no sets; needed at least one fringe set or Gray code")

    @property
    def keys(self) -> tuple[FrameKey, ...]:
        """Every frame of the view, in the order in which `store` reads and `capture` collects them."""
        out: list[FrameKey] = []
        for i, s in enumerate(self.sets):
            if isinstance(s, FringeSet):
                out += [FrameKey(i, Role.STEP, n) for n in range(s.steps)]
            else:
                out += [FrameKey(i, Role.WHITE, 0)] if s.white else []
                out += [FrameKey(i, Role.BLACK, 0)] if s.black else []
                for n in range(s.bits):
                    out.append(FrameKey(i, Role.BIT, n))
                    out += [FrameKey(i, Role.INVERSE, n)] if s.inverse else []
        return tuple(out)


@dataclass(frozen=True)
class PatternPlan:
    """What to project for a rig: per camera (same order as the rig) its sets, on the projector's plane."""

    projector_width: int
    projector_height: int
    layout: Layout
    views: tuple[ViewPlan, ...]


@dataclass(frozen=True)
class NoiseModel:
    """Variance of one raw sample in codes squared: `a + b I` at intensity I (codes), at least that of the rounding.

    `a` is negative on a sensor with a black level: its shot noise begins above the level.
    """

    a: float
    b: float
    source: str = "default"  #: "residuals", "capture.json" or "default"

    def variance(self, intensity: F32) -> F32:
        """Variance of samples of these intensities, codes squared, same shape."""
        line = np.float32(self.a) + np.float32(self.b) * np.asarray(intensity, dtype=np.float32)
        return np.asarray(np.maximum(line, np.float32(ROUNDING)), dtype=np.float32)


@runtime_checkable
class RowFrames(Protocol):
    """Frames of which some rows can be had, without the rest in memory."""

    def __iter__(self) -> Iterator[tuple[FrameKey, AnyArray]]:
        """Each frame, whole, with its key."""

    def rows(self, first: int, last: int) -> Iterator[tuple[FrameKey, AnyArray]]:
        """Rows first to last - 1 of each frame."""


@dataclass(frozen=True, eq=False)
class ViewInput:
    """What the pipeline takes of one view: its plan, its frames one by one in any order, its ring-light picture.

    A frame is (H, W) uint8 or uint16 (RGB8: (H, W, 3)), raw as the sensor gave it. Samples of 12 bits may come packed
    as cameras send them (GenICam 12p), two in three octets: (H, W / 2, 3) uint8. Frames stay as they are until the work
    on the view is done: what a driver's ring of buffers overwrites has to be copied as it comes. `color` is raw in the
    same format, or None. `response`: what its phases are to be freed from, or None.
    """

    plan: ViewPlan
    frames: Iterable[tuple[FrameKey, AnyArray]]
    color: AnyArray | None = None
    noise: NoiseModel | None = None
    response: Response | None = None
