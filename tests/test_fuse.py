"""Fusion judged by exact scenes: noise falls as independent views allow, one layer, no steps, colours that agree."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from fringescope import denoise, fuse, geometry
from fringescope.errors import EmptyResultError, RigError
from fringescope.settings import FuseSettings, Settings
from fringescope.types import Grid, Photo, Rig
from tests import fuse_scenes as scenes
from tests.reference.colour import de2000, lab


def along_normal(r, c, view_index, n):
    """Cosine between each point's own ray and the normal."""
    centres = np.array([geometry.centre(x.pose) for x in r.cameras])
    ray = centres[view_index] - c.xyz
    return (ray / np.linalg.norm(ray, axis=1, keepdims=True)) @ n


@pytest.fixture(scope="module")
def flat():
    r, hit, rng = scenes.rig(3), scenes.plane(), np.random.default_rng(1)
    grids = [scenes.grid(r, i, hit, 0.005, rng) for i in range(3)]
    photos = [scenes.photo(g) for g in grids]
    return r, hit, grids, photos, fuse.merge(grids, photos, r)


def test_noise_falls_by_the_root_of_the_views_and_sigma_tells_it(flat):
    r, hit, _, _, fused = flat
    c = fuse.cloud(fused)
    e = hit.error(c.xyz.astype(float))
    seen = fused.seen
    inner = (seen == 7) & (np.abs(c.xyz[:, :2]) < [14, 9]).all(1)
    n = np.array([0.05, 0.1, 1.0]) / np.linalg.norm([0.05, 0.1, 1.0])
    cosines = np.stack([along_normal(r, c, np.full(len(c), i), n) for i in range(3)])
    best = 0.005 / np.sqrt((1 / cosines**2).sum(0))  # inverse-variance mean of three independent views
    assert inner.sum() > 5000
    assert np.std(e[inner]) < 1.03 * best[inner].mean()
    assert np.std(e[inner]) > 0.97 * best[inner].mean(), "less noise than three independent samples: somebody smoothed"
    ratio = np.std(e[inner] / (c.sigma[inner] * along_normal(r, c, c.view, n)[inner]))
    assert 0.97 < ratio < 1.03
    row = np.abs(np.diff(c.xyz[:, 1])) < 0.1
    pairs = inner[1:] & inner[:-1] & row
    assert abs(np.corrcoef(e[1:][pairs], e[:-1][pairs])[0, 1]) < 0.12
    assert abs(e[inner].mean()) < 0.0002


def test_one_layer_without_gaps(flat):
    _, _, grids, _, fused = flat
    c = fuse.cloud(fused)
    assert len(np.unique(c.view)) >= 2
    distance, nearest = cKDTree(c.xyz).query(c.xyz, k=2)
    other = c.view[nearest[:, 1]] != c.view
    spacing = np.median(distance[:, 1])
    assert distance[other, 1].min() > 0.49 * spacing
    best = max(int(g.valid.sum()) for g in grids)
    assert len(c) < 1.1 * best
    every = np.concatenate([g.xyz[g.valid] for g in grids])
    gap, _ = cKDTree(c.xyz).query(every)
    assert gap.max() < 2.5 * spacing


def test_a_view_that_is_off_leaves_no_step_at_its_border():
    r, hit, rng = scenes.rig(3), scenes.plane((0, 0, 1), 0.0), np.random.default_rng(2)
    grids = [scenes.grid(r, i, hit, 0.002, rng) for i in (0, 1)]
    third = scenes.grid(r, 2, hit, 0.002, rng, keep=lambda p, *_: p[..., 0] > 0)
    grids.append(Grid(third.view, third.camera, third.xyz + np.float32([0, 0, 0.03]), third.sigma, third.reasons))
    fused = fuse.merge(grids, [scenes.photo(g) for g in grids], r)
    c = fuse.cloud(fused)
    inner = (np.abs(c.xyz[:, 1]) < 9) & (np.abs(c.xyz[:, 0]) < 12)
    x, z = c.xyz[inner, 0], c.xyz[inner, 2]
    left, right = z[(x > -0.5) & (x < 0)], z[(x > 0) & (x < 0.5)]
    assert len(left) > 100
    assert len(right) > 100
    assert abs(np.median(right) - np.median(left)) < 0.001
    assert np.median(z[x > 5]) > 0.007, "the third view counts far from its border"


def test_a_single_view_stays_as_it_is(flat):
    r, _, grids, photos, _ = flat
    fused = fuse.merge(grids[1:2], photos[1:2], r)
    c = fuse.cloud(fused)
    np.testing.assert_array_equal(c.xyz, grids[1].xyz[grids[1].valid])
    assert len(c) == grids[1].valid.sum()
    assert (c.view == 1).all()


@pytest.mark.parametrize("cameras", [2, 5])
def test_other_numbers_of_cameras(cameras):
    r, hit, rng = scenes.rig(cameras, 80, 60), scenes.plane(), np.random.default_rng(3)
    grids = [scenes.grid(r, i, hit, 0.005, rng) for i in range(cameras)]
    fused = fuse.merge(grids, [scenes.photo(g) for g in grids], r)
    c = fuse.cloud(fused)
    inner = (np.abs(c.xyz[:, :2]) < [12, 7]).all(1)
    assert np.std(hit.error(c.xyz.astype(float))[inner]) < 0.0052 / np.sqrt(cameras)


def test_curved_and_hidden_surfaces_keep_their_place():
    r, hit, rng = scenes.rig(3), scenes.ball(), np.random.default_rng(4)
    sigma = 0.003
    grids = [scenes.grid(r, i, hit, sigma, rng) for i in range(3)]
    c = fuse.cloud(fuse.merge(grids, [scenes.photo(g) for g in grids], r))
    e = hit.error(c.xyz.astype(float))
    on_ball = np.abs(np.linalg.norm(c.xyz - [0, 0, 4], axis=1) - 6) < 0.1
    assert on_ball.sum() > 1000
    assert np.abs(e).max() < 8 * sigma
    assert abs(e[on_ball].mean()) < 0.0004
    exact = (c.xyz[on_ball] - [0, 0, 4]) / np.linalg.norm(c.xyz[on_ball] - [0, 0, 4], axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((exact * c.normals[on_ball]).sum(1), -1, 1)))
    assert np.median(angle) < 1.0
    assert np.percentile(angle, 99) < 8


def test_views_that_disagree_do_not_mix(flat):
    r, hit, grids, photos, _ = flat
    wrong = Grid(1, grids[1].camera, grids[1].xyz + np.float32([0, 0, 2.0]), grids[1].sigma, grids[1].reasons)
    fused = fuse.merge([grids[0], wrong, grids[2]], photos, r)
    e = hit.error(fuse.cloud(fused).xyz.astype(float))
    assert ((np.abs(e) < 0.05) | (np.abs(e - 2.0 * 0.99) < 0.05)).all(), "nothing between the two surfaces"


def test_all_points_are_the_grids_row_by_row(flat):
    r, _, grids, photos, _ = flat
    c = fuse.all_points(grids, photos, r)
    first = grids[0].xyz[grids[0].valid]
    np.testing.assert_array_equal(c.xyz[: len(first)], first)
    assert len(c) == sum(int(g.valid.sum()) for g in grids)
    assert (np.diff(c.view.astype(int)) >= 0).all()
    assert len(np.unique(c.xyz, axis=0)) == len(c)
    np.testing.assert_allclose(np.linalg.norm(c.normals, axis=1), 1, atol=1e-5)


def difference_between_views(r, grids, pictures, seen):
    """dE2000 at the places that two views share, each looked up in its own picture."""
    out = []
    for a in range(len(grids)):
        for b in range(a):
            shared = ((seen[a] >> b) & 1) > 0
            uv = np.rint(geometry.project(r.cameras[grids[b].view], grids[a].xyz[shared])).astype(int)
            out.append(de2000(lab(pictures[a][shared]), lab(pictures[b][uv[:, 1], uv[:, 0]])))
    return np.concatenate(out)


def test_pictures_of_different_exposure_and_tint_agree_after_balancing(flat):
    r, _, grids, _, _ = flat
    gains = np.array([[1.0, 1.0, 1.0], [0.7, 0.8, 0.75], [1.2, 1.1, 1.4]])
    rng = np.random.default_rng(5)
    photos = [scenes.photo(g, k, rng, 0.004) for g, k in zip(grids, gains, strict=True)]
    fused = fuse.merge(grids, photos, r)
    ratio = fused.gains * gains
    np.testing.assert_allclose(ratio / ratio[0], np.ones((3, 3)), atol=0.01)
    np.testing.assert_allclose(np.log(fused.gains).mean(0), 0, atol=1e-6)
    assert np.median(difference_between_views(r, grids, fused.pictures, scenes.seen(fused))) < 1.0
    off = fuse.merge(grids, photos, r, FuseSettings(harmonise=False))
    raw = [fuse.encode_srgb(p.rgb) for p in photos]
    assert np.median(difference_between_views(r, grids, raw, scenes.seen(off))) > 5.0
    own = fuse.all_points(grids, photos, r)
    split = np.cumsum([int(g.valid.sum()) for g in grids])[:-1]
    truth = [scenes.paint(p.astype(float)) for p in np.split(own.xyz, split)]
    common = (1 / (gains * fused.gains)).mean(0)
    for colours, t in zip(np.split(own.rgb, split), truth, strict=True):
        assert np.median(de2000(lab(colours), lab(fuse.encode_srgb(t / common)))) < 1.0


def test_highlights_come_from_the_views_that_do_not_have_them(flat):
    r, _, grids, photos, _ = flat
    H, W = grids[0].sigma.shape
    v, u = np.mgrid[:H, :W]
    spot = (u - 80) ** 2 + (v - 60) ** 2 < 15**2
    rim = (u - 80) ** 2 + (v - 60) ** 2 < 20**2
    rgb = photos[0].rgb.copy()
    rgb[rim] += 0.35
    rgb[spot] = 1.0
    glossy = Photo(photos[0].camera, rgb, spot)
    fused = fuse.merge(grids, [glossy, *photos[1:]], r, FuseSettings(harmonise=False))
    expected = fuse.encode_srgb(scenes.paint(grids[0].xyz.astype(float)))
    ok = grids[0].valid
    assert de2000(lab(fused.pictures[0][spot & ok]), lab(expected[spot & ok])).max() < 2.0
    assert np.median(de2000(lab(fused.pictures[0][rim & ~spot & ok]), lab(expected[rim & ~spot & ok]))) < 4.0


def test_pixels_without_a_point_in_a_highlight_are_no_specks(flat):
    r, _, grids, photos, _ = flat
    g = grids[0]
    H, W = g.sigma.shape
    v, u = np.mgrid[:H, :W]
    spot = (u - 80) ** 2 + (v - 60) ** 2 < 15**2
    holes = spot & (u % 5 == 0) & (v % 4 == 0)
    rgb = photos[0].rgb + np.where(spot, 0.5, 0.0).astype(np.float32)[..., None]
    xyz, sigma, reasons = g.xyz.copy(), g.sigma.copy(), g.reasons.copy()
    xyz[holes], sigma[holes], reasons[holes] = np.nan, np.nan, 2
    torn = Grid(g.view, g.camera, xyz, sigma, reasons)
    glossy = Photo(photos[0].camera, rgb, spot)
    fused = fuse.merge([torn, *grids[1:]], [glossy, *photos[1:]], r, FuseSettings(harmonise=False))
    expected = fuse.encode_srgb(scenes.paint(g.xyz.astype(float)))
    where = holes & g.valid
    assert where.sum() > 20
    assert de2000(lab(fused.pictures[0][where]), lab(expected[where])).max() < 4.0


def test_a_grey_picture_takes_no_colour_away(flat):
    r, _, grids, photos, _ = flat
    grey = Photo(photos[0].camera, np.repeat(photos[0].rgb.mean(2, keepdims=True), 3, 2), photos[0].saturated)
    fused = fuse.merge(grids, [grey, *photos[1:]], r)
    expected = fuse.encode_srgb(scenes.paint(grids[0].xyz.astype(float)))
    shared = (scenes.seen(fused)[0] & 6) == 6
    difference = de2000(lab(fused.pictures[0][shared]), lab(expected[shared]))
    assert np.median(difference) < 3.0
    only = [Photo(p.camera, np.repeat(p.rgb.mean(2, keepdims=True), 3, 2), p.saturated) for p in photos]
    c = fuse.cloud(fuse.merge(grids, only, r))
    assert (c.rgb[:, 0] == c.rgb[:, 2]).all()


def test_views_of_other_sizes_in_arrays_of_any_kind(flat):
    """Strided, Fortran-ordered and read-only arrays give what plain ones give; sizes may differ between views."""
    r, hit, grids, _, _ = flat
    camera = scenes.rig(3, 96, 72).cameras[1]
    other = Rig(r.projector, (r.cameras[0], camera, r.cameras[2]))
    views = [grids[0], scenes.grid(other, 1, hit, 0.005, np.random.default_rng(7)), grids[2]]
    pictures = [scenes.photo(g) for g in views]
    plain = fuse.merge(views, pictures, other)
    wide = np.repeat(views[0].xyz, 2, axis=1)
    fixed = views[2].sigma.copy()
    fixed.setflags(write=False)
    odd = [
        Grid(0, views[0].camera, wide[:, ::2], np.asfortranarray(views[0].sigma), views[0].reasons),
        views[1],
        Grid(2, views[2].camera, views[2].xyz, fixed, views[2].reasons),
    ]
    odd_pictures = [Photo(p.camera, np.asfortranarray(p.rgb), p.saturated) for p in pictures]
    fused = fuse.merge(odd, odd_pictures, other)
    for name in ("xyz", "normals", "rgb", "sigma", "view"):
        np.testing.assert_array_equal(getattr(fused.cloud, name), getattr(plain.cloud, name))
    assert set(np.unique(plain.cloud.view)) <= {0, 1, 2}
    inner = (np.abs(plain.cloud.xyz[:, :2]) < [12, 7]).all(1)
    assert np.std(hit.error(plain.cloud.xyz.astype(float))[inner]) < 0.0052 / np.sqrt(2)
    every = fuse.all_points(odd, odd_pictures, other)
    np.testing.assert_array_equal(every.xyz, np.concatenate([g.xyz[g.valid] for g in views]))
    for a, b in zip(denoise.agree(odd, other, Settings().denoise), views, strict=True):
        np.testing.assert_array_equal(a.reasons, b.reasons)


def empty(g):
    return Grid(g.view, g.camera, np.full_like(g.xyz, np.nan), np.full_like(g.sigma, np.nan), np.ones_like(g.reasons))


def test_empty_views(flat):
    r, _, grids, photos, _ = flat
    fused = fuse.merge([grids[0], empty(grids[1]), grids[2]], photos, r)
    assert set(np.unique(fuse.cloud(fused).view)) <= {0, 2}
    with pytest.raises(EmptyResultError, match="no view has a single valid point"):
        fuse.merge([empty(g) for g in grids], photos, r)


def test_wrong_inputs_are_named(flat):
    r, _, grids, photos, _ = flat
    with pytest.raises(RigError, match="3 grids and 2 pictures"):
        fuse.merge(grids, photos[:2], r)
    with pytest.raises(RigError, match="same order"):
        fuse.merge(grids, photos[::-1], r)
    with pytest.raises(RigError, match="the rig has 3 cameras"):
        fuse.merge([Grid(7, "camera1", *(getattr(grids[0], k) for k in ("xyz", "sigma", "reasons")))], photos[:1], r)
    small = Photo(photos[0].camera, photos[0].rgb[:50], photos[0].saturated[:50])
    with pytest.raises(RigError, match="picture of 160 x 50"):
        fuse.all_points(grids[:1], [small], r)
