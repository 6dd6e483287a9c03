"""The response that makes a capture agree with itself: robust least squares on phases, modulations and residuals.

Unknown are the exponent of a power law, what each harmonic differs from it (expected to be little), and the blur. Each
pixel's own phase, gain and offset drop out of the equations:

- pairs of sets that see one projector coordinate: their phases, their modulations and their backgrounds;
- a set of more than three steps: what its samples leave beside the fringe (bins 2 .. N // 2);
- where there is neither, a smooth surface: phase and modulation change evenly over half a ripple.

Blocks of the image vote on how sure the result is, so that texture and shape, which are alike in neighbouring pixels,
do not pass for evidence (cluster-robust covariance, doi 10.1093/biomet/73.1.13).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fringescope.response import model
from fringescope.response.observe import Observed, Pair, Pixels, Triple
from fringescope.settings import ResponseSettings
from fringescope.types import F64, Bool

ORDERS = 11  #: harmonics h_2 .. h_12 that the equations hold
ROUNDS = 20
LIKE = 0.5  #: periods nearer than this ratio keep their orders under any response
GRID = 1024  #: entries of a table over one ripple
CONVERGED = 3e-5  #: change of a harmonic
EFFECT = 30.0  #: by how much alike neighbouring pixels are at first taken to be
TUKEY = 4.685  #: residuals beyond this many robust deviations have no say


@dataclass(frozen=True, eq=False)
class Fit:
    """What was found: harmonics h_2 .. (ORDERS,) of sharp fringes with covariance, gamma, blur."""

    h: F64
    h_cov: F64
    gamma: float
    gamma_sigma: float
    blur: float
    explained: float  #: share of the squared residuals that the response explains in blocks that it was not fitted to


@dataclass(frozen=True, eq=False)
class _Equation:
    """Residual r (n,), derivatives of the prediction by the unknowns (P, n), expected deviation (n,), blocks (n,)."""

    r: F64
    J: F64
    sigma: F64
    block: NDArray[np.int64]


class _Unknowns:
    """Where each unknown stands: gamma, blur squared, deltas, and one free constant per equation that has one."""

    def __init__(self, pixels: Pixels, levels: tuple[float, float], s: ResponseSettings) -> None:
        self.levels, self.free = levels, s.harmonics
        self.head = 2 + self.free
        self.size = self.head + 2 * len(pixels.pairs)
        spread = np.full(self.size, 1e3)
        spread[0], spread[1], spread[2 : self.head] = 3.0, s.expected_blur**2, s.law_tolerance
        self.prior = 1 / spread**2
        self.start = np.zeros(self.size)  # also the prior's middle: linear, sharp, no deviations
        self.start[0] = 1.0

    def harmonics(self, head: F64) -> F64:
        """h_2 .. (ORDERS,) of sharp fringes drawn as they should be."""
        h = model.gamma_harmonics(float(head[0]), self.levels)[:ORDERS].copy()
        h[: self.free] += head[2:]
        return h

    def seen(self, head: F64, o: Observed) -> F64:
        """h_2 .. of one set: as drawn, and blurred."""
        h = model.redrawn(self.harmonics(head), o.exponent)
        return model.attenuated(h, math.sqrt(max(float(head[1]), 0.0)), o.frequency)

    def derivatives(self, head: F64, f: Callable[[F64], F64]) -> F64:
        """(len(f), head) by differences."""
        step = 1e-4
        return np.stack([(f(head + step * e) - f(head - step * e)) / (2 * step) for e in np.eye(self.head)], axis=1)

    def bounded(self, theta: F64) -> F64:
        out = theta.copy()
        out[0] = min(max(out[0], 0.2), 6.0)
        out[1] = min(max(out[1], 0.0), 400.0)
        out[2 : self.head] = np.clip(out[2 : self.head], -0.6, 0.6)
        return out


@dataclass(frozen=True, eq=False)
class _Set:
    """One set's error at its pixels under the present response, with derivatives by the unknowns of the head."""

    phi: F64  #: true phase
    slope: F64  #: 1 + d(error) / d(phi)
    gain: F64  #: Re log(1 + x), what the modulation grows by
    error: F64  #: Im log(1 + x), the phase error
    gain_by: F64  #: (head, n) derivatives
    error_by: F64


class _Ripple:
    """A set's error as a table over one ripple, read at any number of phases."""

    def __init__(self, u: _Unknowns, head: F64, o: Observed) -> None:
        self.h, self.steps = u.seen(head, o), o.steps
        self.dh = u.derivatives(head, lambda t: u.seen(t, o))
        phi = np.linspace(0, 2 * math.pi / o.steps, GRID + 1)
        x, slope, used, by_h = model.excess(self.h, o.steps, phi)
        log, by = np.log(1 + x), self.dh[used].T @ (by_h / (1 + x))
        self._rows = np.concatenate([[1 + np.imag(slope / (1 + x))], [log.real], [log.imag], by.real, by.imag])

        self._add, _ = model.table(self.h, o.steps, GRID)

    def true(self, measured: F64) -> F64:
        """Measured phases (any number of turns) to true ones."""
        return _read(self._add, self.steps, measured)

    def at(self, phi: F64) -> _Set:
        """The error at true phases (n,)."""
        x = phi * (self.steps / (2 * math.pi))
        x = (x - np.floor(x)) * GRID
        k = np.minimum(x.astype(np.int64), GRID - 1)
        f = x - k
        rows = self._rows[:, k] * (1 - f) + self._rows[:, k + 1] * f
        n = self.dh.shape[1]
        return _Set(phi, rows[0], rows[1], rows[2], rows[3 : 3 + n], rows[3 + n :])


def _read(add: F64, steps: int, phase: F64) -> F64:
    at = np.mod(phase * steps / (2 * np.pi), 1.0) * len(add)
    return np.asarray(phase + np.interp(at, np.arange(len(add) + 1), np.append(add, add[0])))


def _nearest_order(x: F64, ratio: float) -> F64:
    """A pair's disagreement after the fine set's order that makes it least: a strong response spoils orders, too."""
    turn = 2 * np.pi * abs(ratio)
    return x if abs(ratio) > 0.95 else np.asarray(x - turn * np.rint(x / turn))


def _wrap(x: F64) -> F64:
    return np.asarray(x - 2 * np.pi * np.rint(x / (2 * np.pi)))


def disagreement(pair: Pair, sets: tuple[Observed, ...], h_other: F64 | None, h_fine: F64 | None) -> F64:
    """By how much a pair's phases disagree, rad of the other set (n,), after correction by what each set shows."""
    other, fine = sets[pair.other], sets[pair.fine]
    a, b = other.phase, pair.fine_phase
    if h_other is not None and h_fine is not None:
        a = _read(model.table(h_other, other.steps)[0], other.steps, a)
        b = _read(model.table(h_fine, fine.steps)[0], fine.steps, b)
    return _nearest_order(_wrap(a - pair.ratio * b), pair.ratio)


def _pair_equations(
    n: int, pair: Pair, pixels: Pixels, u: _Unknowns, ripples: Sequence[_Ripple]
) -> list[tuple[F64, F64, F64, int]]:
    """Phase, log modulation and background of a pair: residual, derivatives by the head, sigma, own constant or -1."""
    o, f = pixels.sets[pair.other], pixels.sets[pair.fine]
    of, ff = ripples[pair.other], ripples[pair.fine]
    fine = ff.at(ff.true(pair.fine_phase))
    r = pair.ratio
    phi = r * fine.phi
    phase = _wrap(of.true(o.phase) - phi)
    phi += phase - _nearest_order(phase, r)
    other = of.at(phi)
    moved = -fine.error_by / np.maximum(fine.slope, 0.05)  # d(phi of the fine set) by the head
    phase = _wrap(o.phase - other.phi - other.error)
    J = other.error_by + other.slope * r * moved
    other = of.at(of.true(o.phase))  # what follows needs no order
    log = np.log(o.modulation / f.modulation) - other.gain + fine.gain
    level = (o.background - f.background) / np.sqrt(o.modulation * f.modulation)
    by = np.zeros_like(J)
    for x, ripple, sign, phi in ((o, of, 1.0, other.phi), (f, ff, -1.0, fine.phi)):
        for i, order in model.folded(len(ripple.h), x.steps, 0):
            if order > 0:
                c = np.cos(order * phi)
                level -= sign * ripple.h[i] * c
                by += sign * ripple.dh[i][:, None] * c
    both = np.hypot(o.sigma, f.sigma)
    return [
        (phase, J, np.hypot(o.sigma, r * f.sigma), -1),
        (log, other.gain_by - fine.gain_by, both, u.head + 2 * n),
        (level, by, both / math.sqrt(2), u.head + 2 * n + 1),
    ]


def _bin_equations(o: Observed, u: _Unknowns, ripple: _Ripple) -> list[tuple[F64, F64, F64]]:
    """Real and imaginary part of the bins beside the fringe, turned with the phase so that a harmonic stands still."""
    phi = ripple.true(o.phase)
    gain = np.exp(ripple.at(phi).gain)
    out = []
    for row, m in enumerate(range(2, o.steps // 2 + 1)):
        turn = np.exp(-1j * m * phi)
        y, by = o.bins[row] * gain * turn, np.zeros((u.head, phi.size), np.complex128)
        for i, order in model.folded(len(ripple.h), o.steps, m):
            term = np.exp(1j * order * phi) * turn
            y = y - ripple.h[i] * term
            by += ripple.dh[i][:, None] * term
        out += [(y.real, by.real, o.sigma), (y.imag, by.imag, o.sigma)]
    return out


def _triple_equations(t: Triple, ripple: _Ripple) -> list[tuple[F64, F64, F64]]:
    """Second differences of the corrected phase and of the corrected log modulation: zero on what is smooth."""
    a, b, c = sets = [ripple.at(ripple.true(p)) for p in t.phase]
    by = [x.error_by / np.maximum(x.slope, 0.05) for x in sets]
    bend = _wrap(c.phi - b.phi) - _wrap(b.phi - a.phi)
    level = [m - x.gain for m, x in zip(t.log_modulation, sets, strict=True)]
    return [
        (bend, by[2] - 2 * by[1] + by[0], 1.4 * t.sigma),
        (level[2] - 2 * level[1] + level[0], c.gain_by - 2 * b.gain_by + a.gain_by, 1.4 * t.sigma),
    ]


def _equations(pixels: Pixels, u: _Unknowns, theta: F64, orders: bool = True) -> list[_Equation]:
    """All equations; without `orders` those that rest on the order of a fine set are left out."""
    head = theta[: u.head]
    ripples = [_Ripple(u, head, o) for o in pixels.sets]
    out: list[_Equation] = []

    def add(r: F64, J: F64, sigma: F64, block: NDArray[np.int64], own: int = -1) -> None:
        full = np.zeros((u.size, r.size))
        full[: u.head] = J
        if own >= 0:
            full[own] = 1.0
            r = r - theta[own]
        out.append(_Equation(r, full, sigma, block))

    for n, pair in enumerate(pixels.pairs):
        for r, J, sigma, own in _pair_equations(n, pair, pixels, u, ripples):
            if own >= 0 or orders or abs(pair.ratio) > LIKE:
                add(r, J, sigma, pixels.block, own)
    for o, ripple in zip(pixels.sets, ripples, strict=True):
        if len(o.bins):
            for r, J, sigma in _bin_equations(o, u, ripple):
                add(r, J, sigma, pixels.block)
    for t in pixels.triples:
        for r, J, sigma in _triple_equations(t, ripples[t.of]):
            add(r, J, sigma, t.block)
    return out


def _weights(r: F64, sigma: F64) -> F64:
    """Tukey's, on the scale of the residuals themselves where they are larger than expected."""
    scale = sigma * max(1.4826 * float(np.median(np.abs(r / sigma))), 1.0)
    z = r / (TUKEY * scale)
    return np.where(np.abs(z) < 1, (1 - z * z) ** 2, 0.0) / scale**2


def _normal(
    pixels: Pixels, u: _Unknowns, theta: F64, keep: Bool, effect: float, orders: bool = True
) -> tuple[F64, F64, F64]:
    """Normal matrix and right side of the blocks in `keep`, and each block's score (blocks, P)."""
    blocks = len(keep)
    H, score = np.zeros((u.size, u.size)), np.zeros((blocks, u.size))
    for e in _equations(pixels, u, theta, orders):
        w = _weights(e.r, e.sigma) / effect * keep[e.block]
        H += (e.J * w) @ e.J.T
        pull = e.J * (w * e.r)
        for p in range(u.size):
            score[:, p] += np.bincount(e.block, pull[p], blocks)
    return H, score.sum(0), score


def _solve(pixels: Pixels, u: _Unknowns, keep: Bool, effect: float, theta: F64, orders: bool = True) -> F64:
    h = u.harmonics(theta[: u.head])
    for _ in range(ROUNDS):
        H, g, _score = _normal(pixels, u, theta, keep, effect, orders)
        step = np.linalg.solve(H + np.diag(u.prior), g - u.prior * (theta - u.start))
        largest = float(np.abs(step[: u.head]).max())
        theta = u.bounded(theta + step * min(1.0, 0.5 / max(largest, 1e-12)))
        before, h = h, u.harmonics(theta[: u.head])
        if float(np.abs(h - before).max()) < CONVERGED:
            break
    return theta


def _squares(pixels: Pixels, u: _Unknowns, theta: F64, keep: Bool) -> float:
    """Mean squared phase-like residual over the kept blocks, each clipped at where it would have no say."""
    total, count = 0.0, 0.0
    for e in _equations(pixels, u, theta):
        inside = keep[e.block]
        z = np.minimum((e.r[inside] / e.sigma[inside]) ** 2, 400.0)
        total, count = total + float(z.sum()), count + z.size
    return total / max(count, 1.0)


def fit(pixels: Pixels, levels: tuple[float, float], s: ResponseSettings) -> Fit:
    """The response of the pixels' capture, fringes drawn between `levels`; the caller made sure that there is evidence.
    """
    u = _Unknowns(pixels, levels, s)
    blocks = int(max([pixels.block.max(), *(t.block.max() for t in pixels.triples)])) + 1
    every = np.ones(blocks, bool)
    theta, effect = u.start.copy(), EFFECT
    if any(abs(p.ratio) <= LIKE for p in pixels.pairs):  # modulations tell what orders may be trusted
        theta = _solve(pixels, u, every, effect, theta, orders=False)
    for _ in range(2):
        theta = _solve(pixels, u, every, effect, theta)
        H, _, score = _normal(pixels, u, theta, every, effect)
        full = np.linalg.inv(H + np.diag(u.prior))
        there = int((np.abs(score).sum(1) > 0).sum())
        meat = score.T @ score * (there / max(there - 1, 1))
        effect = max(effect * float(np.trace(full @ meat)) / max(float(np.trace(full @ H)), 1e-12), 1.0)
    cov = full @ (meat + np.diag(u.prior)) @ full
    head = theta[: u.head]
    d = u.derivatives(head, u.harmonics)
    h_cov = d @ cov[: u.head, : u.head] @ d.T
    return Fit(
        u.harmonics(head),
        h_cov,
        float(head[0]),
        float(math.sqrt(max(cov[0, 0], 0.0))),
        math.sqrt(max(float(head[1]), 0.0)),
        _held_out(pixels, u, effect, blocks, theta),
    )


def _held_out(pixels: Pixels, u: _Unknowns, effect: float, blocks: int, start: F64) -> float:
    """Fitted to every other block, how much of the other blocks' squared residuals goes away (share)."""
    half = (np.arange(blocks) % 2).astype(bool)
    theta = _solve(pixels, u, half, effect, start)
    linear = u.start.copy()
    linear[u.head :] = theta[u.head :]
    before, after = (_squares(pixels, u, t, ~half) for t in (linear, theta))
    return 1 - after / max(before, 1e-12)
