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
from fringescope.pipeline import guidance
from fringescope.settings import Settings
from fringescope.types import Fill, Guidelines, Rig, Scan, Stroke, StrokeKind

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


def guided(scan: Scan, rig: Rig, s: Settings) -> NDArray[np.uint8]:
    """Strokes in the first camera's photograph, and the picture that the projector shows for them."""
    lens = rig.cameras[0].lens

    def at(x: object, y: object) -> NDArray[np.float64]:
        return np.stack(np.broadcast_arrays(np.asarray(x) * lens.width, np.asarray(y) * lens.height), -1)

    t = np.linspace(0, 1, 60)
    box = np.array([[0.50, 0.52], [0.62, 0.50], [0.66, 0.62], [0.55, 0.68], [0.48, 0.63]])
    strokes = (
        Stroke("cut", camera="camera1", pixels=at(0.25 + 0.5 * t, 0.42 + 0.04 * np.sin(7 * t)), width_mm=0.7),
        Stroke("sections", StrokeKind.OFFSETS, camera="camera1", pixels=at([0.30, 0.45], [0.55, 0.53]), width_mm=0.3,
               spacing_mm=3, count=3, color=(0, 255, 128)),
        Stroke("sample", StrokeKind.REGION, camera="camera1", pixels=at(box[:, 0], box[:, 1]), fill=Fill.HATCH,
               spacing_mm=1.5, width_mm=0.25, color=(64, 160, 255)),
        Stroke("keep clear", StrokeKind.CIRCLE, camera="camera1", pixels=at([0.36], [0.66]), radius_mm=4, width_mm=0.4,
               color=(255, 255, 255)),
        Stroke("label", StrokeKind.TEXT, camera="camera1", pixels=at([0.60, 0.70], [0.33, 0.34]), text="margin 5 mm",
               size_mm=3.5, color=(255, 224, 0)),
    )  # fmt: skip
    tissue = guidance.tissue_of(scan.grids, scan.surface, rig, s)
    made = guidance.project_guidance(Guidelines(strokes), tissue, s)
    preview = guidance.previews(made, tissue, scan.pictures, s)["camera1"]
    device = cv2.resize(np.asarray(report.plane_light(made.image, rig.projector) * 255, np.uint8), None, fx=1, fy=1)
    high = preview.shape[0]
    device = cv2.resize(device, (round(high * device.shape[1] / device.shape[0]), high), interpolation=cv2.INTER_AREA)
    return np.hstack([preview, np.full((high, 12, 3), 255, np.uint8), device])


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
    save("guidance.jpg", guided(scan, rig, s), 1500)
    save("around.jpg", report.around(scan.surface), 1500)


if __name__ == "__main__":
    main()
