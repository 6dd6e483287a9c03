"""Two scans of one specimen: what was removed or added, where, how surely, and how far a cut ran from its guideline.

Both surfaces become maps of height over one plane; their difference is positive where something was removed. What
unchanged places show, by how steep they are, tells how exact the difference is: it counts only where it exceeds that,
the points' own noise and the error of the registration together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fringescope import heights
from fringescope.compare.cutline import cut_line, sampled
from fringescope.errors import EmptyResultError, RegistrationError
from fringescope.heights import Frame, HeightMap, Layout
from fringescope.settings import CompareSettings
from fringescope.types import F64, AnyArray, Bool

_CLASSES = 10  #: of steepness


@dataclass(frozen=True, eq=False)
class Side:
    """One scan's surface in the frame of the second: xyz (n, 3), unit normals (n, 3), sigma along the ray (n,), mm.

    `on` (n,): which points belong to the specimen; None where no substrate is known, then all are compared.
    """

    xyz: AnyArray
    normals: AnyArray
    sigma: AnyArray
    on: Bool | None = None


@dataclass(frozen=True)
class Region:
    """One connected change. Area as seen along the map's axis; `filled`: share of it that was not seen in one of them.
    """

    removed: bool
    area_mm2: float
    volume_mm3: float
    volume_sigma_mm3: float
    depth_mm: float  #: greatest (median of 3 x 3 cells)
    depth_sigma_mm: float
    middle: tuple[float, float, float]  #: world mm, on the first surface
    width_mm: float  #: of a strip of this shape
    kerf: bool  #: long and narrow: its centre line, not its rim, is where the cut ran
    filled: float


@dataclass(frozen=True, eq=False)
class Change:
    """What differs. Maps (h, w) on `layout` over `frame`: `depth` removed (mm, NaN = not compared), its `sigma` with
    the registration's part, `labels` of the regions from 1 (0 = unchanged).

    `removed` and `added` are volumes of the regions, mm^3; `net` is removed less added over all that was compared,
    regions or not. `least_mm3`: the smallest change of `min_area_mm2` that would have counted.
    """

    frame: Frame
    layout: Layout
    depth: F64
    sigma: F64
    labels: AnyArray
    surface: F64  #: (h, w) height of the first surface, filled
    regions: tuple[Region, ...]
    removed_mm3: float
    removed_sigma_mm3: float
    added_mm3: float
    added_sigma_mm3: float
    net_mm3: float
    net_sigma_mm3: float
    compared_mm2: float
    common: float  #: share of the first surface that was seen again
    noise_mm: float  #: median sigma of the difference
    least_mm3: float
    cut: F64  #: (n, 3) world mm, on the first surface: rims, and centre lines of kerfs, of what was removed
    words: tuple[str, ...]


def compare(
    before: Side, after: Side, frame: Frame, covariance: F64, centre: F64, s: CompareSettings | None = None
) -> Change:
    """The change from one surface to another, both in world mm of the second; heights along the frame's third axis.

    `covariance` (6, 6) of the turn about `centre` (3,) and the shift of the registration (zeros: nothing moved).
    Raises EmptyResultError for a surface without points, RegistrationError where they hardly overlap.
    """
    s = s or CompareSettings()
    a, b = _thinned(before, s, "first"), _thinned(after, s, "second")
    qa, qb = frame.local(a.xyz), frame.local(b.xyz)
    grounded = a.on is not None and b.on is not None
    both = np.concatenate([q if side.on is None else q[side.on] for q, side in ((qa, a), (qb, b))])
    if len(both) < 100:
        raise EmptyResultError(f"{len(both)} points of the specimens to compare; needed 100")
    where = _layout(qa, qb, a, b, both)
    first, second = _maps(a, qa, frame, where), _maps(b, qb, frame, where)
    reach = max(1, round(1.0 / where.cell_mm))
    inside_a, inside_b = (heights.enclosed(m.seen, reach) for m in (first, second))
    if grounded:
        assert b.on is not None
        ground = heights.height_map(frame, where, qb[~b.on], *_noise(b, qb, frame, ~b.on))
        top_a = np.where(inside_a | first.seen, first.height, 0.0)
        top_b = np.where(second.seen, second.height, np.where(inside_b, np.nan, ground.height))
        far = ~inside_a & ~inside_b
        top_b = np.where(far, 0.0, top_b)
        domain = inside_a | inside_b
        sigma = np.hypot(np.nan_to_num(first.sigma), np.nan_to_num(np.where(second.seen, second.sigma, ground.sigma)))
    else:
        top_a, top_b, domain = first.height, second.height, inside_a & inside_b
        sigma = np.hypot(np.nan_to_num(first.sigma), np.nan_to_num(second.sigma))
    seen = np.isfinite(top_a) & np.isfinite(top_b) & domain
    common = float((inside_a & seen).sum() / max(inside_a.sum(), 1))
    if common < s.min_common:
        raise RegistrationError(
            f"only {100 * common:.0f} % of the first surface is seen again in the second; needed "
            f"{100 * s.min_common:.0f} %: place the specimen as before, or scan both with the same cameras"
        )
    (full_a, doubt_a), (full_b, doubt_b) = heights.bridged(top_a), heights.bridged(top_b)
    doubt = np.where(seen, 0.0, np.hypot(doubt_a, doubt_b))
    depth = full_a - full_b
    slope = np.fmax(np.nan_to_num(first.slope), np.nan_to_num(second.slope))
    moved = _registration(frame, where, first, full_a, covariance, centre)
    quiet = seen
    for _ in range(3):  # what is found changed is left out, and the rest says again how exact it is
        local = np.maximum(sigma, _spread(depth, slope, quiet))
        patches = _patch_spread(depth, local, quiet, where, s)
        total = np.sqrt(local**2 + patches**2 + (moved @ covariance * moved).sum(-1))
        loud = (np.abs(depth) > s.sigma * total + s.least_mm).astype(np.uint8)
        loud = cv2.morphologyEx(loud, cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
        rest = seen & (cv2.dilate(loud, np.ones((5, 5), np.uint8)) == 0)
        if rest.sum() < 0.05 * seen.sum() or rest.sum() < 200 or (rest == quiet).all():
            break
        quiet = rest
    ground_at = (full_a, full_b, doubt)
    return _regions(frame, where, depth, total, local, patches, moved, covariance, seen, domain, ground_at, common,
                    grounded, s)  # fmt: skip


def _thinned(side: Side, s: CompareSettings, which: str) -> Side:
    step = -(-len(side.xyz) // s.max_points) if len(side.xyz) else 1
    ok = np.isfinite(side.xyz[::step]).all(1)
    if ok.sum() < 100:
        raise EmptyResultError(f"the {which} surface has {int(ok.sum())} points; needed 100 to compare it")
    on = None if side.on is None else side.on[::step][ok]
    return Side(side.xyz[::step][ok], side.normals[::step][ok], side.sigma[::step][ok], on)


def _layout(qa: F64, qb: F64, a: Side, b: Side, both: F64) -> Layout:
    """Cells that suit the sparser of the two."""
    cells = [heights.layout((q if x.on is None else q[x.on])[:, :2]).cell_mm for q, x in ((qa, a), (qb, b)) if len(q)]
    cell = max(cells)
    low, high = both[:, :2].min(0) - 3 * cell, both[:, :2].max(0) + 3 * cell
    n = np.ceil((high - low) / cell).astype(int) + 1
    return Layout(low, (int(n[1]), int(n[0])), cell)


def _noise(side: Side, q: F64, frame: Frame, keep: AnyArray) -> tuple[F64, F64]:
    """Sigma of heights, and gradients, of some points: an error along a ray moves the height by no more than this."""
    del q
    slopes = heights.gradients(frame, side.normals[keep])
    sigma = np.nan_to_num(np.asarray(side.sigma[keep], dtype=np.float64))
    return sigma * np.sqrt(1 + slopes[:, 0] ** 2 + slopes[:, 1] ** 2), slopes


def _maps(side: Side, q: F64, frame: Frame, where: Layout) -> HeightMap:
    keep = np.ones(len(q), dtype=bool) if side.on is None else side.on
    return heights.height_map(frame, where, q[keep], *_noise(side, q, frame, keep))


def _registration(frame: Frame, where: Layout, first: HeightMap, full: F64, covariance: F64, centre: F64) -> F64:
    """What a turn about `centre` and a shift of the first surface do to its height: (h, w, 6)."""
    if not covariance.any():
        return np.zeros((*where.shape, 6))
    gy, gx = np.gradient(full, where.cell_mm)
    size = np.hypot(gx, gy)
    limit = np.minimum(1.0, heights.STEEPEST / np.maximum(size, 1e-9))
    m = np.stack([-gx * limit, -gy * limit, np.ones_like(gx)], -1) @ frame.axes  # a shift v changes the height by m . v
    x, y = where.places()
    p = frame.world(np.stack([x, y, full], -1)) - centre
    del first
    return np.concatenate([np.cross(p, m), m], axis=-1)


def _spread(depth: F64, slope: F64, seen: Bool) -> F64:
    """Standard deviation of the difference of unchanged cells, by how steep they are: (h, w).

    From the 40 % of the smallest differences of each class of steepness, so that nearly half may have changed.
    """
    d, g = np.abs(depth[seen]), slope[seen]
    if len(d) < 50:
        return np.zeros_like(depth)
    edges = np.quantile(g, np.linspace(0, 1, _CLASSES + 1))
    at = np.clip(np.searchsorted(edges, g, side="right") - 1, 0, _CLASSES - 1)
    middle, spread = [], []
    for k in range(_CLASSES):
        mine = at == k
        if mine.sum() >= 20:
            middle.append(float(np.median(g[mine])))
            spread.append(float(np.quantile(d[mine], 0.4)) / 0.5244)
    order = np.argsort(middle)
    return np.interp(slope, np.asarray(middle)[order], np.maximum.accumulate(np.asarray(spread)[order]))


def _patch_spread(depth: F64, local: F64, seen: Bool, where: Layout, s: CompareSettings) -> float:
    """By how much the mean difference of whole unchanged patches scatters beyond their cells' noise, mm."""
    quiet = seen & (np.abs(depth) < 3 * local + 0.5 * s.least_mm)
    n = max(2, round(s.patch_mm / where.cell_mm))
    h, w = (k // n * n for k in depth.shape)
    if min(h, w) < n:
        return 0.0

    def sums(v: AnyArray) -> F64:
        return np.asarray(v[:h, :w].reshape(h // n, n, w // n, n).sum((1, 3)))

    count = sums(quiet.astype(np.float64))
    used = count > 0.4 * n * n
    if used.sum() < 4:
        return 0.0
    mean = sums(np.where(quiet, depth, 0.0))[used] / count[used]
    own = sums(np.where(quiet, local**2, 0.0))[used] / count[used] ** 2
    seen_spread = 1.4826 * float(np.median(np.abs(mean)))
    return math.sqrt(max(seen_spread**2 - float(np.median(own)), 0.0))


# ------------------------------------------------------------------------------------------------------------- regions


def _regions(
    frame: Frame, where: Layout, depth: F64, total: F64, local: F64, patches: float, moved: F64, covariance: F64,
    seen: Bool, domain: Bool, tops: tuple[F64, F64, F64], common: float, grounded: bool, s: CompareSettings,
) -> Change:  # fmt: skip
    full_a = tops[0]
    smooth = np.asarray(cv2.medianBlur(depth.astype(np.float32), 3), dtype=np.float64)
    limit = s.sigma * total + s.least_mm
    known = domain & (np.abs(smooth) < s.max_depth_mm)
    near_seen = np.asarray(cv2.blur(seen.astype(np.float64), (3, 3)) > 0.3)
    labels = np.zeros(where.shape, np.int32)
    regions: list[Region] = []
    cuts: list[F64] = []
    margin = max(1, round(s.margin_mm / where.cell_mm))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    found = []
    for sign in (1, -1):
        strong = known & (sign * smooth > limit)
        n, pieces, area = heights.pieces(strong)
        for k in range(1, n + 1):
            mine = pieces == k if area[k] * where.area_mm2 >= s.min_area_mm2 else None
            if mine is not None and (mine & seen).sum() >= 0.3 * area[k] and (mine & near_seen).any():
                found.append((sign, mine))
    core = np.zeros(where.shape, dtype=bool)
    for _, mine in found:
        core |= mine
    error = []
    for sign, mine in sorted(found, key=lambda f: -float(np.abs(depth[f[1]]).sum())):
        grown = np.asarray(cv2.dilate(mine.astype(np.uint8), disc) > 0) & known & (labels == 0) & (mine | ~core)
        region, part = _region(
            sign, mine, grown, frame, where, depth, smooth, total, local, patches, moved, seen, tops, s
        )
        labels[grown] = len(regions) + 1
        regions.append(region)
        error.append(part)
        if region.removed:
            width = region.width_mm if region.kerf else None
            cuts.append(cut_line(width, mine, frame, where, smooth, limit, full_a, domain, grounded))
    independent = np.array([e[0] for e in error])
    together = np.array([e[1] for e in error]).reshape(-1, 6)

    def total_of(removed: bool) -> tuple[float, float]:
        which = [k for k, r in enumerate(regions) if r.removed is removed]
        g = together[which].sum(0)
        variance = float((independent[which] ** 2).sum()) + max(float(g @ covariance @ g), 0.0)
        return sum(regions[k].volume_mm3 for k in which), math.sqrt(variance)

    everywhere = known & (seen | (labels > 0))
    compared = float(everywhere.sum()) * where.area_mm2
    net = float(depth[everywhere].sum()) * where.area_mm2
    net_sigma = _volume_sigma(everywhere, where, local, patches, moved, covariance, compared, s)
    net_sigma = math.hypot(net_sigma, float(independent @ independent) ** 0.5)
    removed, added = total_of(True), total_of(False)
    noise = float(np.median(total[everywhere])) if everywhere.any() else math.nan
    least = s.min_area_mm2 * float(np.median(limit[everywhere])) if everywhere.any() else math.nan
    if not any(r.removed for r in regions):
        removed = (0.0, net_sigma)
    if all(r.removed for r in regions):
        added = (0.0, net_sigma)
    cut = np.concatenate(cuts) if cuts else np.zeros((0, 3))
    out = Change(
        frame, where, np.where(known, depth, np.nan), total, labels, full_a, tuple(regions), *removed, *added, net,
        net_sigma, compared, common, noise, least, cut, (),
    )  # fmt: skip
    return Change(**{**vars(out), "words": _words(out)})


def _volume_sigma(
    cells: Bool, where: Layout, local: F64, patches: float, moved: F64, covariance: F64, area: float, s: CompareSettings
) -> float:
    """Of the volume over some cells: their noise, what whole patches scatter, and the registration."""
    a = where.area_mm2
    own = a**2 * float((local[cells] ** 2).sum())
    together = patches**2 * area * max(min(s.patch_mm**2, area), a)
    g = a * moved[cells].sum(0)
    return math.sqrt(own + together + max(float(g @ covariance @ g), 0.0))


def _region(
    sign: int, core: Bool, grown: Bool, frame: Frame, where: Layout, depth: F64, smooth: F64, total: F64, local: F64,
    patches: float, moved: F64, seen: Bool, tops: tuple[F64, F64, F64], s: CompareSettings,
) -> tuple[Region, tuple[float, F64]]:  # fmt: skip
    """A region's figures, and its error: the part that is its own, and what it shares through the registration."""
    a = where.area_mm2
    area = float(core.sum()) * a
    volume = sign * float(depth[grown].sum()) * a
    unseen = grown & ~seen
    holes = a * float(tops[2][grown].sum())  # what hides, hides alike: these add up
    rim = core & ~np.asarray(cv2.erode(core.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    walls = 0.3 * a * math.sqrt(float((smooth[rim] ** 2).sum()))  # cells that straddle a wall
    nothing = np.zeros((6, 6))
    own = _volume_sigma(grown, where, local, patches, moved, nothing, float(grown.sum()) * a, s)
    peak = np.where(core, sign * smooth, -np.inf)
    at = np.unravel_index(int(np.argmax(peak)), peak.shape)
    x, y = where.places()
    weight = np.where(core, np.abs(depth), 0.0)
    mx, my = float((x * weight).sum() / weight.sum()), float((y * weight).sum() / weight.sum())
    mz = float((tops[0] * weight).sum() / weight.sum())
    inner = cv2.distanceTransform(np.pad(core.astype(np.uint8), 1), cv2.DIST_L2, 5)[1:-1, 1:-1]
    width = max((4 * float(inner[core].mean()) - 1) * where.cell_mm, where.cell_mm)
    kerf = sign > 0 and width < s.kerf_mm and area / width > 4 * width
    middle = frame.world(np.array([mx, my, mz]))
    g = sign * a * moved[grown].sum(0)
    region = Region(
        sign > 0, area, volume, 0.0, float(peak[at]), float(total[at]),
        (float(middle[0]), float(middle[1]), float(middle[2])), width, kerf, float(unseen.sum() / grown.sum()),
    )  # fmt: skip
    alone = math.sqrt(own**2 + holes**2 + walls**2)
    return Region(**{**vars(region), "volume_sigma_mm3": alone}), (alone, g)


def depth_at(c: Change, points: AnyArray) -> tuple[F64, AnyArray]:
    """Depth removed (n,) mm at world points (n, 3), NaN outside the map; and their region, 0 = unchanged."""
    xy = c.frame.local(points)[:, :2]
    at = c.layout.cells(np.where(np.isfinite(xy), xy, 1e9))
    known = (at >= 0) & np.isfinite(c.depth).ravel()[at]
    depth = np.full(len(xy), np.nan)
    depth[known] = sampled(np.nan_to_num(c.depth), c.layout, xy[known])
    return depth, np.where(at >= 0, c.labels.ravel()[at], 0)


def _words(c: Change) -> tuple[str, ...]:
    """The verdict for people."""
    if not c.regions:
        return (
            f"nothing changed: no place of the {c.compared_mm2:.0f} mm^2 compared differs by more than noise and "
            f"registration explain (net {c.net_mm3:.1f} +- {c.net_sigma_mm3:.1f} mm^3)",
        )
    out = []
    for what, volume, sigma, which in (
        ("removed", c.removed_mm3, c.removed_sigma_mm3, [r for r in c.regions if r.removed]),
        ("added", c.added_mm3, c.added_sigma_mm3, [r for r in c.regions if not r.removed]),
    ):
        if which:
            places = f"{len(which)} places" if len(which) > 1 else "one place"
            deepest = max(r.depth_mm for r in which)
            area = sum(r.area_mm2 for r in which)
            out.append(
                f"{what}: {volume:.1f} +- {sigma:.1f} mm^3 in {places}, {area:.0f} mm^2, at most {deepest:.2f} mm"
            )
    hidden = max(r.filled for r in c.regions)
    if hidden > 0.1:
        out.append(f"up to {100 * hidden:.0f} % of a changed place was not seen and is interpolated")
    if c.common < 0.9:
        out.append(f"{100 * (1 - c.common):.0f} % of the first surface was not seen again")
    return tuple(out)


def figures(c: Change) -> dict[str, Any]:
    """What compare.json says of a change."""
    return {
        "words": list(c.words),
        "removed_mm3": c.removed_mm3,
        "removed_sigma_mm3": c.removed_sigma_mm3,
        "added_mm3": c.added_mm3,
        "added_sigma_mm3": c.added_sigma_mm3,
        "net_mm3": c.net_mm3,
        "net_sigma_mm3": c.net_sigma_mm3,
        "least_mm3": c.least_mm3,
        "compared_mm2": c.compared_mm2,
        "common": c.common,
        "noise_um": 1e3 * c.noise_mm,
        "regions": [dict(vars(r)) for r in c.regions],
        "map": {
            "origin": c.frame.world(np.array([*c.layout.low, 0.0])).tolist(),
            "x": c.frame.axes[0].tolist(),
            "y": c.frame.axes[1].tolist(),
            "up": c.frame.axes[2].tolist(),
            "cell_mm": c.layout.cell_mm,
            "size": list(c.layout.shape[::-1]),
        },
    }
