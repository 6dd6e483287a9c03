"""The digital twin against analytic truth, OpenCV and physics."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fringescope import geometry
from fringescope.errors import RigError, UsageError
from fringescope.twin import boards, loops, optics, presets, render, scene, shapes, textures, truth
from fringescope.types import Camera, Layout, Lens, PixelFormat, Pose, Projector

SCALE = 0.04
WHITE = textures.Finish(textures.uniform((0.8, 0.8, 0.8)))


def rotation(angles: list[float]) -> np.ndarray:
    return cv2.Rodrigues(np.array(angles))[0]


def fringe(projector: Projector, g: tuple[float, float], n: int, steps: int, low: float = 0.0) -> np.ndarray:
    c, r = np.meshgrid(np.arange(projector.width), np.arange(projector.height))
    u, v = (2 * c + r % 2, r) if projector.layout is Layout.DIAMOND else (c, r)
    x = np.cos(2 * np.pi * (g[0] * u + g[1] * v) - 2 * np.pi * n / steps)
    return np.rint(low + (255 - low) * (0.5 + 0.5 * x)).astype(np.uint8)


def decode(frames: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    n = len(frames)
    a = 2 * np.pi * np.arange(n) / n
    s, c = np.tensordot(np.sin(a), frames, 1) * 2 / n, np.tensordot(np.cos(a), frames, 1) * 2 / n
    return np.arctan2(s, c), frames.mean(0), np.hypot(s, c)


def wrapped(x: np.ndarray) -> np.ndarray:
    return np.angle(np.exp(1j * x))


def plane_at(z: float, finish: textures.Finish = WHITE) -> scene.Scene:
    return scene.Scene("plane", 0, (scene.tilted_plane(np.eye(3), (0.0, 0.0, z), finish),))


# --------------------------------------------------------------------------------- twin, geometry and OpenCV together


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=3),
    st.lists(st.floats(-40, 40), min_size=2, max_size=2),
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-2e-3, 2e-3), st.floats(-2e-3, 2e-3)),
    st.floats(900, 4000),
    st.floats(0.5, 2.0),
)
def test_projection_agrees_with_geometry_and_opencv_on_random_rigs(angles, shift, d, f, aspect):
    R, t = rotation(angles), np.array([*shift, 500.0])
    lens = Lens(800, 600, np.array([[f, 0, 410.3], [0, f * aspect, 288.8], [0, 0, 1]]), np.array([*d, 0.05]))
    pose = Pose(R, t)
    local = np.random.default_rng(1).uniform([-60, -60, 420], [60, 60, 600], (50, 3))
    p = (local - t) @ R
    ours = optics.land(lens, pose, p)
    theirs = cv2.projectPoints(p, cv2.Rodrigues(pose.R)[0], t, np.array(lens.K), np.array(lens.distortion))[0][:, 0]
    assert np.abs(ours[:, :2] - theirs).max() < 1e-6
    assert np.abs(ours[:, :2] - geometry.project(Camera("c", lens, pose), p)).max() < 1e-6
    assert np.abs(ours[:, 2] - local[:, 2]).max() < 1e-6
    origin, rays = optics.look(lens, pose, ours[:, :2])
    away = np.linalg.norm(np.cross(rays, p - origin), axis=1)
    assert away.max() < 1e-6  # the ray through a point's image meets the point


def test_points_behind_a_device_have_no_image():
    cam = presets.instrument("single", 0.05).rig.cameras[0]
    behind = geometry.centre(cam.pose) - 100 * cam.pose.R[2]
    assert np.isnan(optics.land(cam.lens, cam.pose, behind[None])).all()


def test_raising_the_plate_moves_projector_coordinates_as_opencv_says():
    inst = presets.instrument("paper", SCALE)
    p = inst.rig.projector
    cam = inst.rig.cameras[0]
    middle = (cam.lens.height // 2, cam.lens.width // 2)
    low, high = (render.Renderer(plane_at(z), inst).truth("camera1") for z in (0.0, 1.0))
    rvec = cv2.Rodrigues(p.pose.R)[0]
    for t in (low, high):
        uv = cv2.projectPoints(t.xyz[middle][None], rvec, p.pose.t, np.array(p.lens.K), np.array(p.lens.distortion))[0]
        assert np.abs(uv[0, 0] - t.uv[middle]).max() < 1e-6
    # camera 1 stands at +y and looks towards -y: a higher plate is met nearer to it, at larger y, and v runs along -y
    assert high.xyz[middle][1] > low.xyz[middle][1] + 0.5
    assert high.uv[middle][1] < low.uv[middle][1] - 5


# ------------------------------------------------------------------------------------------------------------- shapes


def test_ray_hits_on_analytic_shapes_lie_on_them():
    rng = np.random.default_rng(0)
    o = np.array([20.0, 300, 480])
    target = rng.uniform([-30, -20, 0], [30, 20, 8], (4000, 3))
    d = (target - o) / np.linalg.norm(target - o, axis=1, keepdims=True)
    ball = shapes.Sphere(WHITE, (3.0, -2.0, 4.0), 7.5)
    h = shapes.trace((ball,), o, d)
    hit = h.shape == 0
    assert 100 < hit.sum() < 4000
    r = h.point[hit] - np.array(ball.center)
    assert np.abs(np.linalg.norm(r, axis=1) - 7.5).max() < 1e-9
    assert np.abs(r / 7.5 - h.normal[hit]).max() < 1e-9
    assert (np.einsum("ij,ij->i", h.normal[hit], d[hit]) < 0).all()  # the near side
    turn = Pose(rotation([0.2, -0.1, 0.4]), np.array([1.0, 2.0, 3.0]))
    box = shapes.Boxes(WHITE, np.array([[-10.0, -8, 0]]), np.array([[12.0, 9, 5]]), turn)
    h = shapes.trace((box,), o, d)
    q = box.local(h.point[h.shape == 0])
    gap = np.minimum(np.abs(q - box.low[0]), np.abs(q - box.high[0])).min(1)
    assert len(q) > 500
    assert gap.max() < 1e-9
    assert (q > box.low[0] - 1e-9).all()
    assert (q < box.high[0] + 1e-9).all()


@pytest.mark.parametrize("name", ["plane", "sphere", "steps", "board", "tissue-domed", "tissue-thin"])
def test_offsets_are_distances_from_what_rays_hit(name):
    """Points set off from where rays end: above is positive, and beside no edge the distance is the step."""
    made, rng = scene.make(name), np.random.default_rng(5)
    ends = np.column_stack([rng.uniform([-34, -20], [34, 20], (4000, 2)), np.zeros(4000)])
    eye = np.array([40.0, 30.0, 500.0])
    away = (ends - eye) / np.linalg.norm(ends - eye, axis=1, keepdims=True)
    hits = shapes.trace(made.shapes, eye, away)
    assert (hits.shape >= 0).all()
    assert np.abs(shapes.offsets(made.shapes, hits.point)).max() < 1e-9
    normal = hits.normal * np.where((hits.normal * away).sum(1, keepdims=True) < 0, 1, -1)
    for h in (0.05, 1e-3):
        up = shapes.offsets(made.shapes, hits.point + h * normal)
        down = shapes.offsets(made.shapes, hits.point - h * normal)
        assert np.median(up) == pytest.approx(h, rel=2e-3)
        assert np.median(down) == pytest.approx(-h, rel=2e-3)
        assert np.mean(np.abs(up - h) < 0.05 * h) > (0.9 if "tissue" in name else 0.98)
    assert (shapes.offsets(made.shapes, hits.point + np.array([0, 0, 3.0])) > -1e-9).all()  # a wall goes on upwards


def test_offsets_beyond_an_edge_are_from_the_edge():
    sheet = shapes.Plane(WHITE, x_range=(-10.0, 10.0), y_range=(-5.0, 5.0))
    box = shapes.Boxes(WHITE, np.array([[-1.0, -1, -1]]), np.array([[1.0, 1, 1]]))
    p = np.array([[13.0, 9.0, 0.0], [13.0, 0.0, 4.0], [13.0, 0.0, -4.0], [0.0, 0.0, 2.0]])
    np.testing.assert_allclose(sheet.offset(p), [5, 5, -5, 2])
    q = np.array([[4.0, 5.0, 0.0], [0.0, 0.0, 3.0], [0.2, 0.0, 0.5]])
    np.testing.assert_allclose(box.offset(q), [5, 2, -0.5])
    over = Pose(np.diag([1.0, -1, -1]), np.zeros(3))  # a board's z goes into it: above is still where z grows
    np.testing.assert_allclose(dataclasses.replace(sheet, pose=over).offset(p[3:]), [2])


def test_mesh_hits_agree_with_an_analytic_plane_and_a_brute_force_search():
    rng = np.random.default_rng(3)
    x, y = np.meshgrid(np.linspace(-10, 10, 7), np.linspace(-8, 8, 6))
    V = np.stack([x, y, 0.4 * x + rng.uniform(-1, 1, x.shape)], -1).reshape(-1, 3)
    i = np.arange(42).reshape(6, 7)
    a, b, c, d = (k.ravel() for k in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    F = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    mesh = shapes.Mesh(WHITE, V, np.tile([0.0, 0, 1], (42, 1)), F)
    o = np.array([5.0, 80, 300])
    aim = np.stack([*rng.uniform(-11, 11, (2, 200)), np.zeros(200)], 1)
    rays = (aim - o) / np.linalg.norm(aim - o, axis=1, keepdims=True)
    t, _ = mesh.hit(np.broadcast_to(o, rays.shape), rays)
    slow = np.full(200, np.inf)  # Moeller-Trumbore, ray by ray and face by face
    for k, ray in enumerate(rays):
        for f in F:
            e1, e2, s = V[f[1]] - V[f[0]], V[f[2]] - V[f[0]], o - V[f[0]]
            h = np.cross(ray, e2)
            det = e1 @ h
            u, w = s @ h / det, ray @ np.cross(s, e1) / det
            if u >= 0 and w >= 0 and u + w <= 1:
                slow[k] = min(slow[k], e2 @ np.cross(s, e1) / det)
    assert np.isfinite(slow).sum() > 100
    both = np.isfinite(slow) & np.isfinite(t)
    assert (np.isfinite(slow) == np.isfinite(t)).mean() > 0.98  # rays that graze an edge
    assert np.abs(slow[both] - t[both]).max() < 1e-9


def test_a_sphere_shadows_the_plate_where_the_projector_cannot_reach():
    inst = presets.instrument("paper", SCALE).ideal()
    ball = shapes.Sphere(WHITE, (0.0, 0.0, 20.0), 10.0)
    t = render.Renderer(scene.Scene("s", 0, (scene.tilted_plane(np.eye(3), (0, 0, 0), WHITE), ball)), inst).truth(
        "camera2"
    )
    centre = geometry.centre(inst.rig.projector.pose)
    on_plate = t.shape == 0
    to = t.xyz[on_plate] - centre
    to /= np.linalg.norm(to, axis=1, keepdims=True)
    miss = np.linalg.norm(np.cross(to, np.array([0, 0, 20.0]) - centre), axis=1)  # of the ray from the ball's centre
    inside = (t.uv[on_plate] > 0).all(1) & (t.uv[on_plate] < [1823, 1139]).all(1)
    assert (~t.lit[on_plate][miss < 9.9]).all()
    assert t.lit[on_plate][(miss > 10.1) & inside].all()
    assert (miss < 9.9).sum() > 50


# ------------------------------------------------------------------------------------------------------------- light


@pytest.mark.parametrize("layout", [Layout.DIAMOND, Layout.GRID])
def test_mirrors_give_all_their_light_and_nothing_more(layout):
    p = presets.dlp4500(layout)
    o = optics.ProjectorOptics(contrast=1e9)
    image = np.zeros((p.height, p.width), np.uint8)
    image[300, 200], image[301, 500] = 255, 255
    light = optics.mirror_light(image, p, o)
    m = optics.MARGIN
    u = (np.array([400, 1001]) if layout is Layout.DIAMOND else np.array([200, 500])) + m
    area = 2.0 if layout is Layout.DIAMOND else 1.0  # units squared per mirror
    assert light.sum() == pytest.approx(2 * area, rel=1e-3)  # the dark mirrors' 1e-9 adds up
    assert light[300 + m, u[0]] == pytest.approx(1)
    assert light[301 + m, u[1]] == pytest.approx(1)
    stack = optics.LightStack(optics.blur_levels(1.5, 6.0), 1.0)
    for level in stack.build(light):
        assert level.sum() * stack.step**2 == pytest.approx(2 * area, rel=1e-3)


@pytest.mark.parametrize("sigma", [1.0, 1.6])
def test_defocused_diamond_fringes_are_sinusoids_of_the_predicted_contrast(sigma):
    p = presets.dlp4500()
    g = (np.cos(0.9) / 36, np.sin(0.9) / 36)
    o = optics.ProjectorOptics(contrast=1e9)
    rng = np.random.default_rng(0)
    u, v = rng.uniform(100, 1700, 3000), rng.uniform(100, 1000, 3000)
    stack = optics.LightStack(optics.blur_levels(sigma, 3 * sigma), 1.0)
    x, y, level = stack.place(np.full(3000, sigma), u, v)
    frames = []
    for n in range(8):
        levels = stack.build(optics.mirror_light(fringe(p, g, n, 8), p, o))
        out = np.empty(3000, np.float32)
        loops.gather(levels, x, y, level, np.ones(3000, np.float32), np.zeros(3000, np.float32), out)
        frames.append(out)
    phase, background, modulation = decode(np.array(frames, float))
    error = wrapped(phase - 2 * np.pi * (g[0] * u + g[1] * v))
    assert np.abs(error).max() < 0.004  # 0.02 units: rounding to 8 bits and what is left of the lattice
    assert np.std(error) < 0.001
    assert background == pytest.approx(0.5, abs=0.004)
    expected = 0.5 * np.exp(-2 * np.pi**2 * sigma**2 / 36**2)
    assert np.median(modulation) == pytest.approx(expected, rel=0.02)


def test_gamma_bends_the_fringes():
    p = presets.dlp4500()
    frames = [
        optics.mirror_light(fringe(p, (0, 1 / 36), n, 8), p, optics.ProjectorOptics(gamma=2.2, contrast=1e9))[
            200:800, 400
        ]
        for n in range(8)
    ]
    spectrum = np.abs(np.fft.fft(np.array(frames, float), axis=0))[:4].mean(1)
    assert spectrum[2] / spectrum[1] > 0.15  # the second harmonic
    linear = [
        optics.mirror_light(fringe(p, (0, 1 / 36), n, 8), p, optics.ProjectorOptics())[200:800, 400] for n in range(8)
    ]
    spectrum = np.abs(np.fft.fft(np.array(linear, float), axis=0))[:4].mean(1)
    assert spectrum[2] / spectrum[1] < 0.01


def test_scattering_below_the_surface_lowers_modulation_as_a_gauss_blur_would():
    inst = presets.instrument("single", SCALE).ideal()
    p, g = inst.rig.projector, (0.0, 1 / 36)

    def contrast(scatter: float) -> float:
        r = render.Renderer(plane_at(0.0, dataclasses.replace(WHITE, scatter_mm=scatter)), inst)
        _, a, b = decode(np.array([r.signal("camera1", fringe(p, g, n, 4)) for n in range(4)], float))
        return float(np.median((b / np.maximum(a, 1e-9))[a > 0.1]))

    mm = 36 * 500 / 9120  # period on the plate
    assert contrast(0.3) / contrast(0.0) == pytest.approx(np.exp(-2 * np.pi**2 * 0.3**2 / mm**2), rel=0.02)


def test_defocus_grows_away_from_focus():
    inst = presets.instrument("single", SCALE)
    o = dataclasses.replace(inst.projector, blur_units=0.9, aperture_mm=15.0)
    inst = dataclasses.replace(inst.ideal(), projector=dataclasses.replace(o, focus_mm=500.0))
    p = inst.rig.projector

    def contrast(z: float) -> float:
        r = render.Renderer(plane_at(z), inst)
        _, a, b = decode(np.array([r.signal("camera1", fringe(p, (0, 1 / 18), n, 4)) for n in range(4)], float))
        return float(np.median((b / np.maximum(a, 1e-9))[a > 0.1]))

    assert contrast(0.0) > contrast(10.0) > contrast(20.0)
    assert contrast(-20.0) < contrast(-10.0) < contrast(0.0)


# ------------------------------------------------------------------------------------------------------------ sensor


def sensor_codes(level: float, fmt: PixelFormat, n: int = 200_000, seed: int | None = 0, **kwargs: float) -> np.ndarray:
    rng = None if seed is None else np.random.default_rng(seed)
    s = optics.Sensor(**kwargs)
    return s.read(np.full(n, level, np.float32), 15000.0, fmt, 1.0, rng).astype(float)


@pytest.mark.parametrize("fmt", [PixelFormat.MONO8, PixelFormat.BAYER_RG8, PixelFormat.MONO12, PixelFormat.MONO16])
def test_dark_gives_the_offset_and_bright_gives_full_scale(fmt):
    assert sensor_codes(0.0, fmt).mean() == pytest.approx(2 / 255 * fmt.max_value, rel=0.02)
    assert (sensor_codes(3.0, fmt) == fmt.max_value).all()
    assert sensor_codes(0.5, fmt, 10)[0] <= fmt.max_value


def test_variance_follows_the_mean_by_one_electron_per_electron():
    fmt = PixelFormat.MONO12
    offset = 2 / 255 * fmt.max_value
    per_electron = (fmt.max_value - offset) / 15000
    levels = np.array([0.05, 0.1, 0.2, 0.4, 0.7])
    mean, var = np.array([(c.mean(), c.var()) for c in (sensor_codes(x, fmt) for x in levels)]).T
    slope, at_zero = np.polyfit(mean - offset, var, 1)
    assert slope == pytest.approx(per_electron, rel=0.02)
    assert at_zero == pytest.approx((2.7 * per_electron) ** 2 + 1 / 12, abs=0.5)


def test_noise_comes_from_the_seed_alone():
    a, b, c = (sensor_codes(0.4, PixelFormat.MONO8, 100, seed) for seed in (1, 1, 2))
    assert (a == b).all()
    assert (a != c).any()
    assert np.ptp(sensor_codes(0.4, PixelFormat.MONO8, 100, None)) == 0


def test_bayer_sites_see_their_own_colour():
    inst = presets.instrument("paper", SCALE).ideal()
    red = textures.Finish(textures.uniform((0.7, 0.05, 0.05)))
    p = inst.rig.projector
    f = render.Renderer(plane_at(0, red), inst).frame("camera1", np.full((p.height, p.width), 255, np.uint8), None)
    h, w = f.shape
    part = f[h // 4 * 2 - 20 : h // 4 * 2 + 20, w // 4 * 2 - 20 : w // 4 * 2 + 20].astype(float)
    assert part[0::2, 0::2].mean() > 3 * part[0::2, 1::2].mean()  # R against G of the first row
    assert part[0::2, 0::2].mean() > 3 * part[1::2, 1::2].mean()  # R against B


def test_exposure_scales_the_signal():
    inst = presets.instrument("single", SCALE)
    p = inst.rig.projector
    r = render.Renderer(plane_at(0), inst)
    white = np.full((p.height, p.width), 255, np.uint8)
    one, half = (r.frame("camera1", white, None, exposure_us=e).astype(float) for e in (8000, 4000))
    offset = 2 / 255 * 4095
    lit = one > 1000
    assert np.median((half[lit] - offset) / (one[lit] - offset)) == pytest.approx(0.5, abs=0.01)


def test_a_sensor_refuses_another_mosaic():
    r = render.Renderer(plane_at(0), presets.instrument("single", SCALE))
    with pytest.raises(UsageError, match="Mono12 sensor"):
        r.frame("camera1", None, None, pixel_format=PixelFormat.BAYER_RG8)


# --------------------------------------------------------------------------------------------- the whole, against truth


@pytest.mark.parametrize(
    ("preset", "name"), [("paper", "plane"), ("single", "sphere"), ("pair", "plane"), ("five", "plane")]
)
def test_noise_free_phase_agrees_with_analytic_truth(preset, name):
    inst = presets.instrument(preset, SCALE).ideal()
    p = inst.rig.projector
    r = render.Renderer(scene.make(name, seed=2), inst)
    cam = inst.rig.cameras[-1].name
    g = (0.6 / 60, -0.8 / 60)
    phase, _, modulation = decode(np.array([r.frame(cam, fringe(p, g, n, 8), None, gain=0.9) for n in range(8)], float))
    t = r.truth(cam)
    h, w = modulation.shape
    inner = np.zeros((h, w), bool)
    inner[2:-2, 2:-2] = True
    good = t.lit & inner & (modulation > 0.1 * modulation.max()) & (t.uv > 6).all(-1)
    good &= (t.uv < np.array(p.plane_size) - 7).all(-1)
    e = wrapped(phase - 2 * np.pi * (t.uv @ np.array(g)))[good]
    assert good.sum() > 0.4 * h * w
    assert abs(np.median(e)) < 2e-4
    assert np.median(np.abs(e)) < 0.01
    if name == "plane":  # every pixel, to what 8-bit codes allow
        assert np.abs(e).max() < 0.06


def test_rays_and_footprint_blur_agree_on_a_smooth_surface():
    inst = presets.instrument("single", SCALE)
    p = inst.rig.projector
    image = fringe(p, (0.7 / 48, 0.7 / 48), 1, 4)
    renderer = render.Renderer(plane_at(3.0), inst, rays=4)
    smooth, t = renderer.signal("camera1", image), renderer.truth("camera1")
    before = render.MOST_BEND
    try:
        render.MOST_BEND = -1.0  # every pixel counts as rough: 16 rays each
        traced = render.Renderer(plane_at(3.0), inst, rays=16).signal("camera1", image)
    finally:
        render.MOST_BEND = before
    inner = (t.uv > 30).all(-1) & (t.uv < np.array(p.plane_size) - 30).all(-1)
    d = (smooth - traced)[inner]
    assert inner.sum() > 5000
    assert np.abs(d).max() < 0.03 * traced.max()
    assert abs(d.mean()) < 1e-3


def test_wet_walls_mirror_reversed_fringes():
    black = textures.Finish(textures.uniform((0.0, 0.0, 0.0)), alpha=0.05, f0=0.04)
    ball = shapes.Sphere(black, (0.0, 0.0, 2.0), 18.0)
    s = scene.Scene("wet", 0, (scene.tilted_plane(np.eye(3), (0, 0, -4.0), WHITE), ball))
    inst = presets.instrument("single", SCALE).ideal()
    p, g = inst.rig.projector, (0.0, 1 / 1000)
    r = render.Renderer(s, inst)
    phase, _, modulation = decode(np.array([r.signal("camera1", fringe(p, g, n, 4)) for n in range(4)], float))
    t = r.truth("camera1")
    core = cv2.erode((t.shape == 1).astype(np.uint8), np.ones((5, 5))) > 0
    some = core & (t.mirrored > 0.5) & (modulation > 1e-4) & (np.abs(t.xyz[..., 0]) < 5) & t.lit
    down = some[1:] & some[:-1]
    mirrored = wrapped(np.diff(phase, axis=0))[down]  # what the wall shows
    own = (2 * np.pi * np.diff(t.uv @ np.array(g), axis=0))[down]  # what lights the wall itself
    assert down.sum() > 50
    assert (np.sign(mirrored) != np.sign(own)).mean() > 0.9
    away = cv2.dilate((t.shape == 1).astype(np.uint8), np.ones((5, 5))) == 0
    assert (t.mirrored[away] == 0).all()  # the floor is matt
    assert (render.Renderer(s, inst, mirrors=False).truth("camera1").mirrored == 0).all()


def test_gloss_saturates_where_the_lamp_is_mirrored():
    inst = presets.instrument("paper", SCALE)
    p = inst.rig.projector
    dark = textures.Finish(textures.uniform((0.05, 0.05, 0.05)), alpha=0.06, f0=0.04)
    ball = shapes.Sphere(dark, (0.0, 0.0, 0.0), 12.0)
    r = render.Renderer(scene.Scene("gloss", 0, (ball,), lamp=2.0), inst)
    f = r.frame("camera1", np.full((p.height, p.width), 255, np.uint8), None)
    t = r.truth("camera1")
    y, x = np.argwhere(f == 255).mean(0)
    n = t.xyz[round(y), round(x)] / 12.0  # there the normal halves the angle between camera and projector
    a, b = (geometry.centre(d.pose) - t.xyz[round(y), round(x)] for d in (inst.rig.projector, inst.rig.cameras[0]))
    half = a / np.linalg.norm(a) + b / np.linalg.norm(b)
    assert n @ half / np.linalg.norm(half) > np.cos(0.06)
    assert 3 < (f == 255).sum() < 400


def test_the_ring_light_lights_all_and_needs_no_projector():
    inst = presets.instrument("paper", SCALE)
    r = render.Renderer(plane_at(0), inst)
    on, off = r.signal("camera1", None, ring=1.0), r.signal("camera1", None)
    assert off.max() < 0.05
    assert on.min() > 0.1
    assert (r.signal("camera1", None, ring=0.5) - off) == pytest.approx((on - off) / 2, rel=1e-4)


# ----------------------------------------------------------------------------------------------- lamps of three colours


@pytest.mark.parametrize(("preset", "name"), [("pair", "tissue-folded"), ("single", "sphere")])
def test_the_three_lamps_together_are_the_white_one(preset, name, rng):
    inst = presets.instrument(preset, 0.03)
    p = inst.rig.projector
    r = render.Renderer(scene.make(name, 1), inst)
    image = rng.integers(0, 256, (p.height, p.width)).astype(np.uint8)
    grey = r.signal("camera1", image, ring=0.2, leds=0.6)
    assert list(r._views) == [("camera1", False)]  # who shows no colour pays for none
    same = r.signal("camera1", np.repeat(image[..., None], 3, 2), ring=0.2, leds=0.6)
    assert np.abs(same - grey).max() < 2e-6 * grey.max()
    off = r.signal("camera1", None, ring=0.2)
    parts = [r.signal("camera1", image, ring=0.2, leds=tuple(0.6 * np.eye(3)[k])) - off for k in range(3)]
    assert np.abs(sum(parts) - (grey - off)).max() < 5e-6 * grey.max()
    assert all(a.mean() > 0.05 * (grey - off).mean() for a in parts)


def test_a_lamp_is_seen_through_the_filters_of_the_sensor():
    """On a white plate each colour's share of a pixel is what its filter lets through of it: by the numbers alone."""
    inst = presets.instrument("pair", SCALE).ideal()
    p = inst.rig.projector
    r = render.Renderer(plane_at(0), inst)
    full = np.full((p.height, p.width), 255, np.uint8)
    lit = r.truth("camera1").lit
    middle = np.zeros(lit.shape, bool)
    middle[lit.shape[0] // 4 : -(lit.shape[0] // 4), lit.shape[1] // 4 : -(lit.shape[1] // 4)] = True
    filters, light = np.array(inst.sensor.filters), np.array(inst.projector_colour)
    for k in range(3):
        alone = np.zeros((p.height, p.width, 3), np.uint8)
        alone[..., k] = 255
        share = r.signal("camera1", alone) / np.maximum(r.signal("camera1", full), 1e-9)
        for y, x in ((0, 0), (0, 1), (1, 0), (1, 1)):
            sites, row = np.s_[y::2, x::2], x + y  # R G over G B
            expected = filters[row, k] * light[k] / (filters[row] @ light)
            here = middle[sites] & lit[sites]
            assert here.sum() > 1000
            assert np.median(share[sites][here]) == pytest.approx(expected, rel=1e-4)


def test_a_red_line_on_red_tissue_is_bright_and_a_blue_one_is_not():
    inst = presets.instrument("pair", SCALE).ideal()
    p = inst.rig.projector
    r = render.Renderer(plane_at(0, textures.Finish(textures.uniform((0.7, 0.1, 0.05)))), inst)
    picture = np.zeros((p.height, p.width, 3), np.uint8)
    picture[:, : p.width // 2, 0], picture[:, p.width // 2 :, 2] = 255, 255
    s, t = r.signal("camera1", picture).astype(float), r.truth("camera1")
    left = t.lit & (t.uv[..., 0] > 100) & (t.uv[..., 0] < 800)
    right = t.lit & (t.uv[..., 0] > 1000) & (t.uv[..., 0] < 1700)
    assert np.median(s[0::2, 0::2][left[0::2, 0::2]]) > 3 * np.median(s[1::2, 1::2][right[1::2, 1::2]])


def test_pictures_that_no_projector_shows_are_refused():
    r = render.Renderer(plane_at(0), presets.instrument("single", SCALE))
    for shape in ((1140, 912, 2), (912, 1140, 3), (1140,)):
        with pytest.raises(UsageError, match="shows"):
            r.signal("camera1", np.zeros(shape, np.uint8))


# ------------------------------------------------------------------------------------------------- scenes and presets


@pytest.mark.parametrize("name", scene.names())
def test_a_seed_makes_a_scene_and_another_seed_another(name):
    def parts(seed: int, lift: float = 0.0) -> dict:
        made = scene.make(name, seed, lift)
        return {k: (v if k.endswith(".npz") else json.loads(json.dumps(v))) for k, v in made.truth.items()}

    a, b, c = parts(4), parts(4), parts(5)
    for key, value in a.items():
        if key.endswith(".npz"):
            assert all((value[k] == b[key][k]).all() for k in value)
            assert (value["V"] != c[key]["V"]).any()
        else:
            assert value == b[key]
    assert any(a[k] != c[k] for k in a if k.endswith(".json")) or "tissue_mesh.npz" in a
    if "tissue.json" in a:
        raised = parts(4, 7.0)
        assert raised["tissue.json"]["base_z"] == a["tissue.json"]["base_z"] + 7
        assert raised["tissue_mesh.npz"]["V"][:, 2] == pytest.approx(a["tissue_mesh.npz"]["V"][:, 2] + 7)


@pytest.mark.parametrize("name", ["tissue-domed", "tissue-folded", "tissue-thin"])
def test_specimens_fill_the_oval_that_the_judge_looks_at(name):
    t = scene.make(name, 3).truth
    V, base = t["tissue_mesh.npz"]["V"], t["tissue.json"]["base_z"]
    n = round(len(V) ** 0.5)
    assert n * n == len(V)
    X, Y = V.reshape(n, n, 3)[..., 0], V.reshape(n, n, 3)[..., 1]
    assert np.ptp(X, axis=0).max() == 0  # a regular grid, x along columns
    assert np.ptp(Y, axis=1).max() == 0
    oval = np.hypot(V[:, 0] / 36, V[:, 1] / 22) < 0.97
    assert (V[oval, 2] > base + 0.1).all()
    assert V[:, 2].max() - base > 4


def test_specimens_are_really_different():
    heights = [
        scene.make(n, 0).truth["tissue_mesh.npz"]["V"][:, 2] for n in ("tissue-domed", "tissue-folded", "tissue-thin")
    ]
    slopes = []
    for z in heights:
        n = round(len(z) ** 0.5)
        gy, gx = np.gradient(z.reshape(n, n), 58 / (n - 1), 86 / (n - 1))
        mid = slice(n // 4, -n // 4)
        slopes.append(np.hypot(gx, gy)[mid, mid])
    domed, folded, thin = slopes
    assert (folded > 2.0).mean() > 5 * (domed > 2.0).mean()  # folds: steep walls
    assert thin.max() > 8  # the cut side of the lifted lip: over 80 degrees
    assert np.median(thin) < np.median(folded)


def test_unknown_names_are_refused():
    with pytest.raises(UsageError, match="there are plane"):
        scene.make("cube")
    with pytest.raises(UsageError, match="there are paper"):
        presets.instrument("big")
    with pytest.raises(UsageError, match="scale"):
        presets.instrument("paper", 2.0)
    with pytest.raises(UsageError, match="board"):
        scene.make("board", board="dots")
    with pytest.raises(RigError):
        render.Renderer(plane_at(0), presets.instrument("pair", SCALE)).truth("camera3")


def test_the_paper_preset_is_the_papers_rig():
    inst = presets.instrument("paper", 1.0)
    p = inst.rig.projector
    assert (p.width, p.height, p.layout, p.plane_size) == (912, 1140, Layout.DIAMOND, (1824, 1140))
    assert [(c.lens.width, c.lens.height) for c in inst.rig.cameras] == [(5472, 3648)] * 3
    assert inst.pixel_formats == (PixelFormat.BAYER_RG8,) * 3
    at = np.array([geometry.centre(c.pose) for c in inst.rig.cameras])
    assert np.linalg.norm(at[:, :2], axis=1) == pytest.approx(320, abs=5)
    azimuth = np.sort(np.degrees(np.arctan2(at[:, 1], at[:, 0])) % 360)
    assert np.diff(azimuth) == pytest.approx(120, abs=2)
    for device in inst.rig.devices:  # the whole 10 x 6 cm field is seen
        corners = np.array([[x, y, 0.0] for x in (-48, 48) for y in (-29, 29)])
        uv = geometry.project(device, corners)
        assert (uv > 0).all()
        assert (uv < [device.lens.width, device.lens.height]).all()


def test_scale_keeps_what_a_pixel_covers():
    full, small = (presets.instrument("paper", s).rig.cameras[1] for s in (1.0, 0.125))
    assert (small.lens.width, small.lens.height) == (684, 456)
    p = np.array([[12.0, -7.0, 3.0], [-40.0, 20.0, -5.0]])
    assert geometry.project(small, p) == pytest.approx((geometry.project(full, p) + 0.5) / 8 - 0.5, abs=1e-9)


@pytest.mark.parametrize("kind", ["checkerboard", "charuco"])
def test_opencv_finds_the_board_where_the_truth_says(kind):
    inst = presets.instrument("single", 0.12)
    s = scene.make("board", seed=1, pose=2, board=kind)
    f = render.Renderer(s, inst).frame("camera1", None, np.random.default_rng(0), ring=1.0)
    image = np.clip(f / 16, 0, 255).astype(np.uint8)
    T = s.truth["poses.json"][0]
    b = boards.checkerboard() if kind == "checkerboard" else boards.charuco()
    i, j = np.meshgrid(np.arange(b.columns - 1), np.arange(b.rows - 1))
    grid = np.stack([i, j, 0 * i], -1).reshape(-1, 3) * b.square_mm
    true = geometry.project(inst.rig.cameras[0], grid @ np.array(T["R"]).T + T["t"])
    if kind == "checkerboard":
        ok, found = cv2.findChessboardCornersSB(image, (b.columns - 1, b.rows - 1))
        assert ok
        found = found.reshape(-1, 2)
        if np.linalg.norm(found[0] - true[0]) > np.linalg.norm(found[-1] - true[0]):
            found = found[::-1]
    else:
        words = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100)
        board = cv2.aruco.CharucoBoard((b.columns, b.rows), b.square_mm, b.marker_mm, words)
        found, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
        assert len(ids) > 70
        found, true = found.reshape(-1, 2), true[ids.ravel()]
    assert np.median(np.linalg.norm(found - true, axis=1)) < 0.15


def test_truth_files_are_those_of_the_contract(tmp_path: Path):
    inst = presets.instrument("paper", SCALE)
    for name in ("plane", "sphere", "steps", "board", "tissue-thin"):
        truth.write(scene.make(name, 1), inst.rig, tmp_path / name)
    rig = json.loads((tmp_path / "plane" / "rig.json").read_text())
    assert rig["format"] == "fringescope-rig"
    assert rig["projector"]["layout"] == "diamond"
    assert [c["name"] for c in rig["cameras"]] == ["camera1", "camera2", "camera3"]
    plane = json.loads((tmp_path / "plane" / "plane.json").read_text())
    assert np.linalg.norm(plane["normal"]) == pytest.approx(1)
    ball = json.loads((tmp_path / "sphere" / "sphere.json").read_text())
    assert [s["radius"] for s in ball["spheres"]] == [5.00065, 12.0]
    mesh = np.load(tmp_path / "tissue-thin" / "tissue_mesh.npz")
    assert mesh["V"].shape[1] == 3
    assert mesh["F"].max() < len(mesh["V"])
    assert json.loads((tmp_path / "tissue-thin" / "tissue.json").read_text())["mesh"] == "tissue_mesh.npz"
    assert json.loads((tmp_path / "board" / "board.json").read_text())["pattern"] == "checkerboard"
