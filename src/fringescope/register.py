"""Rigid registration of one scan's surface to another's, and guidelines carried over by it.

Point to plane with the normals of both surfaces: the residual of a pair is r = m . (R p + t - q), with m the mean of
the moved normal of p and the normal of q, made a unit vector; what is minimised is the sum of rho(r / sigma), with
Tukey's biweight rho, so that a part that was cut away or bent has no say. With p' = R (p - c) + c + t and a further
small turn w about c and shift v, the derivative of r is m . (w x (p' - c) + v) = ((p' - c) x m) . w + m . v.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fringescope import geometry
from fringescope.errors import EmptyResultError, RegistrationError
from fringescope.settings import RegisterSettings
from fringescope.types import F64, AnyArray, Bool, Cloud, Pose

_COARSE, _FINE = 900, 12_000  #: points that take part
_TARGET = 90_000
_TUKEY = 4.685
_PATCHES = 14  #: patches along the longer side: errors within one are not independent


@dataclass(frozen=True, eq=False)
class Patch:
    """A surface as points: xyz (n, 3) and unit normals (n, 3), sigma (n,) mm."""

    xyz: F64
    normals: F64
    sigma: F64

    def only(self, keep: AnyArray) -> Patch:
        """Some of the points."""
        return Patch(self.xyz[keep], self.normals[keep], self.sigma[keep])


@dataclass(frozen=True, eq=False)
class Registration:
    """Where a surface has gone: `T_new_old` maps points of the old scan to where they are in the new one.

    `rms_mm`: of the inliers' residuals along the normal. `inliers`: share of the old points (of those that have
    a counterpart) that fit within noise. `covariance` (6, 6) belongs to a turn (rad) about `centre` (new world) and a
    shift (mm), in that order, as `T_new_old` followed by exp(w) about the centre and v. `loose` (k, 6): unit directions
    of turn (times `lever_mm`) and shift that the surface does not tell; along them nothing was moved, and the
    covariance holds what `max_shift_mm` leaves open. `words` say so.
    """

    T_new_old: Pose
    rms_mm: float
    inliers: float
    iterations: int
    converged: bool
    covariance: F64
    centre: F64
    lever_mm: float
    shift_mm: float  #: of the centre of the old surface
    turn_rad: float
    loose: F64
    words: tuple[str, ...]

    @property
    def shift_sigma_mm(self) -> F64:
        """Standard deviation of the shift of `centre`, (3,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[3:]))

    @property
    def turn_sigma_rad(self) -> F64:
        """Standard deviation of the turn about the world's axes, (3,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)[:3]))


def patch_of(cloud: Cloud, keep: AnyArray | None = None) -> Patch:
    """The points of a cloud (of those to `keep`) that are finite and have a normal."""
    ok = np.isfinite(cloud.xyz).all(1) & np.isfinite(cloud.normals).all(1)
    if keep is not None:
        ok &= keep
    sigma = cloud.sigma[ok].astype(np.float64)
    usual = float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else 0.0
    sigma = np.where(np.isfinite(sigma), sigma, usual)
    return Patch(cloud.xyz[ok].astype(np.float64), cloud.normals[ok].astype(np.float64), sigma)


def still(centre: AnyArray) -> Registration:
    """Nothing moved, and that is known: for an instrument and a specimen that stayed where they were."""
    one = Pose(np.eye(3), np.zeros(3))
    nowhere = np.zeros((0, 6))
    return Registration(one, 0.0, 1.0, 0, True, np.zeros((6, 6)), np.asarray(centre, float), 1.0, 0.0, 0.0, nowhere, ())


def register(old: Patch, new: Patch, s: RegisterSettings | None = None, start: Pose | None = None) -> Registration:
    """The rigid motion that lays the old surface on the new one; up to `max_shift_mm` and `max_turn_deg`.

    Tries no motion first (or `start`), then shifts and turns all around, and keeps the first unless another fits
    clearly better. Up to `1 - min_inliers` of the surface may have changed. Raises RegistrationError where the
    surfaces do not fit each other (moved too far, bent, another specimen), EmptyResultError where there are too few
    points.
    """
    s = s or RegisterSettings()
    for which, patch in (("first", old), ("second", new)):
        if len(patch.xyz) < 100:
            raise EmptyResultError(f"the {which} surface has {len(patch.xyz)} points; needed 100 to register it")
    pair = _Pair(old, new, s)
    begun = start or Pose(np.eye(3), np.zeros(3))
    pose, tried = pair.coarse(begun)
    pose, rounds, converged = pair.fine(pose)
    return pair.judged(pose, rounds + tried, converged)


class _Pair:
    """Two surfaces about to be registered: the old one's points, the new one's search tree."""

    def __init__(self, old: Patch, new: Patch, s: RegisterSettings) -> None:
        from scipy.spatial import cKDTree  # much of SciPy, which a scan can do without

        self.s = s
        self.old = old.only(_spread(old.xyz, _FINE))
        self.new = new.only(_spread(new.xyz, _TARGET))
        self.tree = cKDTree(self.new.xyz, balanced_tree=False, compact_nodes=False)
        self.c = np.median(self.old.xyz, axis=0)
        self.lever = float(np.sqrt(np.mean(((self.old.xyz - self.c) ** 2).sum(1))))
        few = self.new.xyz[:: max(1, len(self.new.xyz) // 2000)]
        self.spacing = float(np.median(np.asarray(self.tree.query(few, k=2)[0])[:, 1]))
        self.floor = max(s.floor_mm, 0.0)

    # ------------------------------------------------------------------------------------------------------- matching

    def pairs(self, old: Patch, pose: Pose, reach: float) -> tuple[F64, F64, F64, F64, Bool]:
        """Moved points, pair normals, residuals along them, their sigma; and which have a counterpart in reach."""
        p = geometry.transform(pose, old.xyz)
        n = old.normals @ pose.R.T
        d, at = self.tree.query(p, distance_upper_bound=reach)
        ok = np.isfinite(d)
        at = np.where(ok, at, 0)
        m = n + self.new.normals[at]
        size = np.asarray(np.linalg.norm(m, axis=1))
        ok &= size > 1.6  # normals within 74 degrees of each other
        m /= np.maximum(size, 1e-9).reshape(-1, 1)
        gap = p - self.new.xyz[at]
        r = np.einsum("ij,ij->i", m, gap)
        sigma = np.sqrt(old.sigma**2 + self.new.sigma[at] ** 2 + self.floor**2)
        aside = np.sqrt(np.maximum((gap**2).sum(1) - r**2, 0))
        ok &= aside < max(2.5 * self.spacing, 0.5 * reach)  # beyond the rim of the new surface there is no counterpart
        return p, m, r, sigma, ok

    def step(self, old: Patch, pose: Pose, reach: float, least: float) -> tuple[Pose, float]:
        """One robust Gauss-Newton step; the moved pose, and the largest movement in mm that the step makes."""
        p, m, r, sigma, ok = self.pairs(old, pose, reach)
        if ok.sum() < 30:
            return pose, 0.0
        J, r, sigma = self.jacobian(p[ok], m[ok]), r[ok], sigma[ok]
        scale = max(float(np.quantile(np.abs(r), 0.3)) / 0.3853, least)  # from what fits best: the rest may be cut
        w = _tukey(r / np.hypot(_TUKEY * scale, 3 * sigma)) / sigma**2
        H = (J * w[:, None]).T @ J
        values, vectors = np.linalg.eigh(H)
        firm = values > self.s.loose_share * values[-1]
        x = vectors[:, firm] @ ((vectors[:, firm].T @ -(J.T @ (w * r))) / values[firm])
        return self.moved(pose, x), float(np.linalg.norm(x[:3]) + np.linalg.norm(x[3:]))

    def jacobian(self, p: F64, m: F64) -> F64:
        """Derivatives (n, 6) of the residuals by turn (times the lever: in mm) and shift."""
        return np.hstack([np.cross(p - self.c, m) / self.lever, m])

    def moved(self, pose: Pose, x: F64) -> Pose:
        """The pose followed by a turn (6-vector's first three over the lever, about the centre) and a shift."""
        R = _turn(x[:3] / self.lever)
        return geometry.compose(Pose(R, self.c - R @ self.c + x[3:]), pose)

    # -------------------------------------------------------------------------------------------------- coarse to fine

    def coarse(self, begun: Pose) -> tuple[Pose, int]:
        """The best of several starts; `begun` unless another is clearly better. And how many steps were taken."""
        s = self.s
        few = self.old.only(_spread(self.old.xyz, _COARSE))
        reach = s.max_shift_mm + math.radians(s.max_turn_deg) * self.lever
        up = self.old.normals.mean(axis=0)
        up /= max(float(np.linalg.norm(up)), 1e-9)
        x = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
        x /= np.linalg.norm(x)
        y = np.cross(up, x)
        starts = [begun]
        first, steps = self.settled(few, begun, reach, 12)
        best, cost = first, self.cost(few, first)
        if cost < s.plain_mm:
            return best, steps
        shift = 0.55 * s.max_shift_mm
        turn = 0.6 * math.radians(s.max_turn_deg) * self.lever
        for a in (0.0, -1.0, 1.0):
            for i in (0.0, -1.0, 1.0):
                for j in (0.0, -1.0, 1.0):
                    if a or i or j:
                        starts.append(self.moved(begun, np.r_[a * turn * up, shift * (i * x + j * y)]))
        tried = []
        for one in starts[1:]:
            pose, n = self.settled(few, one, 0.5 * reach, 5)
            steps += n
            tried.append((self.cost(few, pose), pose))
        tried.sort(key=lambda t: t[0])
        for _, pose in tried[:3]:
            pose, n = self.settled(few, pose, 0.25 * reach, 10)
            steps += n
            now = self.cost(few, pose)
            if now < 0.7 * cost:
                best, cost = pose, now
        return (best, steps) if cost < s.plain_mm else self.by_parts(few, best, cost, steps, x, y)

    def by_parts(self, few: Patch, best: Pose, cost: float, steps: int, x: F64, y: F64) -> tuple[Pose, int]:
        """Where one side was cut away, all of it fits best with a lean that fits nowhere: each part is tried alone."""
        some = self.old.only(_spread(self.old.xyz, 4 * _COARSE))
        a, b = (some.xyz - self.c) @ x, (some.xyz - self.c) @ y
        parts = [a > 0, a < 0, b > 0, b < 0, (a > 0) & (b > 0), (a > 0) & (b < 0), (a < 0) & (b > 0), (a < 0) & (b < 0)]
        begun, least = best, 0.7 * cost
        for part in parts:
            if part.sum() < 60:
                continue
            pose, n = self.settled(some.only(part), begun, self.s.max_shift_mm / 2, 12)
            pose, m = self.settled(few, pose, 1.0, 6)
            steps += n + m
            now = self.cost(few, pose)
            if now < least:
                best, least = pose, now
                if now < self.s.plain_mm:
                    break
        return best, steps

    def settled(self, few: Patch, pose: Pose, reach: float, rounds: int) -> tuple[Pose, int]:
        """Some steps on thinned points, the reach closing."""
        for k in range(rounds):
            pose, step = self.step(few, pose, max(reach * 0.7**k, 4 * self.spacing, 0.5), 0.02)
            if step < 1e-3:
                return pose, k + 1
        return pose, rounds

    def cost(self, few: Patch, pose: Pose) -> float:
        """How far the nearest half of the points are from the other surface along the normal, mm."""
        _, _, r, _, ok = self.pairs(few, pose, 3.0)
        away = np.sort(np.where(ok, np.abs(r), 3.0))
        return float(away[: max(1, int(0.5 * len(away)))].mean())

    def fine(self, pose: Pose) -> tuple[Pose, int, bool]:
        """Steps on many points until they are nothing."""
        reach = max(6 * self.spacing, 1.0)
        for k in range(self.s.rounds):
            pose, step = self.step(self.old, pose, reach, 0.0)
            reach = max(0.8 * reach, 3 * self.spacing)
            if step < 2e-4 and k >= 3:  # finer than pairs that change partners to and fro
                return pose, k + 1, True
        return pose, self.s.rounds, False

    # --------------------------------------------------------------------------------------------------------- verdict

    def judged(self, pose: Pose, iterations: int, converged: bool) -> Registration:
        """What was reached, with its covariance; refused where it is not worth the name."""
        s = self.s
        p, m, r, sigma, ok = self.pairs(self.old, pose, max(4 * self.spacing, 1.0))
        spread = 1.4826 * float(np.median(np.abs(r[ok]))) if ok.any() else np.inf
        fits = ok & (np.abs(r) < np.minimum(np.maximum(s.inlier_mm, 4 * sigma), 3 * s.inlier_mm))
        share = float(fits.mean())
        shift = float(np.linalg.norm(geometry.transform(pose, self.c) - self.c))
        turn = float(np.arccos(np.clip((np.trace(pose.R) - 1) / 2, -1, 1)))
        figures = (
            f"{100 * share:.0f} % of it within {1e3 * s.inlier_mm:.0f} um, moved by {shift:.2f} mm and "
            f"{math.degrees(turn):.2f} degrees"
        )
        if share < s.min_inliers:
            raise RegistrationError(
                f"the two surfaces do not fit each other ({figures}; needed {100 * s.min_inliers:.0f} %): another "
                f"specimen, bent, or moved by more than {s.max_shift_mm:g} mm or {s.max_turn_deg:g} degrees; scan again"
            )
        if shift > 1.2 * s.max_shift_mm or turn > 1.2 * math.radians(s.max_turn_deg):
            raise RegistrationError(
                f"the surface has moved too far to be followed ({figures}; at most {s.max_shift_mm:g} mm and "
                f"{s.max_turn_deg:g} degrees): put it back, or take the new scan as a new case"
            )
        J, r, sigma, p = self.jacobian(p[fits], m[fits]), r[fits], sigma[fits], p[fits]
        w = _tukey(r / np.hypot(_TUKEY * spread, 3 * sigma)) / sigma**2
        H = (J * w[:, None]).T @ J
        values, vectors = np.linalg.eigh(H)
        firm = values > s.loose_share * values[-1]
        inverse = (vectors[:, firm] / values[firm]) @ vectors[:, firm].T
        score = _patch_sums(p, J * (w * r)[:, None])
        n = len(score)
        spread_of = score.T @ score * n / max(n - 6, 1)
        least = (J * (w**2 * sigma**2)[:, None]).T @ J  # no better than independent noise would allow
        cov = inverse @ (spread_of + least) @ inverse
        loose = vectors[:, ~firm]
        cov += loose @ loose.T * s.max_shift_mm**2
        scale = np.r_[np.full(3, 1 / self.lever), np.ones(3)]
        words = _loose_words(loose, self.lever)
        return Registration(
            pose, float(np.sqrt(np.mean(r**2))), share, iterations, converged, cov * np.outer(scale, scale),
            self.c, self.lever, shift, turn, loose.T.copy(), words,
        )  # fmt: skip


def _tukey(u: F64) -> F64:
    return np.asarray(np.where(np.abs(u) < 1, (1 - np.minimum(u * u, 1)) ** 2, 0.0))


def _turn(w: F64) -> F64:
    """exp(w): the rotation about w by |w| (Rodrigues)."""
    a = float(np.linalg.norm(w))
    K = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
    if a < 1e-9:
        return np.asarray(np.eye(3) + K)
    return np.asarray(np.eye(3) + math.sin(a) / a * K + (1 - math.cos(a)) / a**2 * (K @ K))


def _spread(xyz: F64, most: int) -> AnyArray:
    """About `most` points at most, one of every cube of a net, as even as it can be; the same for the same points."""
    if len(xyz) <= most:
        return np.arange(len(xyz))
    few = xyz[:: max(1, len(xyz) // (8 * most))]
    size = np.percentile(few, 99, axis=0) - np.percentile(few, 1, axis=0)
    cell = max(math.sqrt(float(np.sort(size)[1:].prod()) / most), 1e-6)
    step = max(1, len(xyz) // (6 * most))
    rows = np.arange(0, len(xyz), step)
    at = np.floor((xyz[rows] - few.min(0)) / cell).astype(np.int64)
    key = (at[:, 0] * 73_856_093) ^ (at[:, 1] * 19_349_663) ^ (at[:, 2] * 83_492_791)
    _, first = np.unique(key, return_index=True)
    first = rows[np.sort(first)]
    return first[:: -(-len(first) // most)] if len(first) > 1.3 * most else first


def _patch_sums(p: F64, score: F64) -> F64:
    """Sums (k, 6) of the scores (n, 6) of the points of each patch of the surface."""
    size = max(float(np.ptp(p, axis=0).max()) / _PATCHES, 1e-6)
    at = np.floor((p - p.min(0)) / size).astype(np.int64)
    _, key = np.unique((at[:, 0] * 64 + at[:, 1]) * 64 + at[:, 2], return_inverse=True)
    return np.stack([np.bincount(key.ravel(), score[:, k]) for k in range(6)], 1)


def _loose_words(loose: F64, lever: float) -> tuple[str, ...]:
    """What the surface does not tell, for people. `loose` (6, k): turns (times the lever) and shifts."""
    k = loose.shape[1]
    if k == 0:
        return ()
    turns, shifts = (loose[:3] ** 2).sum(0), (loose[3:] ** 2).sum(0)
    if k == 3 and np.linalg.svd(loose[:3], compute_uv=False)[1] < 0.1:  # one turn, and shifts without a turn
        return ("the surface is nearly a plane: shifts along it and turns about its normal are not told by it",)
    if k == 3:
        return ("the surface is nearly a sphere: turns about its middle are not told by it",)
    out = []
    for j in range(k):
        kind, v = ("a turn about", loose[:3, j]) if turns[j] > shifts[j] else ("a shift along", loose[3:, j])
        v = v / max(float(np.linalg.norm(v)), 1e-9)
        out.append(f"{kind} ({v[0]:.2f}, {v[1]:.2f}, {v[2]:.2f})")
    return (f"the surface hardly tells {' and '.join(out)} (about its middle, turns at {lever:.0f} mm)",)


# ----------------------------------------------------------------------------------------------------------- carry over


def carried(points: AnyArray | Sequence[Sequence[float]], found: Registration) -> tuple[F64, F64]:
    """World points (n, 3) of the old scan where they are in the new one, and the error to expect of each, um (n,).

    The error is that of the registration at the point (root of the trace of its covariance there) and the residual of
    the surface, together. Raises RegistrationError for points that are not (n, 3) and finite.
    """
    p = np.asarray(points, dtype=np.float64)
    if p.ndim != 2 or p.shape[1] != 3 or not np.isfinite(p).all():
        raise RegistrationError(f"points of shape {p.shape} to carry over; needed (n, 3), finite, world mm")
    q = geometry.transform(found.T_new_old, p)
    a = q - found.centre
    D = np.zeros((len(q), 3, 6))
    D[:, 0, 1], D[:, 0, 2] = a[:, 2], -a[:, 1]
    D[:, 1, 0], D[:, 1, 2] = -a[:, 2], a[:, 0]
    D[:, 2, 0], D[:, 2, 1] = a[:, 1], -a[:, 0]
    D[:, [0, 1, 2], [3, 4, 5]] = 1.0
    variance = np.einsum("nij,jk,nik->n", D, found.covariance, D)
    return q, 1e3 * np.sqrt(variance + found.rms_mm**2)
