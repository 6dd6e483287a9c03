"""What an expert draws, and what becomes of it on the tissue and on the projector."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from fringescope.errors import GuidanceError
from fringescope.types.names import F64, U8


class StrokeKind(Enum):
    """What a stroke's points mean."""

    LINE = "line"  #: a polyline, closed where `closed` says so
    REGION = "region"  #: a closed outline, empty, solid or hatched
    CIRCLE = "circle"  #: the centre, and a point of the rim unless `radius_mm` says how far it is
    ARROW = "arrow"  #: a polyline with its head at the last point
    OFFSETS = "offsets"  #: a polyline and `count` lines parallel to it, every `spacing_mm`
    TEXT = "text"  #: the start of the writing, and a point that it runs towards


class Fill(Enum):
    """What is inside a region."""

    NONE = "none"
    SOLID = "solid"
    HATCH = "hatch"


class Side(Enum):
    """Where parallel lines lie, looking along the stroke from the projector."""

    RIGHT = "right"
    LEFT = "left"
    BOTH = "both"


class Hidden(Enum):
    """Why a part of a stroke cannot be shown where it was asked for."""

    SHADOW = "shadow"  #: something stands between it and the projector
    GRAZING = "grazing"  #: the projector's light only grazes the tissue there
    OUTSIDE = "outside"  #: beyond the projector's field
    HOLE = "hole"  #: no surface was measured there


WIDTH_MM = 0.5  #: of a stroke that asks for no width
FARTHEST = 1e6  #: pixels or mm; no picture and no tissue reaches so far
LETTERS = 100  #: of a text at most
ASIDE_MM = 200.0  #: parallel lines lie no farther from their stroke


@dataclass(frozen=True, eq=False)
class Stroke:
    """One thing that an expert drew: in the pixels (n, 2) of `camera`, or at `world_mm` (n, 3). One of both is None.

    Lengths are those on the tissue, in mm; `width_px` is in mirrors of the projector. `color` is sRGB, 0..255.
    `spacing_mm` is that of hatches and offsets. Raises GuidanceError, which says what is wrong with it.
    """

    id: str
    kind: StrokeKind = StrokeKind.LINE
    camera: str | None = None
    pixels: F64 | None = None
    world_mm: F64 | None = None
    width_mm: float | None = None
    width_px: float | None = None
    color: tuple[int, int, int] = (255, 48, 48)
    closed: bool = False
    fill: Fill = Fill.NONE
    spacing_mm: float = 2.0
    count: int = 1
    side: Side = Side.RIGHT
    radius_mm: float | None = None
    head_mm: float | None = None
    text: str = ""
    size_mm: float = 3.0

    def __post_init__(self) -> None:
        if (self.pixels is None) == (self.world_mm is None):
            came = "both" if self.pixels is not None else "neither"
            raise GuidanceError(f"has {came} of pixels and world_mm; needed one of them")
        if self.pixels is not None and not self.camera:
            raise GuidanceError("has pixels and no camera; needed the name of the camera that they belong to")
        name, n = ("pixels", 2) if self.pixels is not None else ("world_mm", 3)
        points = stroke_points(getattr(self, name), name, n)
        object.__setattr__(self, name, points)
        if self.width_mm is not None and self.width_px is not None:
            raise GuidanceError("has both width_mm and width_px; needed one of them")
        for what, low, high in (("width_mm", 0.01, 20), ("width_px", 0.1, 200), ("radius_mm", 0.05, 200),
                                ("head_mm", 0.1, 50), ("spacing_mm", 0.1, 100), ("size_mm", 0.5, 50)):  # fmt: skip
            value = getattr(self, what)
            if value is not None and not (math.isfinite(value) and low <= value <= high):
                raise GuidanceError(f"{what} is {value:g}; needed {low:g} to {high:g}")
        if not 1 <= self.count <= 100:
            raise GuidanceError(f"count is {self.count}; needed 1 to 100 parallel lines")
        if len(self.color) != 3 or not all(isinstance(c, int) and 0 <= c <= 255 for c in self.color):
            raise GuidanceError(f"color is {self.color}; needed red, green, blue from 0 to 255")
        self._check_count(len(points))

    def _check_count(self, n: int) -> None:
        """Whether there are as many points as the kind needs."""
        needed = {StrokeKind.REGION: 3, StrokeKind.CIRCLE: 1 if self.radius_mm else 2, StrokeKind.TEXT: 1}
        least = needed.get(self.kind, 2)
        if n < least:
            raise GuidanceError(f"has {n} point{'' if n == 1 else 's'}; a {self.kind.value} needs at least {least}")
        if self.kind is StrokeKind.TEXT:
            if not self.text.strip():
                raise GuidanceError("is a text without words")
            if len(self.text) > LETTERS or not self.text.isprintable():
                came = f"text {self.text[:20]!a} of {len(self.text)}"
                raise GuidanceError(f"{came}; needed 1 to {LETTERS} printable letters")
        elif self.kind is not StrokeKind.CIRCLE and not np.ptp(self.points, axis=0).any():
            raise GuidanceError("all its points are the same; needed a line of some length")
        if self.kind is StrokeKind.OFFSETS and self.count * self.spacing_mm > ASIDE_MM:
            far = self.count * self.spacing_mm
            raise GuidanceError(f"its parallels reach {far:g} mm to the side; needed at most {ASIDE_MM:g} mm")

    @property
    def points(self) -> F64:
        """The points as they were drawn: (n, 2) pixels or (n, 3) mm."""
        points = self.pixels if self.pixels is not None else self.world_mm
        assert points is not None
        return points


def stroke_points(a: Any, name: str, n: int) -> F64:
    """A list of points as an array (m, n), read-only; `name` stands in messages. Raises GuidanceError."""
    try:
        raw = np.array(a)
    except (TypeError, ValueError, OverflowError):
        raw = np.array(None)
    if raw.size and raw.dtype.kind not in "iuf":
        raise GuidanceError(f"{name}: not numbers; needed a list of {n} numbers per point")
    points = raw.astype(np.float64)
    if points.ndim != 2 or points.shape[1] != n or not len(points):
        raise GuidanceError(f"{name}: of shape {points.shape}; needed at least one point of {n} numbers")
    bad = int((~np.isfinite(points).all(axis=1)).sum())
    if bad:
        raise GuidanceError(f"{name}: {bad} of {len(points)} points are NaN or infinite; needed finite numbers")
    if float(np.abs(points).max()) > FARTHEST:
        raise GuidanceError(f"{name}: reaches to {np.abs(points).max():.3g}; needed points within {FARTHEST:,.0f}")
    points.setflags(write=False)
    return points


@dataclass(frozen=True, eq=False)
class Guidelines:
    """Strokes, and the hashes of scan and rig that they are bound to (None: those of the call).

    `refused` names strokes that could not be read, with the reason of each.
    """

    strokes: tuple[Stroke, ...]
    scan: str | None = None
    rig: str | None = None
    refused: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Trace:
    """A line on the tissue, sampled: n places along it, in order. A new `piece` begins where the line is broken.

    `why` holds 0 where the projector can show it, else 1 + the index of the reason in `Hidden`. A place that is not on
    a measured surface has NaN as its point, and `uv` only where the line around it tells about where it is.
    """

    xyz: F64  #: (n, 3) mm, world
    normal: F64  #: (n, 3) unit, towards the projector
    sigma: F64  #: (n,) one standard deviation of where it lands on the tissue, mm
    uv: F64  #: (n, 2) projector-plane units
    half: F64  #: (n,) half the line's width, projector-plane units, across the line
    piece: Any  #: (n,) int32
    why: U8  #: (n,)
    carried: Any  #: (n,) bool: by the surface of other views, for the stroke's own camera saw none there

    def __len__(self) -> int:
        return len(self.uv)


@dataclass(frozen=True, eq=False)
class HiddenPart:
    """A part of a stroke that is not shown: about where, projector-plane units (m, 2), and why; its length in mm."""

    segment: F64
    why: Hidden
    length_mm: float


@dataclass(frozen=True, eq=False)
class Guided:
    """What became of one stroke.

    `segments`: the visible pieces, projector-plane units, (m, 2) each; `lands` the same pieces on the tissue, mm
    (m, 3). `expected_error_um`: rms distance on the tissue, across the line, of where it will land from where it was
    asked for. A stroke that was refused has neither, and `refused` says why. Lengths run along the surface.
    """

    stroke: Stroke
    traces: tuple[Trace, ...] = ()
    segments: tuple[F64, ...] = ()
    lands: tuple[F64, ...] = ()
    hidden: tuple[HiddenPart, ...] = ()
    length_mm: float = 0.0
    length_sigma_mm: float = 0.0
    area_mm2: float | None = None
    area_sigma_mm2: float | None = None
    expected_error_um: float | None = None
    notes: tuple[str, ...] = ()
    refused: str | None = None

    @property
    def visible(self) -> float:
        """Share of its length that is shown, 0..1."""
        hidden = sum(h.length_mm for h in self.hidden)
        shown = sum(float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()) for p in self.lands)
        return shown / (shown + hidden) if shown + hidden > 0 else 0.0


@dataclass(frozen=True, eq=False)
class Guidance:
    """Strokes made ready for a projector: the picture that it shows, (height, width, 3) RGB in device pixels."""

    image: U8
    strokes: tuple[Guided, ...]
    scan: str | None = None
    rig: str | None = None


@dataclass(frozen=True, eq=False)
class Landing:
    """Where the projected line of one stroke was found, and how far from where it was asked for, um.

    `found` (n, 3) mm on the tissue, `asked` (n, 3) the places of the asked line next to them, `camera` (n,) index into
    the rig's cameras, `offset_um` (n,) signed, across the line. Figures are None where no line was found.
    """

    id: str
    found: F64
    asked: F64
    offset_um: F64
    camera: Any
    median_um: float | None
    p95_um: float | None
    max_um: float | None
    share: float  #: of the places where the line should be seen by some camera, those where it was found
    words: tuple[str, ...] = ()
