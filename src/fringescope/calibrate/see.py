"""One picture of the board: corners, white squares and the projector's phase on them, in the board's numbering."""

from __future__ import annotations

import numpy as np

from fringescope.calibrate import corners, markers, numbering, squares
from fringescope.calibrate.lattice import homography
from fringescope.calibrate.picture import equalise
from fringescope.errors import CalibrationError
from fringescope.settings import BoardSettings
from fringescope.types import F32, F64, Board, Decoded, Reason, Sighting, ViewPlan


def see(
    decoded: Decoded, image: F32, plan: ViewPlan, board: Board, pose: str, s: BoardSettings | None = None
) -> Sighting:
    """What one camera saw of the board in one pose (III-B, Fig. 4).

    `image` (H, W) is the mean of the view's fringe frames in codes, raw if the sensor has a mosaic; `decoded` has
    absolute phases along one direction or more (its `sets` are not used). With two directions the white squares'
    centres get the projector's coordinate; with one, only the samples carry phases. Raises CalibrationError if there is
    no board in the picture, another one than described, or if it is blurred or mirrored.
    """
    s = s or BoardSettings()
    name = f"{pose}/{plan.camera}"
    if image.shape != decoded.shape:
        raise CalibrationError(f"{name}: picture {image.shape}, phases {decoded.shape}; needed one size")
    even, weights = equalise(np.ascontiguousarray(image, dtype=np.float32), plan.pixel_format)
    saturated = (decoded.reasons & int(Reason.SATURATED)) != 0
    found = corners.find(even, weights, saturated, board, name, s)
    turn, notes = (markers if board.dictionary else numbering).number(found, even, board, name)
    white = squares.measure(even, decoded, found, board, s)
    _not_mirrored(white.square_px, white.square_uv, name)
    return Sighting(
        pose,
        plan.camera,
        (image.shape[1], image.shape[0]),
        turn.corner(found.index),
        found.px,
        found.sigma,
        turn.square(white.square),
        white.square_px,
        white.square_uv,
        white.square_sigma,
        np.array([d.g for d in decoded.directions], dtype=np.float64).reshape(-1, 2),
        white.sample_px,
        white.sample_phase,
        white.sample_sigma,
        (*found.words, *notes, *white.words),
    )


def _not_mirrored(px: F64, uv: F64, name: str) -> None:
    """Raise CalibrationError if the projector's plane runs mirrored in the picture: both look at one side of it."""
    if len(px) < 4 or np.linalg.matrix_rank(px - px.mean(0), tol=1.0) < 2:
        return
    H = homography(px, uv)
    c = px.mean(0)
    q = (H @ np.array([[c[0], c[1], 1], [c[0] + 1, c[1], 1], [c[0], c[1] + 1, 1]]).T).T
    p = q[:, :2] / q[:, 2:]
    if np.linalg.det(p[1:] - p[0]) < 0:
        raise CalibrationError(
            f"{name}: the projector's coordinates run mirrored in this picture; the camera's pictures are mirrored or "
            "the projector shows its patterns mirrored: turn the flip off"
        )
