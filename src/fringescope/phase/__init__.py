"""Frames to absolute phase (II-C, equations 3 to 5): one by one into sums, then phase, noise, and the order.

Captures may hold any direction, any number of steps, HDR brackets and Gray code. Bayer frames are decoded on their raw
sites: the phase does not depend on a site's colour, so no demosaicing ever mixes pixels.
"""

from fringescope.phase.measure import measure, put_rows, room_for, with_reasons
from fringescope.phase.noise import estimate_noise
from fringescope.phase.order import (
    PARALLEL_RAD,
    families,
    field_bounds,
    projector_coordinates,
    settle_order,
    trial,
    unambiguous_span,
)
from fringescope.phase.sums import FringeSums, GrayBits, Measured, intensity, mean_picture, thinned, unpacked
from fringescope.phase.vote import vote_on_orders

__all__ = [
    "PARALLEL_RAD",
    "FringeSums",
    "GrayBits",
    "Measured",
    "estimate_noise",
    "families",
    "field_bounds",
    "intensity",
    "mean_picture",
    "measure",
    "projector_coordinates",
    "put_rows",
    "room_for",
    "settle_order",
    "thinned",
    "trial",
    "unambiguous_span",
    "unpacked",
    "vote_on_orders",
    "with_reasons",
]
