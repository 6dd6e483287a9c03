"""How far a cut ran from the guideline."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fringescope.errors import EmptyResultError
from fringescope.types import F64


@dataclass(frozen=True)
class FromGuideline:
    """How far a cut ran from one stroke, mm; NaN without a point of the cut nearer to it than to another stroke.

    `missed`: share of the stroke's length with no cut within `reach_mm`.
    """

    stroke: int
    points: int
    median_mm: float
    p95_mm: float
    max_mm: float
    missed: float
    reach_mm: float


def from_guideline(cut: F64, strokes: Sequence[F64], reach_mm: float = 3.0) -> tuple[FromGuideline, ...]:
    """Distances of a cut's points (n, 3) from strokes, polylines (m, 3) in world mm; each point counts for the nearest.

    Points of a stroke that are not finite break it. Raises EmptyResultError without strokes that have two points.
    """
    lines = [np.asarray(x, dtype=np.float64).reshape(-1, 3) for x in strokes]
    if not any(len(x) >= 2 and (np.isfinite(x[:-1]) & np.isfinite(x[1:])).all(1).any() for x in lines):
        raise EmptyResultError("no stroke of two points to compare the cut with; check the guidelines")
    away = np.stack([_to_polyline(cut, x) for x in lines]) if len(cut) else np.zeros((len(lines), 0))
    nearest = away.argmin(0) if len(cut) else np.zeros(0, int)
    out = []
    for k, line in enumerate(lines):
        d = away[k][(nearest == k) & np.isfinite(away[k])]
        missed = 1.0
        along = _evenly(line)
        if len(cut) and len(along):
            gap = np.concatenate([np.sqrt(((part[:, None] - cut[None]) ** 2).sum(-1)).min(1)
                                  for part in np.array_split(along, max(1, len(along) * len(cut) // 2_000_000))
                                  if len(part)])  # fmt: skip
            missed = float((gap > reach_mm).mean())
        values = (float(np.median(d)), float(np.percentile(d, 95)), float(d.max())) if len(d) else (math.nan,) * 3
        out.append(FromGuideline(k, len(d), *values, missed, reach_mm))
    return tuple(out)


def _to_polyline(p: F64, line: F64) -> F64:
    """Distances (n,) of points from a polyline; infinite from one without a finite piece."""
    best = np.full(len(p), np.inf)
    for a, b in pairwise(line):
        if np.isfinite(a).all() and np.isfinite(b).all():
            d = b - a
            t = np.clip((p - a) @ d / max(float(d @ d), 1e-24), 0, 1)
            best = np.minimum(best, np.linalg.norm(p - a - t[:, None] * d, axis=1))
    return best


def _evenly(line: F64, step_mm: float = 0.5) -> F64:
    """Points along a polyline, `step_mm` apart."""
    out = []
    for a, b in pairwise(line):
        if np.isfinite(a).all() and np.isfinite(b).all():
            n = max(1, math.ceil(float(np.linalg.norm(b - a)) / step_mm))
            out.append(a + np.linspace(0, 1, min(n, 10_000), endpoint=False)[:, None] * (b - a))
    return np.concatenate(out) if out else np.zeros((0, 3))
