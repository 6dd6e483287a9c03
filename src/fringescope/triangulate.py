"""Phase and rig to points (II-B, III-C, equations 8 to 15), exact for both lenses, nothing resampled, nothing smoothed.

Each point stands on its own pixel's samples. The paper's plane is the case without distortion; `pinhole=True` computes
it, so that the difference can be shown.
"""

from __future__ import annotations

import numpy as np

from fringescope import geometry
from fringescope.errors import DecodeError
from fringescope.kernels import rays
from fringescope.types import F32, U16, Decoded, Grid, Reason, Rig


def grid(
    decoded: Decoded,
    reasons: U16,
    rig: Rig,
    *,
    volume_margin: float = 1.25,
    max_miss: float = 6.0,
    pinhole: bool = False,
) -> Grid:
    """Organised points of one view in world mm, with sigma along the camera's ray.

    `reasons` (H, W): pixels with any bit get no point. Several directions are weighted by 1 / sigma^2; where they
    disagree by more than `max_miss` standard deviations the pixel is ORDER_UNCERTAIN. Points outside the measuring
    space are OUT_OF_VOLUME. `pinhole` leaves out both lenses' distortion (the paper's equation 15).
    Raises DecodeError if the orders are not settled or the frames are not of the size that the rig was calibrated at,
    RigError if the rig lacks the camera.
    """
    camera, projector = rig.camera(decoded.camera), rig.projector
    H, W = decoded.shape
    if not decoded.directions:
        raise DecodeError(f"view '{decoded.camera}': no absolute phase yet; settle the orders first")
    if (camera.lens.width, camera.lens.height) != (W, H):
        raise DecodeError(
            f"camera '{camera.name}': frames of {W} x {H} pixels, the rig was calibrated at "
            f"{camera.lens.width} x {camera.lens.height}; capture at that size or calibrate anew"
        )
    T_pc = geometry.compose(projector.pose, geometry.inverse(camera.pose))
    lenses = [geometry.without_distortion(d.lens) if pinhole else d.lens for d in (camera, projector)]
    phase = np.stack([d.phase for d in decoded.directions])
    sigma = np.stack([d.sigma for d in decoded.directions])
    g = np.array([d.g for d in decoded.directions], dtype=np.float64)
    xyz = np.empty((H, W, 3), np.float32)
    sigma_mm, miss = np.empty((H, W), np.float32), np.empty((H, W), np.float32)
    rays.triangulate(
        phase, sigma, reasons, g, geometry.lens_vector(lenses[0]), geometry.lens_vector(lenses[1]), T_pc.R, T_pc.t,
        camera.pose.R, camera.pose.t, xyz, sigma_mm, miss,
    )
    out = reasons.copy()
    lost = (reasons == 0) & ~np.isfinite(sigma_mm)
    out[lost] |= np.uint16(Reason.OUT_OF_VOLUME)
    out[(reasons == 0) & (miss > max_miss)] |= np.uint16(Reason.ORDER_UNCERTAIN)
    _outside(rig, decoded.camera, xyz, out, volume_margin)
    bad = out != 0
    xyz[bad] = np.nan
    sigma_mm[bad] = np.nan
    return Grid(rig.index(decoded.camera), decoded.camera, xyz, sigma_mm, out)


def _outside(rig: Rig, name: str, xyz: F32, reasons: U16, margin: float) -> None:
    """Mark points outside the measuring space and on the rim of the projector's field.

    A camera pixel that straddles the rim saw half a fringe: half its footprint, in projector units, is the margin.
    """
    camera, projector = rig.camera(name), rig.projector
    some = xyz[::7, ::7][np.isfinite(xyz[::7, ::7, 2])]
    if not len(some):
        some = np.array([rig.volume.center if rig.volume else geometry.working_point(rig)], dtype=np.float32)
    z_camera = float(np.median(geometry.transform(camera.pose, some)[:, 2]))
    z_projector = float(np.median(geometry.transform(projector.pose, some)[:, 2]))
    footprint = z_camera / camera.lens.K[0, 0]
    units_per_mm = np.array([projector.lens.K[0, 0], projector.lens.K[1, 1]]) / z_projector
    rim = np.maximum(0.5 * footprint * units_per_mm, 0.5)
    high = np.array(projector.plane_size) - 1 - rim
    if rig.volume is not None:
        box = rig.volume.center, rig.volume.axes, rig.volume.half_size * margin
    else:  # the slab of depths that all devices share: see `geometry.measuring_space`
        near, far = geometry.common_depths(rig, camera)
        middle = geometry.transform(geometry.inverse(camera.pose), [0.0, 0.0, (near + far) / 2])
        box = middle, camera.pose.R, np.array([np.inf, np.inf, (far - near) / 2])
    lens, bit = geometry.lens_vector(projector.lens), np.uint16(Reason.OUT_OF_VOLUME)
    rays.mark_outside(xyz, projector.pose.R, projector.pose.t, lens, rim, high, *box, reasons, bit)
