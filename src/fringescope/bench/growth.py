"""How the cost of a view grows with its pixels, its frames, and the cores that work on it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping
from typing import Any

from fringescope.bench.frames import views_of
from fringescope.errors import FringescopeError
from fringescope.types import Rig, ViewInput

SIZES = (0.25, 1.0, 5.0, 20.0, 80.0)  #: megapixels
STEPS = ((4, 4, 4), (4, 4, 8), (8, 8, 16), (16, 16, 32))  #: of the three sets
FEW = 5.0  #: megapixels for what does not grow with pixels

Times = Mapping[str, float]
Timer = Callable[[Rig, ViewInput], Times]
Tell = Callable[[str, float], None]


def pixels(megapixels: float, own: Times, timer: Timer, tell: Tell) -> dict[str, dict[str, float]]:
    """Nanoseconds a pixel for pictures of several sizes; `own` are the seconds of that of `megapixels`."""
    out = {}
    for size in sorted({*SIZES, megapixels}):
        tell(f"{size:g} megapixels", 0.85)
        one = own
        if size != megapixels:
            rig, views = views_of(size, 1)
            one = timer(rig, views[0])
            del views
        out[f"{size:g}"] = {name: 1e3 * t / size for name, t in one.items()}
    return out


def frames(timer: Timer, tell: Tell) -> dict[str, dict[str, float]]:
    """Nanoseconds a pixel for more and fewer frames."""
    out = {}
    for steps in STEPS:
        tell(f"{sum(steps)} frames", 0.9)
        rig, views = views_of(FEW, 1, steps)
        out[str(sum(steps))] = {name: 1e3 * t / FEW for name, t in timer(rig, views[0]).items()}
    return out


_ALONE = """
import json, os, sys
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:int(sys.argv[1])])
from fringescope import bench
print(json.dumps(bench.one_view_of(float(sys.argv[2]), int(sys.argv[3]))))
"""


def cores(repeat: int, tell: Tell) -> dict[str, dict[str, float]]:
    """Nanoseconds a pixel on 1, 2, 4 .. of the cores that there are, each in a process of its own; {} if it cannot be
    said on which cores a process runs. Raises FringescopeError if such a process fails.
    """
    if not hasattr(os, "sched_setaffinity"):
        return {}
    there = len(os.sched_getaffinity(0))
    out: dict[str, dict[str, float]] = {}
    for n in sorted({there, *(1 << k for k in range(there.bit_length()) if 1 << k <= there)}):
        tell(f"{n} cores", 0.95)
        command = [sys.executable, "-c", _ALONE, str(n), str(FEW), str(repeat)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            said = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
            raise FringescopeError(f"the run on {n} of {there} cores ended with status {done.returncode}: {said}")
        times: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
        out[str(n)] = {name: 1e3 * t / FEW for name, t in times.items()}
    return out
