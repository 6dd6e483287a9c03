"""The benchmark: a scan from raw frames in memory, beside a plain copy of its bytes and beside other decoders.

All in one run on the same frames: a second tells about the machine, a ratio about the program. The floor is a parallel
copy, on all cores, of touched memory: the raw frames as stored, plus 17 bytes a pixel of output (xyz, sigma, reason).
"""

from __future__ import annotations

import importlib.util
import itertools
import json
import math
import os
import platform
import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from time import perf_counter, sleep
from typing import Any

import cv2
import numpy as np

from fringescope import __version__, denoise, memory, phase, pipeline
from fringescope.bench import growth as grows
from fringescope.bench.frames import views_of
from fringescope.bench.peers import median_time
from fringescope.errors import UsageError
from fringescope.settings import Settings
from fringescope.types import AnyArray, FrameKey, FringeSet, Rig, ViewInput

PERIOD_S = 0.04  #: from one frame to the next where they arrive: 25 a second
BYTES_OUT = 17  #: xyz, sigma, reason of a pixel
PEERS = Path(__file__).with_name("peers.py")


def measure(
    megapixels: float = 20.0,
    repeat: int = 5,
    *,
    growth: bool = False,
    whole: bool = False,
    peer_python: Path | None = None,
    tell: Callable[[str, float], None] = lambda _what, _share: None,
) -> dict[str, Any]:
    """Times everything once on frames of so many megapixels; see the module. Seconds are medians of `repeat`.

    `growth` adds smaller and larger pictures, more and fewer frames and cores; `whole` three views to the coarse
    surface that shows first, and to a coloured cloud and meshes. Other people's decoders are timed by the interpreter
    `peer_python`, or here if they can be imported. Raises UsageError.
    """
    if not 0.01 <= megapixels <= 200 or repeat < 1:
        raise UsageError(f"{megapixels} megapixels, {repeat} times; needed 0.01 to 200, and once at least")
    s = Settings()
    tell("drawing frames", 0.0)
    rig, views = views_of(megapixels, 3)
    tell("one view", 0.3)
    one = _one_view(rig, views[0], repeat, s)
    tell("three views", 0.5)
    floor_three = copy_floor(views, max(repeat, 9))
    three = median_time(lambda: [pipeline.scan_view(v, rig, s) for v in views], max(1, repeat // 2))
    tell("three views as they arrive", 0.57)
    late, late_by_sets = _after_last(rig, views, s, max(1, repeat // 2))
    tell("memory", 0.6)
    io, peak = _memory(rig, views[0], s)
    tell("other decoders", 0.65)
    others = _others(views[0], peer_python, max(1, repeat // 2))
    ours = one["decode_triangulate"]
    lens = rig.cameras[0].lens
    fast = others.get("fringes fast")
    out: dict[str, Any] = {
        "format": "fringescope-bench",
        "version": 1,
        "software": __version__,
        "date": datetime.now(UTC).date().isoformat(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "camera": [lens.width, lens.height],
        "frames": len(views[0].plan.keys),
        "copy_floor_s": one["copy_floor"],
        "decode_triangulate_over_copy": ours / one["copy_floor"],
        "one_view_over_copy": one["one_view"] / one["copy_floor"],
        "three_views_over_copy": three / floor_three,
        "three_views_s": three,
        "after_last_frame_s": late,
        "after_last_frame_by_sets_s": late_by_sets,
        "after_last_frame_over_three_views": late / three,
        "peak_memory_over_io": peak / io,
        "fringes_fast_over_ours": fast / ours if isinstance(fast, float) else None,
        "seconds": one,
        "over_copy": {name: t / one["copy_floor"] for name, t in one.items()},
        "others_s": others,
        "others_over_ours": {name: t / ours for name, t in others.items() if isinstance(t, float)},
    }
    if whole:
        tell("three views to a coarse surface", 0.8)
        out["coarse_surface_s"] = median_time(lambda: pipeline.preview(views, rig, s), repeat)
        tell("three views to a surface", 0.82)
        start = perf_counter()
        pipeline.scan(views, rig, s)
        out["surface_first_s"] = perf_counter() - start  # in memory that the machine has never used before
        out["surface_s"] = median_time(lambda: pipeline.scan(views, rig, s), max(1, repeat // 2))
        tell("three views to a surface as they arrive", 0.85)
        clock, shown = _Clock(), []
        pipeline.scan(clock.paced(views), rig, s, first=lambda _: shown.append(clock.since_last()))
        out["coarse_surface_after_last_frame_s"] = shown[0] if shown else None
        out["surface_after_last_frame_s"] = clock.since_last()
    if growth:
        del views

        def timer(rig: Rig, view: ViewInput) -> dict[str, float]:
            return _one_view(rig, view, repeat, s)

        out["ns_per_pixel"] = grows.pixels(megapixels, one, timer, tell)
        out["ns_per_pixel_by_frames"] = grows.frames(timer, tell)
        out["ns_per_pixel_by_cores"] = grows.cores(repeat, tell)
        out["growth_megapixels"] = grows.FEW
    return out


def lines(result: dict[str, Any]) -> list[str]:
    """The result for people: ratios first, times second."""
    w, h = result["camera"]
    floor = result["copy_floor_s"]
    out = [f"{w} x {h}, {result['frames']} frames a view, {result['machine']}; copy floor {floor * 1e3:.1f} ms"]
    for name, t in result["seconds"].items():
        out.append(f"  {name.replace('_', ' '):24} {t / floor:8.1f} x copy {t * 1e3:10.1f} ms")
    three = result["three_views_s"]
    out.append(f"  {'three views':24} {result['three_views_over_copy']:8.1f} x copy {three * 1e3:10.1f} ms")
    late = result["after_last_frame_s"]
    out.append(f"  {'... after the last frame':24} {late / three:8.2f} x three views {late * 1e3:7.1f} ms")
    by_sets = result["after_last_frame_by_sets_s"]
    out.append(f"  {'    set by set':24} {by_sets / three:8.2f} x three views {by_sets * 1e3:7.1f} ms")
    out.append(f"  {'peak memory':24} {result['peak_memory_over_io']:8.2f} x input and output")
    for name, t in result["others_s"].items():
        if isinstance(t, float):
            out.append(f"  {name:24} {result['others_over_ours'][name]:8.1f} x ours {t * 1e3:10.1f} ms")
        else:
            out.append(f"  {name}: {t}")
    if "surface_s" in result:
        out.append(f"  {'... a coarse surface first':24} {'':15} {result['coarse_surface_s'] * 1e3:10.1f} ms")
        out.append(f"  {'three views to a surface':24} {'':15} {result['surface_s'] * 1e3:10.1f} ms")
        out.append(f"  {'... the first time':24} {'':15} {result['surface_first_s'] * 1e3:10.1f} ms")
        for name in ("coarse_surface", "surface"):
            t = result[f"{name}_after_last_frame_s"]
            if t is not None:
                out.append(f"  ... {name.replace('_', ' ')} after the last frame {t * 1e3:12.1f} ms")
    for key, what in (("", "megapixels"), ("_by_frames", "frames"), ("_by_cores", "cores")):
        for size, one in result.get("ns_per_pixel" + key, {}).items():
            each = ", ".join(f"{name.replace('_', ' ')} {t:.1f}" for name, t in one.items())
            out.append(f"  {size:>5} {what}, ns a pixel: {each}")
    return out


class _Clock:
    """Frames that come one by one, as a camera sends them, and the time since the last."""

    def __init__(self) -> None:
        self._last = 0.0

    def paced(self, views: Sequence[ViewInput]) -> list[ViewInput]:
        """The views, each frame `PERIOD_S` after the one before."""

        def frames(view: ViewInput) -> Iterator[tuple[FrameKey, AnyArray]]:
            for one in view.frames:
                sleep(PERIOD_S)
                self._last = perf_counter()
                yield one

        return [replace(view, frames=frames(view)) for view in views]

    def since_last(self) -> float:
        """Seconds since a frame came."""
        return perf_counter() - self._last


def _after_last(rig: Rig, views: Sequence[ViewInput], s: Settings, repeat: int) -> tuple[float, float]:
    """Seconds from the last frame to the masked points of all views, whose frames arrive view after view; and without
    the sums of the finest set that grow frame by frame: that set is then worked out when it is complete. In turns.
    """
    out: dict[bool, list[float]] = {True: [], False: []}
    for by_frame in (True, False) * repeat:
        clock = _Clock()

        def work(view: ViewInput, by_frame: bool = by_frame) -> None:
            pipeline.scan_gathered(*pipeline.arrival.gathered(view, rig, s, by_frame=by_frame), rig, s, "cpu")

        with pipeline.arrival.each(work, clock.paced(views), rig, at_once=False) as made:
            for _ in made:
                pass
        out[by_frame].append(clock.since_last())
    return float(np.median(out[True])), float(np.median(out[False]))


def copy_floor(views: Sequence[ViewInput], repeat: int) -> float:
    """Seconds to copy what must at least be read and written."""
    size = sum(frame.nbytes for view in views for _, frame in view.frames)
    size += sum(next(iter(view.frames))[1].size * BYTES_OUT for view in views)
    cores = os.cpu_count() or 1
    source, target = np.ones(size, np.uint8), np.ones(size, np.uint8)
    edges = np.linspace(0, size, cores * 8 + 1).astype(int).tolist()
    parts = [slice(a, b) for a, b in itertools.pairwise(edges)]
    with ThreadPoolExecutor(cores) as pool:

        def once() -> None:
            list(pool.map(lambda part: np.copyto(target[part], source[part]), parts))

        return median_time(once, repeat)


def _one_view(rig: Rig, view: ViewInput, repeat: int, s: Settings) -> dict[str, float]:
    fused = pipeline.fast.decode(view, rig, s)
    assert fused is not None
    decoded, d = fused[0], s.denoise
    backward = denoise.monotonic(decoded, decoded.reasons, rig, d)
    linked = denoise.connected(decoded, backward, rig, d)
    return {
        "copy_floor": copy_floor([view], max(repeat, 9)),
        "decode_triangulate": median_time(lambda: pipeline.fast.decode(view, rig, s), repeat),
        "monotonicity": median_time(lambda: denoise.monotonic(decoded, decoded.reasons, rig, d), repeat),
        "domains": median_time(lambda: denoise.connected(decoded, backward, rig, d), repeat),
        "local_surface": median_time(lambda: denoise.local(decoded, linked, rig, d), repeat),
        "one_view": median_time(lambda: pipeline.scan_view(view, rig, s), repeat),
    }


def _memory(rig: Rig, view: ViewInput, s: Settings) -> tuple[int, int]:
    """Bytes of input and output of a view, and the most that was held while it was made, input included."""
    given = sum(frame.nbytes for _, frame in view.frames)
    memory.release()
    tracemalloc.start()
    try:
        decoded, grid = pipeline.scan_view(view, rig, s)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    made: list[AnyArray] = [grid.xyz, grid.sigma, grid.reasons, decoded.background, decoded.modulation]
    made += [a for d in decoded.directions for a in (d.phase, d.sigma)]
    return given + sum(a.nbytes for a in made), given + peak


def one_view_of(megapixels: float, repeat: int) -> dict[str, float]:
    """Seconds of the steps of one view of so many megapixels."""
    rig, views = views_of(megapixels, 1)
    return _one_view(rig, views[0], repeat, Settings())


def _others(view: ViewInput, python: Path | None, repeat: int) -> dict[str, float | str]:
    """Seconds of other decoders on the same frames, or why there are none."""
    sets = [one for one in view.plan.sets if isinstance(one, FringeSet)]
    frames = [[f for key, f in view.frames if key.set_index == n] for n in range(len(sets))]
    out: dict[str, float | str] = {
        "numpy, wrapped phases": median_time(lambda: [_numpy(f) for f in frames], 1),
        "opencv, wrapped phases": median_time(lambda: [_opencv(f) for f in frames], 1),
    }
    if python is None and importlib.util.find_spec("fringes") is not None:
        python = Path(sys.executable)
    if python is None:
        return out | {"fringes": "not here: name an interpreter that has it with --peer-python"}
    g = sets[-1].cycles_per_pixel
    low, high = phase.field_bounds(g, view.plan.projector_size)
    plan = {
        "steps": [one.steps for one in sets],
        "periods": [1 / math.hypot(*one.cycles_per_pixel) for one in sets],
        "length": (high - low) / (2 * math.pi * math.hypot(*g)),
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "frames.npy"
        np.save(file, np.stack([f for one in frames for f in one]))
        command = [str(python), str(PEERS), str(file), str(repeat), json.dumps(plan)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as e:
            raise UsageError(f"--peer-python {python}: cannot be run: {e.strerror}") from e
    if done.returncode != 0:
        return out | {"fringes": (done.stderr.strip().splitlines() or ["it said nothing"])[-1]}
    try:
        told: dict[str, float | str] = json.loads(done.stdout.splitlines()[-1])
    except (IndexError, json.JSONDecodeError):
        raise UsageError(f"--peer-python {python}: said {done.stdout[:40]!r}; needed a Python interpreter") from None
    return out | told


def _numpy(frames: Sequence[AnyArray]) -> AnyArray:
    """What people write first: the N-step formula on arrays."""
    angles = 2 * np.pi * np.arange(len(frames)) / len(frames)
    s = sum(f * np.float32(math.sin(a)) for f, a in zip(frames, angles, strict=True))
    c = sum(f * np.float32(math.cos(a)) for f, a in zip(frames, angles, strict=True))
    return np.asarray(np.arctan2(s, c))


def _opencv(frames: Sequence[AnyArray]) -> AnyArray:
    """The same by OpenCV's fast functions; its phase is off by up to 0.3 degrees."""
    angles = 2 * np.pi * np.arange(len(frames)) / len(frames)
    s, c = (np.zeros(frames[0].shape, np.float32) for _ in range(2))
    for f, a in zip(frames, angles, strict=True):
        light = f.astype(np.float32)
        s, c = cv2.scaleAdd(light, math.sin(a), s), cv2.scaleAdd(light, math.cos(a), c)
    return np.asarray(cv2.phase(c, s))
