"""Strokes on a photograph or on the surface to places on the tissue, and to the image for the projector (III-F, IV-D).

`tissue` makes a scan ready once; `guide` takes strokes to traces, each with what is hidden and how exact it is, and to
the picture. The parts: `drape` (where is it on the tissue), `curves` and `fills` (shapes that are measured along it),
`trace` (what does the projector see of it), `draw` (which mirrors), `find` (where did it land).
"""

from __future__ import annotations

import numpy as np

from fringescope.errors import GuidanceError
from fringescope.guide import curves, drape, fills
from fringescope.guide.drape import Samples, Source
from fringescope.guide.draw import Canvas
from fringescope.guide.fills import Patch
from fringescope.guide.find import Shots, landings
from fringescope.guide.tissue import Tissue, tissue
from fringescope.guide.trace import guided, hidden_parts, mirror_units, trace, visible_runs
from fringescope.settings import GuideSettings
from fringescope.types import Fill, Guidance, Guided, Guidelines, Hidden, HiddenPart, Stroke, StrokeKind

__all__ = [
    "Shots", "Tissue", "guide", "hidden_parts", "landings", "mirror_units", "place", "tissue", "visible_runs",
]  # fmt: skip


def guide(
    guidelines: Guidelines, tissue: Tissue, s: GuideSettings, *, calibration_mm: float = 0.0, dashed: bool = False
) -> Guidance:
    """Strokes to the picture that the projector shows, and what became of each.

    `calibration_mm`: what the rig may be wrong by, on the tissue. `dashed`: they are in doubt. A stroke that cannot be
    shown as it was asked for is refused with the reason, and the others are shown.
    """
    canvas = Canvas(tissue.rig.projector)
    out = []
    for stroke in guidelines.strokes:
        made, patches = place(stroke, tissue, s, calibration_mm)
        canvas.stroke(made, patches, s, dashed)
        out.append(made)
    return Guidance(canvas.image(), tuple(out), guidelines.scan, guidelines.rig)


def place(
    stroke: Stroke, tissue: Tissue, s: GuideSettings, calibration_mm: float = 0.0
) -> tuple[Guided, list[Patch]]:
    """One stroke on the tissue and on the projector's plane, and what of it is filled."""
    try:
        return _place(stroke, tissue, s, calibration_mm)
    except GuidanceError as e:
        return Guided(stroke, refused=str(e)), []


def _place(stroke: Stroke, tissue: Tissue, s: GuideSettings, calibration_mm: float) -> tuple[Guided, list[Patch]]:
    if stroke.kind is StrokeKind.TEXT:
        return _text(stroke, tissue, s, calibration_mm)
    lines = [curves.circle(stroke, tissue, s) if stroke.kind is StrokeKind.CIRCLE else drape.drape(stroke, tissue, s)]
    notes = lines[0].notes
    if stroke.kind is StrokeKind.ARROW:
        lines += curves.head(lines[0], stroke, tissue, s)
    elif stroke.kind is StrokeKind.OFFSETS:
        lines += curves.offsets(lines[0], stroke, tissue)
    if not any((line.source != Source.NOBODY).any() for line in lines):
        raise GuidanceError(_nowhere(lines[0], stroke))
    patches: list[Patch] = []
    size: tuple[float, float] | None = None
    if stroke.closed or stroke.kind in (StrokeKind.REGION, StrokeKind.CIRCLE):
        size, patch, more = _inside(lines[0], stroke, tissue, s)
        notes += more
        if stroke.fill is Fill.SOLID and patch is not None:
            patches.append(patch)
        elif stroke.fill is Fill.HATCH:
            known = np.isfinite(lines[0].xyz).all(1)
            lines += curves.hatch(lines[0].xyz[known], stroke, tissue, s)
    traces = [trace(line, stroke, tissue, calibration_mm, s) for line in lines if len(line)]
    made = guided(stroke, traces, notes, size)
    return made, patches


def _nowhere(line: Samples, stroke: Stroke) -> str:
    if stroke.pixels is not None:
        return f"none of it lies where the tissue was measured, as {stroke.camera} sees it; draw it on the tissue"
    return "none of it lies on the measured surface; " + ("; ".join(line.notes) or "draw it on the tissue")


def _inside(
    line: Samples, stroke: Stroke, tissue: Tissue, s: GuideSettings
) -> tuple[tuple[float, float] | None, Patch | None, tuple[str, ...]]:
    """Area of a closed stroke with its sigma, its filling, and notes."""
    known = np.isfinite(line.xyz).all(1)
    outline = line.xyz[known]
    projector = tissue.rig.projector
    t = trace(line, stroke, tissue, 0.0, s)
    if stroke.pixels is not None and stroke.kind is not StrokeKind.CIRCLE:
        assert stroke.camera is not None
        units = fills.in_photograph(stroke.pixels, stroke.camera, tissue)
        if units is None:
            return None, None, ("nothing inside it was measured",)
        share, low = units
        patch: Patch | None = fills.device_patch(share, low, projector)
    else:
        ring = t.uv[np.isfinite(t.uv).all(1)]
        if len(ring) < 3:
            return None, None, ("nothing inside it was measured",)
        w, h = projector.plane_size
        low = np.clip(np.floor(ring.min(0)) - 1, 0, [w - 1, h - 1]).astype(int)
        high = np.clip(np.ceil(ring.max(0)) + 1, 0, [w - 1, h - 1]).astype(int)
        share = fills.inside([ring], low, (int(high[1] - low[1] + 1), int(high[0] - low[0] + 1)))
        patch = fills.polygons([ring], projector, tissue.relief)
    sigma = float(np.nanmedian(t.sigma)) if len(t) else 0.0
    size, error, missing = fills.area(share, low, tissue.relief, outline, sigma)
    notes = (f"{missing:.0%} of its area was not measured and is not lit",) if missing > 0.005 else ()
    return (size, error), patch, notes


def _text(stroke: Stroke, tissue: Tissue, s: GuideSettings, calibration_mm: float) -> tuple[Guided, list[Patch]]:
    places, rings, ground = fills.letters(stroke, tissue, s)
    if not ground.any():
        raise GuidanceError("none of the text lies on the measured surface; move it")
    patch = fills.polygons(rings, tissue.rig.projector, tissue.relief)
    whole = [bool(g.all()) for g in np.split(ground, np.cumsum([len(r) for r in rings])[:-1])]
    closed = [np.vstack([p, p[:1]]) for p in places]
    around = [float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()) for p in closed]
    hidden: tuple[HiddenPart, ...] = ()
    if not all(whole):
        off = np.concatenate(rings)[~ground]
        dark = sum(a for a, w in zip(around, whole, strict=True) if not w)
        hidden = (HiddenPart(off[np.isfinite(off).all(1)], Hidden.HOLE, dark),)
    notes = () if ground.all() else (f"{1 - ground.mean():.0%} of the text lies beside the measured surface",)
    made = Guided(
        stroke, hidden=hidden, notes=notes, length_mm=sum(around),
        segments=tuple(np.vstack([r, r[:1]]) for r, w in zip(rings, whole, strict=True) if w),
        lands=tuple(p for p, w in zip(closed, whole, strict=True) if w),
        expected_error_um=1e3 * calibration_mm if calibration_mm else None,
    )  # fmt: skip
    return made, [] if patch is None else [patch]
