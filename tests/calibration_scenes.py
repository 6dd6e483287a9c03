"""Calibrations made up from a true rig and noise: what evidence and reports are tested on. OpenCV projects."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from fringescope.twin import presets
from fringescope.types import Board, Calibration, LeftOut, Parameter, Pose, Residuals, Sighting, Volume

BOARD = Board((12, 9), 5.0)
LENS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
LENS_SIGMA = (1.5, 1.5, 4.0, 4.0, 2e-3, 0.05, 1e-4, 1e-4)
POSE = ("rx", "ry", "rz", "tx", "ty", "tz")
POSE_SIGMA = (1e-3, 1e-3, 5e-5, 0.02, 0.02, 0.2)


def cv_project(device, p):
    """World points (n, 3) to a device's plane (n, 2), by OpenCV."""
    rvec, _ = cv2.Rodrigues(device.pose.R)
    uv, _ = cv2.projectPoints(np.asarray(p, float), rvec, device.pose.t, device.lens.K, device.lens.distortion)
    return uv.reshape(-1, 2)


def board_poses(n, rng, tilt_deg=22.0, depth_mm=12.0, shift_mm=14.0, board=BOARD):
    """T_world_board of `n` poses around the world's origin, board facing +z (its own z points away)."""
    out = {}
    centre = board.corner_mm(np.array([board.inner_corners]) - 1)[0] / 2
    for i in range(n):
        a = 2 * np.pi * i / n + 0.3
        lean = np.radians(tilt_deg) * (0 if i == 0 else 1)
        turn = Rotation.from_rotvec(lean * np.array([np.cos(a), np.sin(a), 0]))
        R = (turn * Rotation.from_euler("xz", [np.pi, rng.uniform(-0.4, 0.4)])).as_matrix()
        at = np.array([*rng.uniform(-shift_mm, shift_mm, 2), depth_mm * (-1) ** i * rng.uniform(0.5, 1)])
        out[f"pose{i:02}"] = Pose(R, at - R @ centre)
    return out


def calibration(
    preset="paper", n=9, seed=0, corner_px=0.01, sample_units=0.03, bias=None, board=BOARD, poses=None,
    sigma=1.0, seen=lambda _pose, _camera: True, volume=True, per_square=6,
):  # fmt: skip
    """A calibration at its truth, with noise for residuals; `bias(device, uv)` adds to them."""
    rng = np.random.default_rng(seed)
    rig = presets.instrument(preset, 0.125).rig
    poses = poses if poses is not None else board_poses(n, rng, board=board)
    nothing = lambda _device, uv: np.zeros_like(uv)  # noqa: E731
    bias = bias or nothing
    c, r = board.inner_corners
    corner = np.stack(np.meshgrid(np.arange(c), np.arange(r)), -1).reshape(-1, 2).astype(np.int32)
    square = np.array([(i, j) for j in range(r + 1) for i in range(c + 1) if (i + j) % 2], np.int32)
    offsets = rng.uniform(-0.35, 0.35, (len(square) * per_square, 2))
    on_board = np.repeat(board.centre_mm(square), per_square, 0)
    on_board[:, :2] += board.square_mm * offsets
    directions = np.array([[1 / 36, 0.0], [0.0, 1 / 36]])
    sightings, residuals = [], []
    for pose, T in poses.items():
        for camera in rig.cameras:
            if not seen(pose, camera.name):
                continue
            world = lambda p, T=T: p @ T.R.T + T.t  # noqa: E731
            px, sample_px = cv_project(camera, world(board.corner_mm(corner))), cv_project(camera, world(on_board))
            uv = cv_project(rig.projector, world(on_board))
            size = np.array([camera.lens.width, camera.lens.height])
            centre_uv = cv_project(rig.projector, world(board.centre_mm(square)))
            ok, sample_ok = (((q >= 0) & (q <= size - 1)).all(1) for q in (px, sample_px))
            e = rng.normal(0, corner_px, px.shape) + bias(camera.name, px)
            f = rng.normal(0, sample_units, uv.shape) + bias("projector", uv)
            squares = cv_project(camera, world(board.centre_mm(square)))
            sightings.append(Sighting(
                pose, camera.name, (int(size[0]), int(size[1])), corner[ok], px[ok] + e[ok],
                np.full(ok.sum(), corner_px), square, squares, centre_uv, np.full((len(square), 2), 0.01),
                directions, sample_px[sample_ok], (2 * np.pi * uv @ directions.T)[sample_ok],
                np.full((sample_ok.sum(), 2), 0.01),
            ))  # fmt: skip
            residuals.append(Residuals(pose, camera.name, e[ok], f[sample_ok], uv[sample_ok]))
    parameters = []
    for d in ("projector", *(cam.name for cam in rig.cameras)):
        device = rig.projector if d == "projector" else rig.camera(d)
        K, k = device.lens.K, device.lens.distortion
        values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *k[:4])
        parameters += [Parameter(d, m, float(v), sigma * w, "px" if m[0] in "fc" else "") for m, v, w in
                       zip(LENS, values, LENS_SIGMA, strict=True)]  # fmt: skip
        parameters.append(Parameter(d, "k3", 0.0, 0.0, "", fixed=True))
        if d != "projector":
            rotvec = Rotation.from_matrix(device.pose.R).as_rotvec()
            parameters += [Parameter(d, m, float(v), sigma * w, "mm" if m[0] == "t" else "rad") for m, v, w in
                           zip(POSE, (*rotvec, *device.pose.t), POSE_SIGMA, strict=True)]  # fmt: skip
    s = np.array([p.sigma for p in parameters if not p.fixed] + [0.01] * 6 * len(poses))
    half = rng.normal(size=(len(s), 2 * len(s)))
    rho = half @ half.T
    rho /= np.sqrt(np.outer(np.diag(rho), np.diag(rho)))
    rho[0, 1] = rho[1, 0] = 0.0
    box = Volume(np.zeros(3), np.eye(3), np.array([30.0, 22, 14])) if volume else None
    rig = type(rig)(rig.projector, rig.cameras, box)
    why = "they miss by 0.4 px, the others by 0.01"
    left = (LeftOut("pose01", rig.cameras[0].name, 3, why),) if len(poses) > 1 else ()
    return Calibration(
        rig, board, poses, tuple(sightings), tuple(residuals), tuple(parameters), rho * np.outer(s, s),
        {"camera1 corners px": corner_px}, left,
    )  # fmt: skip
