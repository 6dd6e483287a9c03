"""What loose images say of themselves: fits, residuals in other orders, density and sense of the fringes.

Looked at on a central window of the pictures, in plain numpy: this is a check at the rim, not the decoder.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np

from fringescope.importing.loose import LooseFrames, Recipe
from fringescope.types import F32, F64, AnyArray, Bool, FringeSet

WINDOW = 800  #: pixels, side of the central window that is looked at
SAMPLES = 4000  #: pixels whose samples are tried in other orders


@dataclass(frozen=True, eq=False)
class SetEvidence:
    """What the pictures say of one set in the order given. Maps are (H, W) of the window."""

    index: int
    set: FringeSet
    first: AnyArray  #: its first frame
    phase: F64  #: wrapped, radians
    lit: Bool  #: bright and modulated enough to be asked
    residual_map: F32 | None  #: rms misfit of the samples over the modulation; None for N = 3
    residual: float  #: median of that over lit pixels; NaN for N = 3
    best_order: tuple[int, ...]  #: of the set's frames, that with the least residual
    best_residual: float
    slope: tuple[float, float]  #: growth of the phase per camera pixel along x and y, radians

    @property
    def density(self) -> float:
        """Radians of phase per camera pixel."""
        return math.hypot(*self.slope)


def wrap(x: F64) -> F64:
    """Radians into (-pi, pi]."""
    return np.asarray(np.pi - np.mod(np.pi - x, 2 * np.pi))


def fit(samples: AnyArray) -> tuple[F64, F64, F64, F64]:
    """N-step fit of samples (N, ...) with `I_n = A + B cos(Phi - 2 pi n/N)`: phase, background, modulation, misfit."""
    x = np.asarray(samples, np.float64)
    N = len(x)
    d = 2 * np.pi * np.arange(N) / N
    s, c = np.tensordot(np.sin(d), x, 1), np.tensordot(np.cos(d), x, 1)
    a, b = x.mean(0), 2 * np.hypot(s, c) / N
    energy = np.maximum((x * x).mean(0) - a * a - b * b / 2, 0)
    return np.arctan2(s, c), a, b, np.sqrt(energy * N / max(N - 3, 1))


def candidates(n: int) -> list[tuple[int, ...]]:
    """Orders of n steps that differ by more than a rotation or a reversal, which leave the residual as it is.

    All of them up to 6 steps; above, those that happen: two files swapped, even before odd, names sorted as text.
    """
    if n <= 6:
        return [(0, *p) for p in permutations(range(1, n)) if p[0] <= p[-1]]
    base = list(range(n))
    halves = base[0::2] + base[1::2]
    out = [base, halves, [int(k) for k in np.argsort(halves)]]
    for start in (0, 1):  # files 0, 1, 10, 11, 2 .. sorted as text: put back
        as_text = sorted(base, key=lambda k: str(k + start))
        out += [as_text, [int(k) for k in np.argsort(as_text)]]
    for i, j in combinations(range(n), 2):
        swapped = base.copy()
        swapped[i], swapped[j] = swapped[j], swapped[i]
        out.append(swapped)
    return list(dict.fromkeys(tuple(o) for o in out))


def window(a: AnyArray) -> AnyArray:
    """The central part of a picture, even offsets; of RGB the green."""
    h, w = a.shape[:2]
    y, x = max(0, (h - WINDOW) // 2) & ~1, max(0, (w - WINDOW) // 2) & ~1
    a = a[y : y + WINDOW, x : x + WINDOW]
    return a if a.ndim == 2 else np.asarray(a[..., 1])


def slope(phase: F64, lit: Bool) -> tuple[float, float]:
    """Growth of a wrapped phase per pixel along x and y, over the longest baseline that does not wrap."""
    out = []
    for axis in (1, 0):
        best = 0.0
        for d in (2, 4, 8, 16, 32, 64):  # even: a Bayer site meets its own colour
            ahead = (slice(None), slice(d, None)) if axis else (slice(d, None), slice(None))
            behind = (slice(None), slice(None, -d)) if axis else (slice(None, -d), slice(None))
            both = lit[ahead] & lit[behind]
            if not both.any():
                break
            step = wrap(phase[ahead] - phase[behind])[both]
            if d > 2 and float(np.median(np.abs(step))) > 1.5:
                break
            best = float(np.angle(np.exp(1j * step).mean())) / d
        out.append(best)
    return out[0], out[1]


def look_at_set(images: LooseFrames, recipe: Recipe, i: int) -> SetEvidence:
    """Set i of a recipe, from its images. Raises CaptureError while they are read."""
    s = recipe.sets[i]
    stack = np.stack([window(images[f]) for f in recipe.of_set(i)])
    phase, a, b, misfit = fit(stack)
    top = images.fmt.max_value
    enough = max(0.3 * float(np.percentile(b, 90)), 0.01 * float(np.percentile(a, 99)), 1.0)
    lit = np.asarray((b > enough) & (stack.max(0) < top))
    residual = best = math.nan
    order = tuple(range(s.steps))
    shown = None
    if s.steps >= 4 and lit.any():
        shown = np.asarray(misfit / np.maximum(b, 1e-9), np.float32)
        pick = np.flatnonzero(lit)
        pick = pick[np.linspace(0, len(pick) - 1, min(SAMPLES, len(pick))).astype(int)]
        samples = stack.reshape(s.steps, -1)[:, pick].astype(np.float64)
        swing = samples.std(axis=0) * math.sqrt(2)  # what the modulation would be: the same in any order
        tried = {c: float(np.median(fit(samples[list(c)])[3] / swing)) for c in candidates(s.steps)}
        residual = tried[order]
        order = min(tried, key=lambda c: tried[c])
        best = tried[order]
    return SetEvidence(i, s, stack[0], phase, lit, shown, residual, order, best, slope(phase, lit))


def residual_of(images: LooseFrames, recipe: Recipe, i: int) -> float:
    """Median misfit of set i over its swing, in the order given; NaN for three steps."""
    return look_at_set(images, recipe, i).residual


def gray_slope(images: LooseFrames, recipe: Recipe) -> tuple[float, float] | None:
    """Growth of the Gray code's value per camera pixel along x and y; None without a code or reference frames."""
    gray = recipe.gray
    if gray is None or (gray.inverse == "none" and not gray.white_black):
        return None
    start = sum(s.steps for s in recipe.sets)
    picked = [window(images[start + k]).astype(np.float64) for k in gray.order]
    head = 2 if gray.white_black else 0
    per = 1 if gray.inverse == "none" else 2
    value = np.zeros(picked[0].shape)
    bit = np.zeros(picked[0].shape, bool)
    sure = np.ones(picked[0].shape, bool)
    for k in range(gray.bits):
        frame = picked[head + per * k]
        against = picked[head + per * k + 1] if per == 2 else (picked[0] + picked[1]) / 2
        sure &= np.abs(frame - against) > 0.05 * max(float(np.percentile(frame, 99)), 1.0)
        bit ^= frame > against
        value = 2 * value + bit
    out = []
    for axis in (1, 0):
        d = 32
        ahead = (slice(None), slice(d, None)) if axis else (slice(d, None), slice(None))
        behind = (slice(None), slice(None, -d)) if axis else (slice(None, -d), slice(None))
        both = sure[ahead] & sure[behind]
        out.append(float(np.mean((value[ahead] - value[behind])[both])) / d if both.any() else 0.0)
    return out[0], out[1]
