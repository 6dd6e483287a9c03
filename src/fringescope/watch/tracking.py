"""How far each tile of a picture has shifted, to a part of a pixel, with what noise leaves uncertain.

Per tile the model is now(x) = (1 + contrast) then(x - shift) + level + slope x + noise (Lucas and Kanade 1981, with a
brightness that may change slowly over the tile, as what a drying film mirrors does), solved by least squares; the
covariance is that of white noise behind the smoothing, by the tile's own gradients.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fringescope.settings import WatchSettings
from fringescope.types import F32, F64, AnyArray, Bool
from fringescope.watch.preparing import KERNEL, POWER, Pair, eroded, smooth

ROUNDS = 8  #: Gauss-Newton steps at most
SEARCH = 13.8  #: chi-squared of a shift from which it is looked for step by step; below it the first step serves
SLOPE = np.array([-0.5, 0.0, 0.5])
#: variance of a smoothed picture's central difference, for white noise of variance 1
SLOPE_POWER = float((np.convolve(KERNEL, SLOPE) ** 2).sum() * (KERNEL**2).sum())
LEAST = 0.5  #: share of a tile's pixels that must be usable


@dataclass(frozen=True, eq=False)
class Tracked:
    """Tiles of one level. Shifts in pixels of the comparison at full size (level 0), arrays (n, ..)."""

    centre: F64  #: (n, 2) column, row, in such pixels
    side: float
    shift: F64  #: (n, 2) where the search ended
    first: F64  #: (n, 2) the linear estimate about no shift
    chi2_0: F64  #: (n,) its square over the noise's covariance: chi-squared of 2 degrees where nothing moved
    cov: F64  #: (n, 2, 2) of `first`, by noise
    own_cov: F64  #: (n, 2, 2) the same, were all seen now that could be seen then
    texture: F64  #: (n, 2) eigenvalues of the gradients' structure over what noise makes of them
    change: F64  #: (n,) rms of now less then without any shift, beyond noise, as a share of the tile's brightness
    loud: F64  #: (n,) mean square of now less then over what noise explains
    chi2: F64  #: (n,) mean squared residual of the fit over what noise explains
    relief: F64  #: (n,) share of what brightness does not explain, beyond noise, that the shift explains
    seen: Bool  #: (n,) enough of it can be seen now


def track(p: Pair, surface: F32, s: WatchSettings) -> list[Tracked]:
    """All levels, the finest first. `surface` (h, w): share of each pixel that has points of the scan."""
    then, now, var, ok_a, ok_b, part = [p.then], [p.now], [p.var], [p.then_ok], [p.now_ok], [surface]
    for _ in range(1, s.levels):
        if min(then[-1].shape) < 4 * s.tile:
            break
        for stack in (then, now, part):
            stack.append(_half(stack[-1]))
        var.append(_half(var[-1]) * np.float32(0.25))
        for masks in (ok_a, ok_b):
            masks.append(_half(masks[-1].astype(np.float32)) > 0.7)
    out: list[Tracked] = []
    for k in reversed(range(len(then))):
        start = _start(out[0]) if out else None
        out.insert(0, _level(then[k], now[k], var[k], ok_a[k], ok_b[k], part[k], 2.0**k, start, s))
    return out


def _half(a: F32) -> F32:
    h, w = a.shape[0] // 2 * 2, a.shape[1] // 2 * 2
    return np.asarray(0.25 * (a[0:h:2, 0:w:2] + a[1:h:2, 0:w:2] + a[0:h:2, 1:w:2] + a[1:h:2, 1:w:2]), np.float32)


@dataclass(frozen=True, eq=False)
class _Start:
    """Shifts (m, 2) of coarser tiles at centres (m, 2), full-size pixels."""

    centre: F64
    shift: F64


def _start(coarse: Tracked) -> _Start | None:
    good = coarse.seen & (coarse.relief > 0.5) & (np.abs(coarse.shift) < coarse.side / 2).all(1)
    good &= (coarse.texture[:, 0] > 2) & (coarse.chi2_0 > SEARCH)
    return _Start(coarse.centre[good], coarse.shift[good]) if good.any() else None


def _level(
    then: F32, now: F32, var: F32, ok_a: Bool, ok_b: Bool, part: F32, scale: float, start: _Start | None,
    s: WatchSettings,
) -> Tracked:  # fmt: skip
    n = s.tile
    a, b = smooth(then), smooth(now)
    gx, gy = (np.asarray(cv2.filter2D(a, -1, k), np.float32) for k in (SLOPE[None], SLOPE[:, None]))
    ok_a, ok_b = eroded(ok_a, 2), eroded(ok_b, 1)
    weight = ok_a / np.maximum(var, 1e-6)
    step = max(1, n // 2)
    rows, columns = (np.arange(0, max(size - n, 0) + 1, step) for size in a.shape)
    r0, c0 = (x.ravel() for x in np.meshgrid(rows, columns, indexing="ij"))
    share = _patches(part, r0, c0, n).mean((1, 2))
    own = _patches(ok_a.astype(np.float32), r0, c0, n).mean((1, 2))
    keep = (share >= s.min_surface) & (own >= LEAST)
    r0, c0 = r0[keep], c0[keep]
    count = len(r0)
    centre = (np.stack([c0, r0], 1) + (n - 1) / 2.0) * scale + (scale - 1) / 2.0
    w = _patches(weight.astype(np.float32), r0, c0, n).reshape(count, n * n)
    ref = _patches(a, r0, c0, n).reshape(count, n * n)
    mean = (w * ref).sum(1, keepdims=True) / np.maximum(w.sum(1, keepdims=True), 1e-12)
    grad = [_patches(g, r0, c0, n).reshape(count, n * n) for g in (gx, gy)]
    y, x = (np.broadcast_to(a.ravel().astype(np.float32) / n, ref.shape) for a in np.mgrid[:n, :n] - (n - 1) / 2.0)
    A = np.stack([-grad[0], -grad[1], ref - mean, np.ones_like(ref), x, y], 1)  # (count, 6, n n)
    again = [_patches(smooth(g), r0, c0, n).reshape(count, n * n) for g in (gx, gy, a)]
    B = np.stack([-again[0], -again[1], again[2] - mean, np.ones_like(ref), x, y], 1)

    tiles = _Tiles(A, B, w, ref, b, ok_b.astype(np.uint8), c0, r0, n)
    e, at = tiles.look(np.zeros((count, 2)))
    first, _ = tiles.solve(e, at)
    own_cov, structure = tiles.covariance(w)
    cov, hidden = own_cov.copy(), np.flatnonzero((at != w).any(1))
    if hidden.size:
        cov[hidden], structure[hidden] = tiles.pick(hidden).covariance(at[hidden])
    seen = (at > 0).mean(1) >= LEAST * np.clip(own[keep], LEAST, 1)
    texture = np.linalg.eigvalsh(structure) / (SLOPE_POWER * 0.5 * np.maximum((at > 0).sum(1), 1))[:, None]
    chi2_0 = np.einsum("ni,nij,nj->n", first[:, :2], np.linalg.inv(cov + 1e-9 * np.eye(2)), first[:, :2])
    shift, misfit = first[:, :2].copy(), tiles.misfit(e, at, first)
    loud, bare = tiles.misfit(e, at, np.zeros_like(first)), tiles.misfit(e, at, tiles.unshifted(e, at))
    went = np.flatnonzero((chi2_0 > SEARCH) & seen)
    if went.size:
        some = tiles.pick(went)
        begin = np.zeros((went.size, 2)) if start is None else _nearest(start, centre[went]) / scale
        shift[went] = some.search(begin, n)
        e, at = some.look(shift[went])
        found, _ = some.solve(e, at)
        misfit[went] = some.misfit(e, at, found)
    mean_var = (w > 0).sum(1) / np.maximum(w.sum(1), 1e-12)
    change = np.sqrt(np.maximum(loud - 1.0, 0) * POWER * mean_var) / np.maximum(mean[:, 0], 1.0)
    relief = 1.0 - np.maximum(misfit - 1.0, 0) / np.maximum(bare - 1.0, 0.2)
    return Tracked(
        centre, n * scale, shift * scale, first[:, :2] * scale, chi2_0, cov * scale**2, own_cov * scale**2, texture,
        change, loud, misfit, relief, seen,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Tiles:
    """What least squares needs of tiles: regressors `A`, smoothed once more `B` (n, 6, k), weights and samples (n, k),
    the picture now with what is usable of it, and the first column and row (n,) of each tile of side `side`.
    """

    A: AnyArray
    B: AnyArray
    weight: AnyArray
    ref: AnyArray
    now: F32
    ok: AnyArray
    c0: AnyArray
    r0: AnyArray
    side: int

    def pick(self, k: AnyArray) -> _Tiles:
        """Some of the tiles."""
        return _Tiles(
            self.A[k], self.B[k], self.weight[k], self.ref[k], self.now, self.ok, self.c0[k], self.r0[k], self.side
        )

    def look(self, d: F64) -> tuple[AnyArray, AnyArray]:
        """Now less then, and weights, (n, k), at shifts d (n, 2) in pixels of this level."""
        if not len(d):
            return self.ref, self.weight
        n = self.side
        u = (self.c0[:, None] + np.tile(np.arange(n), n) + d[:, :1]).astype(np.float32)
        v = (self.r0[:, None] + np.repeat(np.arange(n), n) + d[:, 1:]).astype(np.float32)
        got = cv2.remap(self.now, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        seen = cv2.remap(self.ok, u, v, cv2.INTER_NEAREST, borderValue=0)
        return got - self.ref, self.weight * (seen > 0)

    def solve(self, e: AnyArray, at: AnyArray) -> tuple[F64, F64]:
        """Least squares: parameters (n, 6) and normal matrices (n, 6, 6)."""
        Aw = self.A * at[:, None]
        H = (Aw @ self.A.transpose(0, 2, 1)).astype(np.float64)
        y = (Aw @ e[:, :, None])[..., 0].astype(np.float64)
        return np.asarray(np.linalg.solve(_firm(H), y[..., None])[..., 0], np.float64), H

    def covariance(self, at: AnyArray) -> tuple[F64, F64]:
        """Of the shifts, by noise that was white before the smoothing, and the gradients' structure, (n, 2, 2)."""
        H = ((self.A * at[:, None]) @ self.A.transpose(0, 2, 1)).astype(np.float64)
        noise = ((self.B * at[:, None]) @ self.B.transpose(0, 2, 1)).astype(np.float64)
        inverse = np.linalg.inv(_firm(H))
        structure = np.linalg.inv(inverse[:, :2, :2] + 1e-12 * np.eye(2))
        return np.asarray((inverse @ noise @ inverse)[:, :2, :2]), np.asarray(structure, np.float64)

    def search(self, d: F64, n: int) -> F64:
        """Gauss and Newton's steps from shifts d (n, 2); per tile the one that leaves least."""
        best, left = d.copy(), np.full(len(d), np.inf)
        for _ in range(ROUNDS):
            e, at = self.look(d)
            found, _ = self.solve(e, at)
            rest = e - (found[:, None] @ self.A)[:, 0]
            cost = (at * rest**2).sum(1) / np.maximum(at.sum(1), 1e-12)
            better = (cost < left) & ((at > 0).mean(1) > 0.5 * LEAST)
            left = np.where(better, cost, left)
            best = np.where(better[:, None], d + np.clip(found[:, :2], -n / 6, n / 6), best)
            move = np.clip(np.nan_to_num(found[:, :2]), -n / 6, n / 6)
            if np.abs(move).max() < 0.01:
                break
            d = np.clip(d + move, -n / 2, n / 2)
        return np.clip(best, -n / 2, n / 2)

    def unshifted(self, e: AnyArray, at: AnyArray) -> F64:
        """As `solve`, the shifts held at 0."""
        Aw = self.A[:, 2:] * at[:, None]
        H = (Aw @ self.A[:, 2:].transpose(0, 2, 1)).astype(np.float64)
        y = (Aw @ e[:, :, None]).astype(np.float64)
        return np.concatenate([np.zeros((len(y), 2)), np.linalg.solve(_firm(H), y)[..., 0]], 1)

    def misfit(self, e: AnyArray, at: AnyArray, found: F64) -> F64:
        """Mean square (n,) of what parameters (n, 6) leave, over what noise explains."""
        rest = e - (found[:, None] @ self.A)[:, 0]
        return np.asarray((at * rest**2).sum(1) / (POWER * np.maximum((at > 0).sum(1), 1)), np.float64)


def _firm(H: F64) -> F64:
    """Normal matrices (n, k, k) that can be inverted."""
    ridge = 1e-6 * np.einsum("nii->ni", H) + 1e-12
    return np.asarray(H + ridge[:, :, None] * np.eye(H.shape[1]))


def _patches(a: AnyArray, r0: AnyArray, c0: AnyArray, n: int) -> AnyArray:
    """Squares (count, n, n) of a picture whose first pixels are (r0, c0)."""
    if min(a.shape) < n:
        return np.zeros((len(r0), n, n), a.dtype)
    return np.asarray(np.lib.stride_tricks.sliding_window_view(a, (n, n))[r0, c0])


def _nearest(start: _Start, centre: F64) -> F64:
    """Shift of the coarser tile that is nearest to each centre."""
    from scipy.spatial import cKDTree

    _, k = cKDTree(start.centre).query(centre)
    return np.asarray(start.shift[k])
