"""What accuracy to expect, and how likely a wrong fringe order is, before a single frame is taken.

    python examples/03_plan_before_you_capture.py
"""

from fringescope import patterns
from fringescope.twin import presets
from fringescope.types import NoiseModel


def main() -> None:
    rig = presets.instrument("paper", 0.125).rig
    noise = NoiseModel(a=0.5, b=0.02)  # variance of a raw sample, codes squared
    plans = {
        "Table I, tilted": patterns.paper_plan(rig),
        "Table I, horizontal": patterns.horizontal_plan(rig),
        "ours": patterns.plan(rig),
    }
    for name, plan in plans.items():
        for view in plan.views:
            p = patterns.predict(rig, view, noise, modulation=60, background=90)
            frames = len(view.keys)
            sigma, wrong = p.depth_sigma_mm[0] * 1000, p.order_error
            print(f"{name:20} {view.camera}: {frames} frames, sigma {sigma:.1f} um, wrong orders {wrong:.1e}")


if __name__ == "__main__":
    main()
