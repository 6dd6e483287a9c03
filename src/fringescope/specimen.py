"""The specimen told from its substrate, and its length, width, height, area and volume.

The substrate is the plane that has nothing below it: found by trying planes through the lowest places, proved by the
sharp peak that a plane leaves among the distances from it. What stands above it, connected, is specimen. Where no such
plane is to be seen nothing is measured, and it is said why.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fringescope import heights
from fringescope.heights import Frame, HeightMap
from fringescope.settings import SpecimenSettings
from fringescope.types import F64, AnyArray, Bool, Grid

PATCH_MM = 6.0  #: errors of the substrate farther apart than this are independent
_TRIALS, _TEST = 700, 5000
_PLANE = 12_000  #: points that the plane is fitted to


@dataclass(frozen=True, eq=False)
class Substrate:
    """The plane under the specimen: its frame (heights are along its third axis) and how well it is known."""

    frame: Frame
    covariance: F64  #: (3, 3) of height, slope along x, slope along y, at the frame's origin; mm, 1
    rms_mm: float  #: of the points that lie on it
    share: float  #: of the points that lie on it


@dataclass(frozen=True)
class Piece:
    """One connected specimen. Lengths in mm, areas mm^2, volume mm^3, each with its standard deviation.

    `length` and `width` are the sides of the smallest rectangle around the footprint; `height` is the highest place
    (the median of 3 x 3 cells); `surface` is the area of the surface above the substrate, `footprint` that below it;
    `volume` is that between surface and substrate, overhangs counted as solid. `filled`: share of the footprint that
    was not seen, where heights are interpolated. `cut_off`: share of the outline at which the measured field ends.
    """

    length_mm: float
    length_sigma_mm: float
    width_mm: float
    width_sigma_mm: float
    height_mm: float
    height_sigma_mm: float
    footprint_mm2: float
    footprint_sigma_mm2: float
    surface_mm2: float
    surface_sigma_mm2: float
    volume_mm3: float
    volume_sigma_mm3: float
    filled: float
    cut_off: float
    middle: tuple[float, float, float]  #: of the footprint, world mm, on the substrate


@dataclass(frozen=True, eq=False)
class Found:
    """What lies under the instrument: `pieces`, the largest first; none where `why` says that they cannot be told.

    `footprint` (h, w) numbers the pieces from 1 on the cells of `heights`.
    """

    pieces: tuple[Piece, ...]
    why: str
    substrate: Substrate | None = None
    heights: HeightMap | None = None
    footprint: AnyArray | None = None
    low_mm: float = 0.0  #: what lies higher than this above the substrate is specimen


def find(xyz: AnyArray, normals: AnyArray, sigma: AnyArray, up: AnyArray, s: SpecimenSettings | None = None) -> Found:
    """The specimen among points (n, 3) with unit normals (n, 3) and sigma (n,), mm; `up` (3,) points to the projector.

    At most `max_points` of them are looked at. Never raises for what it sees: `Found.why` says what is missing.
    """
    s = s or SpecimenSettings()
    stride = -(-len(xyz) // s.max_points) if len(xyz) else 1
    p, n, e = (np.asarray(a[::stride], dtype=np.float32) for a in (xyz, normals, sigma))
    ok = np.isfinite(p[:, 0]) & np.isfinite(p[:, 1]) & np.isfinite(p[:, 2])
    if not ok.all():
        p, n, e = p[ok], n[ok], e[ok]
    if len(p) < 200:
        return Found((), f"only {len(p)} points; needed 200 to tell a specimen from its substrate")
    known = np.isfinite(e)
    if not known.all():
        e = np.where(known, e, np.median(e[known]) if known.any() else np.float32(0.0))
    few = slice(None, None, max(1, len(p) // _PLANE))
    plane, why = substrate(p[few].astype(np.float64), e[few].astype(np.float64), np.asarray(up, dtype=np.float64), s)
    if plane is None:
        return Found((), why)
    q = plane.frame.local(p)
    where = heights.layout(q[:, :2], s.least_cell_mm)
    slopes = heights.gradients(plane.frame, n)
    up_sigma = np.asarray(e * np.sqrt(1 + slopes[:, 0] ** 2 + slopes[:, 1] ** 2), dtype=np.float64)
    hm = heights.height_map(plane.frame, where, q, up_sigma, slopes)
    return _measured(plane, hm, s)


# ----------------------------------------------------------------------------------------------------------- substrate


def substrate(p: F64, sigma: F64, up: F64, s: SpecimenSettings) -> tuple[Substrate | None, str]:
    """The plane under everything, or None and why there is none to be seen. Points (n, 3), sigma (n,), mm."""
    view = heights.frame_at(np.median(p, axis=0), up)
    q = view.local(p)
    field = np.percentile(q[:, :2], 99.5, axis=0) - np.percentile(q[:, :2], 0.5, axis=0)
    if field.min() <= 0:
        return None, "the points lie on a line; needed a surface"
    noise = float(np.median(sigma))
    tolerance = max(2 * s.flat_mm, 4 * noise)
    test = q[:: max(1, len(q) // _TEST)]
    lows = _lowest(q, field)
    plane = _best_plane(lows, test, tolerance, s)
    if plane is None:
        return None, "no substrate is to be seen: no plane has nothing below it"
    for _ in range(6):
        d = q[:, 2] - q[:, :2] @ plane[:2] - plane[2]
        on = np.abs(d) < tolerance
        if on.sum() < 100:
            return None, "no substrate is to be seen: no plane has nothing below it"
        A = np.column_stack([q[on, :2], np.ones(on.sum())])
        plane = np.linalg.solve(A.T @ A, A.T @ q[on, 2])
        spread = 1.4826 * float(np.median(np.abs(q[on, 2] - A @ plane)))
        tolerance = max(s.flat_mm, 4 * noise, 4 * spread) if spread < tolerance / 3 else tolerance
    d = (q[:, 2] - q[:, :2] @ plane[:2] - plane[2]) / math.sqrt(1 + float(plane[:2] @ plane[:2]))
    on = np.abs(d) < tolerance
    share, below = float(on.mean()), float((d < -2 * tolerance).mean())
    just_above = float(((d > tolerance) & (d < 3 * tolerance)).mean())
    spans = np.percentile(q[on, :2], 97, axis=0) - np.percentile(q[on, :2], 3, axis=0)
    if share < s.min_substrate or (spans < s.min_span * field).any():
        return None, (
            f"no substrate is to be seen: the lowest plane holds {100 * share:.1f} % of the points, needed "
            f"{100 * s.min_substrate:.0f} % spread over the field"
        )
    if below > s.max_below or share < s.peak * just_above:
        return None, "no substrate is to be seen: the lowest surface is not flat"
    normal = view.axes.T @ np.array([-plane[0], -plane[1], 1.0])
    middle = q[on, :2].mean(axis=0)
    frame = heights.frame_at(view.world(np.array([*middle, middle @ plane[:2] + plane[2]])), normal)
    on_plane = frame.local(p[on])
    rms = float(np.sqrt(np.mean(on_plane[:, 2] ** 2)))
    return Substrate(frame, _plane_covariance(on_plane), rms, share), ""


def _lowest(q: F64, field: F64) -> F64:
    """The place (n, 3) of every cell of a coarse net that has hardly anything below it."""
    size = float(field.max()) / 36
    low = q[:, :2].min(0)
    at = np.floor((q[:, :2] - low) / size).astype(np.int64)
    key = at[:, 1] * (int(at[:, 0].max()) + 1) + at[:, 0]
    order = np.lexsort((q[:, 2], key))
    key = key[order]
    first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]])
    count = np.diff(np.r_[first, len(key)])
    enough = count >= min(5, int(np.median(count)))
    return np.asarray(q[order[(first + count // 10)[enough]]])


def _best_plane(lows: F64, test: F64, tolerance: float, s: SpecimenSettings) -> F64 | None:
    """z = a x + b y + c through three of the lowest places that has most points near it and hardly one below it."""
    if len(lows) < 6:
        return None
    rng = np.random.default_rng(len(lows))
    trio = lows[rng.integers(0, len(lows), (_TRIALS, 3))]
    u, v = trio[:, 1] - trio[:, 0], trio[:, 2] - trio[:, 0]
    n = np.cross(u, v)
    n *= np.where(n[:, 2:] < 0, -1.0, 1.0)
    size = np.linalg.norm(n, axis=1)
    ok = (n[:, 2] > math.cos(math.radians(s.max_tilt_deg)) * size) & (size > 1e-9)
    if not ok.any():
        return None
    n, base = n[ok], trio[ok, 0]
    slopes = -n[:, :2] / n[:, 2:]
    planes = np.column_stack([slopes, base[:, 2] - (slopes * base[:, :2]).sum(1)])
    ones = np.column_stack([lows[:, :2], np.ones(len(lows))])
    d = lows[:, 2] - planes @ ones.T
    wide = 2 * tolerance
    good = (np.abs(d) < wide).sum(1) - 3 * np.maximum((d < -wide).sum(1) - 2 * s.max_below * len(lows), 0)
    planes = planes[np.argsort(-good)[:24]]
    ones = np.column_stack([test[:, :2], np.ones(len(test))])
    d = test[:, 2] - planes @ ones.T
    near, below = (np.abs(d) < wide).mean(1), (d < -wide).mean(1)
    near = np.where(below <= max(2 * s.max_below, 0.02), near, 0.0)
    best = int(near.argmax())
    return np.asarray(planes[best]) if near[best] > 0.5 * s.min_substrate else None


def _plane_covariance(q: F64) -> F64:
    """Of height and slopes of a plane fitted to points (n, 3) near it: neighbours err together, patches do not."""
    at = np.floor(q[:, :2] / PATCH_MM).astype(np.int64)
    at -= at.min(0)
    key = at[:, 1] * (int(at[:, 0].max()) + 1) + at[:, 0]
    count = np.bincount(key)
    used = count > 0.2 * float(np.median(count[count > 0]))
    x, y, z = (np.bincount(key, q[:, k])[used] / count[used] for k in range(3))
    A = np.column_stack([np.ones(len(x)), x, y])
    if len(x) < 6:
        return np.asarray(np.diag([float(np.mean(z**2)) + 1e-8, 1e-4, 1e-4]))
    inverse = np.linalg.pinv(A.T @ A)
    r = z - A @ (inverse @ (A.T @ z))
    return np.asarray(inverse @ ((A * (r**2)[:, None]).T @ A) @ inverse * len(x) / (len(x) - 3))


# ------------------------------------------------------------------------------------------------------------- figures


def _measured(plane: Substrate, hm: HeightMap, s: SpecimenSettings) -> Found:
    where, cell = hm.layout, hm.layout.cell_mm
    field = heights.enclosed(hm.seen, max(1, round(s.hole_mm / cell / 2)))
    full, doubt = heights.bridged(hm.height)
    flat = np.abs(hm.height) < max(s.flat_mm, 4 * plane.rms_mm)
    spread = 1.4826 * float(np.median(np.abs(hm.height[flat]))) if flat.any() else plane.rms_mm
    low = max(s.low_mm, 6 * spread)
    above = field & (full > low)
    kernel = np.ones((3, 3), np.uint8)
    above = np.asarray(cv2.morphologyEx(above.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0) & above
    _, labels, area = heights.pieces(above)
    top = np.zeros(len(area))
    np.maximum.at(top, labels[hm.seen], hm.height[hm.seen])
    least = max(s.min_area_mm2 / where.area_mm2, 9)
    kept = [k for k in np.argsort(-area, kind="stable") if k != 0 and area[k] >= least and top[k] >= s.high_mm]
    number = np.zeros(len(area), np.int32)
    number[kept] = np.arange(1, len(kept) + 1)
    footprint = number[labels]
    if not kept:
        why = f"nothing lies on the substrate: no place of {s.min_area_mm2:g} mm^2 is {s.high_mm:g} mm above it"
        return Found((), why, plane, hm, footprint, low)
    pieces = tuple(_piece(plane, hm, (full, doubt), footprint == k + 1, field, low) for k in range(len(kept)))
    return Found(pieces, "", plane, hm, footprint, low)


def _piece(plane: Substrate, hm: HeightMap, tops: tuple[F64, F64], mask: Bool, field: Bool, low: float) -> Piece:
    where, a, cell = hm.layout, hm.layout.area_mm2, hm.layout.cell_mm
    full, doubt = tops
    mask = np.asarray(cv2.morphologyEx(_without_holes(mask).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((3, 3)))) > 0
    h = np.where(mask, np.maximum(full, 0), 0.0)
    unseen = mask & ~hm.seen
    rim = heights.outline(where, full, mask, low, steep=-0.25)  # of cells that straddle a wall the outermost ones count
    (_, (side_a, side_b), _) = cv2.minAreaRect(rim.astype(np.float32))
    edge = mask & ~np.asarray(cv2.erode(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
    perimeter = cell * 0.8 * len(rim)
    area = float(mask.sum()) * a
    foot = max(area - float((mask & (full > 2 * low)).sum()) * a, 0.0)  # between low and twice as high: as much below
    foot = min(foot, 0.25 * area)
    beyond = np.asarray(cv2.erode(field.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0)
    x, y = where.places()
    g = a * np.array([mask.sum(), x[mask].sum(), y[mask].sum()])
    holes = a * float(doubt[mask].sum())  # what hides, hides alike: these add up
    random = a * math.sqrt(float((hm.sigma[mask & hm.seen] ** 2).sum()))
    walls = 0.25 * a * float(h[edge].sum())  # which way a cell on the border falls depends on its flank
    tilt = math.sqrt(max(float(g @ plane.covariance @ g), 0.0))
    volume = float(h.sum()) * a + foot * low / 2
    volume_sigma = math.sqrt(random**2 + walls**2 + tilt**2 + holes**2 + (foot * low / 2) ** 2)
    on_edge = 0.3 * a * math.sqrt(max(float(edge.sum()), 1.0))
    hidden = float((unseen & edge).sum()) * a
    blur = 0.25 * cell * perimeter
    area_sigma = math.sqrt(on_edge**2 + (foot / 2) ** 2 + hidden**2 + blur**2)
    side_sigma = math.hypot(0.5 * cell, foot / max(perimeter, cell))
    top, peak, at = _top(hm, mask)
    here = np.array([1.0, x[at], y[at]])
    noise = math.hypot(float(np.nan_to_num(hm.sigma[at])), 0.5 * cell * float(np.nan_to_num(hm.slope[at])))
    top_sigma = math.sqrt(noise**2 + peak**2 + max(float(here @ plane.covariance @ here), 0.0))
    surface = heights.surface_area(where, full, mask) + foot
    slope_noise = heights.surface_area(where, full, unseen) * 0.1
    middle = plane.frame.world(np.array([x[mask].mean(), y[mask].mean(), 0.0]))
    return Piece(
        max(side_a, side_b), side_sigma, min(side_a, side_b), side_sigma, top, top_sigma, area + foot, area_sigma,
        surface, math.hypot(area_sigma * surface / max(area, a), slope_noise), volume, volume_sigma,
        float(unseen.sum() / mask.sum()), float((edge & beyond).sum() / max(edge.sum(), 1)),
        (float(middle[0]), float(middle[1]), float(middle[2])),
    )  # fmt: skip


def _without_holes(mask: Bool) -> Bool:
    """Places wholly surrounded by specimen belong to it."""
    padded = np.pad(mask.astype(np.uint8), 1)
    cv2.floodFill(padded, None, (0, 0), 2)
    return np.asarray(padded[1:-1, 1:-1] != 2)


def _top(hm: HeightMap, mask: Bool) -> tuple[float, float, tuple[int, int]]:
    """The highest place that three of 3 x 3 cells reach, what the highest one has more, and where."""
    z = np.where(mask & hm.seen, hm.height, 0.0)
    i, j = np.unravel_index(int(np.argmax(_third(z))), z.shape)
    around = np.sort(z[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2], axis=None)
    return float(around[-3]), float(around[-1] - around[-3]), (int(i), int(j))


def _third(z: F64) -> F64:
    """The third highest of 3 x 3 cells, where it can matter: among those within reach of the highest ones."""
    out = np.zeros_like(z)
    near = cv2.dilate((z >= np.partition(z, -min(400, z.size), axis=None)[-min(400, z.size)]).astype(np.uint8),
                      np.ones((3, 3), np.uint8))  # fmt: skip
    for i, j in np.argwhere(near[1:-1, 1:-1]) + 1:
        out[i, j] = np.partition(z[i - 1 : i + 2, j - 1 : j + 2].ravel(), -3)[-3]
    return out


# -------------------------------------------------------------------------------------------------------------- labels


def on_specimen(found: Found, points: AnyArray, sigma: AnyArray | None = None, k: float = 4.0) -> Bool:
    """Which points (..., 3) belong to a piece: above the substrate by more than noise, within a footprint."""
    shape = np.shape(points)[:-1]
    if found.footprint is None or found.heights is None or found.substrate is None or not found.pieces:
        return np.zeros(shape, dtype=bool)
    q = found.substrate.frame.local(np.asarray(points).reshape(-1, 3))
    q = np.where(np.isfinite(q), q, -1e6)
    at = found.heights.layout.cells(q[:, :2])
    wide = cv2.dilate((found.footprint > 0).astype(np.uint8), np.ones((3, 3), np.uint8)).ravel()
    least = np.full(len(q), found.low_mm)
    if sigma is not None:
        least = np.maximum(least, k * np.nan_to_num(np.asarray(sigma, dtype=np.float64).reshape(-1)))
    return np.asarray((at >= 0) & (wide[at] > 0) & (q[:, 2] > least)).reshape(shape)


def labels(found: Found, grid: Grid) -> Bool:
    """Which pixels (H, W) of a view are specimen; none where no specimen was found."""
    return on_specimen(found, grid.xyz, grid.sigma) & grid.valid


def figures(found: Found) -> dict[str, Any]:
    """What scan.json says of it: "found", "why" not, the substrate, and the pieces, the largest first."""
    out: dict[str, Any] = {"found": bool(found.pieces), "why": found.why or None}
    if found.substrate is not None:
        f = found.substrate.frame
        out["substrate"] = {
            "point": f.origin.tolist(),
            "normal": f.axes[2].tolist(),
            "rms_um": 1e3 * found.substrate.rms_mm,
            "share": found.substrate.share,
        }
    out["pieces"] = [dict(vars(p)) for p in found.pieces]
    return out


def words(said: dict[str, Any]) -> str:
    """`figures` in one line."""
    if not said["found"]:
        return f"specimen: not measured; {said['why']}"
    p = said["pieces"][0]
    line = (
        f"specimen: {p['length_mm']:.1f} x {p['width_mm']:.1f} x {p['height_mm']:.2f} mm, "
        f"footprint {p['footprint_mm2']:.0f} mm^2, surface {p['surface_mm2']:.0f} mm^2, "
        f"volume {p['volume_mm3'] / 1e3:.3f} +- {p['volume_sigma_mm3'] / 1e3:.3f} cm^3"
    )
    if p["filled"] >= 0.005:
        line += f"; {100 * p['filled']:.0f} % of it was not seen and is interpolated"
    if p["cut_off"] >= 0.02:
        line += "; it runs out of the measured field, so this is what was seen of it"
    if (more := len(said["pieces"]) - 1) > 0:
        line += f"; and {more} smaller piece{'s' if more > 1 else ''}"
    return line
