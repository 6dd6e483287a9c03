"""Wrapped phases to absolute phases (equation 5): the order by all sets and codes, the rig, the neighbours' vote."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from fringescope import geometry
from fringescope.errors import DecodeError
from fringescope.kernels import fringes as k
from fringescope.kernels import statistics
from fringescope.phase.vote import elect
from fringescope.settings import PhaseSettings
from fringescope.types import (
    F32,
    F64,
    U16,
    Decoded,
    Direction,
    FringeSet,
    GrayCode,
    Reason,
    Rig,
    ViewPlan,
    WrappedSet,
)

MOST_REPEATS = 2.5  #: of what the sets tell apart, that a ray may cross in the measuring space
LEAST_SYSTEMATIC = 0.005  #: rad; less is not believed of any fringes
MOST_MISS = 2.5  #: systematic errors, amplified by the ratio of the periods, by which a set may miss all over
PARALLEL_RAD = 1e-4  #: sets whose gradients differ less than this in angle (either sign) unwrap each other


def families(sets: Sequence[WrappedSet]) -> list[list[WrappedSet]]:
    """Sets grouped by direction (parallel within 1e-4 rad, either sign), each group coarse to fine.

    Sets that point the other way than the finest of their group are turned round (phase and gradient negated).
    """
    groups: list[list[WrappedSet]] = []
    for w in sorted(sets, key=lambda w: -math.hypot(*w.g)):
        for group in groups:
            a, b = group[0].g, w.g
            na, nb = math.hypot(*a), math.hypot(*b)
            if abs(a[0] * b[1] - a[1] * b[0]) < PARALLEL_RAD * na * nb:
                if a[0] * b[0] + a[1] * b[1] < 0:
                    w = replace(w, g=(-b[0], -b[1]), phase=-w.phase)
                group.append(w)
                break
        else:
            groups.append([w])
    return [g[::-1] for g in groups]


def field_bounds(g: tuple[float, float], plane: tuple[int, int], margin: float = 0.01) -> tuple[float, float]:
    """Smallest and largest phase of gradient `g` on the projector plane, grown by `margin` of the extent, radians."""
    corners = [(u, v) for u in (-0.5, plane[0] - 0.5) for v in (-0.5, plane[1] - 0.5)]
    phi = [2 * math.pi * (g[0] * u + g[1] * v) for u, v in corners]
    grow = margin * (max(phi) - min(phi))
    return min(phi) - grow, max(phi) + grow


def unambiguous_span(group: Sequence[WrappedSet] | Sequence[FringeSet], tolerance_rad: float) -> float:
    """Length along the gradient, plane units, over which the sets of one direction tell every order apart.

    The smallest shift by whole coarsest periods that no finer set contradicts by more than `tolerance_rad`;
    infinity where there is none within 1000 periods.
    """
    f = [math.hypot(*(w.g if isinstance(w, WrappedSet) else w.cycles_per_pixel)) for w in group]
    x = np.arange(1, 1001) / f[0]
    alike = np.ones(len(x), np.bool_)
    for fi in f[1:]:
        alike &= np.abs(x * fi - np.round(x * fi)) * 2 * math.pi < tolerance_rad
    return float(x[np.argmax(alike)]) if alike.any() else math.inf


def settle_order(
    decoded: Decoded, plan: ViewPlan, s: PhaseSettings, rig: Rig | None = None, volume_margin: float = 1.25
) -> Decoded:
    """Wrapped phases to absolute phases, one `Direction` per fringe direction (equation 5, [33]).

    Without a rig the projector's field bounds the orders. With a rig each camera ray bounds them by its way through the
    measuring volume: this settles coarsest periods that wrap inside the field. Among the orders that are possible the
    one with the least chi squared over all sets and Gray codes wins; neighbours then vote on single wrong orders.
    Raises DecodeError if a direction has neither sets nor code that span the field (without a rig).
    """
    out: list[Direction] = []
    notes: list[str] = []
    reasons = decoded.reasons.copy()
    used: set[int] = set()
    for group in families(decoded.sets):
        g = group[-1].g
        gray, half, soft = _gray_phase(decoded.gray, group[-1], used)
        if rig is None:
            lo, hi = field_bounds(g, plan.projector_size)
            bounds = np.broadcast_to(np.array([lo, hi, lo, hi])[:, None, None], (4, 2, 2)).copy()
            span = unambiguous_span(group, 4 * s.systematic_rad)
            field = (hi - lo) / (2 * math.pi * math.hypot(*g))
            if gray is None and span < 0.7 * field:
                raise DecodeError(
                    f"view '{plan.camera}': the sets along ({g[0]:.4g}, {g[1]:.4g}) repeat after {span:.0f} projector "
                    f"units, the field is {field:.0f}; add a coarser period or a Gray code, or give a rig"
                )
        else:
            bounds = geometry.phase_bounds(rig, rig.camera(plan.camera), g, volume_margin)
            if gray is None:
                _check_repeats(group, bounds, plan.camera, s)
        trial = _trial(group, bounds, gray, half, soft, s)
        notes += trial.notes
        direction, bad = _unwrap(group, bounds, gray, half, soft, replace(s, systematic_rad=trial.systematic_rad))
        if rig is not None:  # no order leads into the measuring space
            lost = ~np.isfinite(direction.phase) & np.isfinite(direction.sigma)
            bad[lost] = np.uint16(Reason.OUT_OF_VOLUME)
        out.append(direction)
        reasons |= bad
    for i, code in enumerate(decoded.gray):
        if i not in used:
            direction, bad = _from_gray(code)
            out.append(direction)
            reasons |= bad
    return replace(decoded, directions=tuple(out), reasons=reasons, notes=(*decoded.notes, *notes))


class Trial(NamedTuple):
    """What a trial on some pixels says of parallel sets: errors of their phases beyond noise, and words for people."""

    systematic_rad: float
    notes: tuple[str, ...]


def trial(decoded: Decoded, plan: ViewPlan, s: PhaseSettings, rig: Rig, volume_margin: float) -> Trial:
    """How well the parallel sets of a view (one direction, no Gray code) fit each other; see `Trial`.

    Raises DecodeError where they repeat too often within the measuring space.
    """
    group = families(decoded.sets)[0]
    bounds = geometry.phase_bounds(rig, rig.camera(plan.camera), group[-1].g, volume_margin)
    _check_repeats(group, bounds, plan.camera, s)
    return _trial(group, bounds, None, 0.0, 0.0, s)


def _trial(
    group: Sequence[WrappedSet], bounds: F64, gray: F32 | None, half: float, soft: float, s: PhaseSettings
) -> Trial:
    """See `Trial`. Pure fringes earn a smaller systematic error than `systematic_rad`, if they need it.

    The errors are judged by how each set misses what the next coarser one predicts, where both are clear.
    """
    usual = Trial(s.systematic_rad, ())
    if len(group) < 2:
        return usual
    cut = (slice(None, None, max(1, math.isqrt(group[0].phase.size // 10_000)) | 1),) * 2
    thin = [replace(w, phase=w.phase[cut].copy(), sigma=w.sigma[cut].copy()) for w in group]
    code = None if gray is None else np.ascontiguousarray(gray[cut])
    absolute, margin = _search(thin, bounds, code, half, soft, s)
    ok = np.isfinite(absolute)
    for w in thin:
        ok &= w.sigma < 0.2
    if ok.sum() < 200:
        return usual
    f = [math.hypot(*w.g) for w in thin]
    phi = absolute[ok].astype(np.float64)
    off = [_wrapped(w.phase[ok] - phi * (fk / f[-1])) for w, fk in zip(thin, f, strict=True)]
    notes: list[str] = []
    systematic = 0.0
    for n in range(1, len(thin)):
        ratio = f[n] / f[n - 1]
        rest = _wrapped(off[n] - off[n - 1] * ratio)
        middle, reach = statistics.middle_and_reach(rest, 0.9)
        spread = reach / 1.645
        noise = float(statistics.median(np.hypot(thin[n - 1].sigma[ok] * ratio, thin[n].sigma[ok])))
        systematic = max(systematic, math.sqrt(max(spread**2 - noise**2, 0.0) + middle**2) / math.hypot(ratio, 1.0))
        period, other = 1 / f[n], 1 / f[n - 1]
        if noise < 0.5 and spread > 1.5:
            notes.append(
                f"the fringes of period {period:.4g} have nothing to do with what those of {other:.4g} predict: look "
                "for frames out of order, a wrong period or a wrong sign"
            )
        elif abs(middle) > max(MOST_MISS * s.systematic_rad * ratio, 0.6) and spread < 1.5:
            notes.append(
                f"the fringes of period {period:.4g} miss what those of {other:.4g} predict by {middle:.2f} rad all "
                "over: are their steps in order, and none left out?"
            )
    needed = float(np.mean(margin[ok] < s.order_min_margin)) > 0.02
    if needed and not notes and systematic < s.systematic_rad:
        return Trial(max(1.3 * systematic, LEAST_SYSTEMATIC), ())
    return Trial(s.systematic_rad, tuple(notes))


def _wrapped(a: F64) -> F64:
    return np.asarray(a - 2 * math.pi * np.round(a / (2 * math.pi)))


def _check_repeats(group: Sequence[WrappedSet], bounds: F64, camera: str, s: PhaseSettings) -> None:
    g = group[-1].g
    span = unambiguous_span(group, 4 * s.systematic_rad)
    room = float(statistics.median((bounds[3] - bounds[2]).ravel())) / (2 * math.pi * math.hypot(*g))
    if room > MOST_REPEATS * span:
        raise DecodeError(
            f"view '{camera}': the sets along ({g[0]:.4g}, {g[1]:.4g}) repeat after {span:.0f} projector "
            f"units, a ray crosses {room:.0f} in the measuring space; add a coarser period or a Gray code, or "
            f"give the rig a smaller volume"
        )


def _unwrap(
    group: Sequence[WrappedSet], bounds: F64, gray: F32 | None, half: float, soft: float, s: PhaseSettings
) -> tuple[Direction, U16]:
    absolute, margin = _search(group, bounds, gray, half, soft, s)
    uncertain = np.uint16(Reason.ORDER_UNCERTAIN)
    reasons = np.where(margin >= s.order_min_margin, np.uint16(0), uncertain)
    if s.order_votes > 1:
        elect(absolute, group[-1].sigma, reasons, s)
    reasons[~np.isfinite(absolute)] |= uncertain
    return Direction(group[-1].g, absolute, group[-1].sigma, margin), reasons


def _search(
    group: Sequence[WrappedSet], bounds: F64, gray: F32 | None, half: float, soft: float, s: PhaseSettings
) -> tuple[F32, F32]:
    """The absolute phase of the finest set by all sets and the code of each pixel alone, and its margin."""
    phases = np.stack([w.phase for w in group])
    sigmas = np.stack([np.hypot(w.sigma, np.float32(s.systematic_rad)) for w in group])
    freq = np.array([math.hypot(*w.g) for w in group])
    absolute, margin = np.empty_like(phases[0]), np.empty_like(phases[0])
    none = np.zeros((0, 0), np.float32)
    unexpected = s.unexpected_sigma**2
    k.unwrap(phases, sigmas, freq, bounds, unexpected, none if gray is None else gray, half, soft, absolute, margin)
    return absolute, margin


def _gray_phase(codes: Sequence[GrayCode], fine: WrappedSet, used: set[int]) -> tuple[F32 | None, float, float]:
    """The finest phase at the middle of each pixel's Gray cell, half a cell and the softness of its edge, radians.

    A code is misread where a pixel straddles the edge of a cell: within about one and a half pixels of it.
    """
    g = fine.g
    best: tuple[F32 | None, float, float] = (None, 0.0, 0.0)
    cell = math.inf
    for i, code in enumerate(codes):
        along, across = (g[0], g[1]) if code.axis == "u" else (g[1], g[0])
        if abs(across) > PARALLEL_RAD * abs(along):
            continue
        used.add(i)
        if code.cell < cell:
            cell = code.cell
            u = -0.5 + (code.value + 0.5) * code.cell
            phase = np.where(code.value >= 0, 2 * math.pi * along * u, np.nan).astype(np.float32)
            half = math.pi * abs(along) * code.cell
            best = (phase, half, min(0.1 * half + 0.3, _per_pixel(fine)))
    return best


def _per_pixel(w: WrappedSet) -> float:
    """Half of how far the phase usually goes from pixel to pixel (nine in ten go less), and its noise, radians."""
    stride = max(1, math.isqrt(w.phase.size // 60_000))
    sigma = w.sigma[::stride, ::stride]
    if not (sigma < 0.3).any():
        return math.inf
    step = 0.0
    for axis, cut in ((1, (slice(None, None, stride), slice(None))), (0, (slice(None), slice(None, None, stride)))):
        a = np.diff(np.where(w.sigma[cut] < 0.3, w.phase[cut], np.nan), axis=axis)
        a = a[np.isfinite(a)]
        turned = np.abs(a - 2 * math.pi * np.round(a / (2 * math.pi)))
        step = max(step, float(np.quantile(turned, 0.9))) if turned.size else step
    return 0.5 * step + float(np.median(sigma[sigma < 0.3])) + 0.02


def _from_gray(code: GrayCode) -> tuple[Direction, U16]:
    """A Gray code alone is a direction too: one cycle per cell, uniform within the cell."""
    g = (1.0 / code.cell, 0.0) if code.axis == "u" else (0.0, 1.0 / code.cell)
    u = -0.5 + (code.value + 0.5) * code.cell
    phase = np.where(code.value >= 0, 2 * math.pi * u / code.cell, np.nan).astype(np.float32)
    sigma = np.full(phase.shape, 2 * math.pi / math.sqrt(12), np.float32)
    reasons = np.where(code.value >= 0, np.uint16(0), np.uint16(Reason.ORDER_UNCERTAIN))
    return Direction(g, phase, sigma, np.full(phase.shape, 99, np.float32)), reasons.astype(np.uint16)


def projector_coordinates(decoded: Decoded) -> tuple[F32, F32]:
    """Projector-plane coordinates u, v (H, W) of every pixel, without a rig; NaN where the directions do not tell.

    Two or more directions give both (least squares weighted by sigma); one direction along u or v gives that one.
    """
    shape = decoded.shape
    u, v = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    d = decoded.directions
    if len(d) >= 2:
        w = [1 / np.maximum(x.sigma.astype(np.float64), 1e-6) ** 2 for x in d]
        y = [x.phase / (2 * math.pi) for x in d]
        a = np.add.reduce([wi * x.g[0] ** 2 for wi, x in zip(w, d, strict=True)])
        b = np.add.reduce([wi * x.g[0] * x.g[1] for wi, x in zip(w, d, strict=True)])
        c = np.add.reduce([wi * x.g[1] ** 2 for wi, x in zip(w, d, strict=True)])
        p = np.add.reduce([wi * x.g[0] * yi for wi, x, yi in zip(w, d, y, strict=True)])
        q = np.add.reduce([wi * x.g[1] * yi for wi, x, yi in zip(w, d, y, strict=True)])
        with np.errstate(invalid="ignore", divide="ignore"):
            det = a * c - b * b
            u, v = ((c * p - b * q) / det).astype(np.float32), ((a * q - b * p) / det).astype(np.float32)
    else:
        g = d[0].g
        if abs(g[1]) < PARALLEL_RAD * abs(g[0]):
            u = (d[0].phase / (2 * math.pi * g[0])).astype(np.float32)
        elif abs(g[0]) < PARALLEL_RAD * abs(g[1]):
            v = (d[0].phase / (2 * math.pi * g[1])).astype(np.float32)
    return u, v
