"""Frames are worked on as they arrive: views that are there while others are recorded, coarse sets before the finest.

    python examples/05_scan_while_it_records.py OUT [SCALE]

`capture.stream` plays a view's patterns when its frames are asked for, and `pipeline.scan` asks in a thread of its own:
the instrument never waits for the work on what it has recorded. The coarse surface is written as soon as the last frame
has come.
"""

import sys
from pathlib import Path

from fringescope import capture, export, patterns, pipeline
from fringescope.devices import simulated
from fringescope.types import Surface, ViewInput


def main(out: Path, scale: float = 0.125) -> None:
    out.mkdir(parents=True, exist_ok=True)

    def show(coarse: Surface) -> None:
        export.write_glb(coarse, out / "coarse.glb")
        print(f"coarse surface: {coarse.n_faces} triangles")

    with simulated.station(simulated.parse(f"sim://paper/tissue-domed?scale={scale}")) as station:
        rig = station.rig
        assert station.light is not None
        photos = capture.photograph(station.projector, station.cameras, station.light)
        views = []
        for view, camera, photo in zip(patterns.plan(rig).views, station.cameras, photos, strict=True):
            images = patterns.images(view, rig.projector)
            views.append(ViewInput(view, capture.stream(station.projector, camera, images, view), photo))
        scan = pipeline.scan(views, rig, first=show)  # the first pattern is played here

    export.write_ply(scan.cloud, out / "cloud.ply")
    if scan.surface is not None:
        export.write_glb(scan.surface, out / "surface.glb")
    print(f"{len(scan.cloud)} points in {out / 'cloud.ply'}")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(str(__doc__))
    main(Path(sys.argv[1]), *(float(x) for x in sys.argv[2:3]))
