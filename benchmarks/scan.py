"""Times a scan of the paper's plan from raw frames in memory, beside a plain copy of its bytes and beside other decoders.

All in one run on the same frames; a second tells about the machine, a ratio about the program. The floor is a parallel
copy, on all cores, of touched memory: the raw frames as stored, plus 17 bytes a pixel of output (xyz, sigma, reason).
Frames carry noise in every pixel, a fifth of the pixels are dark, and both lenses distort.

    python benchmarks/scan.py [--megapixels 20] [--repeat 5] [--growth] [--peers build/peers/bin/python] [--out X.json]
"""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import resource
import subprocess
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from stages import copy_floor, make_view, median_time

from fringescope import __version__, denoise, geometry, patterns, phase, pipeline, triangulate
from fringescope.pipeline import fast
from fringescope.settings import Settings
from fringescope.twin import presets
from fringescope.types import FringeSet, PixelFormat, ViewInput

FULL = 5472 * 3648  #: pixels of the paper's cameras


def plain_numpy(view: ViewInput) -> list[np.ndarray]:
    """What people write first: the N-step formula on arrays, no order, no points."""
    out = []
    for n, one in enumerate(view.plan.sets):
        assert isinstance(one, FringeSet)
        frames = [f for key, f in view.frames if key.set_index == n]
        angle = 2 * np.pi * np.arange(one.steps) / one.steps
        s = sum(f * np.float32(math.sin(a)) for f, a in zip(frames, angle, strict=True))
        c = sum(f * np.float32(math.cos(a)) for f, a in zip(frames, angle, strict=True))
        out.append(np.arctan2(s, c))
    return out


def views_at(megapixels: float, count: int = 3) -> tuple[Any, list[ViewInput]]:
    """The rig with sensors of so many pixels, and its views' frames."""
    rig = presets.instrument("paper", min(1.0, math.sqrt(megapixels * 1e6 / FULL))).rig
    plan = patterns.paper_plan(rig, PixelFormat.MONO8)
    return rig, [make_view(rig, v, np.random.default_rng(i)) for i, v in enumerate(plan.views[:count])]


def one_view(rig: Any, view: ViewInput, repeat: int) -> dict[str, float]:
    """Seconds of the floor, of decoding with triangulation, of what comes after, and of the whole view."""
    s = Settings()
    decoded, xyz, sigma = fast.decode(view, rig, s) or (None, None, None)
    assert decoded is not None
    d = s.denoise
    backward = denoise.monotonic(decoded, decoded.reasons, rig, d)
    linked = denoise.connected(decoded, backward, rig, d)
    return {
        "copy floor": copy_floor([view], max(repeat, 9)),
        "decode + triangulate": median_time(lambda: fast.decode(view, rig, s), repeat),
        "monotonicity": median_time(lambda: denoise.monotonic(decoded, decoded.reasons, rig, d), repeat),
        "domains": median_time(lambda: denoise.connected(decoded, backward, rig, d), repeat),
        "local surface": median_time(lambda: denoise.local(decoded, linked, rig, d), repeat),
        "blanking": median_time(lambda: triangulate.blanked(xyz, sigma, linked, rig, decoded.camera), repeat),
        "one view": median_time(lambda: pipeline.scan_view(view, rig, s), repeat),
    }


def others(view: ViewInput, rig: Any, python: Path | None, repeat: int) -> dict[str, Any]:
    """Seconds of other decoders on the same frames (or why there are none)."""
    out: dict[str, Any] = {"numpy, wrapped phase only": median_time(lambda: plain_numpy(view), 1)}
    out["the stages, decode alone"] = median_time(
        lambda: phase.settle_order(phase.measure(view.frames, view.plan, Settings().phase), view.plan,
                                   Settings().phase, rig), 1)  # fmt: skip
    if python is None or not python.exists():
        return out
    sets = [one for one in view.plan.sets if isinstance(one, FringeSet)]
    g = sets[-1].cycles_per_pixel
    low, high = phase.field_bounds(g, view.plan.projector_size)
    plan = {
        "steps": [one.steps for one in sets],
        "periods": [1 / math.hypot(*one.cycles_per_pixel) for one in sets],
        "length": (high - low) / (2 * math.pi * math.hypot(*g)),
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "frames.npy"
        np.save(file, np.stack([f for _, f in view.frames]))
        command = [str(python), str(Path(__file__).with_name("peers.py")), str(file), str(repeat), json.dumps(plan)]
        done = subprocess.run(command, capture_output=True, text=True)
    return out | (json.loads(done.stdout.splitlines()[-1]) if done.returncode == 0 else {"peers": done.stderr[-200:]})


def main() -> None:
    """Prints ratios, then times, and writes JSON where asked."""
    ask = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    ask.add_argument("--megapixels", type=float, default=20.0)
    ask.add_argument("--repeat", type=int, default=5)
    ask.add_argument("--growth", action="store_true", help="also 0.25, 1, 5 megapixels")
    ask.add_argument("--peers", type=Path, help="a Python with the packages of benchmarks/peers.txt")
    ask.add_argument("--whole", action="store_true", help="also three views to a coloured cloud and meshes")
    ask.add_argument("--out", type=Path)
    given = ask.parse_args()

    rig, views = views_at(given.megapixels, 3)
    lens = rig.cameras[0].lens
    seconds = one_view(rig, views[0], given.repeat)
    three = median_time(lambda: [pipeline.scan_view(v, rig, Settings()) for v in views], max(1, given.repeat // 2))
    floor, floor_three = seconds["copy floor"], copy_floor(views, 9)
    result: dict[str, Any] = {
        "date": datetime.now(UTC).date().isoformat(),
        "version": __version__,
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "camera": [lens.width, lens.height],
        "frames": len(views[0].plan.keys),
        "seconds": seconds | {"three views": three, "copy floor of three": floor_three},
        "over_copy": {k: t / floor for k, t in seconds.items()} | {"three views": three / floor_three},
        "peers_seconds": others(views[0], rig, given.peers, max(1, given.repeat // 2)),
    }
    ours = seconds["decode + triangulate"]
    result["peers_over_ours"] = {k: t / ours for k, t in result["peers_seconds"].items() if isinstance(t, float)}
    if given.whole:
        start = perf_counter()
        pipeline.scan(views, rig)
        result["seconds"]["three views, fused, meshes"] = perf_counter() - start
    result["peak_memory_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    if given.growth:
        sizes = [m for m in (0.25, 1.0, 5.0) if m < given.megapixels]
        small = {m: one_view(*(lambda r, v: (r, v[0]))(*views_at(m, 1)), given.repeat) for m in sizes}
        small[given.megapixels] = seconds
        result["ns_per_pixel"] = {
            str(m): {k: 1e3 * t / m for k, t in one.items()} for m, one in small.items()
        }
    print(f"{lens.width} x {lens.height}, {result['frames']} frames a view; copy floor {floor * 1e3:.1f} ms")
    for name, t in seconds.items():
        print(f"  {name:28} {t / floor:8.1f} x copy {t * 1e3:10.1f} ms")
    print(f"  {'three views':28} {three / floor_three:8.1f} x copy {three * 1e3:10.1f} ms")
    for name, t in result["peers_seconds"].items():
        print(f"  {name:28} " + (f"{t / ours:8.1f} x ours {t * 1e3:10.1f} ms" if isinstance(t, float) else str(t)))
    if given.out:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        given.out.write_text(json.dumps(result, indent=1) + "\n")
        print(given.out)


if __name__ == "__main__":
    main()
