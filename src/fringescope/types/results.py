"""What passes between the stages, from wrapped phases to the scan."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fringescope.errors import CaptureError
from fringescope.types.capture import NoiseModel
from fringescope.types.names import F32, U8, U16, U32, AnyArray, Bool, PixelFormat


@dataclass(frozen=True, eq=False)
class WrappedSet:
    """One measurement (HDR brackets merged) of one fringe period: all arrays (H, W) float32."""

    g: tuple[float, float]  #: cycles per projector-plane unit
    steps: int
    phase: F32  #: wrapped, radians in (-pi, pi]
    background: F32  #: A, codes
    modulation: F32  #: B, codes
    sigma: F32  #: standard deviation of the phase, radians
    saturated: U8  #: saturated samples of this pixel
    misfit: F32  #: rms misfit of the samples over what the noise explains; NaN when steps == 3


@dataclass(frozen=True, eq=False)
class GrayCode:
    """Decoded Gray code: `value` (H, W) int32, -1 where a bit is uncertain."""

    axis: str
    cell: float
    value: NDArray[np.int32]
    contrast: F32


@dataclass(frozen=True, eq=False)
class Direction:
    """Absolute phase along one fringe direction. Arrays (H, W) float32; NaN = none.

    `phase` belongs to the finest set, of gradient `g`; `order_margin` is how many standard deviations the chosen
    order is better than the next one that the field allows.
    """

    g: tuple[float, float]
    phase: F32
    sigma: F32
    order_margin: F32


@dataclass(frozen=True, eq=False)
class Decoded:
    """One view's frames, decoded: absolute phases and what the masks need. All arrays (H, W)."""

    camera: str
    directions: tuple[Direction, ...]
    sets: tuple[WrappedSet, ...]
    gray: tuple[GrayCode, ...]
    background: F32  #: A of the finest set, codes
    modulation: F32  #: B of the finest set, codes
    reasons: U16
    noise: NoiseModel
    notes: tuple[str, ...] = ()  #: words for people on how the sets fit each other

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.background.shape[0], self.background.shape[1]


@dataclass(frozen=True, eq=False)
class Grid:
    """Organised points of one view on its camera's pixel grid, world mm. NaN where `reasons` is not zero."""

    view: int  #: 0-based index into the rig's cameras
    camera: str
    xyz: F32  #: (H, W, 3)
    sigma: F32  #: (H, W) one standard deviation along the camera's ray, mm
    reasons: U16  #: (H, W)

    @property
    def valid(self) -> Bool:
        """(H, W), true where there is a point."""
        return np.asarray(self.reasons == 0)


@dataclass(frozen=True, eq=False)
class Photo:
    """One view's colour picture: (H, W, 3) float32, linear light, white-balanced, 0..1 = black..white."""

    camera: str
    rgb: F32
    saturated: Bool


@dataclass(frozen=True, eq=False)
class Picture:
    """A raw photograph of one view: (H, W) codes, mono or mosaic, or (H, W, 3) for RGB8, uint8 or uint16.

    `light` says what lit it: "ring", or "projector" where it is the fringes' background A, rounded to codes.
    """

    camera: str
    frame: AnyArray
    pixel_format: PixelFormat
    light: str = "ring"

    def __post_init__(self) -> None:
        deep = 3 if self.pixel_format is PixelFormat.RGB8 else 2
        if self.frame.ndim != deep or (deep == 3 and self.frame.shape[2] != 3):
            raise CaptureError(f"camera '{self.camera}': a picture of shape {self.frame.shape}; "
                               f"{self.pixel_format.value} needs (height, width{', 3' * (deep == 3)})")
        if self.frame.dtype != self.pixel_format.dtype:
            raise CaptureError(f"camera '{self.camera}': a picture of {self.frame.dtype}; {self.pixel_format.value} "
                               f"needs {self.pixel_format.dtype}")
        if self.light not in ("ring", "projector"):
            raise CaptureError(f"camera '{self.camera}': a picture under the light '{self.light}'; needed ring or "
                               "projector")


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points in world mm: xyz (n, 3), unit normals (n, 3), sRGB colours (n, 3), sigma (n,), view (n,)."""

    xyz: F32
    normals: F32
    rgb: U8
    sigma: F32
    view: U8

    def __len__(self) -> int:
        return int(self.xyz.shape[0])


@dataclass(frozen=True, eq=False)
class SurfacePart:
    """The triangles textured by one picture: `faces` (m, 3) into `Surface.vertices`, `uv` one per face corner's vertex.

    `vertex_index` (k,) picks the vertices used here, `uv` (k, 2) are texture coordinates in 0..1 with the origin at
    the top-left corner of the picture, `faces` (m, 3) index into `vertex_index`.
    """

    view: int
    vertex_index: U32
    uv: F32
    faces: U32
    texture: U8  #: (h, w, 3) sRGB


@dataclass(frozen=True, eq=False)
class Surface:
    """A textured triangle mesh in world mm: vertices (n, 3), unit normals (n, 3), parts by texture."""

    vertices: F32
    normals: F32
    parts: tuple[SurfacePart, ...]

    @property
    def n_faces(self) -> int:
        """Triangles in all parts."""
        return sum(len(p.faces) for p in self.parts)


@dataclass(frozen=True)
class ViewVerdict:
    """What one view lost, in figures and in words."""

    camera: str
    pixels: int
    points: int
    lost: Mapping[str, int]  #: pixels per reason name (a pixel may count under several)
    words: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Scan:
    """The result of the main job: one grid per view, the fused cloud, the surface, what was lost and why.

    `surface` is the finest level of detail, `preview` the coarsest; `all_points` every valid pixel of every view, where
    it was asked for. `pictures`: the photograph of each grid, the raw frame itself, not a copy.
    """

    grids: tuple[Grid, ...]
    cloud: Cloud
    surface: Surface | None
    verdicts: tuple[ViewVerdict, ...]
    figures: Mapping[str, Any] = field(default_factory=dict)
    preview: Surface | None = None
    all_points: Cloud | None = None
    pictures: tuple[Picture, ...] = ()
