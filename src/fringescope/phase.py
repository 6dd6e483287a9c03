"""Frames to absolute phase (II-C, equations 3 to 5): one by one into sums, then phase, noise, and the order.

Captures may hold any direction, any number of steps, HDR brackets and Gray code. Bayer frames are decoded on their raw
sites: the phase does not depend on a site's colour, so no demosaicing ever mixes pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from fringescope import geometry
from fringescope.errors import CaptureError, DecodeError
from fringescope.kernels import fringes as k
from fringescope.settings import PhaseSettings
from fringescope.types import (
    F32,
    F64,
    U16,
    AnyArray,
    Decoded,
    Direction,
    FrameKey,
    FringeSet,
    GrayCode,
    GraySet,
    NoiseModel,
    PixelFormat,
    Reason,
    Rig,
    Role,
    ViewPlan,
    WrappedSet,
)

PARALLEL_RAD = 1e-4  #: sets whose gradients differ less than this in angle (either sign) unwrap each other


# ------------------------------------------------------------------------------------------------- frames into sums


def intensity(frame: AnyArray, pixel_format: PixelFormat) -> AnyArray:
    """One sample per pixel: raw Bayer and mono frames as they are, RGB as the sum of its channels (uint16).

    A pixel with one saturated channel counts as saturated: it gets the largest sum.
    """
    if frame.ndim == 2:
        return np.ascontiguousarray(frame)
    total: AnyArray = frame.astype(np.uint16).sum(axis=2, dtype=np.uint16)
    total[(frame >= pixel_format.max_value).any(axis=2)] = 3 * pixel_format.max_value
    return total


def full_scale(pixel_format: PixelFormat) -> int:
    """The code at which a sample of `intensity` is saturated."""
    return pixel_format.max_value * (3 if pixel_format is PixelFormat.RGB8 else 1)


@dataclass(frozen=True, eq=False)
class Measured:
    """One N-step set, fitted, before the noise is known. Arrays (H, W); `variance` is NaN where no sample is left over.

    `poor` lists the pixels that kept two samples only, as flat indices with their sums of I cos and I sin: no sinusoid
    of its own fits there, but one with the background of a finer set does (see `_rescue`).
    """

    fringe_set: FringeSet
    phase: F32
    background: F32
    modulation: F32
    variance: F32
    clipped: AnyArray  #: uint64, bit n = sample n was saturated
    poor: tuple[AnyArray, AnyArray, AnyArray]
    lent: AnyArray | None = None  #: true where the background is another set's

    @property
    def steps(self) -> int:
        """N."""
        return self.fringe_set.steps


class FringeSums:
    """Accumulator of one N-step set: `add` its frames in any order, then `finish`. Holds sums, never frames."""

    def __init__(self, fringe_set: FringeSet, max_value: int) -> None:
        self.fringe_set = fringe_set
        self.max_value = max_value
        self._seen: set[int] = set()
        self._sums: list[F32 | F64] = []
        self._clipped = np.zeros((0, 0), np.uint64)

    def add(self, n: int, frame: AnyArray) -> None:
        """Add frame n, (H, W) unsigned integers. Raises CaptureError for a second frame n or another size."""
        N = self.fringe_set.steps
        if n in self._seen or not 0 <= n < N:
            raise CaptureError(f"frame {n} of a {N}-step set came twice or is out of range; each of 0..{N - 1} once")
        if not self._sums:
            kind = np.float32 if self.max_value < 1024 else np.float64
            self._sums = [np.zeros(frame.shape, kind) for _ in range(4)]
            self._clipped = np.zeros(frame.shape, np.uint64)
        if frame.shape != self._clipped.shape:
            raise CaptureError(
                f"frame {n} is {frame.shape[1]} x {frame.shape[0]} pixels; the set began with "
                f"{self._clipped.shape[1]} x {self._clipped.shape[0]}"
            )
        delta = 2 * math.pi * n / N
        k.accumulate(frame, n, math.cos(delta), math.sin(delta), self.max_value, *self._sums, self._clipped)
        self._seen.add(n)

    @property
    def complete(self) -> bool:
        """Whether every frame has come."""
        return len(self._seen) == self.fringe_set.steps

    def finish(self) -> Measured:
        """The least-squares sinusoid of each pixel's unsaturated samples.

        Raises CaptureError if frames are missing.
        """
        N = self.fringe_set.steps
        missing = sorted(set(range(N)) - self._seen)
        if missing:
            raise CaptureError(f"a {N}-step set got {len(self._seen)} frames; missing {missing}")
        shape = self._clipped.shape
        phase, background, modulation, variance = (np.empty(shape, np.float32) for _ in range(4))
        k.wrap(*self._sums, self._clipped, N, phase, background, modulation, variance)
        index = np.flatnonzero(_left(self._clipped, N) == 2) if (self._clipped != 0).any() else np.zeros(0, np.intp)
        poor = (index, self._sums[1].ravel()[index], self._sums[2].ravel()[index])
        self._sums = []
        return Measured(self.fringe_set, phase, background, modulation, variance, self._clipped, poor)


def _left(clipped: AnyArray, steps: int) -> AnyArray:
    """Samples of each pixel that are not saturated."""
    return np.asarray(steps - np.bitwise_count(clipped).astype(np.int64))


def _rescue(measured: Sequence[Measured]) -> list[Measured]:
    """Two samples and the background of the set that has most samples left make a phase, good enough to tell the order."""
    out = []
    for m in measured:
        index, p, q = m.poor
        if len(index) == 0 or len(measured) == 1:
            out.append(m)
            continue
        left = np.stack([_left(o.clipped.ravel()[index], o.steps) for o in measured])
        exposure = [o.fringe_set.exposure_us == m.fringe_set.exposure_us for o in measured]
        left[~np.array(exposure)] = 0
        donor = left.argmax(0)
        A = np.choose(donor, [o.background.ravel()[index] for o in measured]).astype(np.float64)
        good = left.max(0) > 3
        n = np.arange(m.steps)
        there = ((m.clipped.ravel()[index][:, None] >> n.astype(np.uint64)) & np.uint64(1)) == 0
        cos, sin = np.cos(2 * np.pi * n / m.steps), np.sin(2 * np.pi * n / m.steps)
        m11, m12, m22 = there @ (cos * cos), there @ (cos * sin), there @ (sin * sin)
        p, q = p - A * (there @ cos), q - A * (there @ sin)
        det = m11 * m22 - m12 * m12
        good &= det > 1e-9
        index, A, det = index[good], A[good], det[good]
        c = (m22[good] * p[good] - m12[good] * q[good]) / det
        s = (m11[good] * q[good] - m12[good] * p[good]) / det
        phase, background, modulation = m.phase.copy(), m.background.copy(), m.modulation.copy()
        phase.ravel()[index] = np.arctan2(s, c)
        background.ravel()[index] = A
        modulation.ravel()[index] = np.hypot(c, s)
        lent = np.zeros(m.phase.shape, bool)
        lent.ravel()[index] = True
        out.append(replace(m, phase=phase, background=background, modulation=modulation, lent=lent))
    return out


class GrayBits:
    """Accumulator of one Gray code; frames in any order, kept until `finish` (they are few)."""

    def __init__(self, gray_set: GraySet) -> None:
        self.gray_set = gray_set
        self._frames: dict[tuple[Role, int], AnyArray] = {}

    def add(self, role: Role, n: int, frame: AnyArray) -> None:
        """Add one frame (H, W). Raises CaptureError for another size."""
        for other in self._frames.values():
            if other.shape != frame.shape:
                raise CaptureError(
                    f"a Gray code frame is {frame.shape[1]} x {frame.shape[0]} pixels; the set began with "
                    f"{other.shape[1]} x {other.shape[0]}"
                )
            break
        self._frames[role, n] = frame

    def finish(self, noise: NoiseModel) -> GrayCode:
        """Decode: each bit against its inverse, or the mean of white and black, or the mean of all bits."""
        s, f = self.gray_set, self._frames
        missing = [n for n in range(s.bits) if (Role.BIT, n) not in f]
        if missing:
            raise CaptureError(f"a Gray code of {s.bits} frames lacks {missing}")
        first = f[Role.BIT, 0]
        none = np.zeros((0, 0), first.dtype)
        if (Role.WHITE, 0) in f and (Role.BLACK, 0) in f:
            threshold = 0.5 * (f[Role.WHITE, 0].astype(np.float32) + f[Role.BLACK, 0].astype(np.float32))
        else:
            bits = [f[Role.BIT, n].astype(np.float32) for n in range(s.bits)]
            threshold = 0.5 * (np.maximum.reduce(bits) + np.minimum.reduce(bits))
        code = np.zeros(first.shape, np.int32)
        contrast = np.zeros(first.shape, np.float32)
        level = math.sqrt(noise.a + noise.b * float(np.median(threshold)))
        for n in range(s.bits):
            inverse = f.get((Role.INVERSE, n), none)
            k.gray_bit(f[Role.BIT, n], inverse, threshold.astype(np.float32), 2.0 * level, n, code, contrast)
        self._frames = {}
        return GrayCode(s.axis, s.cell, code, contrast)


# ------------------------------------------------------------------------------------------------------- the noise


def estimate_noise(measured: Sequence[Measured], max_value: int) -> NoiseModel:
    """Sensor noise `variance = a + b I` from the capture itself: the residuals about the sinusoids of sets with N > 3.

    In bins of the background the median residual (a chi-squared of N - 3 degrees of freedom) stands for the variance;
    a line through the bins gives a and b. With three steps only, the backgrounds of two sets of one exposure differ
    by noise alone and serve instead. Falls back to 0.6 codes of read noise and b = 0.03 of the 8-bit scale.
    """
    levels: list[float] = []
    variances: list[float] = []
    weights: list[float] = []
    samples: list[tuple[AnyArray, AnyArray, int]] = []
    for m in measured:
        if m.steps > 3:
            ok = m.clipped == 0
            samples.append((m.background[ok], m.variance[ok], m.steps - 3))
    if not samples:
        for m1, m2 in pairwise(measured):
            if m1.phase.shape == m2.phase.shape and m1.fringe_set.exposure_us == m2.fringe_set.exposure_us:
                ok = (m1.clipped == 0) & (m2.clipped == 0)
                A, d = m1.background[ok], (m1.background[ok] - m2.background[ok]).astype(np.float64)
                d -= np.median(d) if d.size else 0.0
                samples.append((A, d * d / (1 / m1.steps + 1 / m2.steps), 1))
    for A, v, dof in samples:
        ok = (A > 0.01 * max_value) & (A < 0.9 * max_value)
        if np.count_nonzero(ok) < 400:
            continue
        a, x = A[ok], v[ok]
        edges = np.unique(np.quantile(a, np.linspace(0, 1, 25)))
        where = np.clip(np.searchsorted(edges, a, side="right") - 1, 0, max(len(edges) - 2, 0))
        for b in range(len(edges) - 1):
            inside = where == b
            if inside.sum() >= 50:
                levels.append(float(a[inside].mean()))
                variances.append(float(np.median(x[inside])) / _chi2_median(dof))
                weights.append(float(inside.sum()) * dof)
    floor = 1.0 / 12.0
    if len(levels) < 3:
        scale = max_value / 255.0
        return NoiseModel(0.36 * scale * scale, 0.03 * scale, "default")
    x, y, w = np.array(levels), np.array(variances), np.array(weights)
    w = w / np.maximum(y, floor) ** 2
    for _ in range(5):  # iteratively reweighted: bins spoilt by motion or gamma lie above the line
        M = np.stack([np.ones_like(x), x], 1)
        a, b = np.linalg.lstsq(M * np.sqrt(w)[:, None], y * np.sqrt(w), rcond=None)[0]
        if b < 0:
            a, b = float(np.average(y, weights=w)), 0.0
        if a < floor:
            a, b = floor, max(float(np.sum(w * x * (y - floor)) / np.sum(w * x * x)), 0.0)
        r = (y - a - b * x) / np.maximum(a + b * x, floor)
        scale = 1.4826 * float(np.median(np.abs(r))) + 1e-3
        w = np.array(weights) / np.maximum(a + b * x, floor) ** 2 / (1 + (r / (3 * scale)) ** 2)
    return NoiseModel(float(a), float(b), "residuals")


def _chi2_median(dof: int) -> float:
    """Median over mean of a chi-squared variable (Wilson and Hilferty; exact 0.4549 for one degree of freedom)."""
    return 0.45494 if dof == 1 else (1 - 2 / (9 * dof)) ** 3


# ------------------------------------------------------------------------------------------------------- measuring


def measure(
    frames: Iterable[tuple[FrameKey, AnyArray]], plan: ViewPlan, s: PhaseSettings, noise: NoiseModel | None = None
) -> Decoded:
    """Frames, as they come, to wrapped phases with sigma; `directions` is still empty (see `settle_order`).

    Raises CaptureError if frames are missing, doubled or of different sizes.
    """
    top = full_scale(plan.pixel_format)
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
    measured = _rescue([done[i] for i in sorted(done)])
    shapes = {m.phase.shape for m in measured}
    if len(shapes) > 1:
        sizes = ", ".join(f"{c} x {r}" for r, c in sorted(shapes))
        raise CaptureError(f"view '{plan.camera}': sets of different sizes: {sizes}; needed one size")
    noise = noise or estimate_noise(measured, top)
    gray = tuple(bits[i].finish(noise) for i in sorted(bits))
    sets = _merge([(m, _with_sigma(m, noise, s)) for m in measured])
    if sets:
        finest = min(sets, key=lambda w: float(np.median(w.sigma)) / math.hypot(*w.g))
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
    if m.lent is not None:  # two samples fix cos and sin; the lent background adds its own share: twice the plain formula
        v = noise.a + noise.b * m.background[m.lent]
        sigma[m.lent] = np.sqrt(2 * v) / np.maximum(m.modulation[m.lent], 1e-6)
    misfit = np.sqrt(m.variance / (noise.a + noise.b * np.maximum(m.background, 0))).astype(np.float32)
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


# ------------------------------------------------------------------------------------------------------- the order


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
    for turns in range(1, 1001):
        x = turns / f[0]
        if all(abs(x * fi - round(x * fi)) * 2 * math.pi < tolerance_rad for fi in f[1:]):
            return x
    return math.inf


def settle_order(
    decoded: Decoded, plan: ViewPlan, s: PhaseSettings, rig: Rig | None = None, volume_margin: float = 1.25
) -> Decoded:
    """Wrapped phases to absolute phases, one `Direction` per fringe direction (equation 5, [33]).

    Without a rig the projector's field bounds the orders. With a rig each camera ray bounds them by its way through the
    measuring volume: this settles coarsest periods that wrap inside the field. Among the orders that are possible the
    one with the least chi squared over all sets and Gray codes wins; neighbours then vote on single wrong orders.
    Raises DecodeError if a direction has neither sets nor code that span the field (without a rig).
    """
    groups = families(decoded.sets)
    out: list[Direction] = []
    reasons = decoded.reasons.copy()
    used: set[int] = set()
    for group in groups:
        g = group[-1].g
        gray, half, soft = _gray_phase(decoded.gray, g, used)
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
        direction, bad = _unwrap(group, bounds, gray, half, soft, s)
        out.append(direction)
        reasons |= bad
    for i, code in enumerate(decoded.gray):
        if i not in used:
            direction, bad = _from_gray(code)
            out.append(direction)
            reasons |= bad
    return replace(decoded, directions=tuple(out), reasons=reasons)


def _unwrap(
    group: Sequence[WrappedSet], bounds: F64, gray: F32 | None, half: float, soft: float, s: PhaseSettings
) -> tuple[Direction, U16]:
    phases = np.stack([w.phase for w in group])
    sigmas = np.stack([np.hypot(w.sigma, np.float32(s.systematic_rad)) for w in group])
    freq = np.array([math.hypot(*w.g) for w in group])
    shape = phases.shape[1:]
    absolute, margin = np.empty(shape, np.float32), np.empty(shape, np.float32)
    none = np.zeros((0, 0), np.float32)
    unexpected = s.unexpected_sigma**2
    k.unwrap(phases, sigmas, freq, bounds, unexpected, none if gray is None else gray, half, soft, absolute, margin)
    uncertain = ~(margin >= s.order_min_margin)
    if s.order_votes > 1:
        trusted = np.isfinite(absolute) & (group[-1].sigma < s.max_sigma_rad)
        absolute, changed = _elect(np.where(trusted, absolute, np.float32(np.nan)), absolute, s)
        uncertain = np.where(changed == -128, True, uncertain & (changed == 0) & (margin < s.order_min_margin))
    reasons = np.where(uncertain | ~np.isfinite(absolute), np.uint16(Reason.ORDER_UNCERTAIN), np.uint16(0))
    return Direction(group[-1].g, absolute, group[-1].sigma, margin), reasons.astype(np.uint16)


def _elect(voters: F32, absolute: F32, s: PhaseSettings) -> tuple[F32, AnyArray]:
    """Repair single wrong orders by the vote of the neighbours, three rounds."""
    slope = _usual_slope(voters)
    radius = s.order_votes // 2
    total = np.zeros(absolute.shape, np.int16)
    current = voters
    changed = np.zeros(absolute.shape, np.int8)
    for _ in range(3):
        nxt = np.empty_like(current)
        k.order_votes(current, radius, max(3, (2 * radius + 1) ** 2 // 4), s.order_majority, slope, nxt, changed)
        total += np.where(changed == -128, 0, changed)
        current = nxt
        if not ((changed != 0) & (changed != -128)).any():
            break
    repaired = np.where(np.isfinite(current), current, absolute)
    return repaired.astype(np.float32), np.where(changed == -128, -128, np.clip(total, -127, 127))


def _usual_slope(phase: F32) -> float:
    """Largest believable phase slope, radians per pixel: four times the usual one, at most 1.2."""
    usual = 0.0
    for axis in (0, 1):
        d = np.diff(phase, axis=axis)
        d = d[np.isfinite(d)]
        if d.size:
            usual = max(usual, float(np.median(np.abs(d))))
    return min(max(4 * usual, 0.2), 1.2)


def _gray_phase(
    codes: Sequence[GrayCode], g: tuple[float, float], used: set[int]
) -> tuple[F32 | None, float, float]:
    """The finest phase at the middle of each pixel's Gray cell, half a cell and the softness of its edge, radians."""
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
            best = (phase, half, 0.1 * half + 0.3)
    return best


def _from_gray(code: GrayCode) -> tuple[Direction, U16]:
    """A Gray code alone is a direction too: one cycle per cell, uniform within the cell."""
    g = (1.0 / code.cell, 0.0) if code.axis == "u" else (0.0, 1.0 / code.cell)
    u = -0.5 + (code.value + 0.5) * code.cell
    phase = np.where(code.value >= 0, 2 * math.pi * u / code.cell, np.nan).astype(np.float32)
    sigma = np.full(phase.shape, 2 * math.pi / math.sqrt(12), np.float32)
    reasons = np.where(code.value >= 0, np.uint16(0), np.uint16(Reason.ORDER_UNCERTAIN))
    return Direction(g, phase, sigma, np.full(phase.shape, 99, np.float32)), reasons.astype(np.uint16)


# ------------------------------------------------------------------------------------------- projector coordinates


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
        a = sum(wi * x.g[0] ** 2 for wi, x in zip(w, d, strict=True))
        b = sum(wi * x.g[0] * x.g[1] for wi, x in zip(w, d, strict=True))
        c = sum(wi * x.g[1] ** 2 for wi, x in zip(w, d, strict=True))
        p = sum(wi * x.g[0] * yi for wi, x, yi in zip(w, d, y, strict=True))
        q = sum(wi * x.g[1] * yi for wi, x, yi in zip(w, d, y, strict=True))
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


def with_reasons(decoded: Decoded, reasons: U16) -> Decoded:
    """The same decoded view with other reasons (H, W)."""
    return replace(decoded, reasons=reasons)
