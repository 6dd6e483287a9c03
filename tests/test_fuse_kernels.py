"""The kernels of fusion and meshing against their slow twins."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.spatial import Delaunay

from fringescope import geometry
from fringescope.fuse import mesh
from fringescope.kernels import blending, colour, fusing, ownership
from fringescope.kernels import mesh as mesh_kernels
from fringescope.kernels import surface as kernels
from fringescope.types import Grid
from tests import fuse_scenes as scenes
from tests.reference import surface as reference


def points_of(g):
    return g.xyz, g.xyz.reshape(len(g.xyz), -1), g.sigma


def normals_of(r, g, radius=2, max_slope=4.0, jump_sigma=5.0):
    out = np.empty_like(g.xyz)
    camera = r.cameras[g.view]
    kernels.normals(*points_of(g), geometry.centre(camera.pose), 1 / camera.lens.K[0, 0] * 0.95, radius, max_slope,
                    jump_sigma, out)  # fmt: skip
    return out


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_normals_equal_least_squares_also_at_holes_jumps_and_borders(seed):
    """Few holes, a ball before a floor: the quick way and the slow one both take part."""
    rng = np.random.default_rng(seed)
    r = scenes.rig(3, 40, 30)
    share = float(rng.choice([0.0, 0.02, 0.2]))
    g = scenes.grid(r, 1, scenes.ball(), 0.004, rng, keep=lambda p, *_: rng.random(p.shape[:2]) > share)
    out = normals_of(r, g)
    centre = geometry.centre(r.cameras[1].pose)
    for i in range(0, 30, 2):
        for j in range(int(rng.integers(0, 2)), 40, 2):
            if not g.valid[i, j]:
                assert np.isnan(out[i, j]).all()
            else:
                want = reference.normal(g.xyz, g.sigma, centre, i, j, 2, 4.0, 5.0)
                np.testing.assert_allclose(out[i, j], want, atol=3e-5)


@pytest.mark.parametrize(("width", "height", "radius"), [(1, 9, 2), (9, 1, 2), (3, 3, 2), (600, 7, 2), (12, 9, 3)])
def test_normals_of_narrow_grids_and_other_windows(width, height, radius):
    r = scenes.rig(1, 600, 450)
    whole = scenes.grid(r, 0, scenes.plane(), 0.004, np.random.default_rng(0))
    cut = (slice(200, 200 + height), slice(0, width) if width == 600 else slice(300, 300 + width))
    g = Grid(0, whole.camera, whole.xyz[cut].copy(), whole.sigma[cut].copy(), whole.reasons[cut].copy())
    out = normals_of(r, g, radius)
    centre = geometry.centre(r.cameras[0].pose)
    for i, j in np.argwhere(g.valid)[:: max(1, g.valid.sum() // 200)]:
        want = reference.normal(g.xyz, g.sigma, centre, i, j, radius, 4.0, 5.0)
        np.testing.assert_allclose(out[i, j], want, atol=3e-5)
    nothing = Grid(0, g.camera, np.full_like(g.xyz, np.nan), np.full_like(g.sigma, np.nan), g.reasons)
    assert np.isnan(normals_of(r, nothing, radius)).all()


def test_codes_of_normals_are_true_to_a_hundredth_of_a_degree():
    rng = np.random.default_rng(0)
    n = rng.standard_normal((fusing.BLOCK, 3)).astype(np.float32)
    n[:6] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]]
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    code = np.empty(len(n), np.int32)
    padded = np.zeros(len(n) + 4, np.float32)
    padded[12] = np.nan
    kernels._encode(padded, *np.ascontiguousarray(n.T), len(n), code)
    assert code[10].astype(np.int16) == kernels.NOTHING
    out = np.empty_like(n.T)
    fusing.decode(code, len(n), *out)
    off = np.linalg.norm(out.T - n, axis=1)
    assert np.delete(off, 10).max() < 1e-4


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_blend_equals_its_twin(seed):
    rng = np.random.default_rng(seed)
    V, n = int(rng.integers(1, 6)), 9
    C = np.zeros((V, 4, fusing.BLOCK), np.float32)
    C[:, :3, :n] = rng.random((V, 3, n))
    C[:, 3, :n] = rng.random((V, n)) * (rng.random((V, n)) > 0.3)
    channels = int(rng.choice([1, 3]))
    if channels == 1:
        C[:, 1] = C[:, 2] = C[:, 0]
    out = np.empty((7, fusing.BLOCK), np.float32)
    blending.blend(C, V, np.float32(0.25), channels, n, out)
    for k in range(n):
        want = reference.blend(C[:, :3, k], C[:, 3, k], 0.25)
        np.testing.assert_allclose(out[:channels, k], want[:channels], rtol=2e-4, atol=1e-6)


def test_places_in_the_raster_are_those_of_the_projection():
    rng = np.random.default_rng(4)
    xyz = rng.normal([1, 2, 300], [20, 20, 5], (50, 3)).astype(np.float32)
    raster = np.concatenate([np.eye(3).ravel(), [0.5, 0.2, 10.0], [-0.05, -0.04], [1 / 0.01]])
    ab, cell = np.empty((50, 2)), np.empty(50, np.int64)
    ownership.place(xyz, raster, 9, 12, ab, cell)
    q = xyz.astype(float) + np.array([0.5, 0.2, 10.0])
    np.testing.assert_allclose(ab, q[:, :2] / q[:, 2:], rtol=1e-12)
    at = np.clip(((ab - np.array([-0.05, -0.04])) / 0.01).astype(int), 0, [11, 8])
    np.testing.assert_array_equal(cell, at @ [1, 12])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_doubles_equal_brute_force(seed):
    rng = np.random.default_rng(seed)
    ab, view, reach = rng.random((60, 2)), rng.integers(0, 3, 60).astype(np.int16), 0.09
    cell = (ab / 0.1).astype(np.int64) @ [1, 10]
    start, order, out = np.zeros(102, np.int32), np.empty(60, np.int64), np.zeros(60, bool)
    ownership.sort_cells(cell, start, order)
    np.testing.assert_array_equal(order, np.argsort(cell, kind="stable"))
    np.testing.assert_array_equal(start[:101], np.searchsorted(np.sort(cell), np.arange(101)))
    flat, up = np.zeros((60, 3), np.float32), np.tile(np.float32([0, 0, 1]), (60, 1))
    ownership.doubles(ab, flat, up, view, reach, 0.0, 0.0, cell, 10, 10, start, order, out)
    np.testing.assert_array_equal(out, reference.doubles(ab, view, reach, order))
    kept = np.flatnonzero(~out)
    d = np.linalg.norm(ab[kept][:, None] - ab[kept][None], axis=2)
    d[view[kept][:, None] == view[kept][None]] = np.inf
    assert d.min() >= reach


def test_cells_owners_and_marks_equal_numpy():
    """A pinhole at the origin looks along z; its raster of 6 x 8 cells of 0.1 begins at (-0.3, -0.2)."""
    rng = np.random.default_rng(3)
    H, W = 30, 300
    ab = rng.random((H, W, 2)) * [0.8, 0.6] + [-0.3, -0.2]
    z = 1 + rng.random((H, W, 1))
    xyz = np.concatenate([ab * z, z], -1).astype(np.float32)
    xyz[rng.random((H, W)) < 0.2] = np.nan
    raster = np.array([1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, -0.3, -0.2, 10.0])
    cell = np.floor((ab - [-0.3, -0.2]) * 10 + 0.0).astype(int)
    clear = (np.abs((ab - [-0.3, -0.2]) * 10 - np.rint((ab - [-0.3, -0.2]) * 10)) > 1e-4).all(-1)
    owner = rng.integers(0, 4, (6, 8)).astype(np.uint8)
    bits = np.full(256, 4, np.uint8)
    bits[2] = 5
    marks, near = np.empty((H, W), np.uint8), np.zeros((1, 10), np.uint8)
    owned, close = np.empty(H, np.int64), np.empty(H, np.int64)
    ownership.mark(xyz.reshape(H, -1), raster, owner, bits, 32, marks, owned, close, near)
    valid = np.isfinite(xyz[..., 0])
    mine = valid & (owner[cell[..., 1].clip(0, 5), cell[..., 0].clip(0, 7)] == 2)
    assert ((marks != 0) == valid).all()
    np.testing.assert_array_equal(((marks & 1) != 0)[clear], mine[clear])
    np.testing.assert_array_equal(owned, ((marks & 1) != 0).sum(1))
    assert not close.any()
    squares = [((marks & 1) != 0)[:, 32 * q : 32 * q + 32].any() for q in range(10)]
    np.testing.assert_array_equal(near[0] != 0, squares)
    numbers = np.empty((-(-H // 4), W // 4), np.int64)
    assert ownership.number(marks, 1, 4, 7, numbers) == 7 + owned.sum()
    rank = 7 + np.cumsum(((marks & 1) != 0).ravel()).reshape(H, W) - 1
    np.testing.assert_array_equal(numbers, np.where((marks & 1) != 0, rank, -1)[::4, ::4])


def test_the_best_view_present_owns_a_cell():
    there = np.random.default_rng(0).integers(0, 2, (3, 10, 15)).astype(np.uint8)
    score = np.zeros((3, 4, 5), np.float32)
    score[0], score[1], score[2] = 1, 3, 2
    out = np.empty((10, 15), np.uint8)
    ownership.owners(there, score, 5, out)
    want = np.where(there[1], 2, np.where(there[2], 3, np.where(there[0], 1, 0)))
    np.testing.assert_array_equal(out, want)


def test_clearness_is_the_distance_from_saturated_pixels():
    rng = np.random.default_rng(1)
    full = rng.random((20, 33)) < 0.02
    out = np.empty(full.shape, np.uint8)
    colour.clearness(full, 4, out)
    padded = np.pad(~full, 1)
    d = ndimage.distance_transform_edt(padded)[1:-1, 1:-1]
    x = np.clip(d / 4, 0, 1)
    np.testing.assert_allclose(out, 255 * x * x * (3 - 2 * x), atol=0.51)


@pytest.mark.parametrize("step", [1, 3, 7])
def test_spread_is_bilinear(step):
    coarse = np.random.default_rng(step).random((5, 6)).astype(np.float32)
    out = np.empty((3 * step - (step > 1), 4 * step), np.uint8)
    colour.spread(out, coarse, step)
    i, j = np.mgrid[: out.shape[0], : out.shape[1]]
    at = [(i + 0.5) / step + 0.5, (j + 0.5) / step + 0.5]
    want = 255 * ndimage.map_coordinates(coarse.astype(float), at, order=1)
    np.testing.assert_allclose(out, want, atol=0.52)


def test_triangles_equal_their_twin_and_fans_are_counted_right():
    rng = np.random.default_rng(4)
    xyz = (rng.random((40, 3)) * [4, 4, 0.4]).astype(np.float32)
    normals = (np.float32([0, 0, 1]) + 0.3 * rng.standard_normal((40, 3))).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    sigma, reach = rng.random(40).astype(np.float32) * 0.02, (0.5 + rng.random(40)).astype(np.float32)
    faces = np.array([rng.permutation(40)[:3] for _ in range(300)])
    out = np.empty(300, bool)
    mesh_kernels.on_surface(faces, xyz, normals, sigma, reach, 2.0, 0.3, 5.0, out)
    want = [reference.on_surface(f, xyz, normals, sigma, reach, 2.0, 0.3, 5.0) for f in faces]
    assert 20 < sum(want) < 280
    np.testing.assert_array_equal(out, want)
    area = np.empty(300)
    mesh_kernels.areas(faces, xyz, area)
    e = xyz[faces].astype(float)
    np.testing.assert_allclose(
        area, np.linalg.norm(np.cross(e[:, 1] - e[:, 0], e[:, 2] - e[:, 0]), axis=1) / 2, rtol=1e-5
    )


def neighbours_of(faces):
    """The triangle across each edge, opposite the corner of the same place; -1 where there is none."""
    edge = {(f[(c + 1) % 3], f[(c + 2) % 3]): t for t, f in enumerate(faces.tolist()) for c in range(3)}
    return np.array([[edge.get((f[(c + 2) % 3], f[(c + 1) % 3]), -1) for c in range(3)] for f in faces.tolist()])


def test_bow_tie_loses_its_smaller_fan():
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 4, 5]])
    assert sorted(map(len, reference.fans(faces, 0))) == [1, 2]
    leaving, largest, on, keep = np.empty(6, np.int32), np.empty(6, np.int32), np.ones(3, bool), np.ones(3, bool)
    mesh_kernels.border_edges(faces, neighbours_of(faces), on, leaving)
    np.testing.assert_array_equal(leaving, [2, 1, 1, 1, 1, 1])
    assert mesh_kernels.bow_ties(faces, neighbours_of(faces), on, leaving, largest, keep) == 1
    np.testing.assert_array_equal(keep, [True, True, False])


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_what_is_left_of_a_torn_sheet_is_a_manifold(seed):
    rng = np.random.default_rng(seed)
    d = Delaunay(rng.random((60, 2)))
    on = rng.random(len(d.simplices)) < 0.6
    keep = mesh._one_fan(d.simplices, d.neighbors, on, 60)
    assert not (keep & ~on).any()
    assert max(len(reference.fans(d.simplices[keep], v)) for v in range(60)) <= 1
    for t in np.flatnonzero(on & ~keep)[:1]:
        assert any(len(reference.fans(d.simplices[on], v)) > 1 for v in range(60)), t
    whole = np.ones(len(on), bool)
    assert mesh._one_fan(d.simplices, d.neighbors, whole, 60).all()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_best_of_cells_equals_a_dictionary(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 400))
    ab = np.floor(rng.random((n, 2)) * 2**25)
    at = np.sort(rng.permutation(n)[: rng.integers(1, n + 1)])
    step, quiet = rng.integers(0, 4, len(at)).astype(np.int32), rng.random(len(at)).astype(np.float32)
    sides = 2.0 ** rng.uniform(18, 24) / np.sqrt(2.0) ** np.arange(4)
    best = {}
    for i, p in enumerate(at):
        place = ab[p] / sides[step[i]]
        off = 2 * np.abs(place - np.floor(place) - 0.5).max()
        key = (step[i], *np.floor(place))
        best[key] = min(best.get(key, (np.inf, 0)), (np.float32(quiet[i] + np.float32(2) * off * off), p))
    size = 1 << max(4, int(2 * len(at)).bit_length())
    table, chosen = np.full(size, -1, np.int32), np.zeros(n, bool)
    keys = np.empty(size, np.int64)
    count = mesh_kernels.best_of_cells(ab, at, step, sides, quiet, np.float32(2), keys, table, chosen)
    assert count == len(best)
    assert (table == -1).all()
    assert set(np.flatnonzero(chosen)) == {p for _, p in best.values()}


def test_loops_over_triangles_equal_numpy():
    rng = np.random.default_rng(6)
    ab = rng.random((50, 2)) * 100
    xyz = np.column_stack([ab, rng.random(50)]).astype(np.float32)
    faces = Delaunay(ab).simplices
    c = ab[faces]
    u, v = c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]
    area = np.empty(len(faces))
    mesh_kernels.plane_areas(faces, ab, area)
    np.testing.assert_allclose(area, np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2)
    mixed = np.where(rng.random(len(faces))[:, None] < 0.5, faces, faces[:, [0, 2, 1]])
    mixed[3, 2] = mixed[3, 1]
    turned, there = np.empty_like(mixed), np.empty(len(faces), bool)
    eye = np.array([50.0, 50.0, 500.0])
    mesh_kernels.towards(mixed, xyz, eye, turned, there)
    corner = xyz[turned].astype(float)
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    np.testing.assert_array_equal(there, np.arange(len(faces)) != 3)
    assert (((eye - corner[:, 0]) * normal).sum(1)[there] > 0).all()
    np.testing.assert_array_equal(np.sort(turned, axis=1), np.sort(mixed, axis=1))
    owner, seen = rng.integers(0, 3, 50).astype(np.uint8), rng.integers(0, 8, 50).astype(np.uint8)
    out = np.empty(len(faces), np.uint8)
    mesh_kernels.textured_by(faces, owner, seen, 3, out)
    score = np.stack([(owner[faces] == v).sum(1) + 10 * ((seen[faces] >> v) & 1).all(1) for v in range(3)], 1)
    np.testing.assert_array_equal(out, score.argmax(1))
    n = rng.standard_normal((50, 3)).astype(np.float32)
    start, around = mesh_kernels.incident(faces, 50)
    off = np.empty(50, np.float32)
    mesh_kernels.residuals(faces, start, around, xyz, n, off)
    for v in range(50):
        mean = xyz[faces[(faces == v).any(1)].ravel()].astype(float).mean(axis=0)
        assert abs(off[v] - (xyz[v] - mean) @ n[v]) < 1e-3
    reach = np.empty(50, np.float32)
    mesh_kernels.sampling(xyz, n, eye, 1e-3, reach)
    ray = eye - xyz
    distance = np.linalg.norm(ray, axis=1)
    np.testing.assert_allclose(reach, 1e-3 * distance / np.maximum((ray * n).sum(1) / distance, 0.2), rtol=1e-5)


def test_points_above_each_other_on_a_wall_are_doubles():
    ab, xyz = np.array([[0.5, 0.5], [0.62, 0.5]]), np.float32([[0, 0, 0], [0.12, 0, 0.01]])
    wall = np.float32([[1, 0, 0], [1, 0, 0]])
    for near, gone in ((0.5, [True, False]), (0.1, [False, False])):
        out, cell = np.zeros(2, bool), np.zeros(2, np.int64)
        ownership.doubles(ab, xyz, wall, np.int16([0, 1]), 0.05, 0.05, near, cell, 1, 1, np.int32([0, 2, 2]),
                          np.arange(2), out)  # fmt: skip
        np.testing.assert_array_equal(out, gone)
