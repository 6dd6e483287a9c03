"""Draws the pictures of README and docs from the digital twin: `make pictures`. The same code gives the same pictures.

    python tools/make_pictures.py [--scale 0.25] [--scene tissue-domed]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fringescope import capture, patterns, pipeline, report
from fringescope.devices import simulated
from fringescope.settings import Settings

OUT = Path(__file__).resolve().parents[1] / "docs" / "images"
VIEW = 1  #: the camera whose way is told


def save(name: str, rgb: NDArray[np.uint8], width: int) -> None:
    """A JPEG of at most `width` pixels: small enough for a repository, good enough for a page."""
    h, w = rgb.shape[:2]
    if w > width:
        rgb = cv2.resize(rgb, (width, round(h * width / w)), interpolation=cv2.INTER_AREA)
    OUT.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(OUT / name), rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 88])
    print(f"docs/images/{name}: {rgb.shape[1]} x {rgb.shape[0]}, {(OUT / name).stat().st_size // 1000} kB")


def main() -> None:
    """Scans a specimen on the simulated instrument and draws the way from fringes to colour."""
    ask = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    ask.add_argument("--scale", type=float, default=0.25)
    ask.add_argument("--scene", default="tissue-domed")
    given = ask.parse_args()

    s = Settings()
    with simulated.station(simulated.parse(f"sim://paper/{given.scene}?scale={given.scale}")) as station:
        rig = station.rig
        plan = patterns.paper_plan(rig)
        images = [patterns.images(view, rig.projector) for view in plan.views]
        views = capture.collect(station.projector, station.cameras, station.light, images, plan)
    scan = pipeline.scan(views, rig, s)
    assert scan.surface is not None
    for verdict in scan.verdicts:
        print("; ".join(verdict.words))

    view = views[VIEW]
    decoded, grid = pipeline.scan_view(view, rig, s)
    frames = dict(view.frames)
    last_set = max(key.set_index for key in frames)
    frame = next(frame for key, frame in frames.items() if key.set_index == last_set)
    save("story.jpg", report.story(frame, view.plan.pixel_format, decoded, grid, scan.surface), 1500)
    save("around.jpg", report.around(scan.surface), 1500)


if __name__ == "__main__":
    main()
