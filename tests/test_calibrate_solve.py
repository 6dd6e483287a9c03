"""Sightings to a rig: truth from rigs made here, projected by OpenCV; rays met with the board by plain geometry."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fringescope import calibrate, geometry, pipeline, store
from fringescope.calibrate import adjust as stage
from fringescope.calibrate import initial, outcome, problem
from fringescope.calibrate.holdout import state_of
from fringescope.calibrate.solve import make_problem
from fringescope.errors import CalibrationError, UsageError
from fringescope.kernels import adjust as kernel
from fringescope.settings import CalibrateSettings, Settings
from fringescope.types import Board, Camera, Layout, Lens, Pose, Projector, Rig, Sighting
from tests.reference import adjust as reference

BOARD = Board((12, 9), 5.0)
USUAL = CalibrateSettings(lens="k1 k2 p1 p2", projector_lens="k1 k2 p1 p2")
STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 300, 1e-15)

# ---------------------------------------------------------------------------------------------------- a made-up world


def look_at(at: np.ndarray, target: np.ndarray, roll: float, off: np.ndarray | None = None) -> Pose:
    """A device at a place; the ray `off` (ideal x, y) meets the target, by default the axis."""
    z = (target - at) / np.linalg.norm(target - at)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(z, x), z])
    R = cv2.Rodrigues(np.array([0, 0, roll]))[0] @ R
    if off is not None:
        ray = np.array([*off, 1.0]) / np.linalg.norm([*off, 1.0])
        turn = np.cross([0, 0, 1.0], ray)
        R = cv2.Rodrigues(turn / np.linalg.norm(turn) * np.arccos(ray[2]))[0] @ R
    return Pose(R, -R @ at)


def matrix(f: float, fy: float, c: tuple[float, float]) -> np.ndarray:
    return np.array([[f, 0, c[0]], [0, fy, c[1]], [0, 0, 1]])


def make_rig(
    rng: np.random.Generator, cameras: int = 3, focal: float = 3700.0, size: tuple[int, int] = (684, 456),
    layout: Layout = Layout.GRID, offset: float = 0.0, rolls: tuple[float, ...] = (), projector_focal: float = 9120.0,
    baseline: float = 320.0, height: float = 500.0,
) -> Rig:  # fmt: skip
    W, H = (1824, 1140) if layout is Layout.DIAMOND else (912, 1140)
    fx = projector_focal * (1 if layout is Layout.DIAMOND else 0.5)
    K = matrix(fx, projector_focal * 1.0003, ((W - 1) / 2 + 3, (H - 1) / 2 + offset))
    at = np.array([0.9, -1.9, height])
    off = np.array([0.0, -offset / K[1, 1]]) if offset else None
    lens = Lens(W, H, K, np.array([-0.05, 0.11, 3e-5, 4e-4, 0]))
    projector = Projector(912, 1140, layout, lens, look_at(at, np.array([0.4, -0.3, 0]), 0.002, off))
    out = []
    for n in range(cameras):
        a = np.deg2rad(90 + 360 * n / cameras)
        at = np.array([baseline * np.cos(a), baseline * np.sin(a), height - 3]) + rng.uniform(-3, 3, 3)
        roll = rng.uniform(-0.01, 0.01) + (rolls[n] if rolls else 0)
        pose = look_at(at, np.array([*rng.uniform(-1.5, 1.5, 2), 0]), roll)
        f = focal * (1 + rng.uniform(-0.004, 0.004))
        corner = (np.hypot(*size) / 2 / f) ** 2
        d = np.array([-0.003 / corner, 0.0004 / corner**2, *rng.uniform(-2e-4, 2e-4, 2) * 0.012 / corner, 0])
        c = (size[0] - 1) / 2 + rng.uniform(-3, 3), (size[1] - 1) / 2 + rng.uniform(-3, 3)
        out.append(Camera(f"camera{n + 1}", Lens(*size, matrix(f, 1.0001 * f, c), d), pose))
    return Rig(projector, tuple(out))


def make_poses(rng: np.random.Generator, n: int = 8, lean: tuple[float, float] = (0.12, 0.43)) -> list[Pose]:
    middle = np.array([*problem.board_frame(BOARD)[:2], 0])
    out = []
    for p in range(n):
        tilt = 0.03 if p == 0 else rng.uniform(*lean)
        towards = 2.4 * p + rng.uniform(-0.4, 0.4)
        axis = tilt * np.array([np.cos(towards), np.sin(towards), 0])
        R = cv2.Rodrigues(axis)[0] @ cv2.Rodrigues(np.array([0, 0, rng.uniform(-0.4, 0.4)]))[0] @ np.diag([1.0, -1, -1])
        out.append(Pose(R, np.array([*rng.uniform(-6, 6, 2), rng.uniform(-12, 12)]) - R @ middle))
    return out


def seen_by(device: Camera | Projector, points: np.ndarray) -> np.ndarray:
    q, _ = cv2.projectPoints(
        points.reshape(-1, 1, 3), cv2.Rodrigues(device.pose.R)[0], device.pose.t, device.lens.K, device.lens.distortion
    )
    return q.reshape(-1, 2)


@dataclass
class World:
    rig: Rig
    poses: list[Pose]
    rng: np.random.Generator
    noise: float = 0.0  #: of corners in px and of samples in plane units
    shared: float = 0.0  #: error of the phase that all of a white square share
    samples: int = 400
    rows: int = 8  #: rows of corners that are seen

    def sighting(self, p: int, camera: Camera, name: str | None = None) -> Sighting:
        T, lens, rng = self.poses[p], camera.lens, self.rng
        corner = np.array([(i, j) for j in range(self.rows) for i in range(11)], dtype=np.int32)
        px = seen_by(camera, BOARD.corner_mm(corner) @ T.R.T + T.t)
        inside = ((px > 2) & (px < np.array([lens.width, lens.height]) - 3)).all(axis=1)
        corner, px = corner[inside], px[inside] + self.noise * rng.standard_normal((inside.sum(), 2))
        square = np.array([(c, r) for r in range(self.rows + 1) for c in range(12) if (c + r) % 2], dtype=np.int32)
        middle = BOARD.centre_mm(square)
        spx = seen_by(camera, middle @ T.R.T + T.t)
        inside = ((spx > 5) & (spx < np.array([lens.width, lens.height]) - 6)).all(axis=1)
        square, middle, spx = square[inside], middle[inside], spx[inside]
        uv = seen_by(self.rig.projector, middle @ T.R.T + T.t) + self.noise / 5 * rng.standard_normal((len(square), 2))
        each = max(self.samples // max(len(square), 1), 4)
        spot = np.repeat(middle, each, axis=0)
        spot[:, :2] += rng.uniform(-1.5, 1.5, (len(spot), 2))
        at = np.round(seen_by(camera, spot @ T.R.T + T.t))
        ideal = cv2.undistortPoints(at[:, None], lens.K, lens.distortion, None, None, None, STOP).reshape(-1, 2)
        ray = np.column_stack([ideal, np.ones(len(at))]) @ camera.pose.R
        o, n = -camera.pose.R.T @ camera.pose.t, T.R[:, 2]
        points = o + ray * ((n @ (T.t - o)) / (ray @ n))[:, None]
        g = np.array([[1 / 36, 0.002], [0.001, 1 / 40]])
        size = np.linalg.norm(g, axis=1)
        units = seen_by(self.rig.projector, points) @ (g / size[:, None]).T
        units += self.noise * rng.standard_normal(units.shape)
        units += np.repeat(self.shared * rng.standard_normal((len(square), 2)), each, axis=0)
        return Sighting(
            f"pose{p:02d}", name or camera.name, (lens.width, lens.height), corner, px, np.full(len(px), 0.03), square,
            spx, uv, np.full(uv.shape, 0.01), g, at, 2 * np.pi * units * size,
            np.full(units.shape, 0.02) * 2 * np.pi * size,
        )  # fmt: skip

    def sightings(self) -> list[Sighting]:
        return [self.sighting(p, c) for p in range(len(self.poses)) for c in self.rig.cameras]

    @property
    def sizes(self) -> calibrate.Sizes:
        p = self.rig.projector
        cameras = {c.name: (c.lens.width, c.lens.height) for c in self.rig.cameras}
        return calibrate.Sizes((p.width, p.height), p.layout, cameras)


def world(
    seed: int = 1, poses: int = 8, noise: float = 0.0, shared: float = 0.0, samples: int = 400, **rig: object
) -> World:
    rng = np.random.default_rng([seed, 99])
    return World(make_rig(rng, **rig), make_poses(rng, poses), rng, noise, shared, samples)  # type: ignore[arg-type]


def apart(rig: Rig, true: Rig, half: tuple[float, float, float] = (25.0, 18.0, 8.0)) -> float:
    """Root mean square distance, mm, of points triangulated by `rig` from what `true` images, moved rigidly."""
    grid = np.stack(np.meshgrid(*[np.linspace(-h, h, 5) for h in half]), -1).reshape(-1, 3)
    found, there = [], []
    for c in true.cameras:
        px, uv = seen_by(c, grid), seen_by(true.projector, grid)
        o, d = geometry.world_rays(rig.camera(c.name), px)
        o2, d2 = geometry.world_rays(rig.projector, uv)
        w, b = o2 - o, (d * d2).sum(-1)
        s = ((d @ w) - b * (d2 @ w)) / (1 - b * b)
        found.append(o + s[:, None] * d)
        there.append(grid)
    A, B = np.concatenate(there), np.concatenate(found)
    a, b = A - A.mean(0), B - B.mean(0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    R = Vt.T @ np.diag([1, 1, np.linalg.det(Vt.T @ U.T)]) @ U.T
    return float(np.sqrt(np.mean(np.sum((a @ R.T - b) ** 2, axis=1))))


# ---------------------------------------------------------------------------------------------------------- kernels


def some_problem() -> tuple[problem.Problem, problem.State]:
    w = world(3, poses=3, cameras=2, samples=60)
    p = make_problem(w.sightings(), BOARD, w.sizes, USUAL)
    boards = {f"pose{i:02d}": T for i, T in enumerate(w.poses)}
    state = state_of(w.rig, boards, p.poses, np.array([0.1, -0.05, 0.07, 0.001, 0.002]))
    return p, state


def test_kernels_against_slow_twins() -> None:
    p, state = some_problem()
    for b in (p.blocks[2], p.blocks[3]):
        e = problem.evaluate(p, state, b)
        where = state.board_R[b.pose], state.board_t[b.pose], state.R[b.device], state.t[b.device]
        for i in range(0, len(b.place), 7):
            if b.points:
                slow = reference.point_residual(
                    b.xy[i], b.place[i], state.shape, p.frame, *where, state.lens_ten(b.device)
                )
            else:
                lenses = state.lens_ten(b.device), state.lens_ten(0)
                slow = reference.sample_residual(b.place[i], b.cycles[i], b.g, state.shape, p.frame, *where, *lenses)
            assert e.residual[i] == pytest.approx(slow, abs=2e-7)


def test_derivatives_against_differences() -> None:
    p, state = some_problem()
    centres = problem.centre_block(world(3, poses=3, cameras=2, samples=60).sightings()[0], BOARD, 1, 0, 0)
    assert centres is not None
    for b in (p.blocks[2], p.blocks[3], centres):
        e = problem.evaluate(p, state, b)
        for k, column in enumerate(e.columns):
            lens = column < p.shape_at and column % problem.DEVICE < 9
            h = max(abs(problem.value_at(p, state, column)) * 1e-6, 1e-4) if lens else 1e-5
            step = np.zeros(p.n_full)
            step[column] = h
            plus, minus = (problem.evaluate(p, state.moved(s * step), b, False).residual for s in (1, -1))
            slope = (plus - minus) / (2 * h)
            scale = max(np.abs(slope).max(), 1e-3)
            assert np.abs(slope - e.J[..., k]).max() < 2e-5 * scale, (b.kind, k)


def test_a_point_behind_the_device_has_no_residual() -> None:
    p, state = some_problem()
    b = p.blocks[0]
    away = replace(state, board_t=-state.board_t)
    assert np.isnan(problem.evaluate(p, away, b).residual).all()
    assert kernel.point_rows.__doc__


# ------------------------------------------------------------------------------------------------------ exactness


@pytest.mark.parametrize(
    ("seed", "rig"),
    [
        (1, {}),
        (2, {"cameras": 1, "layout": Layout.DIAMOND}),
        pytest.param(
            3,
            {"cameras": 5, "layout": Layout.DIAMOND, "focal": 13000.0, "size": (2448, 1632)},
            marks=pytest.mark.verify,
        ),
        (4, {"offset": 600.0, "cameras": 2}),
        (5, {"rolls": (np.pi / 2, np.pi), "cameras": 2}),
        (6, {"focal": 1200.0, "size": (640, 512), "projector_focal": 4000.0, "cameras": 2, "baseline": 250.0}),
    ],
    ids=["paper", "one camera", "five long lenses", "shifted projector lens", "turned cameras", "short lenses"],
)  # fmt: skip
def test_exact_without_noise(seed: int, rig: dict[str, object]) -> None:
    w = world(seed, **rig)
    found = calibrate.solve(w.sightings(), BOARD, w.sizes, USUAL)
    assert not found.left_out
    assert found.figures["corners_used"] == found.figures["corners_detected"]
    for d, true in zip(found.rig.devices, w.rig.devices, strict=True):
        assert pytest.approx(true.lens.K, rel=1e-5, abs=1e-3) == d.lens.K
        T = geometry.compose(d.pose, geometry.inverse(found.rig.projector.pose))
        expected = geometry.compose(true.pose, geometry.inverse(w.rig.projector.pose))
        assert T.t == pytest.approx(expected.t, abs=1e-3)
        assert pytest.approx(expected.R, abs=1e-6) == T.R
    assert apart(found.rig, w.rig) < 1e-6


def test_the_world_frame() -> None:
    w = world(1, cameras=1)
    found = calibrate.solve(w.sightings(), BOARD, w.sizes, USUAL)
    pose = found.rig.projector.pose
    centre = geometry.centre(pose)
    assert centre[:2] == pytest.approx([0, 0], abs=1e-9)
    assert centre[2] > 400
    assert pytest.approx(np.diag([1, -1, -1])) == pose.R
    middle = np.array([*problem.board_frame(BOARD)[:2], 0])
    assert np.mean([geometry.transform(T, middle)[2] for T in found.boards.values()]) == pytest.approx(0, abs=2)
    assert found.rig.volume is not None
    ends = BOARD.corner_mm(np.array([[0, 0], [10, 7]], dtype=np.int32))
    corners = np.concatenate([geometry.transform(T, ends) for T in found.boards.values()])
    assert geometry.inside_volume(found.rig.volume, corners).all()


# ------------------------------------------------------------------------------------------------------------ noise


def pulls(w: World, s: CalibrateSettings) -> np.ndarray:
    """Errors of lens terms and relative poses over their predicted sigma."""
    found = calibrate.solve(w.sightings(), BOARD, w.sizes, s)
    true = {"projector": w.rig.projector, **{c.name: c for c in w.rig.cameras}}
    ours = {"projector": found.rig.projector, **{c.name: c for c in found.rig.cameras}}
    out = []
    for p in found.parameters:
        if p.fixed or p.device == "board":
            continue
        lens = true[p.device].lens
        values = [lens.K[0, 0], lens.K[1, 1], lens.K[0, 2], lens.K[1, 2], *lens.distortion]
        if p.name in problem.LENS:
            out.append((p.value - values[problem.LENS.index(p.name)]) / p.sigma)
            continue
        T = geometry.compose(true[p.device].pose, geometry.inverse(w.rig.projector.pose))
        T = geometry.compose(T, found.rig.projector.pose)
        pose = ours[p.device].pose
        k = problem.POSE.index(p.name)
        turn = cv2.Rodrigues(pose.R @ T.R.T)[0].ravel()
        out.append((turn[k] if k < 3 else (pose.t - T.t)[k - 3]) / p.sigma)
    return np.array(out)


def test_predicted_sigmas_are_honest() -> None:
    z = np.concatenate([pulls(world(s, noise=0.04, cameras=2), USUAL) for s in range(20, 22)])
    assert (np.abs(z) < 3).mean() > 0.97
    assert 0.7 < np.sqrt(np.mean(z**2)) < 1.3


def test_errors_that_neighbours_share_count_once() -> None:
    worlds = [world(s, noise=0.03, shared=0.06, samples=1200, cameras=1) for s in range(40, 42)]
    z = np.concatenate([pulls(w, USUAL) for w in worlds])
    assert (np.abs(z) < 3).mean() > 0.95
    assert np.sqrt(np.mean(z**2)) < 1.5
    w = worlds[0]
    worth = calibrate.solve(w.sightings(), BOARD, w.sizes, USUAL).figures["sample_worth"]["camera1 projector"]
    assert worth < 0.2


@pytest.mark.verify
def test_predicted_sigmas_are_honest_long() -> None:
    z = [pulls(world(s, noise=0.04), USUAL) for s in range(100, 130)]
    every = np.concatenate(z)
    assert (np.abs(every) < 3).mean() > 0.985
    assert 0.9 < np.sqrt(np.mean(every**2)) < 1.15


def test_noise_is_told_in_units() -> None:
    w = world(7, noise=0.05, cameras=1)
    found = calibrate.solve(w.sightings(), BOARD, w.sizes, USUAL)
    for name, value in found.noise.items():
        assert value == pytest.approx(0.05, rel=0.1), name
    n = sum(not p.fixed for p in found.parameters) + 6 * len(found.boards)
    assert found.covariance.shape == (n, n)
    sigma = [p.sigma for p in found.parameters if not p.fixed]
    assert np.sqrt(np.diag(found.covariance))[: len(sigma)] == pytest.approx(sigma, rel=1e-6)


@pytest.mark.parametrize("how", ["centres", "corners"])
def test_other_ways_to_tie_the_projector(how: str) -> None:
    w = world(8, cameras=1, samples=3000)
    found = calibrate.solve(w.sightings(), BOARD, w.sizes, replace(USUAL, projector=how))
    assert apart(found.rig, w.rig) < (1e-6 if how == "centres" else 2e-3)


# ------------------------------------------------------------------------------------------------- what goes wrong


def test_a_picture_of_another_camera_is_left_out_by_name() -> None:
    w = world(9, noise=0.02)
    seen = w.sightings()
    a, b = w.rig.cameras[:2]
    seen[9], seen[10] = w.sighting(3, b, a.name), w.sighting(3, a, b.name)
    found = calibrate.solve(seen, BOARD, w.sizes, USUAL)
    out = {(n.pose, n.camera) for n in found.left_out if n.points is None}
    assert out == {("pose03", "camera1"), ("pose03", "camera2")}
    assert apart(found.rig, w.rig) < 0.01


def test_wrong_numbering_a_moved_board_and_a_gross_corner() -> None:
    w = world(10, noise=0.02)
    seen = w.sightings()
    seen[4] = replace(seen[4], corner=seen[4].corner + np.array([1, 0], dtype=np.int32))  # pose01/camera2
    lifted = Pose(w.poses[5].R, w.poses[5].t + np.array([0, 0, 1.5]))
    moved = World(w.rig, [lifted], w.rng, 0.02).sighting(0, w.rig.cameras[2])
    seen[17] = replace(seen[17], sample_phase=moved.sample_phase)  # pose05/camera3
    px = seen[0].corner_px.copy()
    px[20] += 6.0
    seen[0] = replace(seen[0], corner_px=px)
    found = calibrate.solve(seen, BOARD, w.sizes, USUAL)
    whole = {(n.pose, n.camera) for n in found.left_out if n.points is None}
    assert whole == {("pose01", "camera2"), ("pose05", "camera3")}
    assert any((n.pose, n.camera) == ("pose00", "camera1") and n.points for n in found.left_out)
    assert np.isnan(found.residuals[0].corner[20]).all()
    assert apart(found.rig, w.rig) < 0.01


def test_boards_partly_hidden_and_sightings_that_miss() -> None:
    w = world(11, noise=0.02)
    seen = [s for n, s in enumerate(w.sightings()) if n not in (1, 2, 6, 10, 11, 15)]
    half = World(w.rig, w.poses, w.rng, 0.02, rows=4)
    seen[3] = half.sighting(int(seen[3].pose[4:]), w.rig.camera(seen[3].camera))
    found = calibrate.solve(seen, BOARD, w.sizes, USUAL)
    assert not [n for n in found.left_out if n.points is None]
    assert apart(found.rig, w.rig) < 0.01


@pytest.mark.verify
def test_cameras_that_share_no_pose_are_tied_by_the_projector() -> None:
    w = world(12, poses=10, cameras=2)
    seen = [s for s in w.sightings() if (int(s.pose[4:]) < 5) == (s.camera == "camera1")]
    found = calibrate.solve(seen, BOARD, w.sizes, USUAL)
    assert apart(found.rig, w.rig) < 1e-5


def test_parallel_poses_are_refused_with_the_motion_that_misses() -> None:
    rng = np.random.default_rng(5)
    w = World(make_rig(rng), make_poses(rng, 6, (0.0, 0.01)), rng, 0.02)
    with pytest.raises(CalibrationError, match=r"all 6 poses are parallel within .* tilt the board by 15 to 30 deg"):
        calibrate.solve(w.sightings(), BOARD, w.sizes, USUAL)


def test_too_few_poses_and_wrong_input() -> None:
    w = world(1, poses=3, cameras=1)
    seen = w.sightings()
    with pytest.raises(CalibrationError, match="2 usable poses of the board; needed 3"):
        calibrate.solve(seen[:2], BOARD, w.sizes, USUAL)
    with pytest.raises(CalibrationError, match="pose00/camera1 was given twice"):
        calibrate.solve([*seen, seen[0]], BOARD, w.sizes, USUAL)
    with pytest.raises(CalibrationError, match="no camera of that name"):
        calibrate.solve([replace(seen[0], camera="left")], BOARD, w.sizes, USUAL)
    other = [replace(seen[0], size=(400, 300)), *seen[1:]]
    with pytest.raises(CalibrationError, match="pictures of 400 x 300"):
        calibrate.solve(other, BOARD, w.sizes, USUAL)
    none = np.nan
    blind = [replace(s, sample_phase=s.sample_phase * none, square_uv=s.square_uv * none) for s in seen]
    with pytest.raises(CalibrationError, match="project fringes along both"):
        calibrate.solve(blind, BOARD, w.sizes, USUAL)
    first = {"sample_phase": (slice(None), [0]), "sample_sigma": (slice(None), [0]), "directions": [0]}
    along = [replace(s, **{name: getattr(s, name)[cut] for name, cut in first.items()}) for s in seen]
    with pytest.raises(CalibrationError, match=r"fringes along one direction only came .* along both u and v"):
        calibrate.solve(along, BOARD, w.sizes, USUAL)
    small = [replace(s, words=("9 white squares left out: too small in the picture (15 pixels wide)",)) for s in blind]
    with pytest.raises(CalibrationError, match=r"pose00/camera1: 9 white squares .*15 pixels wide.*larger squares"):
        calibrate.solve(small, BOARD, w.sizes, USUAL)
    bad = [("lens", "fisheye"), ("projector", "none"), ("board_shape", "round"), ("focal", "camera7=3"), ("focal", "a")]
    for name, value in [*bad, ("focal", "camera1=x"), ("principal_point", "camera1=3")]:
        with pytest.raises(UsageError):
            calibrate.solve(seen, BOARD, w.sizes, replace(USUAL, **{name: value}))


def test_phases_that_fit_no_projector() -> None:
    w = world(4, noise=0.03, cameras=1)
    seen = w.sightings()
    back = np.diag([-1.0, 1.0])
    turned = []
    for s in seen:
        uv = (s.sample_phase / (2 * np.pi)) @ np.linalg.pinv(s.directions).T @ back + [911, 0]
        turned.append(replace(s, sample_phase=2 * np.pi * uv @ s.directions.T))
    with pytest.raises(CalibrationError, match="grow the wrong way along one axis"):
        calibrate.solve(turned, BOARD, w.sizes, USUAL)
    n = min(len(s.sample_px) for s in seen)
    mixed = [
        replace(s, sample_px=s.sample_px[:n], sample_phase=seen[(i + 3) % len(seen)].sample_phase[:n],
                sample_sigma=s.sample_sigma[:n])
        for i, s in enumerate(seen)
    ]  # fmt: skip
    with pytest.raises(CalibrationError):
        calibrate.solve(mixed, BOARD, w.sizes, USUAL)


@pytest.mark.parametrize("ratio", [0.003, 0.25])
def test_squares_that_are_not_square_are_noticed(ratio: float) -> None:
    w = world(4, noise=0.03, cameras=2)
    seen = w.sightings()
    p = make_problem(seen, BOARD, w.sizes, USUAL)
    boards = {f"pose{i:02d}": T for i, T in enumerate(w.poses)}
    state = state_of(w.rig, boards, p.poses, np.array([0, 0, 0, ratio, 0]))
    for b in p.blocks:
        if b.points:
            r = problem.evaluate(p, state, b, False).residual
            seen[b.sighting] = replace(seen[b.sighting], corner_px=b.place + r + 0.03 * w.rng.standard_normal(r.shape))
    if ratio > 0.1:
        with pytest.raises(CalibrationError):
            calibrate.solve(seen, BOARD, w.sizes, USUAL)
        return
    found = calibrate.solve(seen, BOARD, w.sizes, USUAL)
    value, sigma = found.figures["board_shape"]["ratio"]
    assert value == pytest.approx(ratio, abs=5 * sigma)
    assert any("farther apart" in word for word in found.figures["words"])


# ----------------------------------------------------------------------------------------------- lens, priors, shape


def test_the_lens_is_chosen_by_poses_left_out() -> None:
    w = world(13, noise=0.01, cameras=1, focal=1500.0, size=(684, 456), baseline=150.0, height=250.0)
    camera = w.rig.cameras[0]
    strong = np.array([-0.2, 0.3, 0, 0, -300.0])
    w.rig = Rig(w.rig.projector, (replace(camera, lens=replace(camera.lens, distortion=strong)),))
    found = calibrate.solve(w.sightings(), BOARD, w.sizes)
    assert found.figures["lens_models"]["camera1"] == "k1 k2 p1 p2 k3"
    assert set(found.figures["lens_scores"]["camera1"]) == set(stage.MODELS)
    assert found.figures["lens_scores"]["camera1"]["none"] > 1000


def test_which_lens_is_preferred() -> None:
    rng = np.random.default_rng(0)
    scores = {m: 10 + 0.3 * rng.normal(size=6) for m in stage.MODELS}
    assert stage.preferred(scores, 5.0, 0.9) == stage.USUAL  # nothing speaks against the usual one
    scores["k1 k2 p1 p2 k3"] = scores[stage.USUAL] - 5
    assert stage.preferred(scores, 5.0, 0.9) == "k1 k2 p1 p2 k3"
    one = np.array([30.0, 0, 0, 0, 0, 0])
    scores["k1 k2 p1 p2 k3"] = scores[stage.USUAL] - one  # better in one pose only: chance
    assert stage.preferred(scores, 5.0, 0.9) == stage.USUAL
    scores = {"none": np.full(6, 60.0), "k1": 10 + np.array([9.0, 0, 0, 0, 0, -1]), "k1 k2": np.full(6, 10.0)}
    scores |= {m: np.full(6, 20.0) for m in list(stage.MODELS)[3:]}
    assert stage.preferred(scores, 5.0, 0.9) == "k1"  # worse than k1 k2 in one pose only
    scores["k1"] = np.full(6, 15.0)
    assert stage.preferred(scores, 5.0, 0.9) == "k1 k2"


def test_priors_hold_what_is_known() -> None:
    w = world(14, noise=0.05, cameras=1)
    true = w.rig.cameras[0].lens.K
    told = f"camera1={true[0, 0]:.6f},{true[1, 1]:.6f}+-0.01"
    middle = f"camera1={true[0, 2]:.6f},{true[1, 2]:.6f}+-0.01"
    found = calibrate.solve(w.sightings(), BOARD, w.sizes, replace(USUAL, focal=told, principal_point=middle))
    assert pytest.approx(true, abs=0.05) == found.rig.cameras[0].lens.K
    square = calibrate.solve(w.sightings(), BOARD, w.sizes, replace(USUAL, square_pixels=True)).rig.cameras[0].lens.K
    assert square[0, 0] == square[1, 1]


def test_a_board_that_bends_and_a_print_that_is_longer() -> None:
    w = world(15, cameras=1)
    seen = w.sightings()
    p = make_problem(seen, BOARD, w.sizes, USUAL)
    true = np.array([0.08, -0.03, 0.05, 0.0015, 0.0008])
    state = state_of(w.rig, {f"pose{i:02d}": T for i, T in enumerate(w.poses)}, p.poses, true)
    for b in p.blocks:
        r = problem.evaluate(p, state, b, False).residual
        s = seen[b.sighting]
        if b.points:
            seen[b.sighting] = replace(s, corner_px=b.place + r)
        else:
            size = np.linalg.norm(s.directions, axis=1)
            seen[b.sighting] = replace(s, sample_phase=2 * np.pi * (b.cycles + r * size))
    found = calibrate.solve(seen, BOARD, w.sizes, replace(USUAL, board_shape="bend print"))
    shape = [n.value for n in found.parameters if n.device == "board"]
    assert shape == pytest.approx(true, rel=1e-3, abs=1e-6)
    assert apart(found.rig, w.rig) < 1e-4


# --------------------------------------------------------------------------------------------------------- hold-out


def test_a_board_fitted_by_a_rig() -> None:
    w = world(16, noise=0.02)
    T, residuals = calibrate.fit_board(w.rig, [w.sighting(4, c) for c in w.rig.cameras], BOARD)
    assert T.t == pytest.approx(w.poses[4].t, abs=0.01)
    assert pytest.approx(w.poses[4].R, abs=5e-4) == T.R
    assert np.nanstd(residuals[1].corner) == pytest.approx(0.02, rel=0.2)
    assert np.nanstd(residuals[1].sample) == pytest.approx(0.02, rel=0.2)
    with pytest.raises(CalibrationError, match="needed those of one pose"):
        calibrate.fit_board(w.rig, w.sightings(), BOARD)


def test_leaving_poses_out() -> None:
    w = world(17, noise=0.02, cameras=2, poses=6, samples=1500)
    found = calibrate.solve(w.sightings(), BOARD, w.sizes, USUAL)
    held = calibrate.leave_one_out(found, USUAL)
    assert [h.pose for h in held] == sorted(found.boards)
    for h in held:
        assert h.corners > 100
        assert h.corner_px_rms == pytest.approx(0.02, rel=0.35)
        assert h.sample_rms == pytest.approx(0.02, rel=0.35)
        assert h.corner_mm_rms < 0.02
        assert h.scale == pytest.approx(1, abs=3e-4)


def test_readings_are_both_sides_of_a_flat_board() -> None:
    w = world(18, cameras=1)
    p = make_problem(w.sightings(), BOARD, w.sizes, USUAL)
    camera = w.rig.cameras[0]
    K, d = camera.lens.K, camera.lens.distortion
    lens = np.array([[0.0] * 9, [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *d]])
    for n, both in initial.readings_of(p, lens).items():
        T = geometry.compose(camera.pose, w.poses[n])
        assert pytest.approx(T.R, abs=1e-4) == both[0].R


# ---------------------------------------------------------------------------------------------------- outside data


def session(folder: Path, board: Board) -> tuple[list[Sighting], calibrate.Sizes]:
    out: list[Sighting] = []
    cameras: dict[str, tuple[int, int]] = {}
    for pose in sorted(folder.glob("pose*")):
        capture = store.read_capture(pose)
        group = [pipeline.see_board(v, board, pose.name, Settings())[0] for v in store.view_inputs(capture)]
        cameras |= {v.camera: v.size for v in capture.views}
        out += calibrate.agree([s for s in group if s is not None], board)
    return out, calibrate.Sizes((capture.projector_width, capture.projector_height), capture.layout, cameras)


@pytest.mark.verify
def test_rendered_boards(shared: Path) -> None:
    folder = shared / "data" / "rendered-small"
    seen, sizes = session(folder / "calibration", BOARD)
    found = calibrate.solve(seen, BOARD, sizes)
    assert not [n for n in found.left_out if n.points is None]
    assert apart(found.rig, store.read_rig(folder / "truth" / "rig.json")) < 2e-3


@pytest.mark.verify
def test_real_boards(shared: Path) -> None:
    board = Board((14, 10), 10.0)
    seen, sizes = session(shared / "data" / "slstudio" / "board", board)
    found = calibrate.solve(seen, board, sizes)
    assert found.figures["stereo_rms_px"] <= 0.40
    assert found.figures["corners_used"] >= 0.95 * found.figures["corners_detected"]
    assert found.figures["baseline_mm"]["camera1"] == pytest.approx(165.9, abs=0.8)
    for h in calibrate.leave_one_out(found):
        assert h.corner_mm_rms <= 0.125
        assert h.scale == pytest.approx(1, abs=0.0015)


def test_the_projector_read_at_corners() -> None:
    w = world(19, cameras=1, samples=3000)
    s = w.sighting(2, w.rig.cameras[0])
    b = outcome.read_at_corners(s, BOARD, 1, 0, 0)
    assert b is not None
    there = seen_by(w.rig.projector, np.column_stack([b.xy, np.zeros(len(b.xy))]) @ w.poses[2].R.T + w.poses[2].t)
    assert np.abs(b.place - there).max() < 0.02
