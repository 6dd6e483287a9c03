"""Slow, obvious twins of kernels/fringes.py: least squares per pixel, every order tried, loops."""

import math
from collections import Counter

import numpy as np

TWO_PI = 2 * math.pi


def design(steps):
    """Rows 1, cos, sin of I_n = A + B cos(phi - 2 pi n / N) = A + C cos + S sin."""
    d = TWO_PI * np.arange(steps) / steps
    return np.column_stack([np.ones(steps), np.cos(d), np.sin(d)])


def sinusoid(samples, top):
    """Phase, A, B and variance about the sinusoid of one pixel's samples below `top`."""
    samples = np.asarray(samples, float)
    keep = samples < top
    left = int(keep.sum())
    if left < 3:
        return 0.0, samples[keep].mean() if left else math.inf, 0.0, math.nan
    M = design(len(samples))[keep]
    (A, C, S), *_ = np.linalg.lstsq(M, samples[keep], rcond=None)
    rest = samples[keep] - M @ (A, C, S)
    return math.atan2(S, C), A, math.hypot(C, S), rest @ rest / (left - 3) if left > 3 else math.nan


def sigma(phase, B, keep, variances):
    """Standard deviation of the phase by propagating each sample's own variance through the least squares."""
    P = np.linalg.pinv(design(len(keep))[keep])
    row = (math.cos(phase) * P[2] - math.sin(phase) * P[1]) / B
    return math.sqrt(row**2 @ np.asarray(variances)[keep])


def wrapped(x):
    """An angle in (-pi, pi]."""
    return -((-x + math.pi) % TWO_PI - math.pi)


def search(phases, sigmas, freq, lo, hi):
    """Every order of the finest set between lo and hi: (best absolute phase, margin over the next, in sigmas).

    Each coarser set judges the candidate for itself: an independent statement of the same problem.
    """
    found = []
    first = math.ceil((lo - phases[-1]) / TWO_PI)
    for m in range(first, math.floor((hi - phases[-1]) / TWO_PI) + 1):
        absolute = phases[-1] + TWO_PI * m
        cost = 0.0
        for p, s, f in zip(phases[:-1], sigmas[:-1], freq[:-1], strict=True):
            ratio = f / freq[-1]
            cost += wrapped(absolute * ratio - p) ** 2 / (s**2 + (ratio * sigmas[-1]) ** 2)
        found.append((cost, absolute))
    found.sort()
    if not found:
        return math.nan, 0.0
    margin = math.sqrt(found[1][0] - found[0][0]) if len(found) > 1 else math.inf
    return found[0][1], margin


def merge(phases, sigmas):
    """Inverse-variance mean of one pixel's phases on the circle, those of infinite sigma left out."""
    w = np.array([0.0 if math.isinf(s) else 1 / s**2 for s in sigmas])
    return float(np.angle(w @ np.exp(1j * np.asarray(phases)))), 1 / math.sqrt(w.sum())


def votes(phase, voters, radius, least, majority, max_slope):
    """One round of elections: the phase with elected orders, and the change of order (127 = own one, -128 = none).

    An order more than eight away cannot be elected; votes for it only spoil the majority of the others.
    """
    out, changed = phase.copy(), np.zeros(phase.shape, int)
    for i, j in np.argwhere(np.isfinite(phase)):
        ballots = Counter()
        for y in range(i - radius, i + radius + 1):
            for x in range(j - radius, j + radius + 1):
                inside = 0 <= y < phase.shape[0] and 0 <= x < phase.shape[1]
                if not inside or (y, x) == (i, j) or not math.isfinite(voters[y, x]):
                    continue
                difference = float(voters[y, x]) - float(phase[i, j])
                if abs(wrapped(difference)) <= max_slope * max(abs(y - i), abs(x - j)):
                    ballots[round((difference - wrapped(difference)) / TWO_PI)] += 1
        total = sum(ballots.values())
        if total < least:
            continue
        within = {t: n for t, n in ballots.items() if abs(t) <= 8} or {0: 0}
        elected, number = max(within.items(), key=lambda kv: (kv[1], kv[0] == 0))
        if elected and number >= majority * total:
            changed[i, j] = elected
            out[i, j] = phase[i, j] + TWO_PI * elected
        elif not elected and number >= majority * total:
            changed[i, j] = 127
        elif ballots[0] < (1 - majority) * total:
            changed[i, j] = -128
    return out, changed


def gray_words(bits):
    """The reflected binary code, by reflection: word k is a tuple of bits, most significant first."""
    words = [()]
    for _ in range(bits):
        words = [(0, *w) for w in words] + [(1, *w) for w in reversed(words)]
    return words
