"""Shifts of tiles to a verdict: what noise explains, what the limits allow, and the rigid motion that fits them all."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fringescope import geometry
from fringescope.settings import WatchSettings
from fringescope.types import (
    F64,
    AnyArray,
    Bool,
    Camera,
    CameraWatch,
    Motion,
    Standing,
    TileState,
    Watched,
    WatchTiles,
)
from fringescope.watch.tracking import Tracked

OVERLAP = 4  #: tiles of one level that hold the same pixel
TOGETHER = 3  #: tiles that touch a shifted one and shifted alike, fewer than which do not make a motion
FARTHEST = 0.4  #: sides of a tile; what went farther is not found by it
ALIKE = 0.7  #: cosine between their directions
OUTLIER = 12.0  #: squared sigmas from which a tile does not take part in the rigid motion
PRIOR = np.array([20.0, 20.0, 20.0, 0.3, 0.3, 0.3])  #: mm and rad: no motion is larger; makes one camera's solvable
MOST_NOISE = 4.0  #: the noise model is corrected by this factor of variance at most
MISFIT = 3.0  #: mean square over noise from which a change of brightness is none of noise
RELIEF = 0.4  #: share of a change that a shift must explain to be taken for one


@dataclass(frozen=True, eq=False)
class Tested:
    """One camera's tiles, level by level, with the world points (n, 3) in their middles. `why` not empty: blind."""

    name: str
    camera: Camera | None
    levels: Sequence[Tracked]
    points: Sequence[F64]
    bin_: int
    gain: tuple[float, ...]
    why: str = ""


def blind(name: str, why: str, gain: tuple[float, ...] = ()) -> Tested:
    """A camera that cannot say anything."""
    return Tested(name, None, (), (), 1, gain, why)


@dataclass(frozen=True, eq=False)
class _Votes:
    """All tiles of one camera, level after level, arrays (n, ..). Shifts and deviations in mm."""

    centre: F64
    side: F64
    level: AnyArray  #: (n,) 0 = finest
    point: F64
    could: Bool  #: it has texture
    votes: Bool  #: and is seen
    fair: Bool  #: of the finest level, with a surface, seen: its brightness can be compared
    odd: Bool  #: its brightness is not what it was, by more than is usual in this picture
    true: Bool  #: a shift explains most of what changed
    shift: F64  #: (n, 2) mm, only along what is known
    sigma: F64  #: (n,) mm, along what is known best
    chi2: F64  #: (n,) of the shift, 2 degrees of freedom
    px: F64  #: (n, 2) shift in pixels of the comparison
    cov: F64  #: (n, 2, 2) of it
    mm: F64  #: (n,) width of such a pixel across the line of sight


def _votes(t: Tested, s: WatchSettings) -> _Votes:
    assert t.camera is not None
    def of(name: str) -> AnyArray:
        return np.concatenate([getattr(k, name) for k in t.levels])

    shift, cov, texture, seen = of("shift"), of("cov"), of("texture"), of("seen")
    level = np.concatenate([np.full(len(k.centre), i) for i, k in enumerate(t.levels)])
    side = np.concatenate([np.full(len(k.centre), k.side) for k in t.levels])
    point = np.concatenate(list(t.points))
    with np.errstate(invalid="ignore"):
        mm = geometry.transform(t.camera.pose, point)[:, 2] / float(t.camera.lens.K[0, 0]) * t.bin_
    there = np.isfinite(mm)
    mm = np.where(there, mm, 1.0)
    own_best = np.sqrt(np.maximum(np.linalg.eigvalsh(of("own_cov"))[:, 0], 0)) * mm
    could = there & (own_best < s.tile_sigma_mm) & (texture[:, 1] > 2)
    fine = could & seen & (level == 0)
    scale = float(np.clip(np.median(of("chi2")[fine]), 1.0, MOST_NOISE)) if fine.sum() > 20 else 1.0
    total = scale * cov + s.floor_px**2 * np.eye(2)
    values, axes = np.linalg.eigh(total)
    fine_enough = np.sqrt(np.maximum(values, 0)) * mm[:, None] < s.tile_sigma_mm + s.floor_px * mm[:, None]
    known = fine_enough & (texture[:, :1] > 2)
    known[:, 0] = True
    along = np.einsum("nij,ni->nj", axes, shift) * known
    kept = np.einsum("nij,nj->ni", axes, along)
    first = of("first")
    chi2 = np.einsum("ni,nij,nj->n", first, np.linalg.inv(total), first)
    fair = there & seen & (level == 0)
    change, usual = of("change"), float(np.median(of("change")[fair])) if fair.any() else 0.0
    most = min(max(s.max_light, s.max_light_factor * usual), s.max_light_ever)
    odd = fair & (change > most) & (of("loud") > MISFIT * scale)
    true = could & seen & (of("relief") > RELIEF)
    sigma = np.sqrt(np.maximum(values[:, 0], 0)) * mm
    return _Votes(
        of("centre"), side, level, point, could, could & seen, fair, odd, true, kept * mm[:, None], sigma, chi2,
        shift, total, mm,
    )  # fmt: skip


def verdict(tested: Sequence[Tested], s: WatchSettings) -> Watched:
    """All cameras' tiles to one verdict."""
    from scipy.stats import chi2 as chi2_of

    every = {t.name: _votes(t, s) for t in tested if not t.why and any(len(k.centre) for k in t.levels)}
    number = max(sum(int(v.votes.sum()) for v in every.values()), 1)
    limit = float(chi2_of.isf(s.false_alarm / number, 2))
    cameras, states = [], {}
    for t in tested:
        if t.name not in every:
            n0 = np.zeros(0)
            none = WatchTiles(np.zeros((0, 2)), n0, n0, np.zeros((0, 2)), n0, n0, np.zeros(0, np.int8))
            why = t.why or "the scan has no surface there that fills a tile"
            cameras.append(CameraWatch(t.name, 0.0, None, 0.0, 0.0, t.gain, none, why))
            continue
        v = every[t.name]
        size = np.linalg.norm(v.shift, axis=1)
        real = v.votes & v.true & (v.chi2 > limit) & (size > s.suspect_mm) & (size < FARTHEST * v.side * v.mm)
        real &= _supported(v, real) >= TOGETHER
        odd = v.odd & ~real
        odd &= touching(v.centre, float(v.side.min()), odd, None) >= TOGETHER
        state = np.where(v.votes, int(TileState.STILL), int(TileState.NO_VOTE)).astype(np.int8)
        state[real] = TileState.SHIFTED
        state[real & (size > s.stale_mm)] = TileState.MOVED
        state[odd] = TileState.CHANGED
        states[t.name] = state
        fine = v.level == 0
        could = max(int((v.could & fine).sum()), 1)
        worst = int(np.argmax(np.where(real & (fine | ~(real & fine).any()), size, -1)))
        n = t.bin_
        tiles = WatchTiles(
            (v.centre + 0.5) * n - 0.5, v.side * n, v.side * v.mm, np.where(v.votes[:, None], v.shift, np.nan), v.sigma,
            np.exp(-v.chi2 / 2), state,
        )  # fmt: skip
        little = int((v.could & fine).sum()) < s.min_texture * int((np.isfinite(v.point[:, 0]) & fine).sum())
        note = "too little texture to tell shifts" if little or not v.could.any() else ""
        cameras.append(
            CameraWatch(
                t.name,
                float(size[worst]) if real.any() else 0.0,
                (float(tiles.centre[worst, 0]), float(tiles.centre[worst, 1])) if real.any() else None,
                float((v.votes & fine).sum() / could),
                float(odd.sum() / max(int(v.fair.sum()), 1)),
                t.gain,
                tiles,
                note,
            )
        )
    motion = rigid(every, {t.name: t for t in tested})
    most = max((float(v.chi2[v.votes].max(initial=0.0)) for v in every.values()), default=0.0)
    p = min(1.0, float(np.exp(-most / 2)) * number, motion.p if motion else 1.0)
    together = max((_together(every[n], states[n]) for n in every), default=0)
    standing, why = _judge(cameras, motion, together, s)
    judged = float(np.mean([c.judged for c in cameras]))
    return Watched(standing, why, tuple(cameras), motion, p, judged)


def touching(centre: F64, side: float, some: Bool, way: F64 | None) -> AnyArray:
    """How many of the marked tiles (n,) of one size touch each of them; with `way` (n, 2), of those that went in about
    the same direction, for a film's highlights go each its own way.
    """
    from scipy.spatial import cKDTree

    out = np.zeros(len(some), np.intp)
    k = np.flatnonzero(some)
    if not k.size:
        return out
    pairs = cKDTree(centre[k]).query_pairs(1.01 * side, output_type="ndarray")
    if way is not None:
        unit = way[k] / np.maximum(np.linalg.norm(way[k], axis=1, keepdims=True), 1e-12)
        pairs = pairs[(unit[pairs[:, 0]] * unit[pairs[:, 1]]).sum(1) > ALIKE]
    out[k] = np.bincount(pairs.ravel(), minlength=k.size)
    return out


def _supported(v: _Votes, real: Bool) -> AnyArray:
    """`touching`, level by level."""
    out = np.zeros(len(real), np.intp)
    for k in np.unique(v.level[real]):
        some = real & (v.level == k)
        out[some] = touching(v.centre, float(v.side[some][0]), some, v.shift)[some]
    return out


def _together(v: _Votes, state: AnyArray) -> int:
    """Most tiles of one level that have moved."""
    moved = state == TileState.MOVED
    return max((int((moved & (v.level == k)).sum()) for k in np.unique(v.level)), default=0)


def _judge(
    cameras: Sequence[CameraWatch], motion: Motion | None, together: int, s: WatchSettings
) -> tuple[Standing, str]:
    moved = motion is not None and motion.p < s.false_alarm and motion.largest_mm > 3 * motion.sigma_largest_mm
    far = motion.largest_mm if motion is not None and moved else 0.0
    told = f"moved by {far:.2f} mm, by all cameras together: {_words(motion)}" if motion is not None else ""
    worst = max(cameras, key=lambda c: c.shift_mm)
    at = worst.at or (0.0, 0.0)
    local = f"{worst.camera}: {worst.shift_mm:.2f} mm at pixel ({at[0]:.0f}, {at[1]:.0f})"
    gone = max(cameras, key=lambda c: c.changed)
    lost = f"{gone.camera}: {100 * gone.changed:.1f} % of what it sees is covered or no longer what was scanned"
    if far > s.stale_mm:
        return Standing.STALE, told
    if together >= TOGETHER and worst.shift_mm > s.stale_mm:
        return Standing.STALE, f"{told}; most, {local}" if far > s.suspect_mm else f"part of it moved; {local}"
    if gone.changed > 0.5:
        return Standing.STALE, lost
    if far > s.suspect_mm:
        return Standing.SUSPECT, told
    if worst.shift_mm > s.suspect_mm:
        return Standing.SUSPECT, f"part of it shifted; {local}"
    if gone.changed > 0:
        return Standing.SUSPECT, lost
    for c in cameras:
        if c.note:
            return Standing.SUSPECT, f"{c.camera}: {c.note}"
    least = min(cameras, key=lambda c: c.judged)
    if least.judged < s.min_judged:
        return Standing.SUSPECT, f"{least.camera}: only {100 * least.judged:.0f} % of what it could judge can be seen"
    if motion is not None:
        return Standing.VALID, f"nothing moved: {_words(motion)}"
    return Standing.VALID, "nothing moved"


def _words(m: Motion | None) -> str:
    if m is None:
        return ""
    move = ", ".join(f"{a} {d:+.3f} +- {e:.3f}" for a, d, e in zip("xyz", m.move_mm, m.sigma_move_mm, strict=True))
    turn = float(np.degrees(np.linalg.norm(m.turn_rad)))
    return f"{move} mm, turned {turn:.2f} +- {np.degrees(np.linalg.norm(m.sigma_turn_rad)):.2f} degrees"


def rigid(every: dict[str, _Votes], tested: dict[str, Tested]) -> Motion | None:
    """The rigid motion that most fine tiles of all cameras agree on; None where fewer than 6 vote."""
    from scipy.stats import chi2 as chi2_of

    P, J, d, C = [], [], [], []
    for name, v in every.items():
        t = tested[name]
        assert t.camera is not None
        use = v.votes & ~v.odd & (v.level == 0)
        p = v.point[use]
        P.append(p)
        d.append(v.px[use])
        C.append(OVERLAP * v.cov[use])
        J.append(_slopes(t.camera, p) / t.bin_)
    points = np.concatenate(P) if P else np.zeros((0, 3))
    if len(points) < 6:
        return None
    about = points.mean(0)
    q = points - about
    cross = np.zeros((len(q), 3, 3))  # turn x q = -[q]x turn
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = q[:, 2], -q[:, 1], q[:, 0]
    cross -= cross.transpose(0, 2, 1).copy()
    A = np.concatenate(J) @ np.concatenate([np.broadcast_to(np.eye(3), cross.shape), cross], 2)
    y, W = np.concatenate(d), np.linalg.inv(np.concatenate(C))
    weight = np.ones(len(y))
    x, cov, r2 = np.zeros(6), np.eye(6), np.zeros(len(y))
    for k in range(12):
        AW = A.transpose(0, 2, 1) @ (W * weight[:, None, None])
        cov = np.linalg.inv((AW @ A).sum(0) + np.diag(PRIOR**-2.0))
        x = cov @ (AW @ y[..., None]).sum(0)[:, 0]
        r = y - (A @ x)
        r2 = np.einsum("ni,nij,nj->n", r, W, r)
        inner = max(float(np.median(r2)) / 1.386, 1.0)
        cut = OUTLIER * inner * max(1.0, 4.0 - k)
        weight = np.where(r2 < cut, (1 - r2 / cut) ** 2, 0.0)
    cov = cov * max(float(np.median(r2[r2 < OUTLIER])) / 1.386 if (r2 < OUTLIER).any() else 1.0, 1.0)
    went = np.concatenate([np.broadcast_to(np.eye(3), cross.shape), cross], 2)
    steps = went @ x
    far = int(np.argmax(np.linalg.norm(steps, axis=1)))
    largest = float(np.linalg.norm(steps[far]))
    along = went[far].T @ (steps[far] / max(largest, 1e-12))
    seen = np.linalg.solve(cov, x) @ x
    return Motion(
        about, x[:3], x[3:], np.sqrt(np.diag(cov)[:3]), np.sqrt(np.diag(cov)[3:]), largest,
        float(np.sqrt(along @ cov @ along)), float(chi2_of.sf(seen, 6)), len(y), float((r2 < OUTLIER).mean()),
    )  # fmt: skip


def _slopes(camera: Camera, p: F64) -> F64:
    """Camera pixels (n, 2, 3) that the image of world points (n, 3) moves per mm along each axis."""
    h = 0.05
    return np.stack(
        [(geometry.project(camera, p + h * e) - geometry.project(camera, p - h * e)) / (2 * h) for e in np.eye(3)], -1
    )
