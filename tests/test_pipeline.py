"""The recipes end to end on a plate drawn from formulas: three small cameras, one projector."""

import numpy as np
import pytest

from fringescope import denoise, phase, pipeline, triangulate
from fringescope.errors import CaptureError, DecodeError, EmptyResultError, RigError
from fringescope.settings import MeshSettings, Settings
from fringescope.types import PixelFormat, Reason, Rig, ViewInput, Volume
from tests import core_scenes as core
from tests import fuse_scenes as scenes

NORMAL, OFFSET = np.array([0.05, 0.1, 1.0]) / np.linalg.norm([0.05, 0.1, 1.0]), 1.0


@pytest.fixture(scope="module")
def rig() -> Rig:
    r = scenes.rig(3, 96, 72)
    return Rig(r.projector, r.cameras, Volume(np.zeros(3), np.eye(3), np.array([24.0, 20, 6])))


@pytest.fixture(scope="module")
def views(rig):
    rng = np.random.default_rng(5)
    return [core.view(rig, c, core.plane_points(c, NORMAL, OFFSET), rng=rng)[0] for c in rig.cameras]


@pytest.fixture(scope="module")
def scan(rig, views):
    told = []
    made = pipeline.scan(views, rig, all_points=True, progress=lambda what, share: told.append((what, share)))
    return made, told


def test_the_plate_comes_back(scan):
    made, _ = scan
    for grid in made.grids:
        p = grid.xyz[grid.valid].astype(float)
        assert len(p) > 0.8 * grid.valid.size
        error = p @ NORMAL - OFFSET
        assert abs(np.median(error)) < 0.005
        assert np.abs(error).max() < 0.2
    assert np.abs(made.cloud.xyz.astype(float) @ NORMAL - OFFSET).max() < 0.2
    assert np.median(made.cloud.normals @ NORMAL) > 0.99
    assert made.surface is not None
    assert made.surface.n_faces > 1000
    assert np.quantile(np.abs(made.surface.vertices.astype(float) @ NORMAL - OFFSET), 0.95) < 0.03


def test_sigma_is_the_spread_of_the_points(scan, rig):
    """Robust spread of the error along the ray over its own sigma, each view: 0.9 to 1.1."""
    made, _ = scan
    for grid, camera in zip(made.grids, rig.cameras, strict=True):
        o = -camera.pose.R.T @ camera.pose.t
        p, sigma = grid.xyz[grid.valid].astype(float), grid.sigma[grid.valid]
        d = (p - o) / np.linalg.norm(p - o, axis=1, keepdims=True)
        z = ((p @ NORMAL - OFFSET) / (d @ NORMAL)) / sigma
        assert 0.9 < 1.4826 * np.median(np.abs(z - np.median(z))) < 1.1


def test_every_point_is_listed_once_view_by_view(scan):
    made, _ = scan
    assert made.all_points is not None
    want = np.concatenate([g.xyz[g.valid] for g in made.grids])
    np.testing.assert_array_equal(made.all_points.xyz, want)
    np.testing.assert_array_equal(np.bincount(made.all_points.view), [g.valid.sum() for g in made.grids])


def test_words_and_figures(scan):
    made, told = scan
    assert [v.camera for v in made.verdicts] == ["camera1", "camera2", "camera3"]
    for v, g in zip(made.verdicts, made.grids, strict=True):
        assert v.points == g.valid.sum()
        assert v.words[0].startswith(f"{v.camera}: {v.points} points on ")
        figures = made.figures["views"][v.camera]
        assert figures["way"] == "fused"
        assert figures["noise"]["source"] == "residuals"
        assert 0 < figures["sigma_median_mm"] < 0.1
        assert figures["modulation_median"] == pytest.approx(70, abs=2)
        assert figures["background_median"] == pytest.approx(110, abs=2)
    shares = [s for _, s in told]
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    assert told[0][0] == "decoding camera1"


def test_views_may_come_in_another_order_than_the_rig_s(rig, views, scan):
    made = pipeline.scan([views[2], views[0], views[1]], rig, surface=False)
    assert [g.camera for g in made.grids] == ["camera1", "camera2", "camera3"]
    assert made.surface is None
    for a, b in zip(made.grids, scan[0].grids, strict=True):
        np.testing.assert_array_equal(a.xyz, b.xyz)


def test_one_view_is_enough(rig, views):
    made = pipeline.scan(views[1:2], rig, surface=False)
    assert len(made.cloud) > 1000
    assert set(made.cloud.view) == {1}


def test_scan_view_is_its_stages_one_by_one(rig, views):
    """The second door: the same names in the same order give the same view, to float32 (the one door is fused)."""
    s, view = Settings(), views[0]
    decoded, grid = pipeline.scan_view(view, rig, s)
    d = phase.measure(view.frames, view.plan, s.phase, view.noise)
    d = phase.settle_order(d, view.plan, s.phase, rig, s.denoise.volume_margin)
    r = denoise.exposed(d, view.plan.pixel_format, s.denoise)
    r = denoise.monotonic(d, r, rig, s.denoise)
    r = denoise.connected(d, r, rig, s.denoise)
    r = denoise.local(d, r, rig, s.denoise)
    g = triangulate.grid(d, r, rig, volume_margin=s.denoise.volume_margin, rim=s.denoise.rim)
    assert (grid.valid != g.valid).mean() < 0.002
    both = grid.valid & g.valid
    np.testing.assert_allclose(grid.xyz[both], g.xyz[both], atol=1e-4)
    np.testing.assert_allclose(grid.sigma[both], g.sigma[both], rtol=5e-5)
    np.testing.assert_array_equal(decoded.reasons, grid.reasons)
    np.testing.assert_allclose(decoded.directions[0].phase[both], d.directions[0].phase[both], atol=5e-5)


@pytest.mark.parametrize("turn", [0.0, 0.2, np.pi / 4])
def test_two_directions_are_judged_by_those_that_tell_depth(rig, rng, turn):
    """As captures of a board have: along one of the two the phase may not grow with depth at all."""
    for camera in rig.cameras:
        angle = core.best_angle(rig, camera) + turn
        sets = [core.fringes(p, a, n) for a in (angle, angle + np.pi / 2) for p, n in ((270, 4), (60, 4), (16, 8))]
        plan = core.plan(*sets, pixel_format=PixelFormat.MONO8, plane=rig.projector.plane_size, camera=camera.name)
        points = core.plane_points(camera, NORMAL, OFFSET)
        u, v, lit = core.seen(rig, points)
        view = ViewInput(plan, core.draw(plan, u, v, noise=(0.5, 0.02), rng=rng, lit=lit))
        _, grid = pipeline.scan_view(view, rig, Settings())
        assert grid.valid.mean() > 0.8
        assert np.abs(grid.xyz[grid.valid].astype(float) @ NORMAL - OFFSET).max() < 0.1


def test_decode_view_needs_no_rig(rng):
    plan = core.plan(*[core.fringes(p, a, n) for a in (0, np.pi / 2) for p, n in ((450, 4), (70, 4), (16, 8))])
    u, v = core.image(shape=(150, 200))
    A = np.where(np.arange(200) < 20, 4.0, 1600.0) + 0 * u
    decoded = pipeline.decode_view(ViewInput(plan, core.draw(plan, u, v, A, 0.6 * A, (30, 0.4), rng)), Settings())
    got = phase.projector_coordinates(decoded)
    ok = decoded.reasons == 0
    assert ok[:, 22:].mean() > 0.99
    assert ((decoded.reasons[:, :20] & Reason.DARK) != 0).all()
    np.testing.assert_allclose(got[0][ok], u[ok], atol=0.25)
    np.testing.assert_allclose(got[1][ok], v[ok], atol=0.25)


def test_a_steep_step_leaves_no_flying_points(rig):
    """Two levels 3 mm apart: every point that is left lies on one of them."""
    rng = np.random.default_rng(9)
    made = []
    for camera in rig.cameras:
        low, high = (core.plane_points(camera, (0, 0, 1), z) for z in (-1.0, 2.0))
        p = np.where((high[..., :1] > 3), high, low)
        made.append(core.view(rig, camera, p, rng=rng)[0])
    for grid in pipeline.scan(made, rig, surface=False).grids:
        z = grid.xyz[grid.valid][:, 2]
        assert len(z) > 0.6 * grid.valid.size
        assert np.minimum(np.abs(z + 1), np.abs(z - 2)).max() < 0.15


# ----------------------------------------------------------------------------------------------------------- bad input


def test_black_views_give_one_line_and_no_scan(rig, views):
    black = [ViewInput(v.plan, [(k, np.zeros_like(f)) for k, f in v.frames]) for v in views]
    with pytest.raises(EmptyResultError) as e:
        pipeline.scan(black, rig)
    assert "\n" not in str(e.value)
    assert "no point was left" in str(e.value)
    for v in views:
        what = f"{v.plan.camera}: 100.0 % of all pixels: dark or in shadow; no fringes reached this view"
        assert what in str(e.value)


def test_one_black_view_does_not_stop_the_others(rig, views):
    black = ViewInput(views[0].plan, [(k, np.zeros_like(f)) for k, f in views[0].frames])
    made = pipeline.scan([black, *views[1:]], rig, surface=False)
    assert made.verdicts[0].points == 0
    assert made.figures["views"]["camera1"]["sigma_median_mm"] is None
    assert set(made.cloud.view) == {1, 2}


def test_points_without_a_triangle_are_still_a_scan(rig, views):
    s = Settings(mesh=MeshSettings(min_area_mm2=1e9))
    made = pipeline.scan(views, rig, s)
    assert len(made.cloud) > 1000
    assert made.surface is None
    assert made.preview is None
    assert made.figures["surface"].startswith("no surface: ")


def test_blown_views_give_one_line_and_no_scan(rig, views):
    blown = [ViewInput(v.plan, [(k, np.full_like(f, 255)) for k, f in v.frames]) for v in views]
    with pytest.raises(EmptyResultError, match=r"saturated; halve the exposure"):
        pipeline.scan(blown, rig)


def test_a_capture_without_views_gives_one_line(rig):
    with pytest.raises(EmptyResultError, match="no view to scan"):
        pipeline.scan([], rig)


def test_a_rig_that_lacks_the_camera(rig, views):
    two = Rig(rig.projector, rig.cameras[:2], rig.volume)
    with pytest.raises(RigError, match="lacks camera 'camera3'; it has camera1, camera2"):
        pipeline.scan(views, two)


def test_frames_of_another_size_than_the_rig_s(rig, views):
    cut = ViewInput(views[0].plan, [(k, f[:70]) for k, f in views[0].frames])
    with pytest.raises(DecodeError, match=r"frames of 96 x 70 pixels, the rig was calibrated at 96 x 72"):
        pipeline.scan([cut], rig)


@pytest.mark.parametrize("spoilt", ["int8", "bool", "rows", "columns"])
def test_frames_that_hold_no_pixels_give_one_line(rig, views, spoilt):
    wrong = {
        "int8": lambda a: a.astype(np.int8), "bool": lambda a: a > 100, "rows": lambda a: a[:0],
        "columns": lambda a: a[:, :0],
    }[spoilt]  # fmt: skip
    bad = ViewInput(views[0].plan, [(key, wrong(f)) for key, f in views[0].frames])
    with pytest.raises(CaptureError, match="needed pixels, as uint8 or uint16"):
        pipeline.scan([bad], rig)


def test_samples_of_another_byte_order_are_the_same_samples(rig, views):
    swapped = ViewInput(views[0].plan, [(key, f.astype(">u2")) for key, f in views[0].frames])
    native = ViewInput(views[0].plan, [(key, f.astype(np.uint16)) for key, f in views[0].frames])
    a, b = (pipeline.decode_view(v, Settings()).directions[0].phase for v in (swapped, native))
    np.testing.assert_array_equal(a, b)
    assert len(pipeline.scan([swapped], rig, surface=False).cloud) > 1000


def test_missing_frames(rig, views):
    short = ViewInput(views[0].plan, list(views[0].frames)[:-1])
    with pytest.raises(CaptureError, match=r"8-step set got 7 frames; missing \[7\]"):
        pipeline.scan([short], rig)


def test_sets_that_do_not_span_the_field_need_a_rig(rig):
    camera = rig.cameras[0]
    view, _ = core.view(rig, camera, core.plane_points(camera, NORMAL, OFFSET), (48.0, 16.0), (4, 8))
    with pytest.raises(DecodeError, match="give a rig"):
        pipeline.decode_view(view, Settings())


def test_the_picture_is_the_background_where_no_colour_was_taken(rig, views):
    decoded, _ = pipeline.scan_view(views[0], rig, Settings())
    photo = pipeline.picture(views[0], decoded, Settings())
    assert photo.rgb.shape == (72, 96, 3)
    assert views[0].plan.pixel_format is PixelFormat.MONO8
    np.testing.assert_array_equal(photo.rgb[..., 0], photo.rgb[..., 2])
