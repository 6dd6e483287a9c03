"""What one camera sees of the board: corners, white squares, samples, numbering; judged by OpenCV's projection."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fringescope import pipeline, store
from fringescope.calibrate import agree, see
from fringescope.calibrate.lattice import fit_map
from fringescope.calibrate.picture import equalise
from fringescope.errors import CalibrationError
from fringescope.kernels import corners as k
from fringescope.settings import BoardSettings, Settings
from fringescope.types import Board, Decoded, PixelFormat, Reason, Role, Sighting, ViewInput
from tests.board_pictures import Device, Picture, Scene, mirrored, take
from tests.reference import corners as slow

ARUCO = cv2.aruco
MARKERS = ARUCO.CharucoBoard((10, 7), 6.0, 4.4, ARUCO.getPredefinedDictionary(ARUCO.DICT_4X4_100))
CHARUCO = Scene(markers=MARKERS, size=(640, 480), focal=3800)


def board(scene: Scene, *markers: Any) -> Board:
    return Board((scene.inner[0] + 1, scene.inner[1] + 1), scene.square, *markers)


def look(scene: Scene, **kw: Any) -> tuple[Picture, Sighting]:
    p = take(scene)
    return p, see(p.decoded, p.image, p.plan, kw.get("board") or board(scene), "pose00", BoardSettings())


def corner_error(p: Picture, s: Sighting) -> np.ndarray[Any, Any]:
    return s.corner_px - p.camera.project(p.world(s.corner))


def rms(a: Any) -> float:
    return float(np.sqrt(np.nanmean(np.asarray(a) ** 2)))


def sample_error(p: Picture, s: Sighting) -> np.ndarray[Any, Any]:
    """Misses (k, d) of the samples in projector-plane units: the pixel's ray on the true board plane, by OpenCV."""
    uv = landed(p.camera, p.projector, p.board, s.sample_px)
    length = 2 * np.pi * np.hypot(*s.directions.T)
    return np.asarray((2 * np.pi * uv @ s.directions.T - s.sample_phase) / length)


def landed(camera: Device, projector: Device, pose: Any, px: Any) -> np.ndarray[Any, Any]:
    n = cv2.undistortPoints(
        px.reshape(-1, 1, 2).astype(float), camera.K, camera.distortion, None, None, None, (3, 60, 1e-14)
    )[:, 0]
    d = np.column_stack([n, np.ones(len(n))]) @ camera.R
    origin = -camera.R.T @ camera.t
    R, t = pose
    s = ((t - origin) @ R[:, 2]) / (d @ R[:, 2])
    return projector.project(origin + d * s[:, None])


def dirty(p: Picture, where: Any, value: Any, reason: Reason = Reason.LOW_MODULATION) -> Picture:
    """The same with something else in front of the board."""
    image = p.image.copy()
    image[where] = value
    reasons = p.decoded.reasons.copy()
    reasons[where] |= np.uint16(reason)
    return replace(p, image=image, decoded=replace(p.decoded, reasons=reasons))


def seen(p: Picture, b: Board) -> Sighting:
    return see(p.decoded, p.image, p.plan, b, "pose00", BoardSettings())


# ------------------------------------------------------------------------------------------------------------- kernels


@given(st.floats(-2, 2), st.floats(0, math.pi / 2), st.floats(0.15, 2))
@settings(max_examples=30)
def test_edge_profile_is_a_step_seen_by_a_square_pixel(d: float, angle: float, blur: float) -> None:
    halves = 0.5 * max(math.cos(angle), 0.01), 0.5 * max(math.sin(angle), 0.01)
    value, first, second = k.edge_profile(d, *halves, blur)
    assert value == pytest.approx(slow.edge_profile(d, *halves, blur), abs=2e-4)
    e = 1e-4
    up, down = (k.edge_profile(d + x, *halves, blur) for x in (e, -e))
    assert first == pytest.approx((up[0] - down[0]) / (2 * e), abs=1e-5)
    assert second == pytest.approx((up[1] - down[1]) / (2 * e), abs=1e-4)


def test_ring_test_is_its_slow_twin(rng: np.random.Generator) -> None:
    p = take(Scene(noise=2.0))
    place = np.vstack([p.camera.project(p.world(np.array([(i, 2) for i in range(9)]))), rng.uniform(20, 300, (60, 2))])
    out = np.empty((len(place), 4))
    k.ring_tests(p.image, place, 5.0, out)
    for row, (x, y) in zip(out, place, strict=True):
        a, b, contrast, symmetry = slow.ring_test(p.image.astype(float), x, y, 5.0)
        assert row[2:] == pytest.approx([contrast, symmetry], abs=1e-3)
        if contrast:
            for mine, theirs in ((row[0], a), (row[1], b)):
                assert abs((mine - theirs + math.pi / 2) % math.pi - math.pi / 2) < 1e-3
    assert (out[:9, 3] > 0.8).all()


def test_fitted_corners_are_those_of_a_slow_fit_and_of_the_truth() -> None:
    scene = Scene(blur=0.6, noise=0.3)
    p = take(scene)
    index = np.array([(2, 2), (5, 3), (7, 1)])
    truth = p.camera.project(p.world(index))
    step1, step2 = (p.camera.project(p.world(index + d)) - truth for d in np.eye(2))
    out = np.empty((3, 11))
    signs = np.where(index.sum(1) % 2 == 0, 1.0, -1.0)
    start = truth + np.array([(0.6, -0.7), (-0.8, 0.3), (0.2, 0.9)])
    weights = np.ones((2, 2))
    k.fit_corners(p.image, weights, start, step1, step2, np.zeros((3, 2)), 0.8, 0.4, 0.4, signs, 60.0, out)
    for n in range(3):
        twin = slow.fit_corner(p.image.astype(float), truth[n], step1[n], step2[n], 0.4)
        assert out[n, :2] == pytest.approx(twin, abs=2e-3)
        assert out[n, :2] == pytest.approx(truth[n], abs=0.012)
        assert out[n, 10] == signs[n]
    k.fit_corners(p.image, weights, start * 0 + 3, step1, step2, np.zeros((3, 2)), 0.8, 0.4, 0.4, signs, 60.0, out)
    assert np.isnan(out).all(), "a window that leaves the picture has no corner"


# --------------------------------------------------------------------------------------------------------- one picture

WAYS: dict[str, tuple[dict[str, Any], float]] = {
    "plain": ({}, 0.004),
    "mosaic": ({"gains": (0.5, 1, 1, 0.7)}, 0.004),
    "mosaic under light without red": ({"gains": (0.02, 1, 1, 0.9)}, 0.006),
    "wide lens": ({"focal": 520, "camera_at": (10, 5, -90), "distortion": (-0.3, 0.1, 0, 0, 0)}, 0.006),
    "tilted by 60 degrees": ({"tilt": (1.0, 0.3, 0.2)}, 0.012),
    "grey squares": ({"dark": 0.6, "noise": 0.5}, 0.006),
    "noisy": ({"noise": 8.0}, 0.03),
    "dark": ({"light": 6.0}, 0.015),
    "vignetted": ({"falloff": 0.9}, 0.004),
    "upside down": ({"roll": 3.0}, 0.004),
    "soft": ({"blur": 3.0}, 0.006),
    "twelve bits": ({"light": 2500.0, "noise": 4.0, "fmt": PixelFormat.MONO12}, 0.004),
    "many small squares": ({"inner": (25, 17), "square": 2.0, "size": (540, 400), "focal": 3200}, 0.012),
}


@pytest.mark.parametrize("way", WAYS)
def test_a_board_in_full_view(way: str) -> None:
    scene, limit = Scene(**WAYS[way][0]), WAYS[way][1]
    p, s = look(scene)
    n, m = scene.inner
    assert len(s.corner) >= 0.96 * n * m
    assert rms(corner_error(p, s)) < limit
    assert rms(corner_error(p, s) / s.corner_sigma[:, None]) < 3.0
    assert len(s.square) >= 0.4 * (n - 1) * (m - 1)
    assert (s.square.sum(1) % 2 == 1).all(), "square (0, 0) is black"
    assert rms(s.square_px - p.camera.project(p.world(s.square - 0.5))) < max(limit, 0.01)
    off = s.square_uv - p.projector.project(p.world(s.square - 0.5))
    assert 0.4 < rms(off / s.square_sigma) < 1.6
    assert 1000 < len(s.sample_px) <= BoardSettings().max_samples
    pull = sample_error(p, s) * 2 * np.pi * np.hypot(*s.directions.T) / s.sample_sigma
    assert 0.8 < rms(pull) < 1.2
    assert np.abs(np.nanmean(sample_error(p, s), 0)).max() < 6 * 0.2 / math.sqrt(len(s.sample_px))


def test_centres_are_not_those_of_the_four_corners_under_tilt() -> None:
    p, s = look(Scene(tilt=(0.9, 0.5, 0.3), focal=700, camera_at=(10, 5, -110), distortion=(-0.25, 0, 0, 0, 0)))
    at = {tuple(c): x for c, x in zip(s.corner.tolist(), s.corner_px, strict=True)}
    mean = [np.mean([at[c - i, r - j] for i in (0, 1) for j in (0, 1)], 0) for c, r in s.square.tolist()]
    truth = p.camera.project(p.world(s.square - 0.5))
    assert rms(np.array(mean) - truth) > 0.05
    assert rms(s.square_px - truth) < 0.02


def test_clutter_does_not_disturb(rng: np.random.Generator) -> None:
    scene = Scene(size=(480, 360))
    p = take(scene)
    board_there = cv2.morphologyEx((p.image > 60).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((45, 45))) > 0
    noise = cv2.GaussianBlur(rng.normal(size=p.image.shape), (0, 0), 3) * 400 + 60
    s = seen(replace(p, image=np.where(board_there, p.image, np.clip(noise, 0, 200)).astype(np.float32)), board(scene))
    assert len(s.corner) == 54
    assert rms(corner_error(p, s)) < 0.004


@pytest.mark.parametrize("thing", ["bar across", "hand", "shadow"])
def test_hidden_parts_go_and_the_rest_keeps_its_numbers(thing: str) -> None:
    scene = Scene(size=(480, 360))
    p = take(scene)
    y, x = np.mgrid[:360, :480]
    where = {
        "bar across": (x > 250) & (x < 300) & (y > 100) & (y < 330),
        "hand": (x - 330) ** 2 + (y - 230) ** 2 < 70**2,
        "shadow": x + 0.3 * y < 200,
    }[thing]
    value = p.image[where] * 0.05 if thing == "shadow" else 40.0
    s = seen(dirty(p, where, value), board(scene))
    assert 35 <= len(s.corner) < 54
    assert np.abs(corner_error(p, s)).max() < 0.03
    assert any("left out" in w for w in s.words)
    hidden = where[s.sample_px[:, 1].astype(int), s.sample_px[:, 0].astype(int)]
    assert not hidden.any()


def test_a_board_that_leaves_the_picture_is_numbered_by_the_ends_in_view() -> None:
    p, s = look(Scene(shift=(22.0, 10.0, 0.0)))
    assert 25 < len(s.corner) < 54
    assert np.abs(corner_error(p, s)).max() < 0.02


def test_saturated_squares_are_left_out_and_said() -> None:
    p = take(Scene())
    glare = np.zeros(p.image.shape, bool)
    x, y = p.camera.project(p.world(np.array([(3.5, 2.5)])))[0].astype(int)
    glare[y - 12 : y + 13, x - 12 : x + 13] = True
    s = seen(dirty(p, glare, p.image[glare], Reason.SATURATED), board(Scene()))
    assert any("saturated" in w for w in s.words)
    px = s.sample_px.astype(int)
    assert not glare[px[:, 1], px[:, 0]].any()
    with pytest.raises(CalibrationError, match=r"pose00/camera1: the board is saturated .* expose it less"):
        seen(dirty(p, p.image > 0, p.image[p.image > 0], Reason.SATURATED), board(Scene()))


def test_orders_whole_cycles_off_are_repaired(rng: np.random.Generator) -> None:
    p = take(Scene())
    first, second = p.decoded.directions
    phase = first.phase.copy()
    phase[rng.random(phase.shape) < 0.15] += np.float32(2 * np.pi)
    phase[120:160, 150:230] -= np.float32(4 * np.pi)
    bad = replace(p.decoded, directions=(replace(first, phase=phase), second))
    s = see(bad, p.image, p.plan, board(Scene()), "pose00", BoardSettings())
    assert any("repaired" in w for w in s.words)
    assert np.nanmax(np.abs(sample_error(p, s))) < 1.5
    assert len(s.sample_px) > 3500


def test_one_direction_gives_samples_and_no_coordinates() -> None:
    p, s = look(Scene(directions=((1 / 36, 0.0),)))
    assert s.square.shape == s.square_uv.shape == (0, 2)
    assert s.sample_phase.shape[1] == 1
    assert rms(sample_error(p, s)) < 0.3


def test_any_directions_give_coordinates() -> None:
    p, s = look(Scene(directions=((0.02, 0.01), (-0.015, 0.02), (0.01, 0.028))))
    assert s.sample_phase.shape[1] == 3
    off = s.square_uv - p.projector.project(p.world(s.square - 0.5))
    assert 0.4 < rms(off / s.square_sigma) < 1.6


def test_equalise_moves_nothing(rng: np.random.Generator) -> None:
    flat = cv2.GaussianBlur(rng.uniform(20, 200, (120, 160)), (0, 0), 25).astype(np.float32)
    mosaic = flat.copy()
    for (i, j), (gain, shift) in {(0, 0): (0.4, 3), (0, 1): (1.0, 0), (1, 0): (0.98, 1), (1, 1): (0.7, -2)}.items():
        mosaic[i::2, j::2] = mosaic[i::2, j::2] * gain + shift
    out, weights = equalise(mosaic, PixelFormat.BAYER_RG8)
    gain, shift = np.polyfit(flat.ravel(), out.ravel(), 1)
    assert rms(out - gain * flat - shift) < 0.05
    assert weights[0, 0] == pytest.approx(0.4, abs=0.02)


# ------------------------------------------------------------------------------------------------------------ bad input


@pytest.mark.parametrize(
    ("squares", "message"),
    [
        ((8, 7), "the picture shows 9 x 6 inner corners, board.json says 7 x 6; count them and "
         "correct board.json, or show more of the board if a part of it is hidden"),
        ((13, 7), "the picture shows 9 x 6 inner corners, board.json says 12 x 6"),
        ((10, 6), "the picture shows 9 x 6 inner corners, board.json says 9 x 5"),
    ],
)
def test_another_board_than_described(squares: tuple[int, int], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        look(Scene(), board=Board(squares, 6.0))


def test_rows_and_columns_swapped_is_the_same_plain_board() -> None:
    p, s = look(Scene(), board=Board((7, 10), 6.0))
    assert s.corner.max(0).tolist() == [5, 8]
    ij = s.corner.astype(float)
    assert rms(fit_map(ij, p.camera.project(p.world(np.column_stack([ij[:, 1], 5 - ij[:, 0]]))))[1]) < 1e-3 or rms(
        fit_map(ij, s.corner_px)[1]
    ) < 0.01


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"blur": 8.0}, "blurred: edges .* px"), ({"mirrored": True}, "mirrored"), ({"light": 0.0}, "no board found")],
)
def test_pictures_that_cannot_be_used(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(CalibrationError, match=f"pose00/camera1: .*{message}") as e:
        look(Scene(**changes))
    assert "\n" not in str(e.value)


def test_noise_is_no_board(rng: np.random.Generator) -> None:
    p = take(Scene())
    noise = cv2.GaussianBlur(rng.normal(size=p.image.shape), (0, 0), 1.5) * 90 + 100
    with pytest.raises(CalibrationError, match="no board found"):
        seen(replace(p, image=noise.astype(np.float32)), board(Scene()))


# -------------------------------------------------------------------------------------------------------------- ChArUco


@pytest.mark.parametrize("changes", [{}, {"roll": 2.0}, {"roll": 1.6, "shift": (15.0, 12.0, 0.0)}])
def test_markers_tell_the_numbering(changes: dict[str, Any]) -> None:
    scene = CHARUCO.but(**changes)
    p, s = look(scene, board=board(scene, 4.4, "DICT_4X4_100"))
    assert len(s.corner) >= 34
    assert rms(corner_error(p, s)) < 0.004
    assert rms(sample_error(p, s) * 2 * np.pi / 36 / s.sample_sigma) == pytest.approx(1, abs=0.2)


def test_squares_too_small_for_a_rim_of_a_marker_say_so() -> None:
    half = CHARUCO.but(size=(220, 170), focal=1050, blur=0.4)
    _, s = look(half, board=board(half, 4.4, "DICT_4X4_100"))
    assert len(s.sample_px) == 0
    found = re.search(r"too small in the picture \((\d+) pixels wide; needed about (\d+)", " ".join(s.words))
    assert found is not None
    wide, needed = map(int, found.groups())
    assert wide == pytest.approx(np.median(np.linalg.norm(np.diff(s.corner_px[:8], axis=0), axis=1)), rel=0.15)
    enough = half.but(size=(640, 480), focal=1050 * 1.1 * needed / wide)
    assert len(look(enough, board=board(enough, 4.4, "DICT_4X4_100"))[1].sample_px) > 500


def test_markers_before_opencv_4_6() -> None:
    old = ARUCO.CharucoBoard((9, 6), 6.0, 4.4, ARUCO.getPredefinedDictionary(ARUCO.DICT_4X4_100))
    old.setLegacyPattern(True)
    scene = CHARUCO.but(markers=old, inner=(8, 5))
    p, s = look(scene, board=board(scene, 4.4, "DICT_4X4_100"))
    assert rms(corner_error(p, s)) < 0.004


def test_markers_that_do_not_fit() -> None:
    p = take(CHARUCO)
    with pytest.raises(CalibrationError, match=r"markers are of DICT_4X4_50, board\.json says DICT_5X5_100"):
        seen(p, board(CHARUCO, 4.4, "DICT_5X5_100"))
    with pytest.raises(CalibrationError, match="markers contradict each other"):
        seen(p, Board((7, 10), 6.0, 4.4, "DICT_4X4_100"))
    with pytest.raises(CalibrationError, match=r"hold something dark \(markers\?\)"):
        seen(p, board(CHARUCO))
    with pytest.raises(CalibrationError, match="without readable markers of DICT_4X4_100"):
        look(Scene(), board=board(Scene(), 4.4, "DICT_4X4_100"))
    flipped = replace(p, image=np.ascontiguousarray(p.image[:, ::-1]), decoded=mirrored(p.decoded))
    with pytest.raises(CalibrationError, match="markers are mirrored"):
        seen(flipped, board(CHARUCO, 4.4, "DICT_4X4_100"))


# ---------------------------------------------------------------------------------------------------- cameras together

AROUND = (((40, 10, -430), 0.0), ((-150, 60, -400), 2.0), ((20, 180, -400), 3.2), ((160, -40, -400), -1.4))


@pytest.mark.parametrize("inner", [(9, 6), (13, 9), (7, 7), (4, 4)])
def test_cameras_agree_on_the_numbering(inner: tuple[int, int]) -> None:
    scene = Scene(inner=inner, square=54.0 / max(inner), size=(440, 360))
    pictures = [take(scene.but(camera_at=at, roll=roll, camera=f"camera{n}")) for n, (at, roll) in enumerate(AROUND)]
    cut = np.zeros(pictures[3].image.shape, bool)
    cut[:, 240:] = True
    pictures[3] = dirty(pictures[3], cut, 0.0) if max(inner) > 5 else pictures[3]
    sightings = agree([seen(p, board(scene)) for p in pictures], board(scene))
    every = np.array([(i, j) for j in range(inner[1]) for i in range(inner[0])])
    names: dict[tuple[int, ...], int] = {}
    for p, s in zip(pictures, sightings, strict=True):
        truth = p.camera.project(p.world(every))
        for c, x in zip(s.corner.tolist(), s.corner_px, strict=True):
            real = int(np.argmin(((truth - x) ** 2).sum(1)))
            assert names.setdefault(tuple(c), real) == real
        white = p.camera.project(p.world(every - 0.5))
        for x in s.square_px:
            assert np.abs(white - x).max(1).min() < 0.05
        assert not any("fit" in w and "number" in w for w in s.words)


def test_pictures_of_another_pose_do_not_agree() -> None:
    one, other = look(Scene())[1], look(Scene(shift=(3.0, 0.0, 0.0), camera="camera2"))[1]
    kept = agree([one, other], board(Scene()))
    assert any("numbering does not agree" in w for s in kept for w in s.words)


# ---------------------------------------------------------------------------------------------------- rendered and real


def decode(view: ViewInput) -> tuple[Decoded, np.ndarray[Any, Any]]:
    """A view decoded, and the mean of its fringe frames."""
    frames = list(view.frames)
    steps = [f.astype(np.float64) for key, f in frames if key.role is Role.STEP]
    return pipeline.decode_view(replace(view, frames=frames), Settings()), np.mean(steps, axis=0).astype(np.float32)


def test_rendered_corners_to_a_few_thousandths_of_a_pixel(shared: Path) -> None:
    root = shared / "data" / "rendered-small"
    rig, poses = (json.loads((root / "truth" / f"{n}.json").read_text()) for n in ("rig", "poses"))

    def device(d: dict[str, Any]) -> Device:
        return Device(*(np.array(d[key]) for key in ("K", "distortion", "R", "t")))

    for pose in (0, 3, 7):
        T = np.array(poses[pose]["R"]), np.array(poses[pose]["t"])
        views = store.view_inputs(store.read_capture(root / "calibration" / f"pose0{pose}"))
        for n, view in list(enumerate(views))[pose % 2 :: 2]:
            decoded, image = decode(view)
            s = see(decoded, image, view.plan, Board((12, 9), 5.0), f"pose0{pose}", BoardSettings())
            p = Picture(image, decoded, view.plan, device(rig["cameras"][n]), device(rig["projector"]), T, (11, 8), 5.0)
            assert len(s.corner) >= 87
            assert rms(corner_error(p, s)) < 0.006
            off = s.square_uv - p.projector.project(p.world(s.square - 0.5))
            assert 0.6 < rms(off / s.square_sigma) < 1.5
            assert np.abs(np.nanmean(sample_error(p, s), 0)).max() < 0.005
            assert rms(sample_error(p, s)) < 0.07


def test_real_board_is_seen_whole_and_smooth(shared: Path) -> None:
    for pose in (3,):
        view = store.view_inputs(store.read_capture(shared / "data" / "slstudio" / "board" / f"pose0{pose}"))[0]
        decoded, image = decode(view)
        s = see(decoded, image, view.plan, Board((14, 10), 10.0), f"pose0{pose}", BoardSettings())
        assert len(s.corner) == 117
        assert len(s.square) >= 46
        assert rms(fit_map(s.corner.astype(float), s.corner_px)[1]) < 0.3
        assert rms(fit_map(s.square - 0.5, s.square_uv)[1]) < 0.8
