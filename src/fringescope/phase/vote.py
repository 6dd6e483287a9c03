"""Neighbours vote on single wrong orders, and confirm or contradict the uncertain ones (equation 5)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fringescope import calm, memory
from fringescope.kernels import votes as k
from fringescope.settings import PhaseSettings
from fringescope.types import F32, U8, U16, Decoded, Reason

CONFIRMATIONS = 3  #: rounds in which pixels that are certain confirm uncertain neighbours
ORDER = 0.99 * math.pi  #: phases of neighbours that differ by less are of one order, whatever their slope

_UNCERTAIN = np.uint16(Reason.ORDER_UNCERTAIN)
_WEAK = np.uint16(Reason.DARK | Reason.LOW_MODULATION | Reason.SATURATED)
IntArray = NDArray[np.intp]


def vote_on_orders(decoded: Decoded, s: PhaseSettings) -> tuple[IntArray, IntArray] | None:
    """The neighbours' vote on the orders of a view's one direction, in place; rows and columns of orders that changed.

    `reasons` tells the orders that are uncertain, and may tell more. Darkness and low modulation outweigh an uncertain
    order, darkness also frames that do not fit.
    """
    d = decoded.directions[0]
    moved = elect(d.phase, d.sigma, decoded.reasons, s) if s.order_votes > 1 else None
    k.outweigh(decoded.reasons, _UNCERTAIN, _WEAK, np.uint16(Reason.DARK), np.uint16(Reason.INCONSISTENT))
    return moved


def elect(phase: F32, sigma: F32, reasons: U16, s: PhaseSettings) -> tuple[IntArray, IntArray] | None:
    """Repair single wrong orders by the vote of the neighbours, in place; rows and columns of those, None if none.

    `reasons` has the bit of an uncertain order where it is, afterwards where it stays so. Three rounds among all
    trusted pixels change orders that a majority contradicts. In the last rounds only pixels that are certain vote: they
    confirm, or fail to confirm, the orders of the others. A region that is uncertain as a whole stays so.
    """
    radius = s.order_votes // 2
    least = max(3, (2 * radius + 1) ** 2 // 4)
    trusted = (phase, sigma, np.float32(s.max_sigma_rad))
    rules = (radius, least, s.order_majority, _usual_slope(*trusted))
    one_mind = 2 * radius * calm.rise(calm.steps_of(phase)) < calm.SAFE * ORDER
    doubtful = calm.widened(~one_mind, 4 * radius) | (calm.cover_of(reasons) != calm.WHOLE)
    matters = calm.widened(calm.cover_of(reasons, _WEAK) != calm.VOID, 7 * radius)  # as far as all rounds carry a vote
    looked = watched = doubtful & matters
    asked, changed = memory.empty(phase.shape, np.uint8), memory.empty(phase.shape, np.int8)
    some = np.empty(looked.shape, np.bool_)
    k.torn(*trusted, reasons, _WEAK, radius, ORDER, looked, asked, changed, some)
    ever: U8 | None = None
    nobody = np.zeros((0, 0), np.uint8)
    for _ in range(3):
        if not some.any():
            break
        looked = some.copy()
        k.poll(*trusted, nobody, asked, looked, *rules, changed)
        moved = np.zeros(phase.shape, np.uint8)
        k.move(changed, asked, looked, _UNCERTAIN, phase, reasons, moved, some)
        if some.any():
            ever = moved if ever is None else ever | moved
            some = calm.widened(some, radius)
            k.near(moved, radius, some, asked)  # elsewhere the vote would be the same again
    doubt = memory.empty(phase.shape, np.uint8)
    doubt[:] = 0
    k.doubts(sigma, trusted[2], reasons, _UNCERTAIN, _WEAK, changed, watched, doubt, some)
    for _ in range(CONFIRMATIONS):
        if not some.any():
            break
        looked = some.copy()
        k.poll(*trusted, doubt, doubt, looked, *rules, changed)
        k.confirm(changed, doubt, looked, some)
        some = looked if some.any() else some
    k.note_doubts(doubt, watched, _UNCERTAIN, reasons)
    if ever is None:
        return None
    rows, columns = np.nonzero(ever)
    return rows, columns


def _usual_slope(phase: F32, sigma: F32, most: np.float32) -> float:
    """Largest believable phase slope, radians per pixel: four times the usual one of trusted pixels, at most 1.2."""
    usual = 0.0
    stride = max(1, math.isqrt(phase.size // 60_000))  # enough for a median
    for axis in (0, 1):
        if phase.shape[axis] < 2:
            continue
        here = (slice(None, -1, stride), slice(None, None, stride))[:: 1 - 2 * axis]
        there = (slice(1, None, stride), slice(None, None, stride))[:: 1 - 2 * axis]
        d = phase[there] - phase[here]
        d = d[(sigma[here] < most) & (sigma[there] < most) & np.isfinite(d)]
        if d.size:
            usual = max(usual, float(np.median(np.abs(d))))
    return min(max(4 * usual, 0.2), 1.2)
