"""Frames, as they come, to wrapped phases with sigma; HDR brackets merged, saturated samples left out."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from fringescope.errors import CaptureError
from fringescope.kernels import fringes as k
from fringescope.kernels import statistics
from fringescope.phase.noise import estimate_noise
from fringescope.phase.sums import FringeSums, GrayBits, Measured, intensity, rescue
from fringescope.settings import PhaseSettings
from fringescope.types import (
    U16,
    AnyArray,
    Decoded,
    FrameKey,
    FringeSet,
    NoiseModel,
    Reason,
    ViewPlan,
    WrappedSet,
)


def measure(
    frames: Iterable[tuple[FrameKey, AnyArray]], plan: ViewPlan, s: PhaseSettings, noise: NoiseModel | None = None
) -> Decoded:
    """Frames, as they come, to wrapped phases with sigma; `directions` is still empty (see `settle_order`).

    Raises CaptureError if frames are missing, doubled or of different sizes.
    """
    top = plan.pixel_format.full_scale
    sums: dict[int, FringeSums] = {}
    bits: dict[int, GrayBits] = {}
    done: dict[int, Measured] = {}
    for key, frame in frames:
        one = plan.sets[key.set_index]
        if isinstance(one, FringeSet):
            acc = sums.setdefault(key.set_index, FringeSums(one, top))
            acc.add(key.number, intensity(frame, plan.pixel_format))
            if acc.complete:
                done[key.set_index] = acc.finish()
        else:
            bits.setdefault(key.set_index, GrayBits(one)).add(
                key.role, key.number, intensity(frame, plan.pixel_format)
            )
    for i, one in enumerate(plan.sets):
        if i not in done and i not in bits:
            if i in sums:
                sums[i].finish()  # raises and names the missing frames
            raise CaptureError(f"view '{plan.camera}': no frames came for set {i + 1} of {len(plan.sets)} ({one})")
    measured = rescue([done[i] for i in sorted(done)])
    shapes = {m.phase.shape for m in measured} | {b.shape for b in bits.values()}
    if len(shapes) > 1:
        sizes = ", ".join(f"{c} x {r}" for r, c in sorted(shapes))
        raise CaptureError(f"view '{plan.camera}': sets of different sizes: {sizes}; needed one size")
    noise = noise or estimate_noise(measured, top)
    gray = tuple(bits[i].finish(noise) for i in sorted(bits))
    sets = _merge([(m, _with_sigma(m, noise, s)) for m in measured])
    if sets:
        finest = min(sets, key=lambda w: statistics.median(w.sigma.ravel()) / math.hypot(*w.g))
        background, modulation = finest.background, finest.modulation
        reasons = np.zeros(background.shape, np.uint16)
        for w in sets:
            reasons[w.misfit > s.max_misfit] |= np.uint16(Reason.INCONSISTENT)
    else:
        background = modulation = gray[0].contrast
        reasons = np.zeros(background.shape, np.uint16)
    return Decoded(plan.camera, (), tuple(sets), gray, background, modulation, reasons, noise)


def _with_sigma(m: Measured, noise: NoiseModel, s: PhaseSettings) -> WrappedSet:
    sigma, lost = np.empty_like(m.phase), np.empty(m.phase.shape, np.uint8)
    allowed = int(s.max_saturated * m.steps)
    k.phase_sigma(
        m.phase, m.background, m.modulation, m.clipped, m.steps, noise.a, noise.b, allowed, sigma, lost
    )
    if m.lent is not None:  # two samples fix cos and sin; the lent background adds its share: twice the usual formula
        lent = m.lent & (lost <= allowed)
        v = noise.variance(m.background[lent])
        sigma[lent] = np.sqrt(2 * v) / np.maximum(m.modulation[lent], 1e-6)
    misfit = np.sqrt(m.variance / noise.variance(m.background))
    gx, gy = m.fringe_set.cycles_per_pixel
    return WrappedSet(
        (float(gx), float(gy)), m.steps, m.phase, m.background, m.modulation, sigma, lost, misfit
    )


def _merge(measured: Sequence[tuple[Measured, WrappedSet]]) -> list[WrappedSet]:
    """HDR: sets of equal g and different exposure become one, per pixel by sigma."""
    groups: dict[tuple[float, ...], list[WrappedSet]] = {}
    for i, (m, w) in enumerate(measured):
        alone = m.fringe_set.exposure_us is None
        groups.setdefault((*w.g, float(i) if alone else -1.0), []).append(w)
    out = []
    for group in groups.values():
        if len(group) == 1:
            out.append(group[0])
            continue
        first = group[0]
        merged = np.empty((5, *first.phase.shape), np.float32)
        stack = [np.stack([getattr(w, name) for w in group]) for name in ("phase", "background", "modulation", "sigma")]
        k.merge_brackets(*stack, merged)
        phase, background, modulation, sigma, best = merged
        pick = best.astype(np.intp)[None]
        saturated = np.take_along_axis(np.stack([w.saturated for w in group]), pick, 0)[0]
        misfit = np.take_along_axis(np.stack([w.misfit for w in group]), pick, 0)[0]
        out.append(WrappedSet(first.g, first.steps, phase, background, modulation, sigma, saturated, misfit))
    return out


def with_reasons(decoded: Decoded, reasons: U16) -> Decoded:
    """The same decoded view with other reasons (H, W)."""
    return replace(decoded, reasons=reasons)


def room_for(part: Decoded, height: int) -> Decoded:
    """Room for a view of `height` rows of which `part` is a band: uninitialised; no wrapped sets, codes or margins."""
    shape = (height, part.shape[1])
    none = np.broadcast_to(np.float32(np.nan), shape)
    directions = tuple(
        replace(d, phase=np.empty(shape, np.float32), sigma=np.empty(shape, np.float32), order_margin=none)
        for d in part.directions
    )
    A, B, reasons = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.uint16)
    return replace(part, directions=directions, sets=(), gray=(), background=A, modulation=B, reasons=reasons)


def put_rows(whole: Decoded, part: Decoded, first: int, last: int, row: int) -> None:
    """Copies rows first to last - 1 of a band into `whole` (see `room_for`), where they begin at `row`."""
    to, rows = slice(row, row + last - first), slice(first, last)
    for d, e in zip(whole.directions, part.directions, strict=True):
        d.phase[to], d.sigma[to] = e.phase[rows], e.sigma[rows]
    whole.background[to], whole.modulation[to] = part.background[rows], part.modulation[rows]
    whole.reasons[to] = part.reasons[rows]
