"""Times other people's decoders, in an environment of their own: prints one JSON object of seconds, or why not.

    PYTHON peers.py frames.npy REPEAT PLAN

`frames.npy` is (F, H, W) uint8, PLAN is JSON: {"steps": [4, 4, 8], "periods": [..], "length": ..}. `fringes` is GPL:
it is installed for this comparison alone, and nothing of ours imports it but this program.
"""

from __future__ import annotations

import json
import statistics
import sys
from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np


def median_time(once: Callable[[], object], repeat: int) -> float:
    """Median seconds of `repeat` calls, after one that nobody counts."""
    once()
    times = []
    for _ in range(repeat):
        start = perf_counter()
        once()
        times.append(perf_counter() - start)
    return statistics.median(times)


def by_fringes(frames: Any, plan: dict[str, Any], mode: str, repeat: int) -> float:
    """Seconds that `fringes` takes to decode (phases and orders, no points)."""
    from fringes import Fringes  # type: ignore[import-not-found,unused-ignore]

    length = round(plan["length"])
    f = Fringes(X=length, Y=length, mode=mode)
    f.axes = [0]
    f.v = [[length / p for p in plan["periods"]]]
    f.N = [plan["steps"]]
    if list(np.ravel(f.N)) != plan["steps"] or len(frames) != f.T:
        raise ValueError(f"it took N = {f.N}, {f.T} frames; needed {plan['steps']}")
    return median_time(lambda: f.decode(frames), repeat)


def main() -> None:
    """See the module."""
    frames, repeat, plan = np.load(sys.argv[1]), int(sys.argv[2]), json.loads(sys.argv[3])
    out: dict[str, float | str] = {}
    for mode in ("fast", "precise"):
        try:
            out[f"fringes {mode}"] = by_fringes(frames, plan, mode, repeat)
        except Exception as e:
            out[f"fringes {mode}"] = f"{type(e).__name__}: {e}"
    print(json.dumps(out))


if __name__ == "__main__":
    main()
