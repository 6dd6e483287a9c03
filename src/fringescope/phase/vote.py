"""Neighbours vote on single wrong orders, and confirm or contradict the uncertain ones (equation 5)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fringescope import calm, memory
from fringescope.kernels import votes as k
from fringescope.settings import PhaseSettings
from fringescope.types import F32, U16, Decoded, Reason

CONFIRMATIONS = 3  #: rounds in which pixels that are certain confirm uncertain neighbours
ORDER = 0.99 * math.pi  #: phases of neighbours that differ by less are of one order, whatever their slope

_UNCERTAIN = np.uint16(Reason.ORDER_UNCERTAIN)
_WEAK = np.uint16(Reason.DARK | Reason.LOW_MODULATION | Reason.SATURATED)


class Vote(NamedTuple):
    """Rows and columns of the pixels whose order was changed, and the steps of the phase (see `calm.steps_of`)."""

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    steps: F32


def vote_on_orders(decoded: Decoded, s: PhaseSettings) -> Vote:
    """The neighbours' vote on the orders of a view's one direction, in place.

    `reasons` tells the orders that are uncertain, and may tell more. Darkness and low modulation outweigh an uncertain
    order, darkness also frames that do not fit.
    """
    d = decoded.directions[0]
    if s.order_votes > 1:
        out = elect(d.phase, d.sigma, decoded.reasons, s)
    else:
        out = Vote(np.zeros(0, np.int64), np.zeros(0, np.int64), calm.steps_of(d.phase))
    k.outweigh(decoded.reasons, _UNCERTAIN, _WEAK, np.uint16(Reason.DARK), np.uint16(Reason.INCONSISTENT))
    return out


def elect(phase: F32, sigma: F32, reasons: U16, s: PhaseSettings) -> Vote:
    """Repair single wrong orders by the vote of the neighbours, in place.

    `reasons` has the bit of an uncertain order where it is, afterwards where it stays so. Three rounds among all
    trusted pixels change orders that a majority contradicts. In the last rounds only pixels that are certain vote: they
    confirm, or fail to confirm, the orders of the others. A region that is uncertain as a whole stays so.
    """
    radius = s.order_votes // 2
    least = max(3, (2 * radius + 1) ** 2 // 4)
    trusted = (phase, sigma, np.float32(s.max_sigma_rad))
    rules = (radius, least, s.order_majority, _usual_slope(*trusted))
    steps = calm.steps_of(phase)
    one_mind = 2 * radius * calm.rise(steps) < calm.SAFE * ORDER
    doubtful = calm.widened(~one_mind, 4 * radius) | (calm.cover_of(reasons) != calm.WHOLE)
    weak = calm.cover_of(reasons, int(_WEAK)) == calm.VOID
    matters = calm.widened(~weak, 7 * radius)  # as far as all rounds carry a vote
    watched = doubtful & matters
    some, ever = np.empty(watched.shape, np.bool_), np.zeros(watched.shape, np.bool_)
    if not watched.any():
        return Vote(np.zeros(0, np.int64), np.zeros(0, np.int64), steps)
    asked, doubt, moved = (memory.empty(phase.shape, np.uint8) for _ in range(3))
    doubt[:] = moved[:] = 0
    changed = memory.empty(phase.shape, np.int8)
    k.torn(*trusted, reasons, _WEAK, radius, ORDER, watched, asked, changed, some)
    nobody = np.zeros((0, 0), np.uint8)
    for n in range(3):
        if not some.any():
            break
        looked, mark = some.copy(), np.uint8(1 << n)
        k.poll(*trusted, nobody, asked, looked, *rules, changed)
        k.move(changed, asked, looked, _UNCERTAIN, mark, phase, reasons, moved, some)
        if some.any():
            ever |= some
            some = calm.widened(some, radius)
            k.near(moved, mark, radius, some, asked)  # elsewhere the vote would be the same again
    k.doubts(sigma, trusted[2], reasons, _UNCERTAIN, _WEAK, changed, watched, doubt, some)
    for _ in range(CONFIRMATIONS):
        if not some.any():
            break
        looked = some.copy()
        k.poll(*trusted, doubt, doubt, looked, *rules, changed)
        k.confirm(changed, doubt, looked, some)
        some = looked & calm.widened(some, radius)  # elsewhere the vote would be the same again
    k.note_doubts(doubt, watched, _UNCERTAIN, reasons)
    if ever.any():
        calm.update_steps(phase, calm.widened(ever, 1), steps)
    rows, columns = k.collect(moved, ever)
    return Vote(rows, columns, steps)


def _usual_slope(phase: F32, sigma: F32, most: np.float32) -> float:
    """Largest believable phase slope, radians per pixel: four times the usual one of trusted pixels, at most 1.2."""
    stride = max(1, math.isqrt(phase.size // 10_000))  # enough for a median
    usual = max(float(k.usual_step(phase, sigma, most, stride, down, 1 - down)) for down in (0, 1))
    return min(max(4 * usual, 0.2), 1.2)
