"""Fringe direction and periods from the rig, and the images that the projector shows (II-C, III-C, V-B, Table I).

The direction of a set is the one in which a change of depth shifts the phase most: `g ~ (Ju / fx^2, Jv / fy^2)`, where
J is the derivative of (u, v) along the camera's ray through the volume's centre. Where fx = fy that is the epipolar
direction. The sign is always that of J: **phase grows with the distance from the camera**.

A *period* here is a physical length: that of a fringe whose crests lie `period` projector-plane units apart along v. In
the isotropic plane of a diamond lattice it is the distance between crests in any direction.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erfc

from fringescope import geometry
from fringescope.errors import CaptureError, RigError, UsageError
from fringescope.settings import PatternSettings
from fringescope.types import (
    F64,
    U8,
    Camera,
    FrameKey,
    FringeSet,
    GraySet,
    Layout,
    NoiseModel,
    PatternPlan,
    PixelFormat,
    Projector,
    Rig,
    Role,
    ViewPlan,
    plane_size,
)

PAPER_PERIODS = (1140.0, 200.0, 36.0)  #: Table I, projector-plane units along v
PAPER_STEPS = (4, 4, 8)  #: Table I
HORIZONTAL = (0.0, 1.0)  #: gradient of fringes whose crests run along u

PixelFormats: TypeAlias = PixelFormat | Mapping[str, PixelFormat]  #: one for all cameras, or by camera name
_SetsOf: TypeAlias = Callable[[Camera], tuple[FringeSet, ...]]

# ---------------------------------------------------------------------------------------------------------- direction


def centre_of_volume(rig: Rig) -> F64:
    """Where the design is made: the measuring volume's centre (3,), world mm, or the point where the devices look."""
    return rig.volume.center if rig.volume is not None else geometry.working_point(rig)


def depth_jacobian(projector: Projector, camera: Camera, p_world: ArrayLike) -> F64:
    """Derivative of projector coordinates along the camera's rays through world points (..., 3): units per mm (..., 2).

    Both lenses exact (central difference over 1e-4 of the distance). NaN behind a device.
    """
    p = np.asarray(p_world, dtype=np.float64)
    ray = p - geometry.centre(camera.pose)
    distance = np.linalg.norm(ray, axis=-1, keepdims=True)
    step = 1e-4 * distance
    shift = ray / distance * step
    out: F64 = (geometry.project(projector, p + shift) - geometry.project(projector, p - shift)) / (2 * step)
    return out


def direction(rig: Rig, camera: Camera | str) -> tuple[float, float]:
    """Unit vector (gu, gv) on the projector plane of the fringes with the greatest phase disparity for `camera`.

    Returns `(Ju / fx^2, Jv / fy^2)` normalised: the phase grows with the distance from the camera, and of all fringes
    of one physical period these move most with depth. Raises RigError if depth moves nothing at the volume's centre
    (camera and projector look along one ray) or the centre lies behind a device. Paper: III-C, Fig. 5.
    """
    cam = rig.camera(camera) if isinstance(camera, str) else camera
    J = depth_jacobian(rig.projector, cam, centre_of_volume(rig))
    fx, fy = rig.projector.lens.K[0, 0], rig.projector.lens.K[1, 1]
    if not np.isfinite(J).all():
        raise RigError(f"camera '{cam.name}': the volume's centre is behind it or the projector; check R and t")
    if math.hypot(J[0] / fx, J[1] / fy) < 1e-7:
        raise RigError(f"camera '{cam.name}' and the projector see the volume along one ray; move them apart")
    g = np.array([J[0] / fx**2, J[1] / fy**2])
    g /= np.linalg.norm(g)
    return float(g[0]), float(g[1])


def gradient(projector: Projector, along: tuple[float, float], period: float) -> tuple[float, float]:
    """Cycles per plane unit (gx, gy) of fringes with gradient along `along` and physical `period` (units along v).

    `hypot(gx fx / fy, gy) = 1 / period`. Raises UsageError if `period` is not positive or `along` is zero.
    """
    ratio = projector.lens.K[0, 0] / projector.lens.K[1, 1]
    length = math.hypot(along[0] * ratio, along[1])
    if not (period > 0 and math.isfinite(period)) or not length > 0:
        raise UsageError(f"fringe period {period} along {along}; needed a positive period and a direction")
    return along[0] / length / period, along[1] / length / period


def physical_period(projector: Projector, g: tuple[float, float]) -> float:
    """The inverse of `gradient`: physical period, in plane units along v, of fringes with gradient g."""
    return 1.0 / math.hypot(g[0] * projector.lens.K[0, 0] / projector.lens.K[1, 1], g[1])


def span(g: tuple[float, float], size: tuple[int, int]) -> float:
    """Cycles of gradient g that a plane of `size` (W, H) holds: W |gx| + H |gy|. Above 1 the set wraps."""
    return size[0] * abs(g[0]) + size[1] * abs(g[1])


# --------------------------------------------------------------------------------------------------------------- plans


def paper_plan(
    rig: Rig,
    pixel_format: PixelFormats = PixelFormat.BAYER_RG8,
    s: PatternSettings | None = None,
    literal: bool = False,
) -> PatternPlan:
    """Table I for this rig: periods 1140, 200, 36 with 4, 4, 8 steps, tilted for each camera.

    The coarsest period is enlarged until the tilted set fits the plane once, with `wrap_margin` to spare; with
    `literal` it stays 1140, which wraps inside the field (1.8 cycles for the oblique cameras of the paper's rig).
    Raises RigError where a camera has no direction.
    """
    s = s or PatternSettings()

    def sets(camera: Camera) -> tuple[FringeSet, ...]:
        along = direction(rig, camera)
        periods = [*PAPER_PERIODS]
        if not literal:
            periods[0] = max(periods[0], _coarsest(rig.projector, along, s))
        return _fringe_sets(rig.projector, along, periods, PAPER_STEPS)

    return _plan(rig, pixel_format, sets)


def plan(rig: Rig, pixel_format: PixelFormats = PixelFormat.BAYER_RG8, s: PatternSettings | None = None) -> PatternPlan:
    """The planner's own choice: tilted sets from a coarsest period that fits the plane to `finest_period`.

    Takes the fewest sets, in equal ratios, whose predicted probability of a wrong order stays below `max_order_error`
    at the design signal. Raises UsageError, naming the error that is left, if `max_sets` are not enough.
    """
    s = s or PatternSettings()
    return _plan(rig, pixel_format, lambda c: _planned_sets(rig.projector, direction(rig, c), s))


def horizontal_plan(
    rig: Rig, pixel_format: PixelFormats = PixelFormat.BAYER_RG8, s: PatternSettings | None = None
) -> PatternPlan:
    """As `plan`, with untilted fringes (crests along u) for every camera: what IV-A and IV-B compare with."""
    s = s or PatternSettings()
    return _plan(rig, pixel_format, lambda _: _planned_sets(rig.projector, HORIZONTAL, s))


def calibration_plan(
    projector_size: tuple[int, int],
    layout: Layout,
    cameras: Sequence[str],
    pixel_format: PixelFormats = PixelFormat.BAYER_RG8,
    s: PatternSettings | None = None,
) -> PatternPlan:
    """Fringes along u and along v for every camera, for board captures; no rig is needed yet.

    `projector_size` = (width, height) in device pixels. Periods are in plane units of either axis.
    """
    s = s or PatternSettings()
    W, H = plane_size(*projector_size, layout)
    sets = tuple(
        FringeSet((1 / p, 0.0) if axis == 0 else (0.0, 1 / p), n)
        for axis, extent in ((0, W), (1, H))
        for p, n in _ladder(s.wrap_margin * extent, s)
    )
    views = tuple(ViewPlan(c, _format_of(pixel_format, c), sets, (W, H)) for c in cameras)
    return PatternPlan(*projector_size, layout, views)


def gray_set(axis: str, extent: float, cell: float, inverse: bool = True) -> GraySet:
    """The shortest Gray code along `axis` with cells of `cell` plane units that covers `extent` plane units."""
    if not (cell > 0 and extent > 0):
        raise UsageError(f"Gray code cell {cell} over {extent}; needed positive lengths in projector-plane units")
    return GraySet(axis, cell, max(1, math.ceil(math.log2(extent / cell) - 1e-9)), inverse=inverse)


def _format_of(pixel_format: PixelFormats, camera: str) -> PixelFormat:
    return pixel_format if isinstance(pixel_format, PixelFormat) else pixel_format[camera]


def _plan(rig: Rig, pixel_format: PixelFormats, sets: _SetsOf) -> PatternPlan:
    p = rig.projector
    views = tuple(ViewPlan(c.name, _format_of(pixel_format, c.name), sets(c), p.plane_size) for c in rig.cameras)
    return PatternPlan(p.width, p.height, p.layout, views)


def _coarsest(projector: Projector, along: tuple[float, float], s: PatternSettings) -> float:
    """Physical period at which the plane holds 1 / wrap_margin cycles."""
    return s.wrap_margin * span(gradient(projector, along, 1.0), projector.plane_size)


def _fringe_sets(
    projector: Projector, along: tuple[float, float], periods: Sequence[float], steps: Sequence[int]
) -> tuple[FringeSet, ...]:
    return tuple(FringeSet(gradient(projector, along, p), n) for p, n in zip(periods, steps, strict=True))


def _planned_sets(projector: Projector, along: tuple[float, float], s: PatternSettings) -> tuple[FringeSet, ...]:
    ladder = _ladder(_coarsest(projector, along, s), s)
    return _fringe_sets(projector, along, [p for p, _ in ladder], [n for _, n in ladder])


def _ladder(coarsest: float, s: PatternSettings) -> list[tuple[float, int]]:
    """Periods and steps from `coarsest` down to `finest_period`: the fewest sets that keep the orders safe."""
    if coarsest <= s.finest_period:
        return [(coarsest, s.finest_steps)]
    noise = NoiseModel(s.design_noise_a, s.design_noise_b)
    coarse = phase_sigma(noise, s.design_background, s.design_modulation, s.coarse_steps)
    fine = phase_sigma(noise, s.design_background, s.design_modulation, s.finest_steps)
    worst = 1.0
    for k in range(2, s.max_sets + 1):
        ratio = (coarsest / s.finest_period) ** (1 / (k - 1))
        each = [float(order_error(ratio, coarse, b, s.response_error)) for b in [coarse] * (k - 2) + [fine]]
        worst = min(1.0, sum(each))
        if worst <= s.max_order_error:
            periods = [coarsest / ratio**i for i in range(k - 1)] + [s.finest_period]
            return list(zip(periods, [s.coarse_steps] * (k - 1) + [s.finest_steps], strict=True))
    raise UsageError(
        f"{s.max_sets} sets from period {coarsest:.0f} to {s.finest_period:g} leave {worst:.1e} wrong orders, "
        f"more than {s.max_order_error:g}; allow more sets or steps, a longer finest period or a stronger design signal"
    )


# ------------------------------------------------------------------------------------------------------ the prediction


def phase_sigma(noise: NoiseModel, background: ArrayLike, modulation: ArrayLike, steps: int) -> F64:
    """Standard deviation, rad, of an N-step phase: `sigma^2 = 2 (a + b A) / (N B^2)`, variance of a sample a + b I.

    `background` A and `modulation` B in codes. To first order in noise / B; for N = 3 it is the mean over the phase.
    """
    A, B = np.asarray(background, dtype=np.float64), np.asarray(modulation, dtype=np.float64)
    out: F64 = np.sqrt(2 * (noise.a + noise.b * A) / (steps * B**2))
    return out


def order_error(ratio: ArrayLike, sigma_coarse: ArrayLike, sigma_fine: ArrayLike, response_error: float = 0.0) -> F64:
    """Probability that a coarse phase puts a fringe of a `ratio` times shorter period into a wrong order.

    The order is wrong when the coarse error, times `ratio`, and the fine error differ by more than half a cycle.
    `response_error` (rad) is the greatest error of the coarse phase that is not noise (response curve, light from
    elsewhere); it eats into the half cycle.
    """
    r = np.asarray(ratio, dtype=np.float64)
    sigma = np.hypot(r * np.asarray(sigma_coarse), np.asarray(sigma_fine))
    room = np.maximum(np.pi - (r + 1) * response_error, 0.0)
    with np.errstate(divide="ignore"):
        out: F64 = erfc(room / sigma / math.sqrt(2))
    return out


@dataclass(frozen=True, eq=False)
class Prediction:
    """What a view will measure, before it is captured.

    One entry per fringe set, in the view's order: `sigma_phase` (S,) rad. One per pair of neighbouring sets of a
    direction, coarse to fine: `order_error_steps`. `order_error`: probability that at least one of them fails.
    `depth_sigma_mm` (n,): sigma along the camera's ray at the given points, all directions together.
    `gain_over_horizontal` (n,): how many times smaller that is than with untilted fringes of the same physical period
    and steps.
    """

    camera: str
    points: F64
    sigma_phase: tuple[float, ...]
    order_error_steps: tuple[float, ...]
    order_error: float
    depth_sigma_mm: F64
    gain_over_horizontal: F64


def predict(
    rig: Rig,
    view: ViewPlan,
    noise: NoiseModel,
    modulation: float,
    background: float,
    point: ArrayLike | None = None,
    response_error: float = 0.0,
) -> Prediction:
    """Phase noise, wrong orders and depth noise of one view before the capture.

    `noise` is the sensor's (variance a + b I in codes squared), `modulation` B and `background` A what the pixel will
    see, in codes; `point` (3,) or (n, 3) in world mm, default the volume's centre. `response_error` as `order_error`.
    sigma_depth = sigma_phi / |2 pi g . J|. Orders settled by Gray code are not predicted, nor
    whether a coarsest period wraps (`validate` says so).
    Raises RigError if the rig lacks the camera, UsageError for a signal that is not positive, CaptureError for a view
    without fringes.
    """
    if not (modulation > 0 and background >= 0):
        raise UsageError(f"modulation {modulation} and background {background} codes; needed B > 0 and A >= 0")
    camera = rig.camera(view.camera)
    points = np.atleast_2d(np.asarray(centre_of_volume(rig) if point is None else point, dtype=np.float64))
    sigmas = {
        i: float(phase_sigma(noise, background, modulation, x.steps))
        for i, x in enumerate(view.sets)
        if isinstance(x, FringeSet)
    }
    if not sigmas:
        raise CaptureError(f"view '{view.camera}' has no fringe set; there is nothing to predict")
    J = depth_jacobian(rig.projector, camera, points)
    steps: list[float] = []
    info, flat = np.zeros(len(points)), np.zeros(len(points))
    for group in fringe_directions(view):
        for a, b in itertools.pairwise(group):
            ratio = _set(view, b).frequency / _set(view, a).frequency
            steps.append(float(order_error(ratio, sigmas[a], sigmas[b], response_error)))
        finest = _set(view, group[-1])
        g = np.array(finest.cycles_per_pixel)
        period = physical_period(rig.projector, finest.cycles_per_pixel)
        untilted = np.array(gradient(rig.projector, HORIZONTAL, period))
        info += (2 * np.pi * (J @ g) / sigmas[group[-1]]) ** 2
        flat += (2 * np.pi * (J @ untilted) / sigmas[group[-1]]) ** 2
    with np.errstate(divide="ignore"):
        depth, gain = 1 / np.sqrt(info), np.sqrt(info / flat)
    wrong = float(0.0 - np.expm1(sum(math.log1p(-e) if e < 1 else -math.inf for e in steps)))
    return Prediction(view.camera, points, tuple(sigmas.values()), tuple(steps), wrong, depth, gain)


def fringe_directions(view: ViewPlan, tolerance_rad: float = 1e-4) -> list[list[int]]:
    """Set numbers that unwrap each other: parallel within `tolerance_rad`, either sign; coarse to fine.

    Of brackets (equal g) the first stands for all.
    """
    groups: list[list[int]] = []
    for i, x in enumerate(view.sets):
        if not isinstance(x, FringeSet):
            continue
        gx, gy = x.cycles_per_pixel
        for group in groups:
            hx, hy = _set(view, group[0]).cycles_per_pixel
            if abs(gx * hy - gy * hx) <= tolerance_rad * math.hypot(gx, gy) * math.hypot(hx, hy):
                if all(_set(view, k).cycles_per_pixel != x.cycles_per_pixel for k in group):
                    group.append(i)
                break
        else:
            groups.append([i])
    return [sorted(g, key=lambda k: _set(view, k).frequency) for g in groups]


def _set(view: ViewPlan, i: int) -> FringeSet:
    x = view.sets[i]
    if not isinstance(x, FringeSet):
        raise CaptureError(f"set {i} of view '{view.camera}' is no fringe set")
    return x


def validate(planned: PatternPlan, rig: Rig, s: PatternSettings | None = None) -> tuple[str, ...]:
    """What is wrong with a plan on this rig, one sentence each; empty if nothing is.

    Finds coarsest periods that wrap inside the plane where no Gray code settles the order, orders that noise at the
    design signal will break, fringes that the lattice cannot draw, fringes that depth hardly moves, and a
    plan for another projector. Raises RigError if the rig lacks a camera of the plan.
    """
    s = s or PatternSettings()
    found: list[str] = []
    p = rig.projector
    if (planned.projector_width, planned.projector_height, planned.layout) != (p.width, p.height, p.layout):
        found.append(
            f"the plan is for {planned.projector_width} x {planned.projector_height} {planned.layout.value}, "
            f"the rig's projector is {p.width} x {p.height} {p.layout.value}"
        )
    for view in planned.views:
        found += [f"{view.camera}: {what}" for what in _faults(rig, view, s)]
    return tuple(found)


def _faults(rig: Rig, view: ViewPlan, s: PatternSettings) -> Iterator[str]:
    noise = NoiseModel(s.design_noise_a, s.design_noise_b)
    signal = (noise, s.design_modulation, s.design_background)
    result = predict(rig, view, *signal, response_error=s.response_error)
    coded = any(isinstance(x, GraySet) for x in view.sets)
    for group in fringe_directions(view):
        coarse, fine = _set(view, group[0]), _set(view, group[-1])
        cycles = span(coarse.cycles_per_pixel, view.projector_size)
        if cycles > 1 and not coded:
            period = physical_period(rig.projector, coarse.cycles_per_pixel)
            yield (
                f"the coarsest period {period:.0f} wraps inside the field ({cycles:.2f} cycles); "
                f"make it at least {s.wrap_margin * cycles * period:.0f}"
            )
        if max(abs(fine.cycles_per_pixel[0]), abs(fine.cycles_per_pixel[1])) > 0.25:
            yield f"period {fine.period:.2f} is too short for the lattice; make it at least 4"
    if result.order_error > s.max_order_error and not coded:
        yield (
            f"{result.order_error:.1e} wrong orders expected at modulation {s.design_modulation:g}, "
            f"more than {s.max_order_error:g}; add a set or steps, or take --plan planned"
        )
    loss = float(result.depth_sigma_mm[0] / predict(rig, _best(rig, view), *signal).depth_sigma_mm[0])
    if loss > 1.2:
        yield f"fringes in the best direction would measure depth {loss:.2f} times more finely"


def _best(rig: Rig, view: ViewPlan) -> ViewPlan:
    """The view's finest set turned into the best direction."""
    finest = max((_set(view, g[-1]) for g in fringe_directions(view)), key=lambda x: x.frequency)
    period = physical_period(rig.projector, finest.cycles_per_pixel)
    turned = FringeSet(gradient(rig.projector, direction(rig, view.camera), period), finest.steps)
    return ViewPlan(view.camera, view.pixel_format, (turned,), view.projector_size)


# -------------------------------------------------------------------------------------------------------------- images


def images(view: ViewPlan, projector: Projector, s: PatternSettings | None = None) -> Iterator[tuple[FrameKey, U8]]:
    """The device images of one view, one by one, in the order of `view.keys`: (height, width) uint8.

    The continuous function is evaluated at the mirror centres of the projector's layout and rounded to 8 bits between
    `level_low` and `level_high`; nothing is resampled. Raises UsageError if the levels are in the wrong order.
    """
    return _images(view, projector.width, projector.height, projector.layout, s or PatternSettings())


def plan_images(planned: PatternPlan, s: PatternSettings | None = None) -> Iterator[tuple[str, FrameKey, U8]]:
    """The device images of a whole plan, view by view: (camera, key, image). No rig is needed."""
    s = s or PatternSettings()
    for view in planned.views:
        for key, image in _images(view, planned.projector_width, planned.projector_height, planned.layout, s):
            yield view.camera, key, image


def uniform(projector: Projector, level: int) -> U8:
    """A device image of one level (0..255) everywhere: white, black, or what shows the projector's own background."""
    return np.full((projector.height, projector.width), level, dtype=np.uint8)


def _images(
    view: ViewPlan, width: int, height: int, layout: Layout, s: PatternSettings
) -> Iterator[tuple[FrameKey, U8]]:
    if s.level_low >= s.level_high:
        raise UsageError(f"pattern levels {s.level_low} to {s.level_high}; needed level_low < level_high")
    u, v = geometry.lattice(width, height, layout)
    for key in view.keys:
        fringes = view.sets[key.set_index]
        unit = _fringe(fringes, key.number, u, v) if isinstance(fringes, FringeSet) else _stripe(fringes, key, u, v)
        yield key, np.floor(s.level_low + (s.level_high - s.level_low) * unit + 0.5).astype(np.uint8)


def _fringe(x: FringeSet, n: int, u: F64, v: F64) -> F64:
    """Frame n in 0..1: (1 + cos(Phi - 2 pi n / N)) / 2 (equation 3)."""
    gx, gy = x.cycles_per_pixel
    out: F64 = 0.5 + 0.5 * np.cos(2 * np.pi * (gx * u + gy * v - n / x.steps))
    return out


def _stripe(x: GraySet, key: FrameKey, u: F64, v: F64) -> F64:
    """One frame of a Gray code in 0..1."""
    if key.role in (Role.WHITE, Role.BLACK):
        return np.full(u.shape, float(key.role is Role.WHITE))
    value = np.floor(((u if x.axis == "u" else v) + 0.5) / x.cell).astype(np.int64) % (1 << x.bits)
    bit = ((value ^ (value >> 1)) >> (x.bits - 1 - key.number)) & 1
    out: F64 = (bit ^ (key.role is Role.INVERSE)).astype(np.float64)
    return out
