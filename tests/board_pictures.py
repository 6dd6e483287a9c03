"""Pictures of boards made without the package: OpenCV's lens, exact edges by sampling, phases by projection."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np

from fringescope.types import Decoded, Direction, FringeSet, NoiseModel, PixelFormat, ViewPlan

Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class Device:
    """K, distortion and pose of a camera or projector."""

    K: Array
    distortion: Array
    R: Array
    t: Array

    def project(self, world: Array) -> Array:
        """World points (n, 3) to its plane (n, 2), by OpenCV."""
        p = cv2.projectPoints(world.reshape(-1, 1, 3), cv2.Rodrigues(self.R)[0], self.t, self.K, self.distortion)[0]
        return np.asarray(p[:, 0])


def look_at(position: Any, target: Any = (0, 0, 0), roll: float = 0.0) -> tuple[Array, Array]:
    """R, t of a device at a place, looking at another."""
    c, p = np.asarray(position, float), np.asarray(target, float)
    z = (p - c) / np.linalg.norm(p - c)
    x = np.cross([0, 1, 0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    x, y = np.cos(roll) * x + np.sin(roll) * y, np.cos(roll) * y - np.sin(roll) * x
    R = np.stack([x, y, z])
    return R, -R @ c


@dataclass(frozen=True)
class Picture:
    """One view of a board. `corners_px` of every inner corner (column fastest), `board` = its pose (R, t)."""

    image: Array
    decoded: Decoded
    plan: ViewPlan
    camera: Device
    projector: Device
    board: tuple[Array, Array]
    inner: tuple[int, int]
    square: float

    def world(self, ij: Array) -> Array:
        """World points of board corners (n, 2)."""
        p = np.column_stack([np.asarray(ij, float) * self.square, np.zeros(len(ij))])
        return np.asarray(p @ self.board[0].T + self.board[1])


@dataclass(frozen=True)
class Scene:
    """What is photographed, and how."""

    inner: tuple[int, int] = (9, 6)
    square: float = 6.0
    size: tuple[int, int] = (420, 320)
    focal: float = 2500.0
    distortion: tuple[float, ...] = (-0.1, 0.0, 0.0, 0.0, 0.0)
    camera_at: tuple[float, float, float] = (40.0, 10.0, -430.0)
    roll: float = 0.0
    tilt: tuple[float, float, float] = (0.2, -0.15, 0.1)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    dark: float = 0.06
    blur: float = 0.7
    noise: float = 0.15
    phase_sigma: float = 0.03
    light: float = 150.0
    falloff: float = 0.0  #: light lost towards the corners
    gains: tuple[float, float, float, float] | None = None  #: of R, G, G, B sites; None = mono
    mirrored: bool = False
    first_black: bool = True
    markers: Any = None  #: an OpenCV board; its picture replaces the squares
    directions: tuple[tuple[float, float], ...] = ((1 / 36, 0.0), (0.0, 1 / 36))
    camera: str = "camera1"
    fmt: PixelFormat = PixelFormat.MONO8
    seed: int = 1

    def but(self, **changes: Any) -> Scene:
        """The same with changes."""
        return replace(self, **changes)


PROJECTOR = Device(
    np.array([[2000.0, 0, 450], [0, 2000.0, 500], [0, 0, 1]]), np.array([-0.03, 0, 0, 0, 0.0]), *look_at((-60, 0, -420))
)


def take(scene: Scene) -> Picture:
    """Photographs a scene."""
    rng = np.random.default_rng(scene.seed)
    w, h = scene.size
    K = np.array([[scene.focal, 0, w / 2 - 3.3], [0, scene.focal, h / 2 + 2.1], [0, 0, 1]])
    camera = Device(K, np.array(scene.distortion), *look_at(scene.camera_at, roll=scene.roll))
    R = cv2.Rodrigues(np.array(scene.tilt))[0]
    middle = np.array([(scene.inner[0] - 1) / 2, (scene.inner[1] - 1) / 2, 0]) * scene.square
    t = np.array(scene.shift) - R @ middle
    x, y = np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float))
    rays = undistorted(camera, np.column_stack([x.ravel(), y.ravel()]))
    origin = -camera.R.T @ camera.t
    d = np.column_stack([rays, np.ones(len(rays))]) @ camera.R
    s = ((t - origin) @ R[:, 2]) / (d @ R[:, 2])
    world = origin + d * s[:, None]
    flat = ((world - t) @ R)[:, :2].reshape(h, w, 2) / scene.square
    white = _white(scene, flat)
    fall = 1 - scene.falloff * (((x - w / 2) / w) ** 2 + ((y - h / 2) / h) ** 2) * 2
    reflect = scene.dark + (1 - scene.dark) * white
    if scene.blur:
        reflect = cv2.GaussianBlur(reflect, (0, 0), scene.blur)
    bright = scene.light * fall * reflect
    if scene.gains:
        gain = np.empty((h, w))
        for (i, j), g in zip(((0, 0), (0, 1), (1, 0), (1, 1)), scene.gains, strict=True):
            gain[i::2, j::2] = g
        bright = bright * gain
    image = (bright + rng.normal(0, scene.noise, bright.shape)).astype(np.float32)
    uv = PROJECTOR.project(world)
    phases = []
    for g in scene.directions:
        phi = 2 * np.pi * (uv @ np.array(g)).reshape(h, w)
        sigma = (scene.phase_sigma / np.maximum(reflect, 0.02)).astype(np.float32)
        phases.append(Direction(g, (phi + rng.normal(size=(h, w)) * sigma).astype(np.float32), sigma, sigma * 0 + 9))
    modulation = (0.9 * bright).astype(np.float32)
    reasons = np.zeros((h, w), np.uint16)
    decoded = Decoded(scene.camera, tuple(phases), (), (), image, modulation, reasons, NoiseModel(0.3, 0.02))
    sets = tuple(FringeSet(g, 8) for g in scene.directions)
    fmt = PixelFormat.BAYER_RG8 if scene.gains else scene.fmt
    plan = ViewPlan(scene.camera, fmt, sets, (900, 1000))
    if scene.mirrored:
        image, decoded = np.ascontiguousarray(image[:, ::-1]), mirrored(decoded)
    return Picture(image, decoded, plan, camera, PROJECTOR, (R, t), scene.inner, scene.square)


def mirrored(d: Decoded) -> Decoded:
    """A decoded view with its columns reversed."""
    turn = tuple(Direction(x.g, x.phase[:, ::-1], x.sigma[:, ::-1], x.order_margin[:, ::-1]) for x in d.directions)
    flipped = {name: getattr(d, name)[:, ::-1] for name in ("background", "modulation", "reasons")}
    return replace(d, directions=turn, **flipped)


def undistorted(device: Device, px: Array) -> Array:
    """Normalised ideal coordinates (n, 2) of plane coordinates, by fixed point on OpenCV's model."""
    n = (px - device.K[:2, 2]) / device.K[[0, 1], [0, 1]]
    k1, k2, p1, p2, k3 = device.distortion
    q = n.copy()
    for _ in range(25):
        x, y = q.T
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        shift = np.column_stack([2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y])
        q = (n - shift) / radial[:, None]
    return np.asarray(q)


def _white(scene: Scene, flat: Array, fine: int = 8) -> Array:
    """Share of white in each pixel: exact colours at fine x fine places of those that an edge may cross."""
    dx, dy = np.gradient(flat, axis=1), np.gradient(flat, axis=0)
    middle = _colour(scene, flat)
    near = np.ones((3, 3))
    edge = cv2.dilate(middle, near) != cv2.erode(middle, near)
    total = np.zeros(int(edge.sum()))
    at = (np.arange(fine) + 0.5) / fine - 0.5
    skew = (np.arange(fine) - (fine - 1) / 2) / fine**2  # no two samples in one column or row
    for i, a in enumerate(at):
        for j, b in enumerate(at):
            total += _colour(scene, flat[edge] + dx[edge] * (a + skew[j]) + dy[edge] * (b + skew[i]))
    middle[edge] = total / fine**2
    return middle


@cache
def _printed(markers: Any, width: int, height: int) -> Array:
    return np.asarray(markers.generateImage((width, height), marginSize=0))


def _colour(scene: Scene, p: Array) -> Array:
    """1 where the board or its margin is white, at board coordinates in squares."""
    c, r = np.floor(p[..., 0]).astype(int) + 1, np.floor(p[..., 1]).astype(int) + 1
    on = (c >= 0) & (r >= 0) & (c <= scene.inner[0]) & (r <= scene.inner[1])
    sheet = (p > -2.2).all(-1) & (p[..., 0] < scene.inner[0] + 1.2) & (p[..., 1] < scene.inner[1] + 1.2)
    if scene.markers is not None:
        n = 60
        picture = _printed(scene.markers, (scene.inner[0] + 1) * n, (scene.inner[1] + 1) * n)
        x = np.clip(((p + 1) * n).astype(int), 0, np.array(picture.shape[::-1]) - 1)
        return np.where(on, picture[x[..., 1], x[..., 0]] > 127, sheet).astype(float)
    black = on & ((c + r) % 2 == (0 if scene.first_black else 1))
    return (sheet & ~black).astype(float)
