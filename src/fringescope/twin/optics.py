"""Light from mirror to surface and from surface to sensor: lattice, defocus, and the sensor in physical units."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fringescope.errors import UsageError
from fringescope.twin import loops
from fringescope.types import F32, F64, U8, AnyArray, Layout, Lens, PixelFormat, Pose, Projector

MARGIN = 32  #: dark units of the projector plane kept around it, so that blur fades out beyond its edge


def lens_numbers(lens: Lens) -> F64:
    """The ten numbers of a lens that the loops take."""
    K = lens.K
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], K[0, 1], *lens.distortion])


def look(lens: Lens, pose: Pose, uv: F64) -> tuple[F64, F64]:
    """Origin (3,) and unit directions (n, 3), world, of the rays through plane coordinates (n, 2) of a device."""
    out = np.empty((len(uv), 3))
    loops.directions(np.ascontiguousarray(uv, dtype=np.float64), np.asarray(pose.R), lens_numbers(lens), out)
    return -np.asarray(pose.R).T @ np.asarray(pose.t), out


def land(lens: Lens, pose: Pose, points: F64) -> F64:
    """World points (n, 3) to (u, v, depth) (n, 3) of a device; NaN behind it."""
    out = np.empty((len(points), 3))
    loops.plane_coordinates(
        np.ascontiguousarray(points), np.asarray(pose.R), np.asarray(pose.t), lens_numbers(lens), out
    )
    return out


# ------------------------------------------------------------------------------------------------- the projector


@dataclass(frozen=True)
class ProjectorOptics:
    """How the projector turns an image into light.

    `gamma`: light = (code / 255) ** gamma. `contrast`: white over black light. `blur_units`: standard deviation of
    the lens at focus, in plane units along v. `focus_mm`: distance of best focus. `aperture_mm`: entrance pupil,
    which sets how defocus grows. `falloff`: exponent of the cosine with which light drops off axis.
    """

    gamma: float = 1.0
    contrast: float = 600.0
    blur_units: float = 1.0
    focus_mm: float = 495.0
    aperture_mm: float = 9.0
    falloff: float = 3.0


def mirror_light(image: U8, projector: Projector, optics: ProjectorOptics) -> F32:
    """Light on the projector plane just behind the mirrors, averaged over unit cells, with a dark `MARGIN` around.

    Exact for square mirrors: on the diamond lattice a mirror is the square |du| + |dv| <= 1 of two cells' area, so
    the cell on it is filled by it and the cell between mirrors is shared by its four neighbours.

    `image`: (height, width) uint8. Returns (V + 2 MARGIN, U + 2 MARGIN) float32, white = 1.
    """
    if image.shape != (projector.height, projector.width) or image.dtype != np.uint8:
        raise UsageError(
            f"an image of {image.shape} {image.dtype}; "
            f"the projector shows ({projector.height}, {projector.width}) uint8"
        )
    table = (np.arange(256) / 255.0) ** optics.gamma
    table = ((table + 1.0 / optics.contrast) / (1.0 + 1.0 / optics.contrast)).astype(np.float32)
    light = table[image]
    w, h = projector.plane_size
    out = np.zeros((h + 2 * MARGIN, w + 2 * MARGIN), dtype=np.float32)
    inner = out[MARGIN : MARGIN + h, MARGIN : MARGIN + w]
    if projector.layout is Layout.GRID:
        inner[:] = light
        return out
    inner[0::2, 0::2] = light[0::2]
    inner[1::2, 1::2] = light[1::2]
    a, b = MARGIN, MARGIN + w
    for r, c in ((0, 1), (1, 0)):
        rows, cols = slice(a + r, MARGIN + h, 2), slice(a + c, b, 2)
        up, down = slice(rows.start - 1, rows.stop - 1, 2), slice(rows.start + 1, rows.stop + 1, 2)
        left, right = slice(cols.start - 1, cols.stop - 1, 2), slice(cols.start + 1, cols.stop + 1, 2)
        out[rows, cols] = 0.25 * (out[up, cols] + out[down, cols] + out[rows, left] + out[rows, right])
    return out


class LightStack:
    """One pattern at several degrees of blur, sampled every `step` units of the projector plane (1, or 2 where all is
    blurred).

    `sigmas` (L,): standard deviations in plane units along v, growing; `aspect` = fx / fy of the projector.
    """

    def __init__(self, sigmas: F64, aspect: float) -> None:
        self.sigmas = np.asarray(sigmas, dtype=np.float64)
        self.aspect = aspect
        self.step = 2 if self.sigmas[0] * min(aspect, 1.0) >= 1.3 else 1

    def place(self, sigma: AnyArray, u: AnyArray, v: AnyArray) -> tuple[F32, F32, F32]:
        """Column, row and (fractional) level at which light of standard deviation `sigma` at (u, v) is looked up.

        Between levels the variance is interpolated; beyond the last it is clipped.
        """
        var = self.sigmas**2
        level = np.interp(np.asarray(sigma, dtype=np.float64) ** 2, var, np.arange(len(var)))
        x, y = ((np.asarray(c, dtype=np.float64) + MARGIN + 0.5) / self.step - 0.5 for c in (u, v))
        return x.astype(np.float32), y.astype(np.float32), level.astype(np.float32)

    def build(self, light: F32) -> F32:
        """All levels (L, h / step, w / step) of `light` (h, w)."""
        a, before = light, 0.0
        if self.step == 2:
            h, w = (light.shape[0] // 2) * 2, (light.shape[1] // 2) * 2
            a = 0.25 * (light[0:h:2, 0:w:2] + light[1:h:2, 0:w:2] + light[0:h:2, 1:w:2] + light[1:h:2, 1:w:2])
            before = 0.25
        out = np.empty((len(self.sigmas), *a.shape), dtype=np.float32)
        scratch = np.empty_like(a)
        for k, s in enumerate(self.sigmas):
            sigma = math.sqrt(max(s * s - before, 0.0)) / self.step
            loops.blur(a, _taps(sigma, sigma * self.aspect), scratch, out[k])
            a, before = out[k], max(s * s, before)
        return out


def blur_levels(smallest: float, largest: float) -> F64:
    """Standard deviations of a light stack that covers the span: a ratio of at most 1.75 from level to level, at least
    two.
    """
    low = max(smallest, 0.4)
    high = max(largest, 1.2 * low)
    n = max(2, math.ceil(math.log(high / low) / math.log(1.75)) + 1)
    out: F64 = low * (high / low) ** (np.arange(n) / (n - 1))
    return out


def _taps(sigma_v: float, sigma_u: float) -> F32:
    """Half kernels (2, r + 1) of a Gauss blur along v and u."""
    r = max(1, math.ceil(3.5 * max(sigma_v, sigma_u)))
    taps = np.zeros((2, r + 1), dtype=np.float32)
    for row, s in enumerate((sigma_v, sigma_u)):
        k = np.exp(-0.5 * (np.arange(r + 1) / max(s, 1e-3)) ** 2)
        taps[row] = k / (k[0] + 2 * k[1:].sum())
    return taps


def defocus_sigma(focal_units: float, aperture_mm: float, focus_mm: float, depth: AnyArray) -> AnyArray:
    """Standard deviation, in units of `focal_units`, of the blur disc of a thin lens at `depth` mm: a quarter of its
    diameter.
    """
    return 0.25 * focal_units * aperture_mm * np.abs(1.0 / focus_mm - 1.0 / depth)


# --------------------------------------------------------------------------------------------------- wet surfaces


def fresnel(f0: AnyArray, cosine: AnyArray) -> AnyArray:
    """Schlick's approximation of the share of light that a surface mirrors."""
    return f0 + (1.0 - f0) * (1.0 - np.clip(cosine, 0.0, 1.0)) ** 5


# ----------------------------------------------------------------------------------------------------- the camera


@dataclass(frozen=True)
class Sensor:
    """A sensor in physical units; the defaults are those of an IMX183.

    `full_well` and `read_noise` in electrons. At gain 1 the full well is the largest code. `offset_share`: black level
    as a share of the largest code. `filters` (3, 3): response of R, G, B sites to red, green, blue light.
    """

    full_well: float = 15000.0
    read_noise: float = 2.7
    offset_share: float = 2.0 / 255.0
    filters: tuple[tuple[float, float, float], ...] = ((0.80, 0.10, 0.02), (0.07, 0.84, 0.09), (0.01, 0.12, 0.75))
    mono: tuple[float, float, float] = (0.32, 0.40, 0.28)

    def response(self, pixel_format: PixelFormat) -> F64:
        """Response (channels, 3) to red, green and blue light: three rows behind filters, one without."""
        return np.array(self.filters if pixel_format.is_colour else (self.mono,))

    def read(
        self, signal: F32, electrons: float, pixel_format: PixelFormat, gain: float, rng: np.random.Generator | None
    ) -> AnyArray:
        """Codes of a `signal` (n,) of which 1 makes `electrons` photo-electrons; without `rng` no noise is drawn."""
        top = pixel_format.max_value
        noise = rng.standard_normal(signal.size, dtype=np.float32) if rng is not None else np.empty(0, np.float32)
        out = np.empty(signal.size, dtype=pixel_format.dtype)
        offset = self.offset_share * top
        scale = gain * (top - offset) / self.full_well
        loops.expose(signal, noise, electrons, self.read_noise, scale, offset, self.full_well, float(top), out)
        return out


@dataclass(frozen=True)
class CameraOptics:
    """Aperture (entrance pupil, mm), focus distance (mm), pixel pitch (mm) and how light drops off axis (cosine's
    exponent).
    """

    focus_mm: float = 592.0
    aperture_mm: float = 4.5
    falloff: float = 4.0
