"""Pictures against geometry that is known: where a ball lands on the screen, what is in front, what a map shows."""

from __future__ import annotations

import cv2
import matplotlib as mpl
import numpy as np
import pytest

from fringescope import report
from fringescope.errors import EmptyResultError, UsageError
from fringescope.kernels import draw
from fringescope.types import Cloud, Decoded, Direction, Grid, NoiseModel, PixelFormat, Reason, Surface, SurfacePart


def quad(z=0.0, half=20.0, texture=None, x=0.0):
    """A level square of two triangles with a texture."""
    v = np.array([[-half + x, -half, z], [half + x, -half, z], [half + x, half, z], [-half + x, half, z]], np.float32)
    uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)  # +y of the world is up in the texture
    tex = np.full((8, 8, 3), 128, np.uint8) if texture is None else texture
    return v, np.array([[0, 1, 2], [0, 2, 3]], np.uint32), uv, tex


def surface_of(*quads) -> Surface:
    vertices = np.concatenate([q[0] for q in quads])
    parts, first = [], 0
    for i, (v, faces, uv, tex) in enumerate(quads):
        parts.append(SurfacePart(i, np.arange(first, first + len(v), dtype=np.uint32), uv, faces, tex))
        first += len(v)
    return Surface(vertices, np.tile(np.array([0, 0, 1], np.float32), (len(vertices), 1)), tuple(parts))


def ball(n=40_000, radius=10.0, centre=(0, 0, 0), rgb=(200, 40, 40)) -> Cloud:
    i = np.arange(n) + 0.5
    z, t = 1 - 2 * i / n, np.pi * (1 + 5**0.5) * i
    u = np.stack([np.sqrt(1 - z**2) * np.cos(t), np.sqrt(1 - z**2) * np.sin(t), z], 1).astype(np.float32)
    colour = np.tile(np.array(rgb, np.uint8), (n, 1))
    xyz = np.float32(radius) * u + np.array(centre, np.float32)
    return Cloud(xyz, u, colour, np.zeros(n, np.float32), np.zeros(n, np.uint8))


ABOVE = report.Viewpoint(-90, 90)


def test_a_ball_is_a_disc_in_the_middle_without_holes():
    image = report.render_cloud(ball(), (200, 160), report.Viewpoint(30, 40), background=None)
    alpha = image[..., 3] > 127
    v, u = np.nonzero(alpha)
    assert u.mean() == pytest.approx(99.5, abs=1)
    assert v.mean() == pytest.approx(79.5, abs=1)
    radius = np.sqrt(alpha.sum() / np.pi)
    assert radius == pytest.approx(0.46 * 160, rel=0.05)  # fills the height but for the margin
    inside = (np.hypot(*np.mgrid[-79.5:80, -99.5:100]) < radius - 2)
    assert alpha[inside].all()


def test_light_comes_from_the_upper_left():
    image = report.render_cloud(ball(), (160, 160), report.Viewpoint(10, 30), coloured=False).astype(int).sum(2)
    assert image[50, 50] > image[110, 110] + 60


def test_the_nearer_surface_hides_the_farther():
    red = np.zeros((4, 4, 3), np.uint8)
    red[..., 0] = 220
    blue = np.zeros((4, 4, 3), np.uint8)
    blue[..., 2] = 220
    for order in ((0, 1), (1, 0)):
        quads = (quad(0, 20, red), quad(8, 8, blue))
        image = report.render_surface(surface_of(*(quads[i] for i in order)), (120, 120), ABOVE)
        assert image[60, 60, 2] > 2 * image[60, 60, 0]
        assert image[100, 100, 0] > 2 * image[100, 100, 2]


def test_a_texture_lies_the_right_way_round():
    """Seen from above, front (-y) is down and +x is right, as on a map."""
    tex = np.full((64, 64, 3), 30, np.uint8)
    tex[:32, :32] = (250, 30, 30)  # top-left of the texture: x < 0, y > 0
    tex[32:, 32:] = (30, 250, 30)  # x > 0, y < 0
    image = report.render_surface(surface_of(quad(texture=tex)), (200, 200), ABOVE).astype(int)
    assert image[60, 60, 0] > 3 * image[60, 60, 1]
    assert image[140, 140, 1] > 3 * image[140, 140, 0]
    assert image[60, 140].max() < 120
    image = report.render_surface(surface_of(quad(texture=tex)), (200, 200), report.Viewpoint(-90, 40)).astype(int)
    assert image[85, 70, 0] > 3 * image[85, 70, 1]


def test_triangles_match_opencv_perspective_warp():
    """Two triangles that show a picture obliquely agree with a homography of the picture."""
    rng = np.random.default_rng(0)
    tex = cv2.GaussianBlur(rng.uniform(0, 1, (60, 80, 3)).astype(np.float32), (0, 0), 3)
    tex = (tex - tex.min()) / np.ptp(tex)
    corners = np.array([[10.0, 12, 2.0], [150, 25, 3.0], [140, 110, 4.0], [20, 95, 2.6]])
    # a planar quadrilateral needs depths that fit its homography: take them from one
    H, _ = cv2.findHomography(np.array([[-0.5, -0.5], [79.5, -0.5], [79.5, 59.5], [-0.5, 59.5]]), corners[:, :2])
    at = np.array([[-0.5, -0.5, 1], [79.5, -0.5, 1], [79.5, 59.5, 1], [-0.5, 59.5, 1]]) @ H.T
    screen = np.column_stack([corners[:, :2], at[:, 2]])  # depth proportional to the homogeneous coordinate
    assert (screen[:, 2] > 0).all()
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    depth, colour = np.full((120, 160), np.inf, np.float32), np.zeros((120, 160, 3), np.float32)
    normal = np.zeros_like(colour)
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    draw.triangles(screen, faces, np.zeros((4, 3), np.float32), uv, tex, depth, colour, normal)
    want = cv2.warpPerspective(tex, H, (160, 120), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    hit = cv2.erode(np.isfinite(depth).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert hit.sum() > 8000
    assert np.abs(colour - want)[hit].max() < 0.02


def test_bin_mean_is_the_mean_of_each_cell():
    rng = np.random.default_rng(1)
    x, y, value = rng.uniform(-1, 6, 500), rng.uniform(-1, 5, 500), rng.normal(size=500)
    value[::50] = np.nan
    out, count = np.zeros((4, 5)), np.zeros((4, 5), np.int64)
    draw.bin_mean(x, y, value, out, count)
    for v in range(4):
        for u in range(5):
            inside = (np.floor(x) == u) & (np.floor(y) == v) & np.isfinite(value)
            assert out[v, u] == pytest.approx(value[inside].mean())
            assert count[v, u] == inside.sum()


def test_error_map_shows_a_bump_where_it_is():
    x, y = np.meshgrid(np.linspace(-50, 50, 500), np.linspace(-30, 30, 300))
    flat = np.stack([x.ravel(), y.ravel()], 1)
    error = np.where((x > 20) & (y > 10), 8.0, 0.0).ravel() + np.random.default_rng(0).normal(0, 2, x.size)
    grid, extent = report.bin_map(flat, error)
    h, w = grid.shape

    def at(mx, my):
        left, right, bottom, top = extent
        return grid[int((my - bottom) / (top - bottom) * h), int((mx - left) / (right - left) * w)]

    assert at(35, 20) > 4
    assert abs(at(-35, 20)) < 4
    assert abs(at(35, -20)) < 4


def test_error_map_is_a_picture_that_repeats_and_leaves_no_traces(tmp_path):
    rng = np.random.default_rng(2)
    flat, error = rng.uniform(-20, 20, (5000, 2)), rng.normal(0, 5, 5000)
    error[:10] = np.nan
    before = dict(mpl.rcParams)
    one = report.error_map(flat, error, "Plane", [("std", "5.00 µm")], tmp_path / "a.png")
    report.error_map(flat, error, "Plane", [("std", "5.00 µm")], tmp_path / "b.png")
    assert dict(mpl.rcParams) == before
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    read = cv2.imread(str(tmp_path / "a.png"))[..., ::-1]
    np.testing.assert_array_equal(read, one)
    assert one.shape[1] > 900
    assert one.std() > 10
    with pytest.raises(EmptyResultError):
        report.error_map(flat, np.full(5000, np.nan), "nothing")


def test_reasons_are_told_apart_and_the_first_wins():
    reasons = np.zeros((20, 30), np.uint16)
    reasons[5, 5] = Reason.SATURATED | Reason.NOT_LOCAL
    reasons[6, 6] = Reason.NOT_LOCAL
    image = report.reasons_picture(reasons)

    def as_hex(p):
        return "#" + bytes(int(c) for c in p).hex()

    assert as_hex(image[5, 5]) == report.REASON_COLOURS[Reason.SATURATED]
    assert as_hex(image[6, 6]) == report.REASON_COLOURS[Reason.NOT_LOCAL]
    assert set(report.REASON_COLOURS) == set(Reason)
    lab = cv2.cvtColor(
        np.array([[[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in report.REASON_COLOURS.values()]], np.uint8)
        .astype(np.float32) / 255,
        cv2.COLOR_RGB2LAB,
    )[0]
    distance = np.linalg.norm(lab[:, None] - lab[None], axis=2) + 100 * np.eye(len(lab))
    assert distance.min() > 20  # far beyond the threshold of sight
    legend = report.reasons_map(reasons, "camera1", np.arange(600).reshape(20, 30))
    assert legend.ndim == 3


def test_phase_picture_darkens_what_is_not_valid():
    phase = np.linspace(0, 60, 400).reshape(20, 20)
    phase[0, 0] = np.nan
    valid = np.ones((20, 20), bool)
    valid[10] = False
    image = report.phase_picture(phase, valid)
    assert tuple(image[0, 0]) == report.DARK
    assert (image[10] == report.DARK).all()
    assert not (image[15] == report.DARK).all()
    assert (report.phase_picture(np.full((4, 4), np.nan)) == report.DARK).all()


def test_fringe_picture_hides_the_mosaic():
    frame = np.full((40, 60), 40, np.uint8)
    frame[::2, ::2] = 120
    assert np.ptp(report.fringe_picture(frame)) == 0


def test_contact_sheet_holds_every_panel():
    colours = [(200, 30, 30), (30, 200, 30), (30, 30, 200), (200, 200, 30)]
    panels = [report.Panel(np.full((50, 80, 3), c, np.uint8), f"panel {i}", "caption") for i, c in enumerate(colours)]
    sheet = report.contact_sheet(panels, columns=2, panel_px=(160, 100))
    for i, c in enumerate(colours):
        v, u = np.nonzero((sheet == c).all(2))
        assert len(u) == 160 * 100
        assert (u.mean() > sheet.shape[1] / 2) == (i % 2 == 1)
        assert (v.mean() > sheet.shape[0] / 2) == (i >= 2)
    with pytest.raises(UsageError, match="at least one"):
        report.contact_sheet([])


def test_story_and_around_are_made_of_a_scan():
    H, W = 40, 60
    phase = np.tile(np.linspace(0, 90, W, dtype=np.float32), (H, 1))
    ones = np.ones((H, W), np.float32)
    reasons = np.zeros((H, W), np.uint16)
    reasons[:, :5] = Reason.DARK
    decoded = Decoded(
        "camera1", (Direction((0.02, 0.0), phase, 0.01 * ones, 9 * ones),), (), (), 80 * ones, 40 * ones, reasons,
        NoiseModel(0.5, 0.02),
    )  # fmt: skip
    grid = Grid(0, "camera1", np.zeros((H, W, 3), np.float32), 0.005 * ones, reasons)
    frame = (60 + 50 * np.cos(phase)).astype(np.uint8)
    sheet = report.story(frame, PixelFormat.BAYER_RG8, decoded, grid, surface_of(quad()))
    assert sheet.shape[1] > 1500
    assert report.around(surface_of(quad())).shape[1] > 1500


def test_pictures_repeat_whatever_the_threads_do():
    views = [report.render_cloud(ball(5000), (120, 90)) for _ in range(3)]
    assert all((v == views[0]).all() for v in views)


def test_what_cannot_be_drawn_is_refused():
    empty = Cloud(
        np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8), np.zeros(0, np.float32),
        np.zeros(0, np.uint8),
    )  # fmt: skip
    with pytest.raises(EmptyResultError, match="no points"):
        report.render_cloud(empty)
    with pytest.raises(EmptyResultError, match="no triangles"):
        report.render_surface(Surface(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), ()))
    with pytest.raises(UsageError, match="fov"):
        report.Viewpoint(fov_deg=0)
    with pytest.raises(UsageError, match="picture of"):
        report.render_surface(surface_of(quad()), (0, 100))
