"""Strokes on a photograph or on the surface to places on the tissue, and to the image for the projector (III-F, IV-D).

`tissue` makes a scan ready once; `guide` takes strokes to traces, each with what is hidden and how exact it is, and to
the picture. The parts: `drape` (where is it on the tissue), `curves` and `fills` (shapes that are measured along it),
`inside` (what does an outline enclose), `letters`, `trace` (what does the projector see of it), `draw` (which mirrors),
`find` (where did it land).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fringescope.errors import GuidanceError
from fringescope.guide import curves, drape, fills
from fringescope.guide import inside as within
from fringescope.guide.drape import Samples, Source
from fringescope.guide.draw import Canvas, linear
from fringescope.guide.fills import Patch
from fringescope.guide.find import Shots, landings
from fringescope.guide.inside import Inside
from fringescope.guide.letters import letters
from fringescope.guide.tissue import Tissue, tissue
from fringescope.guide.trace import guided, hidden_parts, mirror_units, trace, usual_sigma, visible_runs
from fringescope.settings import GuideSettings
from fringescope.types import Fill, Guidance, Guided, Guidelines, HiddenPart, Stroke, StrokeKind, Trace

__all__ = [
    "Shots", "Tissue", "guide", "hidden_parts", "landings", "mirror_units", "place", "tissue", "visible_runs",
]  # fmt: skip

DARKEST = 0.03  #: level of the brightest lamp, of what it can, below which nobody sees a line
OVER = 0.05  #: of a stroke's picture that later ones may paint over without a word


def guide(
    guidelines: Guidelines,
    tissue: Tissue,
    s: GuideSettings,
    *,
    calibration_mm: float = 0.0,
    dashed: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Guidance:
    """Strokes to the picture that the projector shows, and what became of each.

    `calibration_mm`: what the rig may be wrong by, on the tissue. `dashed`: they are in doubt. A stroke that cannot be
    shown as it was asked for is refused with the reason, and the others are shown. `progress` is told how many strokes
    are done, of how many.
    """
    canvas = Canvas(tissue.rig.projector)
    out = []
    for done, stroke in enumerate(guidelines.strokes):
        if progress is not None:
            progress(done, len(guidelines.strokes))
        made, patches = place(stroke, tissue, s, calibration_mm)
        canvas.stroke(made, patches, s, dashed)
        out.append(made)
    if progress is not None:
        progress(len(out), len(out))
    for i, lost in enumerate(canvas.painted_over()):
        if lost > OVER:
            out[i] = replace(out[i], notes=(*out[i].notes, f"later strokes paint over {lost:.0%} of it"))
    return Guidance(canvas.image(), tuple(out), guidelines.scan, guidelines.rig)


def place(
    stroke: Stroke, tissue: Tissue, s: GuideSettings, calibration_mm: float = 0.0
) -> tuple[Guided, list[Patch]]:
    """One stroke on the tissue and on the projector's plane, and what of it is filled."""
    try:
        _check_colour(stroke, s)
        return _place(stroke, tissue, s, calibration_mm)
    except GuidanceError as e:
        return Guided(stroke, refused=str(e)), []


def _check_colour(stroke: Stroke, s: GuideSettings) -> None:
    """Raises GuidanceError for a colour that nobody sees."""
    level = float(linear(stroke.color).max())
    name = "#{:02x}{:02x}{:02x}".format(*stroke.color)
    if level < DARKEST:
        raise GuidanceError(f"color {name} is too dark to be seen on the tissue; needed a brighter one")
    if round(255 * level * s.brightness) < 1:
        raise GuidanceError(f"color {name} is dark at a brightness of {s.brightness:g}; raise guide.brightness")


def _place(stroke: Stroke, tissue: Tissue, s: GuideSettings, calibration_mm: float) -> tuple[Guided, list[Patch]]:
    if stroke.kind is StrokeKind.TEXT:
        return _text(stroke, tissue, s, calibration_mm)
    disc: curves.Disc | None = None
    if stroke.kind is StrokeKind.CIRCLE:
        line, disc = curves.circle(stroke, tissue, s)
    else:
        line = drape.drape(stroke, tissue, s)
    lines, notes = [line], line.notes
    if stroke.kind is StrokeKind.ARROW:
        lines += curves.head(line, stroke, tissue, s)
    elif stroke.kind is StrokeKind.OFFSETS:
        lines += curves.offsets(line, stroke, tissue)
    filled = stroke.fill is Fill.SOLID and disc is not None and bool(disc.whole[0].any())
    if not filled and not any((x.source != Source.NOBODY).any() for x in lines):
        raise GuidanceError(_nowhere(line, stroke))
    patches: list[Patch] = []
    size: tuple[float, float] | None = None
    if stroke.closed or stroke.kind in (StrokeKind.REGION, StrokeKind.CIRCLE):
        t = trace(line, stroke, tissue, 0.0, s)
        inside = _inside(t, disc, stroke, tissue, s)
        size, more = _size(inside, line, t, tissue)
        notes += more
        if disc is None and fills.crosses_itself(t.uv if stroke.pixels is None else stroke.pixels):
            notes += ("its outline crosses itself: what it goes round twice counts as outside",)
        if inside is not None and stroke.fill is Fill.SOLID:
            patches.append(fills.lit(inside.share, inside.low, tissue.rig.projector, tissue.relief))
        elif inside is not None and stroke.fill is Fill.HATCH:
            known = np.isfinite(line.xyz).all(1)
            lines += curves.hatch(line.xyz[known], inside, stroke, tissue, s)
    traces = [trace(x, stroke, tissue, calibration_mm, s) for x in lines if len(x)]
    return guided(stroke, traces, notes, size), patches


def _nowhere(line: Samples, stroke: Stroke) -> str:
    what = "none of its outline" if stroke.closed or stroke.kind is StrokeKind.REGION else "none of it"
    if stroke.pixels is not None:
        return f"{what} lies where the tissue was measured, as {stroke.camera} sees it; draw it on the tissue"
    return f"{what} lies on the measured surface; " + ("; ".join(line.notes) or "draw it on the tissue")


def _inside(
    t: Trace, disc: curves.Disc | None, stroke: Stroke, tissue: Tissue, s: GuideSettings
) -> Inside | None:
    """What a closed stroke encloses; None where nothing of that was measured."""
    if disc is not None:
        return within.of_ways(disc.ways, disc.whole, tissue.rig.projector)
    if stroke.pixels is None:
        return within.of_outline(t, tissue, s)
    assert stroke.camera is not None
    units = fills.in_photograph(stroke.pixels, stroke.camera, tissue)
    return None if units is None else Inside(*units)


def _size(
    inside: Inside | None, line: Samples, t: Trace, tissue: Tissue
) -> tuple[tuple[float, float] | None, tuple[str, ...]]:
    """Area of what is enclosed, with its sigma, and what is to be said of it."""
    dark: tuple[str, ...] = ()
    if inside is not None and inside.dark > 0.005:
        dark = (f"its outline is not on what the projector lights: {inside.dark:.0%} of what it encloses stays dark",)
    if inside is None or not inside.share.any():
        return None, dark or ("nothing inside it was measured",)
    outline = line.xyz[np.isfinite(line.xyz).all(1)]
    size, error, missing = fills.area(inside.share, inside.low, tissue.relief, outline, usual_sigma(t))
    unknown = (f"{missing:.0%} of its area was not measured and is not lit",) if missing > 0.005 else ()
    return (size, error), (*dark, *unknown)


def _text(stroke: Stroke, tissue: Tissue, s: GuideSettings, calibration_mm: float) -> tuple[Guided, list[Patch]]:
    made = letters(stroke, tissue, s)
    shown, dark = [x for x in made if x.why is None], [x for x in made if x.why is not None]
    if not shown:
        raise GuidanceError("no letter of it lies wholly on visible surface; move it, or write smaller")
    notes: tuple[str, ...] = ()
    if dark:
        names = [c for c in stroke.text if not c.isspace()]
        named = [repr(n) + " " for n in names] if len(names) == len(made) else [""] * len(made)
        which = ", ".join(f"{n}({x.reason})" for n, x in zip(named, made, strict=True) if x.why)
        are = "is" if len(dark) == 1 else "are"
        told = f"{len(dark)} of {len(made)} letters {are} not wholly on visible, unbroken surface and {are} not drawn"
        notes = (f"{told}: {which}",)
    hidden = []
    for x in dark:
        assert x.why is not None
        around = np.concatenate(x.rings)
        hidden.append(HiddenPart(around[np.isfinite(around).all(1)], x.why, x.length_mm))
    patches = []
    for x in shown:
        low, size = within.window(np.concatenate(x.rings), tissue.rig.projector)
        patches.append(fills.lit(fills.inside(x.rings, low, size), low, tissue.rig.projector, tissue.relief))
    return Guided(
        stroke,
        segments=tuple(r for x in shown for r in x.rings),
        lands=tuple(p for x in shown for p in x.lands),
        hidden=tuple(hidden),
        length_mm=sum(x.length_mm for x in made),
        expected_error_um=1e3 * calibration_mm if calibration_mm else None,
        notes=notes,
    ), patches
