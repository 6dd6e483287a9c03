"""Three tissue specimens as height fields: domed, deeply folded, and thin-edged with a raised flap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fringescope.twin.shapes import Mesh
from fringescope.twin.textures import FASCIA, GUT, HEART, Finish, Lazy, Palette, film, fractal, noise, organ
from fringescope.types import F64, AnyArray

GRID = 720  #: vertices along each side of a specimen's grid
HALF_X, HALF_Y = 43.0, 29.0  #: mm; half size of the grid
BELOW = -1.0  #: mm; how far below the substrate the grid goes on outside a specimen
OUTLINE_X, OUTLINE_Y = 38.5, 24.5  #: mm; half axes of a specimen's outline before it is deformed


def _outline(x: F64, y: F64, rng: np.random.Generator, wobble: float = 0.045) -> F64:
    """Normalised distance from the middle: below 1 inside a wavy oval that always holds the oval 36 x 22."""
    a = np.arctan2(y / OUTLINE_Y, x / OUTLINE_X)
    r = np.hypot(x / OUTLINE_X, y / OUTLINE_Y)
    edge = np.ones_like(a)
    for k in (2, 3, 5, 7):
        edge += wobble / k * np.cos(k * a + rng.uniform(0, 2 * np.pi))
    return np.asarray(r / edge)


def _step(t: AnyArray) -> F64:
    t = np.clip(t, 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def _along(x: F64, rng: np.random.Generator, reach: float) -> F64:
    """A smooth line y(x) that wanders by about `reach` mm."""
    p, q = rng.uniform(0, 2 * np.pi, 2)
    return np.asarray(reach * (0.7 * np.sin(x / 11 + p) + 0.45 * np.sin(x / 6 + q)))


def _flank(t: AnyArray, softness: float = 0.08) -> F64:
    """The square root of t, but of finite slope at 0 and going on below it: a body's flank down to its foot.

    So the foot is a smooth line between the vertices of the grid, not a staircase along them.
    """
    return np.asarray(t / np.sqrt(np.sqrt(t * t + softness * softness)))


def _settled(h: F64, rim: float = 0.35) -> F64:
    """A soft wet body of height `h` on its substrate: its foot runs out into a rim of fluid `rim` mm high.

    `h` must go on falling below 0 outside the body: where it has come down to -3 mm, on a steep flank about a
    millimetre away, the rim has ended.
    """
    wetted = rim * np.clip(1 + np.minimum(h, 0) / 3.0, 0, None) ** 2
    return np.asarray(wetted + 0.5 * (h + np.sqrt(h * h + 0.01)) - 0.002 + np.minimum(h + 3.0, 0))


def domed(x: F64, y: F64, rng: np.random.Generator) -> F64:
    """Height above the substrate of a domed organ with two grooves."""
    r = _outline(x, y, rng)
    h = 15.5 * _flank(1 - r**2.6) * (0.92 + 0.10 * noise(x, y, 24, rng))
    h += np.where(r < 1, 0.9 * fractal(x, y, 11, 3, rng) * _step((1 - r) * 4), 0)
    for k, depth in enumerate((3.2, 1.8)):
        d = y - (-1) ** k * (2.0 + 5.0 * k) - _along(x, rng, 2.2)
        h -= depth * np.exp(-((d / 1.3) ** 2)) * _step((0.8 - np.abs(x - 3 * k) / OUTLINE_X) * 4) * _step((1 - r) * 3)
    h += np.where(r < 1, 0.05 * fractal(x, y, 1.3, 3, rng) * _step((1 - r) * 6), 0)
    return np.maximum(_settled(h), BELOW)


def folded(x: F64, y: F64, rng: np.random.Generator) -> F64:
    """Height of a mucosa thrown into deep winding folds: rounded crests, narrow steep clefts 4-6 mm deep."""
    r = _outline(x, y, rng, 0.03)
    wx, wy = x + 5.0 * noise(x, y, 17, rng), y + 4.0 * noise(x, y, 15, rng)
    a = rng.uniform(0.2, 0.5)
    s = (np.cos(a) * wy + np.sin(a) * wx) / 9.5 + 0.25 * noise(x, y, 10, rng)
    crest = np.sqrt(np.abs(np.sin(np.pi * s)) + 1e-4)  # cusps downwards: the clefts
    crest = np.clip((crest - 0.16) / 0.84, 0, 1)
    depth = 5.2 * (1 + 0.25 * noise(x, y, 13, rng))
    body = 11.0 * _flank(1 - r**4) + 1.0 * noise(x, y, 21, rng) * _step((1 - r) * 4)
    h = body - depth * (1 - crest) * _step((1 - r) * 5)
    h += 0.06 * fractal(x, y, 1.4, 3, rng) * _step((1 - r) * 6)
    return np.maximum(_settled(np.where(r < 0.97, np.maximum(h, 0.25), h)), BELOW)


def thin(x: F64, y: F64, rng: np.random.Generator) -> F64:
    """Height of a thin sheet with a cut: one lip lies flat, the other is lifted to a free edge that casts a shadow."""
    r = _outline(x, y, rng, 0.06)
    h = 1.3 + 0.5 * noise(x, y, 12, rng) + 1.2 * np.clip(fractal(x, y, 19, 2, rng), 0, None)
    line = -3.0 + _along(x, rng, 1.8)
    cut = _step((y - line) / 1.2)
    lift = _step((0.62 - np.abs(x + 2.0) / OUTLINE_X) * 2.2)
    up = np.clip(1 - (y - line) / 15.0, 0, 1) ** 1.6
    h += 8.5 * cut * lift * up
    curl = np.exp(-(((y + 17 + 1.5 * noise(x, y, 14, rng)) / 2.6) ** 2))
    h += 2.4 * curl * (0.6 + 0.6 * noise(x, y, 16, rng)) * _step((1 - r) * 3)
    h += 0.05 * fractal(x, y, 1.2, 3, rng)
    rim = _step((1 - r) * 9) * 0.85 + 0.15
    edge = 12.0 * (1 - r)
    return np.maximum(np.minimum(np.maximum(h * rim, 0.22), edge), BELOW)


@dataclass(frozen=True)
class Specimen:
    """A kind of tissue: height above the substrate, colours, roughness of its film, scattering, the lamp it needs."""

    height: Callable[[F64, F64, np.random.Generator], F64]
    palette: Palette
    alpha: float
    scatter_mm: float
    lamp: float


SPECIMENS: dict[str, Specimen] = {
    "tissue-domed": Specimen(domed, HEART, 0.10, 0.18, 2.6),
    "tissue-folded": Specimen(folded, GUT, 0.12, 0.22, 2.2),
    "tissue-thin": Specimen(thin, FASCIA, 0.09, 0.25, 1.4),
}


def build(name: str, seed: int, base_z: float) -> tuple[Mesh, dict[str, AnyArray]]:
    """A specimen lying on the substrate at `base_z`: its mesh, and the truth arrays `V` (n n, 3) and `F` (m, 3).

    V is a square grid, x fastest; faces (a, b, d), (a, d, c) per cell; cells wholly below the substrate are left out.
    """
    kind = SPECIMENS[name]
    rng = np.random.default_rng([seed, 3])
    shift = rng.uniform(-1.0, 1.0, 2) * (1.2, 0.8)
    x, y = np.meshgrid(np.linspace(-HALF_X, HALF_X, GRID), np.linspace(-HALF_Y, HALF_Y, GRID))
    z = base_z + kind.height(x - shift[0], y - shift[1], rng)
    V = np.stack([x, y, z], -1).reshape(-1, 3)
    i = np.arange(GRID * GRID).reshape(GRID, GRID)
    a, b, c, d = (q.ravel() for q in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    F = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    F = F[(V[F, 2] > base_z - 0.05).any(1)]
    gy, gx = np.gradient(z, y[1, 0] - y[0, 0], x[0, 1] - x[0, 0])
    N = np.stack([-gx, -gy, np.ones_like(z)], -1).reshape(-1, 3)
    N /= np.linalg.norm(N, axis=1, keepdims=True)
    body, wet = Lazy(lambda: organ(kind.palette, seed)), Lazy(lambda: film(seed, 0.11))
    finish = Finish(body, kind.alpha, 0.035, kind.scatter_mm, wet)
    return Mesh(finish, V, N, F), {"V": V, "F": F}
