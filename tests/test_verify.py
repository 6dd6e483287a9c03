"""Is a rig still true: analytic surfaces seen by true, shifted and turned cameras; captures rendered by others."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fringescope import cli, evaluate, geometry, pipeline, store
from fringescope.errors import CalibrationError
from fringescope.settings import Settings, VerifySettings
from fringescope.twin import presets
from fringescope.types import Board, Decoded, Direction, Grid, NoiseModel, Pose, Rig, Sighting

SIGMA = 0.006  # mm along the ray
BOARD = Board((13, 10), 5.0)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return presets.instrument("paper", 0.05).rig


def turned(rig: Rig, camera: int, rad: float) -> Rig:
    """The rig with a camera turned about its own vertical by so much: what a knock does."""
    cameras = list(rig.cameras)
    c = cameras[camera]
    R = Rotation.from_rotvec([0.0, rad, 0.0]).as_matrix()
    cameras[camera] = replace(c, pose=Pose(R @ c.pose.R, R @ c.pose.t))
    return replace(rig, cameras=tuple(cameras))


def plane_grid(rig: Rig, view: int, normal=(0.1, -0.05, 1.0), noise=SIGMA, seed=0, lift=0.0) -> Grid:
    """What a camera measures of a plane through the origin, `lift` mm nearer along the ray."""
    camera = rig.cameras[view]
    v, u = np.mgrid[: camera.lens.height, : camera.lens.width]
    o, d = geometry.world_rays(camera, np.stack([u, v], -1))
    n = np.asarray(normal) / np.linalg.norm(normal)
    t = -(o @ n) / (d @ n) - lift + np.random.default_rng(seed + view).normal(0, 1, u.shape) * noise
    xyz = (o + d * t[..., None]).astype(np.float32)
    return Grid(view, camera.name, xyz, np.full(u.shape, noise, np.float32), np.zeros(u.shape, np.uint16))


def sighting(rig: Rig, camera: str, T: Pose, index=None, board=BOARD) -> Sighting:
    c = rig.camera(camera)
    columns, rows = board.inner_corners
    corner = np.array([(i, j) for j in range(rows) for i in range(columns)], dtype=np.int32)
    px = geometry.project(c, geometry.transform(T, board.corner_mm(corner)))
    none, size = np.zeros((0, 2)), (c.lens.width, c.lens.height)
    number = corner if index is None else index(corner)
    sigma, square = np.full(len(px), 0.01), np.zeros((0, 2), np.int32)
    return Sighting("pose", camera, size, number, px, sigma, square, none, none, none, none, none, none, none)


def test_noise_alone_is_what_two_averages_of_25_points_leave(rig: Rig) -> None:
    grids = [plane_grid(rig, v) for v in range(3)]
    found = evaluate.agreement(grids, rig)
    want = 0.6745 * 1e3 * SIGMA * np.sqrt(2) / 5
    # interpolation between averages takes some of the noise away, slant some more
    assert 0.6 * want < found.median_um < 1.05 * want
    assert found.systematic_um < 0.1 * want + 0.1
    assert len(found.pairs) == 6


def test_a_shift_along_the_ray_is_measured_with_its_sign(rig: Rig) -> None:
    grids = [plane_grid(rig, 0, normal=(0, 0, 1.0), noise=0.0, lift=0.05),
             plane_grid(rig, 1, normal=(0, 0, 1.0), noise=0.0)]  # fmt: skip
    pair = evaluate.agreement(grids, rig).pairs[0]
    _o, d = geometry.world_rays(rig.cameras[0], [[rig.cameras[0].lens.width / 2, rig.cameras[0].lens.height / 2]])
    want = 50 * abs(d[0, 2])  # um along the plane's normal
    assert pair.cameras == (rig.cameras[0].name, rig.cameras[1].name)
    assert pair.shift_um == pytest.approx(want, rel=0.03)
    assert pair.systematic_um == pytest.approx(want, rel=0.03)


def test_views_that_share_nothing_agree_on_nothing(rig: Rig) -> None:
    grid = plane_grid(rig, 0)
    found = evaluate.agreement([grid], rig)
    assert found.median_um is None
    assert found.pairs == ()
    hidden = replace(plane_grid(rig, 1), reasons=np.ones(grid.reasons.shape, np.uint16))
    assert evaluate.agreement([grid, hidden], rig).median_um is None


@pytest.mark.parametrize("scale", [1.0, 1.002])
@pytest.mark.parametrize("number", ["same", "turned", "shifted"])
def test_the_board_tells_scale_whatever_end_the_views_number_from(rig: Rig, scale: float, number: str) -> None:
    n = np.array([0.1, -0.05, 1.0]) / np.linalg.norm([0.1, -0.05, 1.0])
    z = -n  # into the board, away from the instrument
    x = np.cross([0, 1.0, 0], z)
    x /= np.linalg.norm(x)
    R = np.column_stack([x, np.cross(z, x), z])
    middle = np.array([27.5, 20.0, 0])  # of the corners, board mm
    T = Pose(R, -R @ middle)
    last = np.array(BOARD.inner_corners, np.int32) - 1
    other = {"same": None, "turned": lambda c: last - c, "shifted": lambda c: c - 2}[number]
    big = replace(BOARD, square_mm=BOARD.square_mm / scale)  # we believe in smaller squares: it measures too large
    names = [c.name for c in rig.cameras]
    sightings = [sighting(rig, names[0], T), sighting(rig, names[1], T, other), sighting(rig, names[2], T)]
    found = evaluate.board_trueness([plane_grid(rig, v, seed=5) for v in range(3)], sightings, big, rig)
    assert found.corners == 108
    assert found.scale_error_ppm == pytest.approx(1e6 * (scale - 1), abs=max(4 * found.scale_sigma_ppm, 20))
    assert found.views_um is not None
    assert found.views_um < 5
    assert found.rms_um < 3 + 3e3 * (scale - 1) * 15


def test_a_turned_camera_shows_in_every_witness(rig: Rig) -> None:
    bad = turned(rig, 1, 2e-4)
    grids = []
    for view in range(3):  # what the true rig sees, computed with the bad one: the ray is turned about the camera
        g = plane_grid(rig, view, noise=0.0)
        p = geometry.transform(rig.cameras[view].pose, g.xyz)
        grids.append(replace(g, xyz=geometry.transform(geometry.inverse(bad.cameras[view].pose), p).astype(np.float32)))
    found = evaluate.agreement(grids, bad)
    by = {p.cameras: p.systematic_um for p in found.pairs}
    names = [c.name for c in rig.cameras]
    assert by[names[0], names[2]] < 0.5
    assert by[names[0], names[1]] > 5


def test_two_directions_test_each_other(rig: Rig) -> None:
    grid = plane_grid(rig, 0, noise=0.0)
    g = (0.0, 1 / 36)
    phase = geometry.phase_at(rig.projector, g, grid.xyz).astype(np.float32)
    flat = np.zeros(phase.shape, np.float32)
    d = Direction(g, phase, flat, flat)
    decoded = Decoded(grid.camera, (d,), (), (), flat, flat, grid.reasons, NoiseModel(0, 0))
    exact = evaluate.epipolar_residual(grid, decoded, d, rig)
    assert exact is not None
    assert exact.systematic_um < 0.3
    off = replace(d, phase=phase + np.float32(2 * np.pi * g[1] * 2))  # two units of the plane
    found = evaluate.epipolar_residual(grid, decoded, off, rig)
    depth = np.median(geometry.transform(rig.projector.pose, grid.xyz)[..., 2])
    assert found is not None
    assert found.systematic_um == pytest.approx(2e3 * depth / rig.projector.lens.K[1, 1], rel=0.01)
    nothing = replace(grid, reasons=np.ones_like(grid.reasons))
    assert evaluate.epipolar_residual(nothing, decoded, d, rig) is None


def verdict(rig, systematic, **kw):
    some, one = (1.0, 0.7) if systematic is not None else (None, None)
    a = evaluate.Agreement(some, one, systematic, ())
    return evaluate.judge(rig, a, VerifySettings(), **kw)


def test_the_verdict_says_why(rig: Rig) -> None:
    assert verdict(rig, 1.0).verdict == "ok"
    assert verdict(rig, 500.0).verdict == "drifted"
    assert "calibrate anew" in verdict(rig, 500.0).words[0]
    nothing = verdict(rig, None)
    assert nothing.verdict == "unknown"
    assert "nothing to compare" in nothing.words[-1]
    assert verdict(rig, None, sphere_radius_error_um=-300.0).verdict == "drifted"
    assert "measured too small by 300 um" in verdict(rig, None, sphere_radius_error_um=-300.0).words[0]
    shrunk = evaluate.BoardTrueness(88, 1.0, 0.5, -2999.6, 3.0, None)
    assert "the board is measured too small by 3000 ppm (limit 509)" in verdict(rig, 1.0, board=shrunk).words[0]
    assert verdict(rig, 1.0, blind=("camera2",)).verdict == "unknown"
    held = {"calibration": {"held_out": [{"corner_mm_rms": 0.6}, {"corner_mm_rms": None}, "x"]}}
    modest = replace(rig, extra=held)  # never was better than 600 um
    assert evaluate.drift.promised_um(modest) == pytest.approx(600)
    assert verdict(modest, 500.0).verdict == "ok"
    json.dumps(nothing.to_dict(), allow_nan=False)


def promising(rig: Rig, um: float) -> Rig:
    """The rig, as if its calibration had predicted so much between two of its views, and half of it between others."""
    views = {"camera1 - camera2": um, "camera1 - camera3": um / 2}
    return replace(rig, extra={**rig.extra, "calibration": {"predicted_views_um": views}})


def test_views_that_differ_by_far_more_than_was_promised_get_a_warning(rig: Rig) -> None:
    assert not any("warning" in w for w in verdict(rig, 19.6).words)  # nothing was promised: the limit alone
    told = verdict(promising(rig, 0.3), 19.6)
    assert told.verdict == "ok"
    assert told.words[0].startswith("warning: the views differ by 19.6 um, the calibration promised 0.3: something")
    assert told.to_dict()["promised_views_um"] == pytest.approx(0.3)
    assert not any("warning" in w for w in verdict(promising(rig, 0.3), 4.0).words)  # as surfaces may leave it
    assert not any("warning" in w for w in verdict(promising(rig, 4.5), 19.6).words)  # it was never better
    worse = verdict(promising(rig, 0.3), 500.0)
    assert worse.verdict == "drifted"
    assert not any("warning" in w for w in worse.words)


@pytest.mark.parametrize(
    ("name", "rad"), [("plane", 1e-5), ("sphere", 1e-5), ("tissue", 1e-5), ("calibration/pose00", 3e-5)]
)
def test_an_honest_capture_gets_no_warning_and_a_small_turn_does(shared, name, rad) -> None:
    data = shared / "data" / "rendered-small"
    views = store.view_inputs(store.read_capture(data / name))[:2]
    rig = promising(store.read_rig(data / "truth" / "rig.json"), 0.3)
    honest = pipeline.verify(views, rig, Settings())
    assert honest.verdict == "ok"
    assert not any("warning" in w for w in honest.words)
    knocked = pipeline.verify(views, turned(rig, 1, rad), Settings())
    assert any("something has moved" in w for w in knocked.words), knocked.words


def test_rendered_captures(shared, tmp_path, capsys) -> None:
    data = shared / "data" / "rendered-small"
    truth = data / "truth" / "rig.json"
    assert cli.run(["verify", str(data / "sphere"), "--rig", str(truth), "--sphere-mm", "12", "--json"]) == 0
    out = json.loads(capsys.readouterr().out)
    assert out["verdict"] == "ok"
    assert out["inter_view_median_um"] < 1.4
    assert abs(out["sphere_radius_error_um"]) < 1
    assert cli.run(["verify", str(data / "calibration" / "pose03"), "--rig", str(truth), "--json"]) == 0
    out = json.loads(capsys.readouterr().out)
    assert out["verdict"] == "ok"
    assert out["board_rms_um"] < 1.5
    assert abs(out["scale_error_ppm"]) < 30
    assert out["epipolar_systematic_um"] < 2
    bad = tmp_path / "bad.json"
    store.write_rig(bad, turned(store.read_rig(truth), 1, 2e-4))
    for capture in ("sphere", "calibration/pose03"):
        assert cli.run(["verify", str(data / capture), "--rig", str(bad), "--json"]) == 0
        out = json.loads(capsys.readouterr().out)
        assert out["verdict"] == "drifted"
    nowhere = tmp_path / "board.json"
    nowhere.write_text('{"pattern": "checkerboard", "inner_corners": [11, 8], "square_mm": 5.0}')
    assert cli.run(["verify", str(data / "plane"), "--rig", str(truth), "--board", str(nowhere)]) == 1
    assert "found in no view" in capsys.readouterr().err


def test_a_board_that_must_be_there(shared) -> None:
    capture = store.read_capture(shared / "data" / "rendered-small" / "plane")
    truth = store.read_rig(shared / "data" / "rendered-small" / "truth" / "rig.json")
    one = store.view_inputs(capture)[:1]
    with pytest.raises(CalibrationError, match="found in no view"):
        pipeline.verify(one, truth, Settings(), BOARD, must_see_board=True)
    assert pipeline.verify(one, truth, Settings()).verdict == "unknown"


@pytest.mark.parametrize(
    ("args", "status", "word"),
    [
        (["nowhere", "--rig", "r.json"], 1, "nowhere"),
        ([".", "--rig", "r.json"], 1, "r.json"),
        ([".", "--rig", "r.json", "--sphere-mm", "-2"], 2, "sphere-mm"),
    ],
)
def test_bad_input_gets_one_line(args, status, word, tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    if "-2" in args:
        (tmp_path / "r.json").write_text("{}")
    assert cli.run(["verify", *args]) == status
    err = capsys.readouterr().err.strip().splitlines()
    assert len(err) == 1
    assert word in err[0]
