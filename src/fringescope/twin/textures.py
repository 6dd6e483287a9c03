"""Colour and shine of surfaces: constants, boards, and procedural organ-like maps. Reflectances are linear, 0..1, (red,
green, blue).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fringescope.twin import loops
from fringescope.types import F32, F64, AnyArray

Colour = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Finish:
    """How a surface answers light.

    `albedo`: own coordinates (n, 3) to diffuse reflectance (n, 3). `alpha`: GGX roughness of its gloss; `f0`: share
    mirrored at normal incidence (0 = matt). `scatter_mm`: standard deviation of the sideways walk of light below
    the surface. `bumps`: own coordinates (n, 3) to slopes (n, 2) that the gloss sees (a wet film's waviness).
    """

    albedo: Callable[[F64], F64]
    alpha: float = 0.3
    f0: float = 0.0
    scatter_mm: float = 0.0
    bumps: Callable[[F64], F64] | None = None


def uniform(colour: Colour) -> Callable[[F64], F64]:
    """One reflectance everywhere."""

    def albedo(points: F64) -> F64:
        return np.broadcast_to(np.asarray(colour), (len(points), 3))

    return albedo


@dataclass(frozen=True, eq=False)
class Raster:
    """A map on a grid of own x and y: `values` (h, w, k), sample (0, 0) at `origin`, `step` mm; edges repeat."""

    values: F32
    origin: tuple[float, float]
    step: float

    def __call__(self, points: F64) -> F64:
        """Bilinear lookup at own coordinates (n, 3), (n, k)."""
        out = np.empty((len(points), self.values.shape[2]))
        loops.bilinear(self.values, *self.origin, self.step, np.ascontiguousarray(points), out)
        return out


class Lazy:
    """A map that is made when it is first looked at."""

    def __init__(self, make: Callable[[], Raster]) -> None:
        self._make = make

    @cached_property
    def raster(self) -> Raster:
        """The map."""
        return self._make()

    def __call__(self, points: F64) -> F64:
        """As `Raster`."""
        return self.raster(points)


def noise(x: AnyArray, y: AnyArray, cell_mm: float, rng: np.random.Generator) -> F64:
    """Smooth random field at (x, y): cubic spline over a random lattice of `cell_mm`; mean 0, about -1..1."""
    lattice = rng.uniform(-1.4, 1.4, (128, 128))
    x, y = np.broadcast_arrays(x, y)
    out = np.empty(x.size)
    loops.spline(lattice, np.ravel(x) / cell_mm + 46.1, np.ravel(y) / cell_mm + 47.3, out)
    return out.reshape(x.shape)


def fractal(x: AnyArray, y: AnyArray, cell_mm: float, octaves: int, rng: np.random.Generator, gain: float = 0.5) -> F64:
    """Sum of `octaves` noises, each of half the cell and `gain` times the height of the one before."""
    out = np.zeros(np.broadcast(x, y).shape)
    for k in range(octaves):
        out += gain**k * noise(x, y, cell_mm / 2**k, rng)
    return out


def _mix(a: AnyArray, b: Colour, t: AnyArray) -> F64:
    return np.asarray(a + (np.asarray(b) - a) * np.clip(t, 0, 1)[..., None])


@dataclass(frozen=True)
class Palette:
    """Colours of a specimen: its body, darker and paler zones, and vessels."""

    body: Colour
    dark: Colour
    pale: Colour
    vessel: Colour
    pale_share: float = 0.3  #: -1..1: how much of the surface is pale
    dark_share: float = 0.0


HEART = Palette((0.40, 0.10, 0.08), (0.17, 0.045, 0.04), (0.74, 0.60, 0.36), (0.22, 0.045, 0.05), -0.12, 0.1)
GUT = Palette((0.66, 0.31, 0.25), (0.36, 0.085, 0.075), (0.80, 0.62, 0.46), (0.34, 0.07, 0.08), 0.0, 0.1)
FASCIA = Palette((0.50, 0.19, 0.15), (0.24, 0.055, 0.05), (0.82, 0.74, 0.60), (0.28, 0.06, 0.10), 0.15, 0.0)


def organ(palette: Palette, seed: int, half_x: float = 46.0, half_y: float = 32.0, step: float = 0.1) -> Raster:
    """An organ-like reflectance map: body colour, dark and pale zones, fibres, branching vessels, fine grain."""
    rng = np.random.default_rng([seed, 7, int(1000 * palette.body[1])])
    x, y = np.meshgrid(np.arange(-half_x, half_x + step, step), np.arange(-half_y, half_y + step, step))
    wx, wy = x + 4 * noise(x, y, 14, rng), y + 4 * noise(x, y, 14, rng)
    c = np.broadcast_to(np.asarray(palette.body), (*x.shape, 3))
    c = _mix(c, palette.dark, 2.2 * (fractal(wx, wy, 22, 4, rng) + palette.dark_share))
    c = _mix(c, palette.pale, 2.6 * (fractal(wx, wy, 17, 4, rng) + palette.pale_share - 0.25))
    vessel = np.abs(fractal(wx, wy, 12, 3, rng, 0.4))
    width = 0.045 * (1 + 0.8 * noise(x, y, 18, rng))
    c = _mix(c, palette.vessel, 0.75 * np.exp(-((vessel / np.maximum(width, 0.01)) ** 2)))
    fibre = fractal(0.25 * wx + 0.1 * wy, 1.6 * wy, 1.6, 3, rng)
    grain = fractal(x, y, 0.8, 2, rng)
    c = c * (1 + 0.10 * fibre + 0.07 * grain)[..., None]
    return Raster(np.clip(c, 0.01, 0.92).astype(np.float32), (float(x[0, 0]), float(y[0, 0])), step)


def film(seed: int, slope: float, cell_mm: float = 1.6, half: float = 48.0, step: float = 0.15) -> Raster:
    """Slopes (2) of a wavy wet film: standard deviation about `slope`."""
    rng = np.random.default_rng([seed, 11])
    x, y = np.meshgrid(np.arange(-half, half + step, step), np.arange(-half, half + step, step))
    s = np.stack([fractal(x, y, cell_mm, 2, rng) for _ in range(2)], -1)
    return Raster((slope * s / s.std()).astype(np.float32), (-half, -half), step)
