"""The fused way from raw frames to points: the usual plan of a view, block by block (kernels/fused.py).

What it gives is what the stages give, to float32; what it does not take (Gray codes, brackets, several directions,
response corrections, RGB, very deep measuring spaces) goes the stages' way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np

from fringescope import denoise, geometry, memory, phase
from fringescope.errors import RigError
from fringescope.kernels import fused as k
from fringescope.kernels.depths import Depths
from fringescope.settings import Settings
from fringescope.types import (
    F32,
    F64,
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

MOST_ERROR_MM = 1e-4  #: of the depth table against the exact solution
TWO_PI = 2 * np.pi
f4 = np.float32


@dataclass(frozen=True, eq=False)
class Way:
    """What the kernel needs to know of a view: its frames in the order of its sets, coarse to fine, and the tables."""

    frames: tuple[AnyArray, ...]
    g: tuple[float, float]
    noise: NoiseModel
    notes: tuple[str, ...]
    table: geometry.DepthTable
    sets: k.Sets
    limits: k.Limits
    depths: Depths
    bounds: F64  #: (4, h, w) turns
    usual: F64  #: (8, 8)


class Fused(NamedTuple):
    """A decoded view with points (H, W, 3) and their sigma, mm, (H, W) of all pixels, and the steps of its phase."""

    decoded: Decoded
    xyz: F32
    sigma_mm: F32
    steps: F32


def decode(view: ViewInput, rig: Rig, s: Settings, device: Device = "cpu") -> Fused | None:
    """A view's frames to absolute phase with the reasons of exposure and order, and to points and their sigma, mm, all
    in one pass; None for a view that the fused kernel, or that of the GPU, does not take.

    `view.frames` must be a sequence. Points have yet to be blanked where `reasons` says so. Raises as the stages do.
    """
    way = way_of(view, rig, s)
    if way is None:
        return None
    H, W = _size(way.frames[0])
    absolute, sigma, A, B, sigma_mm = (memory.empty((H, W), np.float32) for _ in range(5))
    reasons, xyz = memory.empty((H, W), np.uint16), memory.empty((H, W, 3), np.float32)
    out = (absolute, sigma, A, B, reasons, xyz, sigma_mm)
    if device == "gpu":
        from fringescope.pipeline import gpu  # only then: Numba's CUDA is slow to import

        if not gpu.takes(way.sets):
            return None
        frames = [phase.unpacked(f, view.plan.pixel_format) for f in way.frames]
        gpu.by_slabs(frames, way.sets, way.limits, way.bounds, way.usual, way.depths, out)
    else:
        on_cpu(way, out)
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


def way_of(view: ViewInput, rig: Rig, s: Settings) -> Way | None:
    """What the kernel needs to know of a view; None for one that it does not take."""
    plan, camera = view.plan, rig.camera(view.plan.camera)
    family = _parallel(plan)
    frames = _in_order(view, family) if family else None
    if frames is None or family is None or view.response is not None:
        return None
    H, W = _size(frames[0])
    if (camera.lens.width, camera.lens.height) != (W, H):
        return None  # the stages say what is wrong
    numbers, g = [n for n, _ in family], family[-1][1]
    steps = [_fringes(plan, n).steps for n in numbers]
    every = denoise.odd_stride(H * W)
    thin = [(key, phase.thinned(f, plan.pixel_format, every)) for key, f in view.frames]
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
    angles = np.concatenate([TWO_PI * np.arange(n) / n for n in steps])
    signs = np.repeat([1.0 if np.dot(h, g) > 0 else -1.0 for _, h in family], steps)  # of sets that point the other way
    frequency = np.array([float(np.hypot(*h)) for _, h in family])
    pivot = float(np.median(few.background)) if fmt.bits > 10 else 0.0
    sets = k.Sets(
        np.concatenate([[0], np.cumsum(steps)]).astype(np.int64),
        np.cos(angles).astype(f4),
        (signs * np.sin(angles)).astype(f4),
        np.append(1.0, frequency[1:] / frequency[:-1]).astype(f4),
        frequency,
        np.array([np.dot(h, g) > 0 for _, h in family]),
        fmt.max_value,
        f4(pivot),
    )
    bounds = geometry.phase_bounds(rig, camera, g, s.denoise.volume_margin) / TWO_PI
    limits = _limits(few.noise, fmt, steps, sigma_rad, contrast, trial.systematic_rad, s)
    depths = _depths(table, rig, camera, s)
    return Way(frames, g, few.noise, trial.notes, table, sets, limits, depths, bounds, usual)


def _parallel(plan: ViewPlan) -> list[tuple[int, tuple[float, float]]] | None:
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
    return None if alike or max(_fringes(plan, n).steps for n, _ in out) > 64 else out


def _fringes(plan: ViewPlan, n: int) -> FringeSet:
    one = plan.sets[n]
    assert isinstance(one, FringeSet)
    return one


def _in_order(
    view: ViewInput, family: Sequence[tuple[int, tuple[float, float]]]
) -> tuple[AnyArray, ...] | None:
    """The frames of the sets, coarse to fine, step by step; None if any is missing, doubled or unlike the others."""
    there: dict[FrameKey, AnyArray] = {}
    for key, frame in view.frames:
        if key in there or (frame.ndim != 2 and not view.plan.pixel_format.packs(frame)):
            return None
        there[key] = frame
    keys = [FrameKey(n, Role.STEP, i) for n, _ in family for i in range(_fringes(view.plan, n).steps)]
    if set(keys) != set(there):
        return None
    frames = tuple(there[key] for key in keys)
    like = frames[0]
    if any(f.shape != like.shape or f.dtype != like.dtype for f in frames) or like.dtype not in (np.uint8, np.uint16):
        return None
    return frames if min(like.shape) >= 1 else None


def _size(frame: AnyArray) -> tuple[int, int]:
    """Rows and columns of pixels of a frame, which may be packed."""
    return frame.shape[0], frame.shape[1] if frame.ndim == 2 else 2 * frame.shape[1]


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


def on_cpu(way: Way, out: tuple[AnyArray, ...]) -> None:
    """Runs the kernel over rows on all cores; it reads the frames where they lie, packed ones too."""
    frames = [f if f[0].flags.c_contiguous else np.ascontiguousarray(f) for f in way.frames]
    addresses = np.array([f.ctypes.data for f in frames], np.int64)
    row_bytes = np.array([f.strides[0] for f in frames], np.int64)
    packed = frames[0].ndim == 3
    like = np.empty(0, np.uint16 if packed else frames[0].dtype)
    k.decode(addresses, row_bytes, like, packed, way.sets, way.limits, way.bounds, way.usual, way.depths, *out)
