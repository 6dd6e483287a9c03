"""What a capture says about the response: at some good pixels, the phasors of its sets and which pairs must agree."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fringescope.errors import EmptyResultError
from fringescope.response.model import C128
from fringescope.settings import ResponseSettings
from fringescope.types import (
    F64,
    AnyArray,
    Bool,
    Decoded,
    Direction,
    FrameKey,
    FringeSet,
    PixelFormat,
    Reason,
    ViewPlan,
    WrappedSet,
)

PARALLEL_RAD = 1e-4  #: sets whose gradients differ less than this in angle measure the same coordinate
TILES = 10  #: the image is cut into TILES x TILES blocks; what varies between them tells how sure a fit is
UNUSABLE = Reason.INCONSISTENT.value  #: what a strong response itself may cause and so does not speak against a pixel


@dataclass(frozen=True, eq=False)
class Observed:
    """One set at n pixels: wrapped phase, A, B, sigma (n,); `bins` (M, n) = phasors of bins 2 .. N // 2 over B."""

    g: tuple[float, float]
    steps: int
    exponent: float
    phase: F64
    background: F64
    modulation: F64
    sigma: F64
    bins: C128

    @property
    def frequency(self) -> float:
        """Cycles per plane unit."""
        return math.hypot(*self.g)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two sets that see the same projector coordinate: phase of `other` = `ratio` times phase of `fine`.

    `fine_phase` (n,) is the fine set's phase, absolute where the ratio is not whole.
    """

    other: int
    fine: int
    ratio: float
    fine_phase: F64


@dataclass(frozen=True, eq=False)
class Triple:
    """Phase and log B of one set at three places in a row, (3, n): on something smooth they change evenly."""

    of: int
    phase: F64
    log_modulation: F64
    sigma: F64
    block: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Pixels:
    """The observations at n pixels, the block of the image that each lies in, the share of pixels that saturate."""

    sets: tuple[Observed, ...]
    pairs: tuple[Pair, ...]
    triples: tuple[Triple, ...]
    block: NDArray[np.int64]
    saturated: float

    def __len__(self) -> int:
        return int(self.block.size)


def observe(
    decoded: Decoded,
    s: ResponseSettings,
    exponents: Sequence[float] = (),
    bins: Mapping[int, tuple[C128, int]] | None = None,
    smooth: bool = False,
) -> Pixels:
    """The observations of a measured view; pairs need settled orders unless both sets have one frequency.

    `exponents`: power to which each set's fringes were drawn (default 1). `bins`: from `read_bins`. `smooth`: the
    surface is, which is evidence too (else it is taken for smooth only where there is no other). Raises
    EmptyResultError where too few pixels have usable fringes.
    """
    sets = decoded.sets
    usable = _usable(decoded, s)
    cut = _stride(int(np.count_nonzero(usable)), s.max_pixels)
    pick = np.zeros_like(usable)
    pick[cut // 2 :: cut, cut // 2 :: cut] = True
    if bins:
        strides = {stride for _, stride in bins.values()}
        cut = max(strides)
        pick[:] = False
        pick[::cut, ::cut] = True
    where = np.nonzero(usable & pick)
    lit = decoded.modulation > max(s.min_contrast * float(np.median(decoded.background)), 1.0)
    clipped = np.any([w.saturated > 0 for w in sets], axis=0) & (lit | (decoded.background > 0)) if sets else ~usable
    saturated = float(clipped.sum() / max(int((lit | clipped).sum()), 1))
    if len(where[0]) < s.min_pixels:
        more = f"; {100 * saturated:.0f} % of what is lit saturates: halve the exposure" if saturated > 0.3 else ""
        raise EmptyResultError(
            f"view '{decoded.camera}': {len(where[0])} pixels have clean fringes in every set; the response needs "
            f"{s.min_pixels}: show the fringes on something bright that fills the picture{more}"
        )
    observed = tuple(
        _one(w, where, exponents[i] if exponents else 1.0, bins.get(i) if bins else None) for i, w in enumerate(sets)
    )
    H, W = decoded.shape
    block = (where[0] * TILES // H) * TILES + where[1] * TILES // W
    pairs = tuple(_pairs(decoded, observed, where))
    triples: tuple[Triple, ...] = ()
    if smooth or not (pairs or any(len(o.bins) for o in observed)):
        triples = tuple(_triples(decoded, usable, observed, s))
    return Pixels(observed, pairs, triples, block.astype(np.int64), saturated)


def _usable(decoded: Decoded, s: ResponseSettings) -> Bool:
    out = np.ones(decoded.shape, bool)
    out &= (decoded.reasons & np.uint16(0xFFFF ^ UNUSABLE)) == 0
    more_steps = any(w.steps > 3 for w in decoded.sets)  # a strong response passes for noise there
    for w in decoded.sets:
        lit = (w.saturated == 0) & (w.modulation > s.min_contrast * w.background)
        usual = float(np.median(w.sigma[lit])) if lit.any() and more_steps else 0.0
        out &= lit & (w.sigma < max(s.max_sigma_rad, min(2 * usual, 0.5)))
    for d in decoded.directions:
        out &= np.isfinite(d.phase)
    return out


def _stride(count: int, most: int) -> int:
    """Every how-manieth row and column; odd, so that every colour of a mosaic is met."""
    return max(1, math.ceil(math.sqrt(count / most)) | 1) if count > most else 1


def _one(w: WrappedSet, where: tuple[AnyArray, ...], exponent: float, bins: tuple[C128, int] | None) -> Observed:
    phase, A, B, sigma = (x[where].astype(np.float64) for x in (w.phase, w.background, w.modulation, w.sigma))
    higher = np.zeros((0, len(phase)), np.complex128)
    if bins is not None:
        coarse = (slice(None), where[0] // bins[1], where[1] // bins[1])
        higher = bins[0][coarse] / np.maximum(B, 1e-6)
    return Observed(w.g, w.steps, exponent, phase, A, B, np.maximum(sigma, 1e-4), higher)


def _same_line(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return abs(a[0] * b[1] - a[1] * b[0]) < PARALLEL_RAD * math.hypot(*a) * math.hypot(*b)


def _pairs(decoded: Decoded, sets: Sequence[Observed], where: tuple[AnyArray, ...]) -> Iterable[Pair]:
    """Each set with the finest of its direction; sets of one frequency need no order, others the settled one."""
    order = sorted(range(len(sets)), key=lambda i: -sets[i].frequency)
    taken: set[int] = set()
    for f in order:
        if f in taken:
            continue
        taken.add(f)
        fine = sets[f]
        absolute = next((_of(d, fine, where) for d in decoded.directions if _same_line(d.g, fine.g)), None)
        for i in order:
            if i in taken or not _same_line(sets[i].g, fine.g):
                continue
            dot = sets[i].g[0] * fine.g[0] + sets[i].g[1] * fine.g[1]
            ratio = dot / fine.frequency**2
            if abs(abs(ratio) - 1) < 1e-6:
                ratio = math.copysign(1.0, ratio)
                taken.add(i)
                yield Pair(i, f, ratio, fine.phase)
            elif absolute is not None:
                taken.add(i)
                yield Pair(i, f, ratio, absolute)


def _of(d: Direction, fine: Observed, where: tuple[AnyArray, ...]) -> F64:
    """The fine set's absolute phase: its own, plus the direction's whole turns."""
    sign = 1.0 if d.g[0] * fine.g[0] + d.g[1] * fine.g[1] > 0 else -1.0
    absolute = sign * d.phase[where].astype(np.float64) * (fine.frequency / math.hypot(*d.g))
    return np.asarray(fine.phase + 2 * np.pi * np.rint((absolute - fine.phase) / (2 * np.pi)))


def _triples(decoded: Decoded, usable: Bool, sets: Sequence[Observed], s: ResponseSettings) -> Iterable[Triple]:
    """Three places half a ripple apart, along the image axis in which the phase of each set runs faster."""
    H, W = usable.shape
    for i, w in enumerate(decoded.sets):
        steps = []
        for axis in (0, 1):
            ok = usable[1:] & usable[:-1] if axis == 0 else usable[:, 1:] & usable[:, :-1]
            d = np.diff(w.phase, axis=axis)[ok]
            steps.append(float(np.median(np.abs(np.angle(np.exp(1j * d))))) if d.size else 0.0)
        axis = int(steps[1] > steps[0])
        if steps[axis] <= 0:
            continue
        reach = max(1, round(math.pi / (sets[i].steps * steps[axis])))
        if 2 * reach >= usable.shape[axis]:
            continue
        at = [slice(0, -2 * reach), slice(reach, -reach), slice(2 * reach, None)]
        cuts = [(a, slice(None)) if axis == 0 else (slice(None), a) for a in at]
        y, x = np.nonzero(usable[cuts[0]] & usable[cuts[1]] & usable[cuts[2]])
        if len(y) < s.min_pixels:
            continue
        thin = slice(None, None, max(1, 4 * len(y) // s.max_pixels))
        y, x = y[thin], x[thin]
        phase = np.stack([w.phase[c][y, x] for c in cuts]).astype(np.float64)
        log = np.log(np.stack([w.modulation[c][y, x] for c in cuts]).astype(np.float64))
        sigma = np.sqrt((np.stack([w.sigma[c][y, x] for c in cuts]).astype(np.float64) ** 2).sum(0))
        block = (y * TILES // H) * TILES + x * TILES // W
        yield Triple(i, phase, log, np.maximum(sigma, 1e-4), block.astype(np.int64))


def read_bins(
    frames: Iterable[tuple[FrameKey, AnyArray]], plan: ViewPlan, pixels: int
) -> dict[int, tuple[C128, int]]:
    """Phasors of bins 2 .. N // 2 of every set of more than three steps, at every how-manieth pixel: {set number among
    the fringe sets: ((M, h, w) codes, stride)}.

    Frames are thinned as they come. Brackets of one measurement (HDR) are left out.
    """
    numbers = [i for i, x in enumerate(plan.sets) if isinstance(x, FringeSet)]
    sums: dict[int, C128] = {}
    stride = 1
    for key, frame in frames:
        one = plan.sets[key.set_index]
        if not isinstance(one, FringeSet) or one.steps < 4 or one.exposure_us is not None:
            continue
        stride = _stride(frame.shape[0] * frame.shape[1], 2 * pixels)
        thin = frame[::stride, ::stride].astype(np.float64)
        if plan.pixel_format is PixelFormat.RGB8:
            thin = thin.sum(axis=2)
        number = numbers.index(key.set_index)
        higher = np.arange(2, one.steps // 2 + 1)
        if number not in sums:
            sums[number] = np.zeros((len(higher), *thin.shape), np.complex128)
        turn = np.exp(2j * np.pi * higher * key.number / one.steps) * (2 / one.steps)
        sums[number] += turn[:, None, None] * thin
    return {i: (x, stride) for i, x in sums.items()}
