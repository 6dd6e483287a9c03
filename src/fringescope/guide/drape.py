"""Strokes to places on the tissue: out of a photograph by the points of its camera, or from millimetres (III-F)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from fringescope import geometry
from fringescope.errors import GuidanceError
from fringescope.guide.tissue import Tissue
from fringescope.kernels import guiding as k
from fringescope.settings import GuideSettings
from fringescope.types import F64, Bool, Reason, Stroke, StrokeKind

#: reasons of pixels that were lit all the same: their neighbours may speak for them
LIT = int(Reason.SATURATED | Reason.JUMP | Reason.NOT_LOCAL | Reason.VIEWS_DISAGREE)
BRIDGE_MM = 0.1  #: what is lit must be this near to a point of some camera, and its sampling, to throw a shadow
DEEP_MM = 1.0  #: triangles that bridge a gap do not lie farther before its ground than this
RIM_PIXELS = 2.0  #: so much of the edge of a surface, in a camera's pixels, has no points
MARCH_MM = 0.25  #: steps along a camera's ray towards the surface of other views


class Source(IntEnum):
    """Who says where a sample is."""

    NOBODY = 0  #: a hole: its place is a guess between those around it, or NaN
    CAMERA = 1  #: the stroke's own camera measured it
    OTHERS = 2  #: other views did, along this camera's ray
    ASKED = 3  #: it was asked for in mm
    SURFACE = 4  #: it lies on the fused surface, as the projector sees it


@dataclass(frozen=True, eq=False)
class Samples:
    """Places along a stroke, in order: `xyz` (n, 3) mm (a guess or NaN where the source is nobody).

    `ray` (n, 3) is the camera's unit ray and `sigma` (n,) the error along it, mm; NaN and 0 where no camera is meant.
    A new `piece` (n,) begins where the line is broken.
    """

    xyz: F64
    source: Any
    ray: F64
    sigma: F64
    piece: Any
    notes: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.xyz)


def drape(stroke: Stroke, tissue: Tissue, s: GuideSettings) -> Samples:
    """A stroke's polyline on the tissue, closed if it says so. Raises GuidanceError."""
    closed = stroke.closed or stroke.kind is StrokeKind.REGION
    if stroke.pixels is not None:
        assert stroke.camera is not None
        return from_photograph(stroke.pixels, stroke.camera, closed, tissue, s)
    assert stroke.world_mm is not None
    return from_world(stroke.world_mm, closed, tissue, s)


def places(stroke: Stroke, points: F64, tissue: Tissue, s: GuideSettings) -> F64:
    """Single points of a stroke on the tissue (n, 3), NaN where there is none."""
    if stroke.pixels is not None:
        assert stroke.camera is not None
        out = seen(points, stroke.camera, tissue, s)
        return np.where((out.source == Source.NOBODY)[:, None], np.nan, out.xyz)
    uv = geometry.project(tissue.rig.projector, points)
    gap, slack = _gap(points, uv, tissue)
    with np.errstate(invalid="ignore"):
        there = np.abs(gap) <= s.off_surface_mm + slack
    return np.where(there[:, None], points, np.nan)


# ------------------------------------------------------------------------------------------------------- photographs


def from_photograph(pixels: F64, camera: str, closed: bool, tissue: Tissue, s: GuideSettings) -> Samples:
    """A polyline (n, 2) in a camera's pixels, sampled and laid on what that camera measured.

    Where it has a hole the line goes on by what other views measured along its rays; where nobody measured anything it
    is broken. Where the surface jumps, it is broken too. Raises GuidanceError if the scan lacks the camera.
    """
    number = tissue.number(camera)
    footprint = tissue.footprints[number]
    if footprint == 0.0:
        raise GuidanceError(f"camera '{camera}' has no points in this scan; draw in another view, or scan again")
    path = np.concatenate([pixels, pixels[:1]]) if closed else pixels
    H, W = tissue.grids[number].reasons.shape
    path, beside = clipped(path, np.array([-3.0, -3.0]), np.array([W + 2.0, H + 2.0]))
    dense, _ = resampled(path, max(0.5, s.sample_mm / footprint), s.max_samples, beside, s.jump_mm / footprint)
    out = seen(dense, camera, tissue, s)
    xyz, guessed = bridged(out.xyz)
    piece, jumps = _pieces(xyz, guessed, dense, footprint, s)
    off = ~((dense >= -0.5).all(1) & (dense[:, 0] < W - 0.5) & (dense[:, 1] < H - 0.5))
    notes = []
    if off.any():
        notes.append(f"{off.mean():.0%} of it lies beside the picture of {camera} ({W} x {H})")
    if (part := float((out.source == Source.OTHERS).mean())) >= 0.005:
        notes.append(f"{part:.0%} of it is carried by the surface of other views, over holes of {camera}")
    notes += [f"the surface jumps by {j:.1f} mm under it: it is broken there" for j in jumps[:3]]
    if len(jumps) > 3:
        notes.append(f"and {len(jumps) - 3} more jumps")
    return Samples(xyz, out.source, out.ray, out.sigma, piece, tuple(notes))


def seen(pixels: F64, camera: str, tissue: Tissue, s: GuideSettings) -> Samples:
    """Pixels (n, 2) of a camera on the tissue: by its own points, else by what others measured along the ray."""
    number = tissue.number(camera)
    grid, footprint = tissue.grids[number], tissue.footprints[number]
    device = tissue.rig.cameras[grid.view]
    pixels = np.ascontiguousarray(pixels, np.float64)
    origin, rays = geometry.world_rays(device, pixels)
    xyz, sigma = np.empty((len(pixels), 3)), np.empty(len(pixels))
    half = int(np.clip(round(s.window_mm / footprint), 1, 12)) if footprint else 1
    k.drape(grid.xyz, grid.reasons, grid.sigma, pixels, origin, rays, half, s.max_slope, LIT, xyz, sigma)
    there = np.isfinite(xyz).all(1)
    source = np.where(there, Source.CAMERA, Source.NOBODY)
    gaps = np.flatnonzero(~there & np.isfinite(rays).all(1))
    if gaps.size:
        found = _along_rays(origin, rays[gaps], tissue, number)
        ok = np.asarray(np.isfinite(found).all(1))
        ok[ok] = tissue.supported(found[ok], camera)
        xyz[gaps[ok]], source[gaps[ok]] = found[ok], Source.OTHERS
        sigma[gaps[ok]] = tissue.sigmas[number]
    sigma = np.where(source == Source.NOBODY, 0.0, sigma)
    return Samples(xyz, source, rays, sigma, np.zeros(len(pixels), np.int32))


def _along_rays(origin: F64, rays: F64, tissue: Tissue, number: int) -> F64:
    """Where rays (n, 3) from a camera first come down onto the lit surface; NaN where they do not (n, 3).

    A ray that went behind something before, into its shadow, may have ended there, where nobody saw it.
    """
    near, far = tissue.spans[number]
    out = np.full(rays.shape, np.nan)
    if not np.isfinite(near):
        return out
    t = np.arange(near, far + MARCH_MM, MARCH_MM)
    p = tissue.rig.projector
    for block in np.array_split(np.arange(len(rays)), len(rays) * len(t) // 2_000_000 + 1):
        points = origin + rays[block][:, None, :] * t[:, None]
        uv = geometry.project(p, points)
        depth = geometry.transform(p.pose, points)[..., 2]
        ground = tissue.relief.depth_at(uv.reshape(-1, 2)).reshape(depth.shape)
        gap = depth - ground
        with np.errstate(invalid="ignore"):
            lands = (gap[:, :-1] < 0) & (gap[:, 1:] >= 0) & (gap[:, 1:] - gap[:, :-1] < 4 * MARCH_MM)
            behind = gap[:, 1:] >= 0
        row = np.arange(len(block))
        i = behind.argmax(1)
        hit = lands[row, i]
        a, b = gap[row, i], gap[row, np.minimum(i + 1, len(t) - 1)]
        with np.errstate(invalid="ignore", divide="ignore"):
            reach = t[i] + MARCH_MM * a / (a - b)
        out[block[hit]] = origin + rays[block[hit]] * reach[hit, None]
    return out


def bridged(xyz: F64) -> tuple[F64, Bool]:
    """Places with holes guessed on straight lines between what lies around them, and which are guesses."""
    known = np.asarray(np.isfinite(xyz).all(1))
    if known.all() or not known.any():
        return xyz, ~known
    at = np.arange(len(xyz))
    out = np.stack([np.interp(at, at[known], xyz[known, i], np.nan, np.nan) for i in range(3)], 1)
    return out, ~known


def _pieces(xyz: F64, guessed: Bool, pixels: F64, footprint: float, s: GuideSettings) -> tuple[Any, list[float]]:
    """Numbers of the unbroken pieces (n,), and by how much the surface jumps between them."""
    far = np.linalg.norm(np.diff(xyz, axis=0), axis=1)
    pace = footprint * np.linalg.norm(np.diff(pixels, axis=0), axis=1)
    with np.errstate(invalid="ignore"):
        jump = (far > np.maximum(s.jump_mm, 8 * pace)) & ~guessed[1:] & ~guessed[:-1]
    piece = np.concatenate([[0], np.cumsum(jump)]).astype(np.int32)
    return piece, [float(d) for d in far[jump]]


# -------------------------------------------------------------------------------------------------------- millimetres


def from_world(points: F64, closed: bool, tissue: Tissue, s: GuideSettings) -> Samples:
    """A polyline (n, 3) in mm, sampled. Its points are taken as they are; between them it follows the surface.

    Between two points that the projector lights, the line runs as the projector sees it straight; elsewhere straight in
    space. Points that float above the surface by more than `off_surface_mm`, or lie where there is none, are holes.
    """
    path = np.concatenate([points, points[:1]]) if closed else points
    xyz, leg = resampled(path, s.sample_mm, s.max_samples, most_step=s.jump_mm)
    projector = tissue.rig.projector
    uv = geometry.project(projector, xyz)
    gap, slack = known_gap(xyz, uv, tissue)
    ends = np.flatnonzero(np.isin(np.arange(len(xyz)), leg))
    there = np.isfinite(gap)
    with np.errstate(invalid="ignore"):
        floats = gap < -(s.off_surface_mm + slack)
        lit = ~floats & (gap <= s.shadow_mm + slack)
    notes = []
    # between two lit ends the line lies on what is lit
    index = np.arange(len(xyz))
    left = ends[np.searchsorted(ends, index, side="right") - 1]
    right = ends[np.minimum(np.searchsorted(ends, index, side="left"), len(ends) - 1)]
    between = (left < index) & (index < right)
    dropped = between & lit[left] & lit[right]
    ground = tissue.relief.at(uv)
    xyz = np.where((dropped & np.isfinite(ground).all(1))[:, None], ground, xyz)
    source = np.full(len(xyz), int(Source.ASKED))
    source[dropped] = Source.SURFACE
    nowhere = ~there & ~dropped
    nowhere[nowhere] = ~_beside(xyz[nowhere], uv[nowhere], tissue, s)
    if (bridged := ~there & ~dropped & ~nowhere).any():
        notes.append(f"{bridged.mean():.0%} of it crosses gaps of the measured surface, at the places asked for")
    lost = (floats & ~dropped) | nowhere | (dropped & ~np.isfinite(ground).all(1)) | ~np.isfinite(xyz).all(1)
    source[lost] = Source.NOBODY
    at_ends = floats[ends]
    if at_ends.any():
        worst = float(-gap[ends][at_ends].min())
        notes.append(f"{at_ends.sum()} of {len(ends)} points float above the surface, up to {worst:.1f} mm")
    none = np.full(len(xyz), np.nan)
    return Samples(
        xyz, source, np.stack([none] * 3, 1), np.zeros(len(xyz)), np.zeros(len(xyz), np.int32), tuple(notes)
    )


def on_surface(points: F64, ground: Bool, piece: Any = None, notes: tuple[str, ...] = ()) -> Samples:
    """Places (n, 3) that were walked to along the fused surface; those over a hole are guesses."""
    source = np.where(ground, Source.SURFACE, Source.NOBODY)
    none = np.full(len(points), np.nan)
    piece = np.zeros(len(points), np.int32) if piece is None else piece
    return Samples(points, source, np.stack([none] * 3, 1), np.zeros(len(points)), piece, notes)


def _gap(xyz: F64, uv: F64, tissue: Tissue) -> tuple[F64, F64]:
    """How far places lie behind what the projector lights (n,), mm, and how much of it the slope explains (n,)."""
    depth = geometry.transform(tissue.rig.projector.pose, xyz)[:, 2]
    r = tissue.relief
    slack = np.nan_to_num(r.of(r.steep, uv))
    return depth - r.depth_at(uv), np.minimum(slack, r.jump_mm)


def known_gap(xyz: F64, uv: F64, tissue: Tissue) -> tuple[F64, F64]:
    """As `_gap`, NaN where no camera measured what seems to be lit: triangles also bridge what they should not.

    Close to the edge of a surface, where its last pixels were lost, what lies deep behind it is behind it.
    """
    gap, slack = _gap(xyz, uv, tissue)
    r = tissue.relief
    with np.errstate(invalid="ignore"):
        doubt = np.flatnonzero((gap > 0) & (gap < DEEP_MM))
    bridge = doubt[~tissue.supported(tissue.relief.at(uv[doubt]), slack_mm=BRIDGE_MM)]
    gap[bridge] = np.nan
    away = r.of(r.away, uv)
    behind = geometry.transform(tissue.rig.projector.pose, xyz)[:, 2] - r.of(r.beside, uv)
    with np.errstate(invalid="ignore"):
        rim = np.isnan(gap) & (away > 0) & (away <= RIM_PIXELS * max(tissue.footprints, default=0.0))
        rim &= behind > np.maximum(DEEP_MM, 4 * away)
    return np.where(rim, behind, gap), slack


def _beside(xyz: F64, uv: F64, tissue: Tissue, s: GuideSettings) -> Bool:
    """Whether places (n, 3) where nothing was measured lie in a narrow gap of the surface, and not in front of it."""
    r = tissue.relief
    depth = geometry.transform(tissue.rig.projector.pose, xyz)[:, 2]
    with np.errstate(invalid="ignore"):
        near = (r.of(r.away, uv) <= s.gap_mm) & (depth - r.of(r.beside, uv) > -s.off_surface_mm)
    return near | tissue.supported(xyz)


def in_shadow(xyz: F64, uv: F64, source: Any, tissue: Tissue, s: GuideSettings) -> Bool:
    """Whether something stands between places (n, 3) and the projector.

    What a camera measured was lit, whatever the fused surface says, but for gross contradictions.
    """
    gap, slack = known_gap(xyz, uv, tissue)
    limit = np.where(source == Source.CAMERA, s.off_surface_mm, s.shadow_mm) + slack
    with np.errstate(invalid="ignore"):
        return np.asarray(gap > limit)


def clipped(path: F64, low: F64, high: F64) -> tuple[F64, Bool]:
    """A polyline (n, 2) with points where it crosses a box, and which of its legs (m - 1,) run outside the box."""
    a, d = path[:-1], np.diff(path, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.sort(np.stack([(low - a) / d, (high - a) / d]), axis=0)
    still = d == 0
    inside = (a >= low) & (a <= high)
    enter = np.where(still, np.where(inside, 0.0, np.inf), t[0]).max(1)
    leave = np.where(still, np.where(inside, 1.0, -np.inf), t[1]).min(1)
    crosses = np.minimum(leave, 1.0) > np.maximum(enter, 0.0)
    cuts = np.stack([np.zeros(len(a)), np.where(crosses, enter, -1.0), np.where(crosses, leave, -1.0)], 1)
    there = np.concatenate([np.ones((len(a), 1), bool), (cuts[:, 1:] > 0) & (cuts[:, 1:] < 1)], 1)
    points = (a[:, None] + d[:, None] * cuts[..., None])[there]
    out = np.concatenate([points, path[-1:]])
    middle = 0.5 * (out[1:] + out[:-1])
    return out, ~((middle >= low) & (middle <= high)).all(1)


def resampled(
    path: F64, step: float, most: int, sparse: Bool | None = None, most_step: float = np.inf
) -> tuple[F64, Any]:
    """A polyline (n, d) with a point at least every `step` along it, its own points among them; at most about `most`.

    Returns the points (m, d) and which of them are its own (k,): of own points closer than a quarter of the step only
    some are kept, the last always. Legs (n - 1,) that are `sparse` get none between. Raises GuidanceError where the
    step would have to be larger than `most_step`.
    """
    lengths = np.linalg.norm(np.diff(path, axis=0), axis=1)
    inner = lengths if sparse is None else np.where(sparse, 0.0, lengths)
    asked, step = step, max(step, float(inner.sum()) / most)
    if step > max(most_step, asked):
        raise GuidanceError(f"is too long to be followed in {most} steps; split it, or give guide.max_samples")
    if sparse is not None and sparse.any():
        keep = np.concatenate([[True], ~(sparse[1:] & sparse[:-1]), [True]])  # of what runs outside, the ends
        path = path[keep]
        sparse = np.asarray(sparse[np.flatnonzero(keep)[:-1]])
    gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    if sparse is not None and sparse.any():
        return _with_gaps(path, gone, step, sparse)
    keep = np.concatenate([[True], np.diff(np.floor(gone / (0.25 * step))) > 0])
    keep[-1] = True
    path, gone = path[keep], gone[keep]
    if len(gone) > most:
        pick = np.unique(np.linspace(0, len(gone) - 1, most).astype(np.intp))
        path, gone = path[pick], gone[pick]
    count = np.maximum(1, np.ceil(np.diff(gone) / step - 1e-9)).astype(np.intp)
    first = np.concatenate([[0], np.cumsum(count)])
    if len(path) == 1:
        return path, np.array([0])
    return _between(path, count), first


def _with_gaps(path: F64, gone: F64, step: float, sparse: Bool) -> tuple[F64, Any]:
    """As `resampled`, all own points kept, and none put between those of sparse legs."""
    count = np.where(sparse, 1, np.maximum(1, np.ceil(np.diff(gone) / step - 1e-9))).astype(np.intp)
    return _between(path, count), np.concatenate([[0], np.cumsum(count)])


def _between(path: F64, count: Any) -> F64:
    """A polyline (n, d) with each leg in `count` (n - 1,) parts."""
    leg = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(leg)) - np.concatenate([[0], np.cumsum(count)])[leg]) / count[leg]
    out = path[leg] + (path[leg + 1] - path[leg]) * share[:, None]
    return np.concatenate([out, path[-1:]])
