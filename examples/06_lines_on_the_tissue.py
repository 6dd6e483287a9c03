"""A stroke drawn in a photograph: to the tissue, to the projector's picture, shown, and found where it landed.

    python examples/06_lines_on_the_tissue.py OUT [SCALE]

The strokes are given in a camera's pixels. `project_guidance` tells for each what of it can be shown, and how exact;
`close_loop` shows the picture on the simulated instrument, photographs it, and measures how far the lines are from the
asked ones.
"""

import sys
from pathlib import Path

import numpy as np

from fringescope import capture, patterns, pipeline, store
from fringescope.devices import simulated
from fringescope.pipeline import closing, guidance
from fringescope.settings import Settings
from fringescope.types import Guidelines, Stroke, StrokeKind


def main(out: Path, scale: float = 0.125) -> None:
    out.mkdir(parents=True, exist_ok=True)
    s = Settings()
    with simulated.station(simulated.parse(f"sim://paper/tissue-domed?scale={scale}&seed=2")) as station:
        rig = station.rig
        images = [list(patterns.images(v, rig.projector)) for v in patterns.plan(rig).views]
        views = capture.collect(station.projector, station.cameras, station.light, images, patterns.plan(rig))
        scan = pipeline.scan(views, rig, s)

        lens = rig.cameras[0].lens
        t = np.linspace(0, 1, 50)
        cut = np.stack([(0.4 + 0.2 * t) * lens.width, (0.55 + 0.04 * np.sin(6 * t)) * lens.height], 1)
        strokes = (
            Stroke("cut", camera="camera1", pixels=cut, width_mm=0.8, color=(255, 255, 255)),
            Stroke("keep clear", StrokeKind.CIRCLE, camera="camera1", pixels=cut[:1], radius_mm=4, width_mm=0.4),
        )
        tissue = guidance.tissue_of(scan.grids, scan.surface, rig, s)
        made = guidance.project_guidance(Guidelines(strokes), tissue, s)
        for g in made.strokes:
            error = "unknown" if g.expected_error_um is None else f"{g.expected_error_um:.0f} um"
            print(f"{g.stroke.id}: {g.length_mm:.1f} mm, {g.visible:.0%} visible, expected error {error}")

        found = closing.close_loop(made, tissue, station, s)
        for x in found.landings:
            if x.median_um is not None:
                print(f"{x.id}: landed {x.median_um:.0f} um from where it was asked for (p95 {x.p95_um:.0f} um)")

    store.write_png(out / "pattern.png", made.image)
    for camera, picture in guidance.previews(made, tissue, scan.pictures, s).items():
        store.write_png(out / f"preview-{camera}.png", picture)


if __name__ == "__main__":
    if len(sys.argv) not in (2, 3):
        sys.exit(str(__doc__))
    main(Path(sys.argv[1]), *(float(x) for x in sys.argv[2:3]))
