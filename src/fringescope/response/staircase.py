"""The response from a grey staircase: uniform levels, one picture each."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from fringescope.errors import CaptureError, EmptyResultError, UsageError
from fringescope.response import model
from fringescope.response.judge import words
from fringescope.settings import ResponseSettings
from fringescope.types import F64, Bool, Response

GROUPS = 16  #: of pixels, each of which gives a curve of its own: their scatter is the uncertainty
HARMONICS = 11
ROUNDS = 12


def from_staircase(
    levels: ArrayLike, codes: ArrayLike, s: ResponseSettings, full_scale: float = 255.0, max_code: float = 255.0
) -> Response:
    """The response from levels asked (L,), 0 .. full_scale, and the codes seen (L, n) at n pixels, at most max_code.

    Each pixel has its own gain and offset; saturated samples stay out. Raises UsageError for fewer than five different
    levels, CaptureError for codes of another shape, EmptyResultError where too few pixels see the steps.
    """
    x = np.asarray(levels, dtype=np.float64)
    c = np.asarray(codes, dtype=np.float64)
    if x.ndim != 1 or len(np.unique(x)) < 5 or x.min() < 0 or x.max() > full_scale:
        raise UsageError(f"staircase levels {x.tolist()}; needed five or more different ones of 0 to {full_scale:g}")
    if c.ndim != 2 or len(c) != len(x):
        raise CaptureError(f"staircase of {len(x)} levels and codes of shape {c.shape}; needed ({len(x)}, pixels)")
    order = np.argsort(x, kind="stable")
    x, c = x[order] / full_scale, c[order]
    clipped = c >= max_code
    span = c.max(0) - c.min(0)
    seen = span > max(0.05 * max_code, 0.3 * float(np.percentile(span, 95)))
    saturated = float((clipped.any(0) & seen).sum() / max(int(seen.sum()), 1))
    usable = seen & (np.count_nonzero(~clipped, axis=0) >= max(4, 0.7 * len(x)))
    if np.count_nonzero(usable) < s.min_pixels:
        raise EmptyResultError(
            f"{np.count_nonzero(usable)} pixels see the staircase unsaturated; needed {s.min_pixels}"
            + (f"; {100 * saturated:.0f} % saturate: halve the exposure" if saturated > 0.3 else ": give more light")
        )
    c, there = c[:, usable], ~clipped[:, usable]
    if np.count_nonzero(there.any(axis=1)) < len(x) or np.count_nonzero(there[-1]) < s.min_pixels // 4:
        raise EmptyResultError("the brightest steps saturate everywhere: halve the exposure")
    whole = _harmonics(x, _shape(c, there))
    each = np.stack([_harmonics(x, _shape(c[:, i::GROUPS], there[:, i::GROUPS])) for i in range(GROUPS)])
    sigmas = np.maximum(each.std(0, ddof=1) / math.sqrt(GROUPS), 1e-5)
    shape = _shape(c, there)
    gamma = _gamma(x, shape)
    gamma_each = [_gamma(x, _shape(c[:, i::GROUPS], there[:, i::GROUPS])) for i in range(GROUPS)]
    errors = dict(model.predicted_errors(whole))
    scatter = {n: float(np.std([model.greatest_error(e, n) for e in each], ddof=1)) / math.sqrt(GROUPS) for n in errors}
    worst = max(errors, key=lambda n: errors[n])
    needed = errors[worst] > max(s.negligible_rad, s.significance * scatter[worst])
    r = Response(
        "staircase",
        gamma,
        float(np.std(gamma_each, ddof=1)) / math.sqrt(GROUPS),
        tuple(whole.tolist()),
        tuple(sigmas.tolist()),
        0.0,
        (float(x[0]), float(x[-1])),
        errors,
        scatter,
        int(np.count_nonzero(usable)),
        saturated,
        bool(needed),
        (),
        {
            "verdict": "needed" if needed else "unproved" if errors[worst] > s.negligible_rad else "fine",
            "levels": (x * full_scale).tolist(),
            "seen": shape.tolist(),
        },
    )
    return replace(r, words=tuple(words(r, {n: (e, scatter[n]) for n, e in errors.items()}, s)))


def _shape(c: F64, there: Bool) -> F64:
    """The staircase seen (L,), 0 at its darkest and 1 at its brightest level, all pixels' gains and offsets apart."""
    w = there.astype(np.float64)
    f = np.sum(w * c, axis=1) / np.maximum(w.sum(1), 1)
    for _ in range(ROUNDS):
        n = w.sum(0)
        mean_f, mean_c = (w * f[:, None]).sum(0) / n, (w * c).sum(0) / n
        df, dc = w * (f[:, None] - mean_f), c - mean_c
        gain = (df * dc).sum(0) / np.maximum((df * df).sum(0), 1e-12)
        offset = mean_c - gain * mean_f
        f = (w * gain * (c - offset)).sum(1) / np.maximum((w * gain * gain).sum(1), 1e-12)
    return np.asarray((f - f[0]) / (f[-1] - f[0]))


def _harmonics(x: F64, f: F64) -> F64:
    """h_2 .. of fringes drawn from the darkest to the brightest level of the staircase."""
    from scipy.interpolate import PchipInterpolator  # slow to import: scans do without it

    at, first = np.unique(x, return_inverse=True)
    mean = np.bincount(first, f) / np.bincount(first)
    a = model.expand(PchipInterpolator(at, mean)(at[0] + (at[-1] - at[0]) * model.nodes()))
    return np.asarray(a[2:] / a[1])[:HARMONICS]


def _gamma(x: F64, f: F64) -> float:
    """Exponent of the power law that, with any scale and offset, comes closest."""
    from scipy.optimize import minimize_scalar

    def misfit(gamma: float) -> float:
        A = np.column_stack([np.ones_like(x), x**gamma])
        rest = f - A @ np.linalg.lstsq(A, f, rcond=None)[0]
        return float(rest @ rest)

    return float(minimize_scalar(misfit, bounds=(0.2, 6.0), method="bounded", options={"xatol": 1e-5}).x)
