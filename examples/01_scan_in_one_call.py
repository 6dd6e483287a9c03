"""The first door: record a view with each camera, call `pipeline.scan`, write the result.

    python examples/01_scan_in_one_call.py OUT [SCALE]

The instrument here is the simulated one; a real station is opened by its URI in the same way.
"""

import sys
from pathlib import Path

from fringescope import capture, export, patterns, pipeline
from fringescope.devices import simulated


def main(out: Path, scale: float = 0.125) -> None:
    with simulated.station(simulated.parse(f"sim://paper/tissue-domed?scale={scale}")) as station:
        rig = station.rig  # from a file: store.read_rig("rig.json")
        plan = patterns.plan(rig)
        images = [patterns.images(view, rig.projector) for view in plan.views]
        views = capture.collect(station.projector, station.cameras, station.light, images, plan)

    scan = pipeline.scan(views, rig)

    for verdict in scan.verdicts:
        print(f"{verdict.camera}: {verdict.points} of {verdict.pixels} pixels; {'; '.join(verdict.words)}")
    out.mkdir(parents=True, exist_ok=True)
    export.write_ply(scan.cloud, out / "cloud.ply")
    if scan.surface is not None:
        export.write_glb(scan.surface, out / "surface.glb")
    print(f"{len(scan.cloud)} points in {out / 'cloud.ply'}")


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(str(__doc__))
    main(Path(sys.argv[1]), *(float(x) for x in sys.argv[2:3]))
