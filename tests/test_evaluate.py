"""Fits against clouds whose form is known exactly, and statistics against numpy and scipy on plain samples."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from fringescope import evaluate as ev
from fringescope.errors import EmptyResultError, UsageError
from fringescope.types import Grid

NORMAL = np.array([0.05, 0.12, 0.99]) / np.linalg.norm([0.05, 0.12, 0.99])


def plane_cloud(rng, n=60_000, noise=0.005, flying=0.0, normal=NORMAL, offset=5.0):
    """Points of the plane `p . normal = offset` over 100 x 60 mm, noise along the normal, a share of flying points."""
    a = np.cross(normal, [0, 1.0, 0.3])
    a /= np.linalg.norm(a)
    b = np.cross(normal, a)
    p = rng.uniform(-50, 50, (n, 1)) * a + rng.uniform(-30, 30, (n, 1)) * b
    p += (offset + rng.normal(0, noise, (n, 1))) * normal
    k = int(flying * n)
    p[:k] += rng.choice([-1, 1], (k, 1)) * rng.uniform(0.5, 8, (k, 1)) * normal
    return p


def cap_cloud(rng, centre, radius, n, noise=0.005, opening=75.0):
    """The part of a sphere that is seen from above: within `opening` degrees of the top."""
    z = rng.uniform(np.cos(np.radians(opening)), 1, n)
    t = rng.uniform(0, 2 * np.pi, n)
    u = np.stack([np.sqrt(1 - z**2) * np.cos(t), np.sqrt(1 - z**2) * np.sin(t), z], 1)
    return np.asarray(centre) + (radius + rng.normal(0, noise, (n, 1))) * u


def test_spread_is_what_its_names_say():
    e = np.array([0.001, -0.002, 0.003, 0.010, np.nan])
    s = ev.spread(e)
    assert s.points == 4
    assert s.bias_um == pytest.approx(2.0)
    assert s.std_um == pytest.approx(1482.602218505602 * 0.0025)  # |e - 2 um| = 1, 4, 1, 8 um: median 2.5 um
    assert s.std_plain_um == pytest.approx(1e3 * np.std([0.001, -0.002, 0.003, 0.010]))
    assert s.rms_um == pytest.approx(1e3 * np.sqrt((1 + 4 + 9 + 100) * 1e-6 / 4))
    assert s.max_um == pytest.approx(10)
    with pytest.raises(EmptyResultError):
        ev.spread([np.nan, np.nan])


@settings(max_examples=15, deadline=None)
@given(
    direction=st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)).filter(lambda v: np.linalg.norm(v) > 0.2),
    offset=st.floats(-200, 200),
    seed=st.integers(0, 1000),
)
def test_plane_is_found_whatever_its_pose(direction, offset, seed):
    rng = np.random.default_rng(seed)
    n = np.array(direction) / np.linalg.norm(direction)
    p = plane_cloud(rng, 3000, 0.005, 0.05, n, offset)
    fit = ev.fit_plane(p)
    assert abs(abs(n @ fit.normal) - 1) < 1e-9
    assert abs((np.array(fit.point) - offset * n) @ n) < 0.001
    assert fit.normal[2] >= 0
    assert fit.flying_ppm == pytest.approx(50_000)


def test_plane_statistics_are_those_of_the_noise():
    rng = np.random.default_rng(2)
    noise = 0.0048
    clean, dirty = plane_cloud(rng, 100_000, noise), plane_cloud(rng, 100_000, noise, flying=0.2)
    for p, flying in ((clean, 0), (dirty, 200_000)):
        fit = ev.fit_plane(p)
        assert fit.spread.std_um == pytest.approx(4.8, rel=0.02)
        assert abs(fit.spread.bias_um) < 0.05
        assert fit.flying_ppm == pytest.approx(flying)
        assert fit.inliers == round(100_000 * (1 - flying / 1e6))
        assert fit.form_um < 0.5
    svd = clean - clean.mean(0)
    assert np.linalg.svd(svd, full_matrices=False)[2][2] == pytest.approx(
        np.array(ev.fit_plane(clean).normal) * np.sign(np.linalg.svd(svd, full_matrices=False)[2][2][2]), abs=1e-6
    )


def test_form_error_sees_a_bend_and_not_the_noise():
    rng = np.random.default_rng(5)
    p = plane_cloud(rng, 200_000, 0.005, normal=np.array([0, 0, 1.0]), offset=0.0)
    flat = ev.fit_plane(p).form_um
    wave = 0.003 * np.sin(2 * np.pi * p[:, 0] / 40)
    p[:, 2] += wave
    bent = ev.fit_plane(p).form_um
    assert flat < 0.4
    assert bent == pytest.approx(1e3 * wave.std(), rel=0.1)


def test_measure_plane_fits_nothing():
    rng = np.random.default_rng(4)
    p = plane_cloud(rng, 5000, 0.004)
    fit = ev.measure_plane(p + 0.010 * NORMAL, 5.0 * NORMAL, 7 * NORMAL)
    assert fit.spread.bias_um == pytest.approx(10, abs=0.3)
    np.testing.assert_allclose(fit.error_mm, p @ NORMAL - 5 + 0.010, atol=1e-9)
    assert np.linalg.norm(fit.flat_mm[0] - fit.flat_mm[1]) == pytest.approx(np.linalg.norm(p[0] - p[1]), abs=0.01)


def test_a_point_above_the_plane_is_positive():
    p = plane_cloud(np.random.default_rng(1), 2000, 0.0, normal=np.array([0, 0, 1.0]), offset=3.0)
    p = np.concatenate([p, [[0, 0, 3.05]]])
    assert ev.fit_plane(p).error_mm[-1] == pytest.approx(0.05, abs=1e-6)


@pytest.mark.parametrize("radius", [2.0, 5.00065, 12.0])
def test_sphere_is_found_on_its_base_among_flying_points(radius):
    rng = np.random.default_rng(8)
    centre = np.array([7.0, -4.0, 1.5])
    base = plane_cloud(rng, 40_000, 0.005, normal=np.array([0, 0, 1.0]), offset=1.5 - radius)
    cap = cap_cloud(rng, centre, radius, 4000)
    noise = rng.uniform(-40, 40, (200, 3))
    fit = ev.fit_sphere(np.concatenate([base, noise, cap]), radius)
    assert np.linalg.norm(np.array(fit.center) - centre) < 0.0015
    assert abs(fit.radius_error_um) < 1.0
    assert fit.radius_mm == pytest.approx(radius, abs=0.001)
    assert 3990 <= fit.inliers < 4100  # a little of the base, where it touches, and of the air
    assert fit.spread.std_um == pytest.approx(5, rel=0.06)
    assert fit.fixed_rms_um >= fit.spread.std_plain_um - 0.05
    assert 140 < fit.cap_deg < 170


def test_sphere_fit_is_the_geometric_one():
    """An algebraic fit would be biased on a narrow noisy cap; scipy's minimiser is the judge."""
    rng = np.random.default_rng(9)
    p = cap_cloud(rng, (0, 0, 0), 5.0, 3000, noise=0.01, opening=50)
    best = least_squares(lambda x: np.linalg.norm(p - x[:3], axis=1) - x[3], [0.1, 0, 0, 5.1]).x
    fit = ev.fit_sphere(p)
    np.testing.assert_allclose([*fit.center, fit.radius_mm], best, atol=0.0015)  # Tukey's weights against none


def test_two_spheres_and_their_distance():
    rng = np.random.default_rng(10)
    a, b = np.array([-6.0, 2.6, -4.0]), np.array([28.9, -6.3, 3.0])
    p = np.concatenate([
        plane_cloud(rng, 50_000, 0.005, normal=np.array([0, 0, 1.0]), offset=-9.0),
        cap_cloud(rng, a, 5.00065, 2500), cap_cloud(rng, b, 12.0, 9000),
    ])  # fmt: skip
    r = ev.evaluate(p, "sphere", (5.00065, 12.0))
    assert [s.nominal_radius_mm for s in r.spheres] == [12.0, 5.00065]
    assert all(abs(s.radius_error_um) < 1 for s in r.spheres)
    assert len(r.center_distances_mm) == 1
    assert r.center_distances_mm[0][2] == pytest.approx(np.linalg.norm(a - b), abs=0.001)
    assert r.plane is not None
    assert r.plane.point[2] == pytest.approx(-9, abs=0.001)
    assert r.flying_ppm == 0
    text = json.dumps(r.to_dict())
    assert "radius_error_um" in text
    assert "error_mm" not in json.loads(text)


def test_a_plane_is_no_sphere():
    p = plane_cloud(np.random.default_rng(3), 20_000)
    with pytest.raises(EmptyResultError, match="no sphere"):
        ev.fit_spheres(p)
    air = np.random.default_rng(3).uniform(-30, 30, (20_000, 3))
    with pytest.raises(EmptyResultError, match="no sphere"):
        ev.fit_spheres(air)


def test_fits_are_deterministic_and_skip_nan():
    rng = np.random.default_rng(12)
    p = cap_cloud(rng, (1, 2, 3), 8.0, 3000)
    holed = np.concatenate([p, np.full((50, 3), np.nan)])
    assert ev.fit_sphere(holed).to_dict() == ev.fit_sphere(p).to_dict()
    q = plane_cloud(rng, 3000)
    assert ev.fit_plane(q).to_dict() == ev.fit_plane(q).to_dict()


def test_what_cannot_be_fitted_is_refused():
    with pytest.raises(UsageError, match=r"needed \(n, 3\)"):
        ev.fit_plane(np.zeros((4, 2)))
    with pytest.raises(EmptyResultError, match="needed at least 10"):
        ev.fit_plane(np.zeros((4, 3)))
    with pytest.raises(EmptyResultError, match="one line"):
        ev.fit_plane(np.linspace(0, 1, 100)[:, None] * [1.0, 2, 3])
    with pytest.raises(UsageError, match="'cone'"):
        ev.evaluate(np.zeros((100, 3)), "cone")


def test_sigma_ratio_is_one_where_sigma_is_right():
    rng = np.random.default_rng(13)
    sigma = rng.uniform(0.002, 0.02, 40_000)
    assert ev.sigma_ratio(rng.normal(0, sigma), sigma) == pytest.approx(1, abs=0.02)
    assert ev.sigma_ratio(rng.normal(0, 2 * sigma), sigma) == pytest.approx(2, abs=0.04)
    with pytest.raises(EmptyResultError):
        ev.sigma_ratio([np.nan], [1.0])


def test_errors_along_oblique_rays():
    """Noise along the rays of two oblique cameras: only with their centres is the ratio one."""
    rng = np.random.default_rng(14)
    centres = np.array([[320.0, 0, 500], [-200, 250, 500]])
    p = plane_cloud(rng, 40_000, 0.0)
    view = rng.integers(0, 2, len(p))
    ray = p - centres[view]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    sigma = rng.uniform(0.004, 0.012, len(p))
    noisy = p + rng.normal(0, sigma)[:, None] * ray
    right = ev.evaluate(noisy, "plane", sigma_mm=sigma, view=view, centres=centres)
    plain = ev.evaluate(noisy, "plane", sigma_mm=sigma)
    assert right.sigma_ratio == pytest.approx(1, abs=0.03)
    assert plain.sigma_ratio < 0.92


def test_along_rays_signs_and_grazing():
    xyz = np.array([[0, 0, 0], [1.0, 0, 0], [5, 0, 1e-3]])
    e = ev.along_rays([0.01, 0.01, 0.01], np.array([0, 0, 1.0]), xyz, [0, 0, 1e-3])
    assert e[0] == pytest.approx(-0.01)
    assert np.isnan(e[1])
    assert np.isnan(e[2])


def test_neighbour_correlation_tells_smoothing():
    rng = np.random.default_rng(15)
    x, y = np.meshgrid(np.arange(200) * 0.1, np.arange(100) * 0.1)
    e = rng.normal(0, 0.005, x.shape)
    smooth = (e + np.roll(e, 1, 1)) / 2
    xyz = np.stack([x, y, np.zeros_like(x)], -1).reshape(-1, 3)
    assert abs(ev.neighbour_correlation(xyz, e.ravel())) < 0.03
    assert ev.neighbour_correlation(xyz, smooth.ravel()) == pytest.approx(0.5, abs=0.05)
    assert ev.neighbour_correlation(xyz[:50], e.ravel()[:50]) is None


def grids(rng, scans=12, ratio=1.0, drift=0.0):
    """Repeated scans whose points move along their rays by `ratio` sigmas."""
    v, u = np.mgrid[0:40, 0:50]
    ray = np.stack([(u - 25) / 900, (v - 20) / 900, np.ones(u.shape)], -1)
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    sigma = rng.uniform(0.004, 0.01, u.shape)
    reasons = np.zeros(u.shape, np.uint16)
    reasons[:3] = 1
    out = []
    for k in range(scans):
        s = 500 + rng.normal(0, ratio * sigma) + (drift if k == 0 else 0.0)
        xyz = (ray * s[..., None]).astype(np.float32)
        xyz[:3] = np.nan
        out.append(Grid(0, "camera1", xyz, sigma.astype(np.float32), reasons))
    return out


@pytest.mark.parametrize("scans", [2, 12])
def test_repeatability_is_the_ratio_of_seen_to_predicted(scans):
    rng = np.random.default_rng(16)
    for ratio in (1.0, 1.5):
        r = ev.repeatability(grids(rng, scans, ratio))
        assert r.pixels == 37 * 50
        assert r.ratio == pytest.approx(ratio, rel=0.08 if scans == 2 else 0.04)
        assert r.sigma_um == pytest.approx(7, rel=0.03)
        assert r.drift_um < 2
    assert ev.repeatability(grids(rng, 10, 1.0, 0.05)).drift_um == pytest.approx(45, rel=0.05)


def test_repeatability_refuses_what_does_not_belong_together():
    g = grids(np.random.default_rng(0), 2)
    with pytest.raises(UsageError, match="2 or more"):
        ev.repeatability(g[:1])
    with pytest.raises(UsageError):
        ev.repeatability([g[0], dataclasses.replace(g[1], camera="camera2")])
    dark = dataclasses.replace(g[1], reasons=np.ones_like(g[1].reasons))
    with pytest.raises(EmptyResultError, match="valid in all"):
        ev.repeatability([g[0], dark])


JUDGE = Path(__file__).resolve().parents[2] / "shared" / "tools" / "score.py"


@pytest.mark.skipif(not JUDGE.exists(), reason="the judge ../shared/tools/score.py is not here")
def test_figures_are_those_of_the_judge(tmp_path):
    """An independent program takes the same figures of the same cloud."""
    rng = np.random.default_rng(20)
    p = plane_cloud(rng, 150_000, 0.0048, flying=0.001).astype(np.float32)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(p)}\n"
    header += "".join(f"property float {a}\n" for a in "xyz") + "end_header\n"
    (tmp_path / "cloud.ply").write_bytes(header.encode() + p.tobytes())
    truth = {"normal": NORMAL.tolist(), "point": (5 * NORMAL).tolist()}
    (tmp_path / "plane.json").write_text(json.dumps(truth))
    command = [sys.executable, str(JUDGE), str(tmp_path / "cloud.ply"), str(tmp_path / "plane.json"), "--json"]
    judged = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    ours = ev.measure_plane(p, 5 * NORMAL, NORMAL)
    for name in ("bias_um", "std_um", "rms_um", "p99_um"):
        assert getattr(ours.spread, name) == pytest.approx(judged[name], abs=0.002)
    assert ours.inliers == judged["good"]
    assert ours.flying_ppm == pytest.approx(judged["flying_ppm"])
    assert ours.form_um == pytest.approx(judged["form_um"], abs=0.1)  # tiles lie elsewhere


def test_words_where_sigma_does_not_fit_the_errors():
    rng = np.random.default_rng(5)
    y, x = np.mgrid[0:60, 0:70] * 0.2
    xyz = np.stack([x, y, rng.normal(0, 0.005, x.shape)], -1).reshape(-1, 3)
    view, centres = np.zeros(len(xyz), int), np.array([[7.0, 6.0, 500.0]])

    def told(points, sigma):
        return ev.evaluate(points, "plane", (), np.full(len(points), sigma), view, centres).words

    assert told(xyz, 0.005) == ()
    assert "2.5 times what sigma says" in told(xyz, 0.002)[0]
    assert "something smoothed" in told(xyz, 0.01)[0]
    assert "give the rig" in ev.evaluate(xyz, "plane", (), np.full(len(xyz), 0.01), view).words[0]
    smooth = xyz.copy()  # a row's points share half of their noise
    smooth[1:, 2] = (xyz[1:, 2] + xyz[:-1, 2]) / 2
    assert "errors of neighbours are alike" in told(smooth, 0.0035)[0]
