"""Array types and the words of the field: pixel formats, lattices, reasons."""

from __future__ import annotations

from enum import Enum, IntFlag
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

F32: TypeAlias = NDArray[np.float32]
F64: TypeAlias = NDArray[np.float64]
U8: TypeAlias = NDArray[np.uint8]
U16: TypeAlias = NDArray[np.uint16]
U32: TypeAlias = NDArray[np.uint32]
Bool: TypeAlias = NDArray[np.bool_]
AnyArray: TypeAlias = NDArray[Any]


class PixelFormat(Enum):
    """GenICam pixel formats that we read. BayerRG is RGGB: row 0 is R G R G."""

    MONO8 = "Mono8"
    MONO10 = "Mono10"
    MONO12 = "Mono12"
    MONO16 = "Mono16"
    BAYER_RG8 = "BayerRG8"
    BAYER_RG10 = "BayerRG10"
    BAYER_RG12 = "BayerRG12"
    BAYER_RG16 = "BayerRG16"
    RGB8 = "RGB8"

    @property
    def bits(self) -> int:
        """Significant bits per sample."""
        return int("".join(c for c in self.value if c.isdigit()))

    @property
    def max_value(self) -> int:
        """Largest code: a sample at or above it is saturated."""
        return (1 << self.bits) - 1

    @property
    def full_scale(self) -> int:
        """The code at which a decoded sample is saturated: the sum of the channels of an RGB pixel."""
        return self.max_value * (3 if self is PixelFormat.RGB8 else 1)

    @property
    def is_bayer(self) -> bool:
        """Whether the samples lie behind an RGGB mosaic."""
        return self.value.startswith("Bayer")

    @property
    def is_colour(self) -> bool:
        """Whether a colour picture can be made of it."""
        return self.is_bayer or self is PixelFormat.RGB8

    def packs(self, frame: AnyArray) -> bool:
        """Whether a frame holds two samples of 12 bits in three octets: (H, W / 2, 3) uint8."""
        return self.bits == 12 and frame.dtype == np.uint8 and frame.ndim == 3 and frame.shape[2] == 3

    @property
    def dtype(self) -> np.dtype[Any]:
        """uint8 up to 8 bits, uint16 (right-aligned) above."""
        return np.dtype(np.uint8 if self.bits <= 8 else np.uint16)


class Layout(Enum):
    """Where a device pixel (column c, row r) lies on the projector plane."""

    GRID = "grid"  #: u = c, v = r
    DIAMOND = "diamond"  #: u = 2 c + (r mod 2), v = r  (DLP4500)


class Reason(IntFlag):
    """Why a pixel carries no point. The bits are part of the file formats."""

    DARK = 1
    SATURATED = 2
    LOW_MODULATION = 4
    ORDER_UNCERTAIN = 8
    REVERSED = 16
    JUMP = 32
    ISLAND = 64
    OUT_OF_VOLUME = 128
    INCONSISTENT = 256
    VIEWS_DISAGREE = 512
    NOT_LOCAL = 1024

    @property
    def label(self) -> str:
        """How a person reads it."""
        return _REASON_LABELS[self]


_REASON_LABELS = {
    Reason.DARK: "dark or in shadow",
    Reason.SATURATED: "saturated",
    Reason.LOW_MODULATION: "low modulation",
    Reason.ORDER_UNCERTAIN: "order uncertain",
    Reason.REVERSED: "reversed (mirrored) fringes",
    Reason.JUMP: "phase jump",
    Reason.ISLAND: "small island",
    Reason.OUT_OF_VOLUME: "out of volume",
    Reason.INCONSISTENT: "inconsistent frames",
    Reason.VIEWS_DISAGREE: "views disagree",
    Reason.NOT_LOCAL: "not local",
}
