"""The fused way from raw frames to points: the usual plan of a view, block by block (kernels/fused.py).

What it gives is what the stages give, to float32; what it does not take (Gray codes, brackets, several directions,
response corrections, RGB, very deep measuring spaces) goes the stages' way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from time import perf_counter
from typing import Literal, NamedTuple

import numpy as np

from fringescope import denoise, geometry, phase
from fringescope.errors import CaptureError, RigError
from fringescope.kernels import fused as k
from fringescope.kernels.depths import Depths
from fringescope.pipeline import cores
from fringescope.pipeline.cores import Summed, Way, by_rows, on_cpu, room, size_of
from fringescope.pipeline.tiling import ByRows
from fringescope.settings import Settings
from fringescope.types import (
    F32,
    AnyArray,
    Camera,
    Decoded,
    Direction,
    FrameKey,
    FringeSet,
    NoiseModel,
    PixelFormat,
    Reason,
    Rig,
    Role,
    ViewInput,
    ViewPlan,
)

Device = Literal["cpu", "gpu"]  #: where the fused kernel runs
Family = Sequence[tuple[int, tuple[float, float]]]  #: number and gradient of each parallel set, coarse to fine

MOST_ERROR_MM = 1e-4  #: of the depth table against the exact solution
TWO_PI = 2 * np.pi
f4 = np.float32


class Begun(NamedTuple):
    """What the coarser sets of a view say, worked out while its finer ones were still on their way."""

    sets: int  #: how many, from the coarsest on
    noise: NoiseModel  #: that it rests on
    levels: F32  #: backgrounds, codes, at which that counts
    out: tuple[AnyArray, ...]  #: the outputs of the kernel, which hold it
    few: list[tuple[FrameKey, AnyArray]]  #: every n-th pixel of the frames, for statistics
    frames: list[tuple[FrameKey, AnyArray]]  #: that were gathered for this view alone
    summed: Summed | None  #: of the finest set

    def let_go(self) -> None:
        """Frames and sums have been used: their memory serves votes and masks."""
        self.few.clear()
        self.frames.clear()
        if self.summed is not None:
            self.summed.frames, self.summed.rest = 0, cores.NO_REST


class Fused(NamedTuple):
    """A decoded view with points (H, W, 3) and their sigma, mm, (H, W) of all pixels, and the steps of its phase."""

    decoded: Decoded
    xyz: F32
    sigma_mm: F32
    steps: F32


def decode(
    view: ViewInput, rig: Rig, s: Settings, device: Device = "cpu", begun: Begun | None = None
) -> Fused | None:
    """A view's frames to absolute phase with the reasons of exposure and order, and to points and their sigma, mm, all
    in one pass; None for a view that the fused kernel, or that of the GPU, does not take.

    `view.frames` must be a sequence, or `ByRows` on the processor, unless `takes` refuses the view. What was `begun` is
    gone on from, if it rests on what all frames say; the frames that were gathered for it are let go of. Points have
    yet to be blanked where `reasons` says so. Raises as the stages do.
    """
    tiled = view.frames if isinstance(view.frames, ByRows) else None
    few = begun.few if begun is not None else None
    if tiled is not None:
        hollow, few = tiled.looked_over(view.plan, rig.camera(view.plan.camera).lens.height)
        view = replace(view, frames=hollow)
    way = way_of(view, rig, s, few)
    if way is None:
        return None
    H, W = size_of(way.frames[0])
    out = begun.out if begun is not None else room(H, W)
    absolute, sigma, A, B, reasons, xyz, sigma_mm = out
    if device == "gpu":
        from fringescope.pipeline import gpu  # only then: Numba's CUDA is slow to import

        if not gpu.takes(way.sets):
            return None
        frames = [phase.unpacked(f, view.plan.pixel_format) for f in way.frames]
        gpu.by_slabs(frames, way.sets, way.limits, way.bounds, way.usual, way.depths, out)
        del frames
    elif tiled is not None:
        by_rows(tiled, way, _keys(view.plan, _parallel(view.plan) or []), out)
    else:
        good = begun if begun is not None and _still_holds(begun, way, s) else None
        on_cpu(way, out, good.sets if good is not None else 0, summed=good.summed if good is not None else None)
    if begun is not None:
        way = replace(way, frames=())
        begun.let_go()
    no_margin = np.broadcast_to(np.float32(np.nan), (H, W))
    decoded = Decoded(
        view.plan.camera, (Direction(way.g, absolute, sigma, no_margin),), (), (), A, B, reasons, way.noise,
        way.notes,
    )
    vote = phase.vote_on_orders(decoded, s.phase)
    if len(vote.rows):
        _points_again(decoded, vote.rows, vote.columns, way, rig, s, xyz, sigma_mm)
    return Fused(decoded, xyz, sigma_mm, vote.steps)


def _points_again(
    decoded: Decoded, rows: AnyArray, columns: AnyArray, way: Way, rig: Rig, s: Settings, xyz: F32, sigma_mm: F32
) -> None:
    """Points of the pixels whose order the vote has changed, by the same table in float64."""
    moved = rows, columns
    camera = rig.camera(decoded.camera)
    d = decoded.directions[0]
    uv = np.stack([columns, rows], -1).astype(np.float64)
    turns = d.phase[moved].astype(np.float64) / TWO_PI
    table, origin = way.table, geometry.centre(camera.pose)
    points = geometry.points_by_table(table.cubics, table.step, table.depth, origin, uv, turns)
    ahead = geometry.points_by_table(table.cubics, table.step, table.depth, origin, uv, turns + 1e-3)
    xyz[moved] = points
    sigma_mm[moved] = np.linalg.norm(ahead - points, axis=1) / 1e-3 * d.sigma[moved] / TWO_PI
    inside = geometry.measuring_space(rig, camera, points, s.denoise.volume_margin)
    where = geometry.project(rig.projector, points)
    low, high = geometry.lit_field(rig, camera, s.denoise.rim)
    with np.errstate(invalid="ignore"):
        inside &= ((where >= low) & (where <= high)).all(axis=1)
    bit = np.uint16(Reason.OUT_OF_VOLUME)
    decoded.reasons[moved] = np.where(inside, decoded.reasons[moved] & ~bit, decoded.reasons[moved] | bit)


def takes(view: ViewInput) -> bool:
    """Whether the plan of a view is one for the fused kernel; its frames may still turn out not to be."""
    return view.response is None and _parallel(view.plan) is not None


class Beginning:
    """Frames of a view as they come, gathered; what the coarser sets say is worked out while finer ones are on their
    way. Frames that are unlike what the plan says are gathered all the same, for `decode` or the stages to refuse.
    """

    def __init__(self, view: ViewInput, rig: Rig, s: Settings) -> None:
        self.frames: list[tuple[FrameKey, AnyArray]] = []
        self._view, self._rig, self._s = view, rig, s
        self._family = _parallel(view.plan) or []
        self._done = 0
        self._at: dict[int, FrameKey] = {}  # where frames lie
        self._way: Way | None = None
        self._levels = np.zeros(0, np.float32)
        self._out: tuple[AnyArray, ...] = ()
        self._few: list[tuple[FrameKey, AnyArray]] = []
        self._summed: Summed | None = None
        self._sum_s = 0.0  # that it took to add to the sums

    def add(self, key: FrameKey, frame: AnyArray, room_s: float = math.inf) -> None:
        """Gather a frame; if a set is complete with it, work it out, and finer ones that have waited for it. A frame of
        the finest set is added to its sums, with those that have not been yet, if that takes less than `room_s`, the
        seconds until the next one may come.

        Raises CaptureError for a frame in the memory of another.
        """
        if frame.size and (before := self._at.setdefault(frame.ctypes.data, key)) != key:
            raise CaptureError(
                f"view '{self._view.plan.camera}': {key} lies in the memory of {before}, which it has overwritten; "
                "needed frames that stay as they are: copy each one as it comes"
            )
        self.frames.append((key, frame))
        if frame.ndim == 2 or self._view.plan.pixel_format.packs(frame):
            every = denoise.odd_stride(math.prod(size_of(frame)))
            few = phase.thinned(frame, self._view.plan.pixel_format, every)
            self._few.append((key, np.ascontiguousarray(few)))
        while self._done < len(self._family) - 1 and len(self.frames) < len(self._view.plan.keys):
            got = _in_order(replace(self._view, frames=self.frames), self._family, self._done + 1)
            if got is None:
                return
            if self._way is None:
                first = _first_way(self._view, got, self._family, self._rig, self._s)
                if first is None:
                    self._family = []
                    return
                self._way, self._levels = first
                self._out = room(*size_of(got[0]))
            self._way = replace(self._way, frames=got)
            on_cpu(self._way, self._out, self._done, self._done + 1)
            self._done += 1
        if self._way is not None and self._done == len(self._family) - 1 and self._sum_s < room_s:
            start = perf_counter()
            self._sum_up(self._way)
            self._sum_s = perf_counter() - start

    def _sum_up(self, way: Way) -> None:
        """Add what has come of the finest set, in the order of its frames, to the sums; its last frame is left."""
        n, steps = self._family[-1][0], int(way.sets.start[-1] - way.sets.start[-2])
        done = self._summed.frames if self._summed is not None else 0
        there = {key.number: f for key, f in self.frames if key.set_index == n}
        frames: list[AnyArray] = []
        while done + len(frames) < steps - 1 and done + len(frames) in there:
            frames.append(there[done + len(frames)])
        like = way.frames[0]
        if not frames or any(f.shape != like.shape or f.dtype != like.dtype for f in frames):
            return
        self._summed = cores.add(way, self._out, frames, self._summed)

    @property
    def begun(self) -> Begun | None:
        """What has been worked out so far, if anything."""
        way = self._way
        if way is None:
            return None
        return Begun(self._done, way.noise, self._levels, self._out, self._few, self.frames, self._summed)


FIRST_SAMPLES = 50_000  #: pixels that tell the noise of the coarsest set alone
SAME_NOISE = 0.1  #: by which the noise of some sets may differ from that of all, relative to its variance


def _still_holds(begun: Begun, way: Way, s: Settings) -> bool:
    """Whether all frames say of noise and systematic errors what was taken for granted."""
    then, now = begun.noise.variance(begun.levels), way.noise.variance(begun.levels)
    return bool(
        np.all(np.abs(then - now) <= SAME_NOISE * now) and way.limits.systematic == f4(s.phase.systematic_rad / TWO_PI)
    )


def _first_way(
    view: ViewInput, frames: tuple[AnyArray, ...], family: Family, rig: Rig, s: Settings
) -> tuple[Way, F32] | None:
    """As `way_of`, from the frames of the coarsest set: with its noise and the usual systematic errors; and low, usual
    and high backgrounds.
    """
    plan, camera = view.plan, rig.camera(view.plan.camera)
    H, W = size_of(frames[0])
    if (camera.lens.width, camera.lens.height) != (W, H):
        return None
    g = family[-1][1]
    table = _table(rig, camera, g, s.denoise.volume_margin)
    if table is None:
        return None
    alone = replace(plan, sets=(plan.sets[family[0][0]],))

    def thin(samples: int) -> list[tuple[FrameKey, AnyArray]]:
        every = denoise.odd_stride(H * W, samples)
        return [(FrameKey(0, Role.STEP, n), phase.thinned(f, plan.pixel_format, every)) for n, f in enumerate(frames)]

    few = phase.measure(thin(FIRST_SAMPLES), alone, s.phase, view.noise)
    steps = [_fringes(plan, n).steps for n, _ in family]
    limits = _limits(few.noise, plan.pixel_format, steps, math.inf, 0.0, s.phase.systematic_rad, s)
    bounds = geometry.phase_bounds(rig, camera, g, s.denoise.volume_margin) / TWO_PI
    sets = _sets(family, steps, plan.pixel_format, thin(denoise.FEW))
    levels = np.quantile(few.background, (0.1, 0.5, 0.9)).astype(np.float32)
    way = Way(
        frames, g, few.noise, (), table, sets, limits, _depths(table, rig, camera, s), bounds, np.ones((2, 2)),
    )  # fmt: skip
    return way, levels


def way_of(
    view: ViewInput, rig: Rig, s: Settings, few_frames: Sequence[tuple[FrameKey, AnyArray]] | None = None
) -> Way | None:
    """What the kernel needs to know of a view; None for one that it does not take. `few_frames`: its frames thinned, if
    they are already.
    """
    plan, camera = view.plan, rig.camera(view.plan.camera)
    family = _parallel(plan) if takes(view) else None
    frames = _in_order(view, family) if family else None
    if frames is None or family is None:
        return None
    H, W = size_of(frames[0])
    if (camera.lens.width, camera.lens.height) != (W, H):
        return None  # the stages say what is wrong
    numbers, g = [n for n, _ in family], family[-1][1]
    steps = [_fringes(plan, n).steps for n in numbers]
    every = denoise.odd_stride(H * W)
    thin = few_frames or [(key, phase.thinned(f, plan.pixel_format, every)) for key, f in view.frames]
    few = phase.measure(thin, plan, s.phase, view.noise)
    if few.background is not few.sets[numbers[-1]].background:
        return None  # the finest set is not the most accurate one
    table = _table(rig, camera, g, s.denoise.volume_margin)
    if table is None:
        return None
    trial = phase.trial(few, plan, s.phase, rig, s.denoise.volume_margin)
    fmt = plan.pixel_format
    dark, low = denoise.weak(few, fmt, s.denoise)
    sigma_rad, contrast, usual = denoise.usual_exposure([few.sets[n] for n in numbers], ~(dark | low), s.denoise)
    sets = _sets(family, steps, fmt, [(key, f) for key, f in thin if key.set_index == numbers[0]])
    bounds = geometry.phase_bounds(rig, camera, g, s.denoise.volume_margin) / TWO_PI
    limits = _limits(few.noise, fmt, steps, sigma_rad, contrast, trial.systematic_rad, s)
    depths = _depths(table, rig, camera, s)
    return Way(frames, g, few.noise, trial.notes, table, sets, limits, depths, bounds, usual)


def _sets(
    family: Family, steps: Sequence[int], fmt: PixelFormat, coarsest: Sequence[tuple[FrameKey, AnyArray]]
) -> k.Sets:
    """The sets as the kernel has them; `coarsest`: some pixels of the frames of that set."""
    usual = np.median(np.mean([f for _, f in coarsest], axis=0, dtype=np.float64)) if fmt.bits > 10 else 0.0
    g = family[-1][1]
    angles = np.concatenate([TWO_PI * np.arange(n) / n for n in steps])
    signs = np.repeat([1.0 if np.dot(h, g) > 0 else -1.0 for _, h in family], steps)  # of sets that point the other way
    frequency = np.array([float(np.hypot(*h)) for _, h in family])
    return k.Sets(
        np.concatenate([[0], np.cumsum(steps)]).astype(np.int64),
        np.cos(angles).astype(f4),
        (signs * np.sin(angles)).astype(f4),
        np.append(1.0, frequency[1:] / frequency[:-1]).astype(f4),
        frequency,
        np.array([np.dot(h, g) > 0 for _, h in family]),
        fmt.max_value,
        f4(round(float(usual))),  # whole, so that differences are exact
    )


def _parallel(plan: ViewPlan) -> Family | None:
    """Number and gradient of each set, coarse to fine; None unless all are fringes of one direction, no two alike."""
    if plan.pixel_format is PixelFormat.RGB8 or not all(isinstance(one, FringeSet) for one in plan.sets):
        return None
    out = [(n, _fringes(plan, n).cycles_per_pixel) for n in range(len(plan.sets))]
    out.sort(key=lambda one: float(np.hypot(*one[1])))
    (gx, gy), size = out[-1][1], float(np.hypot(*out[-1][1]))
    for _, (hx, hy) in out:
        if abs(gx * hy - gy * hx) >= phase.PARALLEL_RAD * size * float(np.hypot(hx, hy)):
            return None
    lengths = [float(np.hypot(*h)) for _, h in out]
    alike = any(b < 1.0001 * a for a, b in pairwise(lengths))
    alike |= len({_fringes(plan, n).exposure_us for n, _ in out}) > 1  # no set may borrow of another
    return None if alike or max(_fringes(plan, n).steps for n, _ in out) > 64 else out


def _fringes(plan: ViewPlan, n: int) -> FringeSet:
    one = plan.sets[n]
    assert isinstance(one, FringeSet)
    return one


def _in_order(view: ViewInput, family: Family, sets: int | None = None) -> tuple[AnyArray, ...] | None:
    """The frames of the sets (of the `sets` coarsest ones), coarse to fine, step by step; None if any is missing,
    doubled or unlike the others.
    """
    there: dict[FrameKey, AnyArray] = {}
    for key, frame in view.frames:
        if key in there or (frame.ndim != 2 and not view.plan.pixel_format.packs(frame)):
            return None
        there[key] = frame
    keys = _keys(view.plan, family)
    if sets is None and set(keys) != set(there):
        return None
    wanted = keys if sets is None else keys[: sum(_fringes(view.plan, n).steps for n, _ in family[:sets])]
    if not all(key in there for key in wanted):
        return None
    frames = tuple(there[key] for key in wanted)
    like = frames[0]
    if any(f.shape != like.shape or f.dtype != like.dtype for f in frames) or like.dtype not in (np.uint8, np.uint16):
        return None
    return frames if min(like.shape) >= 1 else None


def _keys(plan: ViewPlan, family: Family) -> list[FrameKey]:
    """Frames in the order of the sets, coarse to fine, step by step."""
    return [FrameKey(n, Role.STEP, i) for n, _ in family for i in range(_fringes(plan, n).steps)]


def _table(rig: Rig, camera: Camera, g: tuple[float, float], margin: float) -> geometry.DepthTable | None:
    """A depth table that is accurate enough, or None."""
    for nodes in (24, 96):
        try:
            table = geometry.depth_table(rig, camera, g, margin, max(1, -(-camera.lens.width // nodes)))
        except RigError:
            return None
        if table.error_mm < MOST_ERROR_MM:
            return table
    return None


def _limits(
    noise: NoiseModel, fmt: PixelFormat, steps: Sequence[int], sigma_rad: float, contrast: float,
    systematic_rad: float, s: Settings,
) -> k.Limits:  # fmt: skip
    p, d, scale = s.phase, s.denoise, fmt.full_scale / 255.0
    bits = (Reason.DARK, Reason.SATURATED, Reason.LOW_MODULATION, Reason.ORDER_UNCERTAIN, Reason.OUT_OF_VOLUME,
            Reason.INCONSISTENT)  # fmt: skip
    return k.Limits(
        f4(noise.a), f4(noise.b), f4(systematic_rad / TWO_PI), f4(p.unexpected_sigma**2), f4(p.order_min_margin**2),
        f4(p.max_misfit**2), np.array([int(p.max_saturated * n) for n in steps]), f4(d.min_background * scale),
        f4(d.min_modulation * scale), f4(d.min_contrast), f4(d.min_modulation_sigma), f4(sigma_rad / TWO_PI),
        f4(contrast), *(np.uint16(b) for b in bits),
    )  # fmt: skip


def _depths(table: geometry.DepthTable, rig: Rig, camera: Camera, s: Settings) -> Depths:
    p = rig.projector
    return Depths(
        table.cubics.reshape(len(table.cubics), -1),
        table.step,
        geometry.centre(camera.pose).astype(f4),
        f4(table.depth),
        np.concatenate([p.pose.R.ravel(), p.pose.t]).astype(f4),
        geometry.lens_vector(p.lens).astype(f4),
        np.concatenate(geometry.lit_field(rig, camera, s.denoise.rim)).astype(f4),
        np.concatenate([a.ravel() for a in geometry.measuring_box(rig, camera, s.denoise.volume_margin)]).astype(f4),
    )
