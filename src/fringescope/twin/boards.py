"""Calibration boards as the contract names them: chequerboard and ChArUco, with their reflectance at any point."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fringescope.errors import UsageError
from fringescope.twin.textures import Colour
from fringescope.types import F64, U8

WHITE: Colour = (0.80, 0.80, 0.78)
BLACK: Colour = (0.045, 0.045, 0.05)


@dataclass(frozen=True, eq=False)
class Board:
    """Squares of `square_mm`, `columns` x `rows`, the top-left one black, on a white sheet `margin_mm` wider.

    Board coordinates: origin at the first inner corner, x along the columns, y down the rows, z into the board.
    `markers`: per square (row, column) an (k, k) 0/255 picture, `marker_mm` wide, in its centre (white squares only).
    """

    columns: int
    rows: int
    square_mm: float
    margin_mm: float
    spec: dict[str, Any]
    marker_mm: float = 0.0
    markers: tuple[tuple[int, int, U8], ...] = ()

    @property
    def extent(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Sheet limits ((x0, x1), (y0, y1)) in board coordinates."""
        s, m = self.square_mm, self.margin_mm
        return (-s - m, (self.columns - 1) * s + m), (-s - m, (self.rows - 1) * s + m)

    def albedo(self, points: F64) -> F64:
        """Reflectance (n, 3) at board coordinates (n, 3); exact edges."""
        s = self.square_mm
        c, r = np.floor(points[:, 0] / s).astype(int) + 1, np.floor(points[:, 1] / s).astype(int) + 1
        on = (c >= 0) & (r >= 0) & (c < self.columns) & (r < self.rows)
        black = on & ((c + r) % 2 == 0)
        for row, column, picture in self.markers:
            k = np.flatnonzero((c == column) & (r == row))
            x0, y0 = (column - 0.5) * s - self.marker_mm / 2, (row - 0.5) * s - self.marker_mm / 2
            n = len(picture)
            i = np.floor((points[k, 0] - x0) / self.marker_mm * n).astype(int)
            j = np.floor((points[k, 1] - y0) / self.marker_mm * n).astype(int)
            inside = (i >= 0) & (j >= 0) & (i < n) & (j < n)
            black[k[inside]] = picture[j[inside], i[inside]] == 0
        return np.where(black[:, None], BLACK, WHITE)


def checkerboard(inner_corners: tuple[int, int] = (11, 8), square_mm: float = 5.0, margin_mm: float = 6.0) -> Board:
    """A chequerboard of `inner_corners` (columns, rows)."""
    spec = {"pattern": "checkerboard", "inner_corners": list(inner_corners), "square_mm": square_mm}
    return Board(inner_corners[0] + 1, inner_corners[1] + 1, square_mm, margin_mm, spec)


def charuco(
    squares: tuple[int, int] = (12, 9),
    square_mm: float = 5.0,
    marker_mm: float = 3.7,
    dictionary: str = "DICT_5X5_100",
    margin_mm: float = 6.0,
) -> Board:
    """A ChArUco board of `squares` (columns, rows); markers row by row in the white squares, as OpenCV counts them."""
    if not hasattr(cv2.aruco, dictionary):
        raise UsageError(f"ArUco dictionary '{dictionary}' is unknown; needed a name such as DICT_5X5_100")
    words = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    n = words.markerSize + 2
    white = [(r, c) for r in range(squares[1]) for c in range(squares[0]) if (r + c) % 2 == 1]
    if len(white) > len(words.bytesList):
        raise UsageError(
            f"{dictionary} has {len(words.bytesList)} markers; a {squares[0]} x {squares[1]} board needs {len(white)}"
        )
    markers = tuple((r, c, np.asarray(cv2.aruco.generateImageMarker(words, k, n))) for k, (r, c) in enumerate(white))
    spec = {
        "pattern": "charuco",
        "squares": list(squares),
        "square_mm": square_mm,
        "marker_mm": marker_mm,
        "dictionary": dictionary,
    }
    return Board(squares[0], squares[1], square_mm, margin_mm, spec, marker_mm, markers)
