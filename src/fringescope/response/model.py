"""Harmonics, curves, phase errors and tables: one response in the forms in which it is measured and used.

A fringe asked as `(1 + cos theta) / 2` is seen as `a_0 + B (cos theta + sum h_k cos k theta)`. N samples at
`theta = phi - 2 pi n / N` fold harmonic k onto bin m where k = m or k = -m modulo N, so the N-step phasor is
`B e^{j phi} (1 + x)`, `x = sum_{k = 1 (N)} h_k e^{j (k - 1) phi} + sum_{k = -1 (N)} h_k e^{-j (k + 1) phi}`, and its
phase is wrong by `Im log(1 + x)`: for three steps about `-(h_2 - h_4) sin 3 phi` (doi 10.1364/JOSAA.20.000106).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fringescope.kernels import response as k
from fringescope.types import F64, U8, Response, WrappedSet

TERMS = 24  #: harmonics that a power law is expanded to
NODES = 512  #: samples of a curve for its expansion
TABLE = 1024  #: entries of a correction table over one ripple
C128 = NDArray[np.complex128]
_THETA: F64 = (np.arange(NODES) + 0.5) * np.pi / NODES
_BASIS: F64 = np.cos(np.arange(TERMS + 1)[:, None] * _THETA) * (2 / NODES)


def expand(curve: ArrayLike) -> F64:
    """Chebyshev coefficients a_0 .. a_TERMS of a curve given at `nodes()`."""
    a: F64 = _BASIS @ np.asarray(curve, dtype=np.float64)
    a[0] /= 2
    return a


def nodes() -> F64:
    """Levels asked, 0..1, at which `expand` wants a curve."""
    return np.asarray(0.5 + 0.5 * np.cos(_THETA))


def gamma_harmonics(gamma: float, levels: tuple[float, float] = (0.0, 1.0), exponent: float = 1.0) -> F64:
    """h_2 .. h_TERMS of the power law `level^gamma` where `levels` are drawn, the fringe having been drawn to the
    power `exponent`.
    """
    low, high = levels
    a = expand((low + (high - low) * nodes() ** exponent) ** gamma)
    return np.asarray(a[2:] / a[1])


def redrawn(h: F64, exponent: float) -> F64:
    """h_2 .. of fringes that were drawn to the power `exponent` through a response of harmonics `h` (h_2 ..)."""
    if exponent == 1.0:
        return h
    a = expand(series(h, nodes() ** exponent))
    return np.asarray(a[2:] / a[1])[: len(h)]


def series(h: F64, x: ArrayLike) -> F64:
    """The curve of harmonics `h` (h_2 ..) at levels asked x (0..1), in units of the fringe's amplitude."""
    return np.asarray(np.polynomial.chebyshev.chebval(2 * np.asarray(x, dtype=np.float64) - 1, [0.0, 1.0, *h]))


def attenuated(h: F64, blur: float, frequency: float) -> F64:
    """Harmonics `h` (h_2 ..) as fringes of `frequency` (cycles per plane unit) keep them behind a blur of `blur` units.
    """
    order = np.arange(2, 2 + len(h))
    return np.asarray(h * np.exp(-2 * (math.pi * blur * frequency) ** 2 * (order**2 - 1)))


def folded(count: int, steps: int, m: int) -> list[tuple[int, int]]:
    """(index into h_2 .., signed harmonic) of what folds onto bin m of N steps: k as +k where k = m, as -k where k = -m
    modulo N, up to harmonic `count + 1`.
    """
    out = []
    for i in range(count):
        order = i + 2
        if (order - m) % steps == 0:
            out.append((i, order))
        if (order + m) % steps == 0:
            out.append((i, -order))
    return out


def excess(h: F64, steps: int, phi: F64) -> tuple[C128, C128, list[int], C128]:
    """x(phi) of the module's docstring and its derivative by phi (n,); which h (h_2 ..) it holds, and its derivatives
    by these (used, n).
    """
    fold = folded(len(h), steps, 1)
    used = sorted({i for i, _ in fold})
    by_h = np.zeros((len(used), phi.size), np.complex128)
    slope = np.zeros(phi.size, np.complex128)
    power = [np.ones(phi.size, np.complex128), np.exp(1j * steps * phi)]
    while len(power) <= max((abs(order - 1) // steps for _, order in fold), default=0):
        power.append(power[-1] * power[1])  # every term turns with a multiple of N phi
    for i, order in fold:
        turns = (order - 1) // steps
        term = power[turns] if turns >= 0 else np.conj(power[-turns])
        by_h[used.index(i)] += term
        slope += h[i] * 1j * (order - 1) * term
    return np.asarray(h[used] @ by_h), slope, used, by_h


def phase_error(h: F64, steps: int, phi: F64) -> F64:
    """Error of an N-step phase, rad, where the true phase is phi (n,): measured minus true."""
    return np.asarray(np.angle(1 + excess(h, steps, phi)[0]))


def greatest_error(h: F64, steps: int) -> float:
    """Greatest phase error of N-step fringes, rad."""
    phi = np.linspace(0, 2 * math.pi / steps, 256, endpoint=False)
    return float(np.abs(phase_error(h, steps, phi)).max())


def table(h: F64, steps: int, size: int = TABLE) -> tuple[F64, F64]:
    """What to add to a measured phase, and d(true) / d(measured), over one ripple 0 .. 2 pi / N of the measured phase.

    Exact inverse of `phase_error`. Where the harmonics are so strong that the phase runs back, it is held instead.
    """
    ripple = 2 * math.pi / steps
    phi = np.linspace(-0.5 * ripple, 1.5 * ripple, 2 * size + 1)
    seen = np.maximum.accumulate(phi + phase_error(h, steps, phi)) + 1e-12 * np.arange(phi.size)
    at = np.arange(size) * (ripple / size)
    add = np.interp(at, seen, phi) - at
    wide = np.concatenate([add[-1:], add, add[:1]])
    slope = 1 + (wide[2:] - wide[:-2]) / (2 * ripple / size)
    return add, np.clip(slope, 0.0, 20.0)


def harmonics_at(response: Response, frequency: float) -> F64:
    """The response's h_2 .. as fringes of `frequency` (cycles per plane unit) show them."""
    return attenuated(np.asarray(response.harmonics), response.blur, frequency)


def correct(wrapped: WrappedSet, response: Response) -> WrappedSet:
    """A set whose phases are freed from the response's error; sigma follows the table's slope, A and B stay.

    A response that is not `needed` changes nothing.
    """
    if not response.needed:
        return wrapped
    add, slope = table(harmonics_at(response, math.hypot(*wrapped.g)), wrapped.steps)
    phase, sigma = np.empty_like(wrapped.phase), np.empty_like(wrapped.sigma)
    k.correct(wrapped.phase, wrapped.sigma, wrapped.steps, add, slope, phase, sigma)
    return replace(wrapped, phase=phase, sigma=sigma)


# --------------------------------------------------------------------------------------------------- curves and tables


def curve(response: Response, x: ArrayLike) -> F64:
    """Light seen, 0 at level 0 and 1 at level 1 of the device, for levels x (shares of full scale, 0..1).

    Within the drawn levels it is the measured curve, beyond them the power law, joined without a jump. Never falls.
    """
    low, high = response.levels
    x = np.asarray(x, dtype=np.float64)
    fine = np.linspace(0, 1, 4097)
    inside = series(np.asarray(response.harmonics), np.clip((fine - low) / (high - low), 0, 1))
    ends = series(np.asarray(response.harmonics), np.array([0.0, 1.0]))
    law = fine**response.gamma
    scale = float(ends[1] - ends[0]) / (high**response.gamma - low**response.gamma)
    y = inside + scale * np.where(fine < low, law - low**response.gamma, 0.0)
    y += scale * np.where(fine > high, law - high**response.gamma, 0.0)
    y = np.maximum.accumulate(y)
    y = (y - y[0]) / max(float(y[-1] - y[0]), 1e-9)
    return np.asarray(np.interp(x, fine, y))


def inverse_curve(response: Response, y: ArrayLike) -> F64:
    """The level, share of full scale, that gives light y (0..1 from black to white): the inverse of `curve`."""
    fine = np.linspace(0, 1, 4097)
    seen = curve(response, fine) + 1e-9 * np.arange(fine.size)
    return np.asarray(np.interp(np.asarray(y, dtype=np.float64), seen, fine))


def predistortion(response: Response) -> U8:
    """The table (256,) uint8 for the projector: entry q is the level to send where level q is meant, so that the light
    becomes linear.
    """
    return np.asarray(np.floor(255 * inverse_curve(response, np.arange(256) / 255) + 0.5), np.uint8)


def predicted_errors(h: F64, steps: Sequence[int] = (3, 4, 5, 8)) -> Mapping[int, float]:
    """Greatest phase error, rad, that harmonics `h` (h_2 ..) give N-step fringes, by N."""
    return {n: greatest_error(h, n) for n in steps}


def drawn_to_power(response: Response, exponent: float) -> Response:
    """The response as fringes show it that are drawn to a power, `((1 + cos) / 2) ** exponent`: 1 / gamma makes most
    responses linear. Sigmas (errors of harmonics taken as independent) and predicted errors follow; words and figures
    stay.
    """
    own, sigma = np.asarray(response.harmonics), np.zeros(len(response.harmonics))
    sigma[: len(response.sigmas)] = response.sigmas[: len(sigma)]

    def spread(f: Callable[[F64], F64]) -> F64:
        moves = [(f(own + step) - f(own - step)) / 2 for step in np.diag(np.maximum(sigma, 1e-9))]
        return np.asarray(np.sqrt(np.sum(np.square(moves), axis=0)))

    steps = tuple(response.error_rad) or (3, 4, 5, 8)
    h = redrawn(own, exponent)
    errors = spread(lambda h: np.array([greatest_error(redrawn(h, exponent), n) for n in steps]))
    return replace(
        response,
        gamma=response.gamma * exponent,
        gamma_sigma=response.gamma_sigma * exponent,
        harmonics=tuple(h.tolist()),
        sigmas=tuple(spread(lambda h: redrawn(h, exponent)).tolist()),
        error_rad=predicted_errors(h, steps),
        error_sigma=dict(zip(steps, errors.tolist(), strict=True)),
    )
