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
    """One solved number: of which device (or "board"), its name (fx, k1, ..), value, standard deviation, unit."""

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
