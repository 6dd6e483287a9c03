"""The GPU's way against the processor's: run by `test_gpu.py` in Numba's simulator, and by who has a GPU as

    pytest tests/on_gpu.py

Both differ by the rounding of float32 alone: sums are taken in the same order, but multiply-adds are contracted
differently. The phase may differ by 4 units in the last place of the largest phase, and so the point; whether a pixel
has a reason only where what is compared with a threshold lies that close to it.
"""

from dataclasses import replace

import numpy as np
import pytest
from numba import njit

from fringescope import gpu, pipeline
from fringescope.kernels import gpu as k
from fringescope.pipeline import fast
from fringescope.pipeline import gpu as way_of
from fringescope.settings import Settings
from fringescope.types import PixelFormat, Reason
from tests.test_fused import bowl, rig_of, view_of

S = Settings()
DARK = Reason.DARK | Reason.LOW_MODULATION  # orders of such pixels mean nothing
f4 = np.float32


@njit
def _rows_one_by_one(height, depths, nodes, out):
    for i in range(height):
        k.row_of(i, height, depths, nodes, out)


@njit
def _pixels_one_by_one(band, sets, limits, rows, depths, wrapped, wide, x, bounds, one, used):
    for i in range(band.frames.shape[1]):
        for j in range(band.frames.shape[2]):
            k.decode_pixel(band, i, j, sets, limits, rows, depths, wrapped, wide)
            k.decode_clipped(band, i, j, sets, limits, rows, depths, x, bounds, one, used)


def empty(height, width):
    return [np.empty((height, width, 3)[: 3 if f.channels else 2], f.dtype) for f in way_of.FIELDS]


def tables(way, height):
    nodes = k.Nodes(way.bounds, way.usual)
    rows = k.Rows(
        np.empty((height, way.depths.table.shape[1]), f4), np.empty((4, height, way.bounds.shape[2])),
        np.empty((height, way.usual.shape[1])),
    )  # fmt: skip
    return nodes, rows


def by_loops(way):
    """The kernels of the GPU as plain loops on the processor, over all pixels of a view."""
    height, width = way.frames[0].shape
    out = empty(height, width)
    nodes, rows = tables(way, height)
    _rows_one_by_one(height, way.depths, nodes, rows)
    _pixels_one_by_one(
        k.Band(np.stack(way.frames), 0, *out), way.sets, way.limits, rows, way.depths, np.empty(k.MAX_SETS, f4),
        np.empty(k.MAX_SETS, f4), np.empty((k.MAX_FRAMES, 1), np.uint16), np.empty((4, 1), f4),
        np.empty((4, k.MAX_SETS, 1, 1)), np.empty((k.MAX_SETS, 2), np.uint64),
    )  # fmt: skip
    return out


@pytest.fixture(scope="session")
def compiled():
    """What the simulator's kernels call, compiled before many threads ask for it at once."""
    rig = rig_of(64, 9)
    views = [view_of(rig, rig.cameras[1], fmt) for fmt in (PixelFormat.MONO8, PixelFormat.MONO16)]
    return [by_loops(fast.way_of(view, rig, S)) for view in views]


def compare(view, rig, apart=0.002, s=S):
    """What both ways make of a view; the GPU's decoded view."""
    want, xyz, sigma_mm, _ = fast.decode(view, rig, s)
    got, xyz_, sigma_mm_, _ = fast.decode(view, rig, s, "gpu")
    weak = ((want.reasons | got.reasons) & DARK) != 0
    assert ((got.reasons != want.reasons) & ~weak).mean() <= apart
    assert ((got.reasons ^ want.reasons) & DARK != 0).mean() <= apart
    good = (want.reasons == 0) & (got.reasons == 0)
    assert good.mean() > 0.2
    a, b = want.directions[0], got.directions[0]
    largest = np.abs(a.phase[good]).max()
    np.testing.assert_allclose(b.phase[good], a.phase[good], rtol=0, atol=4 * np.spacing(np.float32(largest)))
    np.testing.assert_allclose(b.sigma[good], a.sigma[good], rtol=2e-6)
    np.testing.assert_allclose(xyz_[good], xyz[good], rtol=0, atol=5e-5)
    np.testing.assert_allclose(sigma_mm_[good], sigma_mm[good], rtol=5e-6)
    top = view.plan.pixel_format.max_value
    np.testing.assert_allclose(got.background, want.background, rtol=0, atol=2e-6 * top)
    np.testing.assert_allclose(got.modulation, want.modulation, rtol=0, atol=2e-6 * top)
    return got


@pytest.fixture
def small(monkeypatch, compiled):  # noqa: ARG001
    """A rig of small odd pictures, and slabs of a few rows: more of them than buffers, the last one not full."""
    gpu.slabs.cache_clear()
    monkeypatch.setattr(gpu, "SLAB", 4 * 41 * (16 + 34))
    if gpu.SIMULATED:
        monkeypatch.setattr(k, "THREADS", 8)  # each of them is a thread of the processor
        monkeypatch.setattr(k, "BLOCKS", 1)
    yield rig_of(41, 15)
    gpu.slabs.cache_clear()


@pytest.mark.parametrize("fmt", [PixelFormat.MONO8, PixelFormat.BAYER_RG8, PixelFormat.MONO16])
def test_every_depth(small, fmt):
    compare(view_of(small, small.cameras[1], fmt), small)


@pytest.mark.parametrize(
    ("periods", "steps"),
    [((270.0, 60.0, 16.0), (3, 3, 3)), ((270.0, 90.0, 40.0, 16.0), (4, 3, 5, 7)), ((250.0,), (8,))],
)
def test_every_plan(small, periods, steps):
    compare(view_of(small, small.cameras[2], PixelFormat.MONO12, periods, steps), small)


@pytest.mark.parametrize(("brightness", "contrast", "valid"), [(0.85, 0.5, 20), (1.0, 0.8, 0)])
def test_saturated_samples(small, brightness, contrast, valid):
    view = view_of(small, small.cameras[1], PixelFormat.MONO8, A=brightness, B=contrast)
    clipped = np.max([f for _, f in view.frames], axis=0) == 255
    got = compare(view, small)
    assert (clipped & (got.reasons == 0)).sum() >= valid
    assert valid or ((got.reasons & Reason.SATURATED) != 0).any()


def test_slabs(small):
    view = view_of(small, small.cameras[1], PixelFormat.MONO8)
    compare(view, small)
    lanes = gpu.slabs(16, 15, 41, "|u1", way_of.FIELDS, gpu.SLAB)
    assert (lanes.rows, len(lanes.slots)) == (4, 3)
    again = compare(view, small)  # the same buffers
    assert gpu.slabs.cache_info().currsize == 1
    first = fast.decode(view, small, S, "gpu")[0]
    np.testing.assert_array_equal(first.directions[0].phase, again.directions[0].phase)


@pytest.mark.usefixtures("small")
def test_one_row():
    rig = rig_of(49, 1)  # and other buffers than those of `small`
    compare(view_of(rig, rig.cameras[1], PixelFormat.MONO8), rig, apart=0.02)


def test_frames_of_any_memory_layout(small):
    view = view_of(small, small.cameras[0], PixelFormat.MONO8)
    odd = []
    for key, f in view.frames:
        wide = np.zeros((2 * f.shape[0], 3 * f.shape[1]), f.dtype)
        wide[::2, ::3] = f
        odd.append((key, wide[::2, ::3]))
    want, got = fast.decode(view, small, S, "gpu"), fast.decode(replace(view, frames=odd), small, S, "gpu")
    np.testing.assert_array_equal(got[1], want[1])
    np.testing.assert_array_equal(got[0].reasons, want[0].reasons)


def test_fields_that_are_not_wanted_stay_there(small):
    view = view_of(small, small.cameras[1], PixelFormat.MONO8)
    way = fast.way_of(view, small, S)
    H, W = way.frames[0].shape
    all_, some = ([np.zeros((H, W, 3)[: 3 if f.channels else 2], f.dtype) for f in way_of.FIELDS] for _ in range(2))
    way_of.by_slabs(way.frames, way.sets, way.limits, way.bounds, way.usual, way.depths, all_)
    wanted = [a if n >= 4 else None for n, a in enumerate(some)]
    way_of.by_slabs(way.frames, way.sets, way.limits, way.bounds, way.usual, way.depths, wanted)
    for n, (a, b) in enumerate(zip(all_, some, strict=True)):
        np.testing.assert_array_equal(b, a if n >= 4 else 0)
    lanes, launch = way_of.prepared(way.frames, way.sets, way.limits, way.bounds, way.usual, way.depths)
    clock = iter(range(1000)).__next__
    timed = [np.zeros_like(a) for a in some]
    assert lanes.timed(way.frames, launch, timed, clock) == gpu.Times(4, 4, 4, 4, 4)
    np.testing.assert_array_equal(timed[5], all_[5])


def test_a_whole_view(small):
    view = view_of(small, small.cameras[1], PixelFormat.MONO8)
    _, want = pipeline.scan_view(view, small, S)
    decoded, got = pipeline.scan_view(view, small, S, device="gpu")
    assert (got.valid != want.valid).mean() < 0.005
    both = got.valid & want.valid
    assert both.mean() > 0.2
    np.testing.assert_allclose(got.xyz[both], want.xyz[both], rtol=0, atol=5e-5)
    assert not any("GPU" in note for note in decoded.notes)


def test_a_plan_for_the_stages_says_so(small):
    """133 frames are more than a thread has room for."""
    view = view_of(small, small.cameras[1], PixelFormat.MONO8, (270.0, 100.0, 60.0, 16.0), (33, 33, 33, 34))
    assert fast.decode(view, small, S) is not None
    decoded, got = pipeline.scan_view(view, small, S, device="gpu")
    _, want = pipeline.scan_view(view, small, S)
    assert decoded.notes[-1].startswith("not on the GPU")
    assert (got.valid == want.valid).mean() > 0.99


def test_the_surface_is_the_bowl(small):
    """Against outside truth: points lie where the camera's rays meet the bowl that was drawn."""
    c = small.cameras[0]
    _, grid = pipeline.scan_view(view_of(small, c, PixelFormat.MONO16), small, S, device="gpu")
    off = np.linalg.norm(grid.xyz - bowl(c), axis=-1)[grid.valid]
    assert np.median(off) < 0.05
