"""Times the stages of a scan against a plain copy of the same memory, all in one run, and prints the ratios.

A second tells about the machine; a ratio tells about the program. The floor is a parallel copy, on all cores, of
touched memory: the raw frames as stored, plus 17 bytes a pixel of output (xyz, sigma, reason). Frames carry noise in
every pixel, 20 % of the pixels are dark, and both lenses distort.

    python benchmarks/stages.py [--scale 0.125] [--repeat 9] [--out build/bench.json]
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import statistics
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter

import numpy as np

from fringescope import __version__, denoise, geometry, patterns, phase, pipeline, triangulate
from fringescope.settings import Settings
from fringescope.twin import presets
from fringescope.types import FringeSet, PixelFormat, Rig, ViewInput, ViewPlan

BYTES_OUT = 17  #: xyz, sigma, reason of a pixel


def make_view(rig: Rig, plan: ViewPlan, rng: np.random.Generator) -> ViewInput:
    """Frames of a gently curved surface, exact for both lenses, with noise and a fifth of the pixels in the dark."""
    camera = rig.camera(plan.camera)
    v, u = np.mgrid[: camera.lens.height, : camera.lens.width].astype(float)
    origin, ray = geometry.world_rays(camera, np.stack([u, v], axis=-1))
    z = np.zeros_like(u)
    for _ in range(3):  # the ray meets z(x, y) after a few steps
        p = origin + ray * ((z - origin[2]) / ray[..., 2])[..., None]
        z = 4.0 * np.cos(p[..., 0] / 18) * np.cos(p[..., 1] / 14)
    at = geometry.project(rig.projector, p)
    lit = np.hypot(u / u.max() - 0.5, v / v.max() - 0.5) < 0.505
    frames = []
    for key in plan.keys:
        fringes = plan.sets[key.set_index]
        assert isinstance(fringes, FringeSet)
        turn = at @ np.array(fringes.cycles_per_pixel) - key.number / fringes.steps
        signal = np.where(lit, 90 + 60 * np.cos(2 * np.pi * turn), 1.0)
        frames.append((key, np.clip(np.rint(signal + rng.normal(0, 1.2, u.shape)), 0, 255).astype(np.uint8)))
    return ViewInput(plan, frames)


def copy_floor(views: list[ViewInput], repeat: int) -> float:
    """Seconds to copy what must at least be read and written."""
    size = sum(frame.nbytes for view in views for _, frame in view.frames)
    size += sum(next(iter(view.frames))[1].size * BYTES_OUT for view in views)
    cores = os.cpu_count() or 1
    source, target = np.ones(size, np.uint8), np.ones(size, np.uint8)
    edges = np.linspace(0, size, cores * 8 + 1).astype(int).tolist()
    parts = [slice(a, b) for a, b in itertools.pairwise(edges)]
    with ThreadPoolExecutor(cores) as pool:

        def once() -> None:
            list(pool.map(lambda part: np.copyto(target[part], source[part]), parts))

        return median_time(once, repeat)


def median_time(once: Callable[[], object], repeat: int) -> float:
    """Median seconds of `repeat` calls, after one that nobody counts."""
    once()
    times = []
    for _ in range(repeat):
        start = perf_counter()
        once()
        times.append(perf_counter() - start)
    return statistics.median(times)


def main() -> None:
    """Prints the table, and writes JSON where asked."""
    ask = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    ask.add_argument("--scale", type=float, default=0.125, help="of the paper's sensors: 0.125 is 684 x 456")
    ask.add_argument("--repeat", type=int, default=9)
    ask.add_argument("--out", type=Path)
    given = ask.parse_args()

    s = Settings()
    rig = presets.instrument("paper", given.scale).rig
    plan = patterns.paper_plan(rig, PixelFormat.MONO8)
    rng = np.random.default_rng(0)
    views = [make_view(rig, view, rng) for view in plan.views]
    view = views[0]

    wrapped = phase.measure(view.frames, view.plan, s.phase)
    decoded = phase.settle_order(wrapped, view.plan, s.phase, rig)
    exposed = denoise.exposed(decoded, view.plan.pixel_format, s.denoise)
    stages: dict[str, Callable[[], object]] = {
        "measure": lambda: phase.measure(view.frames, view.plan, s.phase),
        "settle_order": lambda: phase.settle_order(wrapped, view.plan, s.phase, rig),
        "monotonic": lambda: denoise.monotonic(decoded, exposed, rig, s.denoise),
        "connected": lambda: denoise.connected(decoded, exposed, rig, s.denoise),
        "local": lambda: denoise.local(decoded, exposed, rig, s.denoise),
        "triangulate": lambda: triangulate.grid(decoded, exposed, rig),
    }
    floor_one, floor_all = copy_floor(views[:1], given.repeat), copy_floor(views, given.repeat)
    seconds = {name: median_time(once, given.repeat) for name, once in stages.items()}
    view_s = median_time(lambda: pipeline.scan_view(view, rig, s), given.repeat)
    all_s = median_time(lambda: [pipeline.scan_view(v, rig, s) for v in views], max(3, given.repeat // 3))

    camera = rig.cameras[0].lens
    result = {
        "date": datetime.now(UTC).date().isoformat(),
        "version": __version__,
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "camera": [camera.width, camera.height],
        "frames": len(view.plan.keys),
        "copy_floor_s": floor_one,
        "stages_over_copy": {name: t / floor_one for name, t in seconds.items()},
        "decode_triangulate_over_copy": sum(seconds[n] for n in ("measure", "settle_order", "triangulate")) / floor_one,
        "one_view_over_copy": view_s / floor_one,
        "three_views_s": all_s,
        "three_views_over_copy": all_s / floor_all,
    }
    print(f"{camera.width} x {camera.height}, {len(view.plan.keys)} frames a view; copy floor {floor_one * 1e3:.2f} ms")
    for name, t in seconds.items():
        print(f"  {name:14} {t * 1e3:8.1f} ms  {t / floor_one:8.1f} x copy")
    print(f"  {'one view':14} {view_s * 1e3:8.1f} ms  {view_s / floor_one:8.1f} x copy")
    print(f"  {'three views':14} {all_s * 1e3:8.1f} ms  {all_s / floor_all:8.1f} x copy")
    if given.out:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(result, indent=1) + "\n")
        print(given.out)


if __name__ == "__main__":
    main()
