"""Phase from frames that are already arrays, without files and without a rig.

    python examples/04_your_own_arrays.py
"""

import numpy as np

from fringescope import pipeline
from fringescope.settings import Settings
from fringescope.types import FrameKey, FringeSet, PixelFormat, Role, ViewInput, ViewPlan


def main() -> float:
    # A camera of 320 x 240 pixels sees the projector column u at each pixel: a tilted ramp with a bump.
    v, x = np.mgrid[:240, :320]
    u = 300 + 1.1 * x + 0.2 * v + 12 * np.exp(-((x - 160) ** 2 + (v - 120) ** 2) / 1800)
    sets = tuple(FringeSet((1 / period, 0.0), steps) for period, steps in ((960, 4), (160, 4), (32, 8)))
    plan = ViewPlan("camera1", PixelFormat.MONO8, sets, projector_size=(912, 1140))

    rng = np.random.default_rng(1)
    frames = []
    for i, fringes in enumerate(sets):
        for n in range(fringes.steps):
            intensity = 100 + 60 * np.cos(2 * np.pi * (u * fringes.frequency - n / fringes.steps))
            noisy = np.clip(np.rint(intensity + rng.normal(0, 1.2, u.shape)), 0, 255)
            frames.append((FrameKey(i, Role.STEP, n), noisy.astype(np.uint8)))

    decoded = pipeline.decode_view(ViewInput(plan, frames), Settings())

    direction = decoded.directions[0]
    error = direction.phase / (2 * np.pi * direction.g[0]) - u
    rms = float(np.sqrt(np.nanmean(error**2)))
    expected = float(np.nanmedian(direction.sigma)) / (2 * np.pi * direction.g[0])
    print(f"projector column: rms error {rms:.4f} units; predicted {expected:.4f}")
    return rms


if __name__ == "__main__":
    main()
