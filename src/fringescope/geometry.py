"""Poses T_ab, projection and unprojection with both lenses exact, rays, and the projector's lattice (grid or diamond).

Conventions (docs/conventions.md): mm; x right, y down, z forward; (0, 0) is the centre of the top-left pixel; T_ab maps
b to a. Lens model: OpenCV, "Camera Calibration and 3D Reconstruction"; equations 1, 2, 6, 12 and 19 of the paper.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike

from fringescope.errors import RigError
from fringescope.kernels import lens as k
from fringescope.types import F64, Bool, Camera, Layout, Lens, Pose, Projector, Rig, Volume


def lens_vector(lens: Lens) -> F64:
    """The ten numbers that kernels take: fx, fy, u0, v0, skew, k1, k2, p1, p2, k3."""
    K, d = lens.K, lens.distortion
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1], *d], dtype=np.float64)


def pose_vector(pose: Pose) -> F64:
    """The twelve numbers that kernels take: R row by row, then t."""
    return np.concatenate([pose.R.ravel(), pose.t])


def without_distortion(lens: Lens) -> Lens:
    """The same lens as the plain pinhole of the paper's equations 2 and 6."""
    return Lens(lens.width, lens.height, lens.K, np.zeros(5))


def inverse(T_ab: Pose) -> Pose:
    """T_ba from T_ab."""
    return Pose(T_ab.R.T, -T_ab.R.T @ T_ab.t)


def compose(T_ab: Pose, T_bc: Pose) -> Pose:
    """T_ac = T_ab T_bc."""
    return Pose(T_ab.R @ T_bc.R, T_ab.R @ T_bc.t + T_ab.t)


def similarity(a: ArrayLike, b: ArrayLike) -> tuple[Pose, float]:
    """The rigid motion that lays points a (n, 3) best on b (n, 3), and the scale that would fit better still.

    Least squares (Umeyama 1991, doi:10.1109/34.88573): `b = scale R (a - mean a) + mean b`; the pose has scale 1.
    """
    p, q = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    mp, mq = p.mean(axis=0), q.mean(axis=0)
    U, S, Vt = np.linalg.svd((q - mq).T @ (p - mp))
    D = np.array([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    R = U * D @ Vt
    return Pose(R, mq - R @ mp), float((S * D).sum() / ((p - mp) ** 2).sum())


def centre(T_device_world: Pose) -> F64:
    """Optical centre of a device in world mm, (3,)."""
    c: F64 = -T_device_world.R.T @ T_device_world.t
    return c


def transform(T_ab: Pose, p_b: ArrayLike) -> F64:
    """Points (..., 3) in b to points in a."""
    out: F64 = np.asarray(p_b, dtype=np.float64) @ T_ab.R.T + T_ab.t
    return out


def project(device: Camera | Projector, p_world: ArrayLike) -> F64:
    """World points (..., 3) in mm to plane coordinates (..., 2) of a camera or projector; NaN behind it (equation 19).

    Exact for the lens' distortion. Does not clip to the sensor.
    """
    p = np.ascontiguousarray(p_world, dtype=np.float64)
    flat = p.reshape(-1, 3)
    out = np.empty((len(flat), 2))
    k.project_points(flat, device.pose.R, device.pose.t, lens_vector(device.lens), out)
    return out.reshape(*p.shape[:-1], 2)


def unproject(lens: Lens, uv: ArrayLike) -> F64:
    """Plane coordinates (..., 2) to ideal normalised coordinates (x/z, y/z) (..., 2); NaN where the lens cannot."""
    a = np.ascontiguousarray(uv, dtype=np.float64)
    flat = a.reshape(-1, 2)
    out = np.empty_like(flat)
    k.unproject_points(flat, lens_vector(lens), out)
    return out.reshape(a.shape)


def world_rays(device: Camera | Projector, uv: ArrayLike) -> tuple[F64, F64]:
    """Rays through plane coordinates (..., 2): origin (3,) and unit directions (..., 3) in the world."""
    n = unproject(device.lens, uv)
    d = np.concatenate([n, np.ones((*n.shape[:-1], 1))], axis=-1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    return centre(device.pose), d @ device.pose.R


def pixel_rays(lens: Lens) -> F64:
    """Ideal normalised coordinates (H, W, 2) of every pixel centre of a camera."""
    out = np.empty((lens.height, lens.width, 2))
    k.pixel_rays(lens_vector(lens), out)
    return out


def lattice(width: int, height: int, layout: Layout) -> tuple[F64, F64]:
    """Projector-plane coordinates (u, v), each (height, width), of every device pixel."""
    c, r = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height, dtype=np.float64))
    return (2.0 * c + (np.arange(height) % 2)[:, None], r) if layout is Layout.DIAMOND else (c, r)


def inside_volume(volume: Volume, p_world: ArrayLike) -> Bool:
    """Whether world points (..., 3) lie in the oriented box."""
    q = (np.asarray(p_world, dtype=np.float64) - volume.center) @ volume.axes.T
    return np.asarray((np.abs(q) <= volume.half_size).all(axis=-1))


def working_point(rig: Rig) -> F64:
    """The point (3,), world mm, where the devices look: nearest to the middle rays of the projector and all cameras.

    Raises RigError if all axes are parallel.
    """
    A, b = np.zeros((3, 3)), np.zeros(3)
    for d in rig.devices:
        mid = [(d.lens.width - 1) / 2, (d.lens.height - 1) / 2]
        o, n = world_rays(d, mid)
        M = np.eye(3) - np.outer(n, n)
        A += M
        b += M @ o
    if np.linalg.cond(A) > 1e8:
        raise RigError("the axes of projector and cameras are parallel; add a measuring \"volume\" to the rig")
    return np.asarray(np.linalg.solve(A, b), dtype=np.float64)


def field_of_view(rig: Rig, p_world: ArrayLike) -> Bool:
    """Whether world points (..., 3) are seen by the projector and all cameras of the rig."""
    ok = np.ones(np.asarray(p_world).shape[:-1], dtype=bool)
    for d in rig.devices:
        uv = project(d, p_world)
        with np.errstate(invalid="ignore"):
            ok &= (uv >= -0.5).all(-1) & (uv[..., 0] <= d.lens.width - 0.5) & (uv[..., 1] <= d.lens.height - 0.5)
    return ok


def phase_at(projector: Projector, g: tuple[float, float], p_world: ArrayLike) -> F64:
    """Phase (...,), radians, of fringes of gradient `g` (cycles per plane unit) at world points (..., 3)."""
    uv = project(projector, p_world)
    return np.asarray(2 * np.pi * (uv[..., 0] * g[0] + uv[..., 1] * g[1]))


def check_baseline(rig: Rig, camera: Camera) -> None:
    """Raise RigError if a camera stands where the projector is: without a baseline the fringes do not tell depth."""
    c, p = centre(camera.pose), centre(rig.projector.pose)
    away = max(float(np.linalg.norm(camera.pose.t)), float(np.linalg.norm(rig.projector.pose.t)), 1.0)
    if np.linalg.norm(c - p) < 1e-3 * away:
        raise RigError(
            f"camera '{camera.name}' and the projector stand at the same place ({np.linalg.norm(c - p):.3g} mm apart); "
            "depth needs a baseline: check R and t in the rig"
        )


def measuring_space(rig: Rig, camera: Camera, p_world: ArrayLike, margin: float) -> Bool:
    """Whether world points (..., 3) may carry a specimen seen by `camera`.

    Inside the rig's volume, grown by `margin` (1.25 = a quarter larger), where the rig has one; else seen by projector
    and camera, in the slab of depths where the devices' fields overlap (see `common_depths`).
    """
    p = np.asarray(p_world, dtype=np.float64)
    if rig.volume is not None:
        v = rig.volume
        return inside_volume(Volume(v.center, v.axes, v.half_size * margin), p)
    near, far = common_depths(rig, camera)
    z = transform(camera.pose, p)[..., 2]
    with np.errstate(invalid="ignore"):
        return np.asarray(field_of_view(Rig(rig.projector, (camera,)), p) & (z >= near) & (z <= far))


def measuring_box(rig: Rig, camera: Camera, margin: float) -> tuple[F64, F64, F64]:
    """The measuring space as a box: centre (3,), unit axes in rows (3, 3), half sizes (3,), mm.

    The rig's volume grown by `margin`, or without one the slab of `common_depths`, endless sideways.
    """
    if rig.volume is not None:
        return rig.volume.center, rig.volume.axes, rig.volume.half_size * margin
    near, far = common_depths(rig, camera)
    middle = transform(inverse(camera.pose), [0.0, 0.0, (near + far) / 2])
    return middle, camera.pose.R, np.array([np.inf, np.inf, (far - near) / 2])


def lit_field(rig: Rig, camera: Camera, rim: float) -> tuple[F64, F64]:
    """Least and greatest (u, v) of the projector's plane that a camera's pixels see whole.

    A pixel that straddles the rim of the field saw half a fringe: half its footprint, in projector units, is left out,
    or what the projector's blur mixes with the dark outside, `rim` units along v, if that is more.
    """
    p = rig.projector
    middle = rig.volume.center if rig.volume is not None else working_point(rig)
    footprint = float(transform(camera.pose, middle)[2]) / camera.lens.K[0, 0]
    units_per_mm = np.array([p.lens.K[0, 0], p.lens.K[1, 1]]) / float(transform(p.pose, middle)[2])
    low = np.maximum(0.5 * footprint * units_per_mm, rim * units_per_mm / units_per_mm[1])
    return low, np.array(p.plane_size) - 1 - low


@lru_cache(maxsize=64)
def common_depths(rig: Rig, camera: Camera) -> tuple[float, float]:
    """Depths along a camera's axis, mm, between which all devices of the rig share some of their fields.

    They share where at least a tenth of the best share of this camera's rays is seen by all. Looks from a twentieth to
    twenty times the distance between the devices. Raises RigError if there is no common view.
    """
    base = max(float(np.linalg.norm(centre(d.pose) - centre(camera.pose))) for d in rig.devices)
    L = camera.lens
    v, u = np.meshgrid(np.linspace(0, L.height - 1, 15), np.linspace(0, L.width - 1, 15), indexing="ij")
    n = unproject(L, np.stack([u, v], -1))
    rays = np.concatenate([n, np.ones((15, 15, 1))], -1)
    depths = np.geomspace(base / 20, base * 20, 241)
    back = inverse(camera.pose)
    share = field_of_view(rig, transform(back, rays * depths[:, None, None, None])).mean(axis=(1, 2))
    if not share.any():
        raise RigError(f"camera '{camera.name}' and the other devices of the rig share no view; check the poses")
    ok = depths[share >= 0.1 * share.max()]
    return float(ok.min() * 0.97), float(ok.max() * 1.03)


def phase_bounds(
    rig: Rig, camera: Camera, g: tuple[float, float], margin: float, size: tuple[int, int] = (18, 26)
) -> F64:
    """Bounds of the phase of gradient `g` on each ray of a camera: an array (4, h, w), radians.

    [0] and [1]: smallest and largest phase inside the measuring space. [2] and [3]: the same within 25 % of the working
    distance, where a specimen is to be expected if the rig has no volume (with a volume: equal to the first two).
    The arrays span the image corner on corner; rays that miss a space take the bounds of the nearest ray that meets it.
    Raises RigError if none does.
    """
    return _phase_bounds(rig, camera, (float(g[0]), float(g[1])), margin, size).copy()


@lru_cache(maxsize=64)
def _phase_bounds(rig: Rig, camera: Camera, g: tuple[float, float], margin: float, size: tuple[int, int]) -> F64:
    h, w = size
    L = camera.lens
    v, u = np.meshgrid(np.linspace(0, L.height - 1, h), np.linspace(0, L.width - 1, w), indexing="ij")
    origin, d = world_rays(camera, np.stack([u, v], -1))
    if rig.volume is not None:
        distance = float(np.linalg.norm(rig.volume.center - origin))
        reach = margin * float(np.linalg.norm(rig.volume.half_size))
        t = np.linspace(max(distance - reach, 1e-3 * distance), distance + reach, 257)
    else:
        distance = float(np.linalg.norm(working_point(rig) - origin))
        near, far = common_depths(rig, camera)
        t = np.geomspace(near, 1.1 * far, 513)
    p = origin + d[:, :, None, :] * t[:, None]
    phi = phase_at(rig.projector, g, p)
    ok = measuring_space(rig, camera, p, margin) & np.isfinite(phi)
    low, high = _extremes(phi, ok, camera.name)
    if rig.volume is not None:
        return np.stack([low, high, low, high])
    expected = ok & (np.abs(t - distance) < 0.25 * distance)
    return np.stack([low, high, *(_extremes(phi, expected, camera.name) if expected.any() else (low, high))])


def _extremes(phi: F64, ok: Bool, name: str) -> tuple[F64, F64]:
    """Smallest and largest of `phi` (h, w, n) where `ok`, grown to the neighbours' extremes; holes filled."""
    step = np.where(ok[..., 1:] & ok[..., :-1], np.abs(np.diff(phi, axis=2)), 0.0).max(axis=2)
    low = np.where(ok, phi, np.inf).min(axis=2)
    high = np.where(ok, phi, -np.inf).max(axis=2)
    with np.errstate(invalid="ignore"):
        grow = step + 0.01 * (high - low)
        low, high = low - grow, high + grow
    missed = np.asarray(~ok.any(axis=2))
    if missed.all():
        raise RigError(f"camera '{name}' and the projector share no view in the measuring volume; check the rig")
    if missed.any():
        there = np.argwhere(~missed)
        for a, b in np.argwhere(missed):
            c, e = there[np.argmin(((there - (a, b)) ** 2).sum(1))]
            low[a, b], high[a, b] = low[c, e], high[c, e]
    window = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.erode(low, window)), np.asarray(cv2.dilate(high, window))


def epipolar_field(rig: Rig, camera: Camera, g: tuple[float, float], size: tuple[int, int] = (18, 26)) -> F64:
    """Where the phase of gradient `g` must grow in a camera's image, if the fringes come straight from the projector.

    Along the image of a projector ray the order of points is kept on every surface that faces both devices; the
    derivative of the phase along that epipolar direction has one sign. Returns (h, w, 3): the unit direction (du, dv)
    in camera pixels along which the phase grows, and the growth in radians per pixel on a surface that faces both.
    """
    h, w = size
    L = camera.lens
    v, u = np.meshgrid(np.linspace(0, L.height - 1, h), np.linspace(0, L.width - 1, w), indexing="ij")
    uv = np.stack([u, v], -1)
    origin = centre(camera.pose)
    mid = rig.volume.center if rig.volume is not None else working_point(rig)
    projector_centre = centre(rig.projector.pose)
    to_camera, to_projector = origin - mid, projector_centre - mid
    n = to_camera / np.linalg.norm(to_camera) + to_projector / np.linalg.norm(to_projector)
    n /= np.linalg.norm(n)

    def on_plane(q: F64) -> F64:
        o, r = world_rays(camera, q)
        return np.asarray(o + r * (((mid - o) @ n) / (r @ n))[..., None])

    p = on_plane(uv)
    away = p - projector_centre
    away /= np.linalg.norm(away, axis=-1, keepdims=True)
    e = project(camera, p + away) - project(camera, p - away)
    e /= np.linalg.norm(e, axis=-1, keepdims=True)
    slope = phase_at(rig.projector, g, on_plane(uv + e)) - phase_at(rig.projector, g, on_plane(uv - e))
    return np.concatenate([e * np.sign(slope)[..., None], np.abs(slope)[..., None] / 2], axis=-1)


@dataclass(frozen=True, eq=False)
class DepthTable:
    """Depth as a smooth function of pixel and phase: the rig, as kernels read it (see `depth_table`)."""

    cubics: F64  #: (rows, segments, 9, 4): along a row, between nodes `step` pixels apart; rows of nodes from -step on
    step: int  #: pixels
    depth: float  #: mm along the camera's axis, at which the table's turns are those of the ray
    error_mm: float  #: largest difference from the exact solution at random places of the space


def depth_table(rig: Rig, camera: Camera, g: tuple[float, float], margin: float, step: int | None = None) -> DepthTable:
    """Where a camera's rays meet the fringes of gradient `g`, in place of Newton's method at every pixel.

    At nodes `step` pixels apart (default: 24 along a row): turns at `depth`, curvature b, s0 .. s3, the ray's world
    point there. Delta turns beyond, the depth grows by delta (s0 + s1 delta + s2 delta^2 + s3 delta^3) /
    (1 - b delta): exact without distortion (equation 15), where s1 .. s3 vanish; b is the pinhole's, the rest is
    fitted to the exact projection over the measuring space grown by `margin`. Raises RigError if rays or fringes
    cannot be followed through that space.
    """
    return _depth_table(rig, camera, (float(g[0]), float(g[1])), margin, step or max(1, -(-camera.lens.width // 24)))


@lru_cache(maxsize=32)
def _depth_table(rig: Rig, camera: Camera, g: tuple[float, float], margin: float, step: int) -> DepthTable:
    L = camera.lens
    near, far = _depths(rig, camera, margin)
    z0 = 0.5 * (near + far)
    rows, columns = (L.height - 1) // step + 4, (L.width - 1) // step + 4
    v, u = np.meshgrid(*(step * (np.arange(n) - 1.0) for n in (rows, columns)), indexing="ij")
    fields = _depth_fields(rig, camera, g, unproject(L, np.stack([u, v], -1)), z0, near, far)
    if not np.isfinite(fields).all():
        raise RigError(f"camera '{camera.name}': its lens cannot be followed over the whole picture; check K")
    a, b, c, d = (fields[:, k : columns - 3 + k] for k in range(4))
    powers = [b, -a / 3 - b / 2 + c - d / 6, a / 2 - b + c / 2, -a / 6 + b / 2 - c / 2 + d / 6]
    cubics = np.ascontiguousarray(np.stack(powers, -1))
    rng = np.random.default_rng(0)
    at = rng.uniform(0, 1, (4000, 3)) * [L.width - 1, L.height - 1, far - near] + [0, 0, near]
    ray = np.concatenate([unproject(L, at[:, :2]), np.ones((len(at), 1))], 1)
    exact = transform(inverse(camera.pose), ray * at[:, 2:])
    turns = phase_at(rig.projector, g, exact) / (2 * np.pi)
    found = points_by_table(cubics, step, z0, centre(camera.pose), at[:, :2], turns)
    seen = np.isfinite(turns) & measuring_space(rig, camera, exact, margin)
    error = float(np.abs(found - exact)[seen].max()) if seen.any() else np.inf
    return DepthTable(cubics, step, z0, error if np.isfinite(error) else np.inf)


def _depths(rig: Rig, camera: Camera, margin: float) -> tuple[float, float]:
    """Least and greatest depth along a camera's axis, mm, of the measuring space."""
    if rig.volume is None:
        return common_depths(rig, camera)
    middle = float(transform(camera.pose, rig.volume.center)[2])
    reach = margin * float(np.abs(rig.volume.axes @ camera.pose.R[2]) @ rig.volume.half_size)
    return max(middle - reach, 1e-3 * middle), middle + reach


def _depth_fields(
    rig: Rig, camera: Camera, g: tuple[float, float], n: F64, z0: float, near: float, far: float
) -> F64:
    """The nine fields (h, w, 9) of `depth_table` at rays of ideal coordinates `n` (h, w, 2)."""
    back = inverse(camera.pose)
    ray = np.concatenate([n, np.ones((*n.shape[:-1], 1))], -1)
    here = transform(back, ray * z0)
    c0 = phase_at(rig.projector, g, here) / (2 * np.pi)
    depths = z0 + 0.5 * (far - near) * np.cos(np.pi * (np.arange(10) + 0.5) / 10)  # Chebyshev's points, none at z0
    grown = depths - z0
    delta = np.stack([phase_at(rig.projector, g, transform(back, ray * z)) for z in depths], -1) / (2 * np.pi)
    delta -= c0[..., None]
    h = 1e-4 * z0
    ends = [phase_at(rig.projector, g, transform(back, ray * z)) / (2 * np.pi) for z in (z0 - h, z0 + h)]
    rate = (ends[1] - ends[0]) / (2 * h)
    to_projector = compose(rig.projector.pose, back)
    axis = ray @ to_projector.R[2]  # growth of the depth below the projector
    bend = axis / ((z0 * axis + to_projector.t[2]) * rate)
    scale = np.abs(delta).max(axis=-1)[..., None]
    y = grown * (1 - bend[..., None] * delta) / delta
    A = (delta / scale)[..., None] ** np.arange(4)
    with np.errstate(all="ignore"):
        fit = np.linalg.solve(np.swapaxes(A, -1, -2) @ A, np.swapaxes(A, -1, -2) @ y[..., None])[..., 0]
    return np.concatenate([c0[..., None], bend[..., None], fit / scale ** np.arange(4), here], -1)


def points_by_table(cubics: F64, step: int, depth: float, origin: F64, uv: F64, turns: F64) -> F64:
    """World points (n, 3) of pixels (n, 2) and absolute turns (n,), by a depth table: the slow, obvious way."""
    k = np.minimum(uv // step, np.array([cubics.shape[1] - 1, cubics.shape[0] - 4])).astype(int)
    x, y = (uv / step - k).T
    w = np.stack([-y * (y - 1) * (y - 2) / 6, (y + 1) * (y - 1) * (y - 2) / 2, -(y + 1) * y * (y - 2) / 2,
                  (y + 1) * y * (y - 1) / 6], -1)  # fmt: skip
    nodes = cubics[k[:, 1, None] + np.arange(4), k[:, 0, None]]
    f = np.einsum("nr,nrfm,nm->nf", w, nodes, x[:, None] ** np.arange(4))
    d = turns - f[:, 0]
    grown = d * (f[:, 2] + d * (f[:, 3] + d * (f[:, 4] + d * f[:, 5]))) / (1 - f[:, 1] * d)
    return np.asarray(f[:, 6:] + grown[:, None] * (f[:, 6:] - origin) / depth)
