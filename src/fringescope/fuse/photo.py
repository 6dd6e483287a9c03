"""Raw ring-light pictures to linear light, and the balance between the views' pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np

from fringescope import geometry, memory
from fringescope.errors import CaptureError
from fringescope.kernels import colour as k
from fringescope.kernels.views import constant
from fringescope.settings import FuseSettings
from fringescope.types import F32, F64, U8, AnyArray, Bool, Grid, Photo, PixelFormat, Rig

_RGGB = cv2.COLOR_BayerBG2RGB_EA  # BayerRG of the GenICam names is RGGB, which OpenCV names after its second row

_FEW = 10_000  # places that tell how two pictures differ


def _tables() -> tuple[U8, F32]:
    """sRGB (IEC 61966-2-1): light k / 4096 to codes (4097,), codes to light (256,)."""
    light = np.linspace(0.0, 1.0, 4097)
    curve = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    code = np.arange(256) / 255.0
    back = np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    return (curve * 255.0 + 0.5).astype(np.uint8), back.astype(np.float32)


SRGB, LIGHT = _tables()


def _samples(raw: AnyArray, pixel_format: PixelFormat, camera: str) -> AnyArray:
    """Raw samples (H, W) or (H, W, 3) to codes (H, W, 3), or (H, W, 1) for grey."""
    if pixel_format is PixelFormat.RGB8:
        if raw.ndim != 3 or raw.shape[2] != 3:
            raise CaptureError(f"camera '{camera}': a picture of shape {raw.shape}; RGB8 needs (height, width, 3)")
        return raw
    if raw.ndim != 2:
        raise CaptureError(f"camera '{camera}': a picture of shape {raw.shape}; {pixel_format.value} needs one sample "
                           "a pixel, as the sensor gave it")
    if not pixel_format.is_bayer:
        return raw[:, :, None]
    if min(raw.shape) < 4:
        raise CaptureError(f"camera '{camera}': {raw.shape[1]} x {raw.shape[0]} pixels; needed at least 4 x 4")
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(raw), _RGGB))


def _light(samples: AnyArray, pixel_format: PixelFormat, s: FuseSettings) -> F32:
    """Codes (H, W, 3 or 1) to linear light (H, W, 3), 0..1 of full scale, white-balanced; grey is one channel thrice.
    """
    white = [s.white_red, 1.0, s.white_blue] if pixel_format.is_colour else [1.0]
    out = memory.empty((*samples.shape[:2], len(white)), np.float32)
    k.scale(constant(samples), (np.array(white) / pixel_format.max_value).astype(np.float32), out)
    return np.broadcast_to(out, (*samples.shape[:2], 3))


def photo(raw: AnyArray, pixel_format: PixelFormat, camera: str, s: FuseSettings | None = None) -> Photo:
    """A raw ring-light picture as linear light.

    `raw` is (H, W) for mono and Bayer formats, (H, W, 3) for RGB8, uint8 or uint16 codes, right-aligned; codes
    are taken as proportional to light, as they are in the fringes. Bayer pictures are demosaiced along edges, without a
    shift. White balance: `white_red` and `white_blue` of the settings (`white_gains` finds them). A pixel is saturated
    if any raw sample that went into it is. Mono gives grey. Raises CaptureError if the shape does not fit the format.
    """
    s = s or FuseSettings()
    rgb = _light(_samples(raw, pixel_format, camera), pixel_format, s)
    full = memory.empty(raw.shape[:2], np.bool_)
    k.full(constant(raw if raw.ndim == 3 else raw[:, :, None]), pixel_format.max_value,
           1 if pixel_format.is_bayer else 0, full)
    return Photo(camera, rgb, full)


def photo_from_background(background: F32, pixel_format: PixelFormat, camera: str,
                          s: FuseSettings | None = None) -> Photo:
    """The fringes' background A (H, W), codes, as a picture, for captures without a ring-light picture.

    It shows the specimen under the projector's light. A Bayer camera's background is a mosaic like its frames.
    """
    codes, bright = memory.empty(background.shape, np.uint16), memory.empty(background.shape, np.bool_)
    k.share_codes(constant(background), np.float32(1.0 / pixel_format.full_scale), np.float32(0.99), codes, bright)
    like = PixelFormat.BAYER_RG16 if pixel_format.is_bayer else PixelFormat.MONO16
    return Photo(camera, _light(_samples(codes, like, camera), like, s or FuseSettings()), bright)


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


def samples_of(p: Photo) -> tuple[F32, int]:
    """A picture's light, flat, as kernels take it, and its channels: 1 where one stands for all three."""
    channels = 1 if p.rgb.strides[2] == 0 else 3
    return constant(p.rgb[..., :channels]).reshape(-1), channels


def is_grey(p: Photo) -> bool:
    """Whether a picture holds no colour at all, judged by some of its pixels."""
    if p.rgb.strides[2] == 0:
        return True
    step = 7 * max(1, int(math.sqrt(p.saturated.size / _FEW)))
    some = p.rgb[::step, ::step]
    return bool((some[..., 0] == some[..., 1]).all() and (some[..., 1] == some[..., 2]).all())


def encode_srgb(linear: AnyArray) -> U8:
    """Linear light 0..1 to sRGB codes (IEC 61966-2-1), clipped."""
    flat = np.ascontiguousarray(linear, np.float32).reshape(-1, 1, 1)
    out = np.empty((*flat.shape[:2], 3), np.uint8)
    k.encode(np.broadcast_to(flat, out.shape), np.ones(3, np.float32), SRGB, out)
    return out[:, 0, 0].reshape(np.shape(linear))


def decode_srgb(codes: U8) -> F32:
    """sRGB codes to linear light 0..1."""
    return LIGHT[codes]


def view_gains(grids: Sequence[Grid], photos: Sequence[Photo], rig: Rig, s: FuseSettings) -> F64:
    """Factors (V, 3) that make the pictures agree where views overlap; their geometric mean is 1 per channel.

    For each pair of views the mean of the middle half of the log ratios of what both see unsaturated (at some 10,000
    places where their surfaces agree); then least squares over the pairs. Views without overlap keep 1, as do a grey
    picture's ratios of channels, and all if `harmonise` is off.
    """
    V = len(grids)
    if V < 2 or not s.harmonise:
        return np.ones((V, 3))
    rows: list[F64] = []
    values: list[F64] = []
    grey = [is_grey(p) for p in photos]
    near = [4 * _spacing(g) + s.agree_mm for g in grids]
    for a in range(V):
        where = _places(grids[a], photos[a])
        p = grids[a].xyz[where[0], where[1]]
        for b in range(V):
            if a == b:
                continue
            H, W = grids[b].sigma.shape
            uv = geometry.project(rig.cameras[grids[b].view], p)
            with np.errstate(invalid="ignore"):
                inside = (uv > 0).all(axis=1) & (uv[:, 0] < W - 1) & (uv[:, 1] < H - 1)
            j, i = np.rint(uv[inside]).astype(int).T
            q = grids[b].xyz[i, j]
            with np.errstate(invalid="ignore"):
                same = np.linalg.norm(q - p[inside], axis=1) < near[b]
            same &= ~photos[b].saturated[i, j]
            ca = photos[a].rgb[where[0][inside][same], where[1][inside][same]]
            cb = photos[b].rgb[i[same], j[same]]
            bright = ((ca > 0.01) & (cb > 0.01)).all(axis=1)
            if int(bright.sum()) < 200:
                continue
            ratio = _middle(np.log(cb[bright] / ca[bright]))
            if grey[a] or grey[b]:
                ratio[:] = ratio.mean()
            row = np.zeros(V)
            row[a], row[b] = 1.0, -1.0
            rows.append(row)
            values.append(ratio)
    if not rows:
        return np.ones((V, 3))
    log_gain = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]
    return np.asarray(np.exp(np.clip(log_gain, -1.5, 1.5)), dtype=np.float64)


def _places(grid: Grid, photo: Photo) -> tuple[AnyArray, AnyArray]:
    """Rows and columns of unsaturated points, about `_FEW` of a whole picture's, on a lattice."""
    H, W = grid.sigma.shape
    step = max(1, int(math.sqrt(H * W / _FEW))) | 1  # odd, so that all samples of a mosaic take part
    i, j = np.nonzero((grid.reasons[::step, ::step] == 0) & ~photo.saturated[::step, ::step])
    if len(i) < _FEW // 10 and step > 1:  # a small part of the picture
        i, j = np.nonzero((grid.reasons == 0) & ~photo.saturated)
        step = 1
        thin = max(1, len(i) // _FEW)
        i, j = i[::thin], j[::thin]
    return i * step, j * step


def _middle(values: F32) -> F64:
    """Mean of the middle half of each column: robust like the median, but not caught on the codes of the camera."""
    v = np.sort(values, axis=0)[len(values) // 4 : len(values) - len(values) // 4]
    return np.asarray(v.mean(axis=0), dtype=np.float64)


def _spacing(grid: Grid) -> float:
    """Median distance of neighbouring points, mm, in some rows."""
    d = np.linalg.norm(np.diff(grid.xyz[:: max(8, len(grid.xyz) // 32)], axis=1), axis=2)
    d = d[np.isfinite(d)]
    return float(np.median(d)) if len(d) else 0.0
