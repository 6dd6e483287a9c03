"""What a calibration is worth: noise told from pattern, predictions that sampling confirms, words."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from fringescope import geometry
from fringescope.calibrate import coverage, prediction, scatter
from fringescope.calibrate.evidence import correlations, evidence, told
from fringescope.settings import EvidenceSettings
from fringescope.types import Camera, HeldOut, Layout, LeftOut, Lens, Pose, Projector, Rig
from tests.calibration_scenes import board_poses, calibration, cv_project

S = EvidenceSettings(permutations=500)


def held(c, mm=0.004, px=0.012, scale=1.00002):
    return [HeldOut(p, 200, mm, px, 0.03, 3.0, scale) for p in c.boards]


def judged(c):
    return {v.device: scatter.field_test(v, S) for v in scatter.by_device(c)}


# ----------------------------------------------------------------------------------------------------------- residuals


def test_noise_is_called_noise():
    p = []
    for seed in range(6):
        for t in judged(calibration("pair", seed=seed)).values():
            assert t.rms == pytest.approx(np.sqrt(2) * (0.03 if t.kind == "phase" else 0.01), rel=0.1)
            assert t.field_rms == pytest.approx(t.field_noise, rel=0.8)
            p += [(t.asymmetry_p, t.field_p, t.field_f_p)]
    p = np.array(p)
    assert (p > 0.01).mean() > 0.9
    assert np.abs(p.mean(axis=0) - 0.5).max() < 0.25  # uniform where there is nothing


def test_a_field_that_repeats_is_found_and_measured():
    def bias(device, uv):
        x = (uv - [342, 228]) / 342
        return 0.03 * np.stack([x[:, 1] ** 2, x[:, 0] * x[:, 1]], 1) if device == "camera1" else np.zeros_like(uv)

    c = calibration("pair", bias=bias)
    t = judged(c)
    places = np.concatenate([s.corner_px for s in c.sightings if s.camera == "camera1"])
    truth = np.sqrt((bias("camera1", places) ** 2).sum(1).mean())
    assert t["camera1"].field_p < 0.01
    assert t["camera1"].field_f_p < 1e-6
    assert t["camera1"].field_rms == pytest.approx(truth, rel=0.25)
    assert t["camera2"].field_p > 0.01
    smooth = np.array(t["camera1"].smooth)
    assert np.abs(smooth[:, 2:] - bias("camera1", smooth[:, :2])).max() < 0.6 * np.abs(smooth[:, 2:]).max()


def test_residuals_that_belong_together_are_no_pattern():
    """Every board bends its own way: independent residuals are refused by the F-test, but nothing repeats."""
    rng = np.random.default_rng(1)
    c = calibration("single", n=12)
    bent = []
    for s, r in zip(c.sightings, c.residuals, strict=True):
        k = rng.normal(0, 0.03, (2, 3))
        x = (s.corner_px - 300) / 300
        bend = np.stack([x**2 @ [1, 0], x.prod(1), x**2 @ [0, 1]], 1) @ k.T
        bent.append(dataclasses.replace(r, corner=r.corner + bend))
    t = judged(dataclasses.replace(c, residuals=tuple(bent)))["camera1"]
    assert t.field_f_p < 1e-6
    assert t.field_p > 0.01


def test_skewed_residuals_are_not_centrosymmetric():
    rng = np.random.default_rng(5)
    c = calibration("single")
    skewed = tuple(
        dataclasses.replace(r, corner=0.01 * (rng.exponential(1, r.corner.shape) - 1)) for r in c.residuals
    )
    t = judged(dataclasses.replace(c, residuals=skewed))["camera1"]
    assert t.asymmetry_p < 0.01
    assert np.hypot(*t.mean) < 0.002  # about zero on average, yet lopsided
    assert t.asymmetry > 3 * judged(c)["camera1"].asymmetry


def test_energy_distance_is_that_of_the_definition():
    v = scatter.by_device(calibration("single", n=2))[1]
    r = v.r[:40]
    few = dataclasses.replace(v, place=v.place[:40], r=r, block=np.arange(40).astype(np.int32) % 5)
    d = lambda a, b: np.mean([np.hypot(*(p - q)) for p in a for q in b])  # noqa: E731
    wanted = (2 * d(r, -r) - d(r, r) - d(-r, -r)) / (2 * d(r, -r))
    assert scatter._asymmetry(few, scatter.turned_signs(5, 100))[0] == pytest.approx(wanted)


def test_signs_are_all_tried_where_there_are_few():
    s = scatter.turned_signs(5, 10)
    assert len({tuple(x) for x in s} | {tuple(-x) for x in s}) == 32
    assert (s[0] == 1).all()
    assert scatter.turned_signs(40, 10).shape == (11, 40)
    assert np.isnan(scatter.share_above(np.arange(4.0)))


@pytest.mark.parametrize("degrees", [(0, 90), (10, 75), (0, 60, 120)])
def test_vectors_are_put_together_from_their_parts(degrees, rng):
    a = np.radians(degrees)
    g = np.stack([np.cos(a), np.sin(a)], 1) / 36
    r = rng.normal(size=(20, 2))
    unit = g * 36
    assert scatter.along(g, r @ unit.T) == pytest.approx(r)
    one = scatter.along(g[:1], (r @ unit.T)[:, :1])
    assert one @ unit[0] == pytest.approx(r @ unit[0])
    assert np.isnan(scatter.along(g, np.full((1, len(a)), np.nan))).all()


# ---------------------------------------------------------------------------------------------------------- prediction


def varied(rig, parameters, step):
    """The rig with all parameters changed at once; written apart from the code under test."""
    by = {}
    for p, d in zip(parameters, step, strict=True):
        by.setdefault(p.device, {})[p.name] = d

    def device(d, name):
        x = by.get(name, {})
        K = d.lens.K + np.array([[x.get("fx", 0), 0, x.get("cx", 0)], [0, x.get("fy", 0), x.get("cy", 0)], [0, 0, 0]])
        k = d.lens.distortion + [x.get(n, 0) for n in ("k1", "k2", "p1", "p2", "k3")]
        turn = Rotation.from_rotvec([x.get(n, 0) for n in ("rx", "ry", "rz")]).as_matrix()
        pose = Pose(turn @ d.pose.R, d.pose.t + [x.get(n, 0) for n in ("tx", "ty", "tz")])
        return Lens(d.lens.width, d.lens.height, K, k), pose

    p = rig.projector
    cameras = tuple(Camera(c.name, *device(c, c.name)) for c in rig.cameras)
    return Rig(Projector(p.width, p.height, p.layout, *device(p, "projector")), cameras)


def slow_point(rig, camera, px, phase, g, near, far):
    """Where the pixel's ray carries the phase: by bisection of OpenCV's projection."""
    o, d = geometry.world_rays(camera, px)
    return o + d * brentq(lambda t: float(cv_project(rig.projector, o + t * d)[0] @ g) - phase, near, far, xtol=1e-10)


def test_prediction_is_what_sampling_gives():
    c = calibration("pair", sigma=0.05)
    rig, free = c.rig, [p for p in c.parameters if not p.fixed]
    C = c.covariance[: len(free), : len(free)]
    predicted = prediction.predict(c)
    rng = np.random.default_rng(3)
    x, y, z = (np.linspace(-1, 1, n) for n in prediction.GRID)
    grid = np.stack(np.meshgrid(x, y, z, indexing="ij"), -1).reshape(-1, 3)[::7] * rig.volume.half_size
    seen = [geometry.field_of_view(Rig(rig.projector, (k,)), grid) for k in rig.cameras]
    errors = []
    for step in rng.multivariate_normal(np.zeros(len(free)), C, 120, method="eigh"):
        r = varied(rig, free, step)
        found, true = [], []
        for k, camera in enumerate(rig.cameras):
            g = prediction.fringe_direction(rig, camera, np.zeros(3))
            for p in grid[seen[k]]:
                px, phase = cv_project(camera, p)[0], float(cv_project(rig.projector, p)[0] @ g)
                away = np.linalg.norm(p - geometry.centre(r.cameras[k].pose))
                found.append(slow_point(r, r.cameras[k], px, phase, g, away - 20, away + 20))
                true.append(p)
        found, true = np.array(found), np.array(true)
        a, b = found.mean(0), true.mean(0)
        turn = Rotation.align_vectors(true - b, found - a)[0]
        errors.append((turn.apply(found - a) + b) - true)
    sigma = 1000 * np.sqrt((np.array(errors) ** 2).sum(-1).mean(0))
    n = seen[0].sum()
    for k, part in enumerate((sigma[:n], sigma[n:])):
        assert np.median(part) == pytest.approx(predicted.per_camera[rig.cameras[k].name][0], rel=0.25)
    assert predicted.scale_ppm > 0


def test_moving_everything_is_no_error_of_measurement():
    """Projector and cameras shift together: an uncertainty of the world, not of what is measured in it."""
    c = calibration("single", sigma=0.0)
    names = [("projector", "tx"), ("camera1", "tx")]
    camera, p = c.rig.cameras[0], c.rig.projector
    shift = np.array([0.6, -0.7, 0.4])  # of the world
    steps = {"projector": -p.pose.R @ shift, "camera1": -camera.pose.R @ shift}
    parameters = [dataclasses.replace(c.parameters[0], device=d, name=m, fixed=False)
                  for d, _ in names for m in ("tx", "ty", "tz")]  # fmt: skip
    v = np.concatenate([steps["projector"], steps["camera1"]])
    together = dataclasses.replace(c, parameters=tuple(parameters), covariance=np.outer(v, v))
    assert prediction.predict(together).per_camera["camera1"][2] < 1e-4
    v[3:] = 0
    apart = dataclasses.replace(together, covariance=np.outer(v, v))
    assert prediction.predict(apart).per_camera["camera1"][0] > 0.1


def test_prediction_grows_with_the_covariance_and_needs_one():
    c = calibration("paper", sigma=0.02)
    a, b = prediction.predict(c), prediction.predict(dataclasses.replace(c, covariance=4 * c.covariance))
    for camera in a.per_camera:
        assert b.per_camera[camera] == pytest.approx([2 * x for x in a.per_camera[camera]])
    assert set(a.views_um) == {"camera1 - camera2", "camera1 - camera3", "camera2 - camera3"}
    assert all(len(s) == 3 for s in a.slices.values())
    assert [s.z_mm for s in a.slices["camera1"]] == pytest.approx([-14, 0, 14])
    assert prediction.predict(dataclasses.replace(c, covariance=np.full_like(c.covariance, np.nan))) is None
    assert prediction.predict(dataclasses.replace(c, covariance=np.zeros((0, 0)))) is None


# ------------------------------------------------------------------------------------------------- coverage and words


def test_a_good_calibration_is_called_good():
    c = calibration("paper", n=12, sigma=0.01)
    e = evidence(c, held(c), S)
    assert e.verdict == "good", e.weak
    text = " ".join(e.good)
    assert "0.014 px" in text
    assert "4 um" in text
    assert "20 ppm" in text
    assert json.dumps(dataclasses.asdict(e), allow_nan=True)
    row = next(p for p in e.poses if p.pose == "pose01")
    assert row.notes == ("camera1: 3 points left out: they miss by 0.4 px, the others by 0.01",)
    assert told("camera1", 1, "far off") == "camera1: 1 point left out: far off"
    assert row.corner_px["camera2"] == pytest.approx(0.014, rel=0.3)
    head = next(f.rms for f in e.fields if f.kind == "phase")
    assert row.sample_units["camera2"] == pytest.approx(head, rel=0.1)  # one measure in the head and in the table
    assert np.degrees(row.tilt_rad) == pytest.approx(22, abs=3)


def test_what_to_photograph_next_is_said():
    rng = np.random.default_rng(0)
    flat = Rotation.from_euler("x", np.pi).as_matrix()
    poses = {k: Pose(flat, [-38, -3, 0.1 * i]) for i, k in enumerate(board_poses(9, rng))}
    c = calibration("paper", poses=poses, sigma=0.02)
    e = evidence(c, held(c), S)
    told = " | ".join(e.next)
    assert "no pose tilted towards camera1" in told
    assert "mm nearer and farther" in told
    assert "right" in told
    assert "near one line" in " ".join(e.weak)
    assert e.verdict != "good"


def test_a_layout_that_the_focal_lengths_contradict_is_said():
    c = calibration("paper", n=12, sigma=0.01)
    p = c.rig.projector
    assert p.layout is Layout.DIAMOND
    assert "layout" not in " ".join(evidence(c, held(c), S).weak)
    K = p.lens.K * [[1], [2], [1]]
    rig = Rig(dataclasses.replace(p, lens=dataclasses.replace(p.lens, K=K)), c.rig.cameras, c.rig.volume)
    e = evidence(dataclasses.replace(c, rig=rig), held(c), S)
    assert any("fy is 2.00 fx" in w and "layout grid" in w for w in e.weak)
    assert e.verdict != "good"
    grid = dataclasses.replace(rig.projector, layout=Layout.GRID)  # a grid's units may be what they are
    assert "layout" not in " ".join(evidence(dataclasses.replace(c, rig=Rig(grid, c.rig.cameras)), held(c), S).weak)


def test_tilt_is_told_on_the_right_side():
    """All boards face camera 1: only the side away from it is missing."""
    c0 = calibration("paper", n=1)
    camera = c0.rig.camera("camera1")
    to = geometry.centre(camera.pose)
    axis = np.cross([0, 0, 1.0], to / np.linalg.norm(to))
    axis /= np.linalg.norm(axis)
    poses = {}
    for i in range(8):
        R = (Rotation.from_rotvec(np.radians(20 + i) * axis) * Rotation.from_euler("x", np.pi)).as_matrix()
        poses[f"pose{i:02}"] = Pose(R, -R @ [25.0, 17.5, 0])
    c = calibration("paper", poses=poses)
    tilts = {t.device: t.tilts for t in coverage.coverage(c)}
    assert np.degrees(tilts["projector"][0][1]) == pytest.approx(20, abs=1)
    assert tilts["camera1"][0][1] < tilts["projector"][0][1]  # seen straighter by that camera
    assert tilts["camera2"][0][1] > tilts["projector"][0][1]
    told = " ".join(evidence(c, held(c), S).next)
    assert "away from camera1" in told
    assert "tilted towards camera1" not in told


def test_the_volume_is_filled_where_boards_were():
    flat = Rotation.from_euler("x", np.pi).as_matrix()
    poses = {f"pose{i:02}": Pose(flat, [x - 25.0, 17.5, z]) for i, (x, z) in enumerate([(0, 0), (0, 1), (8, 0)])}
    c = calibration("paper", poses=poses)  # the volume: 60 x 44 x 28 mm about the origin; the board's corners: 50 x 35
    f = coverage.filled(c)
    below, middle, above = (np.array(layer) for layer in f.layers)
    assert middle.shape == (6, 8)
    assert f.edges_mm == pytest.approx([-14, -14 / 3, 14 / 3, 14])
    assert (below <= 0).all()
    assert (above <= 0).all()
    assert (middle[1:-1, 1:-1] == 3).all()
    assert (middle[2, 0], middle[2, -1]) == (2, 3)  # the third pose stands to the right: columns grow with x
    every = np.concatenate([below.ravel(), middle.ravel(), above.ravel()])
    assert f.share == pytest.approx((every > 0).sum() / (every >= 0).sum())
    lifted = {k: Pose(flat, np.add(T.t, [0, 6, 9])) for k, T in poses.items()}
    layers = [np.array(layer) for layer in coverage.filled(calibration("paper", poses=lifted)).layers]
    assert (layers[1] <= 0).all()
    assert layers[2][-1].max() > 0  # rows grow with y, layers with z
    assert layers[2][0].max() <= 0
    assert evidence(c, held(c), S).figures["volume reached"] == f.share


def test_cells_count_corners_where_they_are():
    c = calibration("single", poses={"pose00": board_poses(1, np.random.default_rng(0))["pose00"]})
    s = c.sightings[0]
    covered = {k.device: k for k in coverage.coverage(c)}["camera1"]
    cells = np.array(covered.cells)
    assert cells.shape == (6, 8)
    assert cells.clip(0).sum() == len(s.corner)
    u, v = s.corner_px[0]
    assert cells[int((v + 0.5) / s.size[1] * 6), int((u + 0.5) / s.size[0] * 8)] > 0
    assert covered.share == pytest.approx((cells > 0).sum() / (cells >= 0).sum())


def test_cells_that_the_projector_does_not_light_are_not_asked_for():
    c = calibration("single")
    narrow = dataclasses.replace(c.rig.projector.lens, K=c.rig.projector.lens.K * [[4, 1, 1], [1, 4, 1], [1, 1, 1]])
    rig = Rig(dataclasses.replace(c.rig.projector, lens=narrow), c.rig.cameras)
    dim = dataclasses.replace(c, rig=rig, residuals=())
    covered = {k.device: k for k in coverage.coverage(dim)}["camera1"]
    assert covered.cells[0][0] == -1
    assert "middle" in covered.missing
    assert "upper left" not in covered.missing


@pytest.mark.parametrize(
    ("change", "said", "verdict"),
    [
        ({"corner_px": 0.7}, "0.5 px or less is usual", "usable"),
        ({"corner_px": 3.0}, "0.5 px or less is usual", "do not use"),
        ({"sigma": 30.0}, "the calibration alone makes points uncertain", "do not use"),
        ({"n": 4}, "4 poses; eight to ten", "usable"),
    ],
)
def test_what_is_weak_lowers_the_verdict(change, said, verdict):
    c = calibration("pair", **{"n": 12, "sigma": 0.02, **change})
    e = evidence(c, held(c, px=change.get("corner_px", 0.01)), S)
    assert any(said in w for w in e.weak), e.weak
    assert e.verdict == verdict


@pytest.mark.parametrize(
    ("change", "said", "verdict"),
    [
        ({"mm": 0.3}, "measured 300 um off", "usable"),
        ({"mm": 1.5}, "um off", "do not use"),
        ({"px": 0.1}, "times worse than those used", "usable"),
        ({"scale": 1.01}, "1.00 % off in size", "usable"),
    ],
)
def test_boards_that_were_not_used_judge(change, said, verdict):
    c = calibration("pair", n=12, sigma=0.02)
    e = evidence(c, held(c, **change), S)
    assert any(said in w for w in e.weak), e.weak
    assert e.verdict == verdict


def test_a_lens_model_that_does_not_fit_is_no_good_calibration():
    def bias(device, uv):
        return 0.05 * ((uv - 300) / 300) ** 2 if device == "camera1" else np.zeros_like(uv)

    c = calibration("pair", n=12, sigma=0.02, bias=bias)
    e = evidence(c, held(c, px=0.05), S)
    assert e.verdict == "usable"
    assert any("camera1: corners residuals repeat" in w for w in e.weak)


def test_one_camera_and_nothing_held_out():
    c = calibration("single", n=10, sigma=0.02, volume=False)
    c = dataclasses.replace(c, left_out=(LeftOut("pose77", None, None, "it moved"),))
    e = evidence(c, (), S)
    assert any("held out" in w for w in e.weak)
    assert any("pose77" in w for w in e.weak)
    assert e.prediction.views_um == {}
    assert next(p for p in e.poses if p.pose == "pose77").notes == ("the whole pose left out: it moved",)


def test_tight_pairs_are_listed():
    c = calibration("single")
    C = c.covariance.copy()
    a, b = np.sqrt(C[0, 0]), np.sqrt(C[2, 2])
    C[0, 2] = C[2, 0] = -0.99 * a * b
    found = correlations(dataclasses.replace(c, covariance=C), 0.95)
    assert found == (("projector fx", "projector cx", pytest.approx(-0.99)),)


def test_a_calibration_without_residuals_of_one_kind():
    c = calibration("single", sigma=0.02)
    bare = tuple(dataclasses.replace(r, sample=np.zeros((0, 2)), sample_uv=np.zeros((0, 2))) for r in c.residuals)
    e = evidence(dataclasses.replace(c, residuals=bare), (), S)
    assert e.verdict == "do not use"
    assert [f.device for f in e.fields] == ["camera1"]
