"""The kernels of fusion and meshing against their slow twins."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from fringescope import geometry
from fringescope.fuse import mesh
from fringescope.kernels import mesh as mesh_kernels
from fringescope.kernels import surface as kernels
from tests import fuse_scenes as scenes
from tests.reference import surface as reference


def test_normals_equal_least_squares_also_at_holes_and_jumps():
    r, rng = scenes.rig(3, 40, 30), np.random.default_rng(0)
    g = scenes.grid(r, 1, scenes.ball(), 0.004, rng, keep=lambda p, *_: rng.random(p.shape[:2]) > 0.1)
    centre = geometry.centre(r.cameras[1].pose)
    out = np.empty_like(g.xyz)
    kernels.normals(g.xyz, g.sigma, centre, 2, 4.0, 5.0, out)
    for i in range(0, 30, 2):
        for j in range(0, 40, 2):
            if not g.valid[i, j]:
                assert np.isnan(out[i, j]).all()
            else:
                want = reference.normal(g.xyz, g.sigma, centre, i, j, 2, 4.0, 5.0)
                np.testing.assert_allclose(out[i, j], want, atol=2e-5)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_blend_equals_its_twin(seed):
    rng = np.random.default_rng(seed)
    V = int(rng.integers(1, 5))
    colours = rng.random((V + 1, 3)).astype(np.float32)
    weights = (rng.random(V + 1) * (rng.random(V + 1) > 0.3)).astype(np.float32)
    samples = np.concatenate([colours[1:], weights[1:, None]], 1)[:, None, None].astype(np.float32)
    out = np.empty((1, 1, 3), np.float32)
    kernels.blend(samples, 0.25, 0, colours[None, :1], weights[:1, None], out)
    np.testing.assert_allclose(out[0, 0], reference.blend(colours, weights, 0.25), rtol=2e-4, atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_doubles_equal_brute_force(seed):
    rng = np.random.default_rng(seed)
    ab, view, reach = rng.random((60, 2)), rng.integers(0, 3, 60).astype(np.int16), 0.09
    cell = 0.1
    c = (ab / cell).astype(int)
    index = c[:, 1] * 10 + c[:, 0]
    order = np.argsort(index, kind="stable")
    unique, start = np.unique(index[order], return_index=True)
    lookup = np.full((10, 10), -1, np.int64)
    lookup.ravel()[unique] = np.arange(len(unique))
    out = np.zeros(60, bool)
    flat = np.zeros((60, 3), np.float32)
    up = np.tile(np.float32([0, 0, 1]), (60, 1))
    starts, rows, columns = np.append(start, 60), unique // 10, unique % 10
    kernels.doubles(ab[order], flat, up, view[order], reach, 0.0, 0.0, starts, rows, columns, lookup, out)
    want = reference.doubles(ab, view, reach, order)
    np.testing.assert_array_equal(out, want[order])
    kept = order[~out]
    d = np.linalg.norm(ab[kept][:, None] - ab[kept][None], axis=2)
    d[view[kept][:, None] == view[kept][None]] = np.inf
    assert d.min() >= reach


def test_cells_and_owners_equal_numpy():
    rng = np.random.default_rng(3)
    ab = rng.random((20, 30, 2)) * 4 - 0.5
    ab[rng.random((20, 30)) < 0.2] = np.nan
    weight = rng.random((20, 30)).astype(np.float32)
    total, count = np.zeros((3, 3)), np.zeros((3, 3), np.int32)
    kernels.bin_weights(ab, weight, np.zeros(2), 1.0, total, count)
    owner = rng.integers(0, 3, (3, 3)).astype(np.int16)
    mine = np.empty((20, 30), bool)
    kernels.owned(ab, np.zeros(2), 1.0, owner, 1, mine)
    for row in range(3):
        for col in range(3):
            with np.errstate(invalid="ignore"):
                inside = (ab[..., 0] > 0) & (ab[..., 1] > 0) & (ab[..., 0] // 1 == col) & (ab[..., 1] // 1 == row)
            want = weight[inside].astype(float)
            # points a little outside zero round to the first cell; leave those cells to the sum over all
            if row and col:
                assert count[row, col] == inside.sum()
                np.testing.assert_allclose(total[row, col], want.sum())
                assert (mine[inside] == (owner[row, col] == 1)).all()


def test_gather_finds_the_shift_between_two_exact_views():
    """View 2 sees the plane 30 um higher along the normal: every ray of view 1 is told to move that far."""
    r = scenes.rig(2, 60, 45)
    low, high = scenes.plane(), scenes.plane(offset=1.03)
    a, b = scenes.grid(r, 0, low), scenes.grid(r, 1, high)
    n = np.broadcast_to(np.float32([0.05, 0.1, 1.0]) / np.linalg.norm([0.05, 0.1, 1.0]), a.xyz.shape).astype(np.float32)
    H, W = a.sigma.shape
    centre = geometry.centre(r.cameras[0].pose)
    shift, total, variance = (np.zeros((H, W)) for _ in range(3))
    facing, seen, sample = np.zeros((H, W, 3)), np.zeros((H, W), np.uint8), np.zeros((H, W, 4), np.float32)
    colour = scenes.photo(b).rgb
    ones = np.where(b.valid, np.float32(1), np.float32(0))
    sigma_a, sigma_b = np.full((H, W), 0.005, np.float32), np.full((H, W), 0.005, np.float32)
    kernels.gather(
        a.xyz,
        n,
        sigma_a,
        centre,
        0,
        H,
        r.cameras[1].pose.R,
        r.cameras[1].pose.t,
        geometry.lens_vector(r.cameras[1].lens),
        b.xyz,
        n.copy(),
        sigma_b,
        ones,
        ones,
        colour,
        ones,
        5.0,
        0.05,
        np.uint8(2),
        shift,
        total,
        variance,
        facing,
        seen,
        sample,
    )
    hit = seen == 2
    assert hit.sum() > 1000
    rays = a.xyz[hit] - centre
    cosine = (rays / np.linalg.norm(rays, axis=1, keepdims=True)) @ n[0, 0]
    np.testing.assert_allclose(shift[hit], 0.03 / cosine, atol=2e-5)
    np.testing.assert_allclose(variance[hit], 0.005**2, rtol=1e-5)
    inner = hit & (np.abs(a.xyz[..., :2]) < [10, 7]).all(-1)
    np.testing.assert_allclose(sample[inner][:, :3], scenes.paint(a.xyz[inner].astype(float)), atol=0.004)


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
    lookup = np.zeros((1, 1), np.int64)
    for near, gone in ((0.5, [True, False]), (0.1, [False, False])):
        out = np.zeros(2, bool)
        one = np.zeros(1, np.int64)
        kernels.doubles(ab, xyz, wall, np.int16([0, 1]), 0.05, 0.05, near, np.array([0, 2]), one, one, lookup, out)
        np.testing.assert_array_equal(out, gone)
