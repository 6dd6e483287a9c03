"""What travels between the stages: frozen values without behaviour beyond checking themselves once.

Letters of the axes, everywhere: N frames, H rows, W columns, V views, D fringe directions. Units: millimetres, seconds,
radians; projector-plane units for fringe periods. `T_ab` maps b to a. See `docs/conventions.md`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from enum import Enum, IntFlag
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from fringescope.errors import CaptureError, RigError

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
    def is_bayer(self) -> bool:
        """Whether the samples lie behind an RGGB mosaic."""
        return self.value.startswith("Bayer")

    @property
    def is_colour(self) -> bool:
        """Whether a colour picture can be made of it."""
        return self.is_bayer or self is PixelFormat.RGB8

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


# ---------------------------------------------------------------------------------------------------------- the rig


def _vector(a: Any, shape: tuple[int, ...], what: str) -> F64:
    try:
        v = np.array(a, dtype=np.float64)
    except (TypeError, ValueError) as e:
        raise RigError(f"{what}: not numbers; needed an array of shape {shape}") from e
    if v.shape != shape:
        raise RigError(f"{what}: shape {v.shape}; needed {shape}")
    if not np.isfinite(v).all():
        raise RigError(f"{what}: contains NaN or infinity; needed finite numbers")
    v.setflags(write=False)
    return v


@dataclass(frozen=True, eq=False)
class Lens:
    """Pinhole and OpenCV's five-term distortion of one device, on its plane of `width` x `height` units.

    For a camera the plane is its pixels; for a projector it is the projector plane of `Layout`.
    `K` is (3, 3), `distortion` is (5,) = [k1, k2, p1, p2, k3]. Raises RigError if it cannot be a lens.
    """

    width: int
    height: int
    K: F64
    distortion: F64

    def __post_init__(self) -> None:
        K = _vector(self.K, (3, 3), "K")
        if not (K[0, 0] > 0 and K[1, 1] > 0) or K[1, 0] != 0 or K[2, 0] != 0 or K[2, 1] != 0 or K[2, 2] != 1:
            raise RigError(f"K: {K.tolist()}; needed [[fx, s, u0], [0, fy, v0], [0, 0, 1]] with positive fx, fy")
        if self.width < 1 or self.height < 1:
            raise RigError(f"size {self.width} x {self.height}; needed at least 1 x 1")
        object.__setattr__(self, "K", K)
        object.__setattr__(self, "distortion", _vector(self.distortion, (5,), "distortion"))


@dataclass(frozen=True, eq=False)
class Pose:
    """Rigid transform T_device_world: `p_device = R @ p_world + t`, R (3, 3) a rotation, t (3,) in mm."""

    R: F64
    t: F64

    def __post_init__(self) -> None:
        R = _vector(self.R, (3, 3), "R")
        if not np.allclose(R @ R.T, np.eye(3), atol=1e-4) or np.linalg.det(R) < 0:
            raise RigError("R: not a rotation; needed R R^T = 1 with determinant +1")
        U, _, Vt = np.linalg.svd(R)
        R = U @ Vt
        R.setflags(write=False)
        object.__setattr__(self, "R", R)
        object.__setattr__(self, "t", _vector(self.t, (3,), "t"))


@dataclass(frozen=True, eq=False)
class Camera:
    """One camera of a rig: its name, lens and pose."""

    name: str
    lens: Lens
    pose: Pose


@dataclass(frozen=True, eq=False)
class Projector:
    """The projector, an inverse camera. `width` x `height` device pixels on a `layout`; the lens acts on its plane."""

    width: int
    height: int
    layout: Layout
    lens: Lens
    pose: Pose

    @property
    def plane_size(self) -> tuple[int, int]:
        """Extent of the projector plane in its units (u, v)."""
        return plane_size(self.width, self.height, self.layout)


def plane_size(width: int, height: int, layout: Layout) -> tuple[int, int]:
    """Extent (u, v) of the projector plane of a device of `width` x `height` pixels."""
    return (2 * width if layout is Layout.DIAMOND else width, height)


@dataclass(frozen=True, eq=False)
class Volume:
    """An oriented box in world mm, where the specimen may be: `axes` rows are unit vectors, `half_size` along each."""

    center: F64
    axes: F64
    half_size: F64

    def __post_init__(self) -> None:
        object.__setattr__(self, "center", _vector(self.center, (3,), "volume.center"))
        axes = _vector(self.axes, (3, 3), "volume.axes")
        if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-3):
            raise RigError("volume.axes: rows are not perpendicular unit vectors")
        object.__setattr__(self, "axes", axes)
        h = _vector(self.half_size, (3,), "volume.half_size")
        if not (h > 0).all():
            raise RigError(f"volume.half_size: {h.tolist()}; needed three positive lengths in mm")
        object.__setattr__(self, "half_size", h)


@dataclass(frozen=True, eq=False)
class Rig:
    """A calibrated instrument: one projector and one or more cameras in one world frame, mm.

    `extra` keeps keys of the file that we do not use, so that nothing is lost when it is written again.
    """

    projector: Projector
    cameras: tuple[Camera, ...]
    volume: Volume | None = None
    extra: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    def __post_init__(self) -> None:
        names = [c.name for c in self.cameras]
        if not names:
            raise RigError("the rig has no cameras; needed at least one")
        if len(set(names)) != len(names):
            raise RigError(f"camera names {names}: not unique")

    @property
    def devices(self) -> tuple[Camera | Projector, ...]:
        """The projector, then the cameras."""
        return (self.projector, *self.cameras)

    def index(self, name: str) -> int:
        """0-based index of the camera `name`. Raises RigError if the rig lacks it."""
        for i, c in enumerate(self.cameras):
            if c.name == name:
                return i
        raise RigError(f"the rig lacks camera '{name}'; it has {', '.join(c.name for c in self.cameras)}")

    def camera(self, name: str) -> Camera:
        """The camera `name`. Raises RigError if the rig lacks it."""
        return self.cameras[self.index(name)]


# ------------------------------------------------------------------------------------------------------ the capture


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
    """Variance of one raw sample in codes squared: `a + b I` at intensity I (codes)."""

    a: float
    b: float
    source: str = "default"  #: "residuals", "capture.json" or "default"


@dataclass(frozen=True, eq=False)
class ViewInput:
    """What the pipeline takes of one view: its plan, its frames one by one in any order, its ring-light picture.

    A frame is (H, W) uint8 or uint16 (RGB8: (H, W, 3)), raw as the sensor gave it. `color` is raw in
    the same format, or None.
    """

    plan: ViewPlan
    frames: Iterable[tuple[FrameKey, AnyArray]]
    color: AnyArray | None = None
    noise: NoiseModel | None = None


# ------------------------------------------------------------------------------------------------- between the stages


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
    it was asked for.
    """

    grids: tuple[Grid, ...]
    cloud: Cloud
    surface: Surface | None
    verdicts: tuple[ViewVerdict, ...]
    figures: Mapping[str, Any] = field(default_factory=dict)
    preview: Surface | None = None
    all_points: Cloud | None = None
