"""The joint adjustment (III-B): what is free, how sure each kind of measurement is, what does not belong, which lens.

Standard deviations are settled per camera and kind by variance components; errors of the phase that neighbours share
make samples worth less than their number (the design effect of a cluster sample), so that predicted sigmas are honest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.stats import t as student

from fringescope.calibrate.problem import (
    CORNERS,
    PHASE,
    Block,
    Problem,
    State,
    Weights,
    block_normal,
    damped_step,
    evaluate,
    folded,
    inverse_normal,
    minimise,
    normal,
)
from fringescope.errors import CalibrationError, UsageError
from fringescope.settings import CalibrateSettings
from fringescope.types import F64

#: distortion terms (of k1, k2, p1, p2, k3) of the lens models, each nested in the next
MODELS: dict[str, tuple[int, ...]] = {
    "none": (),
    "k1": (0,),
    "k1 k2": (0, 1),
    "k1 k2 p1 p2": (0, 1, 2, 3),
    "k1 k2 p1 p2 k3": (0, 1, 2, 3, 4),
}
USUAL = "k1 k2 p1 p2"
NORMAL_MAD = 1.4826  #: standard deviation of a normal distribution over its median absolute value
FINEST = 1e-4  #: pixels or projector-plane units: no measurement is called better
TOLERANCE = 1e-9  #: share of the cost that a step must gain for another one

Key = tuple[int, str]


@dataclass(frozen=True, eq=False)
class Noise:
    """Factors on the given sigmas and design effects, per camera and kind; `own` factors of pictures that are worse
    than the camera's others, per sighting and kind.
    """

    factor: Mapping[Key, float]
    effect: Mapping[Key, float] = field(default_factory=dict)
    own: Mapping[Key, float] = field(default_factory=dict)

    def variance(self, b: Block) -> F64:
        """Variance of each residual of a block as weighed: with the design effect."""
        return np.asarray(self.spread(b) ** 2 * self.effect.get(b.key, 1.0))

    def spread(self, b: Block) -> F64:
        """Standard deviation of each residual of a block on its own."""
        return np.asarray(self.factor.get(b.key, 1.0) * self.own.get((b.sighting, b.kind), 1.0) * b.sigma)


@dataclass(frozen=True, eq=False)
class Fit:
    """A solved state: its noise, weights (0 = left out) and steps taken."""

    state: State
    noise: Noise
    weights: tuple[F64, ...]
    steps: int


# ------------------------------------------------------------------------------------------------------ what is free


def released(
    problem: Problem, models: tuple[str, ...], s: CalibrateSettings, *, centres: bool = True, poses: bool = True
) -> Problem:
    """The problem with the unknowns that the settings and lens models leave free, and the priors that belong to them.

    `models` names the distortion terms per device; `centres` releases principal points.
    """
    focal, middle = known(problem, s)
    columns: list[tuple[int, ...]] = []
    priors: dict[int, tuple[float, float]] = {}
    seen = {b.device for b in problem.blocks} | {0}
    for d in range(len(problem.sizes.devices)):
        at = problem.device_at(d)
        if d not in seen:
            continue
        tied = d > 0 and (s.square_pixels or not centres)
        columns += [(at, at + 1)] if tied else [(at,), (at + 1,)]
        if centres:
            columns += [(at + 2,), (at + 3,)]
        columns += [(at + 4 + k,) for k in MODELS[models[d]]]
        columns += [(at + 9 + k,) for k in range(6)] if d else []
        size = problem.sizes.extent(d)
        loose = (s.camera_centre_prior if d else s.projector_centre_prior) * max(size)
        for k in range(2):
            priors[at + 2 + k] = ((size[k] - 1) / 2, loose)
        priors |= {at + k: value for k, value in focal.get(d, {}).items()}
        priors |= {at + 2 + k: value for k, value in middle.get(d, {}).items()}
    if centres:
        for k, sigma in shape_terms(s).items():
            columns.append((problem.shape_at + k,))
            priors[problem.shape_at + k] = (0.0, sigma)
    for p in sorted({b.pose for b in problem.blocks}) if poses else ():
        columns += [(problem.pose_at(p) + k,) for k in range(6)]
    free = np.zeros((problem.n_full, len(columns)))
    for j, rows in enumerate(columns):
        free[list(rows), j] = 1
    held = np.asarray(free.any(axis=1))
    return replace(problem, free=free, priors={i: v for i, v in priors.items() if held[i]})


def shape_terms(s: CalibrateSettings) -> dict[int, float]:
    """Which terms of the board's shape are free, with the sigma of each; raises UsageError for a word there is not."""
    words = s.board_shape.split()
    if not set(words) <= {"flat", "bend", "print"} or not words:
        raise UsageError(f"setting board_shape: '{s.board_shape}'; needed flat, bend, print or \"bend print\"")
    bend = dict.fromkeys(range(3), s.bend_prior_mm) if "bend" in words else {}
    return bend | (dict.fromkeys((3, 4), s.print_prior) if "print" in words else {})


Known = dict[int, dict[int, tuple[float, float]]]


def known(problem: Problem, s: CalibrateSettings) -> tuple[Known, Known]:
    """What the settings tell of focal lengths and principal points: device -> {0, 1: (value, sigma)}.

    Raises UsageError for a device that there is not or words that are no numbers.
    """
    focal = {d: {0: (v[0], e), 1: (v[-1], e)} for d, (v, e) in _told(problem, s.focal, "focal").items()}
    middle: Known = {}
    for d, (v, e) in _told(problem, s.principal_point, "principal_point").items():
        if len(v) != 2:
            raise UsageError(f"setting principal_point: {len(v)} number; needed two, such as camera1=2735,1823+-10")
        middle[d] = {0: (v[0], e), 1: (v[1], e)}
    return focal, middle


def _told(problem: Problem, text: str, name: str) -> dict[int, tuple[list[float], float]]:
    out: dict[int, tuple[list[float], float]] = {}
    for part in filter(None, (p.strip() for p in text.split(";"))):
        device, _, rest = part.partition("=")
        value, _, sigma = rest.partition("+-")
        if device.strip() not in problem.sizes.devices:
            there = ", ".join(problem.sizes.devices)
            raise UsageError(f"setting {name}: no device '{device.strip()}'; there are {there}")
        try:
            numbers, e = [float(v) for v in value.split(",")], float(sigma) if sigma else 1e-3
        except ValueError as error:
            raise UsageError(f"setting {name}: '{part}'; needed a form such as camera1=12800+-50") from error
        if not 1 <= len(numbers) <= 2 or not e > 0 or not np.isfinite([*numbers, e]).all():
            raise UsageError(f"setting {name}: '{part}'; needed one or two numbers and a positive sigma")
        out[problem.sizes.devices.index(device.strip())] = numbers, e
    return out


# ------------------------------------------------------------------------------------------------- noise and weights


def residuals(problem: Problem, state: State) -> list[F64]:
    """Residuals of every block."""
    return [evaluate(problem, state, b, derivatives=False).residual for b in problem.blocks]


def robust_noise(problem: Problem, found: list[F64]) -> Noise:
    """Factors from medians: what half of the measurements say."""
    values: dict[Key, list[F64]] = {}
    for b, r in zip(problem.blocks, found, strict=True):
        values.setdefault(b.key, []).append(np.abs(r / b.sigma)[np.isfinite(r)])
    every = {k: np.concatenate(v) for k, v in values.items()}
    factor = {k: NORMAL_MAD * float(np.median(v)) if len(v) else 1.0 for k, v in every.items()}
    return Noise(floored(problem, factor))


def floored(problem: Problem, factor: Mapping[Key, float]) -> dict[Key, float]:
    """Factors that call no measurement better than FINEST: or one kind that fits by luck would take over the solve."""
    sigma: dict[Key, list[F64]] = {}
    for b in problem.blocks:
        sigma.setdefault(b.key, []).append(b.sigma.ravel())
    return {k: max(f, FINEST / float(np.median(np.concatenate(sigma[k])))) for k, f in factor.items()}


def soft_weights(problem: Problem, found: list[F64], noise: Noise) -> list[F64]:
    """Weights that fade for single measurements, and for whole pictures, that miss by more than most (Cauchy)."""
    out = []
    for b, r in zip(problem.blocks, found, strict=True):
        z = r / noise.spread(b)
        typical = float(np.nanmedian(np.abs(z))) * NORMAL_MAD if np.isfinite(z).any() else 1.0
        w = 1 / noise.variance(b) / (1 + (z / 3) ** 2) / (1 + max(typical / 3, 0) ** 4)
        out.append(np.where(np.isfinite(r), w, 0.0))
    return out


def hard_weights(problem: Problem, found: list[F64], noise: Noise, limit: float) -> list[F64]:
    """1 / variance of what misses by at most `limit` sigma, 0 for the rest; a corner goes as a whole."""
    out = []
    for b, r in zip(problem.blocks, found, strict=True):
        with np.errstate(invalid="ignore"):
            ok = np.abs(r / noise.spread(b)) <= limit
        if b.points:
            ok = np.repeat(np.all(ok, axis=1, keepdims=True), r.shape[1], axis=1)
        out.append(np.where(ok, 1 / noise.variance(b), 0.0))
    return out


def settle(problem: Problem, state: State, turns: int, rounds: int) -> tuple[State, Noise]:
    """Solves with weights that fade for outliers, `turns` times anew."""
    noise = robust_noise(problem, residuals(problem, state))
    for _ in range(turns):
        found = residuals(problem, state)
        noise = robust_noise(problem, found)
        state, _ = minimise(problem, state, soft_weights(problem, found, noise), rounds, 1e-4)
    return state, robust_noise(problem, residuals(problem, state))


def polish(problem: Problem, state: State, noise: Noise, s: CalibrateSettings, turns: int = 4) -> Fit:
    """Least squares among what belongs, the noise settled by variance components."""
    steps = 0
    weights: list[F64] = []
    for turn in range(turns):
        noise = Noise(noise.factor, noise.effect, own_factors(problem, residuals(problem, state), noise))
        weights = hard_weights(problem, residuals(problem, state), noise, s.reject_sigma)
        state, n = minimise(problem, state, weights, s.rounds, TOLERANCE)
        steps += n
        if turn < turns - 1:
            noise = components(problem, state, weights, noise)
    return Fit(state, noise, tuple(weights), steps)


def components(problem: Problem, state: State, weights: Weights, noise: Noise) -> Noise:
    """Variance components (Foerstner 1979): sums of squares over redundancies, per camera and kind; design effects."""
    H, _ = folded(problem, normal(problem, state, weights))
    inverse, _ = inverse_normal(H)
    S = problem.free
    squares: dict[Key, float] = {}
    count: dict[Key, float] = {}
    for b, w in zip(problem.blocks, weights, strict=True):
        columns, Hb, _, c = block_normal(problem, state, b, w)
        Sb = S[columns]
        taken = float(np.sum((Sb.T @ Hb @ Sb) * inverse))
        squares[b.key] = squares.get(b.key, 0.0) + c * noise.effect.get(b.key, 1.0)
        count[b.key] = count.get(b.key, 0.0) + float((w > 0).sum()) - taken * noise.effect.get(b.key, 1.0)
    ratio = {k: float(np.sqrt(squares[k] / count[k])) if count[k] > 1 else 1.0 for k in squares}
    factor = floored(problem, {k: noise.factor[k] * r for k, r in ratio.items()})
    again = Noise(factor, noise.effect, noise.own)
    return Noise(factor, design_effects(problem, state, weights, again), noise.own)


def own_factors(problem: Problem, found: list[F64], noise: Noise) -> dict[Key, float]:
    """How much worse than the camera's factor says a picture is, where it is: by medians of 12 residuals or more."""
    out: dict[Key, float] = {}
    for b, r in zip(problem.blocks, found, strict=True):
        z = np.abs(r / (noise.factor[b.key] * b.sigma))
        z = z[np.isfinite(z)]
        if len(z) >= 12 and (worse := NORMAL_MAD * float(np.median(z))) > 1.25:
            out[b.sighting, b.kind] = worse
    return out


CLUSTERS = (1.0, 2.0, 4.0)  #: sides of the patches, in squares, over which errors may be shared


def design_effects(problem: Problem, state: State, weights: Weights, noise: Noise) -> dict[Key, float]:
    """How many times more the mean over a patch of the board varies than its measurements' number lets expect.

    Kish 1965, Survey Sampling, chapter 5: the variance of cluster means over that of independent samples; the greatest
    of several sizes of patch, at least 1.
    """
    side = problem.board.square_mm
    sums: dict[tuple[Key, int], list[tuple[F64, F64, F64]]] = {}
    for b, w in zip(problem.blocks, weights, strict=True):
        e = evaluate(problem, state, b, derivatives=False)
        for k, patch in enumerate(CLUSTERS if b.kind == PHASE else CLUSTERS[1:]):
            where = np.floor(e.board_xy / (patch * side) + 0.25)
            for a in range(e.residual.shape[1]):
                ok = (w[:, a] > 0) & np.isfinite(where).all(axis=1)
                if ok.sum() < 2:
                    continue
                z = e.residual[ok, a] / noise.spread(b)[ok, a]
                _, which = np.unique(where[ok], axis=0, return_inverse=True)
                n = np.asarray(np.bincount(which.ravel()), dtype=np.float64)
                total = np.asarray(np.bincount(which.ravel(), z), dtype=np.float64)
                sums.setdefault((b.key, k), []).append((n, total, z * z))
    out: dict[Key, float] = {}
    for (key, _), parts in sums.items():
        n, total = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
        each = float(np.mean(np.concatenate([p[2] for p in parts])))
        if len(n) < 8 or each <= 0 or n.sum() <= len(n):
            continue
        out[key] = max(out.get(key, 1.0), float(np.sum(total**2) / n.sum() / each))
    return out


# --------------------------------------------------------------------------------------------------- leaving poses out


def held_out_scores(problem: Problem, fit: Fit) -> F64:
    """Chi-squared of every pose (P,), predicted by the others: from the normal equations, one Newton step each.

    The pose left out keeps its own six unknowns. NaN for a pose without measurements.
    """
    S = problem.free
    shares = {p: _pose_share(problem, fit, p) for p in sorted({b.pose for b in problem.blocks})}
    H, g = folded(problem, normal(problem, fit.state, fit.weights))
    out = np.full(len(problem.poses), np.nan)
    for p, (Hp, gp, cp) in shares.items():
        own = np.asarray(S[problem.pose_at(p) : problem.pose_at(p) + 6].any(axis=0))
        rest = ~own
        step = np.zeros(len(g))
        step[rest] = damped_step((H - Hp)[np.ix_(rest, rest)], (g - gp)[rest], 0.0)
        step[own] = damped_step(Hp[np.ix_(own, own)], gp[own] + Hp[np.ix_(own, rest)] @ step[rest], 0.0)
        out[p] = cp + 2 * gp @ step + step @ Hp @ step
    return out


def _pose_share(problem: Problem, fit: Fit, pose: int) -> tuple[F64, F64, float]:
    n = problem.n_full
    H, g, c = np.zeros((n, n)), np.zeros(n), 0.0
    for b, w in zip(problem.blocks, fit.weights, strict=True):
        if b.pose == pose:
            columns, Hb, gb, cb = block_normal(problem, fit.state, b, w)
            H[np.ix_(columns, columns)] += Hb
            g[columns] += gb
            c += cb
    S = problem.free
    return S.T @ H @ S, S.T @ g, c


def chosen_models(
    problem: Problem, state: State, s: CalibrateSettings
) -> tuple[tuple[str, ...], dict[str, dict[str, float]]]:
    """The lens model of every device, and each model's chi-squared of the poses left out, relative to the chosen one's.

    Device by device, the others as they stand, twice over; see `preferred`. Models named in the settings stand.
    """
    devices = problem.sizes.devices
    asked = asked_models(len(devices), s)
    models = tuple(USUAL if name == "auto" else name for name in asked)
    told: dict[str, dict[str, float]] = {}
    tried: dict[tuple[str, ...], F64] = {}
    base = replace_models(problem, state, models, s)
    noise = robust_noise(base[0], residuals(base[0], base[1]))
    first = polish(base[0], base[1], noise, s, turns=2)
    for _ in range(2):
        before = models
        for d, name in enumerate(asked):
            if name != "auto":
                continue
            scores = {m: _score(problem, first, (*models[:d], m, *models[d + 1 :]), s, tried) for m in MODELS}
            best = preferred(scores, s.lens_gain, s.lens_confidence)
            total = {m: float(np.nansum(c)) for m, c in scores.items()}
            told[devices[d]] = {m: round(c - total[best], 3) for m, c in total.items()}
            models = (*models[:d], best, *models[d + 1 :])
        if models == before:
            break
    return models, told


def replace_models(
    problem: Problem, state: State, models: tuple[str, ...], s: CalibrateSettings
) -> tuple[Problem, State]:
    """The problem with other lens models released, and the state with the terms that they lack at zero."""
    lens = state.lens.copy()
    for d, m in enumerate(models):
        for k in set(range(5)) - set(MODELS[m]):
            lens[d, 4 + k] = 0.0
    return released(problem, models, s), replace(state, lens=lens)


def asked_models(devices: int, s: CalibrateSettings) -> tuple[str, ...]:
    """The lens model that the settings ask for, per device; raises UsageError for a name that there is not."""
    asked = (s.projector_lens, *[s.lens] * (devices - 1))
    for name in asked:
        if name != "auto" and name not in MODELS:
            raise UsageError(f"setting lens: '{name}'; needed auto or one of: {', '.join(MODELS)}")
    return asked


def preferred(scores: Mapping[str, F64], gain: float, confidence: float) -> str:
    """The usual lens model, unless poses left out speak for fewer terms or surely for more.

    `scores` holds each model's chi-squared per pose. A term that is there but left out shifts the others by more than
    their sigma says, so the usual ones stay while they cost the poses left out no more than `gain` each, which chance
    may; else the simplest that no other simpler one surely beats. Surely: beyond what the spread of the difference over
    the poses allows at this one-sided `confidence` (after the one-standard-error rule: Hastie, Tibshirani and Friedman,
    The Elements of Statistical Learning, 2nd edition, section 7.10); "none", which no lens is, gets no such benefit.
    """
    total = {m: float(np.nansum(c)) for m, c in scores.items()}
    terms = {m: len(MODELS[m]) for m in scores}
    fewer = sorted((m for m in scores if terms[m] < terms[USUAL]), key=lambda m: terms[m])
    if any(total[USUAL] - total[m] > gain * (terms[USUAL] - terms[m]) for m in fewer):
        best = min(fewer, key=lambda m: total[m])
        chance = {m: _chance(scores[m] - scores[best], confidence) if terms[m] else 0.0 for m in fewer}
        return next(m for m in fewer if total[m] - total[best] <= chance[m])
    for m in (m for m in scores if terms[m] > terms[USUAL]):
        better = scores[USUAL] - scores[m]
        if np.nansum(better) > gain * (terms[m] - terms[USUAL]) + _chance(better, confidence):
            return m
    return USUAL


def _chance(difference: F64, confidence: float) -> float:
    """What the sum of per-pose differences (P,) may be by chance, at a one-sided confidence (Student's t)."""
    d = difference[np.isfinite(difference)]
    return float(np.sqrt(len(d)) * np.std(d, ddof=1) * student.ppf(confidence, len(d) - 1)) if len(d) > 1 else 0.0


def _score(
    problem: Problem, first: Fit, models: tuple[str, ...], s: CalibrateSettings, tried: dict[tuple[str, ...], F64]
) -> F64:
    """Chi-squared of every pose left out under these lens models; infinite where they cannot be solved."""
    if models not in tried:
        p, state = replace_models(problem, first.state, models, s)
        try:
            state, n = minimise(p, state, first.weights, s.rounds, 1e-4)
            tried[models] = held_out_scores(p, Fit(state, first.noise, first.weights, n))
        except (CalibrationError, np.linalg.LinAlgError):
            tried[models] = np.full(len(problem.poses), np.inf)
    return tried[models]


def thinned(problem: Problem, most: int) -> Problem:
    """The problem with at most `most` samples of each picture."""
    blocks = [
        b if b.kind == CORNERS or len(b.place) <= most else b.picked(np.linspace(0, len(b.place) - 1, most).astype(int))
        for b in problem.blocks
    ]
    return replace(problem, blocks=tuple(blocks))

