"""Strokes of one scan carried over to the next by rigid registration, with its residual: an offer, for the operator."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np

from fringescope import guide, register
from fringescope.errors import GuidanceError
from fringescope.guide import drape
from fringescope.guide.drape import Samples, Source
from fringescope.pipeline import comparing
from fringescope.settings import Settings
from fringescope.types import F64, Bool, Cloud, Guidelines, Rig, Stroke, StrokeKind


@dataclass(frozen=True, eq=False)
class Carried:
    """Guidelines in mm of the new scan, what they rest on, and the error to expect of each stroke, um (median)."""

    guidelines: Guidelines
    registration: register.Registration
    expected_error_um: dict[str, float]


def carry_over(
    guidelines: Guidelines, old: guide.Tissue, before: Cloud, after: Cloud, rig: Rig, settings: Settings | None = None
) -> Carried:
    """Strokes on the old scan's tissue to where it lies in the new scan. They are not bound to a scan afterwards.

    A line that was broken on the old tissue becomes several strokes, `cut-1`, `cut-1 (2)` .. What was not on the
    measured surface is left behind; a stroke of which nothing is left is refused, with the reason. Raises
    RegistrationError where the tissue moved too far, was bent, or is another.
    """
    s = settings or Settings()
    found = comparing.laid(before, after, rig, s)
    strokes: list[Stroke] = []
    refused = dict(guidelines.refused)
    errors: dict[str, float] = {}
    taken = {x.id for x in guidelines.strokes} | set(refused)
    for stroke in guidelines.strokes:
        try:
            parts = _pieces(stroke, old, s)
        except GuidanceError as e:
            refused[stroke.id] = str(e)
            continue
        for i, part in enumerate(parts):
            there, error = register.carried(part, found)
            name = stroke.id if i == 0 else _unused(stroke.id, taken)
            taken.add(name)
            closed = stroke.closed and len(parts) == 1
            headless = stroke.kind is StrokeKind.ARROW and i < len(parts) - 1
            kind = StrokeKind.LINE if headless else stroke.kind
            strokes.append(
                replace(stroke, id=name, kind=kind, camera=None, pixels=None, world_mm=there, closed=closed)
            )
            errors[name] = float(np.median(error))
    return Carried(Guidelines(tuple(strokes), refused=refused), found, errors)


def _unused(name: str, taken: set[str]) -> str:
    """`name (2)`, or the next number that no stroke has."""
    return next(n for k in itertools.count(2) if (n := f"{name} ({k})") not in taken)


def _pieces(stroke: Stroke, tissue: guide.Tissue, s: Settings) -> list[F64]:
    """The unbroken pieces of a stroke on the tissue, mm, (n, 3) each."""
    if stroke.kind in (StrokeKind.CIRCLE, StrokeKind.TEXT):
        points = drape.places(stroke, stroke.points, tissue, s.guide)
        if not np.isfinite(points).all():
            raise GuidanceError("some of its points are not on the surface that was scanned before; draw it anew")
        return [points]
    line = drape.drape(stroke, tissue, s.guide)
    known = (line.source != Source.NOBODY) & np.isfinite(line.xyz).all(1)
    if stroke.kind is StrokeKind.REGION:
        parts = [line.xyz[known]]
        parts = [p[:-1] for p in parts if len(p) > 3]  # it is closed again where it is drawn
    else:
        parts = _runs(line, known)
    if not parts:
        raise GuidanceError("none of it lies on the surface that was scanned before; draw it anew")
    return parts


def _runs(line: Samples, known: Bool) -> list[F64]:
    key = np.where(known, line.piece.astype(np.int64), -1)
    cuts = np.flatnonzero(np.diff(key)) + 1
    groups = np.split(np.arange(len(key)), cuts)
    return [line.xyz[g] for g in groups if key[g[0]] >= 0 and len(g) > 2]
