"""Geometry against OpenCV, against algebra, and for orientation (which way is up, where is forward)."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from fringescope import geometry as geo
from fringescope.errors import RigError
from fringescope.types import Camera, Layout, Lens, Pose, Projector, Rig, Volume, plane_size

finite = {"allow_nan": False, "allow_infinity": False}


@st.composite
def rotation_vectors(draw: st.DrawFn) -> np.ndarray:
    """Axis times angle, nearly zero and nearly 180 degrees included."""
    axis = np.array([draw(st.floats(-1, 1, **finite)) for _ in range(3)])
    assume(np.linalg.norm(axis) > 1e-3)
    angle = draw(st.one_of(st.floats(0, np.pi), st.floats(0, 1e-9), st.floats(np.pi - 1e-9, np.pi)))
    return axis / np.linalg.norm(axis) * angle


translations = st.lists(st.floats(-800, 800, **finite), min_size=3, max_size=3).map(np.array)


@st.composite
def poses(draw: st.DrawFn) -> Pose:
    R, _ = cv2.Rodrigues(draw(rotation_vectors()))
    return Pose(R, draw(translations))


@st.composite
def lenses(draw: st.DrawFn, skew: bool = False) -> Lens:
    """Lenses as they are built: up to 10 % distortion at the corner of the field."""
    width, height = draw(st.integers(64, 6000)), draw(st.integers(64, 6000))
    f = max(width, height) * draw(st.floats(1.2, 6))
    K = np.array([[f, 0, (width - 1) / 2], [0, f * draw(st.floats(0.4, 2.5)), (height - 1) / 2], [0, 0, 1.0]])
    K[:2, 2] += [draw(st.floats(-0.05, 0.05)) * width, draw(st.floats(-0.05, 0.05)) * height]
    if skew:
        K[0, 1] = draw(st.floats(-0.01, 0.01)) * f
    corner = np.hypot(width / K[0, 0], height / K[1, 1]) / 2 * 1.2
    k1, k2, k3 = (draw(st.floats(-0.05, 0.05)) / corner**n for n in (2, 4, 6))
    p1, p2 = (draw(st.floats(-0.002, 0.002)) for _ in range(2))
    return Lens(width, height, K, np.array([k1, k2, p1, p2, k3]))


def points_on(lens: Lens, n: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-0.5, -0.5], [lens.width - 0.5, lens.height - 0.5], (n, 2))


seeds = st.integers(0, 2**32 - 1)


@given(poses(), poses(), seeds)
@example(Pose(np.eye(3), np.zeros(3)), Pose(np.diag([1.0, -1, -1]), np.array([0, 0, 500.0])), 0)
def test_poses_form_a_group(T_ab: Pose, T_bc: Pose, seed: int) -> None:
    p = np.random.default_rng(seed).uniform(-500, 500, (4, 5, 3))
    np.testing.assert_allclose(geo.transform(geo.inverse(T_ab), geo.transform(T_ab, p)), p, atol=1e-9)
    both = geo.compose(T_ab, T_bc)
    np.testing.assert_allclose(geo.transform(both, p), geo.transform(T_ab, geo.transform(T_bc, p)), atol=1e-9)
    unit = geo.compose(geo.inverse(T_ab), T_ab)
    np.testing.assert_allclose(unit.R, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(unit.t, 0, atol=1e-9)
    np.testing.assert_allclose(geo.transform(T_ab, geo.centre(T_ab)), 0, atol=1e-9)


@given(lenses(), rotation_vectors(), translations, seeds)
@settings(max_examples=60)
def test_project_is_opencv_s(lens: Lens, rvec: np.ndarray, t: np.ndarray, seed: int) -> None:
    pose = Pose(cv2.Rodrigues(rvec)[0], t)
    rng = np.random.default_rng(seed)
    z = rng.uniform(100, 900, 50)
    p_cam = np.column_stack([rng.uniform(-0.3, 0.3, (50, 2)) * z[:, None], z])
    p_world = geo.transform(geo.inverse(pose), p_cam)
    theirs, _ = cv2.projectPoints(p_world, rvec, t, lens.K, lens.distortion)
    ours = geo.project(Camera("c", lens, pose), p_world)
    np.testing.assert_allclose(ours, theirs[:, 0], rtol=1e-9, atol=1e-6)


@given(lenses(), seeds)
@settings(max_examples=60)
def test_unproject_is_opencv_s(lens: Lens, seed: int) -> None:
    uv = points_on(lens, 50, seed)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 500, 1e-14)
    theirs = cv2.undistortPoints(uv[:, None], lens.K, lens.distortion, criteria=criteria)[:, 0]
    np.testing.assert_allclose(geo.unproject(lens, uv), theirs, atol=1e-9)


@given(lenses(skew=True), poses(), seeds)
@settings(max_examples=60)
def test_there_and_back(lens: Lens, pose: Pose, seed: int) -> None:
    camera = Camera("c", lens, pose)
    uv = points_on(lens, 40, seed)
    origin, direction = geo.world_rays(camera, uv)
    np.testing.assert_allclose(np.linalg.norm(direction, axis=-1), 1, atol=1e-12)
    depth = np.random.default_rng(seed + 1).uniform(100, 900, (40, 1))
    p = origin + direction * depth
    np.testing.assert_allclose(geo.project(camera, p), uv, atol=1e-6)
    _, again = geo.world_rays(camera, geo.project(camera, p))
    np.testing.assert_allclose(np.cross(again, direction), 0, atol=1e-9)
    assert (np.sum(again * direction, axis=-1) > 0).all()


@given(lenses())
@settings(max_examples=20)
def test_without_distortion_is_the_paper_s_equation_2(lens: Lens) -> None:
    p = np.array([[12.0, -7.0, 400.0], [0.0, 0.0, 300.0]])
    plain = geo.project(Camera("c", geo.without_distortion(lens), Pose(np.eye(3), np.zeros(3))), p)
    K = lens.K
    by_hand = np.column_stack([K[0, 0] * p[:, 0] / p[:, 2] + K[0, 2], K[1, 1] * p[:, 1] / p[:, 2] + K[1, 2]])
    np.testing.assert_allclose(plain, by_hand, rtol=1e-12)


def camera_over_the_table(width: int = 640, height: int = 480) -> Camera:
    """Looks straight down from 500 mm: camera x along world x, camera y against world y, forward along -z."""
    K = np.array([[1000.0, 0, (width - 1) / 2], [0, 1000.0, (height - 1) / 2], [0, 0, 1]])
    R = np.diag([1.0, -1.0, -1.0])
    return Camera("c", Lens(width, height, K, np.zeros(5)), Pose(R, -R @ np.array([0, 0, 500.0])))


def test_orientation() -> None:
    camera = camera_over_the_table()
    np.testing.assert_allclose(geo.centre(camera.pose), [0, 0, 500])
    middle, right, up, nearer = geo.project(camera, [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 100]])
    np.testing.assert_allclose(middle, [319.5, 239.5])
    assert right[0] > middle[0]
    assert right[1] == pytest.approx(middle[1])
    assert up[1] < middle[1]
    assert nearer[0] > right[0]
    np.testing.assert_allclose(geo.world_rays(camera, middle)[1], [0, 0, -1], atol=1e-12)


def test_the_top_left_pixel_centre_is_the_origin() -> None:
    lens = Lens(4, 3, np.array([[10.0, 0, 0], [0, 10, 0], [0, 0, 1]]), np.zeros(5))
    rays = geo.pixel_rays(lens)
    assert rays.shape == (3, 4, 2)
    np.testing.assert_allclose(rays[0, 0], [0, 0])
    np.testing.assert_allclose(rays[2, 3], [0.3, 0.2])


@given(lenses())
@settings(max_examples=20)
def test_pixel_rays_are_unproject_of_the_pixel_centres(lens: Lens) -> None:
    small = Lens(17, 11, lens.K, lens.distortion)
    u, v = np.meshgrid(np.arange(17.0), np.arange(11.0))
    np.testing.assert_array_equal(geo.pixel_rays(small), geo.unproject(small, np.stack([u, v], axis=-1)))


def test_behind_the_camera_is_nowhere() -> None:
    camera = camera_over_the_table()
    assert np.isnan(geo.project(camera, [[0, 0, 500], [0, 0, 600], [3, 4, 501]])).all()
    assert np.isfinite(geo.project(camera, [0, 0, 499.9])).all()


def test_shapes_are_kept() -> None:
    camera = camera_over_the_table()
    assert geo.project(camera, np.zeros((2, 3, 4, 3))).shape == (2, 3, 4, 2)
    assert geo.project(camera, np.zeros(3)).shape == (2,)
    assert geo.project(camera, np.zeros((0, 3))).shape == (0, 2)
    assert geo.unproject(camera.lens, np.zeros((5, 1, 2))).shape == (5, 1, 2)
    assert geo.project(camera, np.zeros((4, 3), dtype=np.float32)[::2]).dtype == np.float64


def test_a_lens_that_folds_over_gives_no_ray() -> None:
    folding = Lens(1000, 1000, np.array([[500.0, 0, 500], [0, 500, 500], [0, 0, 1]]), np.array([-0.4, 0, 0, 0, 0]))
    assert np.isfinite(geo.unproject(folding, [520, 510])).all()
    assert np.isnan(geo.unproject(folding, [999, 999])).all()


def test_the_grid_layout() -> None:
    u, v = geo.lattice(5, 3, Layout.GRID)
    assert u.shape == v.shape == (3, 5)
    assert (u[1, 2], v[1, 2]) == (2, 1)
    assert plane_size(912, 1140, Layout.GRID) == (912, 1140)


def test_the_diamond_layout() -> None:
    u, v = geo.lattice(912, 1140, Layout.DIAMOND)
    by_hand = {(0, 0): (0, 0), (0, 911): (1822, 0), (1, 0): (1, 1), (1, 911): (1823, 1), (1139, 3): (7, 1139)}
    for (r, c), there in by_hand.items():
        assert (u[r, c], v[r, c]) == there
    assert plane_size(912, 1140, Layout.DIAMOND) == (1824, 1140)
    assert u.max() == 1823
    # mirrors of neighbouring rows sit half a pitch apart: every mirror has its four nearest at sqrt(2) units
    points = np.column_stack([u[:9, :9].ravel(), v[:9, :9].ravel()])
    d = np.linalg.norm(points[:, None] - points[None], axis=-1)
    np.testing.assert_allclose(np.sort(d[40])[1:5], np.sqrt(2))


def small_rig(volume: Volume | None = None) -> Rig:
    above = camera_over_the_table()
    R, _ = cv2.Rodrigues(np.array([0.0, 0.4, 0.0]))
    R = R @ above.pose.R
    at = np.array([0.4, 0, 0]) * 500 + [0, 0, 480.0]
    side = Camera("side", above.lens, Pose(R, -R @ at))
    return Rig(Projector(640, 480, Layout.GRID, above.lens, above.pose), (side,), volume)


def test_the_working_point_is_where_the_axes_meet() -> None:
    rig = small_rig()
    p = geo.working_point(rig)
    for d in rig.devices:
        centre = [(d.lens.width - 1) / 2, (d.lens.height - 1) / 2]
        o, n = geo.world_rays(d, centre)
        assert np.linalg.norm(np.cross(n, p - o)) < 15
    parallel = Rig(rig.projector, (camera_over_the_table(),))
    with pytest.raises(RigError, match="volume"):
        geo.working_point(parallel)


def test_inside_an_oriented_box() -> None:
    s = np.sqrt(0.5)
    box = Volume(np.array([10.0, 0, 0]), np.array([[s, s, 0], [-s, s, 0], [0, 0, 1.0]]), np.array([5.0, 1, 2]))
    p = [[10, 0, 0], [10 + 4.9 * s, 4.9 * s, 0], [10 + 4.9 * s, -4.9 * s, 0], [10, 0, 2.1], [np.nan, 0, 0]]
    assert geo.inside_volume(box, p).tolist() == [True, True, False, False, False]


def test_the_field_of_view_is_shared_by_all() -> None:
    rig = small_rig()
    seen = geo.field_of_view(rig, [[0, 0, 0], [0, 0, 5000], [400, 0, 0], [0, 239.0 / 2, 0], [0, 0, np.nan]])
    assert seen.tolist() == [True, False, False, True, False]
