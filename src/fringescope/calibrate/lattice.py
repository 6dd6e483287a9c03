"""Saddles to a chequered lattice: links between neighbours, the largest lattice that they make, its smooth map."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from fringescope.calibrate.saddles import Saddles
from fringescope.types import F64, I32, Bool

STEPS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])  #: in the order in which angles grow (x right, y down)
NEIGHBOURS = 40  #: candidates around one that may be its neighbour on the lattice
CONE = np.radians(14.0)
SWAP = np.radians(25.0)
LEAP = 1.6  #: a link this much longer than the next on its line leaves out a corner
NEAR = 0.2  #: squares: a candidate this near to a lattice point belongs to it


@dataclass(frozen=True, eq=False)
class LatticeMap:
    """Lattice coordinates to pixels: a homography and a polynomial for what the lens bends.

    `powers` (t, 2) and `bend` (t, 2) are the polynomial in lattice coordinates about `middle`, in units of `half`.
    """

    H: F64
    powers: I32
    bend: F64
    middle: F64
    half: float

    def __call__(self, ij: F64) -> F64:
        """Pixels (n, 2) of lattice coordinates (n, 2)."""
        out = apply(self.H, ij)
        return out + terms((ij - self.middle) / self.half, self.powers) @ self.bend if len(self.powers) else out

    def steps(self, ij: F64) -> tuple[F64, F64]:
        """Pixels per square (n, 2) along the lattice's two axes at lattice coordinates (n, 2)."""
        H = self.H
        q = ij @ H[:, :2].T + H[:, 2]
        with np.errstate(all="ignore"):
            p, w = q[:, :2] / q[:, 2:], 1 / q[:, 2:]
            along = [(H[:2, k] - p * H[2, k]) * w for k in (0, 1)]
        if len(self.powers):
            x = (ij - self.middle) / self.half
            for k in (0, 1):
                down = self.powers - np.eye(2, dtype=np.int32)[k]
                factor = self.powers[:, k] / self.half
                along[k] = along[k] + terms(x, np.maximum(down, 0)) @ (factor[:, None] * self.bend)
        return along[0], along[1]

    def inverse(self, px: F64) -> F64:
        """Lattice coordinates (n, 2) of pixels (n, 2); NaN where there are none."""
        ij = apply(np.asarray(np.linalg.inv(self.H), dtype=np.float64), px)
        for _ in range(4 if len(self.powers) else 0):
            a, b = self.steps(ij)
            r = px - self(ij)
            with np.errstate(all="ignore"):
                det = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
                ij[:, 0] += (r[:, 0] * b[:, 1] - r[:, 1] * b[:, 0]) / det
                ij[:, 1] += (r[:, 1] * a[:, 0] - r[:, 0] * a[:, 1]) / det
        with np.errstate(invalid="ignore"):
            ij[~(np.abs(px - self(ij)).max(1) < 0.5)] = np.nan
        return ij


def exponents(low: int, high: int) -> I32:
    """Exponents (t, 2) of the monomials of two coordinates of total degree `low` to `high`."""
    pairs = [(a, d - a) for d in range(low, high + 1) for a in range(d, -1, -1)]
    return np.array(pairs, dtype=np.int32).reshape(-1, 2)


def terms(x: F64, powers: I32) -> F64:
    """Monomials (n, t) of points x (n, 2) with exponents (t, 2)."""
    top = int(powers.max(initial=0))
    table = np.ones((2, top + 1, len(x)))
    for k in range(1, top + 1):
        table[:, k] = table[:, k - 1] * x.T
    return np.ascontiguousarray((table[0, powers[:, 0]] * table[1, powers[:, 1]]).T)


def apply(H: F64, p: F64) -> F64:
    """Homography (3, 3) of points (n, 2)."""
    q = p @ H[:, :2].T + H[:, 2]
    with np.errstate(all="ignore"):
        return np.asarray(q[:, :2] / q[:, 2:])


def homography(a: F64, b: F64, weights: F64 | None = None) -> F64:
    """Homography (3, 3) that takes points a (n, 2) to b (n, 2), n >= 4: normalised linear, then Gauss-Newton."""
    Ta, Tb = _normaliser(a), _normaliser(b)
    p, q = apply(Ta, a), apply(Tb, b)
    w = np.ones(len(a)) if weights is None else weights
    one, zero = np.ones(len(a)), np.zeros(len(a))
    x, y, u, v = p[:, 0], p[:, 1], q[:, 0], q[:, 1]
    A = np.vstack(
        [
            w[:, None] * np.column_stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u]),
            w[:, None] * np.column_stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v]),
        ]
    )
    H = np.linalg.eigh(A.T @ A)[1][:, 0].reshape(3, 3)
    H = H / H[2, 2] if abs(H[2, 2]) > 1e-12 else H
    for _ in range(4):
        s = p @ H[2, :2] + H[2, 2]
        f = apply(H, p)
        J = np.zeros((2 * len(p), 8))
        for k, (lo, hi) in enumerate(((0, 3), (3, 6))):
            rows = slice(k * len(p), (k + 1) * len(p))
            J[rows, lo:hi] = np.column_stack([x, y, one]) / s[:, None]
            J[rows, 6:8] = -f[:, k : k + 1] * p / s[:, None]
        r = np.concatenate([u - f[:, 0], v - f[:, 1]])
        ww = np.concatenate([w, w])
        if not np.isfinite(J).all() or not np.isfinite(r).all():
            break
        N = (J * ww[:, None] ** 2).T @ J
        N += 1e-13 * np.trace(N) * np.eye(8)
        H = H + np.append(np.linalg.solve(N, J.T @ (r * ww**2)), 0.0).reshape(3, 3)
    return np.asarray(np.linalg.inv(Tb) @ H @ Ta)


def _normaliser(p: F64) -> F64:
    m = p.mean(0)
    s = np.sqrt(2) / max(float(np.sqrt(((p - m) ** 2).sum(1).mean())), 1e-12)
    return np.array([[s, 0, -s * m[0]], [0, s, -s * m[1]], [0, 0, 1]])


def fit_map(ij: F64, px: F64, sigma: F64 | None = None, rounds: int = 8) -> tuple[LatticeMap, F64]:
    """The smooth map through corners at lattice points ij (n, 2), n >= 4, px (n, 2); and what each misses it by (n,).

    The more corners, the more bends: a homography alone below 12, cubic terms from 40 on. Robust (Cauchy weights).
    """
    n = len(ij)
    span = np.ptp(ij, axis=0)
    degree = 0 if n < 12 or span.min() < 2 else 2 if n < 40 or span.min() < 4 else 3 if n < 80 or span.min() < 6 else 4
    powers = exponents(2, degree)
    middle, half = 0.5 * (ij.min(0) + ij.max(0)), max(float(span.max()) / 2, 1.0)
    base = np.ones(n) if sigma is None else np.median(sigma) / np.maximum(sigma, 1e-9)
    w = base.copy()
    bend = np.zeros((len(powers), 2))
    x = (ij - middle) / half
    T = terms(x, powers)
    H = homography(ij, px)
    miss = np.zeros(n)
    for _ in range(rounds):
        H = homography(ij, px - T @ bend, w)
        if len(powers):
            r = px - apply(H, ij)
            A = np.column_stack([T, np.ones(n), x])  # what a homography could do as well stays with it
            N = (A * w[:, None] ** 2).T @ A
            bend = np.linalg.solve(N + 1e-12 * np.trace(N) * np.eye(len(N)), A.T @ (r * w[:, None] ** 2))[: len(powers)]
        miss = np.hypot(*(px - apply(H, ij) - T @ bend).T)
        scale = max(1.5 * float(np.median(miss)), 1e-6)
        w = base / np.sqrt(1 + (miss / (3 * scale)) ** 2)
    return LatticeMap(H, powers, bend, middle, half), miss


def grow(s: Saddles) -> tuple[I32, I32]:
    """The largest lattice among the candidates: which (m,), and their lattice indices (m, 2), x to the right of y.

    Two candidates are linked if each is the other's nearest along one of its edges and the colours swap between them.
    """
    none = np.zeros(0, np.int32), np.zeros((0, 2), np.int32)
    if len(s) < 4:
        return none
    link = _links(s)
    best: tuple[I32, I32] = none
    seen = np.zeros(len(s), bool)
    for seed in range(len(s)):
        if seen[seed]:
            continue
        member, index = _walk(seed, s, link)
        seen[member] = True
        if len(member) > len(best[0]) and np.ptp(index, axis=0).min(initial=9) > 0:
            best = member, index
    member, index = best
    return (member, index) if len(member) >= 4 else none


def _slots(s: Saddles) -> F64:
    """The four directions (n, 4) of each candidate's edges; bright sectors lie after the even ones."""
    a = s.angle[:, 0]
    b = a + (s.angle[:, 1] - a) % np.pi
    return np.column_stack([a, b, a + np.pi, b + np.pi])


def _apart(a: F64, b: F64, period: float) -> F64:
    return np.abs((a - b + period / 2) % period - period / 2)


def _links(s: Saddles) -> I32:
    """For each candidate and slot the candidate that it is linked to, and -1 where there is none: (n, 4)."""
    n = len(s)
    k = min(NEIGHBOURS, n)
    found = cKDTree(s.place).query(s.place, k=k)
    distance, near = np.asarray(found[0]), np.asarray(found[1])
    d = s.place[near] - s.place[:, None]
    bearing = np.arctan2(d[..., 1], d[..., 0])
    first, second = s.angle[near, 0], s.angle[near, 1]
    swapped = _apart(first, s.angle[:, None, 1], np.pi) < SWAP
    swapped &= _apart(second, s.angle[:, None, 0], np.pi) < SWAP
    alike = (s.contrast[near] < 4 * s.contrast[:, None]) & (s.contrast[:, None] < 4 * s.contrast[near])
    slots = _slots(s)
    to = np.full((n, 4), -1, np.int32)
    for slot in range(4):
        ok = swapped & alike & (distance > 2.0) & (_apart(bearing, slots[:, None, slot], 2 * np.pi) < CONE)
        to[:, slot] = np.where(ok.any(1), near[np.arange(n), np.argmax(ok, axis=1)], -1)
    mutual = np.full_like(to, -1)
    for slot in range(4):
        has = np.flatnonzero(to[:, slot] >= 0)
        other = to[has, slot]
        back = np.argmin(_apart(slots[other], slots[has, slot, None] + np.pi, 2 * np.pi), axis=1)
        good = to[other, back] == has
        mutual[has[good], slot] = other[good]
    return _without_leaps(s, slots, mutual)


def _without_leaps(s: Saddles, slots: F64, link: I32) -> I32:
    """Without links much longer than the next one along the same line: they leap over hidden corners."""
    length = np.where(link >= 0, np.hypot(*np.moveaxis(s.place[link] - s.place[:, None], -1, 0)), np.inf)
    out = link.copy()
    for slot in range(4):
        has = np.flatnonzero(link[:, slot] >= 0)
        other = link[has, slot]
        on = np.argmin(_apart(slots[other], slots[has, slot, None], 2 * np.pi), axis=1)
        leap = length[has, slot] > LEAP * np.minimum(length[has, (slot + 2) % 4], length[other, on])
        out[has[leap], slot] = -1
        out[other[leap], (on[leap] + 2) % 4] = -1
    return out


def _walk(seed: int, s: Saddles, link: I32) -> tuple[I32, I32]:
    """All candidates that links reach from `seed`, with lattice indices; contradictions are left out."""
    slots = _slots(s)
    where: dict[int, tuple[int, int]] = {seed: (0, 0)}
    turn = {seed: 0}  # lattice direction of slot 0
    taken = {(0, 0): seed}
    queue = [seed]
    for p in queue:
        for slot in range(4):
            q = int(link[p, slot])
            if q < 0 or q in where:
                continue
            heading = (slot + turn[p]) % 4
            at = where[p][0] + int(STEPS[heading][0]), where[p][1] + int(STEPS[heading][1])
            if at in taken:
                continue
            same = int(np.argmin(_apart(slots[q], slots[p, slot], 2 * np.pi)))
            where[q], turn[q], taken[at] = at, (heading - same) % 4, q
            queue.append(q)
    member = np.array(list(where), dtype=np.int32)
    return member, np.array([where[int(m)] for m in member], dtype=np.int32)


def complete(s: Saddles, member: I32, index: I32, rounds: int = 12) -> tuple[I32, I32, LatticeMap]:
    """Adopts the candidates that the smooth map of a lattice foretells, and drops members that it contradicts.

    Returns which candidates, their lattice indices, and the map.
    """
    parity = _parity(s, member, index)
    for _ in range(rounds):
        before = len(member)
        smooth, miss = fit_map(index.astype(np.float64), s.place[member])
        step = _square_px(smooth, index)
        keep = miss < NEAR * step
        if keep.sum() < 4:
            break
        member, index = member[keep], index[keep]
        ij = smooth.inverse(s.place)
        with np.errstate(invalid="ignore"):
            at = np.round(ij)
            near: Bool = np.asarray(np.abs(ij - at).max(1) < NEAR)
        near &= _same_look(s, smooth, ij, at, parity)
        near[member] = False
        near &= _beside(at, index, 2.5)
        order = np.flatnonzero(near)[np.argsort(np.abs(ij - at).max(1)[near])]
        new, first = np.unique(at[order].astype(np.int32), axis=0, return_index=True)
        known = {tuple(x) for x in index.tolist()}
        fresh = np.array([tuple(x) not in known for x in new.tolist()], dtype=bool)
        member = np.concatenate([member, order[first][fresh].astype(np.int32)])
        index = np.concatenate([index, new[fresh]]).astype(np.int32)
        if len(member) == before and keep.all():
            break
    smooth, _ = fit_map(index.astype(np.float64), s.place[member])
    return member, index, smooth


def _square_px(smooth: LatticeMap, index: I32) -> F64:
    a, b = smooth.steps(index.astype(np.float64))
    return np.sqrt(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]))


def _parity(s: Saddles, member: I32, index: I32) -> int:
    """Whether the bright sectors lie after the x edge at even (0) or odd (1) lattice points."""
    smooth, _ = fit_map(index.astype(np.float64), s.place[member])
    bright = _bright_after_x(s, smooth, index.astype(np.float64), member)
    return int(np.median((bright + index.sum(1)) % 2) > 0.5)


def _bright_after_x(s: Saddles, smooth: LatticeMap, ij: F64, which: I32) -> I32:
    a, _ = smooth.steps(ij)
    bearing = np.arctan2(a[:, 1], a[:, 0])
    first = _apart(s.angle[which, 0], bearing, np.pi) < _apart(s.angle[which, 1], bearing, np.pi)
    return np.asarray(np.where(first, 0, 1), dtype=np.int32)


def _same_look(s: Saddles, smooth: LatticeMap, ij: F64, at: F64, parity: int) -> Bool:
    """Whether the edges of candidates run along the lattice there, with the colours that it has there."""
    ok: Bool = np.asarray(np.isfinite(ij).all(1))
    which = np.flatnonzero(ok).astype(np.int32)
    a, b = smooth.steps(ij[which])
    along = np.column_stack([np.arctan2(v[:, 1], v[:, 0]) for v in (a, b)])
    bright = _bright_after_x(s, smooth, ij[which], which)
    edges = np.where(bright[:, None] == 0, s.angle[which], s.angle[which, ::-1])
    ok[which] = (_apart(edges, along, np.pi) < SWAP).all(1) & ((bright + at[which].sum(1)) % 2 == parity)
    return ok


def _beside(at: F64, index: I32, reach: float) -> Bool:
    out = np.zeros(len(at), bool)
    ok = np.isfinite(at).all(1)
    if ok.any():
        out[ok] = cKDTree(index.astype(np.float64)).query(at[ok])[0] <= reach
    return out
