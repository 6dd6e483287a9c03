"""The surface judged by exact scenes: on the points, over no jump or shadow, a manifold, the picture in its place."""

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay

from fringescope import fuse, geometry
from fringescope.errors import EmptyResultError
from fringescope.fuse import delaunay
from fringescope.fuse import levels as levels_of_detail
from fringescope.settings import MeshSettings
from fringescope.types import Grid
from tests import fuse_scenes as scenes
from tests.reference import surface as reference


def faces_of(surface):
    return np.concatenate([p.vertex_index[p.faces] for p in surface.parts]).astype(int)


def build(hit, cameras=3, sigma=0.004, s=None, seed=0, **size):
    r, rng = scenes.rig(cameras, **size), np.random.default_rng(seed)
    grids = [scenes.grid(r, i, hit, sigma, rng) for i in range(cameras)]
    fused = fuse.merge(grids, [scenes.photo(g) for g in grids], r)
    return r, grids, fused, fuse.cloud(fused), fuse.surface(fused, r, s)


@pytest.fixture(scope="module")
def on_ball():
    return build(scenes.ball(), s=MeshSettings(triangles=12_000, preview_triangles=4_000))


def test_vertices_are_points_of_the_cloud(on_ball):
    _, _, _, c, levels = on_ball
    points = {p.tobytes() for p in c.xyz}
    for level in levels:
        assert all(v.tobytes() in points for v in level.vertices)
        assert len(np.unique(level.vertices, axis=0)) == len(level.vertices)


def test_levels_of_detail_have_the_triangles_asked_for_and_stay_near_the_points(on_ball):
    _, _, _, _, levels = on_ball
    assert 9_000 < levels[0].n_faces <= 12_000
    assert 3_000 < levels[1].n_faces <= 4_000
    hit = scenes.ball()
    for level, most in zip(levels, (0.03, 0.06), strict=True):
        corner = level.vertices[faces_of(level)].astype(float)
        for w in ((1 / 3, 1 / 3, 1 / 3), (0.5, 0.5, 0), (0, 0.5, 0.5), (0.5, 0, 0.5)):
            e = np.abs(hit.error(np.tensordot(w, corner, (0, 1))))
            assert np.percentile(e, 95) < most
            assert e.max() < 0.5


def test_every_edge_and_vertex_is_that_of_a_manifold_facing_outwards(on_ball):
    r, _, _, _, levels = on_ball
    for level in levels:
        f = faces_of(level)
        directed = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
        assert len(np.unique(directed, axis=0)) == len(directed), "each edge once in each direction at most"
        for v in np.random.default_rng(0).integers(0, len(level.vertices), 60):
            assert len(reference.fans(f[(f == v).any(1)], v)) == 1
        corner = level.vertices[f].astype(float)
        n = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        to_light = geometry.centre(r.projector.pose) - corner[:, 0]
        assert ((n * to_light).sum(1) > 0).all(), "nothing folds"
        np.testing.assert_allclose(np.linalg.norm(level.normals, axis=1), 1, atol=1e-4)


def border_of(surface):
    """The edges that one triangle has alone, as a set of pairs of points, from the first to the last."""
    f = faces_of(surface)
    e = np.sort(np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]]), axis=1)
    e, count = np.unique(e, axis=0, return_counts=True)
    points = [v.tobytes() for v in surface.vertices]
    return {frozenset((points[a], points[b])) for a, b in e[count == 1]}


def test_borders_stay_as_they_are(on_ball):
    _, _, fused, _, levels = on_ball
    whole = fuse.surface(fused, scenes.rig(3))[0]
    assert whole.n_faces > 1.5 * levels[0].n_faces
    assert len(border_of(whole)) > 200
    for level in levels:
        assert border_of(level) == border_of(whole)


def test_bent_places_get_more_vertices():
    """A plane with a round ridge along y: where it is flat, vertices are rarer, and the ridge is kept."""

    x, y = np.meshgrid(np.arange(-10, 10, 0.2), np.arange(-10, 10, 0.2))
    jitter = np.random.default_rng(0).uniform(-0.03, 0.03, (2, *x.shape))
    x, y = x + jitter[0], y + jitter[1]
    ab = np.stack([x.ravel(), y.ravel()], 1)
    z = np.exp(-((ab[:, 0] / 0.8) ** 2))
    at = delaunay.snapped(ab)
    d = Delaunay(at)
    normal = np.tile(np.float32([0, 0, 1]), (len(ab), 1))
    sheet = levels_of_detail.Sheet(at, np.column_stack([ab, z]).astype(np.float32), normal, d.simplices, d.neighbors,
                                   np.ones(len(d.simplices), bool))
    (faces,) = levels_of_detail.simplify(sheet, [len(d.simplices) // 5])
    assert len(faces) in (len(d.simplices) // 5, len(d.simplices) // 5 - 1)
    inner = np.unique(faces)[~sheet.border[np.unique(faces)]]
    near = np.abs(ab[inner, 0]) < 1.6
    share = (np.abs(ab[:, 0]) < 1.6).mean()
    assert near.mean() > 1.8 * share
    interpolated = LinearNDInterpolator(ab[np.unique(faces)], z[np.unique(faces)])(ab)
    assert np.nanmax(np.abs(interpolated - z)) < 0.12
    assert np.nanpercentile(np.abs(interpolated - z), 99) < 0.04


def test_a_ragged_surface_still_gets_few_triangles():
    """Half of the points missing at random: the border alone has more edges than the level may have triangles."""
    r, rng = scenes.rig(1), np.random.default_rng(2)
    g = scenes.grid(r, 0, scenes.plane((0, 0, 1), 0.0), 0.002, rng, lambda _, u, __: rng.random(np.shape(u)) < 0.5)
    fused = fuse.merge([g], [scenes.photo(g)], r)
    points = {p.tobytes() for p in fuse.cloud(fused).xyz}
    levels = fuse.surface(fused, r, MeshSettings(triangles=1500, preview_triangles=300, max_edge=1.6))
    for level, most in zip(levels, (1500, 300), strict=True):
        assert 0 < level.n_faces <= most
        assert all(v.tobytes() in points for v in level.vertices)


def test_a_preview_alone_is_a_surface_too(on_ball):
    r, _, fused, c, levels = on_ball
    points = {p.tobytes() for p in c.xyz}
    few = fuse.preview(fused, r, MeshSettings(preview_triangles=4_000))
    assert 3_000 < few.n_faces <= 4_000
    assert all(v.tobytes() in points for v in few.vertices)
    assert len(few.vertices) < len(levels[1].vertices) + 100
    f = faces_of(few)
    directed = np.concatenate([f[:, [0, 1]], f[:, [1, 2]], f[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    corner = few.vertices[f].astype(float)
    assert np.percentile(np.abs(scenes.ball().error(corner.mean(1))), 95) < 0.06
    all_of_it = fuse.surface(fused, r, MeshSettings(triangles=10**6, preview_triangles=10**6))[0]
    assert fuse.preview(fused, r, MeshSettings(preview_triangles=10**6)).n_faces == all_of_it.n_faces


def test_levels_share_their_pictures(on_ball):
    *_, levels = on_ball
    textures = {p.view: p.texture for p in levels[0].parts}
    assert all(p.texture is textures[p.view] for p in levels[1].parts)
    assert all(p.texture.flags.c_contiguous for level in levels for p in level.parts)


def test_a_lattice_of_rows_and_columns_keeps_its_borders():
    """Four points on one circle at every place, a hole in the middle: the border has the same edges at every level."""
    x, y = np.meshgrid(np.arange(60.0), np.arange(50.0))
    ab = np.stack([x.ravel(), y.ravel()], 1)
    ab = ab[np.hypot(ab[:, 0] - 30, ab[:, 1] - 25) > 6.2]
    at = delaunay.snapped(ab)
    simplices, neighbours = delaunay.Triangulation(at, delaunay.along_curve(at)).triangles()
    on = np.ptp(ab[simplices], axis=1).max(1) < 1.5
    normal = np.tile(np.float32([0, 0, 1]), (len(ab), 1))
    z = 0.02 * np.random.default_rng(0).standard_normal(len(ab))
    sheet = levels_of_detail.Sheet(at, np.column_stack([ab, z]).astype(np.float32), normal, simplices, neighbours, on)

    def border(faces):
        e = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
        e, count = np.unique(e, axis=0, return_counts=True)
        assert count.max() == 2
        return set(map(tuple, e[count == 1].tolist()))

    assert set(np.flatnonzero(sheet.border)) == {v for e in border(sheet.faces) for v in e}
    wanted = [len(sheet.faces) // n for n in (2, 4, 7)]
    for faces, most in zip(levels_of_detail.simplify(sheet, wanted), wanted, strict=True):
        assert len(faces) in (most, most - 1)
        assert border(faces) == border(sheet.faces)


def test_nothing_bridges_ball_and_floor(on_ball):
    _, _, _, _, levels = on_ball
    for level in levels:
        corner = level.vertices[faces_of(level)].astype(float)
        ball = np.abs(np.linalg.norm(corner - [0, 0, 4], axis=2) - 6) < 0.3
        floor = np.abs(corner[..., 2] + 2) < 0.05
        both = ball.any(1) & floor.any(1) & (corner[..., 2].max(1) > -1.5)
        assert not both.any()


def test_nothing_crosses_a_step_or_its_shadow():
    _, _, _, c, levels = build(scenes.step(1.0))
    corner = levels[0].vertices[faces_of(levels[0])]
    assert (c.xyz[:, 2] > 0.9).sum() > 1000
    assert (c.xyz[:, 2] < 0.1).sum() > 1000
    up, down = (corner[..., 2] > 0.9).any(1), (corner[..., 2] < 0.1).any(1)
    assert not (up & down).any()


def test_a_plane_is_whole():
    _, _, _, c, levels = build(scenes.plane((0, 0, 1), 0.0), sigma=0.002)
    corner = levels[0].vertices[faces_of(levels[0])].astype(float)
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum() / 2
    cells = np.unique(np.floor(c.xyz[:, :2] / 0.6), axis=0)
    assert area == pytest.approx(0.36 * len(cells), rel=0.05)


def test_a_hole_stays_open_and_crumbs_go():
    r, rng = scenes.rig(1), np.random.default_rng(1)

    def keep(_, u, v):
        far = np.hypot(u - 80, v - 60)
        return (far > 12) | (far < 1.5)

    g = scenes.grid(r, 0, scenes.plane((0, 0, 1), 0.0), 0.002, rng, keep)
    fused = fuse.merge([g], [scenes.photo(g)], r)
    level = fuse.surface(fused, r)[0]
    corner = level.vertices[faces_of(level)]
    middle = g.xyz[60, 80]
    assert np.linalg.norm(corner - middle, axis=2).min() > 10 * 0.25


def test_the_picture_lies_where_it_belongs():
    """Colour looked up through uv equals the paint at the vertex: half a pixel off would show."""
    _, _, _, _, levels = build(scenes.plane())
    looked_at = 0
    for part in levels[0].parts:
        h, w = part.texture.shape[:2]
        x, y = part.uv[:, 0] * w - 0.5, part.uv[:, 1] * h - 0.5
        assert (x >= 0).all()
        assert (y <= h - 1).all()
        i, j = np.clip(np.floor(y).astype(int), 0, h - 2), np.clip(np.floor(x).astype(int), 0, w - 2)
        fy, fx = (y - i)[:, None], (x - j)[:, None]
        t = fuse.decode_srgb(part.texture).astype(float)
        colour = (1 - fy) * ((1 - fx) * t[i, j] + fx * t[i, j + 1]) + fy * (
            (1 - fx) * t[i + 1, j] + fx * t[i + 1, j + 1]
        )
        want = scenes.paint(levels[0].vertices[part.vertex_index].astype(float))
        inner = (np.abs(levels[0].vertices[part.vertex_index][:, :2]) < [12, 8]).all(1)
        if inner.sum() < 300:
            continue
        looked_at += 1
        error = colour[inner] - want[inner]
        slope = 0.25 * 0.012  # change of green over one pixel of 0.25 mm
        assert abs(np.median(error[:, 1])) < 0.1 * slope + 0.5 / 255
        assert np.abs(error).max() < 0.02
    assert looked_at >= 1


def test_texture_keeps_the_cameras_sampling():
    _, _, fused, _, levels = build(scenes.plane())
    for part in levels[0].parts:
        H, W = fused.grids[part.view].sigma.shape
        x = part.uv[:, 0] * part.texture.shape[1]
        assert part.texture.shape[0] <= H
        assert part.texture.shape[1] <= W
        spread = levels[0].vertices[part.vertex_index]
        assert np.ptp(x) >= 0.8 * np.ptp(spread[:, 0]) / fused.spacing_mm[part.view] * 0.8


def test_denser_clouds_are_strided():
    _, _, _, _, levels = build(scenes.plane(), s=MeshSettings(max_points=1500))
    assert len(levels[0].vertices) <= 1600
    corner = levels[0].vertices[faces_of(levels[0])]
    assert len(corner) > 900


def test_too_few_points_for_a_triangle():
    r = scenes.rig(1)
    g = scenes.grid(r, 0, scenes.plane(), keep=lambda _, u, v: (v == 60) & (u < 82) & (u > 78))
    fused = fuse.merge([g], [scenes.photo(g)], r)
    with pytest.raises(EmptyResultError, match="no surface"):
        fuse.surface(fused, r)
    apart = scenes.grid(r, 0, scenes.plane(), keep=lambda _, u, v: (u % 10 == 0) & (v % 10 == 0))
    with pytest.raises(EmptyResultError, match="no surface"):
        fuse.surface(fuse.merge([apart], [scenes.photo(apart)], r), r)


def test_noise_larger_than_the_sampling_does_not_tear_the_surface():
    _, _, _, c, levels = build(scenes.plane((0, 0, 1), 0.0), cameras=1, sigma=0.2)
    assert levels[0].n_faces > 1.8 * len(c)
    assert isinstance(levels[0].vertices, np.ndarray)


def test_normals_are_those_of_the_grid():
    r = scenes.rig(1)
    g = scenes.grid(r, 0, scenes.plane())
    n = fuse.normals(g, r)
    want = np.array([0.05, 0.1, 1]) / np.linalg.norm([0.05, 0.1, 1])
    np.testing.assert_allclose(n[g.valid], np.broadcast_to(want, n[g.valid].shape), atol=5e-3)
    assert isinstance(g, Grid)
