"""Raw ring-light pictures to linear light, and the balance between the views' pictures."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from fringescope import geometry
from fringescope.errors import CaptureError
from fringescope.settings import FuseSettings
from fringescope.types import F32, F64, U8, AnyArray, Bool, Grid, Photo, PixelFormat, Rig

_RGGB = cv2.COLOR_BayerBG2RGB_EA  # BayerRG of the GenICam names is RGGB, which OpenCV names after its second row


def _linear(raw: AnyArray, pixel_format: PixelFormat, camera: str) -> F32:
    """Raw samples (H, W) or (H, W, 3) to RGB (H, W, 3), 0..1 of full scale."""
    if pixel_format is PixelFormat.RGB8:
        if raw.ndim != 3 or raw.shape[2] != 3:
            raise CaptureError(f"camera '{camera}': a picture of shape {raw.shape}; RGB8 needs (height, width, 3)")
        rgb = raw
    elif raw.ndim != 2:
        raise CaptureError(f"camera '{camera}': a picture of shape {raw.shape}; {pixel_format.value} needs one sample "
                           "a pixel, as the sensor gave it")
    elif pixel_format.is_bayer:
        if min(raw.shape) < 4:
            raise CaptureError(f"camera '{camera}': {raw.shape[1]} x {raw.shape[0]} pixels; needed at least 4 x 4")
        rgb = cv2.cvtColor(np.ascontiguousarray(raw), _RGGB)
    else:
        rgb = np.repeat(raw[:, :, None], 3, axis=2)
    return np.asarray(rgb, dtype=np.float32) / np.float32(pixel_format.max_value)


def photo(raw: AnyArray, pixel_format: PixelFormat, camera: str, s: FuseSettings | None = None) -> Photo:
    """A raw ring-light picture as linear light.

    `raw` is (H, W) for mono and Bayer formats, (H, W, 3) for RGB8, uint8 or uint16 codes, right-aligned; codes
    are taken as proportional to light, as they are in the fringes. Bayer pictures are demosaiced along edges, without a
    shift. White balance: `white_red` and `white_blue` of the settings (`white_gains` finds them). A pixel is saturated
    if any raw sample that went into it is. Mono gives grey. Raises CaptureError if the shape does not fit the format.
    """
    s = s or FuseSettings()
    rgb = _linear(raw, pixel_format, camera)
    full = np.asarray(raw >= pixel_format.max_value)
    if full.ndim == 3:
        full = np.asarray(full.any(axis=2))
    if pixel_format.is_bayer:
        full = np.asarray(cv2.dilate(full.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    if pixel_format.is_colour:
        rgb *= np.array([s.white_red, 1.0, s.white_blue], np.float32)
    return Photo(camera, rgb, full)


def photo_from_background(background: F32, pixel_format: PixelFormat, camera: str,
                          s: FuseSettings | None = None) -> Photo:
    """The fringes' background A (H, W), codes, as a picture, for captures without a ring-light picture.

    It shows the specimen under the projector's light. A Bayer camera's background is a mosaic like its frames.
    """
    s = s or FuseSettings()
    share = np.clip(np.nan_to_num(background) / pixel_format.full_scale, 0.0, 1.0)
    like = PixelFormat.BAYER_RG16 if pixel_format.is_bayer else PixelFormat.MONO16
    p = photo((share * 65535.0 + 0.5).astype(np.uint16), like, camera, s)
    return Photo(camera, p.rgb, np.asarray(share >= 0.99))


def white_gains(white: Photo, region: Bool | None = None) -> tuple[float, float]:
    """The settings `white_red` and `white_blue` that make something white look white.

    `white` is a picture, taken with both at 1, of a white or grey thing that fills it or the mask `region` (H, W).
    """
    ok = ~white.saturated if region is None else ~white.saturated & region
    if int(ok.sum()) < 100:
        raise CaptureError(f"camera '{white.camera}': {int(ok.sum())} unsaturated pixels of the white thing; "
                           "needed at least 100: expose less")
    r, g, b = np.median(white.rgb[ok], axis=0)
    if min(r, g, b) <= 0:
        raise CaptureError(f"camera '{white.camera}': the white thing is black; expose more")
    return float(g / r), float(g / b)


def is_grey(p: Photo) -> bool:
    """Whether a picture holds no colour at all."""
    some = p.rgb[::7, ::7]
    return bool((some[..., 0] == some[..., 1]).all() and (some[..., 1] == some[..., 2]).all())


def encode_srgb(linear: AnyArray) -> U8:
    """Linear light 0..1 to sRGB codes (IEC 61966-2-1), clipped."""
    table = np.linspace(0.0, 1.0, 4097)
    table = np.where(table <= 0.0031308, 12.92 * table, 1.055 * table ** (1 / 2.4) - 0.055)
    codes = (table * 255.0 + 0.5).astype(np.uint8)
    return np.asarray(codes[(np.clip(np.nan_to_num(linear), 0.0, 1.0) * 4096.0 + 0.5).astype(np.uint16)])


def decode_srgb(codes: U8) -> F32:
    """sRGB codes to linear light 0..1."""
    c = np.arange(256) / 255.0
    table = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4).astype(np.float32)
    return table[codes]


def view_gains(grids: Sequence[Grid], photos: Sequence[Photo], rig: Rig, s: FuseSettings) -> F64:
    """Factors (V, 3) that make the pictures agree where views overlap; their geometric mean is 1 per channel.

    For each pair of views the mean of the middle half of the log ratios of what both see unsaturated (up to 50,000
    places where their surfaces agree); then least squares over the pairs. Views without overlap keep 1, as do a grey
    picture's ratios of channels.
    """
    V = len(grids)
    rows: list[F64] = []
    values: list[F64] = []
    for a in range(V):
        ok = grids[a].valid & ~photos[a].saturated
        where = np.argwhere(ok)
        where = where[:: max(1, len(where) // 50_000)]
        p = grids[a].xyz[where[:, 0], where[:, 1]]
        for b in range(V):
            if a == b:
                continue
            H, W = grids[b].sigma.shape
            uv = geometry.project(rig.cameras[grids[b].view], p)
            with np.errstate(invalid="ignore"):
                inside = (uv > 0).all(axis=1) & (uv[:, 0] < W - 1) & (uv[:, 1] < H - 1)
            j, i = np.rint(uv[inside]).astype(int).T
            q = grids[b].xyz[i, j]
            near = np.linalg.norm(q - p[inside], axis=1) < 4 * _spacing(grids[b]) + s.agree_mm
            near &= ~photos[b].saturated[i, j]
            ca = photos[a].rgb[where[inside][near, 0], where[inside][near, 1]]
            cb = photos[b].rgb[i[near], j[near]]
            bright = ((ca > 0.01) & (cb > 0.01)).all(axis=1)
            if int(bright.sum()) < 200:
                continue
            ratio = _middle(np.log(cb[bright] / ca[bright]))
            if is_grey(photos[a]) or is_grey(photos[b]):
                ratio[:] = ratio.mean()
            row = np.zeros(V)
            row[a], row[b] = 1.0, -1.0
            rows.append(row)
            values.append(ratio)
    if not rows:
        return np.ones((V, 3))
    log_gain = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]
    return np.asarray(np.exp(np.clip(log_gain, -1.5, 1.5)), dtype=np.float64)


def _middle(values: F32) -> F64:
    """Mean of the middle half of each column: robust like the median, but not caught on the codes of the camera."""
    v = np.sort(values, axis=0)[len(values) // 4 : len(values) - len(values) // 4]
    return np.asarray(v.mean(axis=0), dtype=np.float64)


def _spacing(grid: Grid) -> float:
    """Median distance of neighbouring points, mm."""
    d = np.linalg.norm(np.diff(grid.xyz[::8], axis=1), axis=2)
    d = d[np.isfinite(d)]
    return float(np.median(d)) if len(d) else 0.0
