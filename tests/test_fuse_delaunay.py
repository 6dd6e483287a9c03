"""The Delaunay triangulation against scipy's and against the empty circle, exactly, also where points fall together."""

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import Delaunay

from fringescope.errors import UsageError
from fringescope.fuse.delaunay import Triangulation, along_curve, snapped
from fringescope.kernels import delaunay as kernels


def exact_side(a, b, c):
    """Twice the area of a triangle, in whole numbers of any size."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def exact_within(a, b, c, d):
    """Positive where d lies within the circle through a, b, c, in whole numbers of any size."""
    m = [(p[0] - d[0], p[1] - d[1]) for p in (a, b, c)]
    lift = [x * x + y * y for x, y in m]
    return sum(lift[i] * (m[i - 2][0] * m[i - 1][1] - m[i - 2][1] * m[i - 1][0]) for i in range(3))


def hull_area(p):
    """Twice the area of the convex hull of whole numbers, by a monotone chain."""
    p = sorted({(int(x), int(y)) for x, y in p})
    chain = []
    for points in (p, p[::-1]):
        part = []
        for q in points:
            while len(part) > 1 and exact_side(part[-2], part[-1], q) <= 0:
                part.pop()
            part.append(q)
        chain += part[:-1]
    return abs(sum(chain[i - 1][0] * chain[i][1] - chain[i - 1][1] * chain[i][0] for i in range(len(chain))))


def check(ab, simplices, neighbours):
    """The triangles are counter-clockwise, cover the hull, have every point as a corner, and empty circles, exactly."""
    p = [(int(x), int(y)) for x, y in ab]
    t = simplices.tolist()
    area = [exact_side(p[a], p[b], p[c]) for a, b, c in t]
    assert all(x > 0 for x in area)
    assert sum(area) == hull_area(ab)
    if t:
        assert len({p[v] for f in t for v in f}) == len(set(p))
    for i, f in enumerate(t):
        for c in range(3):
            a, b, u = f[(c + 1) % 3], f[(c + 2) % 3], int(neighbours[i, c])
            if u < 0:
                assert sum(a in g and b in g for g in t) == 1
                continue
            (d,) = set(t[u]) - {a, b}
            assert {a, b} < set(t[u])
            s = exact_within(p[f[c]], p[a], p[b], p[d])
            assert s <= 0
            if s == 0:
                assert min(p[v] for v in (f[c], a, b, d)) in (p[a], p[b]), "the diagonal from the first of four points"


def made(ab, order=None):
    at = snapped(np.asarray(ab, float))
    t = Triangulation(at, along_curve(at) if order is None else order)
    return at, *t.triangles()


lattice = np.stack(np.meshgrid(np.arange(14.0), np.arange(11.0)), -1).reshape(-1, 2)
angle = 2 * np.pi * np.arange(24) / 24
pythagoras = np.array([(x, y) for x in range(-65, 66) for y in range(-65, 66) if x * x + y * y == 65**2], float)
CASES = {
    "random": np.random.default_rng(0).random((300, 2)),
    "lattice": lattice,
    "nearly a lattice": lattice + np.random.default_rng(1).uniform(-1e-6, 1e-6, lattice.shape),
    "turned lattice": lattice @ np.array([[0.8, 0.6], [-0.6, 0.8]]),
    "lattices on each other": np.concatenate([lattice, lattice[::3], lattice[::-2]]),
    "exactly on a circle": pythagoras,
    "with its middle": np.concatenate([pythagoras, [[0, 0]]]),
    "nearly on a circle": np.stack([np.cos(angle), np.sin(angle)], 1),
    "a line and one more": np.concatenate([np.stack([np.arange(30.0), np.arange(30.0)], 1), [[3, 9]]]),
    "long and thin": np.random.default_rng(2).random((200, 2)) * [1, 1e-5],
    "very thin": np.random.default_rng(2).random((200, 2)) * [1, 2**-24],
    "clusters": np.concatenate([np.random.default_rng(3).normal(c, 10.0**-c, (60, 2)) for c in range(1, 6)]),
    "tiny": 1e-30 * np.random.default_rng(4).random((100, 2)),
    "huge": 1e30 * np.random.default_rng(5).normal(5, 1, (100, 2)),
    "three": np.array([[0.0, 0], [1, 0], [0, 1]]),
    "three clockwise": np.array([[0.0, 0], [0, 1], [1, 0]]),
}


@pytest.mark.parametrize("case", CASES)
def test_every_circle_is_empty(case):
    check(*made(CASES[case]))


@pytest.mark.parametrize("case", ["random", "huge", "three"])
def test_triangles_are_scipys_where_these_are_unique_in_its_arithmetic_too(case):
    at, simplices, _ = made(CASES[case])
    want = Delaunay(at).simplices
    assert len(want) == len(simplices)
    assert {frozenset(t) for t in simplices.tolist()} == {frozenset(t) for t in want.tolist()}


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 80), st.sampled_from([3, 8, 40, 1000]))
def test_points_of_few_places(seed, n, places):
    """Small whole numbers: many fall together, on lines and on circles."""
    rng = np.random.default_rng(seed)
    ab = rng.integers(0, places, (n, 2)).astype(float)
    at, simplices, neighbours = made(ab)
    check(at, simplices, neighbours)
    _, again, _ = made(ab, rng.permutation(n))
    corner = [{frozenset(map(tuple, at[t].tolist())) for t in s} for s in (simplices, again)]
    assert corner[0] == corner[1], "the order does not matter"


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([6, 30, 10_000]))
def test_edges_of_all_points_stay_edges_of_some(seed, places):
    rng = np.random.default_rng(seed)
    at = np.unique(snapped(rng.integers(0, places, (60, 2)).astype(float)), axis=0)

    def edges(s):
        return {frozenset(e) for t in s.tolist() for e in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0]))}

    every = np.arange(len(at))
    some = every[rng.random(len(at)) < 0.6]
    few = Triangulation(at, some).triangles()[0]
    kept = {e for e in edges(Triangulation(at, every).triangles()[0]) if e <= set(some.tolist())}
    assert len(few) == 0 or kept <= edges(few)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 60))
def test_points_may_come_later(seed, first):
    rng = np.random.default_rng(seed)
    at = snapped(rng.integers(0, 12, (60, 2)).astype(float))
    order = rng.permutation(60)
    t = Triangulation(at, order[:first], room=60)
    t.add(order[first:50])
    t.add(order[50:])
    simplices, neighbours = t.triangles()
    check(at, simplices, neighbours)


@pytest.mark.parametrize("ab", [np.zeros((0, 2)), np.zeros((1, 2)), np.ones((5, 2)), np.array([[0.0, 0], [1, 2]]),
                                np.stack([np.arange(9.0), 2 * np.arange(9.0)], 1)])
def test_points_on_one_line_have_no_triangles(ab):
    _, simplices, neighbours = made(ab)
    assert simplices.shape == neighbours.shape == (0, 3)


def test_a_line_waits_for_a_point_beside_it():
    at = snapped(np.concatenate([np.stack([np.arange(9.0), np.zeros(9)], 1), [[4, 7]]]))
    t = Triangulation(at, np.arange(9), room=10)
    assert len(t.triangles()[0]) == 0
    t.add(np.array([9]))
    assert len(t.triangles()[0]) == 8


def test_what_is_not_finite_is_refused():
    for bad in (np.nan, np.inf):
        with pytest.raises(UsageError, match="1 of 4 points have no coordinates"):
            snapped(np.array([[0.0, 1], [2, bad], [3, 4], [5, 6]]))


@pytest.mark.parametrize("case", CASES)
def test_snapping_moves_points_by_less_than_the_lattice(case):
    ab = CASES[case]
    at = snapped(ab)
    assert (at == np.rint(at)).all()
    assert (at >= 0).all()
    assert at.max() < kernels.SIDE
    size = np.ptp(ab, axis=0).max()
    scale = np.ptp(at, axis=0).max() / size
    assert scale * size >= kernels.SIDE / 2 - 2
    np.testing.assert_allclose(at / scale, ab - ab.min(axis=0), atol=size * 2**-23)


def test_within_is_exact_where_rounding_decides():
    """Points moved by one part in 2^25 on and off a circle: the filter must give up, and the limbs must not."""
    rng = np.random.default_rng(7)
    seen = []
    for _ in range(3000):
        r = rng.integers(2**22, 2**24)
        a = 2 * np.pi * np.sort(rng.random(4))
        xy = np.rint(2**24 + r * np.stack([np.cos(a), np.sin(a)], 1))
        if rng.random() < 0.3:  # a rectangle: exactly on a circle
            xy[2], xy[1], xy[3] = xy[0] + [2**20, 2**21], xy[0] + [2**20, 0], xy[0] + [0, 2**21]
        p = [(int(x), int(y)) for x, y in xy]
        if exact_side(*p[:3]) <= 0 or len(set(p)) < 4:
            continue
        want = exact_within(*p)
        seen.append(np.sign(want))
        got = kernels.within(xy, 0, 1, 2, 3)
        assert got == (want > 0 or (want == 0 and min(p) in (p[0], p[3])))
    assert min(seen.count(s) for s in (-1, 0, 1)) > 100


@settings(max_examples=200, deadline=None)
@given(st.lists(st.integers(-(2**51), 2**51), min_size=6, max_size=6))
def test_sums_of_products_have_the_right_sign(x):
    want = Fraction(x[0] * x[1] + x[2] * x[3] + x[4] * x[5])
    assert kernels._exact(*map(np.int64, x)) == (want > 0) - (want < 0)
    assert kernels._exact(*map(np.int64, (x[0], x[1], -x[0], x[1], 0, x[5]))) == 0


def test_the_curve_goes_from_cell_to_cell_beside_it():
    side = 2**5
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    ab = np.stack([x.ravel(), y.ravel()], 1) * (kernels.SIDE / side)
    key = np.empty(side * side, np.int64)
    kernels.hilbert(ab, 5, key)
    np.testing.assert_array_equal(np.sort(key), np.arange(side * side))
    way = ab[np.argsort(key)] / (kernels.SIDE / side)
    assert (np.abs(np.diff(way, axis=0)).sum(1) == 1).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(0, 200), st.integers(1, 22))
def test_sorting_is_stable(seed, n, bits):
    key = np.random.default_rng(seed).integers(0, 2**bits, n)
    order = np.empty(n, np.int64)
    kernels.sort_by(key, bits, order)
    np.testing.assert_array_equal(order, np.argsort(key, kind="stable"))
