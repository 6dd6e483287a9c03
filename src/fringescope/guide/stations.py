"""Places of the projected lines at which they are looked for: where nothing else is that could be taken for them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np

from fringescope import geometry
from fringescope.guide import fills
from fringescope.guide.inside import window
from fringescope.guide.tissue import Tissue
from fringescope.guide.trace import visible_runs
from fringescope.settings import LoopSettings
from fringescope.types import F64, Fill, Guidance, Guided, Projector, StrokeKind

END_MM = 0.2  #: a station's piece of line ends so far before the line does
SHORT = 0.5  #: pieces that are looked at where the whole ones are not straight, or too long; of the whole
BOW_MM = 0.06  #: a line may differ so much from the parabola through the ends and the middle of a piece
BESIDE_MM = 0.2  #: so much of the ground before another line is left out
GROUND_MM = 0.25  #: so much of the ground to each side must be left
STEEPEST = 0.2  #: least cosine between the projector's light and the surface's normal


@dataclass(frozen=True, eq=False)
class Lights:
    """All that is lit: m places on the projector's plane, half the width of the light there, units, the number of the
    piece of line that they belong to, and how far along it they lie, mm.
    """

    uv: F64
    half: F64
    piece: Any
    gone: F64


@dataclass(frozen=True, eq=False)
class Stations:
    """Places of a stroke at which it is looked for: on the tissue, along it, across it, and up.

    On the projector's plane: `uv`, the unit direction `ahead` of the line (n, 2), its bend (units across for one unit
    along, squared), half its width, and units for a mm along and across. `reach` mm: half the piece of line that is
    looked at, 0 where it cannot be judged. From `low` to `high`, mm across, nothing else is lit; `search` mm: how far
    aside the line is looked for.
    """

    place: F64
    along: F64
    across: F64
    normal: F64
    uv: F64
    ahead: F64
    bend: F64
    half: F64
    pace: F64
    per_mm: F64
    reach: F64
    low: F64
    high: F64
    search: F64

    def of(self, look: Any) -> Stations:
        """Some of them."""
        return Stations(*(getattr(self, f.name)[look] for f in dataclasses.fields(self)))

    def beside(self, uv: F64) -> tuple[F64, F64]:
        """How far places of the plane (n, m, 2) lie across the line and along it, as mm at the stations (n, m)."""
        d = uv - self.uv[:, None]
        a = (d * self.ahead[:, None]).sum(2)
        b = d[..., 1] * self.ahead[:, :1] - d[..., 0] * self.ahead[:, 1:] - self.bend[:, None] * a**2
        return b / self.per_mm[:, None], a / self.pace[:, None]


def lights(guidance: Guidance, tissue: Tissue) -> list[Lights]:
    """All that is lit, by stroke."""
    out = []
    count = 0
    for g in guidance.strokes:
        rows = []
        for t in g.traces:
            for a, b in visible_runs(t):
                rows.append((t.uv[a:b], t.half[a:b], np.full(b - a, count), _gone(t.xyz[a:b])))
                count += 1
        more = [*_letters(g), *_filled(g, tissue.rig.projector)]
        if more:
            uv = np.concatenate(more)
            rows.append((uv, np.full(len(uv), 1.0), np.full(len(uv), -1), np.zeros(len(uv))))
        rows.append((np.zeros((0, 2)), np.zeros(0), np.zeros(0, int), np.zeros(0)))
        out.append(Lights(*(np.concatenate(c) for c in zip(*rows, strict=True))))
    return out


def _letters(g: Guided) -> list[F64]:
    return list(g.segments) if g.stroke.kind is StrokeKind.TEXT else []


def _filled(g: Guided, projector: Projector) -> list[F64]:
    """Every second unit of what a solid stroke may fill."""
    if g.stroke.fill is not Fill.SOLID or not g.traces:
        return []
    ring = g.traces[0].uv[np.isfinite(g.traces[0].uv).all(1)]
    if len(ring) < 3:
        return []
    low, size = window(ring, projector)
    v, u = np.nonzero(fills.inside([ring], low, size)[::2, ::2])
    return [np.stack([2 * u, 2 * v], 1) + low]


def _gone(p: F64) -> F64:
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])


def of_stroke(g: Guided, number: int, every: list[Lights], tissue: Tissue, s: LoopSettings) -> Stations:
    """Stations every `station_mm` along the visible pieces of a stroke, the `number`th of those that are lit."""
    parts: list[Stations] = []
    pieces: list[Any] = []
    gones: list[F64] = []
    first = int(every[number].piece[every[number].piece >= 0].min(initial=np.iinfo(np.int32).max))
    for t in g.traces:
        for a, b in visible_runs(t):
            at, made = _along(t.xyz[a:b], t.uv[a:b], t.normal[a:b], t.half[a:b], tissue.rig.projector, s)
            parts.append(made)
            gones.append(at)
            pieces.append(np.full(len(at), first))
            first += 1
    if not parts:
        return Stations(*(np.zeros((0, 3)),) * 4, *(np.zeros((0, 2)),) * 2, *(np.zeros(0),) * 8)
    names = [f.name for f in dataclasses.fields(Stations)]
    st = Stations(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))
    return _alone(st, np.concatenate(pieces), np.concatenate(gones), every, s)


def _along(xyz: F64, uv: F64, normal: F64, half: F64, projector: Projector, s: LoopSettings) -> tuple[F64, Stations]:
    """How far along a piece of line its stations lie (n,), mm, and the stations."""
    gone = _gone(xyz)
    n = max(1, round(gone[-1] / s.station_mm))
    at = gone[-1] * (np.arange(n) + 0.5) / n
    i = np.clip(np.searchsorted(gone, at), 1, len(xyz) - 1)

    def when(d: float, of: F64) -> F64:
        return np.stack([np.interp(at + d, gone, of[:, k]) for k in range(of.shape[1])], 1)

    reach = np.zeros(n)
    bend = np.zeros(n)
    place, middle = when(0.0, xyz), when(0.0, uv)
    ahead, pace = np.tile([1.0, 0.0], (n, 1)), np.ones(n)
    for share in (1.0, SHORT):
        r = share * s.along_mm
        ends = when(r, uv), when(-r, uv)
        d = ends[0] - ends[1]
        length = np.maximum(np.linalg.norm(d, axis=1), 1e-9)
        dir_ = d / length[:, None]
        clear = (at > r + END_MM) & (at < gone[-1] - r - END_MM)

        def off(p: F64, dir_: F64 = dir_) -> tuple[F64, F64]:
            e = p - middle
            return e[:, 1] * dir_[:, 0] - e[:, 0] * dir_[:, 1], (e * dir_).sum(1)

        (b0, a0), (b1, a1) = off(ends[0]), off(ends[1])
        bow = (b0 + b1) / np.maximum(a0**2 + a1**2, 1e-9)
        worst = np.zeros(n)
        for part in np.linspace(-1, 1, 11):
            b, a = off(when(part * (r + END_MM), uv))
            worst = np.maximum(worst, np.abs(b - bow * a**2))
        ok = clear & (reach == 0) & (worst <= BOW_MM * length / (2 * r))
        reach[ok], bend[ok], ahead[ok], pace[ok] = r, bow[ok], dir_[ok], length[ok] / (2 * r)
    chord = when(0.5 * s.along_mm, xyz) - when(-0.5 * s.along_mm, xyz)
    along = chord / np.maximum(np.linalg.norm(chord, axis=1, keepdims=True), 1e-9)
    across = np.cross(normal[i], along)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    h = 0.05
    side = (geometry.project(projector, place + h * across) - geometry.project(projector, place - h * across)) / (2 * h)
    per = side[:, 1] * ahead[:, 0] - side[:, 0] * ahead[:, 1]
    up = np.cross(along, across)
    across, per = across * np.sign(per)[:, None], np.abs(per)
    to_light = geometry.centre(projector.pose) - place
    facing = np.abs((normal[i] * to_light).sum(1)) / np.linalg.norm(to_light, axis=1)
    reach[~(facing >= STEEPEST) | ~np.isfinite(per) | (per < 1e-3)] = 0.0
    per = np.where(np.isfinite(per) & (per >= 1e-3), per, 1.0)
    width = np.interp(at, gone, half)
    wide = width / per + s.search_mm
    return at, Stations(
        place, along, across, up, middle, ahead, bend, width, pace, per, reach, -wide, wide, np.full(n, s.search_mm)
    )


def _alone(st: Stations, piece: Any, gone: F64, every: list[Lights], s: LoopSettings) -> Stations:
    """Stations with what lies beside them left out, and those that nothing is left of not to be judged."""
    from scipy.spatial import cKDTree

    uv, half, owner, far = (np.concatenate([getattr(x, f.name) for x in every]) for f in dataclasses.fields(Lights))
    if not len(uv):
        return st
    tree = cKDTree(uv)
    wide = st.half + s.search_mm * st.per_mm + float(half.max())
    near = tree.query_ball_point(st.uv, np.hypot(wide, (s.along_mm + END_MM) * st.pace))
    low, high, reach, search = (a.copy() for a in (st.low, st.high, st.reach, st.search))
    for i in np.flatnonzero(st.reach > 0):
        k = np.asarray(near[i], np.intp)
        own = 1.5 * (st.reach[i] + st.half[i] / st.per_mm[i] + BESIDE_MM)
        k = k[(owner[k] != piece[i]) | (np.abs(far[k] - gone[i]) > own)]
        if not len(k):
            continue
        x, a = (c[0] for c in st.of([i]).beside(uv[k][None]))
        k, x = (c[np.abs(a) <= st.reach[i] + half[k] / st.pace[i] + BESIDE_MM] for c in (k, x))
        edge = half[k] / st.per_mm[i]
        low[i] = max(low[i], float((x + edge)[x < 0].max(initial=-np.inf)) + BESIDE_MM)
        high[i] = min(high[i], float((x - edge)[x >= 0].min(initial=np.inf)) - BESIDE_MM)
        room = min(high[i], -low[i]) - st.half[i] / st.per_mm[i]
        search[i] = min(search[i], room)
        if room < GROUND_MM:
            reach[i] = 0.0
    return dataclasses.replace(st, low=low, high=high, reach=reach, search=search)
