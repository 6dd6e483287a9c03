"""Compiles the kernels before they are needed: a tiny scan through the whole pipeline fills Numba's cache on disk."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from fringescope import denoise, geometry, patterns, pipeline, report
from fringescope.pipeline import fast, guidance
from fringescope.settings import MeshSettings, Settings
from fringescope.twin import presets
from fringescope.types import (
    AnyArray,
    Camera,
    FrameKey,
    FringeSet,
    GraySet,
    Guidelines,
    PixelFormat,
    Response,
    Rig,
    Role,
    Stroke,
    ViewInput,
    ViewPlan,
)

SCALE = 1 / 16  #: of the paper's cameras: 342 x 228 pixels, enough to reach every kernel


def drawn_view(rig: Rig, camera: Camera, plan: ViewPlan) -> ViewInput:
    """What a camera would see of a flat white plate through the working point, without a renderer."""
    L, fmt = camera.lens, plan.pixel_format
    v, u = np.meshgrid(np.arange(L.height), np.arange(L.width), indexing="ij")
    origin, d = geometry.world_rays(camera, np.stack([u, v], -1))
    p = origin + d * (-origin[2] / d[..., 2])[..., None]
    bump = 0.02 * np.sin(3 * u) * np.cos(2 * v)
    p = p + d * bump[..., None]
    lit = geometry.field_of_view(Rig(rig.projector, (camera,)), p)

    rng = np.random.default_rng(0)
    lit = lit & (((u // 9 + v // 9) % 2 == 1) | (u > L.width / 2))  # a chessboard, which meets in corners

    def frame(signal: AnyArray | float, dark: float) -> AnyArray:
        light = np.where(lit, signal, dark) + rng.normal(0, 1.5, u.shape)
        codes = (np.maximum(light, 0) * (fmt.max_value / 255)).round().astype(fmt.dtype)
        return np.repeat(codes[..., None], 3, axis=2) if fmt is PixelFormat.RGB8 else codes

    def frames() -> Iterator[tuple[FrameKey, AnyArray]]:
        for key in plan.keys:
            one = plan.sets[key.set_index]
            if isinstance(one, FringeSet):
                phi = geometry.phase_at(rig.projector, one.cycles_per_pixel, p) - 2 * np.pi * key.number / one.steps
                yield key, frame(100 + 80 * np.cos(np.nan_to_num(phi)), 2)
            else:
                at = np.nan_to_num(geometry.project(rig.projector, p)[..., 0 if one.axis == "u" else 1])
                word = np.maximum((at + 0.5) // one.cell, 0).astype(np.int64)
                bit = (word ^ word >> 1) >> (one.bits - 1 - key.number) & 1
                yield key, frame(20 + 160 * (bit if key.role is Role.BIT else 1 - bit), 2)

    return ViewInput(plan, tuple(frames()), frame(120, 3))


def _views(rig: Rig, pixel_format: PixelFormat) -> list[ViewInput]:
    plan = patterns.paper_plan(rig, dict.fromkeys([c.name for c in rig.cameras], pixel_format))
    return [drawn_view(rig, c, v) for c, v in zip(rig.cameras, plan.views, strict=True)]


def compile_kernels(every_plan: bool = False) -> int:
    """Runs the tiny scan and draws its surface; returns the number of points that it found.

    That is the usual plan of three Bayer cameras of 8 bits. `every_plan`: other formats and plans too.
    """
    rig = presets.instrument("paper", SCALE).rig
    views = _views(rig, PixelFormat.BAYER_RG8)
    s = Settings(mesh=MeshSettings(triangles=2000, preview_triangles=300, preview_pixels=20_000))  # simplified, thinned
    scan = pipeline.scan(views, rig, s, all_points=True, first=lambda _surface: None)
    _as_they_come(views[0], rig, s)
    nearer = replace(scan.grids[0], xyz=scan.grids[0].xyz + np.array([0, 0, 3], np.float32))
    denoise.agree((nearer, *scan.grids[1:]), rig, s.denoise)  # views that disagree
    if scan.surface is not None:
        report.render_surface(scan.surface, size=(64, 48))
        tissue = guidance.tissue_of(scan.grids, scan.surface, rig, s)
        middle = 0.5 * np.array(scan.grids[0].reasons.shape[::-1])
        stroke = Stroke("a line", camera=scan.grids[0].camera, pixels=np.stack([middle, middle + 5]))
        guidance.project_guidance(Guidelines((stroke,)), tissue, s)
    if every_plan:
        _other_plans(rig, views[0], s)
    return len(scan.cloud)


def _as_they_come(view: ViewInput, rig: Rig, s: Settings) -> None:
    """Frames that are summed one by one."""
    beginning = fast.Beginning(view, rig, s)
    for key, frame in view.frames:
        beginning.add(key, frame)
    fast.decode(replace(view, frames=beginning.frames), rig, s, "cpu", beginning.begun)


def _other_plans(rig: Rig, usual: ViewInput, s: Settings) -> None:
    """One view of each other kind: more bits, other colours, no picture, and what only the stages take."""
    for fmt in (PixelFormat.BAYER_RG12, PixelFormat.MONO16, PixelFormat.MONO8, PixelFormat.RGB8):
        view = _views(rig, fmt)[0]
        pipeline.scan([view], rig, s, surface=False)
        if fast.takes(view):
            _as_they_come(view, rig, s)
        pipeline.decode_view(view, s)
    pipeline.scan([replace(usual, color=None)], rig, s, surface=False)
    pipeline.decode_view(usual, s)
    camera, sets = rig.camera(usual.plan.camera), usual.plan.sets
    across = tuple(FringeSet((-gy, gx), one.steps) for one in sets if isinstance(one, FringeSet)
                   for gx, gy in (one.cycles_per_pixel,))  # fmt: skip
    brackets = tuple(replace(one, exposure_us=e) for one in sets if isinstance(one, FringeSet) for e in (1e3, 2e3))
    gray = (GraySet("v", 36.0, 6, inverse=True), FringeSet((0.0, 1 / 36.0), 8))
    for some in ((*sets, *across), brackets, gray):
        view = drawn_view(rig, camera, replace(usual.plan, sets=some))
        pipeline.scan_view(view, rig, s)
        pipeline.decode_view(view, s)
    told = Response("exponents", 1.1, 0.01, (0.02,), (0.01,), needed=True)
    pipeline.scan_view(replace(usual, response=told), rig, s)


@contextmanager
def in_background() -> Iterator[subprocess.Popen[bytes]]:
    """Runs `compile_kernels` in a process of its own; wait for it before the kernels are needed here.

    The process ends with the context at the latest.
    """
    command = [sys.executable, "-c", "from fringescope import warmup; warmup.compile_kernels()"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.terminate()
