"""Form fits with robust statistics, repeatability and calibrated uncertainty (III-E, IV-A, IV-B).

Everything takes arrays in world mm and returns frozen results; lengths in results carry their unit in the name
(`_mm`, `_um`). A point farther than `band_mm` from the fitted form is a flying point: it is counted, and no other
figure of the form contains it.
"""

from fringescope.evaluate.agreement import Agreement, PairAgreement, agreement
from fringescope.evaluate.board import BoardTrueness, board_trueness, corners_in_space
from fringescope.evaluate.drift import Verdict, judge
from fringescope.evaluate.epipolar import EpipolarResidual, epipolar_residual
from fringescope.evaluate.plane import PlaneFit, fit_plane, measure_plane
from fringescope.evaluate.repeat import Repeatability, repeatability
from fringescope.evaluate.sphere import SphereFit, fit_sphere, fit_spheres
from fringescope.evaluate.statistics import (
    BAND_MM,
    Spread,
    along_rays,
    neighbour_correlation,
    sigma_ratio,
    spread,
    tile_form,
)
from fringescope.evaluate.verdict import Evaluation, evaluate

__all__ = [
    "BAND_MM",
    "Agreement",
    "BoardTrueness",
    "EpipolarResidual",
    "Evaluation",
    "PairAgreement",
    "PlaneFit",
    "Repeatability",
    "SphereFit",
    "Spread",
    "Verdict",
    "agreement",
    "along_rays",
    "board_trueness",
    "corners_in_space",
    "epipolar_residual",
    "evaluate",
    "fit_plane",
    "fit_sphere",
    "fit_spheres",
    "judge",
    "measure_plane",
    "neighbour_correlation",
    "repeatability",
    "sigma_ratio",
    "spread",
    "tile_form",
]
