"""What calibration sees and finds: the board, its sightings, the solved rig with its evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fringescope.errors import CalibrationError
from fringescope.types.names import F64
from fringescope.types.rig import Pose, Rig

I32 = NDArray[np.int32]


@dataclass(frozen=True)
class Board:
    """A flat board of `squares` (columns, rows), `square_mm` wide; with `dictionary`, markers in its white squares.

    Board coordinates in mm: origin at the first inner corner, x along the columns, y down the rows, z into the board.
    Inner corner (i, j) lies at (i, j, 0) * square_mm; square (c, r) has the corners (c - 1, r - 1) to (c, r), so its
    centre lies at (c - 1/2, r - 1/2, 0) * square_mm. Where the colours tell the board's two ends apart, the square
    (0, 0) is black; where they do not, either numbering is right and the projector's coordinate makes cameras agree.
    """

    squares: tuple[int, int]
    square_mm: float
    marker_mm: float = 0.0
    dictionary: str = ""  #: OpenCV's name of the marker dictionary; "" = a plain chequerboard

    def __post_init__(self) -> None:
        if min(self.squares) < 3 or max(self.squares) > 200:
            raise CalibrationError(f"board of {self.squares[0]} x {self.squares[1]} squares; needed 3 to 200 each way")
        if not 0 < self.square_mm < 1e4:
            raise CalibrationError(f"board squares of {self.square_mm} mm; needed a positive width in mm")
        if self.dictionary and not 0 < self.marker_mm < self.square_mm:
            raise CalibrationError(
                f"markers of {self.marker_mm} mm in squares of {self.square_mm} mm; needed smaller ones"
            )

    @property
    def inner_corners(self) -> tuple[int, int]:
        """Inner corners (columns, rows)."""
        return self.squares[0] - 1, self.squares[1] - 1

    @property
    def ends_differ(self) -> bool:
        """Whether half a turn changes the picture: markers do, and an odd and an even number of squares."""
        return bool(self.dictionary) or (self.squares[0] + self.squares[1]) % 2 == 1

    def corner_mm(self, corner: I32) -> F64:
        """Board coordinates (n, 3) of inner corners (n, 2)."""
        return np.column_stack([corner * self.square_mm, np.zeros(len(corner))])

    def centre_mm(self, square: I32) -> F64:
        """Board coordinates (n, 3) of the centres of squares (n, 2)."""
        return np.column_stack([(square - 0.5) * self.square_mm, np.zeros(len(square))])


@dataclass(frozen=True, eq=False)
class Sighting:
    """What one camera saw of the board in one pose. Pixels of the camera, phases in radians.

    Corners: index (n, 2), place (n, 2) and its standard deviation (n,) in pixels. White squares: index (m, 2), place of
    the centre (m, 2), projector coordinate there (m, 2) and its standard deviation (m, 2). Samples: the phase measured
    at fixed camera pixels inside white squares: places (k, 2), absolute phases (k, d), standard deviations (k, d), one
    column per fringe direction of `directions` (d, 2) in cycles per projector-plane unit; NaN = none.
    """

    pose: str
    camera: str
    size: tuple[int, int]  #: width, height of the picture
    corner: I32
    corner_px: F64
    corner_sigma: F64
    square: I32
    square_px: F64
    square_uv: F64
    square_sigma: F64
    directions: F64
    sample_px: F64
    sample_phase: F64
    sample_sigma: F64
    words: tuple[str, ...] = ()  #: what was left out of this sighting, and why

    @property
    def name(self) -> str:
        """How messages call it."""
        return f"{self.pose}/{self.camera}"


@dataclass(frozen=True)
class LeftOut:
    """A pose, a sighting or a number of points that the solve does without, and why."""

    pose: str
    camera: str | None  #: None = the whole pose
    points: int | None  #: None = all of it
    why: str


@dataclass(frozen=True)
class Parameter:
    """One solved number: of which device ("projector", a camera's name, "board"), name, value, sigma, unit.

    Names of a device: fx fy cx cy k1 k2 p1 p2 k3 of its lens (f = fx and fy as one); rx ry rz (rad) and tx ty tz (mm)
    of its pose T_device_world, where a change w of (rx, ry, rz) turns R into exp(w) R and leaves t as it is.
    """

    device: str
    name: str
    value: float
    sigma: float
    unit: str
    fixed: bool = False


@dataclass(frozen=True, eq=False)
class Residuals:
    """What one sighting's measurements miss the solution by: corners (n, 2) in pixels, samples (k, d) in units of the
    projector plane along each direction; NaN = left out. `sample_uv` (k, 2) is where on the projector plane.
    """

    pose: str
    camera: str
    corner: F64
    sample: F64
    sample_uv: F64


@dataclass(frozen=True, eq=False)
class Calibration:
    """A solved rig and everything needed to judge it or to solve it again.

    `boards` maps pose names to T_world_board. `covariance` (p, p) belongs to the free ones of `parameters` in their
    order, then six per pose (rotation vector, translation of T_world_board). `noise` holds the standard deviations that
    the solve settled on per kind of measurement, e.g. {"camera1 corners px": 0.02, "camera1 projector px": 0.03}.
    """

    rig: Rig
    board: Board
    boards: Mapping[str, Pose]
    sightings: tuple[Sighting, ...]
    residuals: tuple[Residuals, ...]
    parameters: tuple[Parameter, ...]
    covariance: F64
    noise: Mapping[str, float]
    left_out: tuple[LeftOut, ...] = ()
    figures: Mapping[str, Any] = field(default_factory=dict)


# ------------------------------------------------------------------------------------------------------- evidence


@dataclass(frozen=True)
class HeldOut:
    """One pose left out of the solve; its board then fitted with the rig of the other poses held fixed. NaN = none.

    Corners are triangulated from the camera's pixel and the projector's coordinate and compared with the board.
    """

    pose: str
    corners: int  #: how many were compared
    corner_mm_rms: float  #: distance from the board's grid after a rigid fit
    corner_px_rms: float  #: reprojection of the corners into the cameras
    sample_rms: float  #: phase residual in projector-plane units
    sample_um_rms: float  #: the same along the camera's ray
    scale: float  #: measured over true size of the board


@dataclass(frozen=True)
class FieldTest:
    """Whether a device's residuals are noise about nothing: spread, symmetry about zero, a smooth field that repeats.

    Probabilities come from turning the signs of whole sightings, so residuals that belong together stay together; they
    can be no smaller than 2 / 2^sightings. NaN = too few to tell.
    """

    device: str
    kind: str  #: "corners" (camera pixels) or "phase" (projector-plane units)
    unit: str
    size: tuple[int, int]  #: of the device's plane
    vectors: int
    sightings: int
    rms: float  #: of a vector's length
    mean: tuple[float, float]
    asymmetry: float  #: energy distance between r and -r over its largest value: 0 = centrosymmetric, 1 = all alike
    asymmetry_p: float
    field_rms: float  #: of a cubic vector field fitted over the image
    field_noise: float  #: what noise alone gives for it (median over turned signs)
    field_p: float  #: of the field, whole sightings turned
    field_f_p: float  #: of the field, F-test as if all residuals were independent
    arrows: tuple[tuple[float, float, float, float], ...]  #: some residuals to draw: u, v, du, dv (phase: patch means)
    cloud: tuple[tuple[float, float], ...]  #: some single residuals
    smooth: tuple[tuple[float, float, float, float], ...]  #: the fitted field


@dataclass(frozen=True)
class Coverage:
    """Where in a device's picture the boards were, and how they were tilted towards it.

    `cells` counts corners (projector: samples) in 6 rows of 8; -1 = a cell that no other device looks at, which needs
    none. Tilts: (pose, tilt_rad, azimuth_rad), the angle between the board's normal and the line of sight, and the
    direction in the image into which the board faces (0 = right, pi/2 = down).
    """

    device: str
    cells: tuple[tuple[int, ...], ...]
    share: float  #: of the cells that matter
    missing: tuple[str, ...]  #: regions in words: "lower left"
    tilts: tuple[tuple[str, float, float], ...]
    near_mm: float  #: nearest board point along the device's axis
    far_mm: float


@dataclass(frozen=True)
class Filled:
    """How many poses reached each cell of the measuring volume: layers along its last axis, rows along its
    second.

    -1 = a cell that no camera sees in the projector's light, which needs none. `edges_mm` (layers + 1,).
    """

    layers: tuple[tuple[tuple[int, ...], ...], ...]
    edges_mm: tuple[float, ...]
    size_mm: tuple[float, float]  #: of the volume along the first two axes
    share: float  #: of the cells that matter


@dataclass(frozen=True)
class Slice:
    """Predicted systematic sigma of points in one plane of the measuring volume: (rows, columns) in um; NaN = unseen.

    `extent_mm` = (x0, x1, y0, y1) and `z_mm` in world mm (along the volume's axes where it is turned).
    """

    z_mm: float
    extent_mm: tuple[float, float, float, float]
    sigma_um: tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Prediction:
    """What the covariance of the calibration says of measured points, rigid movements of the whole scene left aside.

    `median_um`, `p95_um`, `max_um` per camera: (3D, the root of the trace). `views_um`: median and largest predicted
    height difference of the surfaces of two cameras, per pair.
    """

    points: int
    per_camera: Mapping[str, tuple[float, float, float]]
    views_um: Mapping[str, tuple[float, float]]
    slices: Mapping[str, tuple[Slice, ...]]
    scale_ppm: float  #: standard deviation of the overall scale


@dataclass(frozen=True)
class PoseFigures:
    """One row of the report's table: residuals per camera, corners in pixels and phase in projector-plane units.

    Both are lengths of vectors, as in `FieldTest`.
    """

    pose: str
    corner_px: Mapping[str, float]
    sample_units: Mapping[str, float]
    corners: int
    samples: int
    held_out: HeldOut | None
    tilt_rad: float  #: against the projector's axis
    depth_mm: float  #: of the board's middle, along the projector's axis
    notes: tuple[str, ...]


@dataclass(frozen=True)
class Evidence:
    """All that a person needs to trust a calibration, or not: plain figures and words.

    `verdict` is "good", "usable" or "do not use"; `good`, `weak` and `next` say why and what to photograph next.
    """

    verdict: str
    good: tuple[str, ...]
    weak: tuple[str, ...]
    next: tuple[str, ...]
    fields: tuple[FieldTest, ...]
    coverage: tuple[Coverage, ...]
    poses: tuple[PoseFigures, ...]
    correlations: tuple[tuple[str, str, float], ...]  #: pairs of parameters, |rho| largest first
    prediction: Prediction | None
    figures: Mapping[str, float] = field(default_factory=dict)
    filled: Filled | None = None
