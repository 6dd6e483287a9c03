"""Rendered pictures of coloured clouds and textured surfaces: z-buffer, soft light, antialiased by supersampling."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fringescope.errors import EmptyResultError, UsageError
from fringescope.kernels import draw
from fringescope.types import F32, F64, U8, Cloud, Surface

CLAY = (0.60, 0.58, 0.55)  #: albedo of a relief, linear light
WHITE = (255, 255, 255)
DARK = (17, 20, 26)


@dataclass(frozen=True)
class Viewpoint:
    """Where a picture is taken from: looking at the middle of the object, world z up.

    `azimuth_deg` 0 = from +x, 90 = from +y, -90 = from -y; `elevation_deg` 90 = from above. `fov_deg` is the angle of
    the longer side; `zoom` above 1 comes nearer than what shows everything.
    """

    azimuth_deg: float = -78.0
    elevation_deg: float = 60.0
    fov_deg: float = 18.0
    zoom: float = 1.0

    def __post_init__(self) -> None:
        if not (0 < self.fov_deg < 120 and self.zoom > 0):
            raise UsageError(f"viewpoint with fov {self.fov_deg} and zoom {self.zoom}; needed 0 < fov < 120, zoom > 0")


@dataclass(frozen=True)
class Light:
    """Soft light from the upper left of the picture: key, sky from above, and shade in hollows.

    `gloss` is the strength of the wet highlight, `shade` of the shade in hollows (0 = none).
    """

    key: float = 0.85
    sky: float = 0.33
    gloss: float = 0.10
    shade: float = 0.75


@dataclass(frozen=True, eq=False)
class _Canvas:
    """Buffers of one picture, supersampled."""

    R: F64  #: rows: right, down, forward in the world
    centre: F64
    focal: float
    depth: F32
    colour: F32
    normal: F32


def render_surface(
    surface: Surface,
    size: tuple[int, int] = (1600, 1000),
    viewpoint: Viewpoint | None = None,
    coloured: bool = True,
    background: tuple[int, int, int] | None = DARK,
    light: Light | None = None,
    supersample: int = 2,
) -> U8:
    """Picture of a textured mesh, (height, width, 3) sRGB, or with alpha (.., 4) where `background` is None.

    `size` = (width, height). `coloured` False draws a shaded relief; coloured pictures are exposed so that their
    brightest parts reach 0.65. What was not measured shows the background. Deterministic. Raises EmptyResultError for a
    surface without triangles.
    """
    if not surface.n_faces:
        raise EmptyResultError("the surface has no triangles; there is nothing to draw")
    used = np.concatenate([np.unique(p.vertex_index[p.faces]) for p in surface.parts])
    canvas = _canvas(surface.vertices[used], size, viewpoint or Viewpoint(), supersample)
    for part in surface.parts:
        index = part.vertex_index.astype(np.int64)
        screen = _project(canvas, surface.vertices[index])
        texture = _linear(part.texture) if coloured else np.full((1, 1, 3), CLAY, np.float32)
        if coloured:
            texture = _fit_texture(texture, screen, part.uv, part.faces)
        draw.triangles(
            screen, part.faces.astype(np.int64), np.ascontiguousarray(surface.normals[index], np.float32),
            np.ascontiguousarray(part.uv, np.float32), texture, canvas.depth, canvas.colour, canvas.normal,
        )  # fmt: skip
    return _finish(canvas, light or Light(), background, supersample, coloured)


def render_cloud(
    cloud: Cloud,
    size: tuple[int, int] = (1600, 1000),
    viewpoint: Viewpoint | None = None,
    coloured: bool = True,
    background: tuple[int, int, int] | None = DARK,
    light: Light | None = None,
    supersample: int = 2,
    point_mm: float | None = None,
) -> U8:
    """Picture of a point cloud as discs of `point_mm` diameter (default: closes its gaps); else as `render_surface`.

    Points without a finite normal face the viewer. Raises EmptyResultError for a cloud without points.
    """
    ok = np.isfinite(cloud.xyz).all(1)
    if not ok.any():
        raise EmptyResultError("the cloud has no points; there is nothing to draw")
    xyz = cloud.xyz[ok]
    canvas = _canvas(xyz, size, viewpoint or Viewpoint(), supersample)
    screen = _project(canvas, xyz)
    diameter = point_mm if point_mm is not None else 2.6 * _spacing(xyz)
    radius = np.maximum(0.5 * diameter * canvas.focal / np.maximum(screen[:, 2], 1e-9), 0.71)
    normals = np.where(np.isfinite(cloud.normals[ok]), cloud.normals[ok], -canvas.R[2]).astype(np.float32)
    colours = _linear(cloud.rgb[ok]) if coloured else np.broadcast_to(np.array(CLAY, np.float32), xyz.shape)
    draw.splat(screen, radius, np.ascontiguousarray(colours), normals, canvas.depth, canvas.colour, canvas.normal)
    return _finish(canvas, light or Light(), background, supersample, coloured)


# ------------------------------------------------------------------------------------------------------------- camera


def _canvas(xyz: ArrayLike, size: tuple[int, int], view: Viewpoint, ss: int) -> _Canvas:
    w, h = size[0] * ss, size[1] * ss
    if w < 1 or h < 1 or w * h > 2e8:
        raise UsageError(f"picture of {size[0]} x {size[1]}, {ss} times supersampled; needed 1 to 200 million samples")
    a, e = math.radians(view.azimuth_deg), math.radians(view.elevation_deg)
    forward = -np.array([math.cos(e) * math.cos(a), math.cos(e) * math.sin(a), math.sin(e)])
    right = np.array([-math.sin(a), math.cos(a), 0.0])  # stays defined straight from above
    R = np.stack([right, np.cross(forward, right), forward])
    p = np.asarray(xyz, dtype=np.float64) @ R.T
    low, high = p.min(0), p.max(0)
    focal = 0.5 * max(w, h) / math.tan(math.radians(view.fov_deg) / 2)
    middle = (low + high) / 2
    distance = 0.0
    d = p - middle
    for _ in range(8):  # the nearest place from which everything is seen with a margin
        need_x = np.abs(d[:, 0]) * focal / (0.46 * w) - d[:, 2]
        need_y = np.abs(d[:, 1]) * focal / (0.46 * h) - d[:, 2]
        distance = float(max(need_x.max(), need_y.max()))
        x, y = d[:, 0] / (d[:, 2] + distance), d[:, 1] / (d[:, 2] + distance)
        shift = np.array([(x.max() + x.min()) / 2, (y.max() + y.min()) / 2, 0.0]) * distance
        middle, d = middle + shift, d - shift
    centre = R.T @ (middle - [0, 0, distance / view.zoom])
    depth = np.full((h, w), np.inf, np.float32)
    return _Canvas(R, centre, focal, depth, np.zeros((h, w, 3), np.float32), np.zeros((h, w, 3), np.float32))


def _project(c: _Canvas, xyz: ArrayLike) -> F64:
    p = (np.asarray(xyz, dtype=np.float64) - c.centre) @ c.R.T
    h, w = c.depth.shape
    z = np.where(p[:, 2] > 1e-9, p[:, 2], np.nan)
    return np.stack([c.focal * p[:, 0] / z + (w - 1) / 2, c.focal * p[:, 1] / z + (h - 1) / 2, z], 1)


def _spacing(xyz: NDArray[np.float32]) -> float:
    """Typical distance between neighbouring points of a surface, mm: by counting points in cells."""
    low, high = np.percentile(xyz, [1, 99], axis=0)
    cell = max(float(np.linalg.norm(high - low)) / 150, 1e-6)
    q = np.floor((xyz - low) / cell).astype(np.int64)
    _, count = np.unique(q[:, 0] * 73_856_093 ^ q[:, 1] * 19_349_663 ^ q[:, 2] * 83_492_791, return_counts=True)
    return cell / math.sqrt(max(float(np.median(count)), 1.0))


def _linear(srgb: U8) -> F32:
    x = np.arange(256) / 255
    table = np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4).astype(np.float32)
    out: F32 = table[srgb]
    return out


def _srgb(linear: NDArray[np.floating]) -> U8:
    """Linear light to 8-bit sRGB codes, by a table of 65536 levels."""
    x = np.arange(65536) / 65535
    table = np.rint(255 * np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)).astype(np.uint8)
    out: U8 = table[(np.clip(linear, 0, 1) * 65535 + 0.5).astype(np.uint16)]
    return out


def _fit_texture(texture: F32, screen: F64, uv: F32, faces: NDArray[np.uint32]) -> F32:
    """The texture reduced until a texel is not much smaller than a sample of the screen."""
    f = faces[:: max(1, len(faces) // 2000)].astype(np.int64)
    s, t = screen[f, :2], uv[f] * [texture.shape[1], texture.shape[0]]
    on_screen, on_texture = _areas(s), _areas(t)
    ok = np.isfinite(on_screen) & (on_screen > 0)
    if not ok.any():
        return texture
    scale = math.sqrt(float(np.median(on_texture[ok] / on_screen[ok])))
    if scale < 1.5:
        return texture
    small = (max(1, round(texture.shape[1] / scale)), max(1, round(texture.shape[0] / scale)))
    return np.asarray(cv2.resize(texture, small, interpolation=cv2.INTER_AREA), np.float32)


def _areas(t: NDArray[np.floating]) -> F64:
    """Twice the areas of triangles (m, 3 corners, 2)."""
    a, b = t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
    out: F64 = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return out


# --------------------------------------------------------------------------------------------------------------- light


def _finish(c: _Canvas, light: Light, background: tuple[int, int, int] | None, ss: int, exposed: bool) -> U8:
    """Light on the buffers, the mean over each pixel's samples, exposure, sRGB."""
    h, w = c.depth.shape[0] // ss, c.depth.shape[1] // ss
    key = c.R.T @ np.array([-0.42, -0.62, -0.66])  # from the upper left, behind the viewer
    key /= np.linalg.norm(key)
    half = key - c.R[2]
    half /= np.linalg.norm(half)
    strength = np.array([light.key, light.sky, light.gloss, light.shade])
    rgb, alpha = np.empty((h, w, 3), np.float32), np.empty((h, w), np.float32)
    shade = _hollows(c, ss) if light.shade > 0 else np.ones((h, w), np.float32)
    draw.light(c.depth, c.colour, c.normal, shade, ss, c.R[2], key, np.array([0, 0, 1.0]), half, strength, rgb, alpha)
    if exposed and (alpha > 0.5).any():
        bright = float(np.percentile(rgb[alpha > 0.5].max(1), 98))
        rgb *= min(max(0.65 / max(bright, 1e-6), 0.5), 4.0)
    if background is None:
        straight = _srgb(rgb / np.maximum(alpha, 1e-6)[..., None])
        return np.concatenate([straight, np.rint(255 * alpha[..., None]).astype(np.uint8)], 2)
    behind = _linear(np.array(background, np.uint8))
    return _srgb(rgb + (1 - alpha[..., None]) * behind)


def _hollows(c: _Canvas, ss: int) -> F32:
    """1 in the open, less where the surroundings stand nearer to the viewer: blurred depth against depth, (h, w)."""
    size = (c.depth.shape[0] // ss, c.depth.shape[1] // ss)
    depth, weight = np.empty(size, np.float32), np.empty(size, np.float32)
    draw.reduce_depth(c.depth, ss, depth, weight)
    flat = depth / np.maximum(weight, 1e-6)
    unit = float(np.median(flat[weight > 0.5])) / c.focal * ss if (weight > 0.5).any() else 1.0  # mm per pixel
    total = np.zeros(size, np.float32)
    for share in (0.006, 0.018, 0.05):
        s = share * max(size)
        near = _blur(depth, s) / np.maximum(_blur(weight, s), 1e-6)
        total += np.clip((flat - near) / (unit * s), 0, 2)
    out: F32 = np.exp(-0.9 * total)
    return out


def _blur(a: F32, sigma: float) -> F32:
    """Gaussian blur; wide ones at a lower resolution."""
    k = max(1, int(sigma / 3))
    small = cv2.resize(a, (max(1, a.shape[1] // k), max(1, a.shape[0] // k)), interpolation=cv2.INTER_AREA)
    soft = cv2.GaussianBlur(small, (0, 0), sigma / k)
    return np.asarray(cv2.resize(soft, a.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
