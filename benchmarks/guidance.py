"""How long it takes from a confirmed stroke to the device's picture: beside drawing it with OpenCV where it lands.

    python benchmarks/guidance.py SCAN --rig rig.json [--points 400]

Prints medians of 25 in one run, ratios first. `frame` is the time of one frame at 60 Hz.
"""

from __future__ import annotations

import argparse
import statistics
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import cv2
import numpy as np

from fringescope import export, store
from fringescope.pipeline import guidance
from fringescope.settings import Settings
from fringescope.types import Guidelines, Stroke


def median_ms(work: Callable[[], object], repeats: int = 25) -> float:
    """Median time of a piece of work, ms, after one that does not count."""
    work()
    times = []
    for _ in range(repeats):
        start = perf_counter()
        work()
        times.append(1e3 * (perf_counter() - start))
    return statistics.median(times)


def main() -> None:
    ask = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    ask.add_argument("scan", type=Path)
    ask.add_argument("--rig", type=Path, required=True)
    ask.add_argument("--points", type=int, default=400)
    given = ask.parse_args()

    s, scan, rig = Settings(), store.read_scan(given.scan), store.read_rig(given.rig)
    assert scan.surface is not None
    surface = export.read_glb(scan.surface)
    prepare = median_ms(lambda: guidance.tissue_of(scan.grids, surface, rig, s), 3)
    tissue = guidance.tissue_of(scan.grids, surface, rig, s)
    rows, columns = np.nonzero(scan.grids[0].valid)
    (top, bottom), (left, right) = np.percentile(rows, [15, 85]), np.percentile(columns, [15, 85])
    t = np.linspace(0, 1, given.points)
    pixels = np.stack([left + (right - left) * t, top + (bottom - top) * (0.5 + 0.2 * np.sin(9 * t))], 1)
    guidelines = Guidelines((Stroke("a", camera=scan.grids[0].camera, pixels=pixels, width_mm=0.6),))
    made = guidance.project_guidance(guidelines, tissue, s)
    whole = median_ms(lambda: guidance.project_guidance(guidelines, tissue, s))

    def plain() -> None:
        image = np.zeros_like(made.image)
        for segment in made.strokes[0].segments:
            cv2.polylines(image, [np.round(16 * segment).astype(np.int32)], False, (255, 48, 48), 5, cv2.LINE_AA, 4)

    drawn = median_ms(plain)
    print(f"stroke of {given.points} points to the device's picture: {whole / drawn:.1f} times OpenCV's drawing alone,")
    print(f"  {whole / (1000 / 60):.2f} frames")
    print(f"{whole:.1f} ms; OpenCV {drawn:.1f} ms; making a scan ready, once: {prepare:.0f} ms")


if __name__ == "__main__":
    main()
