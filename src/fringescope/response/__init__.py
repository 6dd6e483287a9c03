"""The response of camera and projector together (gamma, saturation): measured, judged, and corrected by a table (II-C).

`from_staircase`, `from_fringes`, `from_sets` and `from_exponents` measure a `Response`; `corrected` frees measured
phases from its error before their orders are settled; `predistortion` is the table that makes the projector linear.
"""

from fringescope.response.judge import as_drawn, from_exponents, from_fringes, from_sets
from fringescope.response.model import (
    correct,
    curve,
    drawn_to_power,
    gamma_harmonics,
    greatest_error,
    harmonics_at,
    inverse_curve,
    phase_error,
    predicted_errors,
    predistortion,
    table,
)
from fringescope.response.noise import corrected, residual_power
from fringescope.response.ripple import Ripple, plane_ripple
from fringescope.response.staircase import from_staircase

__all__ = [
    "Ripple",
    "as_drawn",
    "correct",
    "corrected",
    "curve",
    "drawn_to_power",
    "from_exponents",
    "from_fringes",
    "from_sets",
    "from_staircase",
    "gamma_harmonics",
    "greatest_error",
    "harmonics_at",
    "inverse_curve",
    "phase_error",
    "plane_ripple",
    "predicted_errors",
    "predistortion",
    "residual_power",
    "table",
]
