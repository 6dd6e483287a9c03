"""The ripple that a response leaves on a plane: the phase's deviation from a smooth surface, by the fringe's phase."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fringescope.errors import EmptyResultError
from fringescope.types import F64, Decoded

DEGREE = 5  #: of the polynomial that a plane's phase is, behind two lenses
BINS = 48
SAMPLES = 15_000
ROUNDS = 8  #: of fitting and leaving out what lies far off


@dataclass(frozen=True, eq=False)
class Ripple:
    """Deviation of one direction's phase from a smooth surface: mean (BINS,) rad over the finest set's wrapped phase.

    `amplitude` and `sigma` are those of its part of `steps` waves per fringe; `rest` is the robust spread about it,
    which is large where the surface was no plane.
    """

    g: tuple[float, float]
    steps: int
    phase: F64
    mean: F64
    amplitude: float
    sigma: float
    rest: float


def plane_ripple(decoded: Decoded, index: int = 0) -> Ripple:
    """The ripple of direction `index` of a decoded plane.

    Raises EmptyResultError where fewer than 400 pixels are valid.
    """
    d = decoded.directions[index]
    fine = next((w for w in decoded.sets if _parallel(w.g, d.g) and _length(w.g) > 0.999 * _length(d.g)), None)
    ok = np.isfinite(d.phase) & ((decoded.reasons & ~np.uint16(256)) == 0)
    if fine is None or np.count_nonzero(ok) < 400:
        raise EmptyResultError(f"view '{decoded.camera}': {np.count_nonzero(ok)} pixels of a plane; needed 400")
    y, x = np.nonzero(ok)
    thin = slice(None, None, max(1, len(y) // SAMPLES))
    y, x = y[thin], x[thin]
    H, W = decoded.shape
    terms = [(i, j) for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)]
    u, v = 2 * x / W - 1, 2 * y / H - 1
    smooth = np.stack([u**i * v**j for i, j in terms], axis=1)
    phase = d.phase[y, x].astype(np.float64)
    wrapped = np.angle(np.exp(1j * phase))
    waves = np.column_stack([f(m * fine.steps * phase) for m in (1, 2) for f in (np.sin, np.cos)])
    A = np.concatenate([smooth, waves], axis=1)  # fitted together: a smooth surface must not follow the ripple
    keep = np.ones(len(y), bool)
    for _ in range(ROUNDS):
        c = np.linalg.lstsq(A[keep], phase[keep], rcond=None)[0]
        off = phase - A @ c
        spread = 1.4826 * float(np.median(np.abs(off[keep] - np.median(off[keep]))))
        keep = np.abs(off - np.median(off[keep])) < 4 * max(spread, 1e-6)
    rest = phase - smooth @ c[: len(terms)]
    bins = np.minimum(((wrapped + math.pi) / (2 * math.pi) * BINS).astype(np.int64), BINS - 1)
    count = np.bincount(bins[keep], minlength=BINS)
    mean = np.bincount(bins[keep], rest[keep], BINS) / np.maximum(count, 1)
    sigma = spread * math.sqrt(2 / max(int(keep.sum()), 1))
    at = (np.arange(BINS) + 0.5) * 2 * math.pi / BINS - math.pi
    amplitude = float(np.hypot(*c[len(terms) : len(terms) + 2]))
    return Ripple(d.g, fine.steps, at, np.where(count > 0, mean, np.nan), amplitude, sigma, spread)


def _length(g: tuple[float, float]) -> float:
    return math.hypot(*g)


def _parallel(a: tuple[float, float], b: tuple[float, float]) -> bool:
    return abs(a[0] * b[1] - a[1] * b[0]) < 1e-4 * _length(a) * _length(b)
