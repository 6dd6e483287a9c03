"""Frames to time on: a gently curved surface, exact for both lenses; noise in every pixel, a fifth of them dark."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fringescope import geometry, patterns
from fringescope.twin import presets
from fringescope.types import AnyArray, Camera, FringeSet, Lens, PixelFormat, Rig, ViewInput, ViewPlan

FULL = 5472 * 3648  #: pixels of the paper's cameras
ZOOM = 1.3  #: focal length over the paper's
BAND = 128  #: rows that are drawn at a time


def views_of(megapixels: float, count: int, steps: Sequence[int] = ()) -> tuple[Rig, list[ViewInput]]:
    """The paper's rig with sensors of so many pixels (more than the real ones are finer), and `count` views' frames.

    The lenses are a little longer than the paper's, so that fringes cover the pictures. `steps`: of the three sets, in
    place of the paper's 4, 4 and 8.
    """
    scale = math.sqrt(megapixels * 1e6 / FULL)
    rig = presets.instrument("paper", min(scale, 1.0)).rig
    rig = Rig(rig.projector, tuple(_zoomed(c, max(scale, 1.0)) for c in rig.cameras), rig.volume)
    plan = patterns.paper_plan(rig, PixelFormat.MONO8)
    views = [_with_steps(v, steps) if steps else v for v in plan.views[:count]]
    return rig, [view_of(rig, v, np.random.default_rng(i)) for i, v in enumerate(views)]


def _with_steps(plan: ViewPlan, steps: Sequence[int]) -> ViewPlan:
    sets = [replace(one, steps=n) for one, n in zip(plan.sets, steps, strict=True) if isinstance(one, FringeSet)]
    return replace(plan, sets=tuple(sets))


def _zoomed(camera: Camera, scale: float) -> Camera:
    lens = presets.scaled(camera.lens, scale) if scale > 1.0 else camera.lens
    K = lens.K.copy()
    K[0, 0] *= ZOOM
    K[1, 1] *= ZOOM
    return Camera(camera.name, Lens(lens.width, lens.height, K, lens.distortion), camera.pose)


def view_of(rig: Rig, plan: ViewPlan, rng: np.random.Generator) -> ViewInput:
    """One camera's frames."""
    lens = rig.camera(plan.camera).lens
    frames = [np.empty((lens.height, lens.width), np.uint8) for _ in plan.keys]
    for row in range(0, lens.height, BAND):
        _draw(rig, plan, row, min(row + BAND, lens.height), rng, frames)
    return ViewInput(plan, list(zip(plan.keys, frames, strict=True)))


def _draw(rig: Rig, plan: ViewPlan, first: int, last: int, rng: np.random.Generator, frames: list[AnyArray]) -> None:
    camera = rig.camera(plan.camera)
    v, u = np.mgrid[first:last, : camera.lens.width].astype(float)
    origin, ray = geometry.world_rays(camera, np.stack([u, v], axis=-1))
    z = np.zeros_like(u)
    for _ in range(3):  # the ray meets z(x, y) after a few steps
        p = origin + ray * ((z - origin[2]) / ray[..., 2])[..., None]
        z = 4.0 * np.cos(p[..., 0] / 18) * np.cos(p[..., 1] / 14)
    at = geometry.project(rig.projector, p)
    lit = np.hypot(u / (camera.lens.width - 1) - 0.5, v / (camera.lens.height - 1) - 0.5) < 0.505
    for key, frame in zip(plan.keys, frames, strict=True):
        fringes = plan.sets[key.set_index]
        assert isinstance(fringes, FringeSet)
        turn = (at @ np.array(fringes.cycles_per_pixel) - key.number / fringes.steps).astype(np.float32)
        signal = np.where(lit, 90 + 60 * np.cos(np.float32(2 * np.pi) * turn), np.float32(1))
        signal += np.float32(1.2) * rng.standard_normal(u.shape, dtype=np.float32)
        frame[first:last] = np.clip(np.rint(signal), 0, 255)
