"""One surface laid on another: known motions come back, with honest sigma; what cannot be told or followed is said."""

from __future__ import annotations

import time

import numpy as np
import pytest

from fringescope import geometry, register, specimen
from fringescope.errors import EmptyResultError, RegistrationError
from fringescope.register import Patch, Registration
from fringescope.settings import RegisterSettings
from fringescope.twin import cuts, presets, scene
from fringescope.types import Cloud, Pose
from tests import cut_scenes as cs

INST = presets.instrument("paper", 0.06)


def patch(cloud: Cloud) -> Patch:
    f = specimen.find(cloud.xyz, cloud.normals, cloud.sigma, np.array([0.0, 0, 1]))
    return register.patch_of(cloud, specimen.on_specimen(f, cloud.xyz, cloud.sigma))


def shifted(p: Patch, T: Pose) -> Patch:
    return Patch(geometry.transform(T, p.xyz), p.normals @ T.R.T, p.sigma)


def error(found: Registration, T: Pose) -> np.ndarray:
    """(6,): turn (rad) about the registration's centre and shift (mm) by which it misses the truth."""
    E = geometry.compose(found.T_new_old, geometry.inverse(T)).R
    w = np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]]) / 2
    one = geometry.compose(found.T_new_old, geometry.inverse(T))
    return np.r_[w, geometry.transform(one, found.centre) - found.centre]


def surface(z, n: int = 30_000, seed: int = 0, sigma: float = 0.004, half=(30.0, 20.0)) -> Patch:
    """Points of z(x, y) with noise along z, with the normals of differences."""
    rng = np.random.default_rng(seed)
    x, y = (rng.uniform(-1, 1, (2, n)).T * half).T
    d = 1e-4
    N = np.stack([-(z(x + d, y) - z(x - d, y)) / (2 * d), -(z(x, y + d) - z(x, y - d)) / (2 * d), np.ones(n)], 1)
    N = N + 0.005 * rng.standard_normal((n, 3))
    N /= np.linalg.norm(N, axis=1, keepdims=True)
    return Patch(np.stack([x, y, z(x, y) + sigma * rng.standard_normal(n)], 1), N, np.full(n, sigma))


def hills(x, y):
    return 4 * np.sin(x / 8) * np.cos(y / 6) + 1.5 * np.sin(x / 3.1 + y / 5) + 0.02 * x * y


@pytest.fixture(scope="module")
def before_and_after() -> dict[str, tuple[Patch, Patch]]:
    out = {}
    for name, kind in (("tissue-domed", "groove"), ("tissue-folded", "wedge"), ("tissue-thin", "pocket")):
        view = scene.make(name, 4)
        cut, _ = cuts.cut(view, *cs.PATHS[kind], kind)
        rng = np.random.default_rng(1)
        out[name] = patch(cs.traced(view, INST, rng)), patch(cs.traced(cut, INST, rng))
    return out


@pytest.mark.parametrize("name", ["tissue-domed", "tissue-folded", "tissue-thin"])
@pytest.mark.parametrize(("mm", "deg"), [(0.0, 0.0), (0.3, 0.5), (5.0, 5.0)])
def test_a_cut_specimen_that_was_moved(name: str, mm: float, deg: float, before_and_after) -> None:
    old, new = before_and_after[name]
    T = cs.motion(np.random.default_rng([len(name), int(10 * mm)]), mm, deg)
    found = register.register(old, shifted(new, T))
    e = error(found, T)
    assert found.converged
    assert np.linalg.norm(e[3:]) < 0.02
    assert np.linalg.norm(e[:3]) < 5e-4
    assert e @ np.linalg.solve(found.covariance, e) / 6 < 6
    assert found.rms_mm < 0.03
    assert found.inliers > 0.55
    assert not found.words


def test_seen_again_by_the_cameras_after_the_motion() -> None:
    view = scene.make("tissue-domed", 6)
    T = cs.motion(np.random.default_rng(2), 3.0, 3.0, flat=True)
    rng = np.random.default_rng(3)
    old, new = patch(cs.traced(view, INST, rng)), patch(cs.traced(cs.moved(view, T), INST, rng))
    e = error(register.register(old, new), T)
    assert np.linalg.norm(e[3:]) < 0.02
    assert np.linalg.norm(e[:3]) < 5e-4


def test_the_derivatives_are_those_of_the_residual() -> None:
    """Of r = m . (R p + t - q), against differences: of the dot product, not of its absolute value or its parts."""
    a, b = surface(hills, 4000, 1), surface(hills, 4000, 2)
    pair = register._Pair(a, b, RegisterSettings())
    rng = np.random.default_rng(3)
    p, m, q = a.xyz, b.normals, b.xyz
    J = pair.jacobian(p, m)
    for k in range(6):
        x = np.zeros(6)
        x[k] = 1e-6
        one = Pose(np.eye(3), np.zeros(3))
        ends = [np.einsum("ij,ij->i", m, geometry.transform(pair.moved(one, s * x), p) - q) for s in (1, -1)]
        assert J[:, k] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-6)
    sideways = np.cross(m, rng.standard_normal(m.shape))  # a residual along the surface costs nothing
    assert np.einsum("ij,ij->i", m, sideways) == pytest.approx(np.zeros(len(m)), abs=1e-12)


def test_sigma_is_the_spread_over_seeds() -> None:
    z = []
    for seed in range(24):
        T = cs.motion(np.random.default_rng(seed), 1.0, 1.0)
        a, b = surface(hills, 8000, 2 * seed), surface(hills, 8000, 2 * seed + 1)
        found = register.register(a, shifted(b, T))
        e = error(found, T)
        z.append(e / np.sqrt(np.diag(found.covariance)))
    spread = float(np.sqrt(np.mean(np.square(z))))
    assert 0.5 < spread < 1.6


@pytest.mark.parametrize(
    ("z", "said"),
    [
        (lambda x, y: 0.1 * x + 0 * y, "nearly a plane"),
        (lambda x, y: np.sqrt(60.0**2 - x**2 - y**2), "nearly a sphere"),
        (lambda x, y: 3 * np.sin(x / 5) + 0 * y, "a shift along"),
    ],
)
def test_motions_that_the_shape_does_not_tell_are_said(z, said: str) -> None:
    found = register.register(surface(z, seed=1), surface(z, seed=2))
    assert any(said in w for w in found.words)
    assert len(found.loose) >= 1
    assert found.shift_mm < 0.1
    worst = np.sqrt(np.linalg.eigvalsh(found.covariance).max())
    assert worst > 0.05  # unknown is not small


def test_other_surfaces_are_refused(before_and_after) -> None:
    old = before_and_after["tissue-domed"][0]
    with pytest.raises(RegistrationError, match=r"do not fit each other \(\d+ % of it"):
        register.register(old, before_and_after["tissue-thin"][1])


def test_moved_too_far_is_refused_with_figures() -> None:
    a, b = surface(hills, seed=1), surface(hills, seed=2)
    T = Pose(cs.turn([0, 0, 0.1]), np.array([14.0, 5.0, 0.0]))
    with pytest.raises(RegistrationError, match=r"mm and .* degrees"):
        register.register(a, shifted(b, T))
    with pytest.raises(RegistrationError, match="moved too far to be followed"):
        register.register(a, shifted(b, T), start=T)


def test_a_bent_surface_is_refused() -> None:
    a = surface(hills, seed=1)
    with pytest.raises(RegistrationError, match="do not fit"):
        register.register(a, surface(lambda x, y: hills(x, y) + 2.5 * (x / 30) ** 2 + 1.5 * np.sin(y / 7), seed=2))


def test_too_few_points_and_points_without_normals() -> None:
    a = surface(hills, seed=1)
    with pytest.raises(EmptyResultError, match="first surface has 0 points"):
        register.register(a.only(slice(0)), a)
    xyz = a.xyz.astype(np.float32)
    rgb, view = np.zeros((len(xyz), 3), np.uint8), np.zeros(len(xyz), np.uint8)
    bare = Cloud(xyz, np.full_like(xyz, np.nan), rgb, np.full(len(xyz), np.nan, np.float32), view)
    with pytest.raises(EmptyResultError, match="second surface has 0 points"):
        register.register(a, register.patch_of(bare))


def test_strokes_are_carried_over_with_the_error_to_expect(before_and_after) -> None:
    old, new = before_and_after["tissue-domed"]
    T = cs.motion(np.random.default_rng(9), 2.0, 2.0)
    found = register.register(old, shifted(new, T))
    line = old.xyz[::500]
    there, um = register.carried(line, found)
    away = 1e3 * np.linalg.norm(there - geometry.transform(T, line), axis=1)
    assert (away < 3 * um).all()
    assert (um < 60).all()
    still, none = register.carried(line, register.still(np.zeros(3)))
    assert np.array_equal(still, line)
    assert (none == 0).all()
    for bad in (np.zeros((3, 2)), np.array([[0, np.nan, 0]])):
        with pytest.raises(RegistrationError, match="needed"):
            register.carried(bad, found)


def test_three_views_of_684_by_456_take_seconds_at_most() -> None:
    a, b = surface(hills, 230_000, 1), surface(hills, 230_000, 2)
    T = cs.motion(np.random.default_rng(5), 5.0, 5.0)
    start = time.perf_counter()
    found = register.register(a, shifted(b, T))
    took = time.perf_counter() - start
    assert np.linalg.norm(error(found, T)[3:]) < 0.01
    assert took < 8  # about 1 s on two idle cores


@pytest.mark.verify
def test_motions_over_seeds_and_specimens() -> None:
    z, failed = [], 0
    for name in ("tissue-domed", "tissue-folded", "tissue-thin"):
        for seed in range(10):
            view, kind = scene.make(name, 200 + seed), ("groove", "pocket", "wedge")[seed % 3]
            cut, _ = cuts.cut(view, *cs.PATHS[kind], kind)
            rng = np.random.default_rng(seed)
            T = cs.motion(rng, rng.uniform(0, 5), rng.uniform(0, 5), flat=True)
            old, new = patch(cs.traced(view, INST, rng)), patch(cs.traced(cs.moved(cut, T), INST, rng))
            try:
                found = register.register(old, new)
            except RegistrationError:
                failed += 1
                continue
            e = error(found, T)
            assert np.linalg.norm(e[3:]) < 0.05
            z.append(e / np.sqrt(np.diag(found.covariance)))
    assert failed <= 1
    spread = float(np.sqrt(np.mean(np.square(z))))
    print(f"motions: {failed} of 30 refused, error over sigma {spread:.2f}")
    assert 0.3 < spread < 3
