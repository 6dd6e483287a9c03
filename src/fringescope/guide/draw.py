"""Traces and patches to the picture that the projector shows."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fringescope.guide.fills import Patch
from fringescope.guide.trace import visible_runs
from fringescope.kernels import guiding as k
from fringescope.settings import GuideSettings
from fringescope.types import F32, F64, U8, Guided, Layout, Projector, Trace

PAINTED = 0.25  #: share of a pixel that makes it a stroke's
STRIPE = 16  #: rows of the device in a stripe of what is filled and in doubt


def linear(color: tuple[int, int, int]) -> F64:
    """An sRGB colour, 0..255, as levels (3,) of lamps that are linear in light, 0..1 (IEC 61966-2-1)."""
    c = np.array(color) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


class Canvas:
    """The picture of a projector, painted stroke over stroke, in levels of its lamps."""

    def __init__(self, projector: Projector) -> None:
        self._projector = projector
        self._light = np.zeros((projector.height, projector.width, 3), np.float32)
        self._touched = (slice(projector.height, 0), slice(projector.width, 0))
        self._owner = np.zeros((projector.height, projector.width), np.int32)  # 1 + the number of a stroke
        self._painted = [0]  # by nobody, and by each stroke

    def stroke(self, g: Guided, patches: Sequence[Patch], s: GuideSettings, dashed: bool) -> None:
        """Paints what of a stroke is visible."""
        self._painted.append(0)
        color = linear(g.stroke.color).astype(np.float32) * np.float32(s.brightness)
        for patch in patches:
            share = patch.share
            if dashed:  # in stripes
                rows = (patch.top + np.arange(len(share))) // STRIPE % 2 == 0
                share = np.ascontiguousarray(share * rows[:, None], np.float32)
            self._paint(share, patch.top, patch.left, color)
        parts = [ribbons_of(t, a, b, s.dash_mm if dashed else None) for t in g.traces for a, b in visible_runs(t)]
        if not parts:
            return
        every = np.concatenate(parts)
        if not len(every):
            return
        reach = np.maximum(every[:, 2], every[:, 5]).max() + 2
        diamond = self._projector.layout is Layout.DIAMOND
        step = 2 if diamond else 1
        spans = []
        for axis, size, unit in ((0, self._projector.width, step), (1, self._projector.height, 1)):
            first = int(np.clip(math.floor((every[:, [axis, axis + 3]].min() - reach) / unit), 0, size - 1))
            end = int(np.clip(math.ceil((every[:, [axis, axis + 3]].max() + reach) / unit) + 1, first + 1, size))
            spans.append((first, end))
        (left, right), (top, bottom) = spans
        share = np.zeros((bottom - top, right - left), np.float32)
        every[:, [0, 3]] -= left * step
        k.ribbons(every, diamond, top, share)
        self._paint(share, top, left, color)

    def _paint(self, share: F32, top: int, left: int, color: F32) -> None:
        if left < 0 or top < 0:
            share, left, top = share[max(-top, 0) :, max(-left, 0) :], max(left, 0), max(top, 0)
        part = self._light[top : top + share.shape[0], left : left + share.shape[1]]
        share = share[: part.shape[0], : part.shape[1]]
        k.paint(share, color, part)
        owner, mine = self._owner[top : top + part.shape[0], left : left + part.shape[1]], len(self._painted) - 1
        new = (share >= PAINTED) & (owner != mine)
        self._painted[mine] += int(np.count_nonzero(new))
        owner[new] = mine
        rows, columns = part.shape[:2]
        self._touched = (
            slice(min(self._touched[0].start, top), max(self._touched[0].stop, top + rows)),
            slice(min(self._touched[1].start, left), max(self._touched[1].stop, left + columns)),
        )

    def painted_over(self) -> list[float]:
        """The share of each stroke's pixels that later ones have taken, 0..1."""
        left = np.bincount(self._owner[self._touched].ravel(), minlength=len(self._painted))
        return [1 - float(left[i]) / n if n else 0.0 for i, n in enumerate(self._painted) if i]

    def image(self) -> U8:
        """The picture (height, width, 3) RGB."""
        out: U8 = np.zeros(self._light.shape, np.uint8)
        if self._touched[0].stop:
            out[self._touched] = np.clip(np.rint(self._light[self._touched] * 255), 0, 255)
        return out


def ribbons_of(t: Trace, first: int, last: int, dash_mm: float | None) -> F64:
    """Parts (m, 6) of a visible run of a trace, as kernels draw them; with `dash_mm` only the dashes."""
    uv, half = t.uv[first:last], t.half[first:last]
    out = np.column_stack([uv[:-1], half[:-1], uv[1:], half[1:]])
    if dash_mm is not None:
        gone = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(t.xyz[first:last], axis=0), axis=1))])
        on = (gone[:-1] % (2 * dash_mm)) < dash_mm
        out = out[on]
    return np.ascontiguousarray(out[np.isfinite(out).all(1)])
