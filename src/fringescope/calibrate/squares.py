"""White squares: the diagonal centre of each, the projector's coordinate there, and dense samples of its phase."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import cv2
import numpy as np

from fringescope.calibrate.corners import Corners
from fringescope.calibrate.lattice import exponents
from fringescope.calibrate.lattice import terms as monomials
from fringescope.settings import BoardSettings
from fringescope.types import F32, F64, I32, Board, Bool, Decoded, Reason

SMALL = "too small in the picture"
MOST_PIXELS = 1500  #: of one square that are looked at; larger squares are strided
USABLE = ~int(Reason.ORDER_UNCERTAIN) & 0xFFFF  #: an uncertain order is judged by the whole board's phase instead
SHARE = 0.25  #: cycles: a phase this near to whole cycles off the board's model is repaired


@dataclass(frozen=True, eq=False)
class Area:
    """Usable pixels of one white square: places (n, 2), phases (n, d), standard deviations (n, d); lattice `square`."""

    square: I32
    px: F64
    phase: F64
    sigma: F64


@dataclass(frozen=True, eq=False)
class White:
    """Centres: lattice square (m, 2), place (m, 2), projector coordinate (m, 2) and its sigma (m, 2); samples: places
    (k, 2), phases (k, d), sigmas (k, d); what was left out.
    """

    square: I32
    square_px: F64
    square_uv: F64
    square_sigma: F64
    sample_px: F64
    sample_phase: F64
    sample_sigma: F64
    words: tuple[str, ...]


def measure(image: F32, decoded: Decoded, found: Corners, board: Board, s: BoardSettings) -> White:
    """Everything that a picture tells about its white squares (III-B, Fig. 4).

    The centre is where the diagonals cross: the lattice's smooth map there, corrected by the corners around, so neither
    perspective nor the lens shifts it. The projector's coordinate comes from the phases of all directions over the
    white area, clear of the edges, by a robust smooth fit.
    """
    words: Counter[str] = Counter()
    areas = [a for sq in _candidates(found) if (a := _area(sq, image, decoded, found, board, s, words)) is not None]
    g = np.array([d.g for d in decoded.directions]).reshape(-1, 2)
    areas, repaired, dropped = _settle(areas, found)
    fits = [_fit_square(a, s) for a in areas]
    usual = _usual([f.rough for f in fits])
    keep = [bool((f.rough <= s.phase_rough * usual).all()) for f in fits]
    words["phase is not smooth (highlight, dirt, movement)"] += len(keep) - sum(keep)
    told = {w: _too_small(found, board, s) if w == SMALL else w for w in words}
    said = [f"{n} white square{'s' if n > 1 else ''} left out: {told[w]}" for w, n in words.items() if n]
    if repaired:
        said.append(f"{repaired} phases a whole number of cycles off the board were repaired")
    if dropped:
        said.append(f"{dropped} phases left out: off the board by no whole number of cycles")
    chosen = [(a, f) for a, f, ok in zip(areas, fits, keep, strict=True) if ok]
    square, px, uv, sigma = _centres(chosen, found, g)
    samples = _samples(chosen, len(g), s.max_samples)
    return White(square, px, uv, sigma, *samples, tuple(said))


def _candidates(found: Corners) -> list[I32]:
    """White squares with at least two corners of the lattice (outer ones too, for samples)."""
    known = {tuple(x) for x in found.index.tolist()}
    low, high = found.index.min(0), found.index.max(0) + 1
    out = []
    for r in range(int(low[1]), int(high[1]) + 1):
        for c in range(int(low[0]), int(high[0]) + 1):
            around = [(c - 1, r - 1), (c, r - 1), (c - 1, r), (c, r)]
            if sum(p in known for p in around) >= 2:
                out.append(np.array([c, r], dtype=np.int32))
    if not out:
        return []
    white = found.is_white(np.array(out, dtype=np.int32))
    return [q for q, w in zip(out, white, strict=True) if w]


def _area(
    square: I32, image: F32, decoded: Decoded, found: Corners, board: Board, s: BoardSettings, words: Counter[str]
) -> Area | None:
    """The usable pixels of one white square, or None and a word why not."""
    middle = square - 0.5
    outline = found.smooth(middle + np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)]))
    H, W = image.shape
    x0, y0 = np.maximum(np.ceil(outline.min(0)).astype(int), 0)
    x1, y1 = np.minimum(np.floor(outline.max(0)).astype(int), [W - 1, H - 1])
    if x1 - x0 < 3 or y1 - y0 < 3:
        words["outside the picture or too small"] += 1
        return None
    side = float(np.sqrt(cv2.contourArea(outline.astype(np.float32))))
    block = (slice(y0, y1 + 1), slice(x0, x1 + 1))
    x, y = np.meshgrid(np.arange(x0, x1 + 1, dtype=np.float64), np.arange(y0, y1 + 1, dtype=np.float64))
    clear = _clear(found, board, s)
    inset = max(s.edge_clearance * side if not board.dictionary else 0.0, clear)
    inside = _inside(outline, x, y, inset)
    if board.dictionary:
        inside &= _white(image[block], found, clear)
    if inside.sum() < s.min_square_pixels:
        words[SMALL] += 1
        return None
    if not board.dictionary and image[block][inside].size:
        level = float(np.median(image[block][inside]))
        inside &= image[block] > 0.5 * level
    reasons = decoded.reasons[block]
    saturated = (reasons & int(Reason.SATURATED)) != 0
    if inside.any() and saturated[inside].mean() > 0.5:
        words["saturated"] += 1
        return None
    ok = inside & ((reasons & USABLE) == 0)
    modulation = decoded.modulation[block]
    if ok.any():
        ok &= modulation > s.min_share * float(np.median(modulation[ok]))
    phase = np.stack([d.phase[block] for d in decoded.directions], -1).astype(np.float64)
    sigma = np.stack([d.sigma[block] for d in decoded.directions], -1).astype(np.float64)
    bad = ~(np.isfinite(phase) & np.isfinite(sigma) & (sigma > 0) & (sigma < 1.0))
    phase[bad], sigma[bad] = np.nan, np.nan
    ok &= ~bad.all(-1)
    if ok.sum() < s.min_square_pixels:
        words["no fringes there (shadow, out of the projector's field, low modulation)"] += 1
        return None
    px = np.column_stack([x[ok], y[ok]])
    pick = np.arange(0, len(px), len(px) // MOST_PIXELS + 1)
    return Area(square, px[pick], phase[ok][pick], sigma[ok][pick])


def _clear(found: Corners, board: Board, s: BoardSettings) -> float:
    """How far from any edge phases are clean, pixels."""
    return max(1.0, 2.4 * math.hypot(found.blur, 0.3)) if board.dictionary else s.edge_pixels + found.blur


def _too_small(found: Corners, board: Board, s: BoardSettings) -> str:
    """How wide squares are in the picture, and how wide they should be to leave anything clean."""
    i = found.index[:, None] - found.index[None]
    far = np.linalg.norm(found.px[:, None] - found.px[None], axis=2)
    side = float(np.median(far[np.abs(i).sum(-1) == 1]))
    clear = _clear(found, board, s)
    if board.dictionary:
        needed = (2 * clear + 0.4) / (0.5 * (1 - board.marker_mm / board.square_mm))
        part = "for the white rim of a marker"
    else:
        width = math.sqrt(s.min_square_pixels)
        needed, part = max(width + 2 * clear, width / (1 - 2 * s.edge_clearance)), "clear of their edges"
    return f"{SMALL} ({side:.0f} pixels wide; needed about {max(needed, side + 1):.0f}, {part})"


def _inside(outline: F64, x: F64, y: F64, inset: float) -> Bool:
    """Pixels at least `inset` pixels within a convex outline (4, 2)."""
    ok = np.ones(x.shape, bool)
    turn = np.sign(cv2.contourArea(outline.astype(np.float32), oriented=True))
    for a, b in zip(outline, np.roll(outline, -1, 0), strict=True):
        d = (b - a) / max(float(np.hypot(*(b - a))), 1e-9)
        ok &= turn * (d[0] * (y - a[1]) - d[1] * (x - a[0])) >= inset
    return ok


def _white(block: F32, found: Corners, clear: float) -> Bool:
    """White parts of a block, `clear` pixels from anything dark."""
    light = np.percentile(block, 95)
    dark = light * float(np.median((found.level - found.half) / (found.level + found.half)))
    size = 2 * math.ceil(clear - 0.5) + 1
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    bright = (block > 0.5 * (light + dark)).astype(np.uint8)
    return np.asarray(cv2.erode(bright, disc, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0)


# -------------------------------------------------------------------------------------------- orders of the whole board


def _settle(areas: list[Area], found: Corners) -> tuple[list[Area], int, int]:
    """Phases whole cycles off the smooth phase of the whole board are repaired; others that are far off are dropped."""
    if not areas or not areas[0].phase.shape[1]:
        return areas, 0, 0
    out = [Area(a.square, a.px, a.phase.copy(), a.sigma.copy()) for a in areas]
    repaired = dropped = 0
    every = found.smooth.inverse(np.concatenate([a.px for a in out]))
    lattice = np.split(every, np.cumsum([len(a.px) for a in out])[:-1])
    for d in range(areas[0].phase.shape[1]):
        thin = [np.arange(0, len(a.px), len(a.px) // 40 + 1) for a in out]
        x = np.concatenate([ij[t] for ij, t in zip(lattice, thin, strict=True)])
        y = np.concatenate([a.phase[t, d] for a, t in zip(out, thin, strict=True)]) / (2 * math.pi)
        ok = np.isfinite(y) & np.isfinite(x).all(1)
        if ok.sum() < 60:
            continue
        model = _board_phase(x[ok], y[ok])
        for a, ij in zip(out, lattice, strict=True):
            off = a.phase[:, d] / (2 * math.pi) - model(ij)
            with np.errstate(invalid="ignore"):
                turns = np.round(off)
                near = np.abs(off - turns) < SHARE
                slipped = near & (turns != 0)
                lost = ~near & np.isfinite(off)
            a.phase[slipped, d] -= 2 * math.pi * turns[slipped]
            a.phase[lost, d], a.sigma[lost, d] = np.nan, np.nan
            repaired, dropped = repaired + int(slipped.sum()), dropped + int(lost.sum())
    return out, repaired, dropped


class _Polynomial:
    """A polynomial of two coordinates, scaled to their range."""

    def __init__(self, x: F64, degree: int) -> None:
        self.middle, self.half = np.median(x, 0), max(float(np.ptp(x, axis=0).max()) / 2, 1e-9)
        self.powers = exponents(0, degree)
        self.value = np.zeros(len(self.powers))

    def terms(self, x: F64) -> F64:
        return monomials((x - self.middle) / self.half, self.powers)

    def __call__(self, x: F64) -> F64:
        return np.asarray(self.terms(x) @ self.value)


def _least_squares(A: F64, y: F64, w: F64) -> tuple[F64, F64]:
    """Weighted least squares by the normal equations (columns of order 1): solution and its covariance."""
    N = (A * w[:, None]).T @ A
    N[np.diag_indices_from(N)] += 1e-12 * np.trace(N) / len(N)
    C = np.asarray(np.linalg.inv(N), dtype=np.float64)
    return C @ (A.T @ (w * y if y.ndim == 1 else w[:, None] * y)), C


def _board_phase(x: F64, y: F64) -> _Polynomial:
    """Phase in cycles over the lattice, robust against whole cycles: least absolute misfits, then Cauchy."""
    p = _Polynomial(x, 2)
    for degree in (1, 2, 4 if len(x) > 400 and np.ptp(x, axis=0).min() > 4 else 3):
        before = p
        first = degree == 1
        p = _Polynomial(x, degree)
        A = p.terms(x)
        r = np.ones(len(x)) if first else np.abs(y - before(x))
        for _ in range(15):
            w = 1 / np.maximum(r, 0.02)
            p.value = _least_squares(A, y, w)[0]
            r = np.abs(y - A @ p.value)
    return p


# --------------------------------------------------------------------------------------------------- one square's phase


@dataclass(frozen=True, eq=False)
class _Fit:
    """Per direction: a polynomial, its covariance, the scatter over sigma; `good` (n, d)."""

    terms: list[_Polynomial]
    covariance: list[F64]
    rough: F64
    good: Bool


def _fit_square(a: Area, s: BoardSettings) -> _Fit:
    n, d = a.phase.shape
    terms, covariance, rough, good = [], [], np.full(d, np.nan), np.zeros((n, d), bool)
    for k in range(d):
        ok = np.isfinite(a.phase[:, k])
        count = int(ok.sum())
        p = _Polynomial(a.px[ok] if count else a.px, 3 if count >= 300 else 2 if count >= 30 else 1)
        C = np.full((len(p.powers),) * 2, np.nan)
        if count >= 2 * len(p.powers):
            C, rough[k], good[:, k] = _robust(p, a.px, a.phase[:, k], a.sigma[:, k], ok, s)
        terms.append(p)
        covariance.append(C)
    return _Fit(terms, covariance, rough, good)


def _robust(p: _Polynomial, px: F64, phase: F64, sigma: F64, ok: Bool, s: BoardSettings) -> tuple[F64, float, Bool]:
    """Weighted least squares with outliers left out: covariance, scatter over sigma, which phases are good."""
    A = p.terms(px)
    use = ok.copy()
    scale, C = 1.0, np.zeros((A.shape[1],) * 2)
    for _ in range(5):
        p.value, C = _least_squares(A[use], phase[use], 1 / sigma[use] ** 2)
        pull = np.full(len(px), np.inf)
        pull[ok] = np.abs(phase[ok] - A[ok] @ p.value) / sigma[ok]
        scale = max(1.0, 1.4826 * float(np.median(pull[ok])))
        new = pull < s.phase_outlier * scale
        if (new == use).all() or new.sum() < 2 * len(p.powers):
            break
        use = new
    chi = float(np.sqrt(np.mean(np.minimum(pull[ok], 30.0) ** 2)))
    return C * scale**2, chi, use


def _usual(rough: list[F64]) -> F64:
    if not rough:
        return np.zeros(0)
    a = np.array(rough)
    out = np.ones(a.shape[1])
    for k in range(a.shape[1]):
        v = a[np.isfinite(a[:, k]), k]
        out[k] = max(float(np.median(v)), 1.0) if v.size else math.inf
    return out


# ---------------------------------------------------------------------------------------------------------- the outcome


def _centres(chosen: list[tuple[Area, _Fit]], found: Corners, g: F64) -> tuple[I32, F64, F64, F64]:
    known = {tuple(x): i for i, x in enumerate(found.index.tolist())}
    squares, places, uvs, sigmas = [], [], [], []
    for a, f in chosen:
        c, r = (int(v) for v in a.square)
        if not all(p in known for p in ((c - 1, r - 1), (c, r - 1), (c - 1, r), (c, r))):
            continue
        place, unsure = centre(found, a.square)
        here, right, below = (_coordinate(place + d, f, g) for d in ((0, 0), (1, 0), (0, 1)))
        if here is None or right is None or below is None:
            continue
        squares.append(a.square)
        places.append(place)
        uvs.append(here[0])
        per_pixel = np.hypot(right[0] - here[0], below[0] - here[0])
        sigmas.append(np.hypot(here[1], per_pixel * unsure))
    m = len(squares)
    return (
        np.array(squares, dtype=np.int32).reshape(m, 2),
        np.array(places, dtype=np.float64).reshape(m, 2),
        np.array(uvs, dtype=np.float64).reshape(m, 2),
        np.array(sigmas, dtype=np.float64).reshape(m, 2),
    )


def centre(found: Corners, square: I32) -> tuple[F64, float]:
    """Where the diagonals of a lattice square cross, pixels (2,), and the standard deviation of each: the smooth map,
    corrected by the corners around it.
    """
    at = np.asarray(square, dtype=np.float64) - 0.5
    d = found.index - at
    near = np.abs(d).max(1) < 2.0
    d, miss = d[near], found.px[near] - found.smooth(found.index[near].astype(np.float64))
    A = np.column_stack([np.ones(len(d)), d])
    if len(d) >= 12:
        A = np.column_stack([A, d[:, 0] ** 2, d[:, 0] * d[:, 1], d[:, 1] ** 2])
    w = 1 / np.maximum(found.sigma[near], 1e-9) ** 2
    fit, C = _least_squares(A, miss, w)
    scatter = float((w[:, None] * (miss - A @ fit) ** 2).sum()) / max(2 * (len(A) - A.shape[1]), 1)
    return np.asarray(found.smooth(at[None])[0] + fit[0]), math.sqrt(float(C[0, 0]) * max(scatter, 1.0))


def _coordinate(place: F64, f: _Fit, g: F64) -> tuple[F64, F64] | None:
    """Projector coordinate (2,) at a pixel and its sigma (2,), from the smooth phases of all directions."""
    use = [k for k in range(len(g)) if np.isfinite(f.rough[k])]
    if len(use) < 2:
        return None
    y, sigma = np.empty(len(use)), np.empty(len(use))
    for n, k in enumerate(use):
        t = f.terms[k].terms(place[None])[0]
        y[n], sigma[n] = t @ f.terms[k].value, math.sqrt(max(float(t @ f.covariance[k] @ t), 1e-18))
    A = 2 * math.pi * g[use] / sigma[:, None]
    N = A.T @ A
    if np.linalg.cond(N) > 1e8:
        return None
    C = np.linalg.inv(N)
    return np.asarray(C @ A.T @ (y / sigma)), np.sqrt(np.diag(C))


def _samples(chosen: list[tuple[Area, _Fit]], d: int, most: int) -> tuple[F64, F64, F64]:
    """At most `most` good pixels, as many of each square as there are, spread over it."""
    px, phase, sigma = [np.empty((0, 2))], [np.empty((0, d))], [np.empty((0, d))]
    counts = np.array([int(f.good.any(1).sum()) for _, f in chosen])
    share = _shares(counts, most)
    rng = np.random.default_rng(0)
    for (a, f), n in zip(chosen, share, strict=True):
        which = np.flatnonzero(f.good.any(1))
        which = np.sort(rng.permutation(which)[:n])
        px.append(a.px[which])
        phase.append(np.where(f.good, a.phase, np.nan)[which])
        sigma.append(np.where(f.good, a.sigma, np.nan)[which])
    return np.concatenate(px), np.concatenate(phase), np.concatenate(sigma)


def _shares(counts: I32, most: int) -> I32:
    """How many of each count to take so that all together are at most `most`, none more than it has."""
    if counts.sum() <= most:
        return counts
    low, high = 0, int(counts.max())
    while high - low > 1:
        mid = (low + high) // 2
        low, high = (mid, high) if np.minimum(counts, mid).sum() <= most else (low, mid)
    return np.asarray(np.minimum(counts, low))


