"""Phase to points against OpenCV, root finding, the paper's closed form, and sampled noise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fringescope import triangulate
from fringescope.errors import DecodeError, RigError
from fringescope.types import (
    Camera,
    Decoded,
    Direction,
    Layout,
    Lens,
    NoiseModel,
    Pose,
    Projector,
    Reason,
    Rig,
    Volume,
    plane_size,
)
from tests import core_scenes as core
from tests.reference import rays

seeds = st.integers(0, 2**32 - 1)


def random_rig(seed, layout=Layout.GRID, distortion=1.0, shape=(9, 12)):
    """One camera and a projector at random places some 300 mm from a specimen that is not at the origin."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(-80, 80, 3)
    H, W = shape

    def device(eye, width, height, view_mm, anisotropy):
        far = np.linalg.norm(eye - target)
        fx = width * far / view_mm
        K = np.array([[fx, 0, (width - 1) / 2 + rng.uniform(-0.03, 0.03) * width],
                      [0, fx * anisotropy, (height - 1) / 2 + rng.uniform(-0.03, 0.03) * height], [0, 0, 1]])
        corner = np.hypot(width / fx, height / fx / anisotropy) / 2
        d = distortion * rng.uniform(-1, 1, 5) * [0.08 / corner**2, 0.05 / corner**4, 0.004, 0.004, 0]
        R, t = core.random_pose(eye, target, rng.uniform(-np.pi, np.pi))
        return Lens(width, height, K, d), Pose(R, t)

    polar, azimuth = np.radians(rng.uniform(12, 45)), rng.uniform(-np.pi, np.pi)
    sideways = np.array([np.cos(azimuth), np.sin(azimuth), 0])
    up = np.array([0, 0, 1.0])
    size = plane_size(456, 570, layout)
    anisotropy = 1.0 if layout is Layout.DIAMOND else rng.uniform(0.5, 2)
    p_lens, p_pose = device(target + 300 * up, *size, 200.0, anisotropy)
    eye = target + rng.uniform(250, 400) * (np.sin(polar) * sideways + np.cos(polar) * up)
    c_lens, c_pose = device(eye, W, H, 40.0, rng.uniform(0.8, 1.2))
    volume = Volume(target, np.eye(3), np.array([60.0, 60, 60]))
    rig = Rig(Projector(456, 570, layout, p_lens, p_pose), (Camera("c", c_lens, c_pose),), volume)
    return rig, target, rng


def gradients(rig, rng, directions):
    """The camera's best direction and, for a second one, something across it; period 25 units of u or v."""
    angle = core.best_angle(rig, rig.cameras[0], rig.volume.center)
    return [(np.cos(a) / 25, np.sin(a) / 25) for a in (angle, angle + rng.uniform(0.6, 1.2))[:directions]]


def decoded(gs, phases, sigmas, camera="c"):
    shape = phases[0].shape
    zero = np.zeros(shape, np.float32)
    sheets = tuple(
        Direction(tuple(g), p.astype(np.float32), np.broadcast_to(np.float32(s), shape).copy(), zero + 99)
        for g, p, s in zip(gs, phases, sigmas, strict=True)
    )
    return Decoded(camera, sheets, (), (), zero, zero, np.zeros(shape, np.uint16), NoiseModel(1, 0))


def specimen(rig, target, rng):
    normal = np.array([*rng.uniform(-0.3, 0.3, 2), 1.0])
    normal /= np.linalg.norm(normal)
    return core.plane_points(rig.cameras[0], normal, normal @ target + rng.uniform(-5, 5)), normal


def slopes(rig, g, p):
    """Phase per mm along the camera's ray at points (H, W, 3), by central differences of OpenCV's projection."""
    o = -rig.cameras[0].pose.R.T @ rig.cameras[0].pose.t
    d = (p - o) / np.linalg.norm(p - o, axis=-1, keepdims=True)
    h = 1e-3
    ahead, behind = (rays.phase(rig.projector, g, p + s * h * d) for s in (1, -1))
    return ((ahead - behind) / (2 * h)).reshape(p.shape[:-1])


@settings(max_examples=50)
@given(seeds, st.sampled_from(list(Layout)), st.integers(1, 2))
def test_a_known_plane_comes_back(seed, layout, directions):
    """Both lenses distorted, any pose: within 1e-4 mm and what a float32 phase of that size can tell."""
    rig, target, rng = random_rig(seed, layout)
    p, _ = specimen(rig, target, rng)
    gs = gradients(rig, rng, directions)
    phases = [rays.phase(rig.projector, g, p).reshape(p.shape[:2]) for g in gs]
    out = triangulate.grid(decoded(gs, phases, [0.01] * directions), np.zeros(p.shape[:2], np.uint16), rig)
    assert (out.reasons == 0).all()
    rounding = sum(np.spacing(np.abs(ph).astype(np.float32)) for ph in phases) / np.abs(slopes(rig, gs[0], p))
    assert (np.linalg.norm(out.xyz - p, axis=-1) <= 1e-4 + rounding).all()


@settings(max_examples=10)
@given(seeds)
def test_the_ray_meets_the_equiphase_surface_where_bisection_finds_it(seed):
    rig, target, rng = random_rig(seed)
    (g,) = gradients(rig, rng, 1)
    o, d = rays.camera_rays(rig.cameras[0])
    middle = np.linalg.norm(target - o)
    p0 = o + (middle + rng.uniform(-40, 40, d.shape[:2]))[..., None] * d
    phi = rays.phase(rig.projector, g, p0).reshape(d.shape[:2]).astype(np.float32)
    out = triangulate.grid(decoded([g], [phi], [0.01]), np.zeros(phi.shape, np.uint16), rig, volume_margin=5)
    for i, j in ((0, 0), (4, 6), (8, 11), (2, 9)):
        want = rays.meet(rig.projector, g, float(phi[i, j]), o, d[i, j], middle - 60, middle + 60)
        np.testing.assert_allclose(out.xyz[i, j], want, atol=1e-4)


@settings(max_examples=30)
@given(seeds, st.sampled_from(list(Layout)))
def test_pinhole_is_the_paper_s_equation_15(seed, layout):
    """Without distortion both ways are one; with it the paper's plane misses by up to whole millimetres."""
    rig, target, rng = random_rig(seed, layout)
    p, _ = specimen(rig, target, rng)
    (g,) = gradients(rig, rng, 1)
    phi = rays.phase(rig.projector, g, p).reshape(p.shape[:2]).astype(np.float32)
    measured, none = decoded([g], [phi], [0.01]), np.zeros(phi.shape, np.uint16)
    flat = triangulate.grid(measured, none, rig, volume_margin=5, pinhole=True)
    for i, j in np.ndindex(*phi.shape):
        want = rays.paper_point(rig.cameras[0], rig.projector, g, float(phi[i, j]), j, i)
        np.testing.assert_allclose(flat.xyz[i, j], want, atol=2e-4)
    exact = triangulate.grid(measured, none, rig, volume_margin=5)
    assert np.nanmax(np.linalg.norm(exact.xyz - flat.xyz, axis=-1)) > 1e-2
    straight, target, rng = random_rig(seed, layout, distortion=0.0)
    p, _ = specimen(straight, target, rng)
    phi = rays.phase(straight.projector, g, p).reshape(p.shape[:2]).astype(np.float32)
    measured = decoded([g], [phi], [0.01])
    both = [triangulate.grid(measured, none, straight, volume_margin=5, pinhole=w).xyz for w in (True, False)]
    np.testing.assert_allclose(both[0], both[1], atol=1e-4)


def test_raising_the_plate_raises_the_points():
    """A plate 1 mm nearer to the devices: z grows by 1 mm, and the phase grows where its gradient says it must."""
    rig, target, rng = random_rig(7)
    (g,) = gradients(rig, rng, 1)
    z, phases = [], []
    for lift in (0.0, 1.0):
        p = core.plane_points(rig.cameras[0], (0, 0, 1), target[2] + lift)
        phi = rays.phase(rig.projector, g, p).reshape(p.shape[:2])
        out = triangulate.grid(decoded([g], [phi], [0.01]), np.zeros(phi.shape, np.uint16), rig)
        z.append(out.xyz[..., 2])
        phases.append(phi)
    np.testing.assert_allclose(z[1] - z[0], 1.0, atol=1e-3)
    assert (phases[1] > phases[0]).all()  # g points where the light moves as the ray comes towards the camera


@settings(max_examples=20)
@given(seeds, st.integers(1, 2))
def test_sigma_is_the_derivative(seed, directions):
    rig, target, rng = random_rig(seed)
    p, _ = specimen(rig, target, rng)
    gs, sigmas = gradients(rig, rng, directions), [0.02, 0.05][:directions]
    phases = [rays.phase(rig.projector, g, p).reshape(p.shape[:2]) for g in gs]
    out = triangulate.grid(decoded(gs, phases, sigmas), np.zeros(p.shape[:2], np.uint16), rig)
    information = sum((slopes(rig, g, p) / s) ** 2 for g, s in zip(gs, sigmas, strict=True))
    np.testing.assert_allclose(out.sigma, 1 / np.sqrt(information), rtol=1e-3)


@pytest.mark.parametrize("directions", [1, 2])
def test_sigma_is_the_spread_of_noisy_scans(directions):
    rig, target, rng = random_rig(11)
    p, _ = specimen(rig, target, rng)
    gs, sigmas = gradients(rig, rng, directions), [0.03, 0.05][:directions]
    phases = [rays.phase(rig.projector, g, p).reshape(p.shape[:2]) for g in gs]
    o = -rig.cameras[0].pose.R.T @ rig.cameras[0].pose.t
    d = (p - o) / np.linalg.norm(p - o, axis=-1, keepdims=True)
    along = []
    for _ in range(150):
        noisy = [ph + rng.normal(0, s, ph.shape) for ph, s in zip(phases, sigmas, strict=True)]
        out = triangulate.grid(decoded(gs, noisy, sigmas), np.zeros(p.shape[:2], np.uint16), rig)
        error = out.xyz - p
        along.append((error * d).sum(-1))
        across = error - along[-1][..., None] * d
        assert np.nanmax(np.abs(across)) < 2e-4  # the error runs along the ray and nowhere else
    spread = np.nanstd(along, axis=0) / out.sigma
    assert np.nanmedian(spread) == pytest.approx(1, abs=0.05)
    assert np.sqrt(np.nanmean(spread**2)) == pytest.approx(1, abs=0.1)


def test_masked_pixels_and_contradictions_carry_no_point():
    rig, target, rng = random_rig(3)
    p, _ = specimen(rig, target, rng)
    gs = gradients(rig, rng, 2)
    phases = [rays.phase(rig.projector, g, p).reshape(p.shape[:2]) for g in gs]
    phases[1][2, 3] += 2 * np.pi  # one direction a whole order off
    phases[0][5, 5] = np.nan  # one direction only
    phases[0][6, 6] = phases[1][6, 6] = np.nan  # none
    reasons = np.zeros(p.shape[:2], np.uint16)
    reasons[1, 1] = Reason.SATURATED
    out = triangulate.grid(decoded(gs, phases, [0.02, 0.02]), reasons, rig)
    assert out.reasons[1, 1] == Reason.SATURATED
    assert out.reasons[2, 3] == Reason.ORDER_UNCERTAIN
    assert out.reasons[5, 5] == 0
    np.testing.assert_allclose(out.xyz[5, 5], p[5, 5], atol=1e-3)
    assert out.reasons[6, 6] != 0
    np.testing.assert_array_equal(np.isfinite(out.xyz).all(-1), out.reasons == 0)
    np.testing.assert_array_equal(np.isfinite(out.sigma), out.reasons == 0)
    assert reasons[2, 3] == 0, "the caller's reasons are not written to"


def test_points_outside_the_volume_are_named():
    rig, target, rng = random_rig(5)
    small = Rig(rig.projector, rig.cameras, Volume(target, np.eye(3), np.array([200.0, 200, 1])))
    p = core.plane_points(rig.cameras[0], (0, 0.1, 1), np.array([0, 0.1, 1]) @ target / np.hypot(1, 0.1))
    (g,) = gradients(rig, rng, 1)
    phi = rays.phase(rig.projector, g, p).reshape(p.shape[:2])
    out = triangulate.grid(decoded([g], [phi], [0.02]), np.zeros(phi.shape, np.uint16), small, volume_margin=1.0)
    inside = np.abs(p[..., 2] - target[2]) < 1
    clear = np.abs(np.abs(p[..., 2] - target[2]) - 1) > 1e-3
    assert 0 < inside.sum() < inside.size
    np.testing.assert_array_equal((out.reasons == 0)[clear], inside[clear])
    assert set(np.unique(out.reasons)) == {0, int(Reason.OUT_OF_VOLUME)}


def test_what_cannot_be_triangulated_is_refused():
    rig, _, rng = random_rig(5)
    (g,) = gradients(rig, rng, 1)
    phi, none = np.ones((9, 12)), np.zeros((9, 12), np.uint16)
    with pytest.raises(RigError, match="lacks camera 'x'; it has c"):
        triangulate.grid(decoded([g], [phi], [0.1], camera="x"), none, rig)
    with pytest.raises(DecodeError, match="settle the orders first"):
        triangulate.grid(Decoded("c", (), (), (), phi, phi, none, NoiseModel(1, 0)), none, rig)
    with pytest.raises(DecodeError, match=r"frames of 11 x 9 pixels, the rig was calibrated at 12 x 9") as e:
        triangulate.grid(decoded([g], [phi[:, 1:]], [0.1]), none[:, 1:], rig)
    assert "\n" not in str(e.value)
