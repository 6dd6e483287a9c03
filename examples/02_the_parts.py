"""The second door: the steps of `pipeline.scan_view` by hand, and what each of them takes away.

    python examples/02_the_parts.py [SCALE]
"""

import sys

import numpy as np

from fringescope import capture, denoise, patterns, phase, triangulate
from fringescope.devices import simulated
from fringescope.settings import Settings


def main(scale: float = 0.125) -> None:
    s = Settings()
    with simulated.station(simulated.parse(f"sim://single/tissue-folded?scale={scale}")) as station:
        rig = station.rig
        formats = {v.name: f for v, f in zip(rig.cameras, station.world.instrument.pixel_formats, strict=True)}
        plan = patterns.plan(rig, formats)
        images = [patterns.images(view, rig.projector) for view in plan.views]
        (view,) = capture.collect(station.projector, station.cameras, None, images, plan)

    decoded = phase.measure(view.frames, view.plan, s.phase)  # wrapped phases, background, modulation, noise
    decoded = phase.settle_order(decoded, view.plan, s.phase, rig)  # absolute phase
    masks = {"as decoded": decoded.reasons}
    masks["background and modulation"] = denoise.exposed(decoded, view.plan.pixel_format, s.denoise)
    masks["monotonicity"] = denoise.monotonic(decoded, masks["background and modulation"], rig, s.denoise)
    masks["jumps and islands"] = denoise.connected(decoded, masks["monotonicity"], rig, s.denoise)
    masks["local surface"] = denoise.local(decoded, masks["jumps and islands"], rig, s.denoise)
    for name, reasons in masks.items():
        print(f"{name:26} leaves {np.count_nonzero(reasons == 0)} of {reasons.size} pixels")

    grid = triangulate.grid(decoded, masks["local surface"], rig)
    pinhole = triangulate.grid(decoded, masks["local surface"], rig, pinhole=True)  # equation 15, without distortion
    both = grid.valid & pinhole.valid
    away = np.linalg.norm(grid.xyz[both] - pinhole.xyz[both], axis=-1)
    print(f"{np.count_nonzero(grid.valid)} points, sigma {np.median(grid.sigma[grid.valid]) * 1000:.1f} um (median)")
    print(f"leaving out the lenses' distortion would move them by {np.median(away) * 1000:.0f} um (median)")


if __name__ == "__main__":
    main(*(float(x) for x in sys.argv[1:2]))
