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
    rim: float = 0.5,
    max_miss: float = 6.0,
    pinhole: bool = False,
) -> Grid:
    """Organised points of one view in world mm, with sigma along the camera's ray.

    `reasons` (H, W): pixels with any bit get no point. Several directions are weighted by 1 / sigma^2; where they
    disagree by more than `max_miss` standard deviations the pixel is ORDER_UNCERTAIN. Points outside the measuring
    space are OUT_OF_VOLUME, and those within `rim` units (along v) of the
    edge of the projector's field. `pinhole` leaves out both lenses' distortion (the paper's equation 15).
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
    field, box = geometry.lit_field(rig, camera, rim), geometry.measuring_box(rig, camera, volume_margin)
    bit = np.uint16(Reason.OUT_OF_VOLUME)
    rays.mark_outside(
        xyz, projector.pose.R, projector.pose.t, geometry.lens_vector(projector.lens), *field, *box, out, bit
    )
    rays.blank(xyz, sigma_mm, out)
    return Grid(rig.index(decoded.camera), decoded.camera, xyz, sigma_mm, out)


def blanked(xyz: F32, sigma: F32, reasons: U16, rig: Rig, camera: str) -> Grid:
    """Points (H, W, 3) and sigma (H, W) that were made of all pixels, without those that have a reason (in place)."""
    rays.blank(xyz, sigma, reasons)
    return Grid(rig.index(camera), camera, xyz, sigma, reasons)
