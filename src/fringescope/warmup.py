"""Compiles the kernels before they are needed: a tiny scan through the whole pipeline fills Numba's cache on disk."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from fringescope import geometry, patterns, pipeline, report
from fringescope.twin import presets
from fringescope.types import AnyArray, Camera, FrameKey, FringeSet, PixelFormat, Rig, ViewInput, ViewPlan

SCALE = 1 / 48  #: of the paper's cameras: 114 x 76 pixels, enough to reach every kernel


def drawn_view(rig: Rig, camera: Camera, plan: ViewPlan) -> ViewInput:
    """What a camera would see of a flat white plate through the working point, without a renderer."""
    L = camera.lens
    v, u = np.meshgrid(np.arange(L.height), np.arange(L.width), indexing="ij")
    origin, d = geometry.world_rays(camera, np.stack([u, v], -1))
    p = origin + d * (-origin[2] / d[..., 2])[..., None]
    bump = 0.02 * np.sin(3 * u) * np.cos(2 * v)
    p = p + d * bump[..., None]
    lit = geometry.field_of_view(Rig(rig.projector, (camera,)), p)

    def frames() -> Iterator[tuple[FrameKey, AnyArray]]:
        for key in plan.keys:
            one = plan.sets[key.set_index]
            if isinstance(one, FringeSet):
                phi = geometry.phase_at(rig.projector, one.cycles_per_pixel, p) - 2 * np.pi * key.number / one.steps
                yield key, np.where(lit, 100 + 80 * np.cos(np.nan_to_num(phi)), 2).round().astype(np.uint8)

    return ViewInput(plan, tuple(frames()), np.where(lit, 120, 3).astype(np.uint8))


def compile_kernels() -> int:
    """Runs the tiny scan and draws its surface; returns the number of points that it found."""
    rig = presets.instrument("paper", SCALE).rig
    formats = dict.fromkeys([c.name for c in rig.cameras], PixelFormat.BAYER_RG8)
    plan = patterns.paper_plan(rig, formats)
    views = [drawn_view(rig, c, v) for c, v in zip(rig.cameras, plan.views, strict=True)]
    scan = pipeline.scan(views, rig, all_points=True)
    if scan.surface is not None:
        report.render_surface(scan.surface, size=(64, 48))
    return len(scan.cloud)


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
