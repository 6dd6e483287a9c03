"""The recipe that compares two scans: specimen from substrate, registration, change, the cut against its guideline."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from fringescope import compare, geometry, heights, register, report, specimen
from fringescope.errors import EmptyResultError, RigError
from fringescope.settings import Settings
from fringescope.types import F64, U8, AnyArray, Bool, Cloud, Grid, Guidance, Rig, Surface

Progress = Callable[[str, float], None]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two scans compared. `strokes`: the guidelines, carried to where they are in the second scan, world mm."""

    change: compare.Change
    registration: register.Registration
    before: specimen.Found
    after: specimen.Found
    strokes: tuple[F64, ...] = ()
    stroke_error_um: tuple[float, ...] = ()  #: median error to expect of each stroke through the registration
    distances: tuple[compare.FromGuideline, ...] = ()
    words: tuple[str, ...] = ()


def compare_scans(
    before: Cloud,
    after: Cloud,
    rig: Rig | None = None,
    settings: Settings | None = None,
    *,
    moved: bool = True,
    strokes: Sequence[F64] = (),
    names: Sequence[str] = (),
    progress: Progress | None = None,
) -> Comparison:
    """What changed from one cloud to another of the same instrument; how far the cut ran from `strokes` (m, 3).

    `moved` False: the specimen stayed where it was, nothing is registered. Strokes lie in the first scan's world;
    `names` are theirs, for words.
    Raises RegistrationError where the surfaces do not fit each other, EmptyResultError where points are too few.
    """
    s = settings or Settings()
    tell = progress or _silent
    up = upwards(after, rig)
    tell("telling the specimens from the substrate", 0.0)
    found, (on_before, on_after) = _specimens(before, after, up, s)
    grounded = on_before is not None
    tell("registering", 0.2)
    if moved:
        placed = register.register(register.patch_of(before, on_before), register.patch_of(after, on_after), s.register)
    else:
        placed = register.still(np.nanmedian(after.xyz, axis=0))
    tell("comparing", 0.5)
    T = placed.T_new_old
    plane = found[1].substrate
    middle = np.nanmedian(after.xyz, axis=0).astype(np.float64)
    frame = plane.frame if plane is not None else heights.frame_at(middle, up)
    first = compare.Side(geometry.transform(T, before.xyz), before.normals @ T.R.T, before.sigma, on_before)
    second = compare.Side(after.xyz, after.normals, after.sigma, on_after)
    change = compare.compare(first, second, frame, placed.covariance, placed.centre, s.compare)
    carried, errors = [], []
    for line in strokes:
        there, error = np.full(line.shape, np.nan), np.full(len(line), np.nan)
        ok = np.isfinite(line).all(1)
        there[ok], error[ok] = register.carried(line[ok], placed)
        carried.append(there)
        errors.append(float(np.nanmedian(error)) if ok.any() else math.nan)
    distances = compare.from_guideline(change.cut, carried) if carried else ()
    words = [*change.words, *_moved_words(placed, moved), *_guide_words(distances, change, names)]
    if not grounded:
        words.append("the specimen is not told from its substrate (" + (found[0].why or found[1].why)
                     + "): all that both scans hold was compared")  # fmt: skip
    tell("done", 1.0)
    return Comparison(change, placed, found[0], found[1], tuple(carried), tuple(errors), distances, tuple(words))


def laid(before: Cloud, after: Cloud, rig: Rig | None, s: Settings) -> register.Registration:
    """The motion that lays the specimen of one cloud on that of another, whatever the tray did. Raises as above."""
    _, (old, new) = _specimens(before, after, upwards(after, rig), s)
    return register.register(register.patch_of(before, old), register.patch_of(after, new), s.register)


def _specimens(
    before: Cloud, after: Cloud, up: F64, s: Settings
) -> tuple[list[specimen.Found], tuple[Bool | None, Bool | None]]:
    """The specimens of both clouds, and which points are theirs: None where either is not told from its substrate."""
    found = [specimen.find(c.xyz, c.normals, c.sigma, up, s.specimen) for c in (before, after)]
    if not (found[0].pieces and found[1].pieces):
        return found, (None, None)
    old, new = (specimen.on_specimen(f, c.xyz, c.sigma) for f, c in zip(found, (before, after), strict=True))
    return found, (old, new)


def upwards(cloud: Cloud, rig: Rig | None) -> F64:
    """Unit vector (3,) towards the projector; without a rig the mean normal of the surface, which faces the cameras."""
    if rig is not None:
        return np.asarray(-rig.projector.pose.R[2])
    mean = np.nanmean(cloud.normals.astype(np.float64), axis=0)
    size = float(np.linalg.norm(mean))
    if not size > 0.1:
        raise EmptyResultError("the surface's normals point all ways; give --rig, which says where the projector is")
    return np.asarray(mean / size)


def _moved_words(r: register.Registration, moved: bool) -> list[str]:
    if not moved:
        return ["not registered: taken as unmoved"]
    shift = float(np.sqrt((r.shift_sigma_mm**2).sum()))
    line = (
        f"registered: moved by {1e3 * r.shift_mm:.0f} um and {math.degrees(r.turn_rad):.3f} degrees, known to "
        f"{1e3 * shift:.1f} um; {100 * r.inliers:.0f} % of the surface fits, to {1e3 * r.rms_mm:.0f} um"
    )
    return [line, *r.words] + ([] if r.converged else ["the registration did not settle; mistrust small changes"])


def _guide_words(
    distances: Sequence[compare.FromGuideline], change: compare.Change, names: Sequence[str]
) -> list[str]:
    out = []
    for d in distances:
        name = names[d.stroke] if d.stroke < len(names) else f"stroke {d.stroke + 1}"
        if not len(change.cut):
            out.append(f"{name}: nothing was cut")
        elif d.points:
            line = (
                f"{name}: the cut ran {d.median_mm:.2f} mm from it (median), p95 {d.p95_mm:.2f}, "
                f"at most {d.max_mm:.2f}"
            )
            if d.missed > 0.02:
                line += f"; {100 * d.missed:.0f} % of it was not cut"
            out.append(line)
        else:
            out.append(f"{name}: no cut is nearest to it")
    return out


# ---------------------------------------------------------------------------------------------------------- guidelines


def on_grid(grid: Grid, pixels: AnyArray) -> F64:
    """World points (m, 3) under pixels (m, 2) of a view's camera: bilinear; NaN where one of the four has none."""
    p = np.asarray(pixels, dtype=np.float64).reshape(-1, 2)
    h, w = grid.reasons.shape
    inside: Bool = np.asarray((p[:, 0] >= 0) & (p[:, 1] >= 0) & (p[:, 0] <= w - 1) & (p[:, 1] <= h - 1))
    q = np.where(inside.reshape(-1, 1), p, 0.0)
    j, i = np.minimum(q.astype(int), [w - 2, h - 2]).T
    a, b = (np.asarray(x).reshape(-1, 1) for x in (q[:, 0] - j, q[:, 1] - i))
    x = grid.xyz.astype(np.float64)
    out = (1 - b) * ((1 - a) * x[i, j] + a * x[i, j + 1]) + b * ((1 - a) * x[i + 1, j] + a * x[i + 1, j + 1])
    return np.where(inside.reshape(-1, 1), out, np.nan)


def from_projector(cloud: Cloud, rig: Rig, uv: AnyArray, reach: float = 4.0) -> F64:
    """World points (m, 3) of a cloud that the projector's rays through (m, 2) of its plane meet; NaN farther than
    `reach` plane units from any point.
    """
    from scipy.spatial import cKDTree

    place = geometry.project(rig.projector, cloud.xyz)
    ok = np.isfinite(place).all(1)
    q = np.asarray(uv, dtype=np.float64).reshape(-1, 2)
    finite: Bool = np.asarray(np.isfinite(q).all(1))
    d, at = (np.asarray(x) for x in cKDTree(place[ok]).query(np.where(finite.reshape(-1, 1), q, 0.0), k=3))
    w = 1 / np.maximum(d, 1e-3)
    out = (cloud.xyz[ok].astype(np.float64)[at] * (w / w.sum(1, keepdims=True))[..., None]).sum(1)
    return np.where((finite & (d[:, 0] < reach)).reshape(-1, 1), out, np.nan)


def traced(guidance: Guidance) -> tuple[list[str], list[F64], list[str]]:
    """Strokes as they lie on the tissue, hidden parts too: their names, polylines (m, 3) in mm with NaN where a line is
    broken, and a line about each that has none.
    """
    names, lines, words = [], [], []
    gap = np.full((1, 3), np.nan)
    for g in guidance.strokes:
        pieces = [t.xyz[t.piece == n] for t in g.traces for n in np.unique(t.piece)]
        if g.refused is not None or not pieces:
            words.append(f"{g.stroke.id}: not compared: {g.refused or 'nothing of it lies on the tissue'}")
            continue
        names.append(g.stroke.id)
        lines.append(np.concatenate([a for piece in pieces for a in (piece, gap)]))
    return names, lines, words


def world_strokes(
    strokes: Sequence[Mapping[str, Any]], cloud: Cloud, grids: Sequence[Grid], rig: Rig | None
) -> list[F64]:
    """Strokes as `store.read_strokes` gives them, as polylines (m, 3) in world mm on the first scan's surface.

    Raises RigError where a stroke needs a camera or a rig that is not there.
    """
    out = []
    for stroke in strokes:
        if "world_mm" in stroke:
            line = np.asarray(stroke["world_mm"], dtype=np.float64)
        elif "pixels" in stroke:
            grid = next((g for g in grids if g.camera == stroke["camera"]), None)
            if grid is None:
                raise RigError(f"stroke '{stroke['id']}': the first scan has no camera '{stroke['camera']}'; it has "
                               f"{', '.join(g.camera for g in grids)}")  # fmt: skip
            line = on_grid(grid, _dense(np.asarray(stroke["pixels"], dtype=np.float64)))
        else:
            if rig is None:
                raise RigError(f"stroke '{stroke['id']}' is given on the projector's plane; add --rig rig.json")
            pieces = [from_projector(cloud, rig, _dense(np.asarray(x, dtype=np.float64))) for x in stroke["segments"]]
            gap = np.full((1, 3), np.nan)
            line = np.concatenate([a for piece in pieces for a in (piece, gap)]) if pieces else gap
        if stroke.get("closed") and len(line):
            line = np.vstack([line, line[:1]])
        out.append(line)
    return out


def _dense(line: F64, step: float = 2.0) -> F64:
    """A polyline (m, 2) with points no more than `step` apart, so that it follows the surface between its corners."""
    out = [line[:1]]
    for a, b in pairwise(line):
        n = min(max(1, math.ceil(float(np.hypot(*(b - a))) / step)), 20_000)
        out.append(a + np.linspace(0, 1, n + 1)[1:, None] * (b - a))
    return np.concatenate(out)


# ------------------------------------------------------------------------------------------------------------ pictures


def _shown(c: Comparison, depth: F64, labels: AnyArray) -> AnyArray:
    """The regions without the margin around them, where nothing is to be seen."""
    return np.where(np.abs(np.nan_to_num(depth)) > 4 * c.change.noise_mm, labels, 0)


def coloured_cloud(cloud: Cloud, c: Comparison) -> Cloud:
    """The second scan's points; those that changed coloured by the depth removed."""
    limit = report.change_limit(c.change.depth, c.change.labels)
    depth, labels = compare.depth_at(c.change, cloud.xyz)
    labels = _shown(c, depth, labels)
    rgb = np.where((labels > 0)[:, None], report.change_colours(depth, limit), cloud.rgb)
    return replace(cloud, rgb=rgb.astype(np.uint8))


def coloured_surface(surface: Surface, c: Comparison) -> Surface:
    """The second scan's mesh; triangles that changed coloured by the depth removed, the others with their pictures."""
    limit = report.change_limit(c.change.depth, c.change.labels)
    depth, labels = compare.depth_at(c.change, surface.vertices)
    return report.change_surface(surface, depth, _shown(c, depth, labels), limit)


def picture(c: Comparison, title: str) -> U8:
    """The map with its legend, the guidelines and where the cut ran."""
    ch = c.change
    figures = [("removed", f"{ch.removed_mm3:.1f} ± {ch.removed_sigma_mm3:.1f} mm³")]
    figures += [("added", f"{ch.added_mm3:.1f} ± {ch.added_sigma_mm3:.1f} mm³")] if ch.added_mm3 else []
    figures += [("deepest", f"{max(r.depth_mm for r in ch.regions):.2f} mm")] if ch.regions else []
    far = [d.p95_mm for d in c.distances if d.points]
    figures += [("from guideline (p95)", f"{max(far):.2f} mm")] if far else []
    shown = ch.surface - np.where(ch.labels > 0, np.nan_to_num(ch.depth), 0.0)
    low = (float(ch.layout.low[0]), float(ch.layout.low[1]))
    strokes = [ch.frame.local(x)[:, :2] for x in c.strokes]
    labels = _shown(c, ch.depth, ch.labels)
    return report.change_picture(ch.depth, labels, shown, low, ch.layout.cell_mm, title, figures, strokes,
                                 ch.frame.local(ch.cut)[:, :2])  # fmt: skip


def figures(c: Comparison, names: Sequence[str] = (), notes: Sequence[str] = ()) -> dict[str, Any]:
    """What compare.json says; `names` are those of the strokes, `notes` about those that are left out."""
    r = c.registration
    return {
        "words": [*c.words, *notes],
        "registration": {
            "R": r.T_new_old.R.tolist(),
            "t": r.T_new_old.t.tolist(),
            "rms_um": 1e3 * r.rms_mm,
            "inliers": r.inliers,
            "iterations": r.iterations,
            "converged": r.converged,
            "centre": r.centre.tolist(),
            "shift_mm": r.shift_mm,
            "turn_deg": math.degrees(r.turn_rad),
            "shift_sigma_um": (1e3 * r.shift_sigma_mm).tolist(),
            "turn_sigma_urad": (1e6 * r.turn_sigma_rad).tolist(),
            "not_told": list(r.words),
        },
        "change": compare.figures(c.change),
        "guidelines": [
            {**vars(d), "id": names[d.stroke] if d.stroke < len(names) else str(d.stroke), "carried_error_um": e}
            for d, e in zip(c.distances, c.stroke_error_um, strict=True)
        ],
        "specimen": {"before": specimen.figures(c.before), "after": specimen.figures(c.after)},
    }


def _silent(_what: str, _share: float) -> None:
    """No progress is shown."""
