"""Poses T_ab, projection and unprojection with both lenses exact, rays, and the projector's lattice (grid or diamond).

Conventions (docs/conventions.md): mm; x right, y down, z forward; (0, 0) is the centre of the top-left pixel; T_ab maps
b to a. Lens model: OpenCV, "Camera Calibration and 3D Reconstruction"; equations 1, 2, 6, 12 and 19 of the paper.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fringescope.errors import RigError
from fringescope.kernels import lens as k
from fringescope.types import F64, Bool, Camera, Layout, Lens, Pose, Projector, Rig, Volume


def lens_vector(lens: Lens) -> F64:
    """The ten numbers that kernels take: fx, fy, u0, v0, skew, k1, k2, p1, p2, k3."""
    K, d = lens.K, lens.distortion
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1], *d], dtype=np.float64)


def without_distortion(lens: Lens) -> Lens:
    """The same lens as the plain pinhole of the paper's equations 2 and 6."""
    return Lens(lens.width, lens.height, lens.K, np.zeros(5))


def inverse(T_ab: Pose) -> Pose:
    """T_ba from T_ab."""
    return Pose(T_ab.R.T, -T_ab.R.T @ T_ab.t)


def compose(T_ab: Pose, T_bc: Pose) -> Pose:
    """T_ac = T_ab T_bc."""
    return Pose(T_ab.R @ T_bc.R, T_ab.R @ T_bc.t + T_ab.t)


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
    k.pixel_rays(lens.height, lens.width, lens_vector(lens), out)
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
