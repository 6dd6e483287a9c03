"""Fringe design against brute force: OpenCV's projection, exhaustive search over directions, sampled noise."""

from __future__ import annotations

import dataclasses
import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

from fringescope import geometry, patterns
from fringescope.errors import CaptureError, RigError, UsageError
from fringescope.settings import PatternSettings
from fringescope.types import (
    Camera,
    FrameKey,
    FringeSet,
    GraySet,
    Layout,
    Lens,
    NoiseModel,
    PixelFormat,
    Pose,
    Projector,
    Rig,
    Role,
    ViewPlan,
    Volume,
)

NOISE = NoiseModel(0.5, 0.02)


def look_at(position, target=(0.0, 0.0, 0.0), roll=0.0) -> Pose:
    """Pose of a device at `position` that looks at `target`, turned by `roll` about its axis."""
    z = np.subtract(target, position)
    z = z / np.linalg.norm(z)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    c, s = math.cos(roll), math.sin(roll)
    R = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) @ R
    return Pose(R, -R @ np.asarray(position, float))


def make_rig(layout=Layout.DIAMOND, angles=(90.0, -30.0, 210.0), baseline=320.0, height=500.0, distortion=None) -> Rig:
    """A projector above the origin and cameras around it, at `angles` degrees in the world's x-y plane."""
    d = np.array([-0.05, 0.1, 2e-4, 4e-4, 0.0]) if distortion is None else distortion
    f = 9120.0
    K = np.array([[f if layout is Layout.DIAMOND else f / 2, 0, 0], [0, f, 560.0], [0, 0, 1]])
    K[0, 2] = 907.0 if layout is Layout.DIAMOND else 453.6
    W = 1824 if layout is Layout.DIAMOND else 912
    projector = Projector(912, 1140, layout, Lens(W, 1140, K, d), look_at((0, 0.0, height)))
    cameras = tuple(
        Camera(
            f"camera{i + 1}",
            Lens(684, 456, np.array([[3700.0, 0, 341], [0, 3701.0, 227], [0, 0, 1]]), d / 2),
            look_at((baseline * math.cos(math.radians(a)), baseline * math.sin(math.radians(a)), height)),
        )
        for i, a in enumerate(angles)
    )
    return Rig(projector, cameras, Volume(np.zeros(3), np.eye(3), np.array([50.0, 30.0, 15.0])))


def cv_project(device, p):
    """OpenCV's own projection of one world point."""
    r, _ = cv2.Rodrigues(device.pose.R)
    uv, _ = cv2.projectPoints(np.array([p], float), r, device.pose.t, device.lens.K, device.lens.distortion)
    return uv.reshape(2)


def cv_jacobian(rig, camera, p, h=0.02):
    """Movement on the projector plane per mm along the camera's ray through p, by OpenCV."""
    ray = p - geometry.centre(camera.pose)
    ray /= np.linalg.norm(ray)
    return (cv_project(rig.projector, p + h * ray) - cv_project(rig.projector, p - h * ray)) / (2 * h)


@pytest.mark.parametrize("layout", list(Layout))
@pytest.mark.parametrize("angle", [90.0, -30.0, 210.0, 0.0, 137.0])
def test_direction_is_the_best_of_all_directions(layout, angle):
    rig = make_rig(layout, (angle,))
    J = cv_jacobian(rig, rig.cameras[0], np.zeros(3))
    turns = np.linspace(0, 2 * np.pi, 7200, endpoint=False)
    fx, fy = rig.projector.lens.K[0, 0], rig.projector.lens.K[1, 1]
    # all fringes of one physical period: a circle in normalised coordinates
    rates = J[0] * np.cos(turns) / fx + J[1] * np.sin(turns) / fy
    best = turns[np.argmax(rates)]
    gu, gv = patterns.direction(rig, rig.cameras[0])
    assert math.hypot(gu, gv) == pytest.approx(1, abs=1e-12)
    found = math.atan2(gv * fy, gu * fx)
    assert abs(math.remainder(found - best, 2 * math.pi)) < 2e-3


@pytest.mark.parametrize("layout", list(Layout))
def test_phase_grows_with_the_distance_from_the_camera(layout):
    rig = make_rig(layout)
    for camera in rig.cameras:
        g = patterns.direction(rig, camera.name)
        ray = -geometry.centre(camera.pose)
        ray /= np.linalg.norm(ray)
        near, far = (cv_project(rig.projector, s * ray) for s in (-5.0, 5.0))
        assert (far - near) @ g > 50


def test_in_an_isotropic_plane_the_direction_is_the_epipolar_one():
    rig = make_rig(Layout.DIAMOND, (-30.0,), distortion=np.zeros(5))
    here = cv_project(rig.projector, np.zeros(3))
    line = cv_project(rig.projector, geometry.centre(rig.cameras[0].pose) * 0.2) - here
    gu, gv = patterns.direction(rig, "camera1")
    assert abs(gu * line[1] - gv * line[0]) / np.hypot(*line) < 1e-6


def test_grid_and_diamond_draw_the_same_physical_fringes():
    grid, diamond = make_rig(Layout.GRID), make_rig(Layout.DIAMOND)
    for a, b in zip(patterns.paper_plan(grid).views, patterns.paper_plan(diamond).views, strict=True):
        for x, y in zip(a.sets, b.sets, strict=True):
            assert x.cycles_per_pixel[0] == pytest.approx(2 * y.cycles_per_pixel[0], rel=1e-3)
            assert x.cycles_per_pixel[1] == pytest.approx(y.cycles_per_pixel[1], rel=1e-3)


def test_direction_needs_a_baseline():
    rig = make_rig()
    same = Camera("camera1", rig.cameras[0].lens, rig.projector.pose)
    with pytest.raises(RigError, match="along one ray"):
        patterns.direction(dataclasses.replace(rig, cameras=(same,)), same)
    with pytest.raises(RigError, match="lacks camera 'nose'"):
        patterns.direction(rig, "nose")
    behind = dataclasses.replace(rig, volume=Volume(np.array([0, 0, 900.0]), np.eye(3), np.ones(3)))
    with pytest.raises(RigError, match="behind"):
        patterns.direction(behind, "camera1")


def phases_over_the_mirrors(projector, x):
    u, v = geometry.lattice(projector.width, projector.height, projector.layout)
    phi = 2 * np.pi * (x.cycles_per_pixel[0] * u + x.cycles_per_pixel[1] * v)
    return phi.min(), phi.max()


@pytest.mark.parametrize("layout", list(Layout))
@pytest.mark.parametrize("make", [patterns.paper_plan, patterns.plan, patterns.horizontal_plan])
def test_the_coarsest_set_fits_every_mirror_once(layout, make):
    rig = make_rig(layout, (90.0, -30.0, 210.0, 15.0, 260.0))
    for view in make(rig).views:
        low, high = phases_over_the_mirrors(rig.projector, view.sets[0])
        assert 0.5 < (high - low) / (2 * np.pi) < 0.97
        assert view.projector_size == rig.projector.plane_size


def test_paper_plan_is_table_one():
    rig = make_rig(Layout.DIAMOND)
    for view in patterns.paper_plan(rig, literal=True).views:
        assert [x.steps for x in view.sets] == [4, 4, 8]
        assert [x.period for x in view.sets] == pytest.approx([1140, 200, 36])
        assert len(view.keys) == 16
    usual = patterns.paper_plan(rig, PixelFormat.MONO12)
    for view in usual.views:
        assert [x.period for x in view.sets[1:]] == pytest.approx([200, 36])
        assert view.sets[0].period > 1140
        assert view.pixel_format is PixelFormat.MONO12


def test_horizontal_fringes_have_no_tilt():
    for view in patterns.horizontal_plan(make_rig()).views:
        assert all(x.cycles_per_pixel[0] == 0 and x.cycles_per_pixel[1] > 0 for x in view.sets)


def test_plan_takes_the_fewest_sets_that_are_safe():
    rig = make_rig()
    s = PatternSettings()
    noise = NoiseModel(s.design_noise_a, s.design_noise_b)
    for view in patterns.plan(rig, s=s).views:
        signal = (noise, s.design_modulation, s.design_background)
        r = patterns.predict(rig, view, *signal, response_error=s.response_error)
        assert r.order_error <= s.max_order_error
        periods = [x.period for x in view.sets]
        assert periods == sorted(periods, reverse=True)
        assert periods[-1] == pytest.approx(36)
        fewer = dataclasses.replace(s, max_sets=len(view.sets) - 1)
        with pytest.raises(UsageError, match="wrong orders"):
            patterns.plan(dataclasses.replace(rig, cameras=(rig.camera(view.camera),)), s=fewer)
    brighter = PatternSettings(finest_period=200, design_modulation=100, response_error=0.0)
    assert max(len(v.sets) for v in patterns.plan(rig, s=brighter).views) == 2


def test_calibration_plan_has_both_axes_and_covers_them():
    for layout, W in ((Layout.GRID, 912), (Layout.DIAMOND, 1824)):
        formats = {"left": PixelFormat.MONO8, "right": PixelFormat.RGB8}
        made = patterns.calibration_plan((912, 1140), layout, ["left", "right"], formats)
        assert [v.camera for v in made.views] == ["left", "right"]
        assert made.views[1].pixel_format is PixelFormat.RGB8
        groups = patterns.fringe_directions(made.views[0])
        assert len(groups) == 2
        for group, extent, axis in zip(groups, (W, 1140), (0, 1), strict=True):
            x = made.views[0].sets[group[0]]
            assert x.cycles_per_pixel[1 - axis] == 0
            assert 0.9 < x.cycles_per_pixel[axis] * extent < 1


@settings(max_examples=40, deadline=None)
@given(
    angle=st.floats(0, 360),
    period=st.floats(8, 3000),
    layout=st.sampled_from(list(Layout)),
)
def test_gradient_and_physical_period_are_inverse(angle, period, layout):
    projector = make_rig(layout).projector
    along = (math.cos(math.radians(angle)), math.sin(math.radians(angle)))
    g = patterns.gradient(projector, along, period)
    assert patterns.physical_period(projector, g) == pytest.approx(period, rel=1e-9)
    assert g[0] * along[1] == pytest.approx(g[1] * along[0], abs=1e-12)


def test_gradient_refuses_nonsense():
    projector = make_rig().projector
    for period in (0.0, -3.0, math.inf, math.nan):
        with pytest.raises(UsageError, match="positive period"):
            patterns.gradient(projector, (0, 1), period)
    with pytest.raises(UsageError):
        patterns.gradient(projector, (0, 0), 36)


# -------------------------------------------------------------------------------------------------------------- images


def small(layout, width=24, height=20) -> Projector:
    W = width * (2 if layout is Layout.DIAMOND else 1)
    lens = Lens(W, height, np.diag([900.0, 900.0, 1]), np.zeros(5))
    return Projector(width, height, layout, lens, Pose(np.eye(3), np.zeros(3)))


@pytest.mark.parametrize("layout", list(Layout))
@pytest.mark.parametrize("steps", [3, 4, 5, 8])
def test_images_are_the_formula_at_the_mirror_centres(layout, steps):
    projector = small(layout)
    g = (0.031, -0.017)
    view = ViewPlan("c", PixelFormat.MONO8, (FringeSet(g, steps),), projector.plane_size)
    made = list(patterns.images(view, projector, PatternSettings(level_low=10, level_high=240)))
    assert [k for k, _ in made] == list(view.keys)
    for key, image in made:
        assert image.dtype == np.uint8
        assert image.shape == (20, 24)
        for r in range(0, 20, 3):
            for c in range(0, 24, 5):
                u = 2 * c + r % 2 if layout is Layout.DIAMOND else c
                phi = 2 * math.pi * (g[0] * u + g[1] * r)
                want = 125 + 115 * math.cos(phi - 2 * math.pi * key.number / steps)
                assert abs(int(image[r, c]) - want) <= 0.5 + 1e-9


@pytest.mark.parametrize("steps", [3, 4, 8])
def test_images_decode_to_the_phase_by_fourier_transform(steps):
    """The first bin of an FFT over the steps holds the phase: no formula of ours."""
    projector = small(Layout.DIAMOND, 60, 50)
    g = (0.008, 0.011)
    view = ViewPlan("c", PixelFormat.MONO8, (FringeSet(g, steps),), projector.plane_size)
    frames = np.stack([i for _, i in patterns.images(view, projector)]).astype(float)
    got = -np.angle(np.fft.fft(frames, axis=0)[1])
    u, v = geometry.lattice(60, 50, Layout.DIAMOND)
    error = np.angle(np.exp(1j * (got - 2 * np.pi * (g[0] * u + g[1] * v))))
    assert np.abs(error).max() < 0.71 / 119.5  # rounding to codes, no more
    assert abs(error.mean()) < 1e-3


def test_gray_images_are_the_reflected_binary_code_of_the_contract():
    projector = small(Layout.GRID, 50, 8)
    gray = GraySet("u", 6.5, 3, inverse=True, white=True, black=True)
    view = ViewPlan("c", PixelFormat.MONO8, (gray,), projector.plane_size)
    made = dict(patterns.images(view, projector, PatternSettings(level_low=0, level_high=255)))
    assert (made[FrameKey(0, Role.WHITE, 0)] == 255).all()
    assert (made[FrameKey(0, Role.BLACK, 0)] == 0).all()
    words = []
    for u in range(50):
        bits = [int(made[FrameKey(0, Role.BIT, n)][4, u]) for n in range(3)]
        assert [255 - int(made[FrameKey(0, Role.INVERSE, n)][4, u]) for n in range(3)] == bits
        words.append("".join("1" if b else "0" for b in bits))
    table = ["000", "001", "011", "010", "110", "111", "101", "100"]
    for u, word in enumerate(words):
        k = next(k for k in range(20) if -0.5 + k * 6.5 <= u < -0.5 + (k + 1) * 6.5)
        assert word == table[k]


def test_gray_set_covers_what_it_must():
    assert patterns.gray_set("v", 1140, 36).bits == 5
    assert patterns.gray_set("u", 1024, 32).bits == 5
    assert patterns.gray_set("u", 1025, 32).bits == 6
    assert patterns.gray_set("u", 3, 32).bits == 1
    with pytest.raises(UsageError):
        patterns.gray_set("u", 100, 0)


def test_levels_in_the_wrong_order_are_refused():
    projector = small(Layout.GRID)
    view = ViewPlan("c", PixelFormat.MONO8, (FringeSet((0.1, 0.0), 4),), projector.plane_size)
    with pytest.raises(UsageError, match="level_low < level_high"):
        list(patterns.images(view, projector, PatternSettings(level_low=200, level_high=100)))


def test_plan_images_are_those_of_the_views():
    rig = make_rig()
    planned = patterns.paper_plan(dataclasses.replace(rig, cameras=rig.cameras[1:2]))
    one = {k: i for k, i in patterns.images(planned.views[0], rig.projector) if k.number == 0}
    for camera, key, image in patterns.plan_images(planned):
        assert camera == "camera2"
        if key in one:
            np.testing.assert_array_equal(image, one[key])
    assert (patterns.uniform(rig.projector, 255) == 255).all()


# ---------------------------------------------------------------------------------------------------------- prediction


@pytest.mark.parametrize("steps", [3, 4, 8])
def test_phase_sigma_is_the_spread_of_noisy_samples(steps):
    rng = np.random.default_rng(7)
    A, B, n = 90.0, 30.0, 60_000
    phi = rng.uniform(-np.pi, np.pi, n)
    clean = A + B * np.cos(phi - 2 * np.pi * np.arange(steps)[:, None] / steps)
    noisy = clean + rng.normal(size=clean.shape) * np.sqrt(0.7 + 0.05 * clean)
    error = np.angle(np.exp(1j * (-np.angle(np.fft.fft(noisy, axis=0)[1]) - phi)))
    assert error.std() == pytest.approx(float(patterns.phase_sigma(NoiseModel(0.7, 0.05), A, B, steps)), rel=0.02)


@pytest.mark.parametrize(("ratio", "coarse", "fine"), [(11.0, 0.15, 0.1), (5.5, 0.3, 0.2), (30.0, 0.05, 0.05)])
def test_order_error_is_the_share_of_wrong_orders(ratio, coarse, fine):
    rng = np.random.default_rng(11)
    n = 200_000
    true = rng.uniform(0, 2 * np.pi, n)  # absolute coarse phase
    seen = true + rng.normal(0, coarse, n)
    wrapped = np.angle(np.exp(1j * (ratio * true + rng.normal(0, fine, n))))
    order = np.round((ratio * seen - wrapped) / (2 * np.pi))
    wrong = np.abs(wrapped + 2 * np.pi * order - ratio * true) > np.pi
    want = float(patterns.order_error(ratio, coarse, fine))
    assert 1e-4 < want < 0.2
    assert wrong.mean() == pytest.approx(want, abs=4 * math.sqrt(want / n) + 0.02 * want)


def test_response_error_eats_into_the_half_cycle():
    assert patterns.order_error(10, 0.05, 0.05, 0.1) > patterns.order_error(10, 0.05, 0.05) > 0
    assert patterns.order_error(10, 0.0001, 0.0001, 1.0) == 1


def depth_of(rig, camera, g, p, phase):
    """Point of the camera's ray through p whose phase is `phase`: distance from p, mm, by root finding with OpenCV."""
    ray = p - geometry.centre(camera.pose)
    ray /= np.linalg.norm(ray)
    return brentq(lambda s: 2 * np.pi * float(cv_project(rig.projector, p + s * ray) @ g) - phase, -3, 3, xtol=1e-9)


@pytest.mark.parametrize("layout", list(Layout))
def test_depth_sigma_and_gain_match_brute_force(layout):
    rig = make_rig(layout)
    tilted, flat = patterns.paper_plan(rig), patterns.horizontal_plan(rig)
    points = np.array([[0, 0, 0], [30.0, -20, 8], [-25, 15, -9]])
    for camera, a, b in zip(rig.cameras, tilted.views, flat.views, strict=True):
        r = patterns.predict(rig, a, NOISE, 40, 60, points)
        h = patterns.predict(rig, b, NOISE, 40, 60, points)
        np.testing.assert_allclose(r.gain_over_horizontal, h.depth_sigma_mm / r.depth_sigma_mm, rtol=1e-9)
        for p, sigma in zip(points, r.depth_sigma_mm, strict=True):
            g = np.array(a.sets[-1].cycles_per_pixel)
            phi = 2 * np.pi * float(cv_project(rig.projector, p) @ g)
            e = r.sigma_phase[-1]
            d = depth_of(rig, camera, g, p, phi + e) - depth_of(rig, camera, g, p, phi - e)
            assert d / 2 == pytest.approx(sigma, rel=1e-4)
    # the camera whose baseline runs along v gains nothing; those 30 degrees off u gain a factor two
    gains = [patterns.predict(rig, v, NOISE, 40, 60).gain_over_horizontal[0] for v in tilted.views]
    assert gains == pytest.approx([1.0, 2.0, 2.0], rel=0.01)


def test_depth_spread_of_sampled_phases_matches_the_prediction():
    rig = make_rig()
    view = patterns.paper_plan(rig).views[1]
    r = patterns.predict(rig, view, NOISE, 25, 40)
    fine = view.sets[-1]
    g = np.array(fine.cycles_per_pixel)
    phi = 2 * np.pi * float(cv_project(rig.projector, np.zeros(3)) @ g)
    rng = np.random.default_rng(3)
    clean = 40 + 25 * np.cos(phi - 2 * np.pi * np.arange(fine.steps) / fine.steps)
    noisy = clean[:, None] + rng.normal(size=(fine.steps, 1500)) * np.sqrt(NOISE.a + NOISE.b * clean[:, None])
    error = np.angle(np.exp(1j * (-np.angle(np.fft.fft(noisy, axis=0)[1]) - phi)))
    depth = [depth_of(rig, rig.cameras[1], g, np.zeros(3), phi + e) for e in error]
    assert np.std(depth) == pytest.approx(r.depth_sigma_mm[0], rel=0.06)


def test_two_directions_add_their_information():
    rig = make_rig()
    view = patterns.calibration_plan((912, 1140), Layout.DIAMOND, ["camera2"]).views[0]
    both = patterns.predict(rig, view, NOISE, 40, 60).depth_sigma_mm[0]
    parts = [tuple(view.sets[i] for i in g) for g in patterns.fringe_directions(view)]
    alone = [patterns.predict(rig, dataclasses.replace(view, sets=x), NOISE, 40, 60) for x in parts]
    assert both == pytest.approx(1 / math.sqrt(sum(1 / p.depth_sigma_mm[0] ** 2 for p in alone)))


def test_brackets_and_opposite_signs_belong_to_one_direction():
    sets = (
        FringeSet((0.0, 1 / 36), 8, 1000.0), FringeSet((0.0, 1 / 36), 8, 4000.0), FringeSet((0.0, -1 / 400), 4),
        FringeSet((0.02, 0.0), 4), GraySet("u", 50.0, 5),
    )
    assert patterns.fringe_directions(ViewPlan("c", PixelFormat.MONO8, sets, (912, 1140))) == [[2, 0], [3]]


def test_predict_refuses_what_it_cannot_answer():
    rig = make_rig()
    view = patterns.paper_plan(rig).views[0]
    with pytest.raises(UsageError, match="B > 0"):
        patterns.predict(rig, view, NOISE, 0, 60)
    with pytest.raises(CaptureError, match="no fringe set"):
        patterns.predict(rig, dataclasses.replace(view, sets=(GraySet("u", 50.0, 5),)), NOISE, 10, 60)
    with pytest.raises(RigError, match="lacks camera"):
        patterns.predict(rig, dataclasses.replace(view, camera="camera9"), NOISE, 10, 60)


def test_validate_names_what_is_wrong():
    rig = make_rig()
    assert patterns.validate(patterns.plan(rig), rig) == ()
    literal = patterns.validate(patterns.paper_plan(rig, literal=True), rig)
    assert sum("wraps inside the field" in x for x in literal) == 3
    assert any("1.8" in x and x.startswith("camera2") for x in literal)
    horizontal = patterns.validate(patterns.horizontal_plan(rig), rig)
    assert [x[:7] for x in horizontal] == ["camera2", "camera3"]
    assert all("times more finely" in x for x in horizontal)
    elsewhere = patterns.validate(patterns.plan(rig), make_rig(Layout.GRID))
    assert "diamond" in elsewhere[0]
    assert "grid" in elsewhere[0]
    fine = ViewPlan("camera1", PixelFormat.MONO8, (FringeSet((0.0, 0.3), 8),), rig.projector.plane_size)
    planned = dataclasses.replace(patterns.plan(rig), views=(fine,))
    assert any("too short for the lattice" in x for x in patterns.validate(planned, rig))
