"""Decoding and triangulating on a GPU: is it equal to the processor, and how long do the steps take?

    python benchmarks/gpu.py --megapixels 20 --repeat 7

Frames of three views lie in ordinary memory. Prints one JSON object: the card; per view how far the results are from
the processor's; medians of the steps of one view when each waits for the one before; three views with all steps at
once, with all results, with points alone, with statistics and the vote on orders (`decode`), with the masks
(`scan_view`); the processor beside it; ratios. Status 1 if the results are not equal within the bounds of
tests/on_gpu.py.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np

from fringescope import gpu, pipeline
from fringescope.bench.frames import views_of
from fringescope.bench.peers import median_time
from fringescope.pipeline import fast
from fringescope.pipeline import gpu as on_gpu
from fringescope.settings import Settings
from fringescope.types import AnyArray, Reason, Rig, ViewInput

NAMES = ("phase", "sigma", "background", "modulation", "reasons", "xyz", "sigma_mm")
POINTS = ("reasons", "xyz", "sigma_mm")
TARGET_S = 0.150  #: three views of 20 megapixels on an H100


def room(way: fast.Way) -> list[AnyArray]:
    """Touched arrays for all results of a view."""
    H, W = way.frames[0].shape
    return [np.zeros((H, W, 3)[: 3 if f.channels else 2], f.dtype) for f in on_gpu.FIELDS]


def parts(way: fast.Way) -> tuple[Any, ...]:
    return way.frames, way.sets, way.limits, way.bounds, way.usual, way.depths


def apart(way: fast.Way) -> dict[str, float]:
    """Share of pixels with other reasons, and the largest differences where both have none."""
    want, got = room(way), room(way)
    fast.on_cpu(way, tuple(want))
    on_gpu.by_slabs(*parts(way), got)
    dark = ((want[4] | got[4]) & (Reason.DARK | Reason.LOW_MODULATION)) != 0
    good = (want[4] == 0) & (got[4] == 0)
    off = {n: np.abs(a[good].astype(float) - b[good]) for n, a, b in zip(NAMES, want, got, strict=True)}
    largest = np.float32(np.abs(want[0][good]).max())
    return {
        "valid": float(good.mean()),
        "other_reasons": float(((want[4] != got[4]) & ~dark).mean()),
        "phase_rad": float(off["phase"].max()),
        "phase_rad_allowed": float(4 * np.spacing(largest)),
        "xyz_mm": float(off["xyz"].max()),
        "sigma_share": float((off["sigma"] / want[1][good]).max()),
    }


def equal(one: dict[str, float]) -> bool:
    close = one["phase_rad"] <= one["phase_rad_allowed"] and one["xyz_mm"] <= 5e-5
    return close and one["other_reasons"] <= 0.002 and one["valid"] > 0.2


def steps(way: fast.Way, repeat: int) -> dict[str, float]:
    """Medians of the steps of one view, one after the other, and the rates of the transfers."""
    out = room(way)
    lanes, launch = on_gpu.prepared(*parts(way))
    lanes.timed(way.frames, launch, out, perf_counter)
    runs = [lanes.timed(way.frames, launch, out, perf_counter) for _ in range(repeat)]
    mid = gpu.Times(*np.median(runs, axis=0).tolist())
    into, back = sum(f.nbytes for f in way.frames) / 1e9, sum(a.nbytes for a in out) / 1e9
    rates = {"stage": into / mid.stage, "upload": into / mid.upload, "download": back / mid.download,
             "collect": back / mid.collect}  # fmt: skip
    return {f"{n}_s": t for n, t in mid._asdict().items()} | {f"{n}_GB_per_s": r for n, r in rates.items()}


def three(
    rig: Rig, views: list[ViewInput], ways: list[fast.Way], repeat: int, tell: Callable[[str], None]
) -> dict[str, float]:
    """Medians of three views, on the GPU and on the processor."""
    s = Settings()
    outs = [room(way) for way in ways]
    few = [[a if n in POINTS else None for n, a in zip(NAMES, out, strict=True)] for out in outs]
    pairs = list(zip(ways, outs, strict=True))
    jobs: dict[str, Callable[[], Any]] = {
        "gpu_all_results_s": lambda: [on_gpu.by_slabs(*parts(w), o) for w, o in pairs],
        "gpu_points_s": lambda: [on_gpu.by_slabs(*parts(w), o) for w, o in zip(ways, few, strict=True)],
        "cpu_all_results_s": lambda: [fast.on_cpu(w, tuple(o)) for w, o in pairs],
        "statistics_s": lambda: [fast.way_of(v, rig, s) for v in views],
        "gpu_decode_s": lambda: [fast.decode(v, rig, s, "gpu") for v in views],
        "cpu_decode_s": lambda: [fast.decode(v, rig, s) for v in views],
        "gpu_scan_view_s": lambda: [pipeline.scan_view(v, rig, s, device="gpu") for v in views],
        "cpu_scan_view_s": lambda: [pipeline.scan_view(v, rig, s) for v in views],
    }
    out = {}
    for name, job in jobs.items():
        tell(name)
        out[name] = median_time(job, repeat if name.startswith("gpu") else max(1, repeat // 3))
    return out


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--megapixels", type=float, default=20.0)
    p.add_argument("--repeat", type=int, default=7)
    a = p.parse_args()
    on_gpu.require()

    def tell(what: str) -> None:
        print(f"{perf_counter() - begun:6.1f} s  {what}", file=sys.stderr, flush=True)

    begun = perf_counter()
    tell("drawing frames")
    rig, views = views_of(a.megapixels, 3)
    ways = [way for view in views if (way := fast.way_of(view, rig, Settings())) is not None]
    tell("comparing with the processor (compiles first)")
    off = [apart(way) for way in ways]
    tell("steps")
    one = steps(ways[0], a.repeat)
    times = three(rig, views, ways, a.repeat, tell)
    H, W = ways[0].frames[0].shape
    result = {
        "gpu": gpu.name(),
        "cores": os.cpu_count(),
        "camera": [W, H],
        "frames": len(ways[0].frames),
        "equal": all(equal(o) for o in off),
        "apart": off,
        "one_view_step_by_step": one,
        "three_views": times,
        "target_s": TARGET_S,
        "gpu_over_target": times["gpu_all_results_s"] / TARGET_S,
        "cpu_over_gpu": times["cpu_all_results_s"] / times["gpu_all_results_s"],
    }
    print(json.dumps(result, indent=1))
    return 0 if result["equal"] else 1


if __name__ == "__main__":
    sys.exit(main())
