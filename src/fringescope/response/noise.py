"""The sensor's noise without the harmonics: what a bent fringe leaves beside its sinusoid is no noise.

Sets of more than three steps take their noise from what their samples miss the fitted sinusoid by. A strong response
adds `B^2 R(phi)` to that, which the harmonics tell; it would make every pixel look too noisy to use.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from fringescope.response import model
from fringescope.types import F64, AnyArray, Decoded, NoiseModel, Response, WrappedSet

GRID = 512
BINS = 24
LEAST = 50  #: pixels of a bin
SAMPLES = 60_000
CLEAR = 0.02  #: share of the greatest R up to which a phase counts as free of harmonics
MATTERS = 0.3  #: share of the noise's variance that harmonics must make up


def residual_power(h: F64, steps: int, phi: F64) -> F64:
    """R(phi) (n,): variance about the fitted sinusoid, over B^2, of N noiseless samples of harmonics h (h_2 ..), as the
    fit estimates it (sum of squares over N - 3).
    """
    n = np.arange(steps)
    theta = phi[:, None] - 2 * np.pi * n / steps
    bent = sum(c * np.cos((i + 2) * theta) for i, c in enumerate(h)) + np.zeros_like(theta)
    spectrum = np.fft.fft(bent, axis=1)
    spectrum[:, [0, 1, steps - 1]] = 0
    return np.asarray((np.abs(spectrum) ** 2).sum(1) / steps / (steps - 3))


def freed(decoded: Decoded, response: Response) -> Decoded:
    """The view with the noise, sigma and misfit that it would have without the response's harmonics.

    Nothing changes where the harmonics make up little of the noise, or where the noise is not from the residuals.
    """
    several = [w for w in decoded.sets if w.steps > 3]
    if not several or decoded.noise.source != "residuals":
        return decoded
    noise = _noise(several, decoded.noise, response)
    if noise is None:
        return decoded
    return replace(decoded, noise=noise, sets=tuple(_rescaled(w, decoded.noise, noise, response) for w in decoded.sets))


def _excess(w: WrappedSet, response: Response, where: tuple[AnyArray, ...] | None = None) -> AnyArray:
    """B^2 R(phi), codes squared; of all pixels, or of those at `where`."""
    phase, B = (w.phase, w.modulation) if where is None else (w.phase[where], w.modulation[where])
    grid = _power(w, response)
    at = np.mod(np.nan_to_num(phase) * np.float32(GRID / (2 * math.pi)), GRID).astype(np.int32) % GRID
    return np.asarray(B * B * grid.astype(np.float32)[at], np.float32)


def _power(w: WrappedSet, response: Response) -> F64:
    """R over one turn of the phase (GRID,)."""
    return residual_power(
        model.harmonics_at(response, math.hypot(*w.g)), w.steps, np.linspace(0, 2 * np.pi, GRID, endpoint=False)
    )


def _noise(sets: list[WrappedSet], old: NoiseModel, response: Response) -> NoiseModel | None:
    """Noise `a + b I` from the residuals less the harmonics' share; None where that share is small."""
    levels, variances, weights, shares = [], [], [], []
    for w in sets:
        ok = (w.saturated == 0) & np.isfinite(w.misfit) & np.isfinite(w.phase)
        where = tuple(i[:: max(1, int(ok.sum()) // SAMPLES)] for i in np.nonzero(ok))
        A = w.background[where]
        v = w.misfit[where] ** 2 * old.variance(A)
        bent = _excess(w, response, where)
        lit = bent > np.percentile(bent, 50) if bent.size else np.zeros(0, bool)
        if np.count_nonzero(lit) < LEAST:
            continue
        shares.append(float(np.median(bent[lit]) / max(float(np.median(v[lit])), 1e-6)))
        clear = bent <= CLEAR * w.modulation[where] ** 2 * float(np.max(_power(w, response)))
        keep = clear if np.count_nonzero(clear) > LEAST * BINS else np.ones(len(A), bool)  # four steps: some see none
        rest, A = np.abs(v - bent)[keep], A[keep]
        edges = np.unique(np.quantile(A, np.linspace(0, 1, BINS + 1)))
        index = np.clip(np.searchsorted(edges, A, side="right") - 1, 0, max(len(edges) - 2, 0))
        for b in range(len(edges) - 1):
            inside = index == b
            if inside.sum() >= LEAST:
                levels.append(float(A[inside].mean()))
                variances.append(float(np.median(rest[inside])) / _chi2_median(w.steps - 3))
                weights.append(float(inside.sum()))
    if len(levels) < 3 or max(shares) < MATTERS:
        return None
    x, y = np.array(levels), np.maximum(np.array(variances), 1 / 12)
    slope, intercept = np.polyfit(x, y, 1, w=np.sqrt(weights) / y)
    if slope < 0:
        slope, intercept = 0.0, float(np.average(y, weights=np.array(weights) / y**2))
    return NoiseModel(float(intercept), float(slope), old.source)


def _chi2_median(dof: int) -> float:
    """Median over mean of a chi-squared variable (Wilson and Hilferty; exact for one degree of freedom)."""
    return 0.45494 if dof == 1 else float((1 - 2 / (9 * dof)) ** 3)


def _rescaled(w: WrappedSet, old: NoiseModel, new: NoiseModel, response: Response) -> WrappedSet:
    was, now = old.variance(w.background), new.variance(w.background)
    sigma = np.asarray(w.sigma * np.sqrt(now / was), np.float32)
    if w.steps <= 3:
        return replace(w, sigma=sigma)
    left = np.maximum(w.misfit * w.misfit * was - _excess(w, response), 0)
    return replace(w, sigma=sigma, misfit=np.asarray(np.sqrt(left / now), np.float32))


def corrected(decoded: Decoded, response: Response | None) -> Decoded:
    """A measured view with every set corrected, and its noise; to be called before the orders are settled.

    Phases change only where the response says that it is `needed`; None changes nothing.
    """
    if response is None:
        return decoded
    out = freed(decoded, response)
    return replace(out, sets=tuple(model.correct(w, response) for w in out.sets)) if response.needed else out
