"""Times other people's decoders on the frames of `scan.py`, in an environment of their own; prints one JSON object.

    build/peers/bin/python benchmarks/peers.py frames.npy REPEAT PLAN

`frames.npy` is (F, H, W) uint8, PLAN is JSON: {"steps": [4, 4, 8], "periods": [.., .., ..], "length": ..}. `fringes` is
GPL: it is installed by `make bench` for this comparison alone, and nothing of ours imports it.
"""

import json
import statistics
import sys
from time import perf_counter

import numpy as np


def median_time(once, repeat):
    once()
    times = []
    for _ in range(repeat):
        start = perf_counter()
        once()
        times.append(perf_counter() - start)
    return statistics.median(times)


def by_fringes(frames, plan, mode, repeat):
    from fringes import Fringes

    length = round(plan["length"])
    f = Fringes(X=length, Y=length, mode=mode)
    f.axes = [0]
    f.v = [[length / p for p in plan["periods"]]]
    f.N = [plan["steps"]]
    if list(np.ravel(f.N)) != plan["steps"] or f.T != len(frames):
        raise ValueError(f"it took N = {f.N}, {f.T} frames; needed {plan['steps']}")
    return median_time(lambda: f.decode(frames), repeat)


def by_opencv(frames, repeat):
    """OpenCV decodes one set of three steps only: three of the frames, so scaled it flatters OpenCV."""
    import cv2

    params = cv2.structured_light.SinusoidalPattern.Params()
    params.width, params.height = frames.shape[2], frames.shape[1]
    params.setMarkers, params.methodId, params.horizontal = False, 1, False  # phase-shifting profilometry
    pattern = cv2.structured_light.SinusoidalPattern.create(params)
    three = [np.ascontiguousarray(f) for f in frames[:3]]
    return median_time(lambda: pattern.computePhaseMap(three), repeat)


def main():
    frames, repeat, plan = np.load(sys.argv[1], mmap_mode=None), int(sys.argv[2]), json.loads(sys.argv[3])
    out = {}
    for name, run in (
        ("fringes fast", lambda: by_fringes(frames, plan, "fast", repeat)),
        ("fringes precise", lambda: by_fringes(frames, plan, "precise", repeat)),
        ("opencv, one set of three", lambda: by_opencv(frames, repeat)),
    ):
        try:
            out[name] = run()
        except Exception as e:
            out[name] = f"{type(e).__name__}: {e}"
    print(json.dumps(out))


if __name__ == "__main__":
    main()
