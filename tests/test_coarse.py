"""The coarse surface that shows first: made of thinned frames, it lies on the fine one, for every plan and any rig."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fringescope import geometry, pipeline, store
from fringescope.devices import registry
from fringescope.errors import CaptureError, DecodeError, EmptyResultError
from fringescope.pipeline import coarse
from fringescope.settings import from_dict
from fringescope.types import FringeSet, GraySet, Lens, PixelFormat, Response, Rig, ViewInput, Volume
from tests import core_scenes as core
from tests import fuse_scenes as scenes
from tests.test_fused import bowl
from tests.test_twin_end_to_end import view_of

NINTH = from_dict({"mesh": {"preview_pixels": 4000}})  #: of the pictures below every third row and column is left


def rig_of(cameras=2, width=230, height=170):
    r = scenes.rig(cameras, width, height)
    return Rig(r.projector, r.cameras, Volume(np.zeros(3), np.eye(3), np.array([24.0, 20, 6])))


def drawn(rig, camera, *sets, pixel_format=PixelFormat.MONO8, seed=3):
    plan = core.plan(*sets, pixel_format=pixel_format, plane=rig.projector.plane_size, camera=camera.name)
    u, v, lit = core.seen(rig, bowl(camera))
    scale = plan.pixel_format.max_value / 255
    noise = (0.5 * scale**2, 0.02 * scale)
    frames = core.draw(plan, u, v, 110 * scale, 70 * scale, noise=noise, rng=np.random.default_rng(seed), lit=lit)
    if pixel_format is PixelFormat.RGB8:
        frames = [(key, np.repeat(f[:, :, None], 3, axis=2)) for key, f in frames]
    return ViewInput(plan, frames)


def usual(angle):
    return [core.fringes(p, angle, n) for p, n in ((270.0, 4), (60.0, 4), (16.0, 8))]


def off_the_bowl(surface):
    """Distances (n,) of the vertices from the surface that was drawn, along z, mm."""
    x, y, z = surface.vertices.astype(float).T
    return np.abs(z - 2.0 * np.cos(x / 9) * np.cos(y / 7))


@pytest.mark.parametrize("n", [1, 3, 11])
def test_a_thinned_lens_sees_what_the_full_one_sees(n):
    K = np.array([[1400.0, 3.0, 480.0], [0, 1390, 333], [0, 0, 1]])
    lens = Lens(1000, 701, K, np.array([-0.1, 0.02, 1e-3, 2e-3, 0]))
    thin = coarse.thinned_lens(lens, n)
    whole = np.empty((701, 1000))[::n, ::n]
    assert (thin.height, thin.width) == whole.shape
    v, u = np.mgrid[: thin.height, : thin.width]
    uv = np.stack([u, v], -1).astype(float)
    np.testing.assert_allclose(geometry.unproject(thin, uv), geometry.unproject(lens, n * uv), atol=1e-12)


@pytest.mark.parametrize("size", [1, 100, 311_904, 599_000, 601_000, 1_250_000, 5_000_000, 20_000_000, 80_000_000])
def test_strides_are_odd_and_leave_about_what_is_asked_for(size):
    n = coarse.stride_for(Lens(size, 1, np.eye(3), np.zeros(5)), 200_000)
    assert n % 2 == 1
    assert n == 1 or 200_000 / 3 <= size / n**2 <= 600_000
    assert n > 1 or size <= 600_000
    if size >= 5_000_000:
        assert 150_000 <= size / n**2 <= 300_000


def test_every_colour_of_a_mosaic_comes_in_and_frames_are_copied_once():
    rig = rig_of(1)
    view = drawn(rig, rig.cameras[0], *usual(0.4), pixel_format=PixelFormat.BAYER_RG8)
    view = replace(view, color=np.arange(230 * 170, dtype=np.uint16).reshape(170, 230).astype(np.uint8))
    (few,), thin, strides = coarse.thinned([view], rig, 4000)
    assert strides == (3,)
    for (key, frame), (same, small) in zip(view.frames, few.frames, strict=True):
        assert key == same
        np.testing.assert_array_equal(small, frame[::3, ::3])
        assert small.flags.c_contiguous
    np.testing.assert_array_equal(few.color, view.color[::3, ::3])
    assert (thin.cameras[0].lens.width, thin.cameras[0].lens.height) == few.color.shape[::-1]
    assert coarse.thinned([view], rig, 4000)[1] is thin  # tables that belong to a rig are made once
    (same,), rig_itself, _ = coarse.thinned([view], rig, 40_000)
    assert same.frames[0][1] is view.frames[0][1]
    assert rig_itself.cameras[0].lens.width == 230


def test_packed_frames_are_thinned_as_they_lie():
    rig = rig_of(1)
    view = drawn(rig, rig.cameras[0], *usual(0.4), pixel_format=PixelFormat.MONO12)
    packed = [(k, np.stack([f[:, ::2] & 255, (f[:, ::2] >> 8) | ((f[:, 1::2] & 15) << 4), f[:, 1::2] >> 4], -1)
               .astype(np.uint8)) for k, f in view.frames]  # fmt: skip
    (want,), _, _ = coarse.thinned([view], rig, 4000)
    (few,), _, _ = coarse.thinned([replace(view, frames=packed)], rig, 4000)
    for (_, a), (_, b) in zip(few.frames, want.frames, strict=True):
        np.testing.assert_array_equal(a, b)


PLANS = {
    "usual": (PixelFormat.MONO8, lambda a: usual(a)),
    "16 bits": (PixelFormat.MONO16, lambda a: usual(a)),
    "Bayer": (PixelFormat.BAYER_RG12, lambda a: usual(a)),
    "RGB": (PixelFormat.RGB8, lambda a: usual(a)),
    "two directions": (PixelFormat.MONO8, lambda a: [*usual(a), *usual(a + 0.8)]),
    "brackets": (PixelFormat.MONO12, lambda a: [replace(s, exposure_us=e) for s in usual(a) for e in (1000.0, 2000.0)]),
    "Gray code": (PixelFormat.MONO8, lambda _: [
        GraySet("v", 20.0, 4, inverse=True, white=True, black=True), FringeSet((0.0, 1 / 20.0), 8)]),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANS)
def test_every_plan(name):
    rig = rig_of(1)
    camera = rig.cameras[0]
    fmt, sets = PLANS[name]
    view = drawn(rig, camera, *sets(core.best_angle(rig, camera)), pixel_format=fmt)
    got = pipeline.preview([view], rig, NINTH)
    assert got.n_faces > 3000
    assert np.quantile(off_the_bowl(got), 0.95) < 0.05
    assert max(p.texture.shape[1] for p in got.parts) <= 77  # every third pixel


def test_a_response_is_taken_out():
    rig = rig_of(1)
    camera = rig.cameras[0]
    view = drawn(rig, camera, *usual(core.best_angle(rig, camera)))
    view = replace(view, response=Response("exponents", 1.0, 0.01, (0.0,), (0.01,), needed=True))
    got = pipeline.preview([view], rig, NINTH)
    assert np.quantile(off_the_bowl(got), 0.95) < 0.05


def apart(surface, cloud):
    """Distances (n,) of a surface's vertices from the planes of the nearest points of a cloud, mm, and those sigmas."""
    far, near = cKDTree(cloud.xyz).query(surface.vertices)
    along = np.einsum("ij,ij->i", surface.vertices - cloud.xyz[near], cloud.normals[near])
    return far, np.abs(along), cloud.sigma[near]


def agrees(first, fine, spacing):
    """The coarse surface lies on the fine cloud and covers it; `spacing` is that of the coarse points, mm."""
    far, along, sigma = apart(first, fine.cloud)
    assert np.quantile(far, 0.99) < spacing
    assert np.median(along / sigma) < 1.5
    assert np.quantile(along, 0.95) < 5 * np.median(sigma) + 0.02
    back, _ = cKDTree(first.vertices).query(fine.cloud.xyz[::7])
    assert np.quantile(back, 0.95) < 2 * spacing


def test_it_lies_on_the_fine_surface_of_rendered_tissue(shared):
    folder = shared / "data" / "rendered-small"
    rig = store.read_rig(folder / "truth" / "rig.json")
    views = store.view_inputs(store.read_capture(folder / "tissue"))
    came = []
    s = from_dict({"mesh": {"preview_pixels": 36_000}})
    fine = pipeline.scan(views, rig, s, first=came.append)
    (first,) = came
    assert 10_000 < first.n_faces <= 50_000
    assert all(max(p.texture.shape) <= 228 for p in first.parts)  # every third pixel
    agrees(first, fine, 0.8)
    assert fine.figures["times_s"]["preview"] > 0


@pytest.mark.parametrize("uri", ["sim://five/sphere?scale=0.12&seed=4", "sim://single/tissue-domed?scale=0.16&seed=3"])
def test_it_lies_on_the_fine_surface_of_the_twin(uri):
    with registry.open_station(uri) as station:
        rig = station.rig
        views = [view_of(station, i) for i in range(len(rig.cameras))]
    s = from_dict({"mesh": {"preview_pixels": 40_000}})
    order = views[::-1]  # in any order
    agrees(pipeline.preview(order, rig, s), pipeline.scan(views, rig, s), 1.6)


def test_what_cannot_be_shown_is_said_or_left_to_the_scan():
    rig = rig_of(2)
    views = [drawn(rig, c, *usual(core.best_angle(rig, c))) for c in rig.cameras]
    with pytest.raises(CaptureError, match="no frames came"):
        pipeline.preview([views[0], replace(views[1], frames=[])], rig)
    dark = [replace(v, frames=[(k, np.zeros_like(f)) for k, f in v.frames]) for v in views]
    with pytest.raises(EmptyResultError, match="no point was left"):
        pipeline.preview(dark, rig, NINTH)
    small = [replace(views[0], frames=[(k, f[:-4]) for k, f in views[0].frames])]
    with pytest.raises(DecodeError, match="frames of 230 x 166 pixels, the rig was calibrated at 230 x 170"):
        pipeline.preview(small, rig, NINTH)
    came = []
    thin = from_dict({"mesh": {"max_edge": 1.5, "min_area_mm2": 1e4, "preview_pixels": 4000}})
    arriving = [replace(v, frames=iter(v.frames)) for v in views]
    assert pipeline.scan(arriving, rig, thin, first=came.append).surface is None
    assert not came
