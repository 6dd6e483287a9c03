"""Residuals as vectors over a device's plane: are they noise about nothing (III-B asks for centrosymmetric and small)?

Two questions, each answered by turning the signs of whole sightings at random: is the distribution symmetric about zero
(energy distance between r and -r; Szekely and Rizzo 2013, doi:10.1016/j.jspi.2013.03.018), and is there a smooth field
over the image that repeats from sighting to sighting (a cubic polynomial)? Turning whole sightings keeps residuals
together that belong together, so neither bending boards nor correlated phases pretend to be evidence.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import f as fisher

from fringescope.settings import EvidenceSettings
from fringescope.types import F64, I32, Calibration, FieldTest, Residuals, Sighting

MOST = 1500  #: vectors that are kept to be drawn, and compared pair by pair
PATCHES = (24, 18)  #: patches of the projector plane whose mean is drawn
ALL = 12  #: up to so many blocks all signs are tried
SEED = 7


@dataclass(frozen=True, eq=False)
class Vectors:
    """Residual vectors `r` (n, 2) at `place` (n, 2) of a plane; `block` (n,) numbers what belongs together."""

    device: str
    kind: str
    unit: str
    size: tuple[int, int]
    place: F64
    r: F64
    block: I32


def by_device(calibration: Calibration) -> list[Vectors]:
    """The projector's phase residuals, then each camera's corner residuals; devices without any are left out."""
    rig = calibration.rig
    pairs = paired(calibration)
    poses = sorted({s.pose for s, _ in pairs})
    out = [_projector([(s, r) for s, r in pairs], rig.projector.plane_size, poses)]
    for c in rig.cameras:
        mine = [(s, r) for s, r in pairs if s.camera == c.name]
        blocks = [np.full(len(s.corner_px), poses.index(s.pose)) for s, _ in mine]
        place, r = [s.corner_px for s, _ in mine], [r.corner for _, r in mine]
        out.append(_joined(c.name, "corners", "px", (c.lens.width, c.lens.height), place, r, blocks))
    return [v for v in out if len(v.r)]


def paired(calibration: Calibration) -> list[tuple[Sighting, Residuals]]:
    """Each sighting with its residuals, in order of the residuals."""
    there = {(s.pose, s.camera): s for s in calibration.sightings}
    return [(there[r.pose, r.camera], r) for r in calibration.residuals if (r.pose, r.camera) in there]


def _projector(pairs: Sequence[tuple[Sighting, Residuals]], size: tuple[int, int], poses: list[str]) -> Vectors:
    place, vectors, blocks = [], [], []
    for s, r in pairs:
        if r.sample.size:
            place.append(r.sample_uv)
            vectors.append(along(s.directions, r.sample))
            blocks.append(np.full(len(r.sample), poses.index(s.pose)))
    return _joined("projector", "phase", "units", size, place, vectors, blocks)


def along(directions: F64, residual: F64) -> F64:
    """Vectors (k, 2) whose parts along the fringe `directions` (d, 2) are the residuals (k, d); NaN where any lacks.

    With one direction only that part is known, and the rest is zero.
    """
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(residual @ np.linalg.pinv(unit, rcond=1e-3).T)


def _joined(
    device: str, kind: str, unit: str, size: tuple[int, int], place: list[F64], r: list[F64], block: list[I32]
) -> Vectors:
    p = np.concatenate([np.zeros((0, 2)), *place])
    v = np.concatenate([np.zeros((0, 2)), *r])
    b = np.concatenate([np.zeros(0, np.int64), *block])
    ok = np.isfinite(p).all(axis=1) & np.isfinite(v).all(axis=1)
    _, b = np.unique(b[ok], return_inverse=True)
    return Vectors(device, kind, unit, size, p[ok], v[ok], b.astype(np.int32))


# --------------------------------------------------------------------------------------------------------------- tests


def field_test(v: Vectors, s: EvidenceSettings) -> FieldTest:
    """All figures of one device's residuals; probabilities are NaN with fewer than four sightings."""
    few = v if len(v.r) <= MOST else _some(v)
    signs = turned_signs(int(v.block.max()) + 1, s.permutations)
    asymmetry, asymmetry_p = _asymmetry(few, signs)
    Q, fitted = _field(v)
    n, k = len(v.r), Q.shape[1]
    parts = np.stack([Q[v.block == b].T @ v.r[v.block == b] for b in range(signs.shape[1])])
    powers = np.einsum("pkc,pkc->p", *(2 * [np.einsum("pb,bkc->pkc", signs, parts)])) / n
    rest = float((v.r**2).sum() - powers[0] * n)
    free = 2 * (n - k)
    ratio = (powers[0] * n / (2 * k)) / (rest / free) if free > 0 and rest > 0 else np.nan
    drawn = _patches(v) if v.kind == "phase" else _rows(few.place, few.r)
    return FieldTest(
        v.device,
        v.kind,
        v.unit,
        v.size,
        n,
        signs.shape[1],
        float(np.sqrt((v.r**2).sum(axis=1).mean())),
        (float(v.r[:, 0].mean()), float(v.r[:, 1].mean())),
        asymmetry,
        asymmetry_p,
        float(np.sqrt(powers[0])),
        float(np.sqrt(np.median(powers[1:]))) if len(powers) > 1 else float("nan"),
        share_above(powers),
        float(fisher.sf(ratio, 2 * k, free)) if np.isfinite(ratio) else float("nan"),
        drawn,
        tuple((float(a), float(b)) for a, b in few.r.tolist()),
        fitted,
    )


def turned_signs(blocks: int, most: int) -> F64:
    """Signs (permutations, blocks), the first all +1: every one that differs by more than all signs, or `most`."""
    if blocks <= ALL:
        bits = np.arange(1 << max(blocks - 1, 0))
        return np.where((bits[:, None] >> np.arange(blocks)) & 1, -1.0, 1.0)
    random = np.random.default_rng(SEED).choice([-1.0, 1.0], (most, blocks))
    return np.concatenate([np.ones((1, blocks)), random])


def share_above(values: F64) -> float:
    """Probability of the first value among all; NaN where there are fewer than eight."""
    if len(values) < 8:
        return float("nan")
    return float((values >= values[0] * (1 - 1e-9)).mean())


def _some(v: Vectors) -> Vectors:
    keep = np.linspace(0, len(v.r) - 1, MOST).astype(int)
    return Vectors(v.device, v.kind, v.unit, v.size, v.place[keep], v.r[keep], v.block[keep])


def _asymmetry(v: Vectors, signs: F64) -> tuple[float, float]:
    """Energy distance between r and -r, 0 to 1, and its probability.

    With K = |ri + rj| - |ri - rj|, the distance is sum(K) / sum(|ri + rj|); turning the sign of ri turns K's row.
    """
    x, y = v.r[:, 0], v.r[:, 1]
    plus = np.hypot(x[:, None] + x, y[:, None] + y)
    K = plus - np.hypot(x[:, None] - x, y[:, None] - y)
    member = np.equal.outer(np.arange(signs.shape[1]), v.block).astype(np.float64)
    sums = member @ K @ member.T
    values = np.einsum("pa,ab,pb->p", signs, sums, signs)
    total = float(plus.sum())
    return (float(values[0]) / total if total > 0 else 0.0), share_above(values)


def _terms(place: F64, size: tuple[int, int], order: int) -> F64:
    """Monomials up to `order` of the place, scaled to -1 .. 1 over the plane."""
    x, y = (2 * (place[:, i] + 0.5) / size[i] - 1 for i in (0, 1))
    return np.stack([x**i * y**j for i in range(order + 1) for j in range(order + 1 - i)], axis=1)


def _field(v: Vectors) -> tuple[F64, tuple[tuple[float, float, float, float], ...]]:
    """Orthonormal basis (n, k) of smooth fields at the places, and the fitted field where there are data."""
    order = 3 if len(v.r) >= 60 else 1
    T = _terms(v.place, v.size, order)
    U, w, Vt = np.linalg.svd(T, full_matrices=False)
    keep = w > 1e-4 * w[0]  # places along a line do not tell what happens beside it
    Q = U[:, keep]
    coefficients = Vt[keep].T @ ((Q.T @ v.r) / w[keep, None])
    low, high = np.percentile(v.place, [2, 98], axis=0)
    gu, gv = np.meshgrid(np.linspace(low[0], high[0], 12), np.linspace(low[1], high[1], 9))
    at = np.stack([gu.ravel(), gv.ravel()], axis=1)
    near = np.array([np.min(np.hypot(*(v.place - a).T)) for a in at]) < max(v.size) / 16
    at = at[near]
    return Q, _rows(at, _terms(at, v.size, order) @ coefficients)


def _patches(v: Vectors) -> tuple[tuple[float, float, float, float], ...]:
    """Means of the vectors of one block in one patch of the plane, where there are three or more."""
    cell = np.clip(((v.place + 0.5) / v.size * PATCHES).astype(int), 0, np.array(PATCHES) - 1)
    key = (v.block * PATCHES[1] + cell[:, 1]) * PATCHES[0] + cell[:, 0]
    _, which, count = np.unique(key, return_inverse=True, return_counts=True)
    sums = [np.bincount(which, weights=a) / count for a in (*v.place.T, *v.r.T)]
    mean = np.stack(sums, axis=1)[count >= 3]
    keep = np.linspace(0, len(mean) - 1, min(len(mean), MOST)).astype(int)
    return _rows(mean[keep, :2], mean[keep, 2:])


def _rows(place: F64, r: F64) -> tuple[tuple[float, float, float, float], ...]:
    return tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in np.column_stack([place, r]).tolist())
